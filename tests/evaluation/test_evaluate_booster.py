"""`evaluate_booster` against a straight-line evaluator, hand-computed scenes, and the traps of other evaluators."""

import json
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from accelerate import debug_launcher
from helpers.booster_tree import depth4tom_by_hand, write_predictions, write_root, write_scene
from helpers.tiny import SIZE, tiny_model, tiny_processor
from PIL import Image

from gift_peft import evaluate_booster
from gift_peft.evaluation.booster_scenes import find_booster, read_ground_truth
from gift_peft.evaluation.results import REGIONS, Report
from gift_peft.evaluation.tables import markdown_table

SAMPLE = Path(__file__).parents[3] / "shared" / "data" / "booster_web_quarter"


def evaluate(root, **options):
    return evaluate_booster(root, progress=False, **options)


def assert_close(found, expected, digits=5e-6):
    for region in REGIONS:
        assert found[region] == pytest.approx(expected[region], rel=digits), region


@pytest.mark.parametrize("resize", [0.25, 0.5, 1])
@pytest.mark.parametrize("size", [None, (23, 31), (150, 200)])
def test_depth4tom_against_straight_line_code(tmp_path, resize, size):
    truths = write_root(tmp_path)
    maps = write_predictions(tmp_path / "pred", truths, size=size)
    options = {"predictions": tmp_path / "pred", "protocol": "depth4tom"}
    with pytest.warns(UserWarning, match=r"meant for x0\.25") if resize != 0.25 else nullcontext():
        report = evaluate(tmp_path, resize=resize, **options)
    assert_close(report.summary, depth4tom_by_hand(truths, maps, resize))
    assert report.counts["images"] == report.counts["scored"] == 4
    assert f"resolution x{resize:g}" in report.protocol["description"]
    if size is None:
        assert any(row["base"]["num_nonpositive"] for row in report.rows)


def test_images_without_a_class_are_skipped_in_it_and_the_mean_is_over_images(tmp_path):
    truths = write_root(tmp_path, scenes=2)
    folder = tmp_path / "train" / "balanced" / "Matt"
    truths["Matt"] = write_scene(folder, 7, size=(40, 48), classes=np.zeros((40, 48), np.uint8))
    maps = write_predictions(tmp_path / "pred", truths)
    report = evaluate(tmp_path, predictions=tmp_path / "pred", protocol="depth4tom")
    assert_close(report.summary, depth4tom_by_hand(truths, maps, 0.25))
    assert report.counts["without_tom"] == 2 and report.counts["skipped"] == 0
    matt = [row for row in report.rows if row["group_id"] == "Matt"]
    assert all(np.isnan(row["base"]["tom"]["mae"]) and row["pixels"]["tom"] == 0 for row in matt)
    rows = report.rows
    by_scene = [np.mean([r["base"]["all"]["mae"] for r in rows if r["group_id"] == name]) for name in truths]
    assert report.per_scene["Matt"]["summary"]["all"]["mae"] == pytest.approx(by_scene[-1], rel=1e-12)


@pytest.mark.parametrize("kind", ["inverse_depth", "depth"])
@pytest.mark.parametrize("protocol", ["gift", "depth4tom", "moge-affine"])
def test_perfect_models_have_no_error(tmp_path, kind, protocol):
    truths = write_root(tmp_path)
    for name, truth in truths.items():
        folder = tmp_path / "pred" / name / "camera_00"
        folder.mkdir(parents=True)
        seen = truth["disparity"] > 0
        depth = np.divide(truth["product"], truth["disparity"], where=seen, out=np.full((60, 84), 5e3))
        for index in range(2):
            # depth4tom inverts a depth before it fits, so only the scale of a depth is free there
            shift = 0 if protocol == "depth4tom" else 40
            values = 3 * truth["disparity"].astype(float) - 7 if kind == "inverse_depth" else depth / 500 + shift
            np.save(folder / f"im{index}.npy", values)
    with pytest.warns(UserWarning, match="meant for") if protocol == "depth4tom" else nullcontext():
        report = evaluate(tmp_path, predictions=tmp_path / "pred", protocol=protocol, kind=kind, resize=1)
    for region in REGIONS:
        assert report.summary[region]["mae"] < 1e-3 and report.summary[region]["rmse"] < 1e-3
        assert report.summary[region]["delta1"] == 100


