"""Metric depth from a depth sensor that is wrong on glass, and a prediction that is right there but has no unit.

1. Where the sensor can be trusted, scale and shift bring the prediction to it, robustly, in the prediction's own
   space (inverse depth to inverse depth).
2. About each hole a local fit, in inverse depth where planes are flat, bends that: the nearer, the more it counts;
   with no news it stays what it was. What it leaves at the border of the hole fades inwards: the spatially smooth
   residual.
3. Holes and target take that; everywhere else the sensor's own value stays.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from gift_peft.rules import KINDS

SAMPLES, HYPOTHESES = 4096, 400  # pixels and pairs of the robust fit; nearly half of the pixels may be wrong
MIN_PIXELS = 50  # to trust; fewer say nothing about a picture
REACH, DECAY = 0.2, 0.06  # of the longer side: how far about a hole a local fit looks, and where its weight is 1/e
PIXELS = 30.0  # that the pixels about a hole count for together: neighbors repeat each other
SCALE_CHANGE, TILT, OFFSET = 0.1, 1.2, 1.0  # expected from a local fit; the last two in spreads of inverse depth
WINDOW = 200  # longest side of the grid on which a local fit works
REGIONS = 24  # the largest holes have a fit of their own, the rest share one
CUT = 4.685  # noises beyond which Tukey's biweight gives no weight; with Gaussian noise it is 95 % efficient
DOUBT = 1.0  # spreads of inverse depth that may be wrong one picture's length away from the nearest trusted pixel
OUTLIER, SMALLEST = 4.0, 0.002  # noises, and share of the picture, of a blob that is rejected where no mask is given
FLAT = 1.6  # ratio of far to near depth below which a scene fixes a factor only
FAR = 4.0  # a filled depth is at most this many times the farthest trusted one
TOLERANCE = 0.05  # of depth: what confidence is about


@dataclass(frozen=True)
class MetricDepth:
    """A picture's depth in the sensor's unit.

    Args:
        depth (`np.ndarray`): (H,W) float32, finite and > 0: the sensor's where it is kept, else the prediction's.
        confidence (`np.ndarray`): (H,W) float32 in 0..1: 1 where the sensor is kept, else the estimated probability
            that the depth is within 5 % of the truth.
        replaced (`np.ndarray`): (H,W) bool, where `depth` is not the sensor's.
        rejected (`np.ndarray`): (H,W) bool, where the sensor had a value that was replaced.
        scale, shift (`float`): of the fit to all trusted pixels, in the prediction's space.
        trusted (`float`): share of the picture that they come from.
        relative_error (`float`): median |fit - sensor| / sensor over the trusted pixels, before local fits.
    """

    depth: np.ndarray
    confidence: np.ndarray
    replaced: np.ndarray
    rejected: np.ndarray
    scale: float
    shift: float
    trusted: float
    relative_error: float


class UnrelatedDepthError(ValueError):
    """The sensor's depth does not follow the prediction."""


