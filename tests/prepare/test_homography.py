"""The mathematics of registration against oracles: fits, expected errors, distances, warps."""

import cv2
import numpy as np
import pytest
from helpers.photos import SETTINGS, frames, motion, scene, through
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.prepare import homography
from gift_peft.prepare.matching import Frame
from gift_peft.prepare.registration import difference_outside, valid_area, warp


def some_map(rng, size):
    return motion(rng, size, translation=20, degrees=5, perspective=1e-4)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31))
def test_points_fit_recovers_the_map_despite_outliers(seed):
    rng = np.random.default_rng(seed)
    truth = some_map(rng, (480, 640))
    fixed = rng.uniform(0, [640, 480], (80, 2))
    moving = through(truth, fixed) + rng.normal(0, 0.1, (80, 2))
    moving[:12] += rng.uniform(5, 40, (12, 2))
    start = cv2.findHomography(fixed, moving, cv2.RANSAC, 3.0)[0]
    fit = homography.fit_points(fixed, moving, start, (640, 480))
    corners = homography.corners_of(640, 480)
    assert np.linalg.norm(through(fit.matrix, corners) - through(truth, corners), axis=1).max() < 0.6
    assert 0.03 < fit.sigma < 0.3


def test_expected_error_is_what_repetition_shows():
    # Features at the left, the target at the right: the spread of the fitted corners over many draws.
    truth = motion(np.random.default_rng(3), (480, 640))
    corners = np.array([[560.0, 200], [620, 200], [620, 260], [560, 260]])
    found, expected = [], []
    for seed in range(120):
        rng = np.random.default_rng(seed)
        fixed = rng.uniform([0, 0], [320, 480], (60, 2))
        moving = through(truth, fixed) + rng.normal(0, 0.3, (60, 2))
        fit = homography.fit_points(fixed, moving, truth, (640, 480))
        found.append(through(fit.matrix, corners))
        expected.append(fit.expected_error(corners))
    spread = np.sqrt(np.var(found, axis=0).sum(axis=1)).max()
    assert 0.6 < np.median(expected) / spread < 1.6, (np.median(expected), spread)


def test_pixel_fit_is_subpixel_and_deaf_to_the_light():
    rng = np.random.default_rng(0)
    picture = scene(4)
    truth = motion(rng, (480, 640), translation=3, degrees=0.3)
    frame = cv2.warpPerspective(picture, truth, (640, 480), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    light = np.linspace(0.6, 1.1, 640)[None, :]  # brighter to the right
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (picture, frame)]
    everywhere = np.ones((480, 640), bool)
    fixed, moving = (homography.pyramid(image.astype(np.uint8), everywhere) for image in (gray[0], gray[1] * light))
    fit = homography.fit_pixels(fixed, moving, np.eye(3))
    corners = homography.corners_of(640, 480)
    assert np.linalg.norm(through(fit.matrix, corners) - through(truth, corners), axis=1).max() < 0.2
    assert fit.correlation > 0.8
    noise = homography.pyramid(rng.integers(0, 255, (480, 640), dtype=np.uint8), everywhere)
    other = homography.fit_pixels(fixed, noise, np.eye(3))
    assert other is None or other.correlation < 0.5


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_displacement_and_distortion_against_the_oracle(seed):
    rng = np.random.default_rng(seed)
    matrix = some_map(rng, (480, 640))
    points = rng.uniform(0, [640, 480], (5, 2))
    moves = np.linalg.norm(through(matrix, points) - points, axis=1)
    assert homography.displacement(matrix, points) == pytest.approx(moves.max())
    stretched = 0.0
    for point in points:  # central differences
        local = np.stack(
            [
                (through(matrix, [point + step])[0] - through(matrix, [point - step])[0]) / 2e-3
                for step in np.eye(2) / 1e3
            ]
        ).T
        stretched = max(stretched, np.abs(np.linalg.svd(local, compute_uv=False) - 1).max())
    assert homography.distortion(matrix, points) == pytest.approx(stretched, rel=1e-3, abs=1e-6)


def test_degenerate_maps_are_infinitely_distorted():
    corners = homography.corners_of(640, 480)
    horizon = np.array([[1, 0, 0], [0, 1, 0], [-1 / 300, 0, 1]])
    for matrix in (horizon, np.diag([-1.0, 1, 1]), np.full((3, 3), np.nan)):
        assert homography.distortion(matrix, corners) == np.inf
    to_infinity = np.array([[1, 0, 0], [0, 1, 0], [-1 / 639, 0, 1]])  # the right border
    assert homography.displacement(to_infinity, corners) == np.inf


def test_valid_area_and_warp_against_the_oracle():
    rng = np.random.default_rng(2)
    matrix = some_map(rng, (40, 60))
    picture = rng.integers(0, 255, (40, 60, 3), dtype=np.uint8)
    mask = rng.random((40, 60)) < 0.5
    valid, warped, warped_mask = valid_area(matrix, (60, 40)), warp(picture, matrix), warp(mask, matrix)
    assert warped_mask.dtype == bool
    back = np.linalg.inv(matrix)
    for y in range(40):
        for x in range(60):
            (u, v), inside = through(back, [[x, y]])[0], valid[y, x]
            assert inside == (0 <= u <= 59 and 0 <= v <= 39)
            if inside and min(abs(u % 1 - 0.5), abs(v % 1 - 0.5)) > 0.05:
                assert warped_mask[y, x] == mask[round(v), round(u)]
            if inside:
                left, top = min(int(u), 58), min(int(v), 38)
                a, b = u - left, v - top
                around = picture[top : top + 2, left : left + 2].astype(float)
                expected = (around[0] * [[1 - a], [a]]).sum(0) * (1 - b) + (around[1] * [[1 - a], [a]]).sum(0) * b
                assert np.abs(warped[y, x] - expected).max() < 10


def test_difference_outside_ignores_the_target_and_the_exposure():
    picture, mask, fixed = frames(6)
    darker = (picture * 0.7).astype(np.uint8)
    darker[mask] = 255
    before, after = difference_outside(Frame(darker, mask, SETTINGS), fixed, np.eye(3))
    assert before == after < 0.6
