"""Layouts with a name: small trees as their authors document them become groups, and what is missing is named."""

import shutil
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from helpers.photos import entry, scene, target, with_content
from PIL import Image

from gift_peft.captures.known_datasets import choose_layout
from gift_peft.captures.measured_depth import read_measured_depth
from gift_peft.cli import main
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.settings import PrepareSettings

SIZE = (160, 200)
SHARED = Path(__file__).parents[3] / "shared" / "data"
needs_exr = pytest.mark.skipif(find_spec("OpenEXR") is None, reason="the extra exr is not installed")

pytestmark = pytest.mark.usefixtures("fresh_cache")


def settings(name):
    return PrepareSettings(layout=choose_layout(name))


def save(path: Path, array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path)


def booster(root: Path, scenes=("Door", "Pots1"), images=3) -> Path:
    for seed, name in enumerate(scenes):
        folder = root / "train/balanced" / name
        rng, picture, mask = np.random.default_rng(seed), scene(seed, SIZE), target(seed, SIZE)
        for index in range(images):
            save(folder / f"camera_00/im{index}.png", with_content(picture, mask, rng, noise=1.0))
            save(folder / f"camera_02/im{index}.png", picture)
        classes = np.zeros(SIZE, np.uint8)
        classes[:20] = 1
        classes[mask] = 3
        rows, columns = np.nonzero(mask)
        classes[rows[0], columns[0]] = 2
        save(folder / "mask_cat.png", classes)
        save(folder / "mask_00.png", np.full(SIZE, 255, np.uint8))
        np.save(folder / "disp_00.npy", np.ones(SIZE, np.float32))
    return root


@pytest.mark.parametrize("below", ["", "train", "train/balanced"])
def test_illuminations_of_booster_are_training_groups(tmp_path, below):
    raw = booster(tmp_path / "booster")
    report = prepare_gift_i(raw / below, tmp_path / "out", settings("booster"))
    ids = [group["group_id"] for group in report["groups"]]
    assert [name.split("__")[-1] for name in ids] == ["Door", "Pots1"]
    assert {group["split"] for group in report["groups"]} == {"train"}
    assert {group["status"] for group in report["groups"]} == {"kept"}, report["groups"]
    row = load_gift_i(tmp_path / "out", "train")[0]
    assert row["image_names"] == ["camera_00/im0.png", "camera_00/im1.png", "camera_00/im2.png"]
    for mask in row["masks"]:
        assert np.array_equal(np.asarray(mask) > 0, target(0, SIZE))


