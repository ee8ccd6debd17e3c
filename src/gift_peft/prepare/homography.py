"""Homographies fitted by least squares, to matched points or to the pixels themselves, with their expected error.

Both fits are robust Gauss-Newton over the same eight parameters, in coordinates that are centred and scaled by the
frame, so one covariance tells how far off the fitted map may be at any place, the target's corners for one.
"""

from dataclasses import dataclass

import cv2
import numpy as np

MAX_PIXELS = 40_000  # of a picture that take part in a fit; more make it slower, not more exact
MIN_PIXELS = 300
MAX_STEPS = 25
SETTLED = 0.005  # pixels
GROSS = 2.0  # pixels, the paper's reprojection threshold
TUKEY = 4.685  # in standard deviations: 95 % efficient on Gaussian residuals, and ignores what lies far beyond


@dataclass(frozen=True)
class Fit:
    """A fitted homography.

    Args:
        matrix (`np.ndarray`): (3, 3) float64, fixed to moving coordinates in pixels, [2, 2] = 1.
        covariance (`np.ndarray`): (8, 8) of the parameters in normalized coordinates.
        frame (`np.ndarray`): (3, 3), pixels to normalized coordinates.
        sigma (`float`): standard deviation of the residuals (pixels, or units of the pictures fitted).
        correlation (`float`): of the two pictures over the pixels used; 1 for points.
    """

    matrix: np.ndarray
    covariance: np.ndarray
    frame: np.ndarray
    sigma: float
    correlation: float = 1.0

    def expected_error(self, points: np.ndarray) -> float:
        """The largest expected distance, in pixels, between where `points` (N, 2) are mapped and where they belong."""
        normalized = transform(self.frame, points)
        jacobian = _jacobian(normalized, self.frame @ self.matrix @ np.linalg.inv(self.frame))
        variances = np.einsum("nij,jk,nik->n", jacobian, self.covariance, jacobian)
        return float(np.sqrt(max(variances.max(), 0.0)) / self.frame[0, 0])


def transform(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) points through a (3, 3) homography, float64; a point that it sends to the horizon is not finite."""
    homogeneous = np.asarray(points, np.float64) @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return homogeneous[:, :2] / homogeneous[:, 2:]


def corners_of(width: int, height: int) -> np.ndarray:
    """(4, 2) centres of a picture's corner pixels."""
    return np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], np.float64)


def displacement(matrix: np.ndarray, points: np.ndarray) -> float:
    """The farthest that a homography moves any of the points, in pixels; infinite if it sends one to the horizon."""
    farthest = np.linalg.norm(transform(matrix, points) - points, axis=1).max()
    return float("inf") if np.isnan(farthest) else float(farthest)


def distortion(matrix: np.ndarray, points: np.ndarray) -> float:
    """How far the map is from a rigid motion: the largest |singular value - 1| of its local linear map at the points.

    Infinite where it mirrors the picture, or sends a point to the horizon or behind it.
    """
    homogeneous = np.asarray(points, np.float64) @ matrix[:, :2].T + matrix[:, 2]
    scale = homogeneous[:, 2]
    if (scale <= 1e-6).any() or not np.isfinite(matrix).all():
        return float("inf")
    mapped = homogeneous[:, :2] / scale[:, None]
    local = (matrix[None, :2, :2] - mapped[:, :, None] * matrix[None, 2:, :2]) / scale[:, None, None]
    if (np.linalg.det(local) <= 0).any():
        return float("inf")
    return float(np.abs(np.linalg.svd(local, compute_uv=False) - 1).max())


