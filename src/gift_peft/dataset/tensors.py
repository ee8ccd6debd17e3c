"""From a row of the dataset to the tensors of one group: checked, resized, normalised, with its proxies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gift_peft.models.pixels import normalize_pixels, resize_images, resize_mask
from gift_peft.rules import UNKNOWN, GroupPictures, parse_group

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
        valid (`torch.Tensor`, *optional*): (N, h, w) bool, False where a warped frame has no pixels, and where the
            teacher's own mask says that there is no surface (sky).
        target (`torch.Tensor`, *optional*): (N, h, w) float32 proxies in native units.
        reference_pixel_values (`torch.Tensor`, *optional*): (1, 3, h, w) float32, the treated reference.
        reference_target (`torch.Tensor`, *optional*): (h, w) float32, the teacher's prediction on it.
        surface (`str`, *optional*): "mirror" or "transparent".
        surface_target, surface_target_flipped (`torch.Tensor`, *optional*): (N, h, w) float32 in native units: inside
            the mask where the surface is, outside the proxies; of the photos and, in their orientation, of the
            flipped photos.
        pictures (`GroupPictures`, *optional*): the same at the original size; None if they were not decoded now.
    """

    group_id: str
    names: list[str]
    pixel_values: torch.Tensor
    mask: torch.Tensor
    valid: torch.Tensor | None = None
    target: torch.Tensor | None = None
    reference_pixel_values: torch.Tensor | None = None
    reference_target: torch.Tensor | None = None
    surface: str | None = None
    surface_target: torch.Tensor | None = None
    surface_target_flipped: torch.Tensor | None = None
    pictures: GroupPictures | None = None


def collate_group(row: dict | GroupPictures, processor, size: tuple[int, int]) -> Group:
    """One GIFT-I row (decoded images; proxies if `load_gift_i` attached them) as a `Group` at size (h, w).

    Raises ValueError naming the group and image for a mask of another size, a mask that is not one, an image that is
    not 8-bit RGB, and proxies made at another size.
    """
    pictures = parse_group(row)
    arrays = resize_pictures(pictures, processor, size)
    proxies = pictures.proxies, pictures.reference_proxy
    targets = pictures.surface_target, pictures.surface_target_flipped
    facts = pictures.group_id, pictures.names, pictures.surface
    group = to_group(*facts, arrays, proxies, processor, size, targets)
    group.pictures = pictures
    return group


def resize_pictures(pictures: GroupPictures, processor, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """What of a group depends on pixels, at size (h, w).

    `images` (N, 3, h, w) uint8, `masks` (N, h, w) bool and, where the group has them, `valids` (N, h, w) bool and
    `reference` (1, 3, h, w) uint8.
    """
    arrays = {"images": resize_images(pictures.images, processor, size), "masks": _stack_masks(pictures.masks, size)}
    if pictures.valids:
        arrays["valids"] = _stack_masks(pictures.valids, size)
    if pictures.reference is not None:
        arrays["reference"] = resize_images([pictures.reference], processor, size)
    return arrays


def to_group(
    group_id: str,
    names: Sequence[str],
    surface: str | None,
    arrays: dict[str, np.ndarray],
    proxies,
    processor,
    size,
    targets=(None, None),
) -> Group:
    """A `Group` of the arrays of `resize_pictures`, (proxies, reference proxy) and the two surface targets.

    Raises ValueError for proxies or targets of another size.
    """
    import torch

    target, reference_target = (_sized_proxies(part, size, group_id) for part in proxies)
    surface_target, surface_target_flipped = (_sized_proxies(part, size, group_id) for part in targets)
    valid = torch.from_numpy(arrays["valids"]) if "valids" in arrays else None
    if target is not None and (unknown := target == UNKNOWN).any():
        valid = ~unknown if valid is None else valid & ~unknown
        target = target.masked_fill(unknown, 0)  # no loss reads it, but the largest value of an image counts
    return Group(
        group_id=group_id,
        names=list(names),
        pixel_values=normalize_pixels(arrays["images"], processor),
        mask=torch.from_numpy(arrays["masks"]),
        valid=valid,
        target=target,
        reference_pixel_values=normalize_pixels(arrays["reference"], processor) if "reference" in arrays else None,
        reference_target=reference_target,
        surface=surface,
        surface_target=surface_target,
        surface_target_flipped=surface_target_flipped,
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
