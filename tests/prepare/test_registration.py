"""Registration: known motions come back, real static photos stay as they are, and nothing else is ever warped."""

import os

import cv2
import numpy as np
import pytest
from helpers.photos import SETTINGS, frames, motion, moved, scene, target, through, with_content
from PIL import Image

from gift_peft.prepare import registration
from gift_peft.prepare.matching import Frame, match_frames
from gift_peft.prepare.registration import register, valid_area, warp
from gift_peft.prepare.settings import RegistrationSettings

SHARED = os.path.join(os.path.dirname(__file__), "..", "..", "..", "shared", "data")
REAL = pytest.mark.skipif(not os.path.isdir(SHARED), reason="the real photos are not beside the repository")


def corner_error(found, truth, frame):
    """How far the found map (moving to fixed) and the truth (fixed to moving) disagree at the target's corners."""
    return np.linalg.norm(through(np.linalg.inv(found), frame.corners) - through(truth, frame.corners), axis=1).max()


def plain_difference(moving, fixed, region):
    """Mean absolute grey difference after one gain and offset, by polyfit."""
    x, y = moving[region].astype(np.float64), fixed[region].astype(np.float64)
    return np.abs(np.polyval(np.polyfit(x, y, 1), x) - y).mean()


def check_case(seed, picture, mask):
    """One known motion: recovered, or dropped with a reason; what is accepted is within a pixel and fits better."""
    rng = np.random.default_rng(seed)
    truth = motion(rng, mask.shape)
    frame, there = moved(picture, mask, truth, rng, noise=rng.uniform(0, 6))
    target_frame = with_content(picture, mask, rng, noise=rng.uniform(0, 6))
    fixed, moving = Frame(target_frame, mask, SETTINGS), Frame(frame, there, SETTINGS)
    result = register(moving, fixed)
    if result.status == "dropped":
        assert result.reasons and result.matrix is None
        return None
    error = corner_error(result.matrix, truth, fixed)
    assert error <= 1, (seed, error, result)
    if result.status == "warped":
        bound = SETTINGS.max_displacement * np.hypot(*mask.shape)
        assert np.linalg.norm(through(result.matrix, fixed.corners) - fixed.corners, axis=1).max() <= bound
        after = warp(frame, result.matrix)
        region = valid_area(result.matrix, fixed.size)
        for away in (mask, there, warp(there, result.matrix)):
            region &= cv2.dilate(away.astype(np.uint8), np.ones((9, 9))) == 0
        gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (frame, after, target_frame)]
        assert plain_difference(gray[1], gray[2], region) < plain_difference(gray[0], gray[2], region)
    return error


def test_known_motions_are_recovered():
    errors = [check_case(seed, scene(seed, (360, 480)), target(seed, (360, 480))) for seed in range(12)]
    assert sum(error is not None and error <= 0.5 for error in errors) >= 11


@pytest.mark.slow
def test_200_known_motions():
    errors = [check_case(seed, scene(seed), target(seed)) for seed in range(1000, 1200)]
    assert sum(error is not None and error <= 0.5 for error in errors) >= 190


def real_photos():
    for scene_id in ("000000080", "000000130"):
        for name in ("transparent.jpg", "opaque_sprayed.jpg"):
            yield np.asarray(Image.open(f"{SHARED}/cleargrasp_d435/{scene_id}/{name}").convert("RGB"))
    for index in range(3):
        yield np.asarray(Image.open(f"{BOOSTER}/camera_00/im{index}.png").convert("RGB"))
    for side in ("left", "right"):
        picture = Image.open(f"{SHARED}/middlebury_motorcycle/motorcycle_{side}.png")
        yield np.asarray(picture.convert("RGB"))


BOOSTER = f"{SHARED}/booster_web_quarter/train/balanced/ShotGlasses"


@REAL
@pytest.mark.slow
def test_200_known_motions_of_real_photos(capsys):
    photos = list(real_photos())
    errors = []
    for seed in range(200):
        picture = photos[seed % len(photos)]
        errors.append(check_case(seed, picture, target(seed, picture.shape[:2])))
    kept = [error for error in errors if error is not None]
    with capsys.disabled():
        print(
            f"\n{len(kept)} of 200 accepted, {200 - len(kept)} dropped with a reason; error at the target's corners: "
            f"median {np.median(kept):.3f} px, 95 % {np.quantile(kept, 0.95):.3f} px, largest {max(kept):.3f} px"
        )
    assert sum(error <= 0.5 for error in kept) >= 0.95 * len(kept) and len(kept) >= 180


# ---- what must not be warped ----


