"""Networks that resize a picture of any size to a grid of tokens: the grid inside an exported graph.

MoGe-2 rounds two square roots to rows and columns, in Python's float64. A graph has no such numbers that could be a
size, and float32 would round to another grid now and then. So a network is traced with the grid as the shape of an
input, and in the finished graph that input is worked out of the picture's height and width, in whole numbers alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor, nn

from gift_peft.deploy.resampling import resample_side, scalar
from gift_peft.models.moge import MogeForDepthEstimation

GRID = "token_grid"


def tokens_of(network: nn.Module) -> int | None:
    """How many tokens a network divides any picture into; None where they are the picture's own patches.

    Raises ValueError for the first version of MoGe: it cuts off fractions of pixels that it worked out in float64.
    """
    inner = getattr(network, "network", None)
    if not isinstance(inner, MogeForDepthEstimation):
        return None
    if inner.config.version == "v1":
        text = "works its grid of tokens out in float64, which no graph has for sizes"
        raise ValueError(f"the first version of MoGe is not exported: it {text}; take --to transformers, or MoGe-2")
    return inner.num_tokens


@contextmanager
def grid_in_graph(network: nn.Module) -> Iterator[None]:
    """While it lasts, a network that has a grid of tokens keeps no number that an exporter takes from the traced one.

    Within `resampled_by_matrices`; nothing for other networks.
    """
    with ExitStack() as stack:
        if tokens_of(network) is not None:
            inner: Any = network.network
            vit = type(inner.network.encoder.backbone)
            stack.enter_context(mock.patch.object(torch, "linspace", linspace))
            stack.enter_context(mock.patch.object(vit, "interpolate_pos_encoding", positions))
            for module in inner.modules():
                if isinstance(module, nn.Upsample) and float(module.scale_factor).is_integer():
                    whole = int(module.scale_factor)  # with 2.0 a size would be a fraction that is cut
                    stack.enter_context(mock.patch.object(module, "scale_factor", whole))
        yield


def linspace(start: Any, end: Any, steps: Any, *, dtype: Any = None, device: Any = None) -> Tensor:
    """As `torch.linspace`, equal up to rounding; ends and steps may be symbols."""
    like = torch.zeros((), dtype=dtype, device=device)
    first, last = scalar(start, like), scalar(end, like)
    step = (last - first) / scalar(steps - 1, like).clamp(min=1)
    index = torch.arange(steps, device=device)
    points = torch.where(index < (steps + 1) // 2, first + step * index, last - step * (steps - 1 - index))
    return points.to(like.dtype)


def positions(self: Any, x: Tensor, h: Any, w: Any) -> Tensor:
    """As the vision transformer's `interpolate_pos_encoding`: its table (1,1+M*M,C), resampled to h/14 x w/14.

    The table is taken as it is for its own grid; for others the step is that of a grid larger by `interpolate_offset`.
    """
    table = self.pos_embed.float()
    side = round((table.shape[1] - 1) ** 0.5)
    grid = table[:, 1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
    counts = (h // self.patch_size, w // self.patch_size)
    own = [scalar(count, grid) == side for count in counts]
    for dimension, count in zip((-2, -1), counts, strict=True):
        step = 1 / scalar((count + self.interpolate_offset) / side, grid)
        step = torch.where(own[0] & own[1], torch.ones_like(step), step)
        grid = resample_side(grid, dimension, count, step, "bicubic", False, self.interpolate_antialias)
    return torch.cat([table[:, :1], grid.permute(0, 2, 3, 1).flatten(1, 2)], dim=1).to(x.dtype)


# ---- rows and columns in whole numbers ----


def thresholds(tokens: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(K,) int64 each: odd squares, and whether rows and columns round up where a square is met exactly.

    rows = round(sqrt(tokens * height / width)) is the number of k >= 0 with (2k+1)^2 * width < 4 * tokens * height.
    Where both are equal, the root is k + 1/2, and which way Python rounds what it computed is a matter of k alone,
    because width / height is then. Columns likewise. Nothing but equality is near enough for float64 to err.
    """
    squares = [(2 * k + 1) ** 2 for k in range(2 * tokens + 1)]  # a grid of one row has no more columns
    rows = [round((tokens / (4 * tokens / square)) ** 0.5) > k for k, square in enumerate(squares)]
    columns = [round((tokens * (square / (4 * tokens))) ** 0.5) > k for k, square in enumerate(squares)]
    odd, up, right = (np.array(values, np.int64) for values in (squares, rows, columns))
    return odd, up, right


def compute_grid(model: Any, tokens: int) -> None:
    """Put the rows and columns of a picture in the place of the input `token_grid` of an `onnx_ir.Model`."""
    import onnx_ir as ir

    graph = model.graph
    inputs = {value.name: value for value in graph.inputs}
    pixels, grid = inputs["pixel_values"], inputs[GRID]
    odd, *ups = thresholds(tokens)
    tape = ir.tape.Tape()

    def constant(name: str, values: np.ndarray) -> Any:
        value = tape.initializer(ir.tensor(values), name=f"{GRID}_{name}")
        graph.register_initializer(value)
        return value

    def product(a: Any, b: Any) -> Any:
        return tape.op("Mul", [a, b])

    def cast(value: Any, to: Any) -> Any:
        return tape.op("Cast", [value], attributes={"to": to})

    squares, floats = constant("squares", odd), constant("squares_float", odd.astype(np.float32))
    four, two = constant("factor", np.array([4 * tokens])), constant("twice", np.array([2], np.float32))
    zero = constant("zero", np.array([0]))
    height, width = (tape.op("Shape", [pixels], attributes={"start": axis, "end": axis + 1}) for axis in (2, 3))
    counts = []
    for name, side, other, up in (("rows", height, width, ups[0]), ("columns", width, height, ups[1])):
        bound = tape.op("Add", [product(four, side), constant(name, up)])
        # The difference, because OpenVINO compares whole numbers as float32.
        below = tape.op("Less", [tape.op("Sub", [product(squares, other), bound]), zero])
        # Runtimes that compute in 32 bits overflow far above the bound; there the floats say so.
        far = product(two, cast(bound, ir.DataType.FLOAT))
        near = tape.op("Less", [product(floats, cast(other, ir.DataType.FLOAT)), far])
        both = cast(tape.op("And", [below, near]), ir.DataType.INT64)
        counts.append(tape.op("ReduceSum", [both], attributes={"keepdims": 1}))
    shape = tape.op("Concat", counts, attributes={"axis": 0})
    filled = tape.op("ConstantOfShape", [shape], attributes={"value": ir.tensor(np.zeros(1, np.float32))})
    ir.convenience.replace_all_uses_with(grid, filled)
    graph.insert_before(graph[0], tape.nodes)
    graph.inputs.remove(grid)