def fit_points(fixed: np.ndarray, moving: np.ndarray, start: np.ndarray, size: tuple[int, int]) -> Fit | None:
    """Robust least squares on matched points (N, 2), beginning at `start`; None if they do not determine a map.

    `size` is (width, height) of the fixed picture.
    """
    frame = _frame(size)
    source, goal = transform(frame, fixed), transform(frame, moving)
    matrix = _normalize(frame @ start @ np.linalg.inv(frame))
    for _ in range(20):
        residual = goal - transform(matrix, source)
        distance = np.linalg.norm(residual, axis=1)
        # 1.1774: median of a Rayleigh distribution. No detector is surer than a twentieth of a pixel.
        sigma = max(float(np.median(distance)) / 1.1774, 0.05 * frame[0, 0])
        weight = _tukey(distance / sigma)
        jacobian = _jacobian(source, matrix)
        normal = np.einsum("n,nij,nik->jk", weight, jacobian, jacobian)
        if not _solvable(normal):
            return None
        step = np.linalg.solve(normal, np.einsum("n,nij,ni->j", weight, jacobian, residual))
        matrix = matrix + np.append(step, 0.0).reshape(3, 3)
        if np.abs(step).max() < 1e-9:
            break
    # For the covariance every match counts that is no gross outlier. With a few dozen matches, the half that agrees
    # best would promise too small an error.
    near = distance[distance < GROSS * frame[0, 0]]
    honest = max(float(np.sqrt(np.square(near).sum() / max(2 * len(near) - 8, 1))), sigma)
    return Fit(_in_pixels(matrix, frame), np.linalg.inv(normal) * honest**2, frame, honest / frame[0, 0])


@dataclass(frozen=True)
class Level:
    """A picture at one resolution: (h, w) float32 locally normalized, and (h, w) bool usable pixels."""

    image: np.ndarray
    usable: np.ndarray


