"""`align` against numpy's lstsq, straight-line loops, and the affine invariance it exists for."""

import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.evaluation.alignment import align
from gift_peft.evaluation.fitting import DegenerateFitError
from gift_peft.evaluation.metrics import depth_metrics
from gift_peft.evaluation.protocols import PROTOCOLS, Protocol, get_protocol, list_protocols
from gift_peft.rules import KINDS

SHAPE = (7, 9)
ALL = np.ones(SHAPE, bool)


def scene(seed: int, low=400.0, high=6000.0) -> np.ndarray:
    """A random depth map in mm."""
    return np.random.default_rng(seed).uniform(low, high, SHAPE)


def lstsq(prediction, target):
    """Scale and shift by an SVD solver that shares nothing with the closed form."""
    columns = np.stack([prediction, np.ones_like(prediction)], axis=1)
    return np.linalg.lstsq(columns, target, rcond=None)[0]


seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=120, deadline=None)
@given(
    seeds,
    st.floats(1e-3, 1e3),
    st.floats(-1e3, 1e3),
    st.sampled_from([1, -1]),
    st.sampled_from([name for name, rules in PROTOCOLS.items() if rules.dof == "scale_shift"]),
    st.sampled_from([np.asarray, torch.from_numpy]),
)
def test_recovers_scale_and_shift(seed, scale, shift, sign, name, convert):
    truth = scene(seed)
    inverse = PROTOCOLS[name].space == "inverse"
    unit = 1e-6 if inverse else 1  # of 1/mm, beside mm
    scale, shift = scale * sign * unit, shift * unit
    prediction = ((1 / truth if inverse else truth) - shift) / scale
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a negative scale is told
        found = align(*map(convert, (prediction, truth, ALL)), name, "inverse_depth" if inverse else "depth")
    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert found.shift == pytest.approx(shift, rel=1e-9, abs=1e-9 * 6000 * unit)
    np.testing.assert_allclose(np.asarray(found.aligned), truth, rtol=1e-9)
    assert found.num_clipped == found.num_nonpositive == 0


@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(1e-3, 1e3), st.floats(-1e-2, 1e-2), st.sampled_from([1, -1]))
def test_recovers_scale_and_shift_of_disparity(seed, scale, shift, sign):
    truth, scale = scene(seed), scale * sign
    for name in ("gift", "depth4tom", "moge-affine"):
        found = align((1 / truth - shift) / scale, truth, ALL, name, "inverse_depth")
        assert found.scale == pytest.approx(scale, rel=1e-9)
        assert found.shift == pytest.approx(shift, rel=1e-9, abs=1e-12)
        np.testing.assert_allclose(found.aligned, truth, rtol=1e-9)


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from(["gift", "native"]), st.sampled_from(["depth", "inverse_depth"]))
def test_against_lstsq(seed, protocol, kind):
    rng = np.random.default_rng(seed)
    truth, prediction = scene(seed), rng.normal(3, 1, SHAPE)
    valid = rng.random(SHAPE) < 0.6
    found = align(prediction, truth, valid, protocol, kind)
    inverse = protocol == "gift" and kind == "inverse_depth"
    scale, shift = lstsq(prediction[valid], 1 / truth[valid] if inverse else truth[valid])
    assert found.scale == pytest.approx(scale, rel=1e-8)
    assert found.shift == pytest.approx(shift, rel=1e-8)
    nonpositive = clipped = 0
    for row in range(SHAPE[0]):
        for column in range(SHAPE[1]):
            value = scale * prediction[row, column] + shift
            nonpositive += value <= 0
            if inverse:
                value = 1 / value if value > 0 else 10000.0
            if protocol == "gift":
                clipped += not 1 <= value <= 10000 or (inverse and scale * prediction[row, column] + shift <= 0)
                value = min(max(value, 1.0), 10000.0)
            assert found.aligned[row, column] == pytest.approx(value, rel=1e-6)
    assert (found.num_nonpositive, found.num_clipped) == (nonpositive, clipped)


@settings(max_examples=40, deadline=None)
@given(seeds, st.floats(0.01, 100), st.floats(-50, 50), st.sampled_from(["depth", "inverse_depth"]))
def test_affine_changes_of_the_prediction_change_nothing(seed, scale, shift, kind):
    truth, prediction = scene(seed), np.random.default_rng([seed, 1]).uniform(1, 2, SHAPE)
    first = align(prediction, truth, ALL, "gift", kind)
    second = align(scale * prediction + shift, truth, ALL, "gift", kind)
    np.testing.assert_allclose(second.aligned, first.aligned, rtol=1e-6)


