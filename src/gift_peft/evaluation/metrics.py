"""MAE, AbsRel, RMSE and delta1 of one region of an aligned prediction (GIFT paper, Tables 1 and 2).

Per image: mean |d-y|, mean |d-y|/y, sqrt(mean (d-y)^2), and the percentage with max(d/y, y/d) < 1.25. Challenges that
rank by a stricter factor ask for further thresholds.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gift_peft.evaluation.alignment import check_mask, check_shapes, known, like, to_numpy
from gift_peft.evaluation.protocols import METRICS, metric_names

__all__ = ["METRICS", "depth_metrics", "metric_names"]


def depth_metrics(aligned: Any, reference: Any, region: Any, thresholds: Sequence[float] = ()) -> dict[str, Any]:
    """Metrics over `region`, where the reference is finite and > 0.

    A value <= 0 never counts as inside delta1 (the ratio of two negatives would pass the test). An empty region gives
    NaN, never 0.

    Args:
        aligned (`np.ndarray` or `torch.Tensor`): (H,W) or (B,H,W), from `align`.
        reference: same shape and unit.
        region: same shape, bool.
        thresholds: factors of further deltas beside 1.25, such as (1.05, 1.10).

    Returns:
        `dict`: `mae` and `rmse` in the reference's unit, `abs_rel`, `delta1` (and `delta_1.05`, ...) in percent;
        floats for (H,W), float64 (B,) arrays or tensors for (B,H,W).

    Raises:
        ValueError: disagreeing shapes, a region that is not bool, NaN or infinity in the region.
    """
    values, references = to_numpy(aligned, np.float64), to_numpy(reference, np.float64)
    regions = check_mask("region", region)
    check_shapes(aligned=values, reference=references, region=regions)
    if values.ndim == 2:
        return _image_metrics(values, references, regions, thresholds)
    rows = [_image_metrics(*image, thresholds) for image in zip(values, references, regions, strict=True)]
    names = metric_names(thresholds)
    return {name: like(np.array([row[name] for row in rows], dtype=np.float64), aligned) for name in names}


def _image_metrics(
    aligned: np.ndarray, reference: np.ndarray, region: np.ndarray, thresholds: Sequence[float]
) -> dict[str, float]:
    region = region & known(reference)
    d, y = aligned[region], reference[region]
    if not d.size:
        return dict.fromkeys(metric_names(thresholds), float("nan"))
    bad = np.count_nonzero(~np.isfinite(d))
    if bad:
        raise ValueError(f"aligned has {bad} NaN or infinite values in the region")
    error = np.abs(d - y)
    positive = d > 0
    with np.errstate(over="ignore"):
        ratio = np.maximum(d[positive] / y[positive], y[positive] / d[positive])
    within = [100 * float(np.count_nonzero(ratio < threshold)) / d.size for threshold in (1.25, *thresholds)]
    errors = [float(error.mean()), float((error / y).mean()), float(np.sqrt((error**2).mean()))]
    return dict(zip(metric_names(thresholds), [*errors, *within], strict=True))
