"""A group as the group step takes it: checked, with its pairs found, before the device is asked for anything.

All of this is work on CPU tensors, so that the threads that load groups can do it while the device is busy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from gift_peft.losses import Pairs, name_infinite, require_finite


@dataclass(frozen=True)
class GroupInputs:
    """N images with what their loss needs; ValueError for what `gift_loss` would refuse after the forwards.

    Args:
        pixel_values (`Tensor`): (N,3,h,w) floating point, not fp16, finite.
        mask (`Tensor`): (N,H,W) bool, the target, at the size of the prediction.
        target (`Tensor`): (N,H,W) floating point, the proxies in native units, finite.
        valid (`Tensor`, *optional*): (N,H,W) bool, False where a warped frame has no pixels.
        names (`Sequence[str]`, *optional*): of the images, for messages.
        pairs (`Pairs`, *optional*): of `mask` and `valid`; if not given they are found and all is checked, so what
            comes with pairs was checked before.
    """

    pixel_values: Tensor
    mask: Tensor
    target: Tensor
    valid: Tensor | None = None
    names: Sequence[str] | None = None
    pairs: Pairs = None  # pyright: ignore[reportAssignmentType]  (never None after __post_init__)

    def __post_init__(self) -> None:
        if self.pairs is None:
            _check(self.pixel_values, self.mask, self.target, self.valid, self.names)
            object.__setattr__(self, "pairs", Pairs.of(self.mask, self.valid))

    def __len__(self) -> int:
        return len(self.mask)

    def arguments(self) -> list[Any]:
        """As `GroupStep.accumulate` takes them."""
        return [getattr(self, field.name) for field in fields(self)]

    def pin_memory(self) -> GroupInputs:
        """The same in pinned memory, from where it travels to a CUDA device while the host goes on."""
        pinned = (part.pin_memory() if hasattr(part, "pin_memory") else part for part in self.arguments())
        return GroupInputs(*pinned)

    def check_results(self, finite: Sequence[float], loss: float, gradient: float) -> None:
        """Raise ValueError for what is not finite: each prediction (N flags), the loss, the gradient's largest value.

        The cause before its consequences.
        """
        name_infinite(finite, "the prediction", self.names)
        if not math.isfinite(loss):  # differences of finite predictions overflow; their signs do not
            raise ValueError("the loss of this group is NaN or infinite")
        if not math.isfinite(gradient):
            raise ValueError("the gradient of this group has NaN or infinite values")


def check_lambdas(**values: float) -> None:
    """ValueError for a weight of the loss that is no finite number, or negative."""
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, Real) or not 0 <= value < math.inf:
            raise ValueError(f"{name} must be a finite number, 0 or more, got {value!r}")


def _check(
    pixel_values: Tensor, mask: Tensor, target: Tensor, valid: Tensor | None, names: Sequence[str] | None
) -> None:
    given: dict[str, Any] = {"pixel_values": pixel_values, "mask": mask, "target": target}
    given |= {} if valid is None else {"valid": valid}
    for what, tensor in given.items():
        if not isinstance(tensor, Tensor):
            raise ValueError(f"{what} must be a tensor, got {type(tensor).__name__}")
    if pixel_values.ndim != 4 or pixel_values.dtype == torch.float16 or not pixel_values.is_floating_point():
        raise ValueError(
            "pixel_values must be (N,3,h,w), floating point and not fp16, got "
            f"{tuple(pixel_values.shape)} {pixel_values.dtype}"
        )
    if len(pixel_values) == 0:
        raise ValueError("the group has no images")
    if names is not None:
        given["names"] = names
    for what, values in given.items():
        if values is not pixel_values and len(values) != len(pixel_values):
            raise ValueError(f"{what} has {len(values)} entries for {len(pixel_values)} images")
    for what in ("mask", "valid"):
        if what in given and given[what].dtype != torch.bool:
            raise ValueError(f"{what} must be a bool tensor, got {given[what].dtype}")
    if not target.is_floating_point():
        raise ValueError(f"target must be a floating point tensor, got {target.dtype}")
    if target.ndim != 3 or 0 in target.shape:
        raise ValueError(f"target must be (N,H,W) with at least one pixel, got {tuple(target.shape)}")
    for what in ("mask", "valid"):
        if what in given and given[what].shape != target.shape:
            raise ValueError(f"{what} is {_sides(given[what])} but target is {_sides(target)}")
    require_finite(pixel_values, "pixel_values", names)
    require_finite(target, "the target (proxy)", names)


def _sides(tensor: Tensor) -> str:
    return "x".join(map(str, tensor.shape[1:]))
