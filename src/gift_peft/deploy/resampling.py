"""`torch.nn.functional.interpolate` written as products with small matrices, for a graph that is right at every size.

An exporter keeps scale factors that a model works out in Python as the numbers of the traced size, and runtimes work
out the positions of samples each in their own way. Here positions are part of the graph, by torch's own formulas, and
the rest is two matrix products, which every runtime has.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor

CUBIC = -0.75  # of bicubic; the antialiased one follows Pillow with -0.5
CUBIC_ANTIALIAS = -0.5
BORDER = 2  # pixels that a cubic kernel reaches over the edge, where the edge's own value is repeated


@contextmanager
def resampled_by_matrices() -> Iterator[None]:
    """While it lasts, `interpolate` of pictures (B,C,H,W) is the one below, for every model that calls it by name."""
    original = torch.nn.functional.interpolate

    def interpolate(input: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        return (resample if input.ndim == 4 else original)(input, *args, **kwargs)

    with mock.patch.object(torch.nn.functional, "interpolate", interpolate):
        yield


def resample(
    input: Tensor,
    size: Any = None,
    scale_factor: Any = None,
    mode: str = "nearest",
    align_corners: bool | None = None,
    recompute_scale_factor: bool | None = None,
    antialias: bool = False,
) -> Tensor:
    """As `torch.nn.functional.interpolate` for (B,C,H,W), equal up to rounding; sizes and factors may be symbols.

    Raises NotImplementedError for a mode other than nearest, bilinear and bicubic.
    """
    if mode not in ("nearest", "bilinear", "bicubic"):
        raise NotImplementedError(f"interpolate(mode={mode!r}) has no form for export")
    sizes, factors = _pair(size), _pair(scale_factor)
    for axis in (0, 1):
        dimension, length = axis - 2, input.shape[axis - 2]
        factor = None if factors is None or sizes is not None else factors[axis]
        count = sizes[axis] if sizes is not None else torch.sym_int(length * factors[axis])
        factor = None if recompute_scale_factor else factor
        # torch takes positions of nearest in float32 whatever the values are; at ties that says which pixel.
        like = input.new_zeros((), dtype=torch.float32) if mode == "nearest" else input
        step = _step(length, count, factor, bool(align_corners), like)
        input = resample_side(input, dimension, count, step, mode, bool(align_corners), antialias)
    return input


def resample_side(
    input: Tensor, dimension: int, count: Any, step: Tensor, mode: str, align_corners: bool, antialias: bool
) -> Tensor:
    """One side of `resample`, -2 or -1, to `count` pixels that lie `step` () pixels of the input apart."""
    length = input.shape[dimension]
    if mode == "nearest":
        places = torch.arange(count, device=input.device).to(step.dtype) * step
        return input.index_select(dimension, places.floor().to(torch.int64).clamp(max=length - 1))
    if antialias:
        matrix = _antialiased(length, count, step, mode)
    else:
        first = torch.arange(count, device=input.device).to(step.dtype)
        source = step * first if align_corners else step * (first + 0.5) - 0.5
        if mode == "bicubic":
            input, matrix = _repeat_border(input, dimension), _cubic_matrix(length, source)
        else:
            matrix = _linear_matrix(length, source)
    matrix = matrix.to(input.dtype)
    return matrix @ input if dimension == -2 else input @ matrix.T


def _pair(value: Any) -> Any:
    return value if value is None or isinstance(value, (tuple, list)) else (value, value)


def scalar(value: Any, like: Tensor) -> Tensor:
    """A number or symbol as a tensor of float32 (float64 beside float64), so that it stays in the graph."""
    dtype = torch.promote_types(like.dtype, torch.float32)
    return torch.full((), value, dtype=dtype, device=like.device)


def _step(length: Any, count: Any, factor: Any, align_corners: bool, like: Tensor) -> Tensor:
    """Pixels of the input per pixel of the output, () float."""
    if align_corners:
        return scalar(length - 1, like) / scalar(count - 1, like).clamp(min=1)
    if factor is not None:
        return 1 / scalar(factor, like)
    return scalar(length, like) / scalar(count, like)


def _columns(length: Any, like: Tensor, first: int = 0) -> Tensor:
    return torch.arange(first, length - first, device=like.device).to(like.dtype)


def _linear_matrix(length: Any, source: Tensor) -> Tensor:
    """(out, in): the two neighbors' weights."""
    source = source.clamp(min=0).minimum(scalar(length - 1, source))
    return (1 - (source[:, None] - _columns(length, source)).abs()).clamp(min=0)


def _cubic_matrix(length: Any, source: Tensor) -> Tensor:
    """(out, in + 2 * BORDER): the four neighbors' weights."""
    return _cubic((source[:, None] - _columns(length, source, -BORDER)).abs(), CUBIC)


def _cubic(x: Tensor, a: float) -> Tensor:
    """The cubic convolution kernel at distances x >= 0."""
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = ((a * x - 5 * a) * x + 8 * a) * x - 4 * a
    return torch.where(x <= 1, near, torch.where(x < 2, far, torch.zeros_like(x)))


def _antialiased(length: Any, count: Any, step: Tensor, mode: str) -> Tensor:
    """(out, in): the kernel made as wide as an output pixel, cut at the edges, each row with sum 1."""
    center = (torch.arange(count, device=step.device).to(step.dtype) + 0.5) * step
    distance = ((_columns(length, step) + 0.5 - center[:, None]) / step.clamp(min=1)).abs()
    weights = _cubic(distance, CUBIC_ANTIALIAS) if mode == "bicubic" else (1 - distance).clamp(min=0)
    return weights / weights.sum(dim=1, keepdim=True)


def _repeat_border(x: Tensor, dimension: int) -> Tensor:
    first, last = x.narrow(dimension, 0, 1), x.narrow(dimension, x.shape[dimension] - 1, 1)
    return torch.cat([*[first] * BORDER, x, *[last] * BORDER], dim=dimension)
