"""What a group must be, whoever reads it: its name, its number of images, parts of one size, a target to train on."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, repeat
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from gift_peft.images import to_mask, to_rgb

if TYPE_CHECKING:  # torch takes longer to import than the command line takes to answer --help
    import torch

SPLITS = ("train", "validation")
SURFACES = ["mirror", "transparent"]
KINDS = ("depth", "inverse_depth")  # what a model predicts
MAX_GROUP_ID = 210  # bytes; the names of a group's files are longer, and file systems take 255


@dataclass(frozen=True, eq=False)
class GroupPictures:
    """The decoded parts of one group. It is made by whoever reads them; what takes one checks nothing again.

    Args:
        group_id (`str`): its name in the dataset.
        names (`list[str]`): N image names.
        images (`list[Image.Image]`): N upright 8-bit RGB pictures of one size.
        masks (`list[np.ndarray]`): N (H, W) bool, the target.
        valids (`list[np.ndarray]`): N (H, W) bool, False where a warped frame has no pixels; or none.
        depths (`list[np.ndarray]`): N (H, W) true z-depth in mm, 0 where unknown; or none.
        reference (`Image.Image`, *optional*): the treated reference.
        surface (`str`, *optional*): "mirror" or "transparent".
        proxies (`torch.Tensor`, *optional*): (N, h, w) float32 in native units, if a teacher was named.
        reference_proxy (`torch.Tensor`, *optional*): (h, w) float32, the teacher's prediction on the reference.
        surface_target, surface_target_flipped (`torch.Tensor`, *optional*): (N, h, w) float32, if asked for: where
            the surface is, and where it is in the flipped photos.

    Raises ValueError, naming the group and the part, unless there is one of each for every name, all of one size.
    """

    group_id: str
    names: Sequence[str]
    images: Sequence[Image.Image]
    masks: Sequence[np.ndarray]
    valids: Sequence[np.ndarray] = ()
    depths: Sequence[np.ndarray] = ()
    reference: Image.Image | None = None
    surface: str | None = None
    proxies: torch.Tensor | None = None
    reference_proxy: torch.Tensor | None = None
    surface_target: torch.Tensor | None = None
    surface_target_flipped: torch.Tensor | None = None

    def __post_init__(self) -> None:
        pictures = [image.size[::-1] for image in self.images]
        parts = {"image": pictures}
        for kind, arrays in (("mask", self.masks), ("valid mask", self.valids), ("depth", self.depths)):
            parts[kind] = [array.shape for array in arrays]
        for kind, shapes in parts.items():
            if len(shapes) != len(self.names) and (shapes or kind in ("image", "mask")):
                raise ValueError(f"group {self.group_id}: {len(self.names)} image names, but {len(shapes)} {kind}s")
            for name, shape in zip(self.names, shapes, strict=False):
                self._check_size(f"{kind} of {name}", shape, pictures[0])
        if self.reference is not None:
            self._check_size("reference", self.reference.size[::-1], pictures[0])

    def _check_size(self, part: str, shape: tuple[int, ...], size: tuple[int, ...]) -> None:
        if tuple(shape) != size:
            raise ValueError(
                f"group {self.group_id}: the {part} is {shape[0]}x{shape[1]} (height x width), "
                f"but the image {self.names[0]} is {size[0]}x{size[1]}"
            )

    def check_target(self) -> None:
        """Raise ValueError unless there is a target somewhere: what a train group needs besides."""
        if not any(mask.any() for mask in self.masks):
            raise ValueError(
                f"group {self.group_id}: every mask is empty, so there is nothing to train on; draw the target in "
                "255, or name its value in group.yaml (`mask_class: 2`)"
            )


def parse_group(
    record: Mapping[str, Any] | GroupPictures,
    rgb: Callable[[Any, str], Image.Image] = to_rgb,
    mask: Callable[[Any, str], np.ndarray] = to_mask,
    depth: Callable[[Any, str], np.ndarray] = lambda item, _: np.asarray(item),
) -> GroupPictures:
    """A record with the dataset's columns as `GroupPictures`, which itself is given back as it is.

    Of the columns after the masks, any may be missing. `rgb`, `mask` and `depth` convert an item, given how messages
    call it; the defaults take pictures, as rows hold them. Raises ValueError as they do, and as `GroupPictures`.
    """
    if isinstance(record, GroupPictures):
        return record
    group_id, names = record["group_id"], list(record["image_names"])

    def convert(column: str, kind: str, function: Callable[[Any, str], Any]) -> list:
        items = record.get(column)
        called = (f"group {group_id}: the {kind} of {name}" for name in chain(names, repeat("an image too many")))
        return [] if items is None else [function(*pair) for pair in zip(items, called, strict=False)]

    reference, surface = record.get("reference"), record.get("surface")
    return GroupPictures(
        group_id,
        names,
        convert("images", "image", rgb),
        convert("masks", "mask", mask),
        convert("valids", "valid mask", mask),
        convert("depths", "depth", depth),
        None if reference is None else rgb(reference, f"group {group_id}: the reference"),
        SURFACES[surface] if isinstance(surface, int) else surface,  # of a row, the number of its label
        record.get("proxies"),
        record.get("reference_proxy"),
        record.get("surface_target"),
        record.get("surface_target_flipped"),
    )


def check_count(group_id: str, count: int, split: str, has_reference: bool) -> None:
    """A validation group takes two observations to compare, or one and a treated reference; a train group only one.

    What compares the observations of a train group asks for two itself: `check_pair`.
    """
    if count < (1 if split == "train" or has_reference else 2):
        hint = " at least one" if split == "train" else " two, or one and a treated reference"
        raise ValueError(f"group {group_id} has {count} different image{'s' * (count != 1)}; it takes{hint}")


def check_pair(group_id: str, count: int) -> None:
    """Raise ValueError for a group of one, where observations are to be compared."""
    if count < 2:
        raise ValueError(
            f"group {group_id} has {count} different image{'s' * (count != 1)}; it takes two to compare; "
            "a single photo trains as it is with --target surface"
        )


def check_group_id(group_id: str) -> None:
    """Raise ValueError unless a group's id can name a folder and a proxy file."""
    if not group_id or group_id.startswith(".") or re.search(r'[/\\:*?"<>|\0]', group_id):
        raise ValueError(f"group id {group_id!r}: it names a folder, so no separators and no leading dot")
    if (length := len(group_id.encode(errors="surrogateescape"))) > MAX_GROUP_ID:
        raise ValueError(
            f"group {group_id[:40]}...: its name has {length} bytes, at most {MAX_GROUP_ID} can be; rename it"
        )