def test_noc_keeps_what_both_cameras_see(tmp_path):
    truths = write_root(tmp_path, scenes=1)
    write_predictions(tmp_path / "pred", truths)
    options = {"predictions": tmp_path / "pred", "kind": "inverse_depth", "resize": 1}
    everything, seen = (evaluate(tmp_path, occlusion=which, **options) for which in ("all", "noc"))
    truth = truths["Scene0"]
    known = (truth["disparity"] > 0) & (truth["depth"] <= 10000) & (truth["depth"] >= 1)
    assert everything.rows[0]["pixels"]["all"] == known.sum()
    assert seen.rows[0]["pixels"]["all"] == (known & truth["visible"]).sum()
    assert seen.rows[0]["pixels"]["tom"] == (known & truth["visible"] & (truth["classes"] >= 2)).sum()


def test_tom_classes_move_the_target(tmp_path):
    truths = write_root(tmp_path, scenes=1)
    write_predictions(tmp_path / "pred", truths)
    report = evaluate(tmp_path, predictions=tmp_path / "pred", kind="inverse_depth", resize=1, tom_classes=(3,))
    assert report.rows[0]["target_pixels"] == (truths["Scene0"]["classes"] == 3).sum()
    pixels = report.rows[0]["pixels"]
    assert pixels["tom"] + pixels["other"] == pixels["all"]


def test_the_fit_is_over_all_known_pixels_and_every_image_needs_its_prediction(tmp_path):
    truths = write_root(tmp_path, scenes=1)
    maps = write_predictions(tmp_path / "pred", truths, images=1)
    options = {"predictions": tmp_path / "pred", "kind": "inverse_depth", "resize": 1}
    with pytest.raises(FileNotFoundError, match=r"1 missing.*Scene0/camera_00/im1"):
        evaluate(tmp_path, **options)
    np.save(tmp_path / "pred" / "Scene0" / "camera_00" / "im1.npy", maps["Scene0", 0])
    row = evaluate(tmp_path, **options).rows[0]
    truth = truths["Scene0"]
    use = (truth["disparity"] > 0) & (truth["depth"] <= 10000) & (truth["depth"] >= 1)
    design = np.stack([maps["Scene0", 0][use].astype(float), np.ones(use.sum())], 1)
    scale, shift = np.linalg.lstsq(design, truth["disparity"][use].astype(float) / truth["product"], rcond=None)[0]
    assert (row["base"]["scale"], row["base"]["shift"]) == pytest.approx((scale, shift), rel=1e-6)


def test_order_of_scenes_and_images_does_not_matter(tmp_path):
    truths = write_root(tmp_path, scenes=3)
    maps = write_predictions(tmp_path / "pred", truths)
    report = evaluate(tmp_path, predictions=tmp_path / "pred", kind="inverse_depth")
    other = tmp_path / "other"
    for number, name in enumerate(reversed(truths)):
        source = tmp_path / "train" / "balanced" / name
        target = other / "train" / "balanced" / f"A{number}"
        target.parent.mkdir(parents=True, exist_ok=True)
        source.rename(target)
        (target / "camera_00" / "im0.png").rename(target / "camera_00" / "z.png")
        (other / "pred" / target.name / "camera_00").mkdir(parents=True)
        np.save(other / "pred" / target.name / "camera_00" / "z.npy", maps[name, 0])
        np.save(other / "pred" / target.name / "camera_00" / "im1.npy", maps[name, 1])
    again = evaluate(other, predictions=other / "pred", kind="inverse_depth")
    assert again.summary == report.summary
    for name in ("base", "base_normalized"):
        assert again.gce[name] == pytest.approx(report.gce[name], rel=1e-6)