@pytest.mark.parametrize(
    "name, truth",
    {
        "shift": lambda w, h: np.array([[1, 0, 70.0], [0, 1, 40], [0, 0, 1]]),
        "turn": lambda w, h: np.vstack([cv2.getRotationMatrix2D((w / 2, h / 2), 15, 1), [0, 0, 1]]),
        "zoom": lambda w, h: np.vstack([cv2.getRotationMatrix2D((w / 2, h / 2), 0, 1.3), [0, 0, 1]]),
    }.items(),
)
@pytest.mark.parametrize("seed", range(2))
def test_motion_beyond_the_bound_is_dropped_and_called_that(seed, name, truth):
    picture, mask, fixed = frames(seed)
    rng = np.random.default_rng(seed)
    frame, there = moved(picture, mask, truth(480, 360), rng)
    result = register(Frame(frame, there, SETTINGS), fixed)
    assert result.status == "dropped" and result.reasons[0].code == "moved_too_far", result


def test_featureless_frames_are_dropped_and_called_that():
    picture, mask, _ = frames(3, (240, 320))
    rng = np.random.default_rng(0)
    flat = np.full_like(picture, 120)
    ramp = np.repeat(np.tile(np.linspace(60, 180, 320), (240, 1))[..., None], 3, axis=2).astype(np.uint8)
    noisy = np.clip(flat + rng.normal(0, 2, flat.shape), 0, 255).astype(np.uint8)
    textured = Frame(picture, mask, SETTINGS)
    for frame in (flat, ramp, noisy, cv2.GaussianBlur(picture, (0, 0), 40)):
        bare = Frame(frame, mask, SETTINGS)
        for moving, fixed in ((bare, textured), (textured, bare)):
            result = register(moving, fixed)
            assert result.status == "dropped" and result.reasons[0].code == "featureless", result
            assert "static_rig" in result.reasons[0].text


def test_another_scene_is_dropped_and_called_that():
    size = 240, 320
    for seed in range(4):
        _, _, fixed = frames(seed, size)
        result = register(Frame(scene(seed + 50, size), target(seed + 50, size), SETTINGS), fixed)
        assert result.status == "dropped" and result.reasons[0].code == "no_match", result


def test_a_still_camera_is_not_resampled():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        picture, mask, fixed = frames(seed)
        frame = with_content(picture * 0.8 + 10, mask, rng)
        result = register(Frame(frame, mask, SETTINGS), fixed)
        assert result.status == "identity" and np.array_equal(result.matrix, np.eye(3))
        assert result.figures.median_displacement < 0.5


def test_a_declared_static_rig_is_not_even_measured():
    _, mask, fixed = frames(0)
    result = register(Frame(np.zeros((360, 480, 3), np.uint8), mask, SETTINGS), fixed, declared_static=True)
    assert result.status == "identity" and result.figures.method == "declared static"


def test_a_turn_about_the_features_does_not_pass_as_standing_still():
    # All texture at the left; the camera turns about it, so that the features hardly move and the target does.
    rng = np.random.default_rng(5)
    picture = scene(5, (360, 640))
    picture[:, 260:] = cv2.GaussianBlur(picture, (0, 0), 6)[:, 260:]
    mask = np.zeros((360, 640), bool)
    mask[120:240, 470:610] = True
    truth = np.vstack([cv2.getRotationMatrix2D((130, 180), 0.25, 1), [0, 0, 1]])
    frame, there = moved(picture, mask, truth, rng, noise=1)
    fixed = Frame(with_content(picture, mask, rng, noise=1), mask, SETTINGS)
    result = register(Frame(frame, there, SETTINGS), fixed)
    assert result.status == "dropped" or corner_error(result.matrix, truth, fixed) < 1, result


def test_changes_inside_the_target_do_not_steer():
    # The reflection moves by 12 px, as a whole and full of features; the camera does not.
    rng = np.random.default_rng(1)
    picture, content = scene(1, (360, 480)), scene(77, (360, 480))
    mask = np.zeros((360, 480), bool)
    mask[40:320, 60:400] = True
    first, second = (np.where(mask[..., None], np.roll(content, shift, 1), picture) for shift in (0, 12))
    noisy = [np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for image in (first, second)]
    result = register(*(Frame(image, mask, SETTINGS) for image in noisy))
    assert result.status == "identity"
    exact = RegistrationSettings(paper_exact=True)
    by_the_paper = register(*(Frame(image, mask, exact) for image in noisy))
    assert by_the_paper.figures.with_additions["status"] == "identity"
    assert by_the_paper.status == "dropped" or abs(by_the_paper.matrix - np.eye(3)).max() > 1e-3


