"""VGGT against the official network's stored results, against DINOv2 of transformers, and as a transformers model."""

import json
import logging
import math
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel, pipeline
from transformers.modeling_outputs import DepthEstimatorOutput

from gift_peft.adapters import get_gift_model, save_adapter
from gift_peft.data.preprocess import to_pixel_values
from gift_peft.group_step import GroupStep
from gift_peft.models import register_models
from gift_peft.models.vggt import VggtConfig, VggtForDepthEstimation, VggtImageProcessorPil
from gift_peft.models.vggt.head_vggt import position_map
from gift_peft.models.vggt.modeling_vggt import rotary_angles, rotate

FIXTURES = Path(__file__).parent / "fixtures" / "vggt"
SIDECAR = json.loads((FIXTURES / "golden_public.json").read_text())
SHAPES = Path(__file__).parents[2] / "shared/reference/vggt/vggt1b_state_dict_shapes.json"


def tiny_config(**changes) -> VggtConfig:
    sizes = {
        "img_size": 70,
        "embed_dim": 24,
        "num_heads": 2,
        "mlp_ratio": 2.0,
        "num_register_tokens": 3,
        "vit_depth": 2,
        "depth": 4,
        "intermediate_layer_idx": [0, 1, 2, 3],
        "features": 16,
        "out_channels": [8, 12, 16, 20],
        "head_features_2": 8,
    }
    return VggtConfig(**sizes | changes)


def tiny_vggt(seed: int = 0, **changes) -> VggtForDepthEstimation:
    """In eval mode; random weights everywhere, so that no bias, norm or token goes untested."""
    model = VggtForDepthEstimation(tiny_config(**changes)).eval()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            noise = torch.randn(weight.shape, generator=generator)
            if name.endswith("norm.weight") or "norm1.weight" in name or "norm2.weight" in name:
                weight.copy_(1 + 0.1 * noise)
            elif weight.ndim > 1 and "token" not in name and "embed" not in name.split(".")[-1]:
                weight.copy_(noise / weight[0].numel() ** 0.5)
            else:
                weight.copy_(0.1 * noise)
    return model


@pytest.fixture(scope="module")
def tensors():
    return load_file(FIXTURES / "golden_public.safetensors")


@pytest.fixture(scope="module")
def official(tensors):
    """The golden model's weights by official name."""
    return {name: value for name, value in tensors.items() if not name.startswith("golden.")}


@pytest.fixture(scope="module")
def golden(official):
    return VggtForDepthEstimation.from_official(official, VggtConfig(**SIDECAR["config"]))


@pytest.fixture(scope="module")
def tiny():
    return tiny_vggt()


def images(*shape, seed=1):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


# ---- the official network's results ----


def relative(ours, theirs):
    return ((ours - theirs).abs() / theirs.abs()).max().item()


def of_maximum(ours, theirs):
    assert ours.shape == theirs.shape
    return ((ours - theirs).abs().max() / theirs.abs().max()).item()


@pytest.mark.parametrize("case", SIDECAR["cases"])
def test_goldens(golden, tensors, case):
    expected = {k.split(".", 2)[2]: v for k, v in tensors.items() if k.startswith(f"golden.{case}.")}
    seen = {}
    parts = {
        "patch_tokens": golden.aggregator.patch_embed,
        "dpt_fused": golden.depth_head.scratch.output_conv1,
        "head_logits": golden.depth_head.scratch.output_conv2,
    }
    hooks = [
        part.register_forward_hook(lambda module, args, output, name=name: seen.update({name: output}))
        for name, part in parts.items()
    ]
    with torch.no_grad():
        output = golden(expected["images"], output_hidden_states=True)
    for hook in hooks:
        hook.remove()
    seen |= {f"agg.{index}": level for index, level in zip([0, 2, 3, 4], output.hidden_states, strict=True)}
    for name, value in seen.items():
        assert of_maximum(value, expected[name]) < 1e-5, name
    assert relative(output.predicted_depth, expected["depth"].squeeze(-1)) < 3e-5
    assert relative(output.confidence, expected["depth_conf"]) < 3e-5


