"""What a group must be, whoever reads it: its name, its number of images, parts of one size, a target to train on."""

import re
from collections.abc import Sequence

import numpy as np
from PIL import Image

SPLITS = ("train", "validation")
SURFACES = ["mirror", "transparent"]
KINDS = ("depth", "inverse_depth")  # what a model predicts


def label_items(group_id: str, names: Sequence[str], kind: str, items: Sequence | None, optional: bool = False):
    """Pairs (item, how to call it in a message), one per image name; ValueError if their number differs.

    `optional`: there may be none at all.
    """
    items = [] if items is None else list(items)
    if len(items) != len(names) and (items or not optional):
        raise ValueError(f"group {group_id}: {len(names)} image names, but {len(items)} {kind}s")
    return [(item, f"group {group_id}: the {kind} of {name}") for item, name in zip(items, names, strict=False)]


def check_group(
    group_id: str,
    names: Sequence[str],
    images: Sequence[Image.Image],
    masks: Sequence[np.ndarray],
    valids: Sequence[np.ndarray] = (),
    depths: Sequence[np.ndarray] = (),
    reference: Image.Image | None = None,
    train: bool = False,
) -> None:
    """Raise ValueError unless every part of a group has the size of its images and, in `train`, a target somewhere."""
    size = images[0].size[::-1]
    parts = [("image", [image.size[::-1] for image in images])]
    parts += [(kind, [array.shape for array in arrays]) for kind, arrays in (("mask", masks), ("valid mask", valids))]
    parts += [("depth", [array.shape for array in depths])]
    for kind, shapes in parts:
        for name, shape in zip(names, shapes, strict=False):
            if tuple(shape) != size:
                raise ValueError(
                    f"group {group_id}: the {kind} of {name} is {shape[0]}x{shape[1]} (height x width), "
                    f"but the image {names[0]} is {size[0]}x{size[1]}"
                )
    if reference is not None and reference.size[::-1] != size:
        raise ValueError(
            f"group {group_id}: the reference is {reference.height}x{reference.width} (height x width), "
            f"but the image {names[0]} is {size[0]}x{size[1]}"
        )
    if train and not any(mask.any() for mask in masks):
        raise ValueError(
            f"group {group_id}: every mask is empty, so there is nothing to train on; draw the target in 255, "
            "or name its value in group.yaml (`mask_class: 2`)"
        )


def check_count(group_id: str, count: int, split: str, has_reference: bool) -> None:
    """A group takes two observations to compare; in validation one will do if there is a treated reference."""
    if count < (1 if split == "validation" and has_reference else 2):
        hint = "" if split == "train" else ", or one and a treated reference"
        raise ValueError(f"group {group_id} has {count} different image{'s' * (count != 1)}; it takes two{hint}")


def check_group_id(group_id: str) -> None:
    """Raise ValueError unless a group's id can name a folder and a proxy file."""
    if not group_id or group_id.startswith(".") or re.search(r'[/\\:*?"<>|\0]', group_id):
        raise ValueError(f"group id {group_id!r}: it names a folder, so no separators and no leading dot")