def fill_sensor_depth(
    prediction: np.ndarray, sensor: np.ndarray, mask: np.ndarray | None = None, kind: str = "inverse_depth"
) -> MetricDepth:
    """Sensor depth whose holes and target are filled from a prediction that is aligned to the rest of it.

    Args:
        prediction (`np.ndarray`): (H,W), finite, in native units.
        sensor (`np.ndarray`): (H,W) z-depth of the same picture in any unit, metres as a rule; 0, negative and
            non-finite values are holes.
        mask (`np.ndarray`, *optional*): (H,W) bool, the target: all of it is replaced and none of it enters the fit.
            Without it, blobs that the fit rejects are replaced.
        kind (`str`): what the prediction is, `depth` or `inverse_depth`.

    Raises:
        ValueError: shapes that disagree, a prediction that is not finite, an unknown kind, a sensor without values
            (outside the target).
        UnrelatedDepthError: (a ValueError) no increasing fit of the sensor to the prediction.
    """
    prediction, sensor = np.asarray(prediction, np.float64), np.asarray(sensor, np.float64)
    _check(prediction, sensor, mask, kind)
    there = np.isfinite(sensor) & (sensor > 0)
    trusted = there if mask is None else there & ~_grow(mask)
    if np.count_nonzero(trusted) < MIN_PIXELS:
        where = "outside the target" if np.count_nonzero(there) >= MIN_PIXELS else "in the whole picture"
        raise ValueError(f"the sensor has depth at {np.count_nonzero(trusted)} pixels {where}: nothing to align to")
    sensor = np.where(there, sensor, 1.0)
    scale, shift = align_to_sensor(prediction, sensor, trusted, kind)
    farthest = FAR * float(sensor[trusted].max())
    inverse = _inverse_depth(scale * prediction + shift, kind, farthest)
    rejected = np.zeros_like(there)
    if mask is None:
        rejected = _outliers(1 / sensor, inverse, there)
        trusted = there & ~_grow(rejected)
    replaced = ~there | (rejected if mask is None else mask)
    error = float(np.median(np.abs(1 / (inverse[trusted] * sensor[trusted]) - 1)))
    inverse, deviation = _fit_locally(inverse, 1 / sensor, trusted, replaced)
    inverse = np.clip(inverse, 1 / farthest, 1000 * FAR / farthest)
    # Of a Laplace distribution, whose tails are heavy as those of predictions are.
    confidence = -np.expm1(-TOLERANCE * np.sqrt(2) * inverse / np.maximum(deviation, 1e-9 * inverse))
    return MetricDepth(
        np.where(replaced, 1 / inverse, sensor).astype(np.float32),
        np.where(replaced, confidence, 1).astype(np.float32),
        replaced,
        replaced & there,
        scale,
        shift,
        float(np.mean(trusted)),
        error,
    )


def align_to_sensor(prediction: np.ndarray, sensor: np.ndarray, trusted: np.ndarray, kind: str) -> tuple[float, float]:
    """Scale and shift that bring a prediction to metric (inverse) depth, by `robust_line` over the trusted pixels.

    `prediction`, `sensor` (> 0 where `trusted`) and `trusted` are (H,W). In inverse depth differences count as they
    are, in depth relative to the depth.
    """
    pixels = np.flatnonzero(trusted)
    pixels = pixels[np.linspace(0, len(pixels) - 1, min(SAMPLES, len(pixels))).astype(int)]
    x, z = prediction.ravel()[pixels], sensor.ravel()[pixels]
    y, weight = (1 / z, np.ones_like(z)) if kind == "inverse_depth" else (z, 1 / z)
    try:
        return robust_line(x, y, weight)
    except UnrelatedDepthError:
        low, high = np.percentile(z, (5, 95))
        if high > FLAT * low or np.median(x) <= 0:
            raise
        return float(np.median(y) / np.median(x)), 0.0  # a wall seen from the front fixes no more than a factor


