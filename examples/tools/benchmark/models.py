"""The models of `benchmark_group_step.py`: released configurations with random weights, and the embedded base."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import torch

from gift_peft.models.loading import load_base

PAPER_MINUTES = {"depth-anything-v2-large": 4.53, "vggt-1b": 5.90, "metric3d-v2-giant2": 6.94}


@dataclass
class Config:
    """One model of the benchmark: how to build it, at what size, and which strata of group sizes are sampled.

    `strata` are the largest sizes of each stratum; the one group timed for a stratum has its mean size.
    `memory_sizes` are the group sizes whose peak memory is measured.
    """

    build: Callable[[], torch.nn.Module]
    size: tuple[int, int]
    strata: tuple[int, ...]
    device: str = "cpu"
    memory_sizes: tuple[int, ...] = (9, 55)


def depth_anything(hidden_size, num_layers, num_heads, out_indices, neck, fusion):
    """The released Depth Anything V2 configurations, random weights."""
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    backbone = Dinov2Config(
        hidden_size=hidden_size,
        num_hidden_layers=num_layers,
        num_attention_heads=num_heads,
        image_size=518,
        patch_size=14,
        out_indices=out_indices,
        reshape_hidden_states=False,
        apply_layernorm=True,
    )
    return DepthAnythingForDepthEstimation(
        DepthAnythingConfig(
            backbone_config=backbone,
            reassemble_hidden_size=hidden_size,
            neck_hidden_sizes=neck,
            fusion_hidden_size=fusion,
        )
    )


def depth_anything_small():
    return depth_anything(384, 12, 6, [3, 6, 9, 12], [48, 96, 192, 384], 64)


def depth_anything_large():
    return depth_anything(1024, 24, 16, [5, 12, 18, 24], [256, 512, 1024, 1024], 256)


def vggt():
    from gift_peft import VggtConfig, VggtForDepthEstimation

    return VggtForDepthEstimation(VggtConfig())


def metric3d(variant):
    from gift_peft import Metric3DConfig, Metric3DForDepthEstimation

    return Metric3DForDepthEstimation(Metric3DConfig(variant=variant))


def embedded():

    return load_base(Path(str(files("gift_peft.demo") / "base")))[0]


CONFIGS = {
    "tiny": Config(embedded, (112, 140), (4, 7, 12, 20, 55)),
    "12-block": Config(depth_anything_small, (112, 140), (6, 13, 55), memory_sizes=(9,)),
    "depth-anything-v2-large": Config(depth_anything_large, (476, 644), (4, 7, 12, 20, 55), "cuda"),
    "vggt-1b": Config(vggt, (476, 644), (4, 7, 12, 20, 55), "cuda"),
    "metric3d-v2-large": Config(lambda: metric3d("large"), (476, 644), (4, 7, 12, 20, 55), "cuda"),
    "metric3d-v2-giant2": Config(lambda: metric3d("giant2"), (476, 644), (4, 7, 12, 20, 55), "cuda"),
}
