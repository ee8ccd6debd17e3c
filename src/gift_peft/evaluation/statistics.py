"""How far a mean can be trusted: medians, and bootstrap intervals over groups.

Observations of one group share scene, pose and target, so that they are no independent samples; groups are. Whole
groups are drawn with replacement, base and adapted together, and the table's own mean is taken of every draw.
"""

import math

import numpy as np

RESAMPLES = 2000
LEVEL = 0.95

Interval = tuple[float, float]
UNKNOWN: Interval = (math.nan, math.nan)


class GroupBootstrap:
    """Percentile bootstrap of an evaluation's means.

    Args:
        rows (`list[dict]`): the rows of a report, one per image, with `group_id` and the metrics of its models.
        seed (`int`): of the draws; the same rows give the same intervals.
    """

    def __init__(self, rows: list[dict], seed: int = 0) -> None:
        # Sorted: neither the order of the rows nor that of the groups matters.
        self.rows = sorted(rows, key=lambda row: (row["group_id"], row["image"]))
        names = sorted({row["group_id"] for row in rows})
        self.index = {name: number for number, name in enumerate(names)}
        self.draws = _draws(len(names), seed)

    def interval(self, model: str, region: str, metric: str) -> Interval:
        """95 % interval of the mean of one model; NaN where fewer than two groups have a value."""
        return _percentiles(self._means(model, region, metric))

    def change_interval(self, region: str, metric: str) -> Interval:
        """95 % interval of the relative change from base to adapted, in percent; both from the same draws."""
        base, adapted = (self._means(model, region, metric) for model in ("base", "adapted"))
        with np.errstate(divide="ignore", invalid="ignore"):
            return _percentiles(100 * (adapted - base) / np.abs(base))

    def _means(self, model: str, region: str, metric: str) -> np.ndarray:
        """The mean of every draw: sums over counts, both additive over groups."""
        sums, counts = np.zeros((2, len(self.index)))
        for row in self.rows:
            value = value_of(row, model, region, metric)
            if not math.isnan(value):
                sums[self.index[row["group_id"]]] += value
                counts[self.index[row["group_id"]]] += 1
        if np.count_nonzero(counts) < 2:
            return np.full(RESAMPLES, math.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            return (self.draws @ sums) / (self.draws @ counts)


def mean_interval(values: list[float], seed: int = 0) -> Interval:
    """95 % interval of a plain mean over groups, such as GCE; NaN for fewer than two values."""
    if len(values) < 2:
        return UNKNOWN
    return _percentiles(_draws(len(values), seed) @ np.sort(values) / len(values))


def median_of(rows: list[dict], model: str, region: str, metric: str) -> float:
    """The median over images of each image's own metric; NaN if no image has one."""
    values = [value for row in rows if not math.isnan(value := value_of(row, model, region, metric))]
    return float(np.median(values)) if values else math.nan


def value_of(row: dict, model: str, region: str, metric: str) -> float:
    """A metric of one row; NaN for what a saved report holds as null."""
    value = row[model][region][metric]
    return math.nan if value is None else value


def _draws(groups: int, seed: int) -> np.ndarray:
    """(RESAMPLES, groups) how often each group is drawn; every row sums to `groups`."""
    if not groups:
        return np.zeros((RESAMPLES, 0))
    return np.random.default_rng(seed).multinomial(groups, np.full(groups, 1 / groups), RESAMPLES).astype(float)


def _percentiles(values: np.ndarray) -> Interval:
    """Of the draws that have a value at all."""
    values = values[np.isfinite(values)]
    if not values.size:
        return UNKNOWN
    low, high = np.percentile(values, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    return float(low), float(high)
