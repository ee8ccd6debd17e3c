"""What differs between two frames of one camera: the light, or the scene; `camera_motion.py` has the camera's pose.

Frames are compared as cells, means over squares of about a hundredth of the picture's side: noise and compression
average out, and nothing depends on the size. Gain and offset of each color are fitted away first, by the cells that
agree, so that a lamp that is dimmed or an automatic exposure is no change of the scene.
"""

import cv2
import numpy as np

CELLS, LEAST_SIDE = 96, 8  # cells along the longer side; pixels of a cell at least, since codecs work in blocks
MIN_CHANGE, MAX_CHANGE = 1.2, 6.0  # grey levels; bounds of what counts as a change from one moment to the next
OTHER_CONTENT = 3.0  # grey levels; moments further apart also differ by what the light does to shadows
NOISES = 1.9  # a change exceeds the noise this many times
ONE_GAIN = 0.06  # of the logarithm; gains that differ by less are one
STRUCTURE_CHANGED = 0.6  # share of the cells that changed, above which it is another view


def cells_of(pixels: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 means over squares of (H, W, 3) uint8; a rest at the right and lower border is left out."""
    height, width = pixels.shape[:2]
    side = max(LEAST_SIDE, round(max(height, width) / CELLS))
    rows, columns = max(1, height // side), max(1, width // side)
    whole = np.ascontiguousarray(pixels[: rows * side, : columns * side])
    return cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float32)


def cells_inside(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of (H, W) bool, the cells (h, w) that lie mostly inside, and those that do not touch it or its neighborhood."""
    share = cells_of(np.dstack([mask.astype(np.uint8) * 255] * 3))[..., 0] / 255
    inside = share > min(0.5, 0.99 * float(share.max()))
    return inside, cv2.dilate((share > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0


def same_light(cells: np.ndarray, goal: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
    """The cells in the light of `goal`, both (h, w, 3): each color's gain and offset, by robust least squares.

    Cells of `region` (h, w) bool count, default all. What differs most has the least weight, so that a part of the
    picture that shows something else does not pull.
    """
    chosen = slice(None) if region is None or region.sum() < 30 else region
    here, there = cells[chosen].reshape(-1, 3), goal[chosen].reshape(-1, 3)
    result = np.empty_like(cells)
    for color in range(3):
        x, y = here[:, color], there[:, color]
        usable = (x > 4) & (x < 248) & (y > 4) & (y < 248)
        gain, offset = 1.0, 0.0
        if usable.sum() >= 30:
            x, y = x[usable], y[usable]
            gain = float(np.clip(np.median(y / x), 0.25, 4.0))
            for _ in range(4):
                residual = np.abs(gain * x + offset - y)
                weight = 1 / (1 + (residual / (1.5 * float(np.median(residual)) + 0.3)) ** 2)
                total = weight.sum()
                mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
                spread = (weight * (x - mean_x) ** 2).sum() / total
                if spread > 25:  # else there is no contrast to see a gain by
                    slope = (weight * (x - mean_x) * (y - mean_y)).sum() / total / spread
                    gain = float(np.clip(slope, 0.25, 4.0))
                offset = float(mean_y - gain * mean_x)
        result[..., color] = np.clip(gain * cells[..., color] + offset, 0, 255)
    return result


def light_gain(cells: np.ndarray, goal: np.ndarray, region: np.ndarray | None = None) -> float:
    """What the brightness of `cells` is multiplied by to give that of `goal`, both (h, w, 3), as most cells agree.

    Cells that show something else have any gain, and a change of the light is one gain for all the others.
    """
    chosen = slice(None) if region is None or region.sum() < 30 else region
    here, there = cells[chosen].ravel(), goal[chosen].ravel()
    usable = (here > 8) & (here < 245) & (there > 8) & (there < 245)
    if usable.sum() < 30:
        return 1.0
    gains = np.sort(np.log(there[usable] / here[usable]))
    ends = np.searchsorted(gains, gains + ONE_GAIN, side="right")
    first = int(np.argmax(ends - np.arange(len(gains))))
    return float(np.exp(np.median(gains[first : ends[first]])))


def difference(cells: np.ndarray, goal: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
    """(h, w) grey levels by which each cell and its neighbors differ, in the color that differs most, the light apart.

    `region` (h, w) bool is where the light is measured.
    """
    signed = cv2.blur(same_light(cells, goal, region) - goal, (3, 3), borderType=cv2.BORDER_REPLICATE)
    return np.abs(signed).max(axis=2)


def noise_of(differences: np.ndarray) -> float:
    """What 99 of 100 cells stay below, in grey levels, of differences (h, w) that are noise.

    Not the median: a codec changes few cells much and most of them little.
    """
    return float(np.quantile(differences, 0.99))


def change_above(noise: float, least: float = MIN_CHANGE) -> float:
    """Grey levels above which a cell has changed, where this is the noise; `least` is what counts at all."""
    return float(np.clip(NOISES * noise, least, max(least, MAX_CHANGE)))


def detail_of(pixels: np.ndarray) -> float:
    """How much fine detail (H, W, 3) uint8 has, for comparisons within one scene: it falls when a lens defocuses."""
    gray = cv2.GaussianBlur(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), (5, 5), 1.0)  # else noise counts as detail
    return float(cv2.Laplacian(gray, cv2.CV_16S).std())
