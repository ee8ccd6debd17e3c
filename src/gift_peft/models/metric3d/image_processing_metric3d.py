"""Pictures to Metric3D V2's input, and its canonical depth back to metres at the pictures' size.

By default every picture is resized to 476x644 (GIFT's size), bicubic. `keep_aspect_ratio=True` gives the original's
rule: scaled bilinearly to fit inside `size` (the original's is 616x1064) and centred on a canvas of the mean colour.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.nn import functional as F
from transformers.image_processing_backends import PilBackend
from transformers.image_processing_utils import BatchFeature
from transformers.image_utils import PILImageResampling, SizeDict
from transformers.processing_utils import ImagesKwargs

CANONICAL_FOCAL_LENGTH = 1000.0  # pixels


class Metric3DImageProcessorKwargs(ImagesKwargs, total=False):
    """
    keep_aspect_ratio (`bool`, *optional*, defaults to `False`):
        Fit the picture inside `size` and pad it around with the mean colour, instead of stretching it to `size`.
    """

    keep_aspect_ratio: bool


class Metric3DImageProcessorPil(PilBackend):
    """Image processor of [`Metric3DForDepthEstimation`], on Pillow, numpy and torch.

    Values are 0 to 255 and are not rescaled: mean and std are in that range. Raises ValueError for pictures that are
    not three-channel, not finite, or floats in 0 to 1.
    """

    valid_kwargs = Metric3DImageProcessorKwargs
    model_input_names = ["pixel_values"]  # noqa: RUF012 (transformers declares them so)
    resample = PILImageResampling.BICUBIC
    size = {"height": 476, "width": 644}  # noqa: RUF012
    do_resize = True
    do_rescale = False
    do_normalize = True
    image_mean = [123.675, 116.28, 103.53]  # noqa: RUF012
    image_std = [58.395, 57.12, 57.375]  # noqa: RUF012
    do_convert_rgb = True
    keep_aspect_ratio = False

    def _preprocess(
        self,
        images: list[np.ndarray],
        do_resize: bool,
        size: SizeDict,
        resample: PILImageResampling | None,
        do_rescale: bool,
        rescale_factor: float,
        do_normalize: bool,
        image_mean: Sequence[float] | None,
        image_std: Sequence[float] | None,
        keep_aspect_ratio: bool,
        return_tensors: str | None = None,
        **kwargs: Any,
    ) -> BatchFeature:
        if do_resize and not (size.height and size.width):
            raise ValueError(f"size must have height and width, got {size}")
        processed = []
        for image in images:  # (C, H, W)
            _check(image, do_rescale)
            if do_resize and keep_aspect_ratio:
                image = _fit_inside(image, (size.height, size.width), image_mean)
            elif do_resize:
                image = self.resize(image, size, resample)
            if do_rescale:
                image = self.rescale(image, rescale_factor)
            processed.append(self.normalize(image, image_mean, image_std) if do_normalize else image)
        shapes = sorted({image.shape[-2:] for image in processed})
        if return_tensors is not None and len(shapes) > 1:
            raise ValueError(
                f"the pictures come out in different sizes ({', '.join(f'{h}x{w}' for h, w in shapes)}): process them "
                "one by one, or with do_resize=True"
            )
        return BatchFeature({"pixel_values": processed}, tensor_type=return_tensors)

    def post_process_depth_estimation(
        self,
        outputs: Any,
        target_sizes: Sequence[tuple[int, int]] | None = None,
        focal_lengths: Sequence[float | tuple[float, float]] | None = None,
    ) -> list[dict[str, torch.Tensor]]:
        """Depth of each picture of a batch, `[{"predicted_depth": (H, W)}, ...]`.

        Args:
            outputs: of the model on (B, 3, h, w).
            target_sizes (*optional*): the pictures' original (height, width), to which depth is resized bilinearly,
                without the padding; without them it stays at the network's size.
            focal_lengths (*optional*): one per picture, in pixels of the original picture: fx, or (fx, fy). With them
                depth is in metres of that camera, else of the canonical one of 1000 pixels at the network's size.

        Raises ValueError if their numbers differ from B, for focal lengths without target sizes, and for focal lengths
        that are not positive.
        """
        depths = outputs.predicted_depth
        for name, values in (("target sizes", target_sizes), ("focal lengths", focal_lengths)):
            if values is None:
                continue
            if not hasattr(values, "__len__") or getattr(values, "ndim", 1) == 0:
                raise ValueError(f"{name}: a list, one per picture, got {values!r}")
            if len(values) != len(depths):
                raise ValueError(f"{len(values)} {name} for {len(depths)} predictions")
        if target_sizes is None:
            if focal_lengths is not None:
                raise ValueError("focal_lengths need target_sizes: they are in pixels of the original pictures")
            return [{"predicted_depth": depth} for depth in depths]
        results = []
        for index, (depth, target) in enumerate(zip(depths, target_sizes, strict=True)):
            if len(target) != 2 or min(target) < 1:
                raise ValueError(f"a target size is (height, width) in pixels, got {target!r}")
            size = int(target[0]), int(target[1])
            depth = self._content(depth, size)
            depth = F.interpolate(depth[None, None], size=size, mode="bilinear", align_corners=False)[0, 0]
            if focal_lengths is not None:
                depth = depth * self._canonical_to_metric(size, focal_lengths[index])
            results.append({"predicted_depth": depth})
        return results

    def _content(self, depth: torch.Tensor, original: tuple[int, int]) -> torch.Tensor:
        """The part of a prediction that shows a picture of this original size, without the padding."""
        if not (self.do_resize and self.keep_aspect_ratio):
            return depth
        canvas = self.size["height"], self.size["width"]
        height, width, top, left = _placement(original, canvas)
        # The prediction is up to two pixels smaller than a canvas that is no multiple of 28.
        rows, columns = (side / full for side, full in zip(depth.shape, canvas, strict=True))
        top, left = round(top * rows), round(left * columns)
        return depth[top : top + max(1, round(height * rows)), left : left + max(1, round(width * columns))]

    def _canonical_to_metric(self, original: tuple[int, int], focal_length: float | tuple[float, float]) -> float:
        """Metres per canonical metre: the focal length at the network's size over the canonical one."""
        if isinstance(focal_length, torch.Tensor):
            focal_length = focal_length.tolist()
        try:
            lengths = [float(value) for value in np.ravel(focal_length)]
        except (TypeError, ValueError):
            lengths = []
        if len(lengths) not in (1, 2) or not all(0 < value < float("inf") for value in lengths):
            raise ValueError(f"a focal length is fx or (fx, fy), positive pixels, got {focal_length!r}")
        scales = self._resize_scales(original)
        return sum(f * s for f, s in zip(lengths, scales, strict=False)) / len(lengths) / CANONICAL_FOCAL_LENGTH

    def _resize_scales(self, original: tuple[int, int]) -> tuple[float, float]:
        """(x, y) factors of the resize."""
        if not self.do_resize:
            return 1.0, 1.0
        y, x = self.size["height"] / original[0], self.size["width"] / original[1]
        return (min(x, y),) * 2 if self.keep_aspect_ratio else (x, y)