def test_golden_gradients(official, tensors):
    model = VggtForDepthEstimation.from_official(official, VggtConfig(**SIDECAR["config"]))
    case = SIDECAR["grad_case"]
    output = model(tensors[f"golden.{case}.images"])
    loss = output.predicted_depth.log().mean() + 0.1 * output.confidence.log().mean()
    assert loss.item() == pytest.approx(SIDECAR["loss"], rel=1e-5)
    loss.backward()
    for name in SIDECAR["grad_max_abs"]:
        assert of_maximum(model.get_parameter(name).grad, tensors[f"golden.{case}.grad.{name}"]) < 1e-4, name
    assert not model.aggregator.camera_token.grad[:, 1].any()  # single frames have no second one


# ---- parts against other code ----


@pytest.mark.parametrize("size", [(70, 70), (42, 98), (126, 154)], ids=["native", "wide", "larger"])
def test_image_transformer_is_dinov2_with_registers(tiny, size):
    ours = tiny.aggregator.patch_embed
    config = tiny.config
    theirs = Dinov2WithRegistersModel(
        Dinov2WithRegistersConfig(
            hidden_size=config.embed_dim,
            num_hidden_layers=config.vit_depth,
            num_attention_heads=config.num_heads,
            mlp_ratio=2,
            layer_norm_eps=1e-6,
            image_size=config.img_size,
            patch_size=14,
            num_register_tokens=config.num_register_tokens,
        )
    ).eval()
    with torch.no_grad():
        embeddings = theirs.embeddings
        embeddings.cls_token.copy_(ours.cls_token)
        embeddings.register_tokens.copy_(ours.register_tokens)
        embeddings.position_embeddings.copy_(ours.pos_embed)
        embeddings.patch_embeddings.projection.load_state_dict(ours.patch_embed.proj.state_dict())
        theirs.layernorm.load_state_dict(ours.norm.state_dict())
        for block, layer in zip(ours.blocks, theirs.encoder.layer, strict=True):
            layer.norm1.load_state_dict(block.norm1.state_dict())
            layer.norm2.load_state_dict(block.norm2.state_dict())
            parts = zip(block.attn.qkv.weight.chunk(3), block.attn.qkv.bias.chunk(3), ["q", "k", "v"], strict=True)
            for weight, bias, letter in parts:
                layer.attention.get_submodule(f"{letter}_proj").load_state_dict({"weight": weight, "bias": bias})
            layer.attention.o_proj.load_state_dict(block.attn.proj.state_dict())
            layer.mlp.fc1.load_state_dict(block.mlp.fc1.state_dict())
            layer.mlp.fc2.load_state_dict(block.mlp.fc2.state_dict())
            layer.layer_scale1.lambda1.copy_(block.ls1.gamma)
            layer.layer_scale2.lambda1.copy_(block.ls2.gamma)
        pixels = images(2, 3, *size)
        expected = theirs(pixels).last_hidden_state[:, 1 + config.num_register_tokens :]
        torch.testing.assert_close(ours(pixels), expected, rtol=1e-5, atol=1e-5)