@pytest.mark.parametrize("convert", [np.asarray, torch.from_numpy])
def test_perfect_models_score_zero(convert):
    truth = scene(0)
    for kind, prediction in (("depth", 0.01 * truth - 3), ("inverse_depth", 7000 / truth + 2)):
        aligned = align(convert(prediction), convert(truth), convert(ALL), "gift", kind).aligned
        found = depth_metrics(aligned, convert(truth), convert(ALL))
        assert found["mae"] < 1e-6 and found["rmse"] < 1e-6 and found["abs_rel"] < 1e-9 and found["delta1"] == 100


def test_a_disparity_is_never_fitted_to_depth():
    truth = scene(1)
    wrong = align(1 / truth, truth, ALL, "gift", "depth").aligned
    assert depth_metrics(wrong, truth, ALL)["mae"] > 50


def test_batch_equals_single_images_in_any_order_and_type():
    truth = np.stack([scene(seed) for seed in range(4)])
    prediction = np.random.default_rng(9).normal(size=truth.shape)
    valid = np.random.default_rng(10).random(truth.shape) < 0.7
    batch = align(prediction, truth, valid, kind="inverse_depth")
    order = [2, 0, 3, 1]
    shuffled = align(prediction[order], truth[order], valid[order], kind="inverse_depth")
    tensors = align(*map(torch.from_numpy, (prediction, truth, valid)), kind="inverse_depth")
    assert isinstance(tensors.aligned, torch.Tensor) and tensors.aligned.dtype == torch.float64
    for index in range(4):
        single = align(prediction[index], truth[index], valid[index], kind="inverse_depth")
        for name in ("aligned", "scale", "shift", "num_clipped", "num_nonpositive"):
            expected = getattr(single, name)
            np.testing.assert_array_equal(getattr(batch, name)[index], expected)
            np.testing.assert_array_equal(getattr(shuffled, name)[order.index(index)], expected)
            np.testing.assert_array_equal(getattr(tensors, name)[index].numpy(), expected)
    assert isinstance(single.scale, float) and isinstance(single.num_clipped, int)


def test_half_precision_tensors_are_fitted_in_float64():
    truth = torch.from_numpy(scene(2))
    prediction = truth.to(torch.bfloat16)
    found = align(prediction, truth, torch.from_numpy(ALL))
    expected = lstsq(prediction.double().numpy().ravel(), truth.numpy().ravel())
    assert (found.scale, found.shift) == pytest.approx(tuple(expected), rel=1e-9)


def test_large_offsets_lose_no_digits():
    truth = scene(3)
    found = align(truth * 1e-6 + 1e4, truth, ALL)
    np.testing.assert_allclose(found.aligned, truth, rtol=1e-3)  # the input itself holds no more digits
    assert found.scale == pytest.approx(1e6, rel=1e-3)


def test_nonpositive_disparity_is_far_and_counted():
    truth = np.array([[1000.0, 2000.0, 4000.0, 5000.0]])
    disparity = 1 / truth
    prediction = np.append(disparity, [[0.0, -1e-3]], axis=1)
    reference = np.append(truth, [[0.0, np.nan]], axis=1)
    found = align(prediction, reference, np.ones(reference.shape, bool), "gift", "inverse_depth")
    np.testing.assert_allclose(found.aligned, [[1000, 2000, 4000, 5000, 10000, 10000]], rtol=1e-6)
    assert found.num_clipped == 2
    assert found.num_nonpositive == 1 + int(found.shift <= 0)  # the zero lands on the shift itself, +-1e-19


def test_negative_depth_takes_the_near_end_and_native_keeps_it():
    truth = np.array([[1000.0, 2000.0, 3000.0, 0.0]])
    prediction = np.array([[1.0, 2.0, 3.0, -1.0]])
    valid = np.ones(truth.shape, bool)
    clipped = align(prediction, truth, valid)
    assert clipped.aligned[0, 3] == 1.0 and clipped.num_clipped == clipped.num_nonpositive == 1
    native = align(prediction, truth, valid, "native")
    assert native.aligned[0, 3] == pytest.approx(-1000) and native.num_clipped == 0 and native.num_nonpositive == 1


def test_far_depth_is_clipped_to_ten_metres():
    truth = np.array([[1000.0, 9000.0, 0.0]])
    found = align(np.array([[1.0, 9.0, 12.0]]), truth, np.ones(truth.shape, bool))
    assert found.aligned[0, 2] == 10000 and (found.num_clipped, found.num_nonpositive) == (1, 0)


