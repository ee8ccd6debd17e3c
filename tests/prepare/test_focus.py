"""Blur that was added is found again in pixels, whatever noise, light and target do."""

import cv2
import numpy as np
import pytest
from helpers.clips import views
from helpers.photos import scene

from gift_peft.prepare.focus import SIDE, Focus

SIZE = (240, 320)


def mean(picture, seed, sigma=3.0, frames=4):
    rng = np.random.default_rng(seed)
    gray = cv2.cvtColor(np.asarray(picture, np.float32), cv2.COLOR_RGB2GRAY)
    return (gray + rng.normal(0, sigma, (frames, *gray.shape)).mean(axis=0)).astype(np.float32)


def blurred(picture, sigma):
    return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), sigma) if sigma else picture.astype(np.float32)


@pytest.mark.parametrize("known_mask", [True, False])
@pytest.mark.parametrize("sigma", [0, 1.0, 1.5, 2.5, 4.0])
def test_added_blur_is_found(sigma, known_mask):
    for seed in range(3):
        (first, second), mask = views(seed, SIZE, 2)
        focus = Focus(mean(first, seed), mean(first, seed + 10), mask if known_mask else None)
        blur = focus.blur(mean(0.8 * blurred(second, sigma), seed + 20))
        assert abs(blur.pixels - sigma) < 0.3
        assert (blur.sharpness > 0.97) if not sigma else (blur.sharpness < 0.9)


def test_noise_alone_is_no_blur_and_hides_none():
    picture = scene(4, SIZE)
    focus = Focus(mean(picture, 0, 8.0), mean(picture, 1, 8.0))
    assert focus.blur(mean(picture, 2, 12.0)).pixels < 0.5
    assert abs(focus.blur(mean(blurred(picture, 2), 3, 12.0)).pixels - 2) < 0.4


def test_a_camera_that_moved_within_bounds_is_not_out_of_focus():
    picture = scene(5, SIZE)
    matrix = np.array([[1, 0, 0.7], [0, 1, -0.5], [0, 0, 1.0]])
    moved = cv2.warpPerspective(picture, matrix, SIZE[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    focus = Focus(mean(picture, 0), mean(picture, 1))
    assert focus.blur(mean(moved, 2), matrix).pixels < 0.5


def test_sharper_than_before_is_no_blur():
    picture = scene(6, SIZE)
    soft = blurred(picture, 2)
    blur = Focus(mean(soft, 0), mean(soft, 1)).blur(mean(picture, 2))
    assert blur.pixels == 0 and blur.sharpness > 1.1


def test_blur_of_a_large_picture_is_in_its_own_pixels():
    size = (1080, 2 * SIDE)
    picture = blurred(scene(7, size), 1.0)
    blur = Focus(mean(picture, 0), mean(picture, 1)).blur(mean(blurred(picture, 4.0), 2))
    assert abs(blur.pixels - 4.0) < 0.6


def test_another_picture_says_nothing():
    for seed in range(4):
        focus = Focus(mean(scene(seed, SIZE), 0), mean(scene(seed, SIZE), 1))
        assert focus.blur(mean(scene(9, SIZE), 2)) is None


@pytest.mark.parametrize("sigma", [8.0, 20.0])
def test_a_picture_without_any_detail_left_is_far_out_of_focus(sigma):
    picture = scene(8, SIZE)
    blur = Focus(mean(picture, 0), mean(picture, 1)).blur(mean(blurred(picture, sigma), 2))
    assert blur.pixels > 5 and blur.sharpness < 0.3
