"""Safety figures: free space that is not there and flicker, by hand and through the evaluation."""

import json
import math

import numpy as np
import pytest
import torch
from helpers.tiny import SIZE, tiny_processor
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.writer import write_gift_i
from gift_peft.evaluation.evaluate import evaluate_gift_i
from gift_peft.evaluation.results import Report
from gift_peft.evaluation.safety import Flicker, false_free_space
from gift_peft.evaluation.tables import text_table


def test_behind_by_both_a_tenth_and_twenty_centimetres():
    truth = np.array([[1000.0, 1000, 1000, 4000, 4000, 0, 1000]])
    found = np.array([[1201.0, 1200, 800, 4399, 4401, 9999, 9999]])
    target = np.array([[True, True, True, True, True, True, False]])
    assert false_free_space(found, truth, target) == pytest.approx(100 * 2 / 5)
    assert math.isnan(false_free_space(found, truth, np.zeros_like(target)))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.integers(2, 6))
def test_flicker_is_the_standard_deviation_where_two_masks_meet(seed, count):
    random = np.random.default_rng(seed)
    depths = random.uniform(500, 5000, (count, 6, 7))
    masks = random.random((count, 6, 7)) < 0.6
    flicker = Flicker()
    for depth, mask in zip(depths, masks, strict=True):
        flicker.update(depth, mask)
    several = masks.sum(0) >= 2
    spreads = [np.std(depths[masks[:, y, x], y, x]) for y, x in zip(*np.nonzero(several), strict=True)]
    assert flicker.compute() == pytest.approx(np.mean(spreads) if spreads else math.nan, nan_ok=True)


@pytest.fixture
def groups(tmp_path):
    """A group of two with true depth: a wall at 2 to 3 m with a target at 1.5 m."""
    depth = np.tile(np.linspace(2000, 3000, SIZE[1]), (SIZE[0], 1))
    mask = np.zeros(SIZE, bool)
    mask[10:30, 20:40] = True
    depth[mask] = 1500
    random = np.random.default_rng(0)
    pictures = [Image.fromarray(random.integers(0, 255, (*SIZE, 3), dtype=np.uint8)) for _ in range(2)]
    group = {"split": "validation", "group_id": "g", "images": pictures, "masks": [mask] * 2, "surface": "mirror"}
    write_gift_i([group | {"depths": [np.rint(depth).astype(np.uint16)] * 2}], tmp_path, license="cc0-1.0")
    return load_gift_i(tmp_path, "validation"), torch.from_numpy(np.rint(depth)).float(), torch.from_numpy(mask)


def evaluate(groups, model, teacher, **options):
    options = {"processor": tiny_processor(), "size": SIZE, "progress": False, "kind": "depth"} | options
    return evaluate_gift_i(groups, model, teacher, reference="depth", protocol="metric", **options)


def test_the_report_has_both_figures_of_both_models_where_depth_is_known(groups, tmp_path):
    dataset, depth, mask = groups
    through = torch.stack([torch.where(mask, depth + 100 * k, depth) for k in (1, 9)])  # 0.1 and 0.9 m behind it
    report = evaluate(dataset, lambda pixels: torch.stack([depth, depth]), lambda pixels: through)
    assert report.safety == {
        "base": {"false_free_space": 50, "flicker": pytest.approx(400)},
        "adapted": {"false_free_space": 0, "flicker": 0},
    }
    assert [row["base"]["false_free_space"] for row in report.rows] == [0, 100]
    text = text_table(report)
    assert "False free space %" in text and "Flicker mm" in text and "more than 10 % and 200 mm behind" in text
    loaded = Report.load(report.save(tmp_path / "saved"))
    assert loaded.safety == report.safety
    metrics = tmp_path / "saved" / "metrics.json"
    values = json.loads(metrics.read_text())
    del values["safety"]  # as versions before it left it
    metrics.write_text(json.dumps(values))
    assert Report.load(tmp_path / "saved").safety is None


def test_a_base_alone_and_proxies(groups):
    dataset, depth, _ = groups
    alone = evaluate(dataset, lambda pixels: torch.stack([depth, depth]), None)
    assert alone.safety == {"base": {"false_free_space": 0, "flicker": 0}}
    options = {"processor": tiny_processor(), "size": SIZE, "progress": False, "kind": "depth"}
    against_proxy = evaluate_gift_i(dataset, lambda pixels: torch.stack([depth, depth]), **options)
    assert against_proxy.safety is None and "Flicker" not in text_table(against_proxy)
