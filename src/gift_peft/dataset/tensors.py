"""From a row of the dataset to the tensors of one group: checked, resized, normalised, with its proxies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gift_peft.images import to_mask, to_rgb
from gift_peft.models.pixels import normalize_pixels, resize_images, resize_mask
from gift_peft.rules import SURFACES, check_group, label_items

if TYPE_CHECKING:  # torch takes longer to import than the command line takes to answer --help
    import torch


@dataclass
class Group:
    """Images of one camera pose and target geometry, ready for the network: N observations at size (h, w).

    Args:
        group_id (`str`): its name in the dataset.
        names (`list[str]`): N image names, for messages and per-sample rows.
        pixel_values (`torch.Tensor`): (N, 3, h, w) float32.
        mask (`torch.Tensor`): (N, h, w) bool, the target (non-Lambertian) region.
        valid (`torch.Tensor`, *optional*): (N, h, w) bool, False where a warped frame has no pixels.
        target (`torch.Tensor`, *optional*): (N, h, w) float32 proxies in native units.
        reference_pixel_values (`torch.Tensor`, *optional*): (1, 3, h, w) float32, the treated reference.
        reference_target (`torch.Tensor`, *optional*): (h, w) float32, the teacher's prediction on it.
        depths (`list[torch.Tensor]`, *optional*): N times (H, W) float32 true z-depth in mm at the images' original
            size, 0 where unknown.
        surface (`str`, *optional*): "mirror" or "transparent".
    """

    group_id: str
    names: list[str]
    pixel_values: torch.Tensor
    mask: torch.Tensor
    valid: torch.Tensor | None = None
    target: torch.Tensor | None = None
    reference_pixel_values: torch.Tensor | None = None
    reference_target: torch.Tensor | None = None
    depths: list[torch.Tensor] | None = None
    surface: str | None = None


# ---- decoding ----


# ---- resizing ----


# ---- one row of the dataset ----


def collate_group(row: dict, processor, size: tuple[int, int]) -> Group:
    """One GIFT-I row (decoded images; proxies if `load_gift_i` attached them) as a `Group` at size (h, w).

    Raises ValueError naming the group and image for a mask of another size, a mask that is not one, an image that is
    not 8-bit RGB, and proxies made at another size.
    """
    import torch

    group = to_group(row, resize_row(row, processor, size), processor, size)
    group.depths = [
        torch.from_numpy(np.asarray(depth).astype(np.float32)) for depth in row.get("depths") or []
    ] or None
    return group


def resize_row(row: dict, processor, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """What of a decoded row depends on pixels, at size (h, w).

    `images` (N, 3, h, w) uint8, `masks` (N, h, w) bool and, where the row has them, `valids` (N, h, w) bool and
    `reference` (1, 3, h, w) uint8. Raises ValueError as `collate_group`.
    """
    group_id, names = row["group_id"], list(row["image_names"])
    images = [to_rgb(*item) for item in label_items(group_id, names, "image", row["images"])]
    masks = [to_mask(*item) for item in label_items(group_id, names, "mask", row["masks"])]
    valids = [to_mask(*item) for item in label_items(group_id, names, "valid mask", row.get("valids"), True)]
    depths = [np.asarray(depth) for depth, _ in label_items(group_id, names, "depth", row.get("depths"), True)]
    reference = row.get("reference")
    reference = None if reference is None else to_rgb(reference, f"group {group_id}: the reference")
    check_group(group_id, names, images, masks, valids, depths, reference)
    arrays = {"images": resize_images(images, processor, size), "masks": _stack_masks(masks, size)}
    if valids:
        arrays["valids"] = _stack_masks(valids, size)
    if reference is not None:
        arrays["reference"] = resize_images([reference], processor, size)
    return arrays


def to_group(row: dict, arrays: dict[str, np.ndarray], processor, size: tuple[int, int]) -> Group:
    """A `Group` of a row's names and proxies, and what `resize_row` gives; ValueError for proxies of another size."""
    import torch

    surface = row.get("surface")
    return Group(
        group_id=row["group_id"],
        names=list(row["image_names"]),
        pixel_values=normalize_pixels(arrays["images"], processor),
        mask=torch.from_numpy(arrays["masks"]),
        valid=torch.from_numpy(arrays["valids"]) if "valids" in arrays else None,
        target=_sized_proxies(row.get("proxies"), size, row["group_id"]),
        reference_pixel_values=normalize_pixels(arrays["reference"], processor) if "reference" in arrays else None,
        reference_target=_sized_proxies(row.get("reference_proxy"), size, row["group_id"]),
        surface=SURFACES[surface] if isinstance(surface, int) else surface,
    )


def _stack_masks(masks: Sequence[np.ndarray], size: tuple[int, int]) -> np.ndarray:
    return np.stack([resize_mask(mask, size) for mask in masks])


def _sized_proxies(proxies, size: tuple[int, int], group_id: str) -> torch.Tensor | None:
    if proxies is None:
        return None
    import torch

    proxies = torch.as_tensor(proxies)
    if tuple(proxies.shape[-2:]) != tuple(size):
        made = "x".join(map(str, proxies.shape[-2:]))
        raise ValueError(
            f"group {group_id}: its proxies are {made} but the size in use is {size[0]}x{size[1]}; "
            f"make them again with `gift-peft proxies --size {size[0]}x{size[1]} --overwrite`"
        )
    return proxies