def pyramid(gray: np.ndarray, usable: np.ndarray) -> list[Level]:
    """A quarter of the resolution, then all of it; `gray` (H, W) uint8, `usable` (H, W) bool."""
    height, width = (max(side // 4, 1) for side in gray.shape)
    small = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
    usable_small = cv2.resize(usable.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.999
    return [
        Level(normalize_contrast(picture, mask), mask) for picture, mask in ((small, usable_small), (gray, usable))
    ]


def fit_pixels(fixed: list[Level], moving: list[Level], start: np.ndarray) -> Fit | None:
    """Robust least squares on brightness from a start some pixels away, coarse to fine; None if it does not settle.

    Lucas-Kanade over the pixels with the strongest gradients, on pictures freed of local brightness and contrast.

    Args:
        fixed, moving (`list[Level]`): of `pyramid`, of pictures of one size.
        start (`np.ndarray`): (3, 3), fixed to moving.
    """
    height, width = fixed[-1].image.shape
    fit = None
    for here, there in zip(fixed, moving, strict=True):
        x, y = here.image.shape[1] / width, here.image.shape[0] / height
        shrink = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])  # pixel centres onto pixel centres
        fit = _fit_level(here, there, shrink @ start @ np.linalg.inv(shrink))
        if fit is not None:
            start = np.linalg.inv(shrink) @ fit.matrix @ shrink
    return fit


def _fit_level(fixed: Level, moving: Level, start: np.ndarray) -> Fit | None:
    height, width = fixed.image.shape
    frame = _frame((width, height))
    points = _strong_pixels(fixed)
    source = transform(frame, points)
    values = fixed.image[points[:, 1], points[:, 0]].astype(np.float64)
    gradients = [cv2.Sobel(moving.image, cv2.CV_32F, dx, dy, scale=1 / 8) for dx, dy in ((1, 0), (0, 1))]
    matrix = _normalize(frame @ start @ np.linalg.inv(frame))
    for _ in range(MAX_STEPS):
        at = transform(np.linalg.inv(frame), transform(matrix, source))
        inside = (at > 1).all(axis=1) & (at[:, 0] < width - 2) & (at[:, 1] < height - 2)
        inside[inside] = moving.usable[tuple(np.round(at[inside]).astype(int).T[::-1])]
        if inside.sum() < MIN_PIXELS:
            return None
        sampled, gx, gy = (_sample(image, at[inside]) for image in (moving.image, *gradients))
        residual = values[inside] - sampled
        sigma = max(1.4826 * float(np.median(np.abs(residual))), 1e-4)
        weight = _tukey(residual / sigma)
        geometry = _jacobian(source[inside], matrix)
        jacobian = (gx[:, None] * geometry[:, 0] + gy[:, None] * geometry[:, 1]) / frame[0, 0]
        normal = (jacobian * weight[:, None]).T @ jacobian
        if not _solvable(normal):
            return None
        step = np.linalg.solve(normal, jacobian.T @ (weight * residual))
        if not np.isfinite(step).all() or np.abs(step).max() > 0.5:
            return None
        matrix = matrix + np.append(step, 0.0).reshape(3, 3)
        if np.abs(step).max() < SETTLED * frame[0, 0]:
            break
    else:
        return None
    trusted = weight > 0
    correlation = float(np.corrcoef(values[inside][trusted], sampled[trusted])[0, 1]) if trusted.sum() > 2 else 0.0
    # Neighbouring residuals are alike (both pictures are smoothed): about one in twelve counts as a new one.
    return Fit(_in_pixels(matrix, frame), np.linalg.inv(normal) * sigma**2 * 12, frame, sigma, correlation)


def normalize_contrast(gray: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """(H, W) uint8 to float32 with local mean 0 and local deviation near 1: brightness changes fall out.

    Only `usable` pixels, (H, W) bool, count in a neighbourhood, else a change inside the target would leak out of it.
    Where a neighbourhood varies by less than a few grey levels, noise is not blown up.
    """
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    weight = usable.astype(np.float32)
    total = np.maximum(cv2.blur(weight, (31, 31)), 1e-3)
    mean = cv2.blur(smooth * weight, (31, 31)) / total
    variance = np.maximum(cv2.blur(smooth * smooth * weight, (31, 31)) / total - mean * mean, 0)
    return (smooth - mean) / (np.sqrt(variance) + 5.0)


def _strong_pixels(level: Level) -> np.ndarray:
    """(N, 2) x, y of the usable pixels with the strongest gradients of each part of the picture."""
    strength = np.hypot(*(cv2.Sobel(level.image, cv2.CV_32F, dx, dy, scale=1 / 8) for dx, dy in ((1, 0), (0, 1))))
    strength[~level.usable] = 0
    strength[:2] = strength[-2:] = strength[:, :2] = strength[:, -2:] = 0
    height, width = strength.shape
    chosen = [np.empty((0, 2), int)]
    for rows in np.array_split(np.arange(height), 4):
        for columns in np.array_split(np.arange(width), 6):
            tile = strength[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            count = min(MAX_PIXELS // 24, int(np.count_nonzero(tile > 0.01)))
            if count:
                y, x = np.unravel_index(np.argpartition(tile.ravel(), -count)[-count:], tile.shape)
                chosen.append(np.stack([x + columns[0], y + rows[0]], axis=1))
    return np.concatenate(chosen)


def _sample(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Bilinear values of an image at (N, 2) x, y inside it."""
    column, row = np.floor(at).astype(int).T
    x, y = (at - np.floor(at)).T
    top = image[row, column] * (1 - x) + image[row, column + 1] * x
    return top * (1 - y) + (image[row + 1, column] * (1 - x) + image[row + 1, column + 1] * x) * y


def _jacobian(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """(N, 2, 8): how the mapped points move with the first eight entries of the homography."""
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    scale = homogeneous[:, 2]
    u, v = homogeneous[:, 0] / scale, homogeneous[:, 1] / scale
    x, y, one, zero = points[:, 0], points[:, 1], np.ones(len(points)), np.zeros(len(points))
    rows = [[x, y, one, zero, zero, zero, -u * x, -u * y], [zero, zero, zero, x, y, one, -v * x, -v * y]]
    return np.moveaxis(np.array(rows) / scale, 2, 0)


def _tukey(normalized: np.ndarray) -> np.ndarray:
    return np.square(np.clip(1 - np.square(normalized / TUKEY), 0, None))


def _solvable(normal: np.ndarray) -> bool:
    return bool(np.isfinite(normal).all()) and np.linalg.cond(normal) < 1e12


def _frame(size: tuple[int, int]) -> np.ndarray:
    """Pixels to coordinates with the picture's middle at 0 and its corners at distance 1."""
    width, height = size
    scale = 2 / np.hypot(width, height)
    return np.array([[scale, 0, -scale * (width - 1) / 2], [0, scale, -scale * (height - 1) / 2], [0, 0, 1]])


def _normalize(matrix: np.ndarray) -> np.ndarray:
    return matrix / matrix[2, 2]


def _in_pixels(matrix: np.ndarray, frame: np.ndarray) -> np.ndarray:
    return _normalize(np.linalg.inv(frame) @ matrix @ frame)