def test_unknown_reference_pixels_do_not_enter_the_fit():
    truth, valid = scene(4), ALL.copy()
    prediction = truth / 10
    damaged = truth.copy()
    damaged[0, :4] = [0, -5, np.nan, np.inf]
    np.testing.assert_allclose(align(prediction, damaged, valid).aligned, truth, rtol=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_predictions_are_errors(value):
    prediction = scene(5)
    prediction[3, 3] = value
    with pytest.raises(ValueError, match="prediction has 1 NaN or infinite"):
        align(prediction, scene(6), ALL)


@pytest.mark.parametrize("pixels", [0, 1])
def test_too_few_values_are_refused(pixels):
    valid = np.zeros(SHAPE, bool)
    valid[0, :pixels] = True
    with pytest.raises(DegenerateFitError, match="fewer than two distinct"):
        align(scene(7), scene(8), valid)


def test_constant_prediction_is_refused():
    with pytest.raises(DegenerateFitError, match="fewer than two distinct"):
        align(np.full(SHAPE, 3.3), scene(8), ALL)


def test_wrong_arguments():
    truth = scene(9)
    with pytest.raises(ValueError, match=r"shapes must agree.*reference \(7, 8\)"):
        align(truth, truth[:, :8], ALL)
    with pytest.raises(ValueError, match="shapes must agree"):
        align(truth[0], truth[0], ALL[0])
    with pytest.raises(ValueError, match="valid must be boolean, got uint8"):
        align(truth, truth, ALL.astype(np.uint8))
    with pytest.raises(ValueError, match="unknown kind 'disparity'"):
        align(truth, truth, ALL, kind="disparity")
    with pytest.raises(ValueError, match="unknown protocol 'mine': choose one of gift, native"):
        align(truth, truth, ALL, "mine")


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from(["depth4tom", "gift-literal", "ntire25", "moge-affine"]), st.sampled_from(KINDS))
def test_presets_against_straight_line_code(seed, name, kind):
    """Space, loss, floor, clip and the sign of disparity of each preset, pixel by pixel."""
    rng = np.random.default_rng(seed)
    truth, prediction = scene(seed), rng.normal(3, 1, SHAPE)
    if kind == "depth" and name == "depth4tom":
        prediction = np.abs(prediction) + 0.1
    valid = rng.random(SHAPE) < 0.6
    inverse = name == "depth4tom" or (name == "moge-affine" and kind == "inverse_depth")
    values = 1 / prediction if name == "depth4tom" and kind == "depth" else prediction
    target = 1 / truth if inverse else truth
    if name == "moge-affine" and kind == "depth":
        lines = []
        where = np.argwhere(valid)
        for i in range(len(where)):
            for j in range(i):
                (a, b), (c, d) = ((values[tuple(p)], target[tuple(p)]) for p in (where[i], where[j]))
                slope = (d - b) / (c - a)
                lines.append((slope, b - slope * a))
        costs = [np.sum(np.abs(s * values[valid] + t - target[valid]) / target[valid]) for s, t in lines]
        scale, shift = lines[int(np.argmin(costs))]
    else:
        scale, shift = lstsq(values[valid], target[valid])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = align(prediction, truth, valid, name, kind)
    assert (found.scale, found.shift) == pytest.approx((scale, shift), rel=1e-7)
    for row in range(SHAPE[0]):
        for column in range(SHAPE[1]):
            value = scale * values[row, column] + shift
            if inverse and name == "moge-affine":
                value = 1 / max(value, 1 / truth[valid].max())
            elif inverse:
                value = 1 / value
            if name != "moge-affine":
                value = min(max(value, 1.0), 10000.0)
            assert found.aligned[row, column] == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("convert", [np.asarray, torch.from_numpy])
def test_metric_changes_nothing_but_the_range(convert):
    truth = scene(1)
    prediction = truth * 1.1
    prediction[0, :2] = [-4, 20000]
    found = align(convert(prediction), convert(truth), convert(ALL), "metric")
    np.testing.assert_array_equal(np.asarray(found.aligned), np.clip(prediction, 1, 10000))
    assert (found.scale, found.shift, found.num_nonpositive, found.num_clipped) == (1, 0, 1, 2)
    constant = align(convert(np.full(SHAPE, 700.0)), convert(truth), convert(~ALL), "metric")
    assert (np.asarray(constant.aligned) == 700).all()
    with pytest.raises(ValueError, match="compares depth with depth; this is inverse depth"):
        align(prediction, truth, ALL, "metric", "inverse_depth")