def test_rotary_embedding_of_every_token():
    grid, special, dim, base = (2, 3), 2, 12, 50.0
    cos, sin = rotary_angles(grid, special, dim, base, torch.device("cpu"), torch.float64)
    x = torch.randn(1, 1, special + 6, dim, dtype=torch.float64)
    expected = x[0, 0].numpy().copy()
    positions = [(0, 0)] * special + [(row, column) for row in (1, 2) for column in (1, 2, 3)]
    for token, position in enumerate(positions):
        for axis in (0, 1):
            for j in range(dim // 4):
                first = axis * dim // 2 + j
                second = first + dim // 4
                pair = complex(x[0, 0, token, first], x[0, 0, token, second])
                pair *= np.exp(1j * position[axis] * base ** (-2 * j / (dim // 2)))
                expected[token, [first, second]] = pair.real, pair.imag
    np.testing.assert_allclose(rotate(x, cos, sin)[0, 0], expected, rtol=1e-12, atol=1e-12)


def test_position_map_of_every_pixel():
    (height, width), image, channels = (3, 5), (42, 70), 8
    ours = position_map(channels, (height, width), image, torch.zeros(1))
    diagonal = math.hypot(*image)
    for row in range(height):
        for column in range(width):
            u = image[1] / diagonal * (width - 1) / width * (2 * column / (width - 1) - 1)
            v = image[0] / diagonal * (height - 1) / height * (2 * row / (height - 1) - 1)
            waves = [f(at * 100 ** (-j / 2)) for at in (u, v) for f in (math.sin, math.cos) for j in (0, 1)]
            np.testing.assert_allclose(ours[:, row, column], 0.1 * np.array(waves), atol=1e-7)
    single = position_map(channels, (1, 1), (14, 14), torch.zeros(1))  # one patch: the middle, not 0 / 0
    np.testing.assert_allclose(single.flatten(), [0, 0, 0.1, 0.1] * 2, atol=1e-7)


# ---- scenes and batches ----


def test_a_batch_is_single_frame_scenes_that_do_not_see_each_other(tiny):
    pixels = images(5, 3, 42, 28)
    with torch.no_grad():
        batch = tiny(pixels)
        scenes = tiny(pixels[:, None])
        singles = torch.cat([tiny(image[None]).predicted_depth for image in pixels])
        one_scene = tiny(pixels[None])
    assert isinstance(batch, DepthEstimatorOutput)
    assert batch.predicted_depth.shape == batch.confidence.shape == (5, 42, 28)
    assert scenes.predicted_depth.shape == (5, 1, 42, 28)
    assert one_scene.predicted_depth.shape == one_scene.confidence.shape == (1, 5, 42, 28)
    assert torch.equal(batch.predicted_depth, scenes.predicted_depth[:, 0])
    torch.testing.assert_close(batch.predicted_depth, singles, rtol=1e-4, atol=0)
    assert relative(one_scene.predicted_depth[0], batch.predicted_depth) > 1e-3
    assert (batch.predicted_depth > 0).all() and (batch.confidence > 1).all()


def test_only_the_first_frame_of_a_scene_is_special(tiny):
    pixels = images(1, 3, 3, 28, 42)
    with torch.no_grad():
        depth = tiny(pixels).predicted_depth
        swapped = tiny(pixels[:, [0, 2, 1]]).predicted_depth
        moved = tiny(pixels[:, [1, 0, 2]]).predicted_depth
    torch.testing.assert_close(swapped, depth[:, [0, 2, 1]], rtol=1e-4, atol=0)
    assert relative(moved, depth[:, [1, 0, 2]]) > 1e-3


@pytest.mark.parametrize("size", [(14, 14), (14, 56), (70, 70), (98, 28)])
def test_every_multiple_of_the_patch_is_a_size(tiny, size):
    with torch.no_grad():
        assert tiny(images(1, 3, *size)).predicted_depth.shape == (1, *size)


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (torch.zeros(1, 3, 30, 28), "30x28: height and width must be multiples of 14"),
        (torch.zeros(1, 2, 3, 28, 29), "28x29"),
        (torch.zeros(0, 3, 28, 28), "empty"),
        (torch.zeros(2, 0, 3, 28, 28), "empty"),
        (torch.zeros(1, 3, 0, 28), "empty"),
        (torch.zeros(1, 4, 28, 28), r"\(B, 3, H, W\)"),
        (torch.zeros(3, 28, 28), r"\(B, 3, H, W\)"),
        (torch.zeros(1, 3, 28, 28, dtype=torch.uint8), r"floats in \[0, 1\], got torch.uint8"),
    ],
)
def test_input_errors(tiny, pixels, message):
    with pytest.raises(ValueError, match=message):
        tiny(pixels)


def test_forward_returns_tuples_and_refuses_labels(tiny):
    pixels = images(1, 3, 28, 28)
    with torch.no_grad():
        depth, confidence = tiny(pixels, return_dict=False)
        output = tiny(pixels)
    assert torch.equal(depth, output.predicted_depth) and torch.equal(confidence, output.confidence)
    with pytest.raises(NotImplementedError, match="labels"):
        tiny(pixels, labels=depth)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"intermediate_layer_idx": [0, 1, 2]}, "4 entries"),
        ({"intermediate_layer_idx": [0, 1, 2, 4]}, r"0\.\.3"),
        ({"embed_dim": 20}, "embed_dim 20 must be a multiple of"),
        ({"out_channels": [8, 12, 16, 18]}, "out_channels"),
        ({"features": 12}, "features 12"),
        ({"img_size": 75}, "img_size 75"),
    ],
)
def test_config_errors(change, message):
    with pytest.raises(ValueError, match=message):
        tiny_config(**change)


