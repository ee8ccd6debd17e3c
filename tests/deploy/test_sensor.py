"""Filling a sensor's depth: exact where the model is, robust where the sensor is wrong, honest about the rest."""

import numpy as np
import pytest
from helpers.simulated_sensor import simulate_sensor
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.deploy.sensor import UnrelatedDepthError, fill_sensor_depth, robust_line
from gift_peft.deploy.sensor_checks import check_range, check_registration

SIZE = 60, 80


def scene(seed=0, size=SIZE):
    """(true depth in m, mask): a slanted wall with boxes before it, and a target that has a box of its own."""
    random = np.random.default_rng(seed)
    row, column = np.mgrid[: size[0], : size[1]] / size[1]
    depth = 1 / (0.4 + 0.2 * row + random.uniform(-0.2, 0.2) * column)
    for _ in range(4):
        top, left = random.integers(0, size[0] - 15), random.integers(0, size[1] - 15)
        box = np.s_[top : top + 15, left : left + 15]
        depth[box] = np.minimum(depth[box], random.uniform(0.8, 1.6))
    mask = np.zeros(size, bool)
    mask[size[0] // 3 : -size[0] // 4, size[1] // 3 : -size[1] // 3] = True
    depth[mask] = depth[mask].min() * 0.9
    return depth, mask


def predicted(depth, kind, scale, shift):
    """A perfect prediction in native units."""
    return ((1 / depth if kind == "inverse_depth" else depth) - shift) / scale


@pytest.mark.parametrize("kind", ["inverse_depth", "depth"])
@settings(max_examples=15, deadline=None)
@given(st.floats(0.01, 100), st.floats(-0.3, 0.3), st.integers(0, 1000))
def test_a_perfect_prediction_gives_the_true_depth_whatever_its_units(kind, scale, shift, seed):
    depth, mask = scene(seed)
    sensor = np.where(mask, depth + 1, depth)  # it looks through the glass
    sensor[::7, ::5] = 0
    filled = fill_sensor_depth(predicted(depth, kind, scale, shift), sensor, mask, kind)
    np.testing.assert_allclose(filled.depth, depth, rtol=2e-3)
    assert filled.scale == pytest.approx(scale, rel=1e-3) and filled.shift == pytest.approx(shift, abs=1e-2)
    np.testing.assert_array_equal(filled.replaced, mask | (sensor == 0))
    np.testing.assert_array_equal(filled.rejected, mask & (sensor > 0))
    assert filled.confidence[~filled.replaced].min() == 1 and filled.relative_error < 1e-3


def test_outside_the_target_the_sensor_keeps_every_value():
    depth, mask = scene(1)
    sensor = simulate_sensor(1000 * depth, mask, 1) / 1000
    filled = fill_sensor_depth(predicted(depth, "inverse_depth", 2.0, 0.1), sensor, mask)
    kept = ~mask & (sensor > 0)
    np.testing.assert_array_equal(filled.depth[kept], sensor[kept].astype(np.float32))
    assert (filled.depth > 0).all() and np.isfinite(filled.depth).all()


def test_scale_and_unit_of_the_sensor_carry_through():
    """All that is chosen is relative: millimetres in, millimetres out."""
    depth, mask = scene(2)
    sensor = simulate_sensor(1000 * depth, mask, 2).astype(float)
    prediction = predicted(depth, "inverse_depth", 3.0, 0.0)
    metres, millimetres = (fill_sensor_depth(prediction, sensor / unit, mask) for unit in (1000, 1))
    np.testing.assert_allclose(1000 * metres.depth, millimetres.depth, rtol=1e-4)
    np.testing.assert_allclose(metres.confidence, millimetres.confidence, atol=1e-3)


def test_without_a_mask_what_the_fit_rejects_is_the_glass():
    depth, mask = scene(3)
    sensor = np.where(mask, depth + 1.2, depth)
    filled = fill_sensor_depth(predicted(depth, "inverse_depth", 2.0, 0.1), sensor)
    found = filled.replaced & mask
    assert found.sum() > 0.9 * mask.sum() and (filled.replaced & ~mask).sum() < 0.02 * mask.size
    np.testing.assert_allclose(filled.depth[found], depth[found], rtol=0.02)


def test_a_smooth_error_of_the_model_is_taken_off_inside_the_target_too():
    depth, mask = scene(4)
    row, column = np.mgrid[: SIZE[0], : SIZE[1]] / SIZE[1]
    bent = 1 / depth + 0.1 * np.sin(3 * row) * np.cos(2 * column)
    one_line = np.polyfit(bent[~mask], 1 / depth[~mask], 1)
    rough = np.abs(1 / np.polyval(one_line, bent[mask]) - depth[mask]).mean()
    filled = fill_sensor_depth(bent, np.where(mask, 0, depth), mask)
    assert np.abs(filled.depth[mask] - depth[mask]).mean() < 0.4 * rough


@pytest.mark.parametrize("kind", ["inverse_depth", "depth"])
@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.floats(0.005, 0.08), st.floats(-1, 3))
def test_wrong_predictions_nearby_do_not_turn_the_fit(kind, seed, share, factor):
    """On a plane a tilt explains what the prediction does: only what the few wrong pixels say tells the two apart."""
    random = np.random.default_rng(seed)
    row, column = np.mgrid[: SIZE[0], : SIZE[1]] / SIZE[1]
    depth = 1 / (0.5 + random.uniform(0.3, 0.8) * row + random.uniform(-0.2, 0.2) * column)
    mask = np.zeros(SIZE, bool)
    mask[20:40, 30:55] = True
    depth[mask] = depth[mask].min() * random.uniform(0.75, 0.95)  # stands on the table
    prediction = predicted(depth, kind, 2.0, 0.1)
    wrong = ~mask & (random.random(SIZE) < share)
    prediction[wrong] = np.median(prediction) * factor
    sensor = np.where(mask, 0, depth * (1 + 0.003 * random.standard_normal(SIZE)))
    filled = fill_sensor_depth(prediction, sensor, mask, kind)
    np.testing.assert_allclose(filled.depth[mask], depth[mask], rtol=0.015)


