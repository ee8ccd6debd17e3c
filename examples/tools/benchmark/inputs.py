"""What `benchmark_group_step.py` trains and looks at: a base with random weights, and photographs of nothing."""

from pathlib import Path

import numpy as np
from PIL import Image

from benchmark.models import Config


def write_base(config: Config, folder: Path) -> None:
    from transformers import DPTImageProcessor

    config.build().save_pretrained(folder)
    size = {"height": config.size[0], "width": config.size[1]}
    mean, std = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
    DPTImageProcessor(size=size, image_mean=mean, image_std=std, resample=3).save_pretrained(folder)


def write_groups(root: Path, sizes: list[int]) -> None:
    """A raw tree with one group of each size: 480x640 JPEG photographs of nothing, one target per group."""
    for size in sizes:
        rng = np.random.default_rng(size)
        folder = root / "train" / f"group_{size:02d}"
        (folder / "masks").mkdir(parents=True)
        mask = np.zeros((480, 640), np.uint8)
        mask[120:360, 160:480] = 255  # a quarter of the picture
        for index in range(size):
            noise = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
            Image.fromarray(noise).resize((640, 480), Image.Resampling.BICUBIC).save(folder / f"{index:02d}.jpg")
            Image.fromarray(mask).save(folder / "masks" / f"{index:02d}.png")
