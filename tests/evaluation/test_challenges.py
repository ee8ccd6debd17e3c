"""The challenges on Booster: stricter factors, what they rank by, and metric depth in centimeters."""

import json
import warnings

import numpy as np
import pytest
from helpers.booster_tree import write_predictions, write_root
from helpers.tiny import tiny_processor

from gift_peft import align, depth_metrics, evaluate_booster
from gift_peft.evaluation.booster_scenes import find_booster, read_ground_truth
from gift_peft.evaluation.protocols import PROTOCOLS, Protocol
from gift_peft.evaluation.results import Report
from gift_peft.evaluation.table_formats import to_latex
from gift_peft.evaluation.tables import comparison_table, markdown_table, text_table, uncertainty_table

STRICT = ("delta_1.05", "delta_1.10", "delta_1.15", "delta_1.20")


@pytest.mark.parametrize(("protocol", "resize"), [("ntire24", 1.0), ("tricky24", 0.25), ("ntire25", 1.0)])
def test_rows_have_the_stricter_factors(tmp_path, protocol, resize):
    truths = write_root(tmp_path)
    maps = write_predictions(tmp_path / "pred", truths)
    options = {"predictions": tmp_path / "pred", "kind": "depth", "protocol": protocol, "resize": resize}
    with pytest.warns(UserWarning, match="fitted scale is negative"):  # what is stored is disparity
        report = evaluate_booster(tmp_path, progress=False, **options)
    assert list(report.summary["tom"]) == ["mae", "abs_rel", "rmse", "delta1", *STRICT]
    scene = find_booster(tmp_path).scenes[0]
    truth = read_ground_truth(scene, resize)
    row = report.rows[0]
    if resize == 1:
        known = truth.depth > 0
        with pytest.warns(UserWarning, match="fitted scale is negative"):
            aligned = align(maps["Scene0", 0], truth.depth, known, protocol).aligned
        ratio = np.maximum(aligned / np.where(known, truth.depth, 1), truth.depth / aligned)[known & truth.tom]
        for name, factor in zip(STRICT, (1.05, 1.1, 1.15, 1.2), strict=True):
            assert row["base"]["tom"][name] == pytest.approx(100 * (ratio < factor).mean(), abs=1e-9)
    ordered = [row["base"]["tom"][name] for name in (*STRICT, "delta1")]
    assert ordered == sorted(ordered)
    assert report.protocol["ranked_by"] == "delta_1.05" and "ranked by delta 1.05 on ToM" in markdown_table(report)
    text = text_table(report)
    assert "delta1.05" in text and "delta1.20" in text and max(map(len, text.splitlines())) <= 80
    assert "δ1.05" in " ".join(comparison_table([("a", report)]).columns)
    assert r"$\delta_{1.05}$" in to_latex(uncertainty_table(report))
    report.save(tmp_path / "out")
    again = Report.load(tmp_path / "out")
    assert again.summary["tom"]["delta_1.05"] == report.summary["tom"]["delta_1.05"]
    assert text_table(again) == text


def test_metric_depth_in_centimeters_by_hand(tmp_path):
    truths = write_root(tmp_path, scenes=1, images=1)
    folder = tmp_path / "pred" / "Scene0" / "camera_00"
    folder.mkdir(parents=True)
    truth = truths["Scene0"]
    depth = truth["product"] / np.where(truth["disparity"] > 0, truth["disparity"], 1)  # mm
    np.save(folder / "im0.npy", (depth + 120) / 1000)  # metres, 12 cm too far
    options = {"predictions": tmp_path / "pred", "kind": "depth", "resize": 1.0, "prediction_scale": 1000}
    report = evaluate_booster(tmp_path, progress=False, protocol="ntire26", **options)
    assert report.unit == "cm" and "(cm)" in markdown_table(report) and "clip 0.1..1000 cm" in markdown_table(report)
    for region in ("tom", "other", "all"):
        assert report.summary[region]["rmse"] == pytest.approx(12, abs=1e-4)
        assert report.summary[region]["mae"] == pytest.approx(12, abs=1e-4)
    millimeters = evaluate_booster(tmp_path, progress=False, protocol="metric", **options | {"resize": 1.0})
    for metric, factor in (("mae", 10), ("rmse", 10), ("abs_rel", 1), ("delta1", 1)):
        own, other = report.summary["tom"][metric], millimeters.summary["tom"][metric]
        assert factor * own == pytest.approx(other, rel=1e-9)
    report.save(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["unit"] == "cm"


def test_a_model_of_unknown_unit_under_a_metric_protocol_is_told(tmp_path):
    write_root(tmp_path, scenes=1, images=1)
    options = {"size": (56, 70), "processor": tiny_processor(), "kind": "depth", "progress": False}

    def depth(pixels):
        return 800 + pixels.mean(1)

    with pytest.warns(UserWarning, match=r"ntire26 fits no scale, and nothing says that this model predicts metres"):
        evaluate_booster(tmp_path, depth, protocol="ntire26", resize=1.0, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evaluate_booster(tmp_path, depth, protocol="ntire26", resize=1.0, prediction_scale=1, **options)


def test_protocols_name_what_they_rank_by():
    assert {name for name, own in PROTOCOLS.items() if own.ranked_by} == {"ntire24", "tricky24", "ntire25", "ntire26"}
    assert PROTOCOLS["ntire26"].ranked_by == "rmse" and not PROTOCOLS["ntire26"].fits_scale
    with pytest.raises(ValueError, match="thresholds"):
        Protocol("mine", space="depth", thresholds=(0.9,))
    with pytest.raises(ValueError, match=r"ranked_by 'delta_1\.05'; what is computed is mae"):
        Protocol("mine", space="depth", ranked_by="delta_1.05")
    with pytest.raises(ValueError, match="unit 'inch'"):
        Protocol("mine", space="depth", unit="inch")
    assert depth_metrics(np.ones((1, 2)), np.ones((1, 2)), np.ones((1, 2), bool))["delta1"] == 100
