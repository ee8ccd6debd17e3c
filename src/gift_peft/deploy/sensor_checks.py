"""What can be wrong with a sensor's depth before anything is fitted: its unit, and its registration to the photo."""

import cv2
import numpy as np

from gift_peft.deploy.sensor import UnrelatedDepthError

NEAR, FAR = 0.02, 80.0  # metres between which the median depth of a scene lies
GRID = 96  # longer side of the maps that are moved over each other
MOVES = 0.12  # of the longer side: how far they are moved
TREND = 0.08  # of the longer side: what is smoother does not say where a map lies
ALIKE, CLEARER = 0.5, 0.2  # correlation at the best place, and how much more it is than where the depth lies


def check_range(depth: np.ndarray, name: str, unit: str) -> None:
    """ValueError, naming the file, for depth (H,W) in metres without a value, or that can only be in another unit.

    `unit` is how the message calls what the file was taken for.
    """
    there = np.isfinite(depth) & (depth > 0)
    if not there.any():
        raise ValueError(f"{name}: no depth at all, every pixel is 0 or not finite; is the sensor on and in range?")
    median = float(np.median(depth[there]))
    if not NEAR <= median <= FAR:
        other = "metres" if median < NEAR else "millimetres"
        raise ValueError(
            f"{name}: taken as {unit}, its median depth is {median:.3g} m; if the values are {other}, say "
            f"--sensor-unit {'m' if other == 'metres' else 'mm'}"
        )


def check_registration(prediction: np.ndarray, sensor: np.ndarray, trusted: np.ndarray, kind: str) -> None:
    """UnrelatedDepthError where the sensor's depth would fit the prediction much better somewhere else.

    Both are reduced, and one is moved over the other: where they belong together, the best place is near where they
    lie. `prediction`, `sensor` (metres) and `trusted` are (H,W).
    """
    shape = sensor.shape
    factor = min(1.0, GRID / max(shape))
    size = max(8, round(shape[1] * factor)), max(8, round(shape[0] * factor))
    weight = cv2.resize(trusted.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    value = np.where(trusted, 1 / np.where(trusted, sensor, 1), 0).astype(np.float32)
    value = cv2.resize(value, size, interpolation=cv2.INTER_AREA) / np.maximum(weight, 1e-6)
    guess = cv2.resize(prediction.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    if kind == "depth":
        guess = 1 / np.maximum(guess, 1e-3 * np.median(np.abs(guess)))
    known = (weight > 0.5).astype(np.float32)
    value, guess = _without_trend(value, known), _without_trend(guess, np.ones_like(known))
    reach = max(2, round(MOVES * max(size)))
    # The same pixels of the sensor at every place, so that places can be compared.
    inner = np.zeros_like(known)
    inner[reach:-reach, reach:-reach] = known[reach:-reach, reach:-reach]
    rows, columns = np.nonzero(inner)
    if len(rows) < 100:
        return
    y = value[rows, columns] - value[rows, columns].mean()
    alike = np.zeros((2 * reach + 1, 2 * reach + 1))
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            x = guess[rows + down, columns + right]
            x = x - x.mean()
            alike[down + reach, right + reach] = (x @ y) / max(float(np.sqrt((x @ x) * (y @ y))), 1e-12)
    down, right = np.unravel_index(np.argmax(alike), alike.shape) - np.array(reach)
    best, here = alike.max(), alike[reach, reach]
    inside = max(abs(down), abs(right)) < reach  # at the rim it may only be a slope that goes on
    if inside and np.hypot(down, right) >= max(2.0, 0.02 * max(size)) and best > ALIKE and best > here + CLEARER:
        step = max(shape) / max(size)
        raise UnrelatedDepthError(
            f"it fits the photo much better moved by {round(right * step)} pixels to the right and "
            f"{round(down * step)} down: it is not registered to the photo's camera (align depth to color first)"
        )


def _without_trend(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """What is left where a blurred copy is taken off: edges, which say where a map lies."""
    blurred, weight = (cv2.GaussianBlur(part, (0, 0), TREND * max(values.shape)) for part in (values * known, known))
    return values - blurred / np.maximum(weight, 1e-6)