# ---- the full size ----


def test_vggt_1b_has_the_official_tensors():
    with torch.device("meta"):
        model = VggtForDepthEstimation(VggtConfig())
    assert sum(p.numel() for p in model.aggregator.parameters()) == 909_112_320
    assert sum(p.numel() for p in model.depth_head.parameters()) == 32_654_562
    assert sum(p.numel() for p in model.parameters()) == 941_766_882
    state = {name: list(tensor.shape) for name, tensor in model.state_dict().items()}
    assert len(state) == 1210 + 62
    assert not list(model.named_buffers())
    if not SHAPES.exists():
        pytest.skip("the list of the official shapes is not in this checkout")
    listed = json.loads(SHAPES.read_text())
    assert state == {k: v for k, v in listed.items() if k.startswith(("aggregator.", "depth_head."))}


def test_full_size_forward_needs_no_values():
    """On the meta device every look at a tensor's value (`.item()`, `int(tensor)`, `bool(tensor)`) raises."""
    with torch.device("meta"):
        model = VggtForDepthEstimation(VggtConfig(vit_depth=2, depth=4, intermediate_layer_idx=[0, 1, 2, 3])).eval()
        assert model(torch.empty(2, 3, 476, 644)).predicted_depth.shape == (2, 476, 644)
        assert model(torch.empty(2, 3, 3, 28, 42)).predicted_depth.shape == (2, 3, 28, 42)


# ---- as a transformers model ----


@pytest.mark.parametrize("training", [False, True])
def test_save_and_load(tmp_path, training):
    model = tiny_vggt(seed=3).train(training)
    model.save_pretrained(tmp_path)
    again = VggtForDepthEstimation.from_pretrained(tmp_path).train(training)
    assert list(again.named_buffers()) == list(model.named_buffers()) == []
    state = again.state_dict()
    assert state.keys() == model.state_dict().keys()
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())
    fields = ["img_size", "mlp_ratio", "intermediate_layer_idx", "out_channels", "rope_freq", "qk_norm"]
    assert [getattr(again.config, name) for name in fields] == [getattr(model.config, name) for name in fields]
    pixels = images(2, 3, 42, 70)
    ours, theirs = model(pixels), again(pixels)
    assert torch.equal(ours.predicted_depth, theirs.predicted_depth)
    assert torch.equal(ours.confidence, theirs.confidence)


def test_random_weights_predict_something(tmp_path):
    model = VggtForDepthEstimation(tiny_config())
    assert torch.equal(model.aggregator.frame_blocks[0].ls1.gamma, torch.full((24,), 0.01))
    assert torch.equal(model.aggregator.patch_embed.blocks[0].ls1.gamma, torch.ones(24))
    assert 0.015 < model.aggregator.patch_embed.pos_embed.std() < 0.025
    assert torch.isfinite(model(images(1, 3, 28, 28)).predicted_depth).all()


def test_official_folder_loads_without_noise(tmp_path, official, golden, caplog, capfd):
    """The hub's layout: safetensors with all heads and a config without model_type."""
    heads = {f"{head}_head.norm.weight": torch.ones(3) for head in ("camera", "point", "track")}
    state = {k: v for k, v in official.items() if not k.endswith("mask_token")} | heads
    save_file(state, tmp_path / "model.safetensors")
    (tmp_path / "config.json").write_text(json.dumps(SIDECAR["config"]))
    capfd.readouterr()
    with caplog.at_level(logging.INFO):
        model = VggtForDepthEstimation.from_pretrained(tmp_path)
    noise = capfd.readouterr().err + caplog.text
    assert "head" not in noise and "mask_token" not in noise and "LOAD REPORT" not in noise, noise
    pixels = images(2, 3, 28, 42)
    with torch.no_grad():
        assert torch.equal(model(pixels).predicted_depth, golden(pixels).predicted_depth)
    assert all(torch.isfinite(value).all() for value in model.state_dict().values())


