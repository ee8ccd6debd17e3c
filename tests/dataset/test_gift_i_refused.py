"""GIFT-I that is damaged, incomplete or misnamed: refused in one line that names the file or group."""

import os
import shutil

import datasets
import numpy as np
import pytest
from datasets.table import embed_table_storage
from helpers.records import one_line, records, save_mask
from helpers.tiny import write_group
from PIL import Image

from gift_peft.dataset.gift_i import GiftI, load_gift_i
from gift_peft.dataset.writer import write_gift_i

pytestmark = pytest.mark.usefixtures("fresh_cache")


def rgba(path):
    image = Image.open(path).convert("RGBA")
    image.putalpha(128)
    image.save(path)


def cut(path):
    path.write_bytes(path.read_bytes()[:900])


def deep(path):
    Image.fromarray(np.asarray(Image.open(path).convert("L"), np.uint16) * 200).save(path)


DAMAGE = {
    "missing masks": (lambda g: [path.unlink() for path in g.glob("masks/*")], "masks/0.png", "missing mask"),
    "mask of another size": (lambda g: save_mask(g / "masks/1.png", np.ones((50, 80))), "1.png", "50x80"),
    "truncated": (lambda g: cut(g / "1.png"), "1.png", "truncated"),
    "unreadable": (lambda g: (g / "0.png").write_text("hello"), "0.png", "not a readable image"),
    "truncated mask": (lambda g: (g / "masks/0.png").write_bytes(b"\x89PNG"), "masks/0.png", "not a readable image"),
    "transparent": (lambda g: rgba(g / "1.png"), "1.png", "transparent pixels"),
    "16 bit": (lambda g: deep(g / "1.png"), "1.png", "16-bit"),
    "all masks empty": (lambda g: [save_mask(p, np.zeros((60, 80))) for p in g.glob("masks/*")], "scene_0", "empty"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_raw_tree(raw_tree, name):
    damage, file, words = DAMAGE[name]
    damage(raw_tree / "train/scene_0")
    with pytest.raises((ValueError, FileNotFoundError)) as excinfo:
        load_gift_i(raw_tree, "train")
    one_line(excinfo, file, words)


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_prepared_folder(prepared, name):
    damage, file, words = DAMAGE[name]
    group = prepared / "train/scene_0"
    for path in list(group.rglob("0?_*")):
        path.rename(path.with_name(path.name[3:]))
    (group / "images/0.png").rename(group / "0.png")
    (group / "images/1.png").rename(group / "1.png")
    damage(group)
    for path in list(group.glob("*.png")):
        path.rename(group / "images" / f"0{path.stem}_{path.name}")
    for path in list(group.glob("masks/*.png")):
        path.rename(path.with_name(f"0{path.stem}_{path.name}"))
    with pytest.raises((ValueError, FileNotFoundError)) as excinfo:
        load_gift_i(prepared, "train")[0]
    one_line(excinfo, os.path.basename(file), words)


def test_a_third_mask_value_in_a_prepared_folder_names_the_image(prepared):
    save_mask(prepared / "train/scene_0/masks/01_1.png", np.arange(4800).reshape(60, 80) % 3)
    with pytest.raises(ValueError) as excinfo:
        load_gift_i(prepared, "train")[0]
    one_line(excinfo, "group scene_0: the mask of 1.png: 3 different values")


def test_groups_with_and_without_a_reference_share_a_split(tmp_path):
    for index in range(3):
        write_group(tmp_path / "raw/validation" / f"scene_{index}", 2, index, reference=index != 1)
    (tmp_path / "raw/train").mkdir()
    groups = [{**group, "split": "validation", "surface": None} for group in records(tmp_path / "raw")]
    for folder in (tmp_path / "raw", write_gift_i(groups, tmp_path / "gift-i", license="cc0-1.0")):
        rows = load_gift_i(folder, "validation")
        assert [row["reference"] is None for row in rows] == [False, True, False]
    rows = datasets.load_dataset(str(folder), split="validation")
    shard = tmp_path / "parquet/validation-00000-of-00001.parquet"
    rows.with_format("arrow").map(embed_table_storage, batched=True).with_format(None).to_parquet(shard)
    rows = load_gift_i(tmp_path / "parquet", "validation")
    assert [row["reference"] is None for row in rows] == [False, True, False]


def test_misnamed_validation_folder(raw_tree):
    (raw_tree / "validation").rename(raw_tree / "val")
    with pytest.raises(ValueError) as excinfo:
        load_gift_i(raw_tree, "train")
    one_line(excinfo, raw_tree / "val", "the second split is called validation")


def test_writer_takes_masks_that_are_bool(tmp_path):
    pictures = [Image.new("RGB", (8, 6), (value, 0, 0)) for value in (1, 2)]
    for mask in (np.ones((6, 8), np.int64), np.ones((6, 8, 1), bool)):
        group = {"split": "train", "group_id": "g", "images": pictures, "masks": [mask, mask]}
        with pytest.raises(ValueError) as excinfo:
            write_gift_i([group], tmp_path / "gift-i", license="cc0-1.0")
        one_line(excinfo, "group g: the mask of 00.png: a mask is (H, W) bool", mask.dtype)


def test_a_train_group_of_one_is_read(raw_tree):
    (raw_tree / "train/scene_0/1.png").unlink()
    assert load_gift_i(raw_tree, "train")[0]["image_names"] == ["0.png"]
    shutil.copy(raw_tree / "train/scene_0/0.png", raw_tree / "train/scene_0/1.png")  # twice the same is one as well
    assert load_gift_i(raw_tree, "train")[0]["image_names"] == ["0.png"]


def test_validation_takes_one_image_with_a_reference(raw_tree):
    group = raw_tree / "validation/scene_100"
    (group / "1.png").unlink()
    assert len(load_gift_i(raw_tree, "validation")[0]["images"]) == 1
    (group / "reference.png").unlink()
    with pytest.raises(
        ValueError, match="scene_100 has 1 different image; it takes two, or one and a treated reference"
    ):
        load_gift_i(raw_tree, "validation")


def test_empty_masks_are_fine_in_validation(raw_tree):
    for path in (raw_tree / "validation/scene_100/masks").iterdir():
        save_mask(path, np.zeros((60, 80)))
    assert len(load_gift_i(raw_tree, "validation")[0]["masks"]) == 2


def test_wrong_folders_and_splits(tmp_path, raw_tree, prepared):
    def error(*arguments):
        with pytest.raises((ValueError, FileNotFoundError)) as excinfo:
            load_gift_i(*arguments)
        assert "\n" not in str(excinfo.value)
        return str(excinfo.value)

    assert "no such folder" in error(tmp_path / "nowhere", "train")
    assert "no such folder, nor on the hub" in error("nobody/nothing-at-all", "train")
    (tmp_path / "empty").mkdir()
    assert "no group folders" in error(tmp_path / "empty", "train")
    for folder in (raw_tree, prepared):
        assert "no split 'test', only train, validation" in error(folder, "test")
    assert "one split at a time" in error(prepared, "train+validation")
    (raw_tree / "train/scene_0/group.yaml").write_text("surface: chrome")
    assert "group.yaml: surface 'chrome'" in error(raw_tree, "train")
    (raw_tree / "train/scene_0/group.yaml").write_text("surfce: mirror")
    assert "group.yaml: it may have the keys" in error(raw_tree, "train")
    (raw_tree / "train/scene_0/group.yaml").write_bytes(b"notes: caf\xe9")
    assert "group.yaml: not valid YAML" in error(raw_tree, "train")
    (raw_tree / "train/scene_0/group.yaml").unlink()
    shutil.copy(raw_tree / "train/scene_0/0.png", raw_tree / "train/scene_0/0.jpg")
    assert "would share one mask" in error(raw_tree, "train")
    with pytest.raises(ValueError, match="data_dir"):
        GiftI().download_and_prepare()
