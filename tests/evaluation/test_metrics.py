"""`depth_metrics` against a loop over pixels, and the traps other evaluators fall into."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.evaluation.metrics import METRICS, depth_metrics, metric_names


def by_loop(aligned, reference, region):
    """Pixel by pixel, written from the definitions."""
    absolute = relative = square = inside = count = 0
    for d, y, use in zip(aligned.ravel(), reference.ravel(), region.ravel(), strict=True):
        if use and y > 0:
            count += 1
            absolute += abs(d - y)
            relative += abs(d - y) / y
            square += (d - y) ** 2
            inside += d > 0 and d / y < 1.25 and y / d < 1.25
    return {
        "mae": absolute / count,
        "abs_rel": relative / count,
        "rmse": (square / count) ** 0.5,
        "delta1": 100 * inside / count,
    }


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([np.asarray, torch.from_numpy]))
def test_against_a_loop(seed, convert):
    rng = np.random.default_rng(seed)
    reference = rng.uniform(-0.2, 3, (5, 6))
    aligned = reference * rng.normal(1, 0.4, (5, 6))
    region = rng.random((5, 6)) < 0.8
    region[0, 0], reference[0, 0] = True, 1.0
    found = depth_metrics(convert(aligned), convert(reference), convert(region))
    assert found == pytest.approx(by_loop(aligned, reference, region), rel=1e-12)
    assert all(isinstance(value, float) for value in found.values())


def test_batches_are_image_metrics():
    rng = np.random.default_rng(0)
    reference = rng.uniform(1, 3, (3, 4, 5))
    aligned = reference + rng.normal(0, 0.3, reference.shape)
    region = rng.random(reference.shape) < 0.5
    region[1] = False
    batch = depth_metrics(aligned, reference, region)
    tensors = depth_metrics(*map(torch.from_numpy, (aligned, reference, region)))
    for index in range(3):
        single = depth_metrics(aligned[index], reference[index], region[index])
        for name in METRICS:
            np.testing.assert_array_equal(batch[name][index], single[name])
            np.testing.assert_array_equal(tensors[name][index].numpy(), single[name])


def test_image_mean_is_not_the_pixel_mean():
    reference = np.ones((2, 1, 10))
    aligned = reference + np.array([0.1, 0.5])[:, None, None]
    region = np.ones(reference.shape, bool)
    region[1, 0, 1:] = False
    images = depth_metrics(aligned, reference, region)
    assert images["mae"].mean() == pytest.approx(0.3)
    assert np.abs(aligned - reference)[region].mean() == pytest.approx((10 * 0.1 + 0.5) / 11)


def test_an_empty_region_is_nan_never_zero():
    ones = np.ones((2, 2))
    for reference, region in ((ones, np.zeros((2, 2), bool)), (ones * 0, np.ones((2, 2), bool))):
        assert all(np.isnan(value) for value in depth_metrics(ones, reference, region).values())


def test_negative_values_are_never_inside_delta1():
    reference = np.full((1, 4), 2.0)
    found = depth_metrics(np.array([[-2.0, 0.0, -1e-9, 2.0]]), reference, np.ones((1, 4), bool))
    assert found["delta1"] == 25


def test_delta1_is_strict():
    reference = np.array([[4.0, 4.0, 5.0, 5.0]])
    found = depth_metrics(np.array([[5.0, 4.999, 4.0, 4.001]]), reference, np.ones((1, 4), bool))
    assert found["delta1"] == 50


def test_non_finite_values_in_the_region_are_errors():
    reference, region = np.ones((1, 3)), np.array([[True, True, False]])
    assert depth_metrics(np.array([[1.0, 1.0, np.nan]]), reference, region)["mae"] == 0
    for value in (np.nan, np.inf):
        with pytest.raises(ValueError, match="aligned has 1 NaN or infinite"):
            depth_metrics(np.array([[1.0, value, 1.0]]), reference, region)


def test_wrong_arguments():
    ones = np.ones((2, 2))
    with pytest.raises(ValueError, match="region must be boolean, got float64"):
        depth_metrics(ones, ones, ones)
    with pytest.raises(ValueError, match="shapes must agree"):
        depth_metrics(ones, np.ones((2, 3)), ones > 0)


def test_stricter_factors_worked_by_hand():
    reference = np.full((1, 6), 100.0)
    values = np.array([[100.0, 104.9, 107.0, 112.0, 84.0, -100.0]])  # ratios 1, 1.049, 1.07, 1.12, 1.1905, none
    found = depth_metrics(values, reference, np.ones((1, 6), bool), (1.05, 1.1, 1.15, 1.2))
    assert list(found) == list(metric_names((1.05, 1.1, 1.15, 1.2)))
    expected = {"delta_1.05": 2, "delta_1.10": 3, "delta_1.15": 4, "delta_1.20": 5, "delta1": 5}
    for name, count in expected.items():
        assert found[name] == pytest.approx(100 * count / 6, abs=1e-9), name
    plain = depth_metrics(values, reference, np.ones((1, 6), bool))
    assert plain == {name: found[name] for name in METRICS}
    empty = depth_metrics(values, reference, np.zeros((1, 6), bool), (1.05,))
    assert list(empty) == [*METRICS, "delta_1.05"] and all(map(np.isnan, empty.values()))
    batch = depth_metrics(np.stack([values] * 2), np.stack([reference] * 2), np.ones((2, 1, 6), bool), (1.05,))
    assert batch["delta_1.05"].tolist() == [found["delta_1.05"]] * 2