def test_frames_are_matched_by_the_paper_only_when_it_decides(monkeypatch):
    calls = []

    def counted(moving, fixed, contrast, outside_only=True):
        calls.append("ours" if outside_only else "the paper's")
        return match_frames(moving, fixed, contrast, outside_only)

    monkeypatch.setattr(registration, "match_frames", counted)
    picture, mask, fixed = frames(0)
    frame = with_content(picture, mask, np.random.default_rng(0))
    result = register(Frame(frame, mask, SETTINGS), fixed)
    assert set(calls) == {"ours"} and result.figures.paper_exact is None
    exact = RegistrationSettings(paper_exact=True)
    result = register(Frame(frame, mask, exact), Frame(picture, mask, exact))
    assert calls.count("the paper's") == 1 and result.figures.paper_exact["accepted"] is True


def test_treated_reference_passes_by_its_pixels():
    # Twenty matches are asked for and cannot be had; the pixels outside the target are the same.
    strict = RegistrationSettings(min_inliers=5000)
    picture, mask, _ = frames(2)
    treated = picture.copy()
    treated[mask] = 150
    result = register(Frame(treated, mask, strict), Frame(picture, mask, strict), treated=True)
    assert result.status == "identity" and result.figures.method == "pixels" and result.warnings[0].code == "by_pixels"
    exact = RegistrationSettings(paper_exact=True)  # the paper leaves references alone
    assert register(Frame(treated, mask, exact), Frame(picture, mask, exact), treated=True).figures.method == "paper"
    other = register(Frame(scene(9, (360, 480)), mask, strict), Frame(picture, mask, strict), treated=True)
    assert other.status == "dropped"


def test_settings_are_obeyed():
    rng = np.random.default_rng(0)
    picture, mask, fixed = frames(0, (240, 320))
    truth = np.array([[1, 0, 9.0], [0, 1, -5], [0, 0, 1]])
    frame, there = moved(picture, mask, truth, rng, noise=1)
    assert register(Frame(frame, there, SETTINGS), fixed).status == "warped"
    for name, value, code in (
        ("max_displacement", 0.01, "moved_too_far"),
        ("min_inlier_ratio", 1.01, "low_inlier_ratio"),
        ("max_target_error", 1e-6, "uncertain"),
        ("min_spread", 0.5, "narrow"),
        ("min_correlation", 1.01, "no_match"),
        ("max_distortion", 1e-9, "distorted"),
    ):
        other = RegistrationSettings(**{name: value})
        result = register(Frame(frame, there, other), Frame(picture, mask, other))
        assert result.status == "dropped" and code in [item.code for item in result.reasons], (name, result)
    still = RegistrationSettings(identity_displacement=20)
    assert register(Frame(frame, there, still), Frame(picture, mask, still)).status in ("identity", "warped")


def test_settings_that_are_refused():
    for name, value in (
        ("contrast_threshold", 0),
        ("min_contrast_threshold", 0.0),
        ("confidence", 1.0),
        ("max_iterations", 0),
    ):
        with pytest.raises(ValueError, match=name):
            RegistrationSettings(**{name: value})


# ---- real photographs ----


@REAL
def test_booster_illuminations_are_identity():
    classes = np.asarray(Image.open(f"{BOOSTER}/mask_cat.png"))
    mask = np.asarray(Image.fromarray(((classes == 3) * 255).astype(np.uint8)).resize((1028, 752), 0)) > 0
    photos = [
        Frame(np.asarray(Image.open(f"{BOOSTER}/camera_00/im{k}.png").convert("RGB")), mask, SETTINGS)
        for k in range(3)
    ]
    for index in (0, 1):
        result = register(photos[index], photos[2])
        assert result.status == "identity" and result.figures.median_displacement < 0.1, result


@REAL
@pytest.mark.parametrize("scene_id", ["000000080", "000000130"])
def test_cleargrasp_twins_are_registered(scene_id):
    folder = f"{SHARED}/cleargrasp_d435/{scene_id}"
    mask = np.asarray(Image.open(f"{folder}/mask.png")) > 0
    clear, sprayed = (
        Frame(np.asarray(Image.open(f"{folder}/{name}.jpg").convert("RGB")), mask, SETTINGS)
        for name in ("transparent", "opaque_sprayed")
    )
    assert register(sprayed, clear, treated=True).status == "identity"


@REAL
def test_two_views_are_not_one():
    left, right = (
        Frame(
            np.asarray(Image.open(f"{SHARED}/middlebury_motorcycle/motorcycle_{side}.png").convert("RGB")),
            None,
            SETTINGS,
        )
        for side in ("left", "right")
    )
    assert register(right, left).status == "dropped"