def test_a_mask_that_is_too_small_leaves_glass_about_it_that_says_nothing_of_the_target():
    row, column = np.mgrid[:120, :160] / 160
    depth = 1 / (0.5 + 0.5 * row + 0.1 * column)
    glass = np.zeros(depth.shape, bool)
    glass[40:80, 60:110] = True
    depth[glass] = depth[glass].min() * 0.9
    sensor = np.where(glass, depth + 0.5, depth)
    mask = np.zeros(depth.shape, bool)
    mask[43:77, 63:107] = True
    filled = fill_sensor_depth(predicted(depth, "inverse_depth", 2.0, 0.1), sensor, mask)
    np.testing.assert_allclose(filled.depth[mask], depth[mask], rtol=0.015)


def test_confidence_falls_with_distance_from_what_is_known_and_with_disagreement():
    depth, mask = scene(5)
    sensor = np.where(mask, 0, depth)
    random = np.random.default_rng(0)
    prediction = 1 / depth
    good = fill_sensor_depth(prediction, sensor, mask)
    bad = fill_sensor_depth(prediction + 0.08 * random.standard_normal(SIZE), sensor, mask)
    assert bad.confidence[mask].mean() < good.confidence[mask].mean() - 0.1
    middle = good.confidence[30:35, 38:42].mean()
    assert middle < good.confidence[21, 27:52].mean()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 0.42))
def test_robust_line_against_points_on_a_line_of_which_many_are_wrong(seed, share):
    random = np.random.default_rng(seed)
    x = random.uniform(0, 1, 400)
    scale, shift = random.uniform(0.1, 10), random.uniform(-5, 5)
    y = scale * x + shift + 1e-3 * scale * random.standard_normal(400)
    wrong = random.permutation(400)[: int(share * 400)]
    y[wrong] += scale * random.uniform(0.5, 3, len(wrong))
    assert robust_line(x, y, np.ones(400)) == pytest.approx((scale, shift), abs=0.02 * scale)