def test_gradient_checkpointing(tiny):
    model = tiny_vggt().train()
    pixels = images(2, 2, 3, 28, 42)
    calls = []
    model.aggregator.global_blocks[1].attn.register_forward_hook(lambda *_: calls.append(1))
    gradients = []
    for checkpointing in (False, True):
        if checkpointing:
            model.activation_checkpointing_enable()
        model.zero_grad()
        calls.clear()
        model(pixels).predicted_depth.log().mean().backward()
        assert len(calls) == 1 + checkpointing
        gradients.append({name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None})
    assert gradients[0].keys() == gradients[1].keys()
    for name, gradient in gradients[0].items():
        assert torch.equal(gradient, gradients[1][name]), name


def test_attention_implementations_agree():
    pixels = images(1, 2, 3, 28, 42)
    model = tiny_vggt()
    assert model.config._attn_implementation == "sdpa"
    with torch.no_grad():
        fused = model(pixels).predicted_depth
        model.set_attn_implementation("eager")
        torch.testing.assert_close(model(pixels).predicted_depth, fused, rtol=1e-5, atol=0)


def test_bf16_autocast_keeps_the_head_in_float32(tiny):
    pixels = images(2, 3, 42, 42)
    seen = []
    hooks = [
        tiny.aggregator.global_blocks[3].attn.qkv.register_forward_hook(
            lambda m, a, output: seen.append(output.dtype)
        ),
        tiny.depth_head.projects[3].register_forward_hook(lambda m, a, output: seen.append(output.dtype)),
    ]
    with torch.no_grad():
        exact = tiny(pixels).predicted_depth
        seen.clear()
        with torch.autocast("cpu", dtype=torch.bfloat16):
            depth = tiny(pixels).predicted_depth
    for hook in hooks:
        hook.remove()
    assert seen == [torch.bfloat16, torch.float32]
    assert depth.dtype == torch.float32
    assert 0 < relative(depth, exact) < 0.1


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_other_weight_precisions(tiny, dtype):
    pixels = images(1, 2, 3, 42, 28)
    with torch.no_grad():
        depth = tiny_vggt().to(dtype)(pixels.to(dtype)).predicted_depth
        exact = tiny(pixels).predicted_depth
    assert depth.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    assert relative(depth, exact) < (1e-5 if dtype == torch.float64 else 0.2)


def test_compiles_without_graph_breaks():
    model = tiny_vggt(vit_depth=1, depth=1, intermediate_layer_idx=[0, 0, 0, 0])
    pixels = images(1, 2, 3, 28, 42)
    with torch.no_grad():
        expected = model(pixels).predicted_depth
        whole = torch.compile(model, fullgraph=True, backend="eager")
        torch.testing.assert_close(whole(pixels).predicted_depth, expected, rtol=1e-5, atol=0)
        for blocks in (model.aggregator.patch_embed.blocks, model.aggregator.frame_blocks):
            blocks[0].compile(fullgraph=True, backend="aot_eager")
        torch.testing.assert_close(model(pixels).predicted_depth, expected, rtol=1e-5, atol=0)


# ---- official files ----


