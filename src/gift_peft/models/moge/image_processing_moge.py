"""Pictures to MoGe's input: 476x644 (GIFT's size), bicubic, colors from 0 to 1; the network normalizes them itself.

The network resizes its input to a grid of tokens and its output back, so any size does.
"""

from transformers import DPTImageProcessorPil
from transformers.image_utils import PILImageResampling


class MogeImageProcessorPil(DPTImageProcessorPil):
    """Image processor of [`MogeForDepthEstimation`]: DPT's with other defaults."""

    resample = PILImageResampling.BICUBIC
    size = {"height": 476, "width": 644}  # noqa: RUF012 (transformers declares them so)
    do_normalize = False
    keep_aspect_ratio = False
    ensure_multiple_of = 1


__all__ = ["MogeImageProcessorPil"]
