"""The paper's matching between two frames: SIFT, ratio test, displacement filter, MAGSAC (supplement A).

Added to it: on request only features outside the target, with one match per feature; and a least-squares fit to all
matches that agree. Its covariance says how exact the map is at the target's corners.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from gift_peft.prepare.homography import Fit, Level, corners_of, fit_points, pyramid, transform
from gift_peft.prepare.settings import RegistrationSettings

MAX_FEATURES = 6000


class Picture:
    """What of a frame does not depend on where its target is."""

    def __init__(self, gray: np.ndarray, settings: RegistrationSettings):
        self.gray, self.settings = gray, settings

    @cached_property
    def features(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (K, 2), descriptors (K, 128) uint8, contrasts (K,), at the lowest threshold.

        A keypoint's contrast is three times its response; thresholding that gives exactly what SIFT itself gives at a
        higher threshold, so one detection serves every threshold. Its descriptors are whole numbers up to 255.
        """
        low = min(self.settings.min_contrast_threshold, self.settings.contrast_threshold)
        sift = cv2.SIFT_create(contrastThreshold=low, edgeThreshold=self.settings.edge_threshold)
        keypoints, descriptors = sift.detectAndCompute(self.gray, None)
        if not keypoints:
            return np.empty((0, 2)), np.empty((0, 128), np.uint8), np.empty(0)
        points = np.array([keypoint.pt for keypoint in keypoints], np.float64)
        contrasts = np.array([3 * keypoint.response for keypoint in keypoints])
        return points, descriptors.astype(np.uint8), contrasts


