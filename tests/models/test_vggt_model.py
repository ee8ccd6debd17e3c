"""VGGT as a transformers model: saved and loaded, checkpointed, compiled, in other precisions, from official files."""

import json
import logging
import math
import os
import pickle
from pathlib import Path

import pytest
import torch
from helpers.backbones import FIXTURES, VGGT, images, relative, saved_forms, tiny_vggt, vggt_golden
from safetensors.torch import save_file

from gift_peft.models.vggt import VggtConfig, VggtForDepthEstimation

GOLDEN = FIXTURES / "vggt/golden_public.safetensors"
SIDECAR = json.loads(GOLDEN.with_suffix(".json").read_text())


@pytest.fixture(scope="module")
def official():
    """The golden model's weights by official name."""
    return vggt_golden()[1]


@pytest.fixture(scope="module")
def golden(official):
    return VggtForDepthEstimation.from_official(official, VggtConfig(**SIDECAR["config"]))


@pytest.fixture(scope="module")
def tiny():
    return tiny_vggt()


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
    model = VggtForDepthEstimation(VggtConfig(**VGGT))
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
    sources = [GOLDEN, *sorted(tmp_path.iterdir()), wrapped]
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
            path = GOLDEN
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


def test_checkpoints_of_another_variant(official, tmp_path):
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
    save_file(broken, tmp_path / "int.safetensors")
    with pytest.raises(ValueError, match=r"depth_head\.norm\.bias holds torch\.int64"):
        VggtForDepthEstimation.from_official(tmp_path / "int.safetensors", VggtConfig(**sizes))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_weights_that_are_not_finite_are_refused(official, tmp_path, value):
    name = "depth_head.norm.bias"
    bias = official[name].double()
    bias[-1] = value
    for where, source in saved_forms(official | {name: bias}, tmp_path).items():
        with pytest.raises(ValueError) as error:
            VggtForDepthEstimation.from_official(source, VggtConfig(**SIDECAR["config"]))
        assert str(error.value) == f"{where}: {name} holds NaN or infinite values (in float32)"


def test_a_tensor_with_and_without_the_prefix_is_refused(official, tmp_path):
    name, config = "depth_head.norm.bias", VggtConfig(**SIDECAR["config"])
    for where, source in saved_forms(official | {f"module.{name}": official[name] + 1}, tmp_path).items():
        with pytest.raises(ValueError, match=rf"(module\.)?{name} and (module\.)?{name} are two tensors") as error:
            VggtForDepthEstimation.from_official(source, config)
        assert str(error.value).startswith(f"{where}: ") and "\n" not in str(error.value)
    ignored = {"camera_head.x": torch.zeros(1), "module.camera_head.x": torch.zeros(1)}
    VggtForDepthEstimation.from_official(official | ignored, config)


@pytest.mark.parametrize("value", ["text", [1], None, 3], ids=repr)
def test_an_entry_that_is_no_tensor_is_named(official, value):
    config, kind = VggtConfig(**SIDECAR["config"]), type(value).__name__
    for name in ("aggregator.camera_token", "aggregator.patch_embed.mask_token", "depth_head.more"):
        broken = official | {name: value}
        prefixed = {f"module.{key}": entry for key, entry in broken.items()}
        for source, key in ((broken, name), (prefixed, f"module.{name}"), ({"model": prefixed}, f"module.{name}")):
            with pytest.raises(ValueError) as error:
                VggtForDepthEstimation.from_official(source, config)
            assert str(error.value) == f"the given dict: {key} is a {kind}, not a tensor"
    for key in ("model_state_dict", "state_dict", "model"):
        with pytest.raises(ValueError) as error:
            VggtForDepthEstimation.from_official({"epoch": 3, key: value}, config)
        assert str(error.value) == f"the given dict: {key} is a {kind}, not tensors by name"
    for key in ("camera_head.x", "model"):  # nothing of the depth path
        VggtForDepthEstimation.from_official({key: value} | official, config)


def test_a_file_cut_anywhere_is_one_clear_error(tmp_path):
    torch.save({"aggregator.x": torch.zeros(3)}, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    content = (tmp_path / "old.pt").read_bytes()
    path = tmp_path / "cut.pt"
    for length in range(0, len(content), 3):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"cut\.pt: ") as error:
            VggtForDepthEstimation.from_official(path)
        assert "\n" not in str(error.value)
