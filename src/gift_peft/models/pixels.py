"""From pictures to the tensors a network takes: the size, the image processor's filter, scale, mean and std.

The same resize serves teacher, training, evaluation and prediction, so a proxy and the prediction it is compared with
come from identical pixels. Images are resized by the image processor's own PIL filter, masks by the nearest pixel
centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

if TYPE_CHECKING:  # torch takes longer to import than the command line takes to answer --help
    import torch

MAX_SIDE = 16384  # of an image at the network: a damaged file shall not ask for all memory


def parse_size(text: str) -> tuple[int, int]:
    """(476, 644) from "476x644" (height x width)."""
    height, cross, width = text.lower().replace("×", "x").partition("x")
    if not (cross and height.strip().isdigit() and width.strip().isdigit()):
        raise ValueError(f"size {text!r}: write HEIGHTxWIDTH, for example 476x644")
    return int(height), int(width)


def resolve_size(size, recipe=None, processor=None, config=None) -> tuple[int, int]:
    """The (height, width) everything is resized to: `size` ("HxW" or a pair), else the recipe's, else the processor's.

    `config` is the model's configuration, whose patch size the processor does not always know. Raises ValueError when
    no size is fixed, or when it is not a multiple of the patch size.
    """
    if size is None:
        size = getattr(recipe, "size", None)
    if size is None:
        stated = getattr(processor, "size", None) or {}
        size = (stated["height"], stated["width"]) if "height" in stated and "width" in stated else None
    if not size:
        raise ValueError("the image processor states no height and width; give a size, for example --size 476x644")
    height, width = parse_size(size) if isinstance(size, str) else (int(side) for side in size)
    multiple = size_multiple(processor, config)
    if height < 1 or width < 1 or height % multiple or width % multiple:
        near = tuple(max(multiple, round(side / multiple) * multiple) for side in (height, width))
        raise ValueError(
            f"size {height}x{width}: both sides must be positive multiples of the patch size {multiple}, "
            f"for example {near[0]}x{near[1]}"
        )
    if max(height, width) > MAX_SIDE:
        raise ValueError(f"size {height}x{width}: at most {MAX_SIDE} on a side")
    return height, width


def size_multiple(processor, config) -> int:
    backbone = getattr(config, "backbone_config", None)
    candidates = (
        getattr(processor, "ensure_multiple_of", None),
        getattr(config, "patch_size", None),
        getattr(backbone, "patch_size", None),
    )
    return math.lcm(*(value for value in candidates if isinstance(value, int) and value > 0))


def pixel_settings(processor) -> dict:
    """What a processor does to pixels besides the size: resample filter, rescale factor (or None), mean and std."""
    normalize = getattr(processor, "do_normalize", True)
    rescale = getattr(processor, "do_rescale", True)
    resample = getattr(processor, "resample", None)
    return {
        "resample": int(Image.Resampling.BILINEAR if resample is None else resample),  # None is bilinear to HF as well
        "rescale_factor": float(processor.rescale_factor) if rescale else None,
        "image_mean": [float(value) for value in processor.image_mean] if normalize else None,
        "image_std": [float(value) for value in processor.image_std] if normalize else None,
    }


def to_pixel_values(images: Sequence[Image.Image], processor, size: tuple[int, int]) -> torch.Tensor:
    """N RGB images to (N, 3, h, w) float32, bit for bit what the processor's PIL backend gives when set to `size`.

    Keep-aspect and padding settings are ignored: `size` is final. Spelled out here because the torchvision backend,
    which transformers takes where torchvision is installed, has another bicubic.
    """
    return normalize_pixels(resize_images(images, processor, size), processor)


def resize_images(images: Sequence[Image.Image], processor, size: tuple[int, int]) -> np.ndarray:
    """N RGB images to (N, 3, h, w) uint8 with the processor's filter."""
    height, width = size
    resample = Image.Resampling(pixel_settings(processor)["resample"])
    return np.stack([np.asarray(image.resize((width, height), resample)).transpose(2, 0, 1) for image in images])


def _column(values) -> np.ndarray:
    return np.asarray(values, np.float32)[:, None]


def normalize_pixels(pixels: np.ndarray, processor) -> torch.Tensor:
    """(N, 3, h, w) uint8 to float32 with the processor's scale, mean and std, looked up: there are 256 values."""
    import torch

    settings = pixel_settings(processor)
    levels = np.arange(256, dtype=np.uint8)
    if settings["rescale_factor"] is not None:
        levels = levels.astype(np.float64) * settings["rescale_factor"]  # float64 first, as transformers does
    table = np.repeat(levels.astype(np.float32)[None], 3, axis=0)
    if settings["image_mean"] is not None:
        table = (table - _column(settings["image_mean"])) / _column(settings["image_std"])
    values = torch.empty(pixels.shape, dtype=torch.float32)
    for planes, target in zip(pixels, values.numpy(), strict=True):
        for channel in range(3):
            np.take(table[channel], planes[channel], out=target[channel], mode="clip")  # "raise" makes a copy
    return values


def resize_mask(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool to (h, w) bool by nearest neighbour: it stays a set of pixels, nothing is invented between."""
    # In whole numbers: Pillow's nearest takes either side where the centre falls between two pixels.
    rows, columns = ((2 * np.arange(new) + 1) * old // (2 * new) for new, old in zip(size, mask.shape, strict=True))
    return np.asarray(mask, dtype=bool)[np.ix_(rows, columns)]
