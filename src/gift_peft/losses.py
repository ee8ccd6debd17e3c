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

# Differences to a proxy up to this share of its image's largest |value| count as none: the sign of what another cut
# into batches or number of threads changes is noise, and a fresh adapter would get a whole gradient of it.
ROUNDING = {torch.float32: 2.0**-18, torch.float64: 2.0**-46}


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
    return _consistency(depth, Pairs.of(mask, valid))


def self_distillation_loss(depth: Tensor, target: Tensor, mask: Tensor, valid: Tensor | None = None) -> Tensor:
    """Twice the mean over images of the L1 distance to the frozen model's prediction outside the target (Eq. 5).

    Args: as `group_consistency_loss`; `target` (N,H,W) proxies, treated as constants. Images without other-region
    pixels do not count; differences up to 2^-18 of the image's largest |target| (float64: 2^-46) are rounding and
    count as none. Returns a 0-dim tensor; 0, with zero gradients, if none counts. Raises ValueError likewise.
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
    _check_group_and_target(depth, target, mask, valid)
    return gift_terms(depth, target, mask, Pairs.of(mask, valid), lambda_c, lambda_d, valid)


def gift_terms(
    depth: Tensor,
    target: Tensor,
    mask: Tensor,
    pairs: Pairs,
    lambda_c: float = 1.0,
    lambda_d: float = 1.0,
    valid: Tensor | None = None,
) -> GiftLoss:
    """`gift_loss` without its checks, of pairs found beforehand: nothing here waits for the device.

    NaN in, NaN out.
    """
    depth, target = _promote(depth, target)
    consistency = _consistency(depth, pairs)
    distillation = _distillation(depth, target.detach(), _other_region(mask, valid))
    return GiftLoss(lambda_c * consistency + lambda_d * distillation, consistency, distillation, pairs.num_pairs)


def image_terms(depth: Tensor, target: Tensor, mask: Tensor, valid: Tensor | None = None) -> Tensor:
    """(N,2): of each image alone, `masked_l1` to `target` inside its target region, and `self_distillation_loss`.

    Args: as `self_distillation_loss`, without its checks: nothing here waits for the device. A region without a pixel
    gives 0. NaN in, NaN out.
    """
    depth, target = _promote(depth, target)
    target = target.detach()
    inside, other = _target_region(mask, valid), _other_region(mask, valid).flatten(1)
    first = _absolute(depth - target, inside).flatten(1).sum(1) / inside.flatten(1).sum(1).clamp(min=1)
    second = _DistanceToTarget.apply(depth.flatten(1), target.flatten(1), other, other.sum(1))
    return torch.stack([first, 2 * second], 1)


class Pairs(NamedTuple):
    """All of Eq. 2 that target regions alone decide, on the CPU: which pixels count in which pair.

    Args:
        columns (`Tensor`): (K,) int64, the pixels, out of H*W, that at least two regions hold.
        mask (`Tensor`): (N, K) bool, which region holds them.
        count (`Tensor`): (N, N) int64, pixels in each pair's intersection; on the diagonal those of `mask`.
        sizes (`Tensor`): (N,) int64, pixels of each region.
    """

    columns: Tensor
    mask: Tensor
    count: Tensor
    sizes: Tensor

    @classmethod
    def of(cls, mask: Tensor, valid: Tensor | None = None) -> Pairs:
        """Of a group's `mask` (N,H,W) and `valid`, bool."""
        region = _target_region(mask, valid).flatten(1).cpu()
        columns = (region.sum(0) >= 2).nonzero()[:, 0]
        shared = region[:, columns]
        count = torch.zeros(len(region), len(region), dtype=torch.int64)
        for part in shared.split(_block_length(len(region)), dim=1):
            ones = part.float()
            count += (ones @ ones.T).long()  # sums of less than 2**24 ones: exact
        return cls(columns, shared, count, region.sum(1))

    @property
    def num_pairs(self) -> int:
        """Pairs with a non-empty intersection."""
        return int(self.count.triu(1).count_nonzero())

    def pin_memory(self) -> Pairs:
        """The same in pinned memory, from where it travels to a CUDA device while the host goes on."""
        return Pairs(*(part.pin_memory() for part in self))


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
            depth, pairs = _check_group(depth, mask, valid), Pairs.of(mask, valid)
        if pairs.num_pairs == 0:
            self.num_skipped += 1
            return math.nan
        with torch.no_grad():
            value = _consistency(depth, pairs).item()
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


def are_finite(values: Tensor) -> Tensor:
    """(N,) bool: which images of `values` (N,...) hold finite values only."""
    low, high = values.detach().flatten(1).aminmax(dim=1)  # both are NaN if one value is; isfinite would copy them all
    return low.isfinite() & high.isfinite()