def test_negative_disparity_is_near_in_depth4tom_and_zero_is_far():
    truth = np.array([[1000.0, 2000.0, 4000.0, 8000.0, 0, 0, 0]])
    prediction = np.array([[8.0, 4.0, 2.0, 1.0, 0.0, -1.0, 0.01]])
    valid = np.ones(truth.shape, bool)
    found = align(prediction, truth, valid, "depth4tom", "inverse_depth")
    # The zero lands within rounding of zero, on either side: only far from it is the sign a matter of the data.
    np.testing.assert_allclose(found.aligned[0, [0, 1, 2, 3, 5, 6]], [1000, 2000, 4000, 8000, 1, 10000], rtol=1e-9)
    far = align(prediction, truth, valid, "gift", "inverse_depth")
    assert far.aligned[0, 5] == 10000 and found.num_nonpositive == far.num_nonpositive >= 1
    mine = Protocol("mine", space="inverse", dof="none", clip=(1e-3, 10.0), nonpositive="near")
    disparity = np.array([[2.0, 1.0, 0.0, -1.0]])
    exact = align(disparity, np.ones(disparity.shape), disparity > 0, mine, "inverse_depth")
    np.testing.assert_array_equal(exact.aligned, [[0.5, 1, 10, 1e-3]])


def test_depth_without_an_inverse_stays_out_of_the_fit_and_is_near():
    truth = np.array([[1000.0, 2000.0, 4000.0, 500.0]])
    prediction = np.array([[1.0, 2.0, 4.0, -3.0]])
    found = align(prediction, truth, np.ones(truth.shape, bool), "depth4tom", "depth")
    np.testing.assert_allclose(found.aligned, [[1000, 2000, 4000, 1]], rtol=1e-9)
    assert (found.num_nonpositive, found.num_clipped) == (1, 1)


def test_fits_of_disparity_to_depth_are_told():
    truth = scene(3)
    with pytest.warns(UserWarning, match="gift-literal fits inverse depth straight to depth"):
        assert align(1 / truth, truth, ALL, "gift-literal", "inverse_depth").scale < 0
    with pytest.warns(UserWarning, match="the fitted scale is negative"):
        align(1 / truth, truth, ALL, "gift-literal", "depth")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        align(truth / 7, truth, ALL, "gift-literal", "depth")
        align(1 / truth, truth, ALL, "gift", "inverse_depth")


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0.01, 100), st.floats(-50, 50), st.sampled_from(list(PROTOCOLS)), st.sampled_from(KINDS))
def test_metrics_do_not_change_under_affine_changes_in_the_fitted_space(seed, scale, shift, name, kind):
    rules = PROTOCOLS[name]
    if rules.dof == "none":
        return
    truth, values = scene(seed), np.random.default_rng([seed, 1]).uniform(1, 2, SHAPE)
    changed = scale * values + abs(shift)
    if rules.space == "inverse" and kind == "depth":  # what is fitted is its inverse
        values, changed = 1 / values, 1 / changed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        first, second = (
            depth_metrics(align(p, truth, ALL, rules, kind).aligned, truth, ALL) for p in (values, changed)
        )
    assert second == pytest.approx(first, rel=1e-5, abs=1e-9)


def test_protocols_state_their_choices():
    names = ["gift", "native", "gift-literal", "depth4tom", "ntire24", "tricky24", "ntire25", "moge-affine", "metric"]
    assert list(PROTOCOLS) == [*names, "ntire26"]
    listed = list_protocols()
    for name, protocol in PROTOCOLS.items():
        assert protocol.name == name and protocol.source in listed and f"{name}: " in listed
        assert protocol.describe() in listed
    assert "clip 1..10000 mm" in PROTOCOLS["gift"].describe()
    assert "no clipping" in PROTOCOLS["native"].describe()
    assert "no alignment" in PROTOCOLS["metric"].describe() and "l2" not in PROTOCOLS["metric"].describe()
    assert "negative inverse depth is near" in PROTOCOLS["depth4tom"].describe()
    for wrong in ({"space": "both"}, {"dof": "gain"}, {"loss": "l1"}, {"floor": "min"}):
        with pytest.raises(ValueError, match=f"protocol 'mine': {next(iter(wrong))} .*; what is computed is"):
            Protocol("mine", **{"space": "depth"} | wrong)
    for space in ("auto", "inverse"):
        with pytest.raises(ValueError, match="inverting may give an infinite depth"):
            Protocol("mine", space=space)
    with pytest.raises(ValueError, match="the lower end comes first"):
        Protocol("mine", space="auto", clip=(10.0, 1.0))
    mine = Protocol("mine", space="auto", clip=(1.0, 2000.0))
    assert get_protocol(mine) is mine and mine.to_dict()["clip"] == [1.0, 2000.0]
    assert align(scene(1) / 5, scene(1), ALL, mine).aligned.max() == 2000