def test_robust_line_is_least_squares_where_noise_is_small_and_gaussian():
    random = np.random.default_rng(0)
    x = random.uniform(0, 1, 3000)
    y = 2 * x + 1 + 0.05 * random.standard_normal(3000)
    assert robust_line(x, y, np.ones(3000)) == pytest.approx(tuple(np.polyfit(x, y, 1)), abs=5e-3)


def test_what_cannot_be_filled_says_why():
    depth, mask = scene()
    with pytest.raises(ValueError, match="depth at 0 pixels in the whole picture"):
        fill_sensor_depth(1 / depth, np.zeros(SIZE), mask)
    with pytest.raises(ValueError, match="depth at 0 pixels outside the target"):
        fill_sensor_depth(1 / depth, depth, np.ones(SIZE, bool))
    with pytest.raises(UnrelatedDepthError, match="does not grow with the predicted depth"):
        fill_sensor_depth(depth, depth, mask, "inverse_depth")  # the wrong kind
    with pytest.raises(ValueError, match="one \\(H,W\\) is expected: prediction"):
        fill_sensor_depth(1 / depth, depth[1:], mask)
    with pytest.raises(ValueError, match="mask must be boolean"):
        fill_sensor_depth(1 / depth, depth, mask.astype(np.uint8))
    with pytest.raises(ValueError, match="unknown kind 'sonar'"):
        fill_sensor_depth(1 / depth, depth, mask, "sonar")
    with pytest.raises(ValueError, match="NaN or infinite"):
        fill_sensor_depth(np.full(SIZE, np.nan), depth, mask)


def test_a_wall_seen_from_the_front_fixes_a_factor():
    random = np.random.default_rng(0)
    depth = np.full(SIZE, 2.0) + 0.01 * random.standard_normal(SIZE)
    mask = scene()[1]
    prediction = 3 + 0.05 * random.standard_normal(SIZE) - 0.5 * (depth - 2) * -1
    filled = fill_sensor_depth(prediction, np.where(mask, 0, depth), mask)
    np.testing.assert_allclose(filled.depth[mask], 2, rtol=0.1)


# ---- checks before the fit ----


@pytest.mark.parametrize("kind", ["inverse_depth", "depth"])
def test_depth_of_another_place_is_told_from_depth_in_its_place(kind):
    """Noise of pixels, a wrong target and a smooth error do not look like another place; a moved map does."""
    for seed in range(4):
        depth, mask = scene(seed, (90, 120))
        random = np.random.default_rng(seed)
        prediction = predicted(depth, kind, 2.0, 0.1) * (1 + 0.05 * random.standard_normal(depth.shape))
        sensor = np.where(mask, depth + 1, depth)
        check_registration(prediction, sensor, ~mask, kind)
        moved, known = np.roll(sensor, (4, -7), (0, 1)), ~np.roll(mask, (4, -7), (0, 1))
        with pytest.raises(UnrelatedDepthError, match=r"moved by [678] pixels to the right and -[345] down: .*align"):
            check_registration(prediction, moved, known, kind)


def test_depth_in_the_wrong_unit_is_told():
    depth, _ = scene()
    check_range(depth, "a.npy", "m")
    with pytest.raises(ValueError, match=r"a\.npy: taken as m, its median depth is .* say --sensor-unit mm"):
        check_range(1000 * depth, "a.npy", "m")
    with pytest.raises(ValueError, match=r"a\.png: taken as mm, .* say --sensor-unit m$"):
        check_range(0.001 * depth, "a.png", "mm")
    with pytest.raises(ValueError, match=r"a\.png: no depth at all"):
        check_range(0 * depth, "a.png", "mm")
