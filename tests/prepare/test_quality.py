"""Quality figures against straight-line computations, and that each check tells the sound frame from the unsound."""

import cv2
import numpy as np
import pytest
from helpers.photos import scene, target, with_content

from gift_peft.prepare import quality
from gift_peft.prepare.quality import SmallFrame, check_group_change, pairwise_changes
from gift_peft.prepare.settings import QualitySettings

SIZE = (240, 320)


def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def group(seed, noise=3.0, count=2):
    """Frames of one scene of which only the target changes."""
    rng = np.random.default_rng(seed)
    picture, mask = scene(seed, SIZE), target(seed, SIZE)
    return [gray(with_content(picture, mask, rng, noise)) for _ in range(count)], mask


def smalls(grays, mask):
    return [SmallFrame(image, mask, None) for image in grays]


def check_frames(names, frames, grays, target_frame, settings):
    return quality.check_frames(names, frames, grays, target_frame, pairwise_changes(frames), settings)


@pytest.mark.parametrize("seed", range(4))
def test_only_the_target_changed(seed):
    grays, mask = group(seed)
    one, other = smalls(grays, mask)
    assert quality.outside_change(one, other) < 0.003 and quality.outside_correlation(one, other) > 0.8
    assert quality.target_change(one, other) > 5
    darker = SmallFrame((grays[0] * 0.6).astype(np.uint8), mask, None)
    assert quality.outside_change(darker, other) < 0.003  # light is no change of the scene
    assert quality.target_change(darker, SmallFrame(grays[0], mask, None)) < 1.5


@pytest.mark.parametrize("seed", range(4))
def test_something_else_changed(seed):
    grays, mask = group(seed)
    away = np.argwhere(cv2.erode((~mask).astype(np.uint8), np.ones((101, 101))) > 0)
    row, column = np.clip(away[len(away) // 2], 40, np.array(SIZE) - 40)
    grays[0][row - 30 : row + 30, column - 30 : column + 30] = gray(scene(70 + seed, SIZE))[:60, :60]
    one, other = smalls(grays, mask)
    assert quality.outside_change(one, other) > 0.003
    _, reasons, warnings = check_frames(["a", "b"], [one, other], grays, 1, QualitySettings())
    assert not reasons[0] and "outside_change" in [item.code for item in warnings[0]]


def test_another_scene():
    for seed in range(4):
        mask = target(seed, SIZE)
        one, other = smalls([gray(scene(seed, SIZE)), gray(scene(seed + 60, SIZE))], mask)
        _, reasons, _ = check_frames(["a", "b"], [one, other], [one.gray, other.gray], 1, QualitySettings())
        assert {"another_scene", "outside_change"} & {item.code for item in reasons[0]}


def test_target_change_is_the_mean_difference_inside():
    rng = np.random.default_rng(0)
    mask = np.zeros(SIZE, bool)
    mask[80:160, 120:200] = True
    base = np.full(SIZE, 100.0) + rng.normal(0, 30, (60, 80)).repeat(4, 0).repeat(4, 1).clip(-90, 90)
    frame, other = base.copy(), base.copy()
    frame[mask], other[mask] = 150, 131
    frame = frame * 0.5 + 20  # half the light, and a veil
    one, two = smalls([frame.astype(np.uint8), other.astype(np.uint8)], mask)
    # Undoing the exposure doubles the frame: 150 again, 19 away from 131.
    assert quality.target_change(one, two) == pytest.approx(19, abs=1.5)


def test_figures_of_single_frames():
    sharp = gray(scene(0, SIZE))
    values = [quality.sharpness(cv2.GaussianBlur(sharp, (0, 0), sigma)) for sigma in (0.5, 1, 2, 4)]
    assert values == sorted(values, reverse=True) and values[2] < 0.35 * quality.sharpness(sharp)
    assert quality.sharpness(np.full(SIZE, 7, np.uint8)) == 0
    noisy = np.clip(sharp + np.random.default_rng(0).normal(0, 3, SIZE), 0, 255).astype(np.uint8)
    assert quality.sharpness(noisy) == pytest.approx(quality.sharpness(sharp), rel=0.5)
    ramp = np.arange(256, dtype=np.uint8).reshape(16, 16)
    assert quality.clipped(ramp) == (4 / 256, 4 / 256)


def test_masks_and_their_warnings():
    grays, mask = group(1, count=3)
    shifted = np.roll(mask, 25, axis=1)
    frames = [SmallFrame(image, one, None) for image, one in zip(grays, (mask, mask, shifted), strict=True)]
    figures, _, warnings = check_frames(list("abc"), frames, grays, 0, QualitySettings())
    assert figures[0].mask_iou == 1 and figures[2].mask_iou < 0.8
    assert "mask_disagrees" in [item.code for item in warnings[2]]
    assert figures[0].mask_area == pytest.approx(mask.mean(), abs=0.02)
    border = np.zeros(SIZE, bool)
    border[:, :100] = True
    edge = [SmallFrame(image, border, None) for image in grays]
    figures, _, warnings = check_frames(list("abc"), edge, grays, 0, QualitySettings())
    assert figures[0].mask_border == pytest.approx((60 + 25 + 25) / (2 * 80 + 2 * 60), abs=0.02)
    assert "mask_border" in [item.code for item in warnings[0]]


def test_a_group_that_teaches_nothing():
    grays, mask = group(2, noise=0, count=1)
    rng = np.random.default_rng(0)
    same = [np.clip(grays[0] + rng.normal(0, 4, SIZE), 0, 255).astype(np.uint8) for _ in range(3)]
    most, complaint = check_group_change(pairwise_changes(smalls(same, mask)), QualitySettings())
    assert most < 1.5 and "teaches nothing" in complaint  # noise is not a change
    grays, mask = group(2)
    assert check_group_change(pairwise_changes(smalls(grays, mask)), QualitySettings())[1] is None
    assert check_group_change(pairwise_changes(smalls(grays[:1], mask)), QualitySettings()) == (None, None)
    apart = [SmallFrame(grays[0], mask, None), SmallFrame(grays[1], np.roll(mask, 120, axis=0), None)]
    assert "no two frames overlap" in check_group_change(pairwise_changes(apart), QualitySettings())[1]


def test_a_thin_target_is_still_one():
    grays, _ = group(3)
    thin = np.zeros(SIZE, bool)
    thin[100:102, 40:280] = True
    one, other = smalls(grays, thin)
    assert one.mask_area == thin.mean() and one.inside.any() and quality.target_change(one, other) is not None
    assert not SmallFrame(grays[0], np.zeros(SIZE, bool), None).inside.any()
