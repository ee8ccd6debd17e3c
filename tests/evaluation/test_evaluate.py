"""`evaluate_gift_i` on groups whose predictions are known to the pixel: rows, summaries, GCE, collapse and counts."""

import json
import math

import numpy as np
import pytest
import torch

from gift_peft.dataset.tensors import Group
from gift_peft.evaluation.evaluate import evaluate_gift_i
from gift_peft.evaluation.results import REGIONS, Report
from gift_peft.evaluation.samples import consensus

H, W = 6, 8


def base_of(pixel_values):
    """The base reads its prediction from channel 0, the adapted model from channel 1."""
    return pixel_values[:, 0]


def adapted_of(pixel_values):
    return pixel_values[:, 1]


def make_group(seed, count=3, surface=None, valid=False, reference=True) -> Group:
    rng = np.random.default_rng(seed)
    pictures = torch.from_numpy(rng.uniform(0.5, 3, (count, 3, H, W)).astype(np.float32))
    mask = torch.from_numpy(rng.random((count, H, W)) < 0.4)
    target = torch.from_numpy(rng.uniform(-0.1, 3, (H, W)).astype(np.float32))
    return Group(
        group_id=f"group-{seed}",
        names=[f"{index}.png" for index in range(count)],
        pixel_values=pictures,
        mask=mask,
        valid=torch.from_numpy(rng.random((count, H, W)) < 0.8) if valid else None,
        reference_target=target if reference else None,
        surface=surface,
    )


def evaluate(groups, model=adapted_of, teacher=base_of, **options):
    return evaluate_gift_i(groups, model, teacher, progress=False, **options)


def oracle(prediction, reference, mask, valid):
    """Metrics of one image, from the paper's equations, pixel by pixel."""
    use = [(r, c) for r in range(H) for c in range(W) if valid[r, c] and reference[r, c] > 0]
    columns = np.array([[float(prediction[p]), 1.0] for p in use])
    scale, shift = np.linalg.lstsq(columns, np.array([float(reference[p]) for p in use]), rcond=None)[0]
    result = {}
    for region in REGIONS:
        pairs = [
            (scale * float(prediction[p]) + shift, float(reference[p]))
            for p in use
            if region == "all" or bool(mask[p]) == (region == "tom")
        ]
        result[region] = {
            "mae": sum(abs(d - y) for d, y in pairs) / len(pairs),
            "abs_rel": sum(abs(d - y) / y for d, y in pairs) / len(pairs),
            "rmse": (sum((d - y) ** 2 for d, y in pairs) / len(pairs)) ** 0.5,
            "delta1": 100 * sum(d > 0 and max(d / y, y / d) < 1.25 for d, y in pairs) / len(pairs),
        }
    return result