def test_constant_predictions_are_skipped_and_counted(tmp_path):
    truths = write_root(tmp_path, scenes=1)
    write_predictions(tmp_path / "pred", truths)
    np.save(tmp_path / "pred" / "Scene0" / "camera_00" / "im1.npy", np.ones((5, 7), np.float32))
    report = evaluate(tmp_path, predictions=tmp_path / "pred", protocol="depth4tom")
    assert report.counts["scored"] == 1
    assert report.counts["reasons"] == {"with a constant base prediction": 1}
    assert report.summary["all"] == report.rows[0]["base"]["all"]


def test_what_kind_the_predictions_are_has_to_be_said(tmp_path):
    truths = write_root(tmp_path, scenes=1)
    write_predictions(tmp_path / "pred", truths)
    with pytest.raises(ValueError, match='say what the predictions are: kind="depth" or'):
        evaluate(tmp_path, predictions=tmp_path / "pred")
    with pytest.raises(ValueError, match="unknown kind 'disparity'"):
        evaluate(tmp_path, predictions=tmp_path / "pred", kind="disparity")
    with pytest.raises(ValueError, match="compares in native units"):
        evaluate(tmp_path, predictions=tmp_path / "pred", kind="depth", protocol="native")
    with pytest.raises(ValueError, match="compares depth with depth"):
        evaluate(tmp_path, predictions=tmp_path / "pred", kind="inverse_depth", protocol="metric")
    with pytest.raises(ValueError, match="one of the two"):
        evaluate(tmp_path)
    with pytest.warns(UserWarning, match="fits inverse depth straight to depth"):
        literal = evaluate(tmp_path, predictions=tmp_path / "pred", kind="inverse_depth", protocol="gift-literal")
    assert literal.rows[0]["base"]["scale"] < 0


def test_metric_compares_as_it_is(tmp_path):
    truths = write_root(tmp_path, scenes=1)
    write_predictions(tmp_path / "pred", truths)
    for index in range(2):
        np.save(tmp_path / "pred" / "Scene0" / "camera_00" / f"im{index}.npy", truths["Scene0"]["depth"] / 1000 + 0.05)
    options = {"predictions": tmp_path / "pred", "kind": "depth", "protocol": "metric", "resize": 1}
    report = evaluate(tmp_path, prediction_scale=1000, **options)
    assert report.summary["all"]["mae"] == pytest.approx(50, rel=1e-4)
    assert (report.rows[0]["base"]["scale"], report.rows[0]["base"]["shift"]) == (1, 0)
    assert evaluate(tmp_path, **options).summary["all"]["delta1"] == 0  # metres taken for millimetres


# ---- models ----