def _check(image: np.ndarray, do_rescale: bool) -> None:
    if image.ndim != 3 or image.shape[0] != 3:
        raise ValueError(f"a picture must have three channels, got an array of shape {image.shape} (channels first)")
    if image.dtype.kind != "f":
        return
    if not np.isfinite(image).all():
        raise ValueError("a picture has NaN or infinite values")
    if not do_rescale and 0 < image.max() <= 1:
        raise ValueError(
            "a picture has floats up to 1: Metric3D takes values from 0 to 255, multiply by 255 and round"
        )


def _placement(image: tuple[int, int], canvas: tuple[int, int]) -> tuple[int, int, int, int]:
    """(height, width, top, left) of a picture (height, width) scaled into a canvas and centred."""
    scale = min(canvas[0] / image[0], canvas[1] / image[1])
    height, width = (max(1, int(side * scale)) for side in image)
    return height, width, (canvas[0] - height) // 2, (canvas[1] - width) // 2


def _fit_inside(image: np.ndarray, canvas: tuple[int, int], colour: Sequence[float] | None) -> np.ndarray:
    """(3,H,W) scaled and centred on (3, *canvas); 8-bit pictures stay 8-bit, their border too, as in the original."""
    height, width, top, left = _placement(image.shape[-2:], canvas)
    # Bilinear without antialias is the original's filter; Pillow's would blur when it shrinks.
    pixels = torch.from_numpy(np.array(image, dtype=np.float32))[None]
    pixels = F.interpolate(pixels, size=(height, width), mode="bilinear", align_corners=False)[0].numpy()
    result = np.empty((3, *canvas), np.float32)
    result[:] = np.float32(0 if colour is None else colour).reshape(-1, 1, 1)
    result[:, top : top + height, left : left + width] = pixels
    return result if image.dtype.kind == "f" else result.round().clip(0, 255).astype(np.uint8)


__all__ = ["Metric3DImageProcessorPil"]
