"""A rendered group on disk, whichever renderer made it: its size, its kinds, and how it is written."""

import json
import os
from pathlib import Path

import numpy as np
from PIL import Image

KINDS = {"mirror": "mirror", "pane": "transparent", "solid": "transparent"}
KEPT = 140, 112  # pixels across and down, the input of the base: many groups teach more than large pictures of few
JPEG = {"quality": 95, "optimize": True, "progressive": True}
ATTEMPTS = 200  # scene seeds a group


def first_group(make, first_seed: int, name: str) -> tuple[dict, int]:
    """The first of `make(seed)` that is a group and no failed plan (None), and its seed; RuntimeError if none is."""
    for seed in range(first_seed, first_seed + ATTEMPTS):
        group = make(seed)
        if group is not None:
            return group, seed
    raise RuntimeError(f"{name}: no plan in {ATTEMPTS} attempts")


def write_group(group: dict, kind: str, seed: int, temporary: Path, folder: Path) -> None:
    """Write a group's `images`, `mask`, `depths` (mm), `reference` and `shown` to `temporary`, then move it there."""
    for name in ("images", "masks", "depths"):
        (temporary / name).mkdir(parents=True)
    mask = Image.fromarray(group["mask"].astype(np.uint8) * 255)
    for index, (image, depth) in enumerate(zip(group["images"], group["depths"], strict=True)):
        Image.fromarray(image).save(temporary / "images" / f"{index:02d}.jpg", **JPEG)
        mask.save(temporary / "masks" / f"{index:02d}.png", optimize=True)
        Image.fromarray(depth).save(temporary / "depths" / f"{index:02d}.png", optimize=True)
    Image.fromarray(group["reference"]).save(temporary / "reference.jpg", **JPEG)
    facts = {"surface": KINDS[kind], "kind": kind, "seed": seed, "surface_seen": group["shown"]}
    (temporary / "group.json").write_text(json.dumps(facts) + "\n")
    os.replace(temporary, folder)
