"""The GIFT objective (paper, Section 3.2, Eqs. 1-7) as pure functions of tensors.

Observations of one group share their geometry, so their predictions must agree where two target masks overlap
(consistency); everywhere else the adapted model must stay with the frozen one (self-distillation).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

# Values per temporary tensor of the pairwise sums: 4 MiB in float32, near enough to a cache and to a GPU's appetite.
BLOCK_ELEMENTS = 2**20


class GiftLoss(NamedTuple):
    """What `gift_loss` returns; the two terms are before their lambdas, the factor 2 of Eq. 5 included."""

    total: Tensor
    consistency: Tensor
    distillation: Tensor
    num_pairs: int


def masked_l1(a: Tensor, b: Tensor, mask: Tensor) -> Tensor:
    """Mean absolute difference over the mask (Eq. 1).

    Args: `a`, `b` float tensors of one shape, `mask` bool of the same shape. Returns a 0-dim tensor, float64 if an
    input is, else float32. Raises ValueError for an empty mask, wrong dtypes or shapes, and non-finite values.
    """
    a, b = _promote(a, b)
    _check_same_shape("b", b.shape, "a", a.shape)
    _check_mask("mask", mask, "a", a.shape)
    for name, values in (("a", a), ("b", b)):
        if not torch.isfinite(values).all():
            raise ValueError(f"masked_l1: {name} has NaN or infinite values")
    count = mask.sum()
    if count == 0:
        raise ValueError("masked_l1: the mask is empty, so its mean is undefined")
    return _absolute(a - b, mask).sum() / count


def group_consistency_loss(depth: Tensor, mask: Tensor, valid: Tensor | None = None) -> Tensor:
    """Mean of `masked_l1` over all unordered pairs of a group whose target masks intersect (Eqs. 2-3).

    Args: `depth` (N,H,W) predictions in native units, `mask` (N,H,W) bool targets, `valid` (N,H,W) bool, False where
    a warped frame has no pixels. Returns a 0-dim tensor; 0, with zero gradients, if no pair intersects.
    Raises ValueError for wrong dtypes or shapes and non-finite values.
    """
    depth = _check_group(depth, mask, valid)
    return _consistency(depth, _target_region(mask, valid))[0]


def self_distillation_loss(depth: Tensor, target: Tensor, mask: Tensor, valid: Tensor | None = None) -> Tensor:
    """Twice the mean over images of the L1 distance to the frozen model's prediction outside the target (Eq. 5).

    Args: as `group_consistency_loss`; `target` (N,H,W) proxies, treated as constants. Images without other-region
    pixels do not count. Returns a 0-dim tensor; 0, with zero gradients, if none counts. Raises ValueError likewise.
    """
    depth, target = _check_group_and_target(depth, target, mask, valid)
    return _distillation(depth, target, _other_region(mask, valid))


def gift_loss(
    depth: Tensor,
    target: Tensor,
    mask: Tensor,
    lambda_c: float = 1.0,
    lambda_d: float = 1.0,
    valid: Tensor | None = None,
) -> GiftLoss:
    """The complete objective of one group, `lambda_c * consistency + lambda_d * distillation` (Eq. 6).

    Args: `depth`, `target` (N,H,W) float, `mask`, `valid` (N,H,W) bool. Raises ValueError for wrong dtypes or shapes
    and non-finite values. `num_pairs` counts the pairs behind the consistency term.
    """
    depth, target = _check_group_and_target(depth, target, mask, valid)
    consistency, num_pairs = _consistency(depth, _target_region(mask, valid))
    distillation = _distillation(depth, target, _other_region(mask, valid))
    return GiftLoss(lambda_c * consistency + lambda_d * distillation, consistency, distillation, num_pairs)


class GeometryConsistencyError:
    """GCE (Eq. 7): the mean of Eq. 3 over groups, streaming.

    GCE is in native units and shrinks with the outputs; `compute_normalized` divides each group's value by the spread
    (P95 - P5) of the same model's predictions over that group, which a mere rescaling leaves alone.
    """

    def __init__(self) -> None:
        self.num_groups = 0
        self.num_skipped = 0
        self._sum = 0.0
        self._normalized_sum = 0.0

    def update(self, depth: Tensor, mask: Tensor, valid: Tensor | None = None) -> float:
        """Add one group and return its value; a group without a valid pair is skipped, counted, and returns NaN.

        Shapes, units and errors as `group_consistency_loss`.
        """
        with torch.no_grad():
            depth = _check_group(depth, mask, valid)
            loss, num_pairs = _consistency(depth, _target_region(mask, valid))
        if num_pairs == 0:
            self.num_skipped += 1
            return math.nan
        value = loss.item()
        spread = prediction_spread(depth, valid)
        self.num_groups += 1
        self._sum += value
        # A constant prediction has no scale to compare with: infinite, never a flattering zero.
        self._normalized_sum += value / spread if spread > 0 else math.inf
        return value

    def compute(self) -> float:
        """Mean over the counted groups in native units; NaN if none counts."""
        return self._sum / self.num_groups if self.num_groups else math.nan

    def compute_normalized(self) -> float:
        """Mean of value / (P95 - P5); infinite if a group's predictions have no spread, NaN if no group counts."""
        return self._normalized_sum / self.num_groups if self.num_groups else math.nan


