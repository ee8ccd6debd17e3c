"""Every fit against an oracle of another kind: all candidate lines, SVD, the gradient at the optimum."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.evaluation.fitting import DegenerateFitError, fit, nearest_to_grid

seeds = st.integers(0, 2**32 - 1)
LOSSES = ["l2", "l1_rel"]
losses = st.sampled_from(LOSSES)


def points(seed: int, count: int, ties: bool = False):
    """Predictions and positive targets; with `ties` on a coarse grid, where residuals and slopes coincide."""
    rng = np.random.default_rng(seed)
    if ties:
        return rng.integers(-3, 4, count).astype(float), rng.integers(1, 5, count).astype(float)
    return rng.normal(3, 2, count), rng.uniform(0.2, 9, count)


def relative_l1(prediction, target, scale, shift):
    return float(np.sum(np.abs(scale * prediction + shift - target) / target))


def best_line_by_trying(prediction, target):
    """The smallest relative L1 of all lines through two points: one of them is best."""
    lines = []
    for i in range(len(prediction)):
        for j in range(i):
            if prediction[i] != prediction[j]:
                slope = (target[i] - target[j]) / (prediction[i] - prediction[j])
                lines.append((slope, target[i] - slope * prediction[i]))
    return min(relative_l1(prediction, target, *line) for line in lines)


@settings(max_examples=150, deadline=None)
@given(seeds, st.integers(3, 14), st.booleans())
def test_l1_is_the_best_of_all_lines(seed, count, ties):
    prediction, target = points(seed, count, ties)
    prediction[:2] = [1, 2]  # two distinct ones
    found = relative_l1(prediction, target, *fit(prediction, target, "l1_rel"))
    assert found == pytest.approx(best_line_by_trying(prediction, target), rel=1e-9, abs=1e-12)


@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(1e-4, 1e4), st.floats(0, 100), losses)
def test_every_loss_recovers_an_exact_relation(seed, scale, shift, loss):
    prediction = np.random.default_rng(seed).uniform(1, 3, 80)
    found = fit(prediction, scale * prediction + shift, loss)
    assert found[0] == pytest.approx(scale, rel=1e-9)
    assert found[1] == pytest.approx(shift, rel=1e-9, abs=1e-9 * max(scale, shift))


def test_l1_ignores_what_least_squares_follows():
    prediction, _ = points(0, 400)
    target = 2 * prediction + 30 + np.random.default_rng(1).normal(0, 0.01, 400)
    target[::7] += 500
    assert fit(prediction, target, "l1_rel") == pytest.approx((2, 30), rel=0.03)
    assert fit(prediction, target, "l2")[1] > 60


@settings(max_examples=60, deadline=None)
@given(seeds, st.integers(2, 50))
def test_least_squares_against_svd(seed, count):
    prediction, target = points(seed, count)
    expected = np.linalg.lstsq(np.stack([prediction, np.ones(count)], 1), target, rcond=None)[0]
    assert fit(prediction, target, "l2") == pytest.approx(expected, rel=1e-7)


@settings(max_examples=40, deadline=None)
@given(seeds, st.floats(0.01, 100), st.floats(-50, 50), losses)
def test_the_line_does_not_depend_on_the_predictions_units(seed, scale, shift, loss):
    prediction, target = points(seed, 41)
    first = np.polyval(fit(prediction, target, loss), prediction)
    second = np.polyval(fit(scale * prediction + shift, target, loss), scale * prediction + shift)
    np.testing.assert_allclose(second, first, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("loss", LOSSES)
def test_what_cannot_be_fitted(loss):
    for prediction in (np.ones(5), np.empty(0)):
        with pytest.raises(DegenerateFitError, match="fewer than two distinct values"):
            fit(prediction, prediction + 1, loss)


def test_the_subsample_takes_the_valid_pixel_nearest_to_each_centre():
    rng = np.random.default_rng(0)
    mask = rng.random((37, 50)) < 0.3
    mask[:10, :14] = False
    kept = nearest_to_grid(mask, 5)
    expected = np.zeros_like(mask)
    for i in range(5):
        for j in range(5):
            best = None
            for row, column in zip(*np.nonzero(mask), strict=True):
                y, x = (row + 0.5) * 5 / 37, (column + 0.5) * 5 / 50
                if int(y) == i and int(x) == j:
                    distance = (y - i - 0.5) ** 2 + (x - j - 0.5) ** 2
                    if best is None or distance < best[0] - 1e-12:
                        best = distance, row, column
            if best:
                expected[best[1:]] = True
    np.testing.assert_array_equal(kept, expected)
    assert 0 < kept.sum() < 25
    np.testing.assert_array_equal(nearest_to_grid(mask), mask)  # no larger than the grid
