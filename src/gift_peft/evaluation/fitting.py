"""Scale and shift of flat float64 arrays under the losses that a `Protocol` names.

Least squares is a closed form on centred data. The weighted L1 fit is exact: for one scale the best shift is a
weighted median, what is left is convex in the scale and is bisected by its subgradient.
"""

import numpy as np

SUBSAMPLE = 64  # MoGe's grid for L1 fits: bounds their cost whatever the picture's size


class DegenerateFitError(ValueError):
    """No scale and shift exist, as for fewer than two distinct values."""


def fit(prediction: np.ndarray, target: np.ndarray, loss: str) -> tuple[float, float]:
    """Scale and shift that bring `prediction` to `target`, both (K,) float64.

    `loss` is `l2`, or `l1_rel`, which takes target > 0. Raises DegenerateFitError for fewer than two distinct
    predictions.
    """
    tiny = np.finfo(np.float64).tiny / np.finfo(np.float64).eps  # below it, differences are subnormal noise
    if not prediction.size or np.ptp(prediction) < tiny:
        raise DegenerateFitError(
            "cannot fit scale and shift: the prediction has fewer than two distinct values in the "
            f"{prediction.size} pixels of the fit"
        )
    return _fit_l1(prediction, target, 1 / target) if loss == "l1_rel" else _fit_l2(prediction, target)


def _fit_l2(prediction: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None) -> tuple[float, float]:
    """Least squares, weighted if `weight` (K,) is given."""
    # Centred and divided by the spread, so that the normal equations lose no digits to a large offset or tiny units.
    spread = float(np.ptp(prediction))
    mean, target_mean = np.average(prediction, weights=weight), np.average(target, weights=weight)
    centred = (prediction - mean) / spread
    weighted = centred if weight is None else centred * weight
    scale = float(weighted @ (target - target_mean) / (weighted @ centred)) / spread
    return scale, float(target_mean - scale * mean)


def _fit_l1(prediction: np.ndarray, target: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """argmin of sum weight |s d + t - y|, exactly."""
    mean, spread = prediction.mean(), float(np.ptp(prediction))
    centred = (prediction - mean) / spread
    slope = _l1_slope(centred, target, weight)
    shift = _weighted_median(target - slope * centred, weight)
    return slope / spread, shift - slope / spread * mean


def _l1_slope(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> float:
    """The slope of the best line; x has a spread of 1."""
    slope, _ = _fit_l2(x, y, weight)
    side = _slope_side(slope, x, y, weight)
    if side == 0:
        return slope
    step = max(abs(slope), float(np.ptp(y))) * side
    low = slope  # the best slope lies between `low` and `high`, in either order
    while _slope_side(low + step, x, y, weight) == side:
        low, step = low + step, 2 * step
    high = low + step
    while True:
        slope = (low + high) / 2
        if slope in (low, high):
            return slope
        found = _slope_side(slope, x, y, weight)
        if found == 0:
            return slope
        low, high = (slope, high) if found == side else (low, slope)


def _slope_side(slope: float, x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> int:
    """Where the best slope lies: 1 above, -1 below, 0 here.

    By the subgradient of min over t of sum w |y - s x - t|. Residuals equal to their median count with any sign
    between -1 and 1 that balances the others, which leaves a range of subgradients.
    """
    residual = y - slope * x
    offset = residual - _weighted_median(residual, weight)
    sign = np.sign(offset)
    pull = float((weight * sign) @ x)  # minus the derivative, before those on the line have their say
    on_line = np.flatnonzero(offset == 0)
    on_line = on_line[np.argsort(x[on_line])]
    capacity = weight[on_line]
    # Their signed weights sum to minus the rest's; the most negative ones go to the smallest x for the largest pull.
    total = min(max(-float(weight @ sign), -capacity.sum()), capacity.sum())
    pulls = [pull + float(_fill(order, capacity, total) @ x[on_line]) for order in (1, -1)]
    if min(pulls) > 0:
        return 1
    return -1 if max(pulls) < 0 else 0


def _fill(order: int, capacity: np.ndarray, total: float) -> np.ndarray:
    """Values in [-capacity, capacity] of a given sum, as large as can be at the end (or, for -1, at the start)."""
    ordered = capacity[::order]
    above = np.concatenate([np.cumsum(ordered[::-1])[::-1][1:], [0.0]])  # capacity of those to be filled first
    room = total + capacity.sum()  # to hand out over -capacity, up to twice the capacity each
    return (np.clip(room - 2 * above, 0, 2 * ordered) - ordered)[::order]


def _weighted_median(values: np.ndarray, weight: np.ndarray) -> float:
    """The lower weighted median: the smallest value with at least half of the weight at or below it."""
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(cumulative, cumulative[-1] / 2)]])


def nearest_to_grid(mask: np.ndarray, cells: int = SUBSAMPLE) -> np.ndarray:
    """(H,W) bool, of which only the pixel nearest to the centre of each cell of a `cells` x `cells` grid is left.

    MoGe's subsample for L1 fits; a mask of no more than `cells` rows and columns comes back as it is.
    """
    rows, columns = np.nonzero(mask)
    height, width = (min(cells, side) for side in mask.shape)
    y, x = (rows + 0.5) * height / mask.shape[0], (columns + 0.5) * width / mask.shape[1]
    cell = np.floor(y).astype(np.int64) * width + np.floor(x).astype(np.int64)
    distance = (y % 1 - 0.5) ** 2 + (x % 1 - 0.5) ** 2
    order = np.lexsort((distance, cell))
    _, first = np.unique(cell[order], return_index=True)
    kept = np.zeros_like(mask)
    kept[rows[order[first]], columns[order[first]]] = True
    return kept
