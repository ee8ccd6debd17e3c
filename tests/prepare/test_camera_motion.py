"""Motion of the camera against motions that are known, with targets that change, noise, and nothing to see."""

import cv2
import numpy as np
import pytest
from helpers.clips import pushed, views
from helpers.photos import scene

from gift_peft.prepare.camera_motion import Anchor
from gift_peft.prepare.homography import transform

SIZE = (240, 320)


def noisy(picture, seed, sigma=3.0):
    noise = np.random.default_rng(seed).normal(0, sigma, picture.shape)
    return np.clip(np.round(picture + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("known_mask", [True, False])
@pytest.mark.parametrize("pixels", [0, 0.4, 3, 12, 35])
def test_a_push_is_measured_to_a_fifth_of_a_pixel(pixels, known_mask):
    for seed in range(3):
        (first, second), mask = views(seed, SIZE, 2)
        moved = noisy(0.85 * pushed(second.astype(np.float32), pixels), seed)
        motion = Anchor(noisy(first, seed + 50), mask if known_mask else None).motion(moved)
        assert abs(motion.pixels - pixels) < 0.2 and motion.error < 0.2
        assert np.allclose(motion.matrix[:2, 2], [0.8 * pixels, 0.6 * pixels], atol=0.3)


@pytest.mark.parametrize("size", [SIZE, (1080, 1440)])
def test_turn_and_zoom_are_in_pixels_of_the_frame(size):
    picture = scene(3, size)
    middle = ((size[1] - 1) / 2, (size[0] - 1) / 2)
    matrix = np.vstack([cv2.getRotationMatrix2D(middle, 0.5, 1.004), [0, 0, 1]])
    moved = cv2.warpPerspective(picture, matrix, size[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    motion = Anchor(picture).motion(noisy(moved, 0))
    corners = np.array([[0, 0], [size[1] - 1, 0], [0, size[0] - 1], [size[1] - 1, size[0] - 1]], float)
    apart = np.linalg.norm(transform(motion.matrix, corners) - transform(matrix, corners), axis=1)
    assert apart.max() < 0.25 * max(size) / 320


@pytest.mark.parametrize("pixels", [0, 2, 18])
def test_a_mirror_over_half_of_the_picture_neither_hides_a_push_nor_makes_one(pixels):
    mirror = np.zeros(SIZE, bool)
    mirror[30:220, 60:290] = True  # 57 % of the picture; where it is, is not told
    for seed in range(6):
        first, second = (
            np.where(mirror[..., None], scene(500 + 2 * seed + k, SIZE), scene(seed, SIZE)) for k in (0, 1)
        )
        motion = Anchor(noisy(first, seed)).motion(noisy(pushed(second.astype(np.float32), pixels), seed + 50))
        assert np.allclose(motion.matrix[:2, 2], [0.8 * pixels, 0.6 * pixels], atol=0.8)
        assert abs(motion.pixels - pixels) < 0.6


def test_another_view_and_an_empty_one_have_no_motion():
    anchor = Anchor(noisy(scene(1, SIZE), 0))
    assert anchor.motion(noisy(scene(2, SIZE), 1)) is None
    small = scene(1, (32, 320))
    assert Anchor(small).motion(small) is None
    assert anchor.motion(np.full((*SIZE, 3), 90, np.uint8)) is None
    assert Anchor(np.full((*SIZE, 3), 90, np.uint8)).motion(noisy(scene(2, SIZE), 1)) is None