def test_booster_names_a_scene_without_classes_and_leaves_test_scenes_out(tmp_path, caplog):
    raw = booster(tmp_path / "booster")
    shutil.copytree(raw / "train/balanced/Door", raw / "test/Hidden")
    (raw / "test/Hidden/mask_cat.png").unlink()
    assert len(choose_layout("booster").find(raw)["train"]) == 2
    assert "Hidden" in caplog.text and "left out" in caplog.text
    (raw / "train/balanced/Door/mask_cat.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"Door/mask_cat\.png, the material classes"):
        choose_layout("booster").find(raw)


def write_exr(path: Path, depth: np.ndarray) -> None:
    """As the authors save it: three equal channels of float32 metres."""
    import OpenEXR

    channels = {"RGB": np.dstack([depth.astype(np.float32)] * 3)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def cleargrasp(root: Path, sets=("real-val/d435", "real-test/d415")) -> dict[str, np.ndarray]:
    """The masks, by group id."""
    masks = {}
    for seed, name in enumerate(sets):
        rng, picture, mask = np.random.default_rng(seed), scene(seed, SIZE), target(seed, SIZE)
        start = root / name / "000000080"
        start.parent.mkdir(parents=True)
        opaque = picture.copy()
        opaque[mask] = 150
        for ending, array in (("transparent", with_content(picture, mask, rng, noise=1.0)), ("opaque", opaque)):
            Image.fromarray(array).save(f"{start}-{ending}-rgb-img.jpg", quality=95)
        Image.fromarray(np.dstack([mask * np.uint8(255)] * 3)).save(f"{start}-mask.png")
        masks[f"{name.replace('/', '__')}__000000080"] = mask
    return masks


@needs_exr
def test_pairs_of_cleargrasp_are_validation_groups_with_reference_and_depth(tmp_path):
    raw = tmp_path / "cleargrasp"
    masks = cleargrasp(raw)
    depth = np.full(SIZE, 0.7314, np.float32)
    depth[:40] = np.nan
    depth[40:50] = 0
    for start in raw.rglob("*-mask.png"):
        write_exr(Path(str(start).replace("-mask.png", "-opaque-depth-img.exr")), depth)
    report = prepare_gift_i(raw, tmp_path / "out", settings("cleargrasp"))
    assert {group["group_id"]: group["status"] for group in report["groups"]} == dict.fromkeys(masks, "kept"), report
    for row in load_gift_i(tmp_path / "out", "validation"):
        mask = masks[row["group_id"]]
        assert len(row["images"]) == 1 and row["reference"] is not None and row["surface"] == 1
        assert np.array_equal(np.asarray(row["masks"][0]) > 0, mask)
        known = np.asarray(row["depths"][0])
        assert (known[:50] == 0).all() and (known[50:] == 731).all()


@needs_exr
def test_depth_of_another_size_or_damaged_is_named(tmp_path):
    path = tmp_path / "a-opaque-depth-img.exr"
    write_exr(path, np.ones((8, 10)))
    with pytest.raises(ValueError, match=r"a-opaque-depth-img\.exr: depth of 8x10 .* beside a photo of 10x8"):
        read_measured_depth(path, (10, 8))
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(ValueError, match=r"a-opaque-depth-img\.exr: not a readable OpenEXR"):
        read_measured_depth(path, (8, 10))


def test_a_pair_without_depth_is_made_and_one_without_its_twin_is_named(tmp_path):
    raw = tmp_path / "cleargrasp"
    cleargrasp(raw)
    report = prepare_gift_i(raw, tmp_path / "out", settings("cleargrasp"))
    assert {group["status"] for group in report["groups"]} == {"kept"}
    assert load_gift_i(tmp_path / "out", "validation")[0]["depths"] == []
    (raw / "real-val/d435/000000080-opaque-rgb-img.jpg").unlink()
    with pytest.raises(FileNotFoundError, match=r"missing .*000000080-opaque-rgb-img\.jpg, the sprayed twin"):
        choose_layout("cleargrasp").find(raw)


@pytest.mark.parametrize("folders", [("images", "masks"), ("train/image", "train/mask"), ("JPEGImages", "gt")])
def test_each_photo_with_a_mask_is_a_group_of_one(tmp_path, folders):
    raw, masks = tmp_path / "raw", {}
    for seed, name in enumerate(("b 1", "a2", "a10")):
        masks[name] = target(seed, SIZE)
        save(raw / folders[0] / f"{name}.jpg", scene(seed, SIZE))
        save(raw / folders[1] / f"{name}.png", masks[name].astype(np.uint8) * 255)
    save(raw / folders[0] / "bare.jpg", scene(9, SIZE))
    report = prepare_gift_i(raw, tmp_path / "out", settings("photos"))
    kept = [group["group_id"] for group in report["groups"] if group["status"] == "kept"]
    assert kept == ["a2", "a10", "b 1"]
    assert "bare.png: no such file" in entry(report, "bare")["reasons"][0]["text"]
    assert [item["code"] for item in entry(report, "a2")["warnings"]] == ["one_photo"]
    for row in load_gift_i(tmp_path / "out", "train"):
        assert len(row["images"]) == 1
        assert np.array_equal(np.asarray(row["masks"][0]) > 0, masks[row["group_id"]])


def test_a_class_of_the_masks_of_photos_is_named_beside_them(tmp_path):
    raw, mask = tmp_path / "raw", target(0, SIZE)
    labels = np.where(mask, 7, 3).astype(np.uint8)
    save(raw / "images/a.png", scene(0, SIZE))
    save(raw / "masks/a.png", labels)
    (raw / "group.yaml").write_text("mask_class: 7\nsurface: mirror\n")
    prepare_gift_i(raw, tmp_path / "out", settings("photos"))
    row = load_gift_i(tmp_path / "out", "train")[0]
    assert row["surface"] == 0 and np.array_equal(np.asarray(row["masks"][0]) > 0, mask)


@pytest.mark.parametrize("name", ["booster", "cleargrasp", "photos"])
def test_an_empty_folder_says_what_is_looked_for(tmp_path, name, capsys):
    (tmp_path / "raw").mkdir()
    with pytest.raises(SystemExit) as leaving:
        main(["prepare", str(tmp_path / "raw"), str(tmp_path / "out"), "--layout", name])
    said = capsys.readouterr().err
    assert leaving.value.code == 1 and said.count("\n") == 1
    assert f"the layout {name} finds nothing there; it looks for" in said


def test_a_name_that_is_nearly_right_is_guessed(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"layout boster: neither a file nor one of .*; did you mean booster\?"
    ):
        choose_layout("boster")


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real photos are not beside the repository")
def test_a_real_scene_of_booster(tmp_path):
    groups = choose_layout("booster").find(SHARED / "booster_web_quarter")["train"]
    assert [group.group_id for group in groups] == ["train__balanced__ShotGlasses"]
    size = Image.open(groups[0].images[0]).size
    mask = groups[0].masks[0].read(size)
    classes = np.asarray(Image.open(groups[0].masks[0].path))
    assert len(groups[0].images) == 3 and np.array_equal(mask, classes >= 2) and mask.any()
