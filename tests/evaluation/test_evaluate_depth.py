"""`evaluate_gift_i` and its panels against true depth: spaces, grids, unknown pixels, and real scenes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.booster_tree import bilinear
from helpers.tiny import SIZE, tiny_model, tiny_processor
from PIL import Image

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.writer import write_gift_i
from gift_peft.evaluation.evaluate import evaluate_gift_i
from gift_peft.evaluation.results import REGIONS
from gift_peft.evaluation.tables import text_table
from gift_peft.models.loading import DepthModel
from gift_peft.reports.panels import group_panels

OPTIONS = {"processor": tiny_processor(), "size": SIZE, "progress": False}


def depth_tree(folder, size, seed=0):
    """A prepared validation split of one group of two pictures with true depth in mm; 0 in a corner."""
    rng = np.random.default_rng(seed)
    depths = rng.integers(500, 5000, (2, *size)).astype(np.uint16)
    depths[:, 0, 0] = 0
    masks = [np.pad(np.ones((size[0] - 4, size[1] - 4), bool), 2)] * 2
    images = [Image.fromarray(rng.integers(0, 255, (*size, 3), dtype=np.uint8)) for _ in range(2)]
    group = {"split": "validation", "group_id": "g", "images": images, "masks": masks, "depths": list(depths)}
    write_gift_i([group | {"surface": "mirror"}], folder, license="cc0-1.0")
    return load_gift_i(folder, "validation"), depths


def test_a_perfect_disparity_model_has_no_error_against_depth(tmp_path):
    dataset, depths = depth_tree(tmp_path, SIZE)
    disparity = torch.from_numpy(7000.0 / np.maximum(depths, 1).astype(np.float64) + 3).float()
    report = evaluate_gift_i(dataset, lambda pixels: disparity, reference="depth", kind="inverse_depth", **OPTIONS)
    assert report.protocol["name"] == "gift" and report.unit == "mm"
    for region in REGIONS:
        assert report.summary[region]["rmse"] < 0.5 and report.summary[region]["delta1"] == 100
    wrong = evaluate_gift_i(dataset, lambda pixels: disparity, reference="depth", kind="depth", **OPTIONS)
    assert wrong.summary["all"]["rmse"] > 100


def test_depth_is_scored_on_its_own_grid_with_the_masks_drawn_there(tmp_path):
    dataset, depths = depth_tree(tmp_path, (30, 40))
    small = torch.rand(2, *SIZE, generator=torch.Generator().manual_seed(0)) + 1
    report = evaluate_gift_i(dataset, lambda pixels: small, reference="depth", kind="depth", **OPTIONS)
    row = report.rows[1]
    assert row["target_pixels"] == 26 * 36
    resized = bilinear(small[1].double().numpy(), (30, 40))
    known = depths[1] > 0
    columns = np.stack([resized[known], np.ones(known.sum())], 1)
    scale, shift = np.linalg.lstsq(columns, depths[1][known].astype(float), rcond=None)[0]
    error = np.abs(np.clip(scale * resized + shift, 1, 10000) - depths[1])
    assert row["base"]["all"]["mae"] == pytest.approx(error[known].mean(), rel=1e-6)
    assert row["base"]["tom"]["mae"] == pytest.approx(error[2:-2, 2:-2].mean(), rel=1e-6)


def test_unknown_depth_all_over_the_target_is_counted(tmp_path):
    rng = np.random.default_rng(5)
    mask = np.zeros((28, 28), bool)
    mask[5:20, 5:20] = True
    depth = rng.integers(500, 900, (28, 28)).astype(np.uint16)
    blind = np.where(mask, 0, depth).astype(np.uint16)  # a depth camera sees nothing on glass
    pictures = [Image.fromarray(rng.integers(0, 255, (28, 28, 3), dtype=np.uint8)) for _ in range(3)]
    group = {"split": "validation", "group_id": "g", "surface": "transparent", "masks": [mask, mask, mask | True]}
    write_gift_i([group | {"images": pictures, "depths": [depth, blind, depth]}], tmp_path, license="cc0-1.0")
    report = evaluate_gift_i(
        load_gift_i(tmp_path, "validation"),
        lambda pixels: pixels[:, 1],
        lambda pixels: pixels[:, 0],
        reference="depth",
        kind="depth",
        **OPTIONS | {"size": (28, 28)},
    )
    assert (report.counts["scored"], report.counts["without_tom"], report.counts["without_other"]) == (3, 1, 1)
    assert report.by_surface["transparent"]["num_images"] == 2
    assert "1 without known target pixels, 1 with nothing else" in text_table(report)


def test_panels_hold_an_observation_on_the_reference_grid(tmp_path):
    dataset, depths = depth_tree(tmp_path, (30, 40))
    model = DepthModel(tiny_model(1), tiny_processor(), SIZE, "inverse_depth", teacher=tiny_model())
    (panel,) = group_panels(dataset[0], {dataset[0]["image_names"][1]: "mirror"}, model)
    assert panel.label == "mirror"
    assert panel.base.shape == panel.adapted.shape == panel.target.shape == (30, 40)
    np.testing.assert_array_equal(panel.reference, depths[1])
    assert panel.image.size == (40, 30) and panel.target.sum() == 26 * 36 and panel.protocol == "gift"
    assert not np.array_equal(panel.base, panel.adapted)
    with pytest.raises(ValueError, match="group g has no reference to compare"):
        group_panels(dataset[0], {dataset[0]["image_names"][0]: "x"}, model, reference="proxy")


CLEARGRASP = Path(__file__).parents[3] / "shared" / "data" / "cleargrasp_d435"


@pytest.mark.skipif(not CLEARGRASP.is_dir(), reason="the ClearGrasp sample scenes are not beside the repository")
def test_real_scenes_with_a_treated_reference_and_measured_depth(tmp_path):
    scenes = [folder for folder in sorted(CLEARGRASP.iterdir()) if folder.is_dir()]
    groups = [
        {
            "split": "validation",
            "group_id": scene.name,
            "surface": "transparent",
            "images": [scene / "transparent.jpg"],
            "masks": [scene / "mask.png"],
            "depths": [scene / "opaque_depth_mm.png"],
            "reference": scene / "opaque_sprayed.jpg",
        }
        for scene in scenes
    ]
    write_gift_i(groups, tmp_path, license="other")
    dataset = load_gift_i(tmp_path, "validation")
    for reference, protocol in (("proxy", "native"), ("depth", "gift")):
        report = evaluate_gift_i(dataset, tiny_model(1), tiny_model(), reference=reference, **OPTIONS)
        assert report.protocol["name"] == protocol and report.counts["scored"] == 2
        assert (report.gce["num_groups"], report.gce["num_skipped"]) == (0, 2)
        # With one observation the median is the observation itself.
        assert report.consensus == report.base and report.summary != report.base
    assert 10 < report.base["all"]["mae"] < 1000  # mm, of scenes less than two metres deep
    assert report.rows[0]["target_pixels"] == int((np.asarray(dataset[0]["masks"][0]) > 0).sum())
