"""Pictures to VGGT's input: resize, then [0, 1]. The network normalises itself, so nothing else happens here.

By default every picture is resized to 476x644 (GIFT's size). `keep_aspect_ratio=True` gives the original's rules
instead: with `size` 518x518 its "crop" (width 518, tall pictures cut), with `do_pad=True` its "pad" (white borders).
"""

from typing import Any

import numpy as np
import torch
from transformers.image_processing_backends import PilBackend
from transformers.image_processing_utils import BatchFeature
from transformers.image_utils import PILImageResampling, SizeDict
from transformers.processing_utils import ImagesKwargs

WHITE = 255


class VggtImageProcessorKwargs(ImagesKwargs, total=False):
    """
    keep_aspect_ratio (`bool`, *optional*, defaults to `False`):
        Resize to the width of `size`, the height follows and is cut to the height of `size` around its middle. With
        `do_pad`, fit the picture inside `size` and pad with white.
    ensure_multiple_of (`int`, *optional*, defaults to 14):
        The patch size, which heights and widths are multiples of when the aspect ratio is kept.
    """

    keep_aspect_ratio: bool
    ensure_multiple_of: int


class VggtImageProcessorPil(PilBackend):
    """Image processor of [`VggtForDepthEstimation`], on Pillow and numpy.

    Transparent pixels become white. Raises ValueError for pictures that are not three-channel, are not finite, are
    floats in 0 to 1 with `do_rescale`, or come out in different sizes, and for `do_normalize=True`.
    """

    valid_kwargs = VggtImageProcessorKwargs
    model_input_names = ["pixel_values"]  # noqa: RUF012 (transformers declares them so)
    resample = PILImageResampling.BICUBIC
    size = {"height": 476, "width": 644}  # noqa: RUF012
    do_resize = True
    do_rescale = True
    rescale_factor = 1 / 255
    do_normalize = False
    do_pad = False
    do_convert_rgb = True
    keep_aspect_ratio = False
    ensure_multiple_of = 14

    def _preprocess(
        self,
        images: list[np.ndarray],
        do_resize: bool,
        size: SizeDict,
        resample: PILImageResampling | None,
        do_rescale: bool,
        rescale_factor: float,
        do_normalize: bool,
        do_pad: bool,
        keep_aspect_ratio: bool,
        ensure_multiple_of: int,
        return_tensors: str | None = None,
        **kwargs: Any,
    ) -> BatchFeature:
        if do_normalize:
            raise ValueError("do_normalize=True: VGGT normalises inside the network, leave it False")
        if do_resize and not (size.height and size.width):
            raise ValueError(f"size must have height and width, got {size}")
        processed = []
        for image in images:  # (C, H, W)
            _check(image, do_rescale)
            if do_resize and keep_aspect_ratio:
                image = self._resize_kept(image, (size.height, size.width), resample, ensure_multiple_of, do_pad)
            elif do_resize:
                image = self.resize(image, size, resample)
            processed.append(self.rescale(image, rescale_factor) if do_rescale else image)
        shapes = sorted({image.shape[-2:] for image in processed})
        if return_tensors is not None and len(shapes) > 1:
            raise ValueError(
                f"the pictures come out in different sizes ({', '.join(f'{h}x{w}' for h, w in shapes)}): process them "
                "one by one, or with keep_aspect_ratio=False or do_pad=True"
            )
        return BatchFeature({"pixel_values": processed}, tensor_type=return_tensors)

    def _resize_kept(
        self, image: np.ndarray, size: tuple[int, int], resample: int | None, multiple: int, pad: bool
    ) -> np.ndarray:
        height, width = kept_size(image.shape[-2:], size, multiple, pad)
        image = self.resize(image, SizeDict(height=height, width=width), resample)
        if pad:
            top, left = (size[0] - height) // 2, (size[1] - width) // 2
            border = ((0, 0), (top, size[0] - height - top), (left, size[1] - width - left))
            return np.pad(image, border, constant_values=WHITE)
        top = max(0, height - size[0]) // 2
        return image[:, top : top + size[0]]

    def post_process_depth_estimation(
        self, outputs: Any, target_sizes: list[tuple[int, int]] | None = None
    ) -> list[dict[str, torch.Tensor]]:
        """Depth of each picture of a batch, `[{"predicted_depth": (H, W)}, ...]`.

        Args: `outputs` of the model on (B, 3, h, w); `target_sizes` the pictures' original (height, width), to which
        depth is resized bicubically, without the padding; without them it stays at (h, w).
        Raises ValueError if the number of sizes differs from B, and for a picture whose top and bottom were cut.
        """
        depth = outputs.predicted_depth
        if depth.ndim != 3:
            raise ValueError(f"predicted_depth must be (B, h, w), got {tuple(depth.shape)}: pass one scene's frames")
        if target_sizes is None:
            return [{"predicted_depth": item} for item in depth]
        if len(target_sizes) != len(depth):
            raise ValueError(f"{len(target_sizes)} target sizes for {len(depth)} predictions")
        return [
            {"predicted_depth": _resize_depth(self._content(item, tuple(map(int, size))), tuple(map(int, size)))}
            for item, size in zip(depth, target_sizes, strict=True)
        ]

    def _content(self, depth: torch.Tensor, original: tuple[int, int]) -> torch.Tensor:
        """The part of a prediction that shows a picture of this original size."""
        if not (self.do_resize and self.keep_aspect_ratio):
            return depth
        size = (self.size["height"], self.size["width"])
        height, width = kept_size(original, size, self.ensure_multiple_of, self.do_pad)
        if self.do_pad:
            top, left = (size[0] - height) // 2, (size[1] - width) // 2
            return depth[top : top + height, left : left + width]
        if height > size[0]:
            raise ValueError(
                f"a picture of {original[0]}x{original[1]} was cut to {size[0]} of {height} rows, so the rest has no "
                "depth: use do_pad=True, or leave target_sizes out"
            )
        return depth


def kept_size(image: tuple[int, int], size: tuple[int, int], multiple: int, inside: bool) -> tuple[int, int]:
    """(height, width), multiples of `multiple`, of a picture (height, width) scaled to the width of `size`.

    `inside`: to its height instead where the picture is relatively taller than `size`. Ties round to even.
    """
    if inside and image[0] * size[1] > size[0] * image[1]:
        width = round(image[1] * size[0] / image[0] / multiple) * multiple
        return size[0], min(max(width, multiple), size[1])
    height = max(round(image[0] * size[1] / image[1] / multiple) * multiple, multiple)
    return min(height, size[0]) if inside else height, size[1]


def _check(image: np.ndarray, do_rescale: bool) -> None:
    if image.ndim != 3 or image.shape[0] != 3:
        raise ValueError(f"a picture must have three channels, got an array of shape {image.shape} (channels first)")
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        raise ValueError("a picture has NaN or infinite values")
    if image.dtype.kind == "f" and do_rescale and 0 < image.max() <= 1:
        raise ValueError("a picture has floats up to 1, which would be divided by 255 again: pass do_rescale=False")


def _resize_depth(depth: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    return torch.nn.functional.interpolate(depth[None, None], size=size, mode="bicubic", align_corners=False)[0, 0]


__all__ = ["VggtImageProcessorPil"]