def geometry_consistency_error(groups: Iterable[Sequence[Tensor]]) -> float:
    """GCE (Eq. 7) over an iterable of (depth, mask) or (depth, mask, valid); see `GeometryConsistencyError`."""
    error = GeometryConsistencyError()
    for group in groups:
        error.update(*group)
    return error.compute()


def prediction_spread(depth: Tensor, valid: Tensor | None = None) -> float:
    """P95 - P5 of the (valid) values of `depth`, any shape, in its units; NaN if there is none."""
    values = depth.detach() if valid is None else depth.detach()[valid]
    if values.numel() == 0:
        return math.nan
    # numpy, because torch.quantile stops at 2**24 values and a group of 55 at 476x644 has more.
    values = values.to("cpu", torch.promote_types(values.dtype, torch.float32)).numpy()
    low, high = np.percentile(values, (5, 95))
    return float(high - low)


def require_finite(values: Tensor, what: str, names: Sequence[str] | None = None) -> None:
    """Raise ValueError naming the first image of `values` (N,...) that holds a NaN or infinite value."""
    low, high = values.flatten(1).aminmax(dim=1)  # both are NaN if one value is; isfinite(values) would copy them all
    finite = low.isfinite() & high.isfinite()
    if not finite.all():
        index = int((~finite).nonzero()[0])
        image = f"image {index}" if names is None else f"{names[index]} (image {index})"
        raise ValueError(f"{what} of {image} has NaN or infinite values")


