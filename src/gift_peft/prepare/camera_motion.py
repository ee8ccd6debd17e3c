"""By how much a camera was moved between two frames, to a tenth of a pixel, whatever else has changed in them.

Direct alignment in place of tracked corners, which soft and noisy frames hardly have: Gauss-Newton over all pixels, on
brightness freed of local mean and contrast. Residuals are judged by tiles, and tiles that show something else than the
rest agrees on lose their weight, so that a target that changes does not pull, known or not. Of several starts that one
wins whose motion explains most of the picture, so that a mirror over half of it neither hides a motion nor makes one.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from gift_peft.prepare.homography import normalize_contrast, transform

SIDE = 640  # pixels of the longer side, at which it is measured
TILES = 16  # along the longer side
COARSE, STEPS = 4, 12  # first at a quarter of the resolution; Gauss-Newton steps at most at each
LEAST_SIDE = 16  # pixels of the shorter side at the coarse resolution
MAX_STEP, SETTLED = 4.0, 0.01  # pixels at that resolution
EXPLAINED = 0.15  # share of the structure that a motion explains; what comes of another scene stays below
CLEARLY = 0.5  # from which no other start is tried
SURE = 3.0  # times its own expected error, by which a motion exceeds 0
STILL_PRIOR = 1e-4  # of the whole gradient energy: directions in which nothing can be seen stay at 0
PEAKS, STARTS = 8, 2  # of the phase correlation that are looked at, and that are starts
PEAK_WIDTH = 1.2  # pixels by which a small turn or zoom smears a peak


@dataclass(frozen=True)
class Motion:
    """How a camera has moved.

    Args:
        matrix (`np.ndarray`): (3, 3), the anchor's pixels to the frame's.
        pixels (`float`): mean length of the motion over the picture.
        error (`float`): its expected error.
    """

    matrix: np.ndarray
    pixels: float
    error: float


@dataclass(frozen=True)
class _Fit:
    shift: np.ndarray  # (4,): right, down, and what the picture's longer half-side adds to them by zoom and by turn
    covariance: np.ndarray
    explained: float


def _explained(fit: _Fit) -> float:
    return fit.explained


class _Level:
    """The anchor's structure at one resolution."""

    def __init__(self, image: np.ndarray, usable: np.ndarray) -> None:
        self.image, self.usable = image, usable
        height, width = image.shape
        larger = max(height, width)
        self.half = larger / 2
        self.tiles = max(1, round(TILES * width / larger)), max(1, round(TILES * height / larger))
        x = (np.arange(self.tiles[0]) + 0.5) * width / self.tiles[0] - width / 2
        y = (np.arange(self.tiles[1]) + 0.5) * height / self.tiles[1] - height / 2
        x, y = (side.ravel() / self.half for side in np.meshgrid(x, y))
        one, none = np.ones_like(x), np.zeros_like(x)
        self.geometry = np.array([[one, none, x, -y], [none, one, y, x]]).transpose(2, 0, 1)  # (tiles, 2, 4)

    def matrix(self, shift: np.ndarray) -> np.ndarray:
        """(2, 3), this level's pixels to the frame's, of a motion in pixels of this level."""
        height, width = self.image.shape
        zoom, turn = shift[2] / self.half, shift[3] / self.half
        linear = np.array([[1 + zoom, -turn], [turn, 1 + zoom]])
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        return np.column_stack([linear, middle + shift[:2] - linear @ middle])

    def fit(self, there: np.ndarray, shift: np.ndarray, steps: int) -> _Fit:
        """The motion to the frame's structure `there`: of those on the way from `shift`, what explains most."""
        best = None
        for _ in range(steps):
            found, step = self._look(there, shift)
            if best is None or found.explained > best.explained:
                best = found
            if np.abs(step).max() < SETTLED:
                break
            shift = shift + np.clip(step, -MAX_STEP, MAX_STEP)
        return best

    def _look(self, there: np.ndarray, shift: np.ndarray) -> tuple[_Fit, np.ndarray]:
        """What is to be said of a motion, and the step to a better one."""
        gradients, pulls, weights, correlation, overlap = self._tiles(there, shift)
        normal = np.einsum("t,tji,tjk,tkl->il", weights, self.geometry, gradients, self.geometry)
        normal += (STILL_PRIOR * np.trace(gradients.sum(axis=0)) + 1e-9) * np.eye(4)
        # Its error by how the tiles disagree, not by the residuals' variance: neighboring residuals are alike.
        scores = np.einsum("t,tji,tj->ti", weights, self.geometry, pulls)
        inverse = np.linalg.inv(normal)
        energy = gradients[:, 0, 0] + gradients[:, 1, 1]
        explained = overlap * float((energy * np.square(np.clip(correlation, 0, 1))).sum() / max(energy.sum(), 1e-9))
        return _Fit(shift, inverse @ (scores.T @ scores) @ inverse, explained), inverse @ scores.sum(axis=0)

    def _tiles(self, there: np.ndarray, shift: np.ndarray):
        """Of each tile: gradients' products (2, 2), what pulls at the motion (2,), its weight, its correlation; and
        the share of the anchor that the frame shows.
        """
        size, matrix, flags = self.image.shape[::-1], self.matrix(shift), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        frame = cv2.warpAffine(there, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        counts = self.usable * cv2.warpAffine(np.ones_like(there), matrix, size, flags=flags)
        middle = (self.image + frame) * 0.5
        gx, gy = (cv2.Sobel(middle, cv2.CV_32F, dx, dy, scale=1 / 8) * counts for dx, dy in ((1, 0), (0, 1)))
        apart = (self.image - frame) * counts
        xx, xy, yy, gx_apart, gy_apart, residual = map(
            self._mean, (gx * gx, gx * gy, gy * gy, gx * apart, gy * apart, apart * apart)
        )
        here, moved = self.image * counts, frame * counts
        both, own, others = map(self._mean, (here * moved, here * here, moved * moved))
        gradients = np.array([[xx, xy], [xy, yy]]).transpose(2, 0, 1)
        energy = xx + yy
        mismatch = residual / (energy + 1e-6)  # as square pixels
        usual = weighted_quantile(mismatch, energy, 0.3)
        weights = 1 / np.square(1 + mismatch / (2 * usual + 1e-6))
        overlap = float(counts.sum()) / max(float(self.usable.sum()), 1.0)
        return gradients, np.stack([gx_apart, gy_apart], 1), weights, both / np.sqrt(own * others + 1e-9), overlap

    def _mean(self, image: np.ndarray) -> np.ndarray:
        return cv2.resize(image, self.tiles, interpolation=cv2.INTER_AREA).ravel().astype(np.float64)


class Anchor:
    """The frame that others of its pose are compared with.

    Args:
        pixels (`np.ndarray`): (H, W, 3) or (H, W) uint8.
        mask (`np.ndarray`, *optional*): (H, W) bool, the target, where nothing counts.
    """

    def __init__(self, pixels: np.ndarray, mask: np.ndarray | None = None) -> None:
        self.size = pixels.shape[1], pixels.shape[0]
        self.scale = min(1.0, SIDE / max(self.size))
        small = self._small(pixels)
        usable = np.ones(small.shape, bool)
        if mask is not None:
            around = cv2.dilate(self._small(mask.astype(np.uint8) * 255), np.ones((9, 9), np.uint8))
            usable = around == 0
        fine, usable = _structure(small), usable.astype(np.float32)
        self.levels = [_Level(_quarter(fine), (_quarter(usable) > 0.99).astype(np.float32)), _Level(fine, usable)]

    def motion(self, pixels: np.ndarray) -> Motion | None:
        """How the camera has moved, or None if that cannot be seen: too little structure, or another view."""
        if min(self.levels[0].image.shape) < LEAST_SIDE:
            return None
        there = _structure(self._small(pixels))
        coarse, fine = self.levels
        near = _quarter(there)
        roughly = coarse.fit(near, np.zeros(4), STEPS).shift * COARSE
        starts = [roughly, np.zeros(4)] if np.abs(roughly).max() > 1 else [roughly]
        fit = max((fine.fit(there, start, STEPS) for start in starts), key=_explained)
        if fit.explained < CLEARLY:  # a large motion, or a large target
            others = [start for start in self._starts(there) if 2 * start.explained > fit.explained]
            fit = max([fit, *(fine.fit(there, start.shift, STEPS) for start in others)], key=_explained)
        if not np.isfinite(fit.shift).all() or fit.explained < EXPLAINED:
            return None
        return self._whole(fit)

    def _starts(self, there: np.ndarray) -> list[_Fit]:
        """Shifts of which there is a sign, the best first.

        A target that shows something else can have a stronger peak than the camera's motion, so several are tried, and
        at the fine resolution, where chance has weaker peaks.
        """
        fine = self.levels[1]
        window = np.outer(*(_taper(side) for side in there.shape))
        product = np.conj(np.fft.rfft2(fine.image * fine.usable * window)) * np.fft.rfft2(there * window)
        peaks = np.fft.irfft2(product / (np.abs(product) + 1e-9), there.shape).astype(np.float32)
        peaks = cv2.GaussianBlur(np.fft.fftshift(peaks), (0, 0), PEAK_WIDTH)
        shifts = []
        for _ in range(PEAKS):
            y, x = np.unravel_index(int(np.argmax(peaks)), peaks.shape)
            peaks[max(y - COARSE, 0) : y + COARSE + 1, max(x - COARSE, 0) : x + COARSE + 1] = -np.inf
            shifts.append(np.array([x - there.shape[1] // 2, y - there.shape[0] // 2, 0, 0], float))
        return sorted((fine.fit(there, shift, 1) for shift in shifts), key=_explained, reverse=True)[:STARTS]

    def _whole(self, fit: _Fit) -> Motion:
        """In pixels of the frame."""
        matrix = np.vstack([self.levels[1].matrix(fit.shift), [0, 0, 1]])
        shrink = np.array([[self.scale, 0, (self.scale - 1) / 2], [0, self.scale, (self.scale - 1) / 2], [0, 0, 1]])
        matrix = np.linalg.inv(shrink) @ matrix @ shrink
        x, y = np.meshgrid(*(np.linspace(0, side - 1, 5) for side in self.size))
        grid = np.stack([x.ravel(), y.ravel()], 1)
        pixels = float(np.linalg.norm(transform(matrix, grid) - grid, axis=1).mean())
        return Motion(matrix, pixels, float(np.sqrt(np.trace(fit.covariance))) / self.scale)

    def _small(self, picture: np.ndarray) -> np.ndarray:
        gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
        size = tuple(max(1, round(side * self.scale)) for side in self.size)
        return gray if size == self.size else cv2.resize(gray, size, interpolation=cv2.INTER_AREA)


def _structure(gray: np.ndarray) -> np.ndarray:
    # With the target: what it shows is another motion at most, and its mask's edge would not move with the camera.
    return normalize_contrast(gray, np.ones(gray.shape, bool))


def _taper(count: int) -> np.ndarray:
    """(count,) 1, and less in the outer eighths: what lies around a large target must count."""
    return np.minimum(1, (0.5 + np.minimum(np.arange(count), np.arange(count)[::-1])) * 8 / count).astype(np.float32)


def _quarter(image: np.ndarray) -> np.ndarray:
    size = max(1, image.shape[1] // COARSE), max(1, image.shape[0] // COARSE)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def weighted_quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """The value below which this share of the weights lies."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][min(np.searchsorted(total, share * total[-1]), len(values) - 1)])