def test_checkpoint_files(tmp_path, official, golden):
    config = VggtConfig(**SIDECAR["config"])
    wrapped = {f"module.{name}": value for name, value in official.items() if not name.endswith("mask_token")}
    torch.save(official, tmp_path / "plain.pt")
    torch.save({"model_state_dict": wrapped, "epoch": 3}, tmp_path / "wrapped.pth")
    torch.save(official, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    sources = [FIXTURES / "golden_public.safetensors", *sorted(tmp_path.iterdir()), wrapped]
    pixels = images(1, 3, 28, 42)
    with torch.no_grad():
        expected = golden(pixels).predicted_depth
        for source in sources:
            model = VggtForDepthEstimation.from_official(source, config)
            assert not model.training and model.dtype == torch.float32
            assert torch.equal(model(pixels).predicted_depth, expected)
            model.depth_head.norm.weight.zero_()  # a copy: neither dict nor file changes
    assert official["depth_head.norm.weight"].any()


def test_half_precision_checkpoints_become_float32(official):
    half = {name: value.to(torch.bfloat16) for name, value in official.items()}
    model = VggtForDepthEstimation.from_official(half, VggtConfig(**SIDECAR["config"]))
    assert {value.dtype for value in model.state_dict().values()} == {torch.float32}


class Runs:
    def __reduce__(self):
        return os.system, ("true",)


def write_bad(folder: Path, kind: str, official) -> Path:
    path = folder / "model.pt"
    if kind.startswith("truncated"):
        if kind.endswith("safetensors"):
            path = FIXTURES / "golden_public.safetensors"
        else:
            torch.save(official, path)
        content = path.read_bytes()
        path = folder / f"cut-{path.name}"
        path.write_bytes(content[: len(content) // 2])
    elif kind == "empty":
        path.touch()
    elif kind == "text":
        path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    elif kind == "code":
        torch.save({"model": Runs()}, path)
    elif kind == "pickle":
        path.write_bytes(pickle.dumps({"a": Runs()}, protocol=2))
    elif kind == "other":
        torch.save({"depth_model.encoder.cls_token": torch.zeros(1)}, path)
    elif kind == "list":
        torch.save([torch.zeros(1)], path)
    elif kind == "folder":
        path = folder
    return path


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("truncated safetensors", r"cut-golden_public.*truncated.*\d+ bytes"),
        ("truncated pt", r"cut-model\.pt: truncated.*\d+ bytes"),
        ("empty", "0 bytes"),
        ("text", "neither a safetensors nor a torch file"),
        ("code", "refused"),
        ("pickle", "refused"),
        ("other", "not a VGGT checkpoint.*'depth_model.encoder.cls_token'"),
        ("list", "holds a list"),
        ("folder", "is a folder"),
    ],
)
def test_bad_files(tmp_path, official, kind, message):
    path = write_bad(tmp_path, kind, official)
    with pytest.raises(ValueError, match=message) as error:
        VggtForDepthEstimation.from_official(path, VggtConfig(**SIDECAR["config"]))
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_checkpoints_of_another_variant(official):
    sizes = SIDECAR["config"]
    with pytest.raises(ValueError, match=r"aggregator\.camera_token has shape .*64.* asks for .*1024"):
        VggtForDepthEstimation.from_official(official)
    with pytest.raises(ValueError, match=r"aggregator\.frame_blocks\.4\.\S+ has no place"):
        VggtForDepthEstimation.from_official(
            official, VggtConfig(**sizes | {"depth": 4, "intermediate_layer_idx": [0, 1, 2, 3]})
        )
    with pytest.raises(ValueError, match=r"aggregator\.patch_embed\.blocks\.2\.norm1\.weight is missing"):
        VggtForDepthEstimation.from_official(official, VggtConfig(**sizes | {"vit_depth": 3}))
    broken = official | {"depth_head.norm.bias": torch.zeros(128, dtype=torch.int64)}
    with pytest.raises(ValueError, match=r"depth_head\.norm\.bias holds torch\.int64"):
        VggtForDepthEstimation.from_official(broken, VggtConfig(**sizes))
    with pytest.raises(FileNotFoundError, match="nowhere"):
        VggtForDepthEstimation.from_official("nowhere.pt")


# ---- GIFT ----


@pytest.mark.parametrize("head", ["full", "lora"])
def test_gift_trains_an_adapter(tmp_path, head):
    from peft import PeftModel

    base = tiny_vggt()
    pixels = images(3, 3, 28, 42)
    with torch.no_grad():
        teacher = base(pixels).predicted_depth
    model = get_gift_model(base, head=head)
    adapted = {name.split(".lora_A")[0] for name, _ in model.named_parameters() if ".lora_A" in name}
    assert sum(".attn." in name for name in adapted) == 2 * (2 + 2 * 4)
    mask = torch.zeros(3, 28, 42, dtype=torch.bool)
    mask[:, 7:21, 10:30] = True
    step = GroupStep(model)
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=2e-4)
    losses = []
    for _ in range(6):
        output = step.accumulate(pixels, mask, teacher)
        losses.append(float(output.total))
        optimizer.step()
        optimizer.zero_grad()
    assert losses[-1] < losses[0]
    with torch.no_grad():
        trained = model(pixel_values=pixels).predicted_depth
        with model.disable_adapter():
            assert torch.equal(model(pixel_values=pixels).predicted_depth, teacher)
        save_adapter(model, tmp_path / "adapter", "tiny/base")
        again = PeftModel.from_pretrained(tiny_vggt(), tmp_path / "adapter")
        assert torch.equal(again(pixel_values=pixels).predicted_depth, trained)
        merged = again.merge_and_unload()
        torch.testing.assert_close(merged(pixel_values=pixels).predicted_depth, trained, rtol=1e-4, atol=0)


