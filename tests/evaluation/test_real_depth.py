"""Real ground truth through alignment and metrics: a Middlebury disparity map, and ClearGrasp's sensor depth."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers.booster_tree import metrics_by_hand
from PIL import Image

from gift_peft.evaluation.alignment import align
from gift_peft.evaluation.metrics import depth_metrics

DATA = Path(__file__).parents[3] / "shared" / "data"
MIDDLEBURY, CLEARGRASP = DATA / "middlebury_motorcycle", DATA / "cleargrasp_d435"
FOCAL, BASELINE, OFFSET = 994.978, 193.001, 31.086  # px, mm, px: of this pair, from its page


@pytest.fixture(scope="module")
def motorcycle():
    """Disparity (500,741) in px with its depth in mm, 0 where it is unknown."""
    if not MIDDLEBURY.is_dir():
        pytest.skip("the Middlebury pair is not beside the repository")
    disparity = np.load(MIDDLEBURY / "motorcycle_disp.npz")["arr_0"].astype(np.float64)
    seen = np.isfinite(disparity) & (disparity > 0)
    depth = np.zeros(disparity.shape)
    depth[seen] = FOCAL * BASELINE / (disparity[seen] + OFFSET)
    return np.where(seen, disparity, 0), depth, seen


def region(mask):
    """Every seventh pixel of a mask, so that the straight-line code has little to do."""
    kept = np.zeros_like(mask)
    kept.ravel()[np.flatnonzero(mask)[::7]] = True
    return kept


def test_disparity_of_a_real_pair_is_perfect_as_disparity_and_wrong_as_depth(motorcycle):
    disparity, depth, seen = motorcycle
    assert disparity.shape == (500, 741)
    # By hand: 50 px of disparity are 994.978 * 193.001 / 81.086 mm.
    assert pytest.approx(2368.24, abs=0.01) == FOCAL * BASELINE / (50 + OFFSET)
    found = align(disparity, depth, seen, "gift", "inverse_depth")
    assert found.scale == pytest.approx(1 / (FOCAL * BASELINE), rel=1e-9)
    assert found.shift == pytest.approx(OFFSET / (FOCAL * BASELINE), rel=1e-9)
    perfect = depth_metrics(found.aligned, depth, seen)
    assert perfect["mae"] < 1e-6 and perfect["rmse"] < 1e-6 and perfect["delta1"] == 100
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        literal = align(disparity, depth, seen, "gift-literal", "inverse_depth")
    design = np.stack([disparity[seen], np.ones(seen.sum())], 1)
    scale, shift = np.linalg.lstsq(design, depth[seen], rcond=None)[0]
    assert (literal.scale, literal.shift) == pytest.approx((scale, shift), rel=1e-9) and scale < 0
    kept = region(seen)
    aligned = np.clip(scale * disparity[kept] + shift, 1, 10000)
    expected = metrics_by_hand(list(zip(aligned, depth[kept], strict=True)))
    assert depth_metrics(literal.aligned, depth, kept) == pytest.approx(expected, rel=1e-9)
    assert expected["mae"] > 50


@pytest.mark.parametrize("protocol", ["gift", "depth4tom", "moge-affine"])
def test_a_coarse_disparity_of_a_real_pair_against_hand_computed_numbers(motorcycle, protocol):
    disparity, depth, seen = motorcycle
    coarse = np.floor(disparity / 8) * 8  # 8 px steps
    found = align(coarse, depth, seen, protocol, "inverse_depth")
    true = 1 / depth[seen]
    design = np.stack([coarse[seen], np.ones(seen.sum())], 1)
    scale, shift = np.linalg.lstsq(design, true, rcond=None)[0]
    kept, lowest = region(seen), true.min()
    pairs = []
    for value, y in zip(coarse[kept], depth[kept], strict=True):
        inverse = scale * value + shift
        if protocol == "moge-affine":
            pairs.append((1 / max(inverse, lowest), y))
        else:
            pairs.append((min(max(1 / inverse, 1), 10000), y))
    expected = metrics_by_hand(pairs)
    assert depth_metrics(found.aligned, depth, kept) == pytest.approx(expected, rel=1e-6)
    assert 10 < expected["mae"] < 500 and 50 < expected["delta1"] <= 100


@pytest.mark.parametrize("name", ["000000080", "000000130"])
def test_a_sensor_that_looks_through_plastic_against_the_sprayed_twin(name):
    """ClearGrasp: the depth camera's own reading of clear objects as a metric prediction, scored by hand."""
    folder = CLEARGRASP / name
    if not folder.is_dir():
        pytest.skip("the ClearGrasp sample scenes are not beside the repository")
    clear, sprayed = (
        np.asarray(Image.open(folder / f"{kind}_depth_mm.png")).astype(np.float64)
        for kind in ("transparent", "opaque")
    )
    target = np.asarray(Image.open(folder / "mask.png"))
    target = (target if target.ndim == 2 else target[..., 0]) > 127
    both = (clear > 0) & (sprayed > 0)
    assert both.mean() > 0.3 and (both & target).sum() > 1000
    metric = align(clear, sprayed, both, "metric")
    assert (metric.scale, metric.shift) == (1, 0)
    errors = {}
    for label, mask in (("target", both & target), ("other", both & ~target)):
        kept = region(mask)
        pairs = list(zip(np.clip(clear[kept], 1, 10000), sprayed[kept], strict=True))
        errors[label] = metrics_by_hand(pairs)
        assert depth_metrics(metric.aligned, sprayed, kept) == pytest.approx(errors[label], rel=1e-9)
    # What this package is for, in two numbers: the sensor is wrong on the plastic and right beside it.
    assert errors["target"]["mae"] > 2 * errors["other"]["mae"]
    affine = align(0.001 * clear + 5, sprayed, both, "gift")
    scale, shift = np.linalg.lstsq(np.stack([clear[both], np.ones(both.sum())], 1), sprayed[both], rcond=None)[0]
    assert affine.scale == pytest.approx(1000 * scale, rel=1e-6)
    kept = region(both & target)
    expected = metrics_by_hand(list(zip(np.clip(scale * clear[kept] + shift, 1, 10000), sprayed[kept], strict=True)))
    assert depth_metrics(affine.aligned, sprayed, kept) == pytest.approx(expected, rel=1e-6)
