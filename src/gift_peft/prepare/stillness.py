"""What differs between two frames of one camera: the light, the scene, or the camera's pose.

Frames are compared as cells, means over squares of about a hundredth of the picture's side: noise and compression
average out, and nothing depends on the size. Gain and offset of each color are fitted away first, by the cells that
agree, so that a lamp that is dimmed or an automatic exposure is no change of the scene.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from gift_peft.prepare.homography import normalize_contrast, transform

CELLS, LEAST_SIDE = 96, 8  # cells along the longer side; pixels of a cell at least, since codecs work in blocks
TRACKED_SIDE = 640  # pixels of the longer side, at which the camera's pose is measured
MIN_CHANGE, MAX_CHANGE = 1.2, 6.0  # grey levels; bounds of what counts as a change from one moment to the next
OTHER_CONTENT = 3.0  # grey levels; moments further apart also differ by what the light does to shadows
NOISES = 1.9  # a change exceeds the noise this many times
POINTS, MIN_POINTS = 300, 12
MIN_AGREEING = 0.3  # share of the tracked points
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


@dataclass(frozen=True)
class Motion:
    """How a camera has moved: `matrix` (3, 3) maps the anchor's pixels to the frame's; `pixels` is the mean length."""

    matrix: np.ndarray
    pixels: float


class Anchor:
    """The frame that others of its pose are compared with.

    Args:
        pixels (`np.ndarray`): (H, W, 3) uint8.
        mask (`np.ndarray`, *optional*): (H, W) bool, the target, where nothing is tracked.
    """

    def __init__(self, pixels: np.ndarray, mask: np.ndarray | None = None) -> None:
        self.size = pixels.shape[1], pixels.shape[0]
        self.scale = min(1.0, TRACKED_SIDE / max(self.size))
        self.usable = np.ones(self._small(pixels).shape, bool)
        if mask is not None:
            around = cv2.dilate(self._small(mask.astype(np.uint8) * 255), np.ones((9, 9), np.uint8))
            self.usable = around == 0
        self.structure = self._structure(pixels)
        points = cv2.goodFeaturesToTrack(
            self.structure, POINTS, 0.01, 8, mask=self.usable.astype(np.uint8), blockSize=5
        )
        self.points = np.empty((0, 1, 2), np.float32) if points is None else points

    def motion(self, pixels: np.ndarray) -> Motion | None:
        """How the camera has moved since, or None if that cannot be seen: too little to track, or another view."""
        if len(self.points) < MIN_POINTS:
            return None
        here = self._structure(pixels)
        found, there, _ = cv2.calcOpticalFlowPyrLK(self.structure, here, self.points, None, winSize=(21, 21))
        back, again, _ = cv2.calcOpticalFlowPyrLK(here, self.structure, found, None, winSize=(21, 21))
        good = (there[:, 0] > 0) & (again[:, 0] > 0) & (np.linalg.norm(back - self.points, axis=2)[:, 0] < 0.5)
        start, end = self.points[good, 0], found[good, 0]
        if len(start) < MIN_POINTS:
            return None
        matrix, agreeing = cv2.estimateAffinePartial2D(
            start, end, method=cv2.RANSAC, ransacReprojThreshold=0.5, maxIters=2000, confidence=0.999
        )
        if matrix is None or agreeing.sum() < max(MIN_POINTS, MIN_AGREEING * len(start)):
            return None
        return self._whole(np.vstack([matrix, [0, 0, 1]]))

    def _whole(self, matrix: np.ndarray) -> Motion:
        """In pixels of the frame."""
        shrink = np.array([[self.scale, 0, (self.scale - 1) / 2], [0, self.scale, (self.scale - 1) / 2], [0, 0, 1]])
        matrix = np.linalg.inv(shrink) @ matrix @ shrink
        x, y = np.meshgrid(*(np.linspace(0, side - 1, 5) for side in self.size))
        grid = np.stack([x.ravel(), y.ravel()], 1)
        return Motion(matrix, float(np.linalg.norm(transform(matrix, grid) - grid, axis=1).mean()))

    def _small(self, picture: np.ndarray) -> np.ndarray:
        gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
        size = tuple(max(1, round(side * self.scale)) for side in self.size)
        return gray if size == self.size else cv2.resize(gray, size, interpolation=cv2.INTER_AREA)

    def _structure(self, pixels: np.ndarray) -> np.ndarray:
        """(h, w) uint8 with the brightness of each neighborhood taken out, for tracking."""
        contrast = normalize_contrast(self._small(pixels), np.ones(self.usable.shape, bool))
        return np.clip(contrast * 40 + 128, 0, 255).astype(np.uint8)


def detail_of(pixels: np.ndarray) -> float:
    """How much fine detail (H, W, 3) uint8 has, for comparisons within one scene: it falls when a lens defocuses."""
    gray = cv2.GaussianBlur(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), (5, 5), 1.0)  # else noise counts as detail
    return float(cv2.Laplacian(gray, cv2.CV_16S).std())