# ---- image processor ----


def picture(height, width, seed=0):
    rng = np.random.default_rng(seed)
    return Image.fromarray(rng.integers(0, 256, (height, width, 3), dtype=np.uint8))


def test_processor_only_resizes_and_rescales():
    processor = VggtImageProcessorPil()
    pictures = [picture(60, 80), picture(90, 50, seed=1)]
    pixels = processor(pictures, return_tensors="pt")["pixel_values"]
    assert pixels.shape == (2, 3, 476, 644) and pixels.dtype == torch.float32
    resized = np.asarray(pictures[1].resize((644, 476), Image.Resampling.BICUBIC), dtype=np.float32)
    np.testing.assert_allclose(pixels[1], resized.transpose(2, 0, 1) / 255, atol=1e-6)
    assert torch.equal(pixels, to_pixel_values(pictures, processor, (476, 644)))


@pytest.mark.parametrize(
    ("original", "network"),
    [((60, 80), (392, 518)), ((80, 60), (518, 518)), ((37, 37), (518, 518)), ((10, 1000), (14, 518))],
)
def test_crop_rule(original, network):
    processor = VggtImageProcessorPil(size={"height": 518, "width": 518}, keep_aspect_ratio=True)
    image = picture(*original)
    pixels = processor(image, return_tensors="pt")["pixel_values"]
    assert pixels.shape == (1, 3, *network)
    height = max(round(original[0] * 518 / original[1] / 14) * 14, 14)
    resized = np.asarray(image.resize((518, height), Image.Resampling.BICUBIC), dtype=np.float32) / 255
    top = max(0, height - 518) // 2
    np.testing.assert_allclose(pixels[0], resized.transpose(2, 0, 1)[:, top : top + 518], atol=1e-6)
    output = DepthEstimatorOutput(predicted_depth=pixels[:, 0])
    if height > 518:
        with pytest.raises(ValueError, match="was cut"):
            processor.post_process_depth_estimation(output, [original])
    else:
        assert processor.post_process_depth_estimation(output, [original])[0]["predicted_depth"].shape == original


@pytest.mark.parametrize(("original", "content"), [((60, 80), (392, 518)), ((100, 60), (518, 308))])
def test_pad_rule_and_its_inverse(original, content):
    processor = VggtImageProcessorPil(size={"height": 518, "width": 518}, keep_aspect_ratio=True, do_pad=True)
    image = picture(*original)
    pixels = processor(image, return_tensors="pt")["pixel_values"]
    assert pixels.shape == (1, 3, 518, 518)
    top, left = (518 - content[0]) // 2, (518 - content[1]) // 2
    inside = torch.zeros(518, 518, dtype=torch.bool)
    inside[top : top + content[0], left : left + content[1]] = True
    assert (pixels[:, :, ~inside] == 1).all()
    depth = torch.where(inside, 2.0, -100.0)[None]
    (result,) = processor.post_process_depth_estimation(DepthEstimatorOutput(predicted_depth=depth), [original])
    torch.testing.assert_close(result["predicted_depth"], torch.full(original, 2.0))


def test_transparent_pixels_become_white():
    image = Image.new("RGBA", (28, 28), (255, 0, 0, 0))
    pixels = VggtImageProcessorPil(size={"height": 28, "width": 28})(image, return_tensors="pt")["pixel_values"]
    torch.testing.assert_close(pixels, torch.ones(1, 3, 28, 28))