def test_a_model_beside_its_base(tmp_path):
    truths = write_root(tmp_path, scenes=2, images=3)
    base, other = tiny_model(0), tiny_model(1)
    options = {"processor": tiny_processor(), "size": SIZE, "kind": "inverse_depth", "resize": 1}
    report = evaluate(tmp_path, model=other, teacher=base, **options)
    alone = evaluate(tmp_path, model=base, **options)
    assert report.adapted and not alone.adapted and alone.summary == alone.base == report.base != report.summary
    assert report.counts == {
        "groups": 2, "images": 6, "scored": 6, "skipped": 0, "reasons": {}, "without_tom": 0, "without_other": 0
    }  # fmt: skip
    assert report.collapse.keys() == {"target_mean_ratio", "spread_ratio", "alarm"}
    # The same predictions from files give the same rows.
    scenes = find_booster(tmp_path).scenes
    gce = []
    for scene in scenes:
        (tmp_path / "pred" / scene.name / "camera_00").mkdir(parents=True)
        maps = []
        for image in scene.images:
            pixels = tiny_processor()(Image.open(image), return_tensors="pt").pixel_values
            with torch.no_grad():
                maps.append(base(pixels).predicted_depth[0])
            np.save(tmp_path / "pred" / scene.name / "camera_00" / f"{image.stem}.npy", maps[-1].numpy())
        rows, columns = ((2 * np.arange(new) + 1) * old // (2 * new) for new, old in zip(SIZE, (60, 84), strict=True))
        tom = torch.from_numpy((truths[scene.name]["classes"] >= 2)[np.ix_(rows, columns)])
        pairs = [(maps[i] - maps[j]).abs()[tom].mean().item() for i in range(3) for j in range(i)]
        gce.append(sum(pairs) / len(pairs))
    stored = evaluate(tmp_path, predictions=tmp_path / "pred", kind="inverse_depth", resize=1)
    for mine, theirs in zip(stored.rows, alone.rows, strict=True):
        assert mine["base"]["all"] == pytest.approx(theirs["base"]["all"], rel=1e-5)
        assert mine["base"]["target_mean"] == pytest.approx(theirs["base"]["target_mean"], rel=1e-5)
    assert alone.gce["base"] == pytest.approx(np.mean(gce), rel=1e-5)
    assert report.gce["adapted"] is not None and alone.gce["adapted"] is None


def test_damaged_images_and_wrong_sizes_are_named(tmp_path):
    write_root(tmp_path, scenes=1)
    options = {"processor": tiny_processor(), "size": SIZE, "kind": "depth"}
    picture = tmp_path / "train" / "balanced" / "Scene0" / "camera_00" / "im1.png"
    Image.new("RGB", (84, 61)).save(picture)
    with pytest.raises(ValueError, match=r"im1\.png is 61x84 .*disp_00\.npy is 60x84"):
        evaluate(tmp_path, model=tiny_model(), **options)
    picture.write_bytes(picture.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"im1\.png: not a readable image"):
        evaluate(tmp_path, model=tiny_model(), **options)


def test_non_finite_predictions_are_named(tmp_path):
    write_root(tmp_path, scenes=1)
    options = {"processor": tiny_processor(), "size": SIZE, "kind": "depth"}

    def broken(pixels):
        depth = pixels.mean(1) + torch.linspace(0, 1, SIZE[1])
        depth[-1, 3, 3] = torch.nan
        return depth

    with pytest.raises(ValueError, match=r"scene Scene0: the base prediction of im1\.png \(image 1\) has NaN"):
        evaluate(tmp_path, model=broken, **options)


def _evaluate_in_two_processes(root):
    from accelerate import Accelerator
    from accelerate.state import AcceleratorState

    AcceleratorState._reset_state(reset_partial_state=True)  # the parent's tests may have made one before the fork
    accelerator = Accelerator(cpu=True)
    report = evaluate(root, predictions=root / "pred", kind="inverse_depth", accelerator=accelerator)
    report.save(root / str(accelerator.process_index))


def test_two_processes_give_the_report_of_one(tmp_path):
    truths = write_root(tmp_path, scenes=3)
    write_predictions(tmp_path / "pred", truths)
    debug_launcher(_evaluate_in_two_processes, (tmp_path,), num_processes=2)
    one, two = (Report.load(tmp_path / rank) for rank in "01")
    alone = evaluate(tmp_path, predictions=tmp_path / "pred", kind="inverse_depth")
    assert one.to_dict() == two.to_dict() == alone.to_dict()
    assert one.rows == two.rows and [row["group_id"] for row in one.rows[::2]] == ["Scene0", "Scene1", "Scene2"]


# ---- the report ----


def test_reports_are_saved_and_loaded(tmp_path):
    truths = write_root(tmp_path, images=1)
    write_predictions(tmp_path / "pred", truths, images=1)
    report = evaluate(tmp_path, predictions=tmp_path / "pred", protocol="depth4tom")
    assert report.gce["num_groups"] == 0 and report.gce["num_skipped"] == 2
    folder = report.save(tmp_path / "out")
    loaded = Report.load(folder)
    assert loaded.dataset == "booster" and loaded.to_dict() == report.to_dict()
    rows = [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]
    assert rows == loaded.rows and len(rows) == 2
    about = loaded.about
    assert (about["kind"], about["occlusion"], about["subset"], about["official"]) == (
        "inverse_depth", "all", "balanced", False
    )  # fmt: skip
    with pytest.raises(FileNotFoundError, match=r"metrics\.json is missing"):
        Report.load(tmp_path)
    metrics = (folder / "metrics.json").read_text()
    assert json.loads(metrics)["illumination_gce"] == loaded.gce
    unknown = metrics.replace('"illumination_gce"', '"gce"')
    for broken, message in (
        (metrics[:-30], "damaged"),
        ("[]", "damaged"),
        ("{}", "is no evaluation: it lacks "),
        (unknown, "is no evaluation: it has per_scene"),
    ):
        (folder / "metrics.json").write_text(broken)
        with pytest.raises(ValueError, match=rf"metrics\.json:? {message}"):
            Report.load(folder)


def test_evaluations_saved_before_the_report_knew_both_datasets_are_read(tmp_path):
    """As 0.1.0 wrote them: no `dataset`, and a protocol with choices that are gone."""
    truths = write_root(tmp_path, images=1)
    write_predictions(tmp_path / "pred", truths, images=1)
    report = evaluate(tmp_path, predictions=tmp_path / "pred", protocol="depth4tom")
    folder = report.save(tmp_path / "out")
    metrics = json.loads((folder / "metrics.json").read_text())
    assert "dataset" not in metrics and "consensus" not in metrics
    metrics["protocol"] |= {"fit_region": "valid", "aggregation": "image"}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    loaded = Report.load(folder)
    assert (loaded.dataset, loaded.reference, loaded.by_surface) == ("booster", "depth", {})
    assert markdown_table(loaded) == markdown_table(report)


def benchmark(folder, images, size):
    script = Path(__file__).parents[2] / "examples" / "tools" / "benchmark_booster.py"
    options = ["--scenes", 1, "--images", images, "--size", size, "--folder", folder]
    done = subprocess.run([sys.executable, script, *map(str, options)], capture_output=True, text=True, check=True)
    assert f"Booster balanced: 1 scene, {images} images (mm)" in done.stdout
    assert f"{images} images of {size} in" in done.stdout
    return int(re.search(r"peak memory (\d+) MiB", done.stdout)[1])


@pytest.mark.slow
def test_the_memory_of_a_full_size_scene_does_not_grow_with_its_images(tmp_path):
    """What the benchmark prints, at the size that Booster has."""
    few, many = (benchmark(tmp_path / str(images), images, "3008x4112") for images in (2, 6))
    assert many < 1700 and many - few < 100  # MiB; an image more is 47 MiB of float32


# ---- real data ----


@pytest.mark.skipif(not SAMPLE.is_dir(), reason="the Booster sample scene is not beside the repository")
def test_the_real_scene_end_to_end(tmp_path):
    (scene,) = find_booster(SAMPLE).scenes
    truth = read_ground_truth(scene, 1)
    disparity, classes = np.load(scene.folder / "disp_00.npy"), np.asarray(Image.open(scene.folder / "mask_cat.png"))
    assert len(scene.images) == 3 and truth.depth.shape == (752, 1028)
    known = disparity > 0
    np.testing.assert_allclose(truth.depth[known], 940 * 63.8 / disparity[known].astype(float), rtol=1e-12)
    assert np.array_equal(truth.depth > 0, known) and np.array_equal(truth.tom, classes >= 2)

    folder = tmp_path / "ShotGlasses" / "camera_00"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    maps = {}
    for index in range(3):
        smooth = cv2.GaussianBlur(disparity + (classes == 3) * np.float32(8 * rng.random()), (0, 0), 3)
        maps["ShotGlasses", index] = (0.3 * smooth + 2 + rng.normal(0, 0.2, smooth.shape)).astype(np.float32)
        np.save(folder / f"im{index}.npy", maps["ShotGlasses", index])
    facts = {"disparity": disparity, "classes": classes, "product": 940 * 63.799999999999997}
    report = evaluate(SAMPLE, predictions=tmp_path, protocol="depth4tom")
    assert_close(report.summary, depth4tom_by_hand({"ShotGlasses": facts}, maps, 0.25))
    assert report.gce["num_groups"] == 1 and report.gce["base"] > 0

    model = evaluate(SAMPLE, model=tiny_model(), processor=tiny_processor(), size=SIZE, occlusion="noc")
    assert model.counts["scored"] == 3 and np.isfinite(model.summary["tom"]["rmse"])
    assert model.rows[0]["pixels"]["all"] < report.rows[0]["pixels"]["all"]
