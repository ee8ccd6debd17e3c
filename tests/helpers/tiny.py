"""A Depth Anything V2 of a few thousand random weights, and a GIFT-I raw tree of random pictures."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config, DPTImageProcessor

SIZE = (56, 70)


def tiny_model(seed: int = 0, **config) -> DepthAnythingForDepthEstimation:
    """In eval mode; weights scaled by fan-in so that the output is positive and depends on the input."""
    backbone = Dinov2Config(
        hidden_size=32,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=28,
        patch_size=14,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        apply_layernorm=True,
    )
    generator = torch.Generator().manual_seed(seed)
    model = DepthAnythingForDepthEstimation(
        DepthAnythingConfig(
            backbone_config=backbone,
            reassemble_hidden_size=32,
            patch_size=14,
            neck_hidden_sizes=[8, 16, 24, 24],
            fusion_hidden_size=16,
            head_hidden_size=8,
            **config,
        )
    ).eval()
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if weight.ndim > 1:
                scale = 0.02 if "embed" in name or "token" in name else 1.4 / weight[0].numel() ** 0.5
                weight.copy_(torch.randn(weight.shape, generator=generator) * scale)
        model.head.conv3.weight.abs_()
        model.head.conv3.bias.fill_(1.0)
    return model


def tiny_processor() -> DPTImageProcessor:
    return DPTImageProcessor(
        size={"height": SIZE[0], "width": SIZE[1]},
        ensure_multiple_of=14,
        keep_aspect_ratio=False,
        image_mean=[0.485, 0.456, 0.406],
        image_std=[0.229, 0.224, 0.225],
        resample=3,
    )


def write_base(folder: Path, seed: int = 0, **config) -> Path:
    """A transformers folder with the tiny model and its image processor."""
    tiny_model(seed, **config).save_pretrained(folder)
    tiny_processor().save_pretrained(folder)
    return folder


def write_group(folder: Path, count: int, seed: int, reference: bool = False, size=(60, 80)) -> Path:
    """One group of a raw tree: `count` pictures that differ inside a box, their masks, maybe a treated reference."""
    rng = np.random.default_rng(seed)
    height, width = size
    scene = rng.integers(0, 255, (height // 10, width // 10, 3), dtype=np.uint8)
    scene = np.asarray(Image.fromarray(scene).resize((width, height), Image.Resampling.BICUBIC))
    top, left = rng.integers(5, height // 3), rng.integers(5, width // 3)
    box = slice(top, top + height // 2), slice(left, left + width // 2)
    (folder / "masks").mkdir(parents=True)
    mask = np.zeros(size, np.uint8)
    mask[box] = 255
    for index in range(count):
        picture = scene.copy()
        picture[box] = rng.integers(0, 255, picture[box].shape, dtype=np.uint8)
        Image.fromarray(picture).save(folder / f"{index}.png")
        Image.fromarray(mask).save(folder / "masks" / f"{index}.png")
    if reference:
        picture = scene.copy()
        picture[box] = 128
        Image.fromarray(picture).save(folder / "reference.png")
    return folder


def write_raw_tree(root: Path, train=(2, 3), validation=(2,), size=(60, 80)) -> Path:
    """RAW/train/<group> and RAW/validation/<group>; the numbers are group sizes."""
    for split, counts in (("train", train), ("validation", validation)):
        for index, count in enumerate(counts):
            seed = index if split == "train" else 100 + index
            write_group(root / split / f"scene_{seed}", count, seed, split == "validation", size)
    return root