class _PairwiseL1(torch.autograd.Function):
    """Sum over pairs of the mean absolute difference on each pair's intersection, and the number of such pairs.

    `depth`, `mask` (N,P). Pixels that fewer than two masks hold are left out; the others are gathered block by block,
    so that beside `gradient` (N,P), which is built with the value, the temporary memory does not depend on N or P.
    """

    @staticmethod
    def forward(ctx, depth: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        blocks = (mask.sum(0) >= 2).nonzero()[:, 0].split(max(1, BLOCK_ELEMENTS // len(mask)))
        count = torch.zeros(len(mask), len(mask), dtype=torch.float64, device=mask.device)
        for columns in blocks:
            ones = mask[:, columns].float()
            count += ones @ ones.T  # sums of less than 2**24 ones: exact
        weight = torch.where(count > 0, 1 / count, 0).to(depth.dtype)
        total = depth.new_zeros(())
        gradient = torch.zeros_like(depth) if depth.requires_grad else None
        for columns in blocks:
            value, signs = _pair_sums(depth[:, columns], mask[:, columns], weight, gradient is not None)
            total += value
            if gradient is not None and signs is not None:
                gradient[:, columns] = signs
        ctx.save_for_backward(gradient)
        num_pairs = count.triu(1).count_nonzero()
        ctx.mark_non_differentiable(num_pairs)
        return total, num_pairs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_total: Tensor, _) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * grad_total, None


def _pair_sums(depth: Tensor, mask: Tensor, weight: Tensor, differentiate: bool) -> tuple[Tensor, Tensor | None]:
    """The weighted sum over pairs of (N,K) columns, and its gradient (N,K)."""
    total = depth.new_zeros(())
    gradient = torch.zeros_like(depth) if differentiate else None
    same = bool(mask.all())  # the usual case: one mask for the whole group
    for i in range(len(depth) - 1):
        difference = depth[i] - depth[i + 1 :]
        if not same:  # where, not a product: an overflow outside the masks would turn 0 * inf into NaN
            difference = torch.where(mask[i] & mask[i + 1 :], difference, 0)
        if gradient is not None:
            sign = difference.sign()
            gradient[i] += weight[i, i + 1 :] @ sign
            gradient[i + 1 :].addcmul_(sign, weight[i, i + 1 :, None], value=-1)
        total += difference.abs_().sum(1) @ weight[i, i + 1 :]
    return total, gradient


class _DistanceToTarget(torch.autograd.Function):
    """Per image the mean absolute difference to `target` on `region`, 0 where that is empty; all (N,P).

    Image by image in both directions: autograd would keep and make several (N,P) tensors.
    """

    @staticmethod
    def forward(ctx, depth: Tensor, target: Tensor, region: Tensor, count: Tensor) -> Tensor:
        ctx.save_for_backward(depth, target, region, count)
        sums = [torch.where(r, d - t, 0).abs_().sum() for d, t, r in zip(depth, target, region, strict=True)]
        return torch.stack(sums) / count.clamp(min=1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_output: Tensor) -> tuple[Tensor, None, None, None]:
        depth, target, region, count = ctx.saved_tensors
        gradient = torch.empty_like(depth)
        for i, scale in enumerate(grad_output / count.clamp(min=1)):
            gradient[i] = torch.where(region[i], depth[i] - target[i], 0).sign_().mul_(scale)
        return gradient, None, None, None


def _consistency(depth: Tensor, region: Tensor) -> tuple[Tensor, int]:
    """Eq. 3 on checked tensors, and the number of pairs in Eq. 2."""
    total, num_pairs = _PairwiseL1.apply(depth.flatten(1), region.flatten(1))
    return total / num_pairs.clamp(min=1), int(num_pairs)


def _distillation(depth: Tensor, target: Tensor, region: Tensor) -> Tensor:
    """Eq. 5 on checked tensors."""
    count = region.flatten(1).sum(1)
    per_image = _DistanceToTarget.apply(depth.flatten(1), target.flatten(1), region.flatten(1), count)
    return 2 * per_image.sum() / (count > 0).sum().clamp(min=1)


def _absolute(difference: Tensor, mask: Tensor) -> Tensor:
    # where, not a product: a difference that overflows outside the mask would turn 0 * inf into NaN.
    return torch.where(mask, difference, 0).abs()


def _target_region(mask: Tensor, valid: Tensor | None) -> Tensor:
    return mask if valid is None else mask & valid


def _other_region(mask: Tensor, valid: Tensor | None) -> Tensor:
    return ~mask if valid is None else ~mask & valid


def _promote(*tensors: Tensor) -> list[Tensor]:
    """All in float64 if one is, else float32."""
    dtype = torch.float32
    for tensor in tensors:
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            raise ValueError(f"predictions must be floating point tensors, got {_kind(tensor)}")
        dtype = torch.promote_types(dtype, tensor.dtype)
    return [tensor.to(dtype) for tensor in tensors]


def _check_group(depth: Tensor, mask: Tensor, valid: Tensor | None) -> Tensor:
    """`depth` in the precision of the computation, after all checks."""
    (depth,) = _promote(depth)
    if depth.ndim != 3 or 0 in depth.shape:
        raise ValueError(f"depth must be (N,H,W) with at least one image and pixel, got {tuple(depth.shape)}")
    _check_mask("mask", mask, "depth", depth.shape)
    if valid is not None:
        _check_mask("valid", valid, "depth", depth.shape)
    require_finite(depth, "depth")
    return depth


def _check_group_and_target(depth: Tensor, target: Tensor, mask: Tensor, valid: Tensor | None) -> list[Tensor]:
    _check_group(depth, mask, valid)
    depth, target = _promote(depth, target)
    _check_same_shape("target", target.shape, "depth", depth.shape)
    require_finite(target, "target")
    return [depth, target.detach()]


def _check_mask(name: str, mask: Tensor, other_name: str, shape: torch.Size) -> None:
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
        raise ValueError(f"{name} must be a bool tensor, got {_kind(mask)}")
    _check_same_shape(name, mask.shape, other_name, shape)


def _check_same_shape(name: str, shape: torch.Size, other_name: str, other: torch.Size) -> None:
    if shape != other:
        raise ValueError(f"{name} has shape {tuple(shape)} but {other_name} has {tuple(other)}")


def _kind(value: object) -> str:
    return str(value.dtype) if isinstance(value, Tensor) else type(value).__name__