def test_processor_errors():
    processor = VggtImageProcessorPil()
    with pytest.raises(ValueError, match="NaN"):
        processor(np.full((28, 28, 3), np.nan, dtype=np.float32), do_resize=False)
    with pytest.raises(ValueError, match="normalises inside"):
        processor(picture(28, 28), do_normalize=True, image_mean=[0.5] * 3, image_std=[0.5] * 3)
    with pytest.raises(ValueError, match=r"different sizes \(322x644, 476x644\)"):
        processor([picture(40, 80), picture(60, 80)], keep_aspect_ratio=True, return_tensors="pt")
    with pytest.raises(ValueError, match="2 target sizes for 1"):
        processor.post_process_depth_estimation(
            DepthEstimatorOutput(predicted_depth=torch.ones(1, 2, 2)), [(2, 2)] * 2
        )
    with pytest.raises(ValueError, match=r"\(B, h, w\)"):
        processor.post_process_depth_estimation(DepthEstimatorOutput(predicted_depth=torch.ones(1, 2, 2, 2)))


def test_pipeline(tiny):
    processor = VggtImageProcessorPil(size={"height": 28, "width": 42})
    estimate = pipeline("depth-estimation", model=tiny, image_processor=processor)
    pictures = [picture(40, 50), picture(33, 70)]
    results = estimate(pictures, batch_size=2)
    assert [tuple(result["predicted_depth"].shape) for result in results] == [(40, 50), (33, 70)]
    assert results[0]["depth"].size == (50, 40)
    (single,) = [estimate(pictures[1])]
    torch.testing.assert_close(single["predicted_depth"], results[1]["predicted_depth"], rtol=1e-4, atol=0)


def test_auto_classes_know_a_saved_folder(tmp_path, tiny):
    register_models()
    tiny.save_pretrained(tmp_path)
    VggtImageProcessorPil(size={"height": 28, "width": 42}, keep_aspect_ratio=True).save_pretrained(tmp_path)
    estimate = pipeline("depth-estimation", model=str(tmp_path))
    assert type(estimate.model) is VggtForDepthEstimation
    assert type(estimate.image_processor) is VggtImageProcessorPil
    assert estimate.image_processor.keep_aspect_ratio
    assert estimate(picture(40, 60))["predicted_depth"].shape == (40, 60)


REMOTE = """
import sys
sys.modules["gift_peft"] = None  # an import of it fails
import torch
from transformers import AutoImageProcessor, AutoModelForDepthEstimation, pipeline
folder, picture, out = sys.argv[1:]
model = AutoModelForDepthEstimation.from_pretrained(folder, trust_remote_code=True).eval()
processor = AutoImageProcessor.from_pretrained(folder, trust_remote_code=True, backend="pil")
estimate = pipeline("depth-estimation", model=folder, trust_remote_code=True)
from PIL import Image
with torch.no_grad():
    depth = model(**processor(Image.open(picture), return_tensors="pt")).predicted_depth
torch.save([depth, estimate(picture)["predicted_depth"]], out)
"""


def test_saved_folder_works_without_this_package(tmp_path, tiny):
    folder = tmp_path / "model"
    tiny.save_pretrained(folder)
    processor = VggtImageProcessorPil(size={"height": 28, "width": 42})
    processor.save_pretrained(folder)
    picture(40, 50).save(tmp_path / "picture.png")
    arguments = [sys.executable, "-c", REMOTE, folder, tmp_path / "picture.png", tmp_path / "depth.pt"]
    environment = os.environ | {"HF_MODULES_CACHE": str(tmp_path / "modules"), "HF_HUB_OFFLINE": "1"}
    run = subprocess.run(list(map(str, arguments)), env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    depth, resized = torch.load(tmp_path / "depth.pt")
    with torch.no_grad():
        output = tiny(**processor(picture(40, 50), return_tensors="pt"))
    assert torch.equal(depth, output.predicted_depth)
    (expected,) = processor.post_process_depth_estimation(output, [(40, 50)])
    assert torch.equal(resized, expected["predicted_depth"])