def require_finite(values: Tensor, what: str, names: Sequence[str] | None = None) -> None:
    """Raise ValueError naming the first image of `values` (N,...) that holds a NaN or infinite value."""
    name_infinite(are_finite(values).tolist(), what, names)


def name_infinite(finite: Sequence[float], what: str, names: Sequence[str] | None = None) -> None:
    """Raise ValueError naming the first image whose flag is not set."""
    if not all(finite):
        index = [bool(flag) for flag in finite].index(False)
        image = f"image {index}" if names is None else f"{names[index]} (image {index})"
        raise ValueError(f"{what} of {image} has NaN or infinite values")


class _PairwiseL1(torch.autograd.Function):
    """Sum over pairs of the mean absolute difference on each pair's intersection.

    `depth` (N,P). Pixels that fewer than two masks hold are left out; the others are gathered block by block, so that
    beside `gradient` (N,P), which is built with the value, the temporary memory does not depend on N or P.
    """

    @staticmethod
    def forward(ctx, depth: Tensor, pairs: Pairs) -> Tensor:
        def there(part: Tensor) -> Tensor:
            return part.to(depth.device, non_blocking=True)

        count = there(pairs.count)
        weight = torch.where(count > 0, count.to(depth.dtype).reciprocal(), 0)
        columns, mask, length = there(pairs.columns), there(pairs.mask), _block_length(len(depth))
        total = depth.new_zeros(())
        gradient = torch.zeros_like(depth) if depth.requires_grad else None
        for start in range(0, len(columns), length):
            block = slice(start, start + length)
            uniform = bool(pairs.mask[:, block].all())  # the usual case: one mask for the whole group
            part = None if uniform else mask[:, block]
            value, signs = _pair_sums(depth[:, columns[block]], part, weight, gradient is not None)
            total += value
            if gradient is not None and signs is not None:
                gradient[:, columns[block]] = signs
        ctx.save_for_backward(gradient)
        return total

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_total: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * grad_total, None


def _block_length(num_images: int) -> int:
    return max(1, BLOCK_ELEMENTS // num_images)


def _pair_sums(
    depth: Tensor, mask: Tensor | None, weight: Tensor, differentiate: bool
) -> tuple[Tensor, Tensor | None]:
    """The weighted sum over pairs of (N,K) columns, and its gradient (N,K); no `mask` where all hold all of them."""
    total = depth.new_zeros(())
    gradient = torch.zeros_like(depth) if differentiate else None
    for i in range(len(depth) - 1):
        difference = depth[i] - depth[i + 1 :]
        if mask is not None:  # where, not a product: an overflow outside the masks would turn 0 * inf into NaN
            difference = torch.where(mask[i] & mask[i + 1 :], difference, 0)
        if gradient is not None:
            sign = difference.sign()
            gradient[i] += weight[i, i + 1 :] @ sign
            gradient[i + 1 :].addcmul_(sign, weight[i, i + 1 :, None], value=-1)
        total += difference.abs_().sum(1) @ weight[i, i + 1 :]
    return total, gradient


class _DistanceToTarget(torch.autograd.Function):
    """Per image the mean absolute difference to `target` on `region`, 0 where that is empty; all (N,P).

    Image by image in both directions: autograd would keep and make several (N,P) tensors. Differences up to
    `ROUNDING` count as none.
    """

    @staticmethod
    def forward(ctx, depth: Tensor, target: Tensor, region: Tensor, count: Tensor) -> Tensor:
        ctx.save_for_backward(depth, target, region, count)
        sums = [_beyond_rounding(*image).abs_().sum() for image in zip(depth, target, region, strict=True)]
        return torch.stack(sums) / count.clamp(min=1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_output: Tensor) -> tuple[Tensor, None, None, None]:
        depth, target, region, count = ctx.saved_tensors
        gradient = torch.empty_like(depth)
        for i, scale in enumerate(grad_output / count.clamp(min=1)):
            gradient[i] = _beyond_rounding(depth[i], target[i], region[i]).sign_().mul_(scale)
        return gradient, None, None, None


def _beyond_rounding(depth: Tensor, target: Tensor, region: Tensor) -> Tensor:
    """(P,) of one image: the difference on the region, 0 elsewhere and where it is rounding."""
    difference = torch.where(region, depth - target, 0)
    limit = target.abs().amax() * ROUNDING[depth.dtype]
    return difference.masked_fill_(difference.abs() <= limit, 0)


def _consistency(depth: Tensor, pairs: Pairs) -> Tensor:
    """Eq. 3 on checked tensors."""
    return _PairwiseL1.apply(depth.flatten(1), pairs) / max(1, pairs.num_pairs)


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
