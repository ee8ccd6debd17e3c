"""`gift-peft prepare` on real photographs, and on a group of 55 images."""

import os
import shutil

import datasets
import numpy as np
import pytest
from helpers.photos import capture, statuses
from PIL import Image

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.prepare.prepare import prepare_gift_i

SHARED = os.path.join(os.path.dirname(__file__), "..", "..", "..", "shared", "data")


pytestmark = pytest.mark.usefixtures("fresh_cache")


@pytest.mark.slow
@pytest.mark.skipif(not os.path.isdir(SHARED), reason="the real photos are not beside the repository")
def test_real_photos(tmp_path):
    raw, out = tmp_path / "raw", tmp_path / "out"
    for scene_id in ("000000080", "000000130"):
        folder, source = raw / "validation" / scene_id, os.path.join(SHARED, "cleargrasp_d435", scene_id)
        folder.mkdir(parents=True)
        shutil.copy(f"{source}/transparent.jpg", folder / "clear.jpg")
        shutil.copy(f"{source}/mask.png", folder / "clear_mask.png")
        shutil.copy(f"{source}/opaque_sprayed.jpg", folder / "ref_sprayed.jpg")
    scene_folder = os.path.join(SHARED, "booster_web_quarter/train/balanced/ShotGlasses")
    (raw / "train/shot glasses/masks").mkdir(parents=True)
    classes = np.asarray(Image.open(f"{scene_folder}/mask_cat.png"))
    mask = Image.fromarray(((classes == 3) * 255).astype(np.uint8)).resize((1028, 752), Image.Resampling.NEAREST)
    for index in range(3):
        shutil.copy(f"{scene_folder}/camera_00/im{index}.png", raw / "train/shot glasses")
        mask.save(raw / f"train/shot glasses/masks/im{index}.png")
    report = prepare_gift_i(raw, out)
    assert statuses(report, "shot glasses") == ["identity", "identity", "kept"]
    row = load_gift_i(out, "train")[0]
    assert row["valids"] == []
    for index, image in enumerate(row["images"]):
        original = np.asarray(Image.open(f"{scene_folder}/camera_00/im{index}.png"))
        assert np.array_equal(np.asarray(image), original)
    for row in load_gift_i(out, "validation"):
        assert row["image_names"] == ["clear.jpg"] and row["reference"].size == (1280, 720)
        assert statuses(report, row["group_id"]) == ["kept", "identity"]


@pytest.mark.slow
def test_a_group_of_55_images(tmp_path):
    group = capture(tmp_path / "raw/many", 5, count=55, size=(720, 1280))
    assert len(list(group.glob("*.png"))) == 55
    report = prepare_gift_i(tmp_path / "raw", tmp_path / "out")
    assert report["statistics"]["train"]["images"] == 55 and report["statistics"]["train"]["dropped_frames"] == 0
    row = datasets.load_dataset(str(tmp_path / "out"), split="train")[0]
    assert len(row["images"]) == 55 and row["image_names"][-1] == "54.png"