def median_of_targets(prediction, region):
    result = prediction.clone()
    for row in range(H):
        for column in range(W):
            seen = [float(prediction[i, row, column]) for i in range(len(prediction)) if region[i, row, column]]
            for i in range(len(prediction)):
                if region[i, row, column]:
                    result[i, row, column] = sorted(seen)[len(seen) // 2] / 2 + sorted(seen)[(len(seen) - 1) // 2] / 2
    return result


def gce_by_pairs(prediction, region):
    """Eqs. 1-3, pair by pair."""
    errors = []
    for i in range(len(prediction)):
        for j in range(i):
            both = region[i] & region[j]
            if both.any():
                errors.append(float((prediction[i] - prediction[j]).double().abs()[both].mean()))
    return sum(errors) / len(errors)


@pytest.mark.parametrize("valid", [False, True])
def test_rows_and_summaries_against_straight_line_code(valid):
    groups = [make_group(seed, count, valid=valid) for seed, count in ((0, 2), (1, 3), (2, 5))]
    report = evaluate(groups)
    rows = iter(report.rows)
    expected = {"base": [], "adapted": [], "consensus": []}
    for group in groups:
        everywhere = torch.ones_like(group.mask) if group.valid is None else group.valid
        predictions = {"base": group.pixel_values[:, 0], "adapted": group.pixel_values[:, 1]}
        predictions["consensus"] = median_of_targets(predictions["base"], group.mask & everywhere)
        for index, name in enumerate(group.names):
            row = next(rows)
            assert (row["group_id"], row["image"], row["skipped"]) == (group.group_id, name, None)
            assert row["target_pixels"] == int((group.mask & everywhere)[index].sum())
            for model, prediction in predictions.items():
                found = oracle(prediction[index], group.reference_target, group.mask[index], everywhere[index])
                for region in REGIONS:
                    assert row[model][region] == pytest.approx(found[region], rel=1e-5)
                expected[model].append(found)
    for model, summary in (("base", report.base), ("adapted", report.summary), ("consensus", report.consensus)):
        for region in REGIONS:
            for metric, value in summary[region].items():
                assert value == pytest.approx(np.mean([found[region][metric] for found in expected[model]]), rel=1e-5)
    assert report.counts == {
        "groups": 3,
        "images": 10,
        "scored": 10,
        "skipped": 0,
        "reasons": {},
        "without_tom": 0,
        "without_other": 0,
    }


@pytest.mark.parametrize("valid", [False, True])
def test_gce_against_a_loop_over_pairs(valid):
    groups = [make_group(seed, valid=valid) for seed in range(3)]
    gce = evaluate(groups).gce
    for channel, model in enumerate(("base", "adapted")):
        values, normalized = [], []
        for group in groups:
            everywhere = torch.ones_like(group.mask) if group.valid is None else group.valid
            value = gce_by_pairs(group.pixel_values[:, channel], group.mask & everywhere)
            spread = np.subtract(*np.percentile(group.pixel_values[:, channel][everywhere], (95, 5)))
            values.append(value)
            normalized.append(value / spread)
        assert gce[model] == pytest.approx(np.mean(values), rel=1e-5)
        assert gce[f"{model}_normalized"] == pytest.approx(np.mean(normalized), rel=1e-5)
    assert (gce["num_groups"], gce["num_skipped"]) == (3, 0)


def test_groups_without_a_pair_are_left_out_of_gce_and_counted():
    single = make_group(0, count=1)
    apart = make_group(1, count=2)
    apart.mask = torch.stack([apart.mask[0], ~apart.mask[0]])
    report = evaluate([single, apart, make_group(2)])
    assert (report.gce["num_groups"], report.gce["num_skipped"]) == (1, 2)
    assert report.gce["base"] == pytest.approx(evaluate([make_group(2)]).gce["base"])
    assert report.counts["scored"] == 6
    assert math.isnan(evaluate([single]).gce["adapted"])


def test_consensus_is_the_median_inside_the_target_only():
    prediction = torch.arange(4.0)[:, None, None] * torch.ones(4, 1, 2) + torch.tensor([0.0, 10.0])
    mask = torch.tensor([True, True, True, False])[:, None, None] & torch.tensor([True, False])
    assert consensus(prediction, mask).tolist() == [[[1, 10]], [[1, 11]], [[1, 12]], [[3, 13]]]
    valid = torch.tensor([True, True, False, True])[:, None, None].expand(4, 1, 2)
    assert consensus(prediction, mask, valid).tolist() == [[[0.5, 10]], [[0.5, 11]], [[2, 12]], [[3, 13]]]
    nowhere = torch.zeros_like(mask)
    assert torch.equal(consensus(prediction, nowhere), prediction)


def test_order_of_groups_does_not_matter():
    groups = [make_group(seed, surface="mirror" if seed % 2 else "transparent") for seed in range(5)]
    first, second = evaluate(groups), evaluate([groups[index] for index in (3, 1, 4, 0, 2)])
    assert first.summary == second.summary and first.consensus == second.consensus
    assert first.gce == second.gce and first.collapse == second.collapse and first.by_surface == second.by_surface


def test_affine_changes_of_the_adapted_model_change_nothing_but_collapse_and_gce():
    groups = [make_group(seed) for seed in range(2)]
    first = evaluate(groups)
    second = evaluate(groups, lambda pixels: 0.25 * pixels[:, 1] + 0.1)
    for region in REGIONS:
        assert second.summary[region] == pytest.approx(first.summary[region], rel=1e-4)
    assert second.gce["adapted"] == pytest.approx(0.25 * first.gce["adapted"], rel=1e-4)
    assert second.gce["adapted_normalized"] == pytest.approx(first.gce["adapted_normalized"], rel=1e-4)
    assert second.collapse["spread_ratio"] == pytest.approx(0.25 * first.collapse["spread_ratio"], rel=1e-4)
    assert second.collapse["alarm"] and not first.collapse["alarm"]


@pytest.mark.parametrize(("factor", "alarm"), [(0.45, True), (0.55, False), (1.9, False), (2.1, True)])
def test_collapse_alarm_is_outside_half_to_twice(factor, alarm):
    report = evaluate([make_group(0)], lambda pixels: factor * pixels[:, 0])
    assert report.collapse["target_mean_ratio"] == pytest.approx(factor, rel=1e-5)
    assert report.collapse["spread_ratio"] == pytest.approx(factor, rel=1e-5)
    assert report.collapse["alarm"] is alarm


def test_a_constant_prediction_is_skipped_counted_and_raises_the_alarm():
    report = evaluate([make_group(0), make_group(1)], lambda pixels: 1.5 + 0 * pixels[:, 0])
    assert report.counts["reasons"] == {"with a constant adapted prediction": 6}
    assert math.isnan(report.summary["tom"]["rmse"]) and report.base["tom"]["rmse"] > 0
    assert report.collapse["spread_ratio"] == 0 and report.collapse["alarm"]
    assert report.gce["adapted"] == 0


def test_missing_references_and_empty_targets_are_counted_not_averaged():
    blind, clear = make_group(0, reference=False), make_group(1)
    clear.mask[0] = False
    report = evaluate([blind, clear])
    assert report.counts["reasons"] == {"without a treated reference": 3}
    assert (report.counts["scored"], report.counts["skipped"], report.counts["without_tom"]) == (3, 3, 1)
    tom = [row["adapted"]["tom"]["mae"] for row in report.rows]
    assert [math.isnan(value) for value in tom] == [True] * 4 + [False] * 2
    assert report.summary["tom"]["mae"] == pytest.approx(np.mean(tom[4:]))
    assert report.gce["num_groups"] == 2


def test_protocols_that_do_not_fit_the_reference_are_refused():
    with pytest.raises(ValueError, match='protocol gift aligns to depth in mm; proxies are in native units: use "nat'):
        evaluate([make_group(0)], protocol="gift")
    with pytest.raises(ValueError, match="protocol native would fit inverse depth straight to depth"):
        evaluate([make_group(0)], protocol="native", reference="depth", kind="inverse_depth")


def test_no_target_anywhere_is_no_collapse():
    group = make_group(0)
    group.mask[:] = False
    report = evaluate([group])
    assert math.isnan(report.collapse["target_mean_ratio"]) and not report.collapse["alarm"]
    assert evaluate([group], lambda pixels: 0.3 * pixels[:, 0]).collapse["alarm"]
    assert evaluate([make_group(0)], teacher=lambda pixels: 0 * pixels[:, 0]).collapse["alarm"]


def test_without_references_there_is_gce_alone():
    report = evaluate([make_group(0, reference=False)])
    assert report.gce["adapted"] > 0 and math.isnan(report.summary["all"]["mae"]) and report.counts["scored"] == 0


def test_surfaces_have_their_own_summaries():
    groups = [make_group(0, surface="mirror"), make_group(1, count=2, surface="transparent"), make_group(2)]
    report = evaluate(groups)
    assert list(report.by_surface) == ["mirror", "transparent", "unknown"]
    for group, entry in zip(groups, report.by_surface.values(), strict=True):
        alone = evaluate([group])
        assert entry["num_images"] == len(group.names)
        assert (entry["summary"], entry["base"], entry["consensus"]) == (alone.summary, alone.base, alone.consensus)


def test_the_base_alone_and_the_model_alone():
    alone = evaluate([make_group(0)], base_of, None)
    both = evaluate([make_group(0)])
    assert not alone.adapted and alone.collapse is None and alone.gce["adapted"] is None
    assert alone.summary == alone.base == both.base and alone.consensus == both.consensus
    quick = evaluate([make_group(0)], baseline=False)
    assert quick.adapted and quick.base is quick.consensus is quick.collapse is None
    assert quick.summary == both.summary and quick.gce["adapted"] == both.gce["adapted"]


def test_groups_are_cut_in_image_order():
    calls = []

    def model(pixels):
        calls.append(pixels[:, 2, 0, 0].tolist())
        return pixels[:, 0]

    group = make_group(0, count=5)
    group.pixel_values[:, 2] = torch.arange(5.0)[:, None, None]
    evaluate([group], model, None)
    assert calls == [[0, 1], [2, 3], [4]]


def test_bad_predictions_and_arguments_are_named():
    group = make_group(0)
    with pytest.raises(ValueError, match=r"group group-0: the adapted prediction of 1\.png .*NaN"):
        evaluate([group], lambda pixels: torch.where(pixels[:, 1] == pixels[1, 1, 0, 0], torch.nan, pixels[:, 1]),
                 batch_size=3)  # fmt: skip
    with pytest.raises(ValueError, match="the adapted model predicts 6x7 for images of 6x8"):
        evaluate([group], lambda pixels: pixels[:, 1, :, 1:])
    with pytest.raises(ValueError, match="unknown reference 'gt': choose one of proxy, depth"):
        evaluate([group], reference="gt")
    with pytest.raises(ValueError, match="unknown protocol 'mine'"):
        evaluate([group], protocol="mine")
    with pytest.raises(ValueError, match="kind="):
        evaluate([group], reference="depth")
    with pytest.raises(ValueError, match="needs a model"):
        evaluate_gift_i([group])
    with pytest.raises(ValueError, match="no groups"):
        evaluate([])
    with pytest.raises(ValueError, match='reference="depth" needs the rows of load_gift_i'):
        evaluate([group], reference="depth", kind="depth")


def test_saved_reports_hold_no_nan_and_load_again(tmp_path):
    report = evaluate([make_group(0), make_group(1, reference=False), make_group(2, count=1)])
    folder = report.save(tmp_path / "deep" / "folder")

    def refuse(name):
        raise AssertionError(f"{name} in JSON")

    for line in [(folder / "metrics.json").read_text(), *(folder / "rows.jsonl").read_text().splitlines()]:
        json.loads(line, parse_constant=refuse)
    loaded = Report.load(folder)
    assert loaded.to_dict() == report.to_dict() and len(loaded.rows) == len(report.rows)
    assert loaded.rows[3]["base"]["all"]["mae"] is None
    assert {path.name for path in folder.iterdir()} == {"metrics.json", "rows.jsonl"}
    with pytest.raises(FileNotFoundError, match=r"metrics\.json is missing"):
        Report.load(tmp_path)