def robust_line(x: np.ndarray, y: np.ndarray, weight: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Scale > 0 and shift of y = scale * x + shift, of which nearly half of the points may be anything.

    It starts from the pair of points with the least median of residuals and goes on with Tukey's biweight, whose
    scale is the median of all residuals. `x`, `y`, `weight` are (K,) float64; residuals times `weight` have one noise.
    Raises UnrelatedDepthError where y does not grow with x.
    """
    unrelated = "the sensor's depth does not grow with the predicted depth"
    random = np.random.default_rng(seed)
    first, second = random.integers(0, len(x), (2, 4 * HYPOTHESES))
    span = np.abs(x[second] - x[first])
    rise = np.sign(x[second] - x[first]) * (y[second] - y[first])
    # Points that are close together say little: of the pairs the wider half.
    good = np.flatnonzero((rise > 0) & (span > 0) & (span >= np.median(span)))[:HYPOTHESES]
    if not good.size:
        raise UnrelatedDepthError(unrelated)
    scales = (rise / np.where(span > 0, span, 1))[good]
    shifts = y[first[good]] - scales * x[first[good]]
    medians = [np.median(np.abs(y - a * x - b) * weight) for a, b in zip(scales, shifts, strict=True)]
    best = int(np.argmin(medians))
    line = np.array([scales[best], shifts[best]])
    basis = np.stack([x, np.ones_like(x)], 1)
    for _ in range(30):
        residual = (y - basis @ line) * weight
        noise = 1.4826 * np.median(np.abs(residual))
        if noise <= 1e-12 * np.median(np.abs(y) * weight):
            break  # at least half of the points are on the line
        factor = weight**2 * _biweight(residual / noise)
        line, before = _least_squares(basis, y, factor), line
        if np.allclose(line, before, rtol=1e-9, atol=0):
            break
    if not line[0] > 0:
        raise UnrelatedDepthError(unrelated)
    return float(line[0]), float(line[1])


def _biweight(residual: np.ndarray) -> np.ndarray:
    """Tukey's weights of residuals in standard deviations: 1 for none, 0 from `CUT` on."""
    return np.clip(1 - (residual / CUT) ** 2, 0, None) ** 2


def _least_squares(basis: np.ndarray, y: np.ndarray, weight: np.ndarray) -> np.ndarray:
    root = np.sqrt(weight)
    return np.linalg.lstsq(basis * root[:, None], y * root, rcond=None)[0]


def _inverse_depth(aligned: np.ndarray, kind: str, farthest: float) -> np.ndarray:
    """Aligned (inverse) depth as inverse depth, positive."""
    if kind == "inverse_depth":
        return np.maximum(aligned, 1 / farthest)
    return 1 / np.clip(aligned, farthest / FAR / 1000, farthest)


def _outliers(truth: np.ndarray, fit: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Blobs of sensor pixels far behind the fit (both inverse depth); not single pixels, edges, or a few percent.

    Behind alone, because that is where a sensor looks through glass and into mirrors: what it sees before the fit is
    more likely something that the model has missed.
    """
    behind = fit - truth
    noise = 1.4826 * np.median(np.abs(behind[there]))
    far = (there & (behind > OUTLIER * noise) & (behind > TOLERANCE * fit)).astype(np.uint8)
    size = max(1, round(max(far.shape) / 100)) * 2 + 1
    far = cv2.morphologyEx(far, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    _, label, statistics, _ = cv2.connectedComponentsWithStats(far)
    large = statistics[:, cv2.CC_STAT_AREA] >= SMALLEST * far.size
    large[0] = False
    return large[label]


# ---- about each hole ----


def _fit_locally(
    line: np.ndarray, truth: np.ndarray, trusted: np.ndarray, replaced: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth (H,W) for the replaced pixels, and its estimated standard deviation.

    `line` is the inverse depth of the fit to the whole picture, `truth` that of the sensor, right where `trusted`.
    """
    filled, deviation = line.copy(), np.zeros_like(line)
    spread = max(float(np.std(line[trusted])), 1e-3 * float(np.median(truth[trusted])))
    _, label, statistics, _ = cv2.connectedComponentsWithStats(replaced.astype(np.uint8))
    order = 1 + np.argsort(-statistics[1:, cv2.CC_STAT_AREA], kind="stable")
    side = max(line.shape)
    reach = max(2, round(REACH * side))
    away = DOUBT * spread / side * cv2.distanceTransform((~trusted).astype(np.uint8), cv2.DIST_L2, 3)
    for number in order[:REGIONS]:
        left, top, width, height = statistics[number, :4]
        rows = slice(max(0, top - reach), top + height + reach)
        columns = slice(max(0, left - reach), left + width + reach)
        region = label[rows, columns] == number
        parts = line[rows, columns], truth[rows, columns], trusted[rows, columns]
        values, noise = _fit_region(*parts, region, spread, side)
        filled[rows, columns][region], deviation[rows, columns][region] = values[region], noise
    rest = np.isin(label, order[REGIONS:])
    if rest.any():
        values, noise = _fit_region(line, truth, trusted, rest, spread, side)
        filled[rest], deviation[rest] = values[rest], noise
    return filled, np.hypot(deviation, away)


def _fit_region(
    line: np.ndarray, truth: np.ndarray, trusted: np.ndarray, region: np.ndarray, spread: float, side: int
) -> tuple[np.ndarray, float]:
    """Inverse depth of a window bent to the sensor about one region of it, and the noise of the fit.

    A robust, regularized fit of truth on [line, row, column, 1], weighted by nearness; then its residual faded in.
    """
    step = -(-max(line.shape) // WINDOW)
    at = np.s_[step // 2 :: step, step // 2 :: step]
    y, x, known = truth[at], line[at], trusted[at]
    distance = cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, 3)[at] / side
    about = known & (distance < REACH)
    rows, columns = (grid / side for grid in np.mgrid[: line.shape[0], : line.shape[1]])
    middle = line[region].mean(), rows[region].mean(), columns[region].mean()
    whole = [line - middle[0], rows - middle[1], columns - middle[2], np.ones_like(line)]
    start = np.array([1.0, 0.0, 0.0, middle[0]])
    if np.count_nonzero(about) < 20:
        return line, spread
    basis = np.stack([part[at][about] for part in whole], 1)
    weight = np.exp(-distance[about] / DECAY)
    expected = np.array([SCALE_CHANGE, TILT * spread, TILT * spread, OFFSET * spread])
    found, noise = _ridge(basis, y[about], PIXELS * weight / weight.sum(), start, expected)
    bent = sum(share * part for share, part in zip(found, whole, strict=True))
    residual = np.zeros_like(x)
    residual[about] = np.clip(y[about] - basis @ found, -2 * noise, 2 * noise)
    # What the fit gives no weight is another surface, or glass that the mask has missed: it says nothing of the hole.
    explained = np.zeros_like(known)
    explained[about] = np.abs(y[about] - basis @ found) < CUT * noise
    faded = _fade_in(residual, explained & (distance < DECAY / 2))
    faded = cv2.resize(faded, line.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return bent + faded, noise


def _ridge(
    basis: np.ndarray, y: np.ndarray, weight: np.ndarray, start: np.ndarray, expected: np.ndarray
) -> tuple[np.ndarray, float]:
    """Coefficients near `start` (as far as `expected` lets them), by Tukey's biweight, and the noise they leave.

    Not by Huber's weights, which bound what a wrong value does but not what a wrong prediction does: a few pixels far
    off would turn the fit, wherever a plane beside it explains the others as well.
    """
    found, noise = start, 0.0
    for _ in range(15):
        residual = y - basis @ found
        order = np.argsort(np.abs(residual))
        share = np.cumsum(weight[order])
        half = np.searchsorted(share, share[-1] / 2)  # the weighted median
        noise = max(1.4826 * float(np.abs(residual[order[half]])), 1e-6 * float(np.median(y)))
        factor = weight * _biweight(residual / noise) / noise**2
        matrix = (basis * factor[:, None]).T @ basis + np.diag(1 / expected**2)
        before, found = found, np.linalg.solve(matrix, (basis * factor[:, None]).T @ y + start / expected**2)
        if np.allclose(found, before, rtol=1e-6):
            break
    return found, noise


def _fade_in(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values (h,w) carried smoothly from where they are known to everywhere: averages of ever coarser grids."""
    weight = known.astype(np.float32)
    value = np.where(known, values, 0).astype(np.float32)
    if known.all() or min(values.shape) < 2:
        return np.divide(value, weight, out=np.full_like(value, value.sum() / max(1.0, weight.sum())), where=known)
    total, count = cv2.pyrDown(value), cv2.pyrDown(weight)
    there = count > 1e-6
    mean = np.divide(total, count, out=np.zeros_like(total), where=there)
    coarse = _fade_in(mean, there) if there.any() else mean
    coarse = cv2.pyrUp(coarse, dstsize=values.shape[::-1])
    return np.where(known, value, coarse)


def _grow(mask: np.ndarray) -> np.ndarray:
    """A mask with a margin of half a percent of the picture: sensors mix two surfaces at an edge."""
    size = 2 * max(1, round(max(mask.shape) / 200)) + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)).astype(bool)


def _check(prediction: np.ndarray, sensor: np.ndarray, mask: np.ndarray | None, kind: str) -> None:
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}: choose one of {', '.join(KINDS)}")
    shapes = {"prediction": prediction.shape, "sensor": sensor.shape} | ({} if mask is None else {"mask": mask.shape})
    if prediction.ndim != 2 or len(set(shapes.values())) > 1:
        raise ValueError(f"one (H,W) is expected: {', '.join(f'{name} {shape}' for name, shape in shapes.items())}")
    if mask is not None and mask.dtype != bool:
        raise ValueError(f"mask must be boolean, got {mask.dtype}")
    if not np.isfinite(prediction).all():
        raise ValueError("the prediction has NaN or infinite values")