class Frame:
    """One picture as registration sees it; what is costly is computed once, since a target frame serves many."""

    def __init__(
        self,
        image: np.ndarray,
        target: np.ndarray | None,
        settings: RegistrationSettings,
        seen: Picture | None = None,
    ):
        """`image` (H, W, 3) RGB uint8, `target` (H, W) bool or None where there is none.

        `seen` is the `picture` of a frame of the same image and settings, with whatever target.
        """
        self.picture = seen or Picture(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), settings)
        self.gray = self.picture.gray
        self.target = np.zeros(self.gray.shape, bool) if target is None else target
        self.settings = settings

    @property
    def size(self) -> tuple[int, int]:
        return self.gray.shape[1], self.gray.shape[0]

    @cached_property
    def outside(self) -> np.ndarray:
        """(H, W) bool: farther than the margin from the target."""
        side = 2 * self.settings.target_margin + 1
        return cv2.dilate(self.target.astype(np.uint8), np.ones((side, side), np.uint8)) == 0

    @cached_property
    def levels(self) -> list[Level]:
        return pyramid(self.gray, self.outside)

    @cached_property
    def corners(self) -> np.ndarray:
        """(4, 2) corners of the target's bounding box, or of the frame where there is no target."""
        if not self.target.any():
            return corners_of(*self.size)
        rows, columns = (np.flatnonzero(self.target.any(axis=axis)) for axis in (1, 0))
        left, right, top, bottom = columns[0], columns[-1], rows[0], rows[-1]
        return np.array([[left, top], [right, top], [right, bottom], [left, bottom]], np.float64)

    def features(self, contrast: float, outside_only: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """(K, 2) points, (K, 128) float32 descriptors of at least this contrast; the strongest where they are many."""
        points, descriptors, contrasts = self.picture.features
        chosen = contrasts >= contrast
        if outside_only:
            column, row = np.clip(np.round(points).astype(int), 0, np.array(self.size) - 1).T
            chosen &= self.outside[row, column]
        chosen = np.flatnonzero(chosen)
        if len(chosen) > MAX_FEATURES:
            chosen = np.sort(chosen[np.argsort(-contrasts[chosen], kind="stable")[:MAX_FEATURES]])
        return points[chosen], descriptors[chosen].astype(np.float32)


@dataclass
class Matches:
    """Matches at one contrast threshold, and what MAGSAC makes of them."""

    contrast: float
    size: tuple[int, int]  # width, height of the target frame
    features: tuple[int, int]  # outside the targets, of the moving and the target frame
    fixed: np.ndarray  # (N, 2) after the ratio test
    moving: np.ndarray
    near: np.ndarray  # bool, which of them pass the displacement filter
    matrix: np.ndarray | None = None  # moving to fixed
    inliers: np.ndarray | None = None  # bool, among those that pass
    agreeing: np.ndarray | None = None  # bool, among all of them, those that agree with the map; for `fit`
    fit: Fit | None = None  # fixed to moving

    @property
    def spread(self) -> float:
        """Deviation of the agreeing matches in the direction in which they spread least, over the diagonal."""
        if self.agreeing is None:
            return 0.0
        variance = np.linalg.eigvalsh(np.cov(self.fixed[self.agreeing].T))[0]
        return float(np.sqrt(max(variance, 0.0)) / np.hypot(*self.size))

    @property
    def count(self) -> int:
        return 0 if self.inliers is None else int(self.inliers.sum())

    @property
    def inlier_ratio(self) -> float | None:
        return self.count / int(self.near.sum()) if self.near.any() else None

    @property
    def median_displacement(self) -> float | None:
        if not self.count:
            return None
        moved = (self.moving - self.fixed)[self.near][self.inliers]
        return float(np.median(np.linalg.norm(moved, axis=1)))


def match_frames(moving: Frame, fixed: Frame, contrast: float, outside_only: bool = True) -> Matches:
    """The paper's steps at one contrast threshold."""
    settings = fixed.settings
    (there, there_descriptors), (here, here_descriptors) = (
        frame.features(contrast, outside_only) for frame in (moving, fixed)
    )
    pairs = np.empty((0, 2), int)
    if len(there) >= 2 and len(here) >= 2:
        nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(there_descriptors, here_descriptors, k=2)
        good = [first for first, second in nearest if first.distance < settings.ratio * second.distance]
        if outside_only:  # of several matches that claim one feature at most one is right
            taken: dict[int, cv2.DMatch] = {}
            for match in sorted(good, key=lambda match: match.distance):
                taken.setdefault(match.trainIdx, match)
            good = list(taken.values())
        pairs = np.array(sorted((match.queryIdx, match.trainIdx) for match in good), int).reshape(-1, 2)
    there, here = there[pairs[:, 0]], here[pairs[:, 1]]
    moves = here - there
    near = np.zeros(len(pairs), bool)
    if len(pairs):
        near = np.linalg.norm(moves - np.median(moves, axis=0), axis=1) < settings.displacement_filter
    counts = tuple(len(frame.features(contrast)[0]) for frame in (moving, fixed))
    result = Matches(contrast, fixed.size, counts, here, there, near)
    if near.sum() < 4:
        return result
    result.matrix, result.inliers = find_homography(there[near], here[near], settings)
    if result.matrix is not None and abs(np.linalg.det(result.matrix)) > 1e-9 and result.count >= 8:
        start = np.linalg.inv(result.matrix)
        # Turning moves the frame's border farther than the displacement filter lets pass: the map calls those back.
        agreeing = np.linalg.norm(transform(start, here) - there, axis=1) < settings.reprojection_threshold
        if agreeing.sum() >= 8:
            result.agreeing = agreeing
            result.fit = fit_points(here[agreeing], there[agreeing], start, fixed.size)
    return result


def find_homography(source: np.ndarray, goal: np.ndarray, settings: RegistrationSettings):
    """(3, 3) matrix and (N,) bool inliers by MAGSAC, by RANSAC where that gives nothing, else (None, None)."""
    for method in (cv2.USAC_MAGSAC, cv2.RANSAC):
        try:
            matrix, inliers = cv2.findHomography(
                source,
                goal,
                method,
                settings.reprojection_threshold,
                maxIters=settings.max_iterations,
                confidence=settings.confidence,
            )
        except cv2.error:
            continue
        if matrix is not None and np.isfinite(matrix).all():
            return matrix, inliers.ravel().astype(bool)
    return None, None
