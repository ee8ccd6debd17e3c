"""Tiny MoGe networks with random weights, on a vision transformer that the package's list is given for the test."""

import copy
from typing import Any

import numpy as np
import pytest
import torch
from helpers.backbones import randomize

WIDTH = 24


def _stack(dim_in: int, outputs: int | None) -> dict[str, Any]:
    return {
        "dim_in": [dim_in, 8, 8, 8, 8],
        "dim_out": None if outputs is None else [None] * 4 + [outputs],
        "dim_res_blocks": [16, 8, 8, 8, 8],
        "num_res_blocks": [0, 1, 1, 1, 0],
        "res_block_in_norm": "none",
        "res_block_hidden_norm": "none",
        "resamplers": ["conv_transpose", "conv_transpose", "conv_transpose", "bilinear"],
    }


SECOND = {
    "encoder": {"backbone": "dinov2_tiny14", "intermediate_layers": [1, 2], "dim_out": 16},
    "neck": _stack(18, None) | {"dim_in": [18, 2, 2, 2, 2]},
    "points_head": _stack(16, 3),
    "mask_head": _stack(16, 1),
    "normal_head": _stack(16, 3),
    "scale_head": {"dims": [WIDTH, 8, 1]},
    "remap_output": "exp",
    "num_tokens_range": [16, 40],
}
NETWORKS = {
    "v1": {
        "encoder": "dinov2_tiny14",
        "remap_output": "exp",
        "output_mask": True,
        "split_head": True,
        "intermediate_layers": 2,
        "dim_proj": 32,
        "dim_upsample": [32, 32, 32],
        "trained_area_range": [16 * 196, 40 * 196],
        "last_conv_channels": 8,
    },
    "v2": {key: value for key, value in SECOND.items() if key != "normal_head"},
    "v2-normal": SECOND,
    "v2-affine": {key: value for key, value in SECOND.items() if key != "scale_head"},
}


@pytest.fixture(scope="module")
def tiny_vit():
    """`dinov2_tiny14` among the package's vision transformers; skips where the package is not installed."""
    backbones = pytest.importorskip("moge.model.dinov2.hub.backbones", reason="MoGe (dlr-moge) is not installed")
    from moge.model.dinov2.models.vision_transformer import DinoVisionTransformer

    def make(pretrained=False, **options):
        options = {"img_size": 70, "patch_size": 14, "embed_dim": WIDTH, "depth": 3, "num_heads": 2, "mlp_ratio": 2.0}
        return DinoVisionTransformer(init_values=1.0, block_chunks=0, interpolate_offset=0.1, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(backbones, "dinov2_tiny14", make, raising=False)
        yield


def tiny_network(name: str, seed: int = 0):
    """The package's own model."""
    from moge.model import v1, v2

    module = v1 if name == "v1" else v2
    network = randomize(module.MoGeModel(**copy.deepcopy(NETWORKS[name])), seed).eval()
    with torch.no_grad():
        _look_like_a_camera(network, name)
    return network


def _look_like_a_camera(network, name: str) -> None:
    """Points near those of a pinhole camera: x and y follow the pixel's own u and v, and most pixels are valid.

    Without it a random network has no shift that would make a camera of it.
    """
    if name == "v1":
        points, mask = network.head.output_block
        points[0].weight[:4] = 0
        for channel, (source, sign) in enumerate([(-2, 1), (-2, -1), (-1, 1), (-1, -1)]):  # past the ReLU
            points[0].weight[channel, source, 1, 1] = sign
        points[0].bias[:4] = 0
        points[-1].weight.mul_(0.2)
        points[-1].weight[:2] = 0
        points[-1].weight[0, :2, 0, 0] = torch.tensor([1.0, -1.0])
        points[-1].weight[1, 2:4, 0, 0] = torch.tensor([1.0, -1.0])
        points[-1].bias[:2] = 0
        mask[-1].weight.mul_(0.3)
        mask[-1].bias.fill_(1.0)
        return
    for stack in (network.neck, network.points_head):  # channels 0 and 1 of the last level carry u and v
        stack.resamplers[-1][1].weight[:2] *= 0.02
        stack.resamplers[-1][1].bias[:2] = 0
        stack.input_blocks[-1].weight[:2] = 0
        stack.input_blocks[-1].weight[0, 0] = stack.input_blocks[-1].weight[1, 1] = 1
        stack.input_blocks[-1].bias[:2] = 0
    last = network.points_head.output_blocks[-1]
    last.weight.mul_(0.1)
    last.weight[:2] = 0
    last.weight[0, 0] = last.weight[1, 1] = 1
    last.bias[:2] = 0
    network.mask_head.output_blocks[-1].weight.mul_(0.3)
    network.mask_head.output_blocks[-1].bias.fill_(1.0)


def tiny_moge(seed: int = 0, name: str = "v2-normal", sky: bool = False, **config):
    """As a transformers model, in eval mode; with `sky` the mask of MoGe-2 leaves out the upper third."""
    from gift_peft.models.moge import MogeConfig, MogeForDepthEstimation

    network = tiny_network(name, seed)
    if sky:
        stack = network.mask_head
        stack.resamplers[-1][1].weight.data[:2] *= 0.02
        stack.input_blocks[-1].weight.data[:2] = 0
        stack.input_blocks[-1].weight.data[1, 1] = 1  # v, which is negative above the center
        stack.input_blocks[-1].bias.data[:2] = 0
        stack.output_blocks[-1].weight.data *= 0.01
        stack.output_blocks[-1].weight.data[0, 1] = 30
        stack.output_blocks[-1].bias.data.fill_(4)
    official = {"model_config": copy.deepcopy(NETWORKS[name]), "model": network.state_dict()}
    return MogeForDepthEstimation.from_official(official, MogeConfig(network=NETWORKS[name], **config))


def pinhole(
    seed: int, height: int = 48, width: int = 64, count: int = 2
) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
    """(B,H,W,3) float64 points of pinhole cameras, their z moved by `-shift`; (focal, shift), each (B,)."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width]
    diagonal = np.hypot(height, width)
    u, v = (2 * columns + 1 - width) / diagonal, (2 * rows + 1 - height) / diagonal
    points, focals, shifts = [], rng.uniform(0.6, 3, count), rng.uniform(-0.5, 4, count)
    for focal, shift in zip(focals, shifts, strict=True):
        phase = rng.uniform(0, 6, 2)
        z = 2 + shift + 0.6 * np.sin(columns / 9 + phase[0]) + 0.3 * np.cos(rows / 7 + phase[1])
        points.append(np.stack([u * z / focal, v * z / focal, z - shift], axis=-1))
    return torch.from_numpy(np.stack(points)), focals, shifts
