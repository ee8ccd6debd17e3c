"""VGGT against the official network's stored results and against DINOv2 of transformers; its input sizes."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.backbones import VGGT, images, relative, tiny_vggt, vggt_golden
from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel
from transformers.modeling_outputs import DepthEstimatorOutput

from gift_peft.models.vggt import VggtConfig, VggtForDepthEstimation
from gift_peft.models.vggt.head_vggt import position_map
from gift_peft.models.vggt.modeling_vggt import rotary_angles, rotate

TENSORS, _, SIDECAR = vggt_golden()
SHAPES = Path(__file__).parents[3] / "shared/reference/vggt/vggt1b_state_dict_shapes.json"


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


# ---- the official network's results ----


def of_maximum(ours, theirs):
    assert ours.shape == theirs.shape
    return ((ours - theirs).abs().max() / theirs.abs().max()).item()


@pytest.mark.parametrize("case", SIDECAR["cases"])
def test_goldens(golden, case):
    expected = {k.split(".", 2)[2]: v for k, v in TENSORS.items() if k.startswith(f"golden.{case}.")}
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


def test_golden_gradients(official):
    model = VggtForDepthEstimation.from_official(official, VggtConfig(**SIDECAR["config"]))
    case = SIDECAR["grad_case"]
    output = model(TENSORS[f"golden.{case}.images"])
    loss = output.predicted_depth.log().mean() + 0.1 * output.confidence.log().mean()
    assert loss.item() == pytest.approx(SIDECAR["loss"], rel=1e-5)
    loss.backward()
    for name in SIDECAR["grad_max_abs"]:
        assert of_maximum(model.get_parameter(name).grad, TENSORS[f"golden.{case}.grad.{name}"]) < 1e-4, name
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
        VggtConfig(**VGGT | change)


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
