"""GIFT-I in all its forms: raw tree, prepared folder, parquet; streaming, workers, and everything that is refused."""

import os
import pickle
import shutil
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import datasets
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from datasets.table import embed_table_storage
from helpers.records import one_line, records, save_mask
from helpers.tiny import SIZE, tiny_processor, write_group, write_raw_tree
from PIL import Image
from torch.utils.data import DataLoader

from gift_peft.dataset.cache import GroupCache
from gift_peft.dataset.gift_i import FEATURES, GiftI, dataset_fingerprint, gift_i_splits, load_gift_i
from gift_peft.dataset.rows import parsed
from gift_peft.dataset.tensors import collate_group
from gift_peft.dataset.writer import SCHEMA, write_gift_i
from gift_peft.evaluation.evaluate import evaluate_gift_i
from gift_peft.rules import GroupPictures
from gift_peft.training.teacher import make_proxies

CLEARGRASP = os.path.join(os.path.dirname(__file__), "..", "..", "..", "shared", "data", "cleargrasp_d435")

pytestmark = pytest.mark.usefixtures("fresh_cache")


# ---- the prepared folder ----


def test_plain_load_dataset_reads_the_prepared_folder(prepared):
    loaded = datasets.load_dataset(str(prepared))
    assert {split: len(rows) for split, rows in loaded.items()} == {"train": 2, "validation": 1}
    row = loaded["train"][0]
    assert row["surface"] == "mirror" and row["valids"] == row["depths"] == [] and row["reference"] is None
    assert [mask.mode for mask in row["masks"]] == ["L", "L"]
    row = loaded["validation"][0]
    assert row["depths"][0].mode == "I;16" and row["reference"].size == (80, 60)
    schemas = [pq.read_schema(prepared / split / "metadata.parquet") for split in ("train", "validation")]
    assert schemas[0] == schemas[1] == SCHEMA


def test_a_folder_of_pictures_kept_from_before():
    """One embedded group in the form in which the package used to ship them; its shards hold the same files."""
    folder = Path(__file__).parents[1] / "fixtures" / "prepared"
    loose = load_gift_i(folder, "validation")
    shipped = load_gift_i(str(files("gift_peft.demo") / "gift-i"), "validation")
    same = shipped.select([shipped["group_id"].index("mirror_003")])
    assert dataset_fingerprint(loose) == dataset_fingerprint(same)
    assert len(loose) == 1 and loose["image_names"] == same["image_names"] and loose["surface"] == same["surface"]
    for own, other in zip(loose[0]["depths"], same[0]["depths"], strict=True):
        assert np.array_equal(np.asarray(own), np.asarray(other))
    plain = datasets.load_dataset(str(folder), split="validation", features=FEATURES)[0]
    assert [np.asarray(image).tolist() for image in plain["images"]] == [
        np.asarray(image).tolist() for image in same[0]["images"]
    ]


@pytest.mark.parametrize("name", ["data [v2]", "what?", "50 % *", "Küche (alt)"])
def test_a_folders_name_is_no_pattern(name, prepared, tmp_path):
    decoy = shutil.copytree(prepared, tmp_path / "whats" / "gift-i")  # what `what?` would match as well
    folder = shutil.copytree(decoy, tmp_path / name / "gift-i")
    rows = load_gift_i(folder, "train")
    assert rows["group_id"] == load_gift_i(prepared, "train")["group_id"]
    assert [image.size for image in rows[0]["images"]] == [(80, 60)] * 2


def test_prepared_rows(prepared, raw_tree):
    train, validation = load_gift_i(prepared, "train"), load_gift_i(prepared, "validation")
    assert train.features == validation.features == FEATURES and len(train) == 2
    row = validation[0]
    assert row["surface"] == 0 and train[1]["surface"] is None  # ClassLabel, null if unknown
    assert np.asarray(row["depths"][0]).dtype == np.uint16
    assert np.array_equal(np.asarray(row["depths"][1]).ravel(), np.arange(4800) + 60000)  # 16 bits, exactly
    for name, image in zip(row["image_names"], row["images"], strict=True):
        assert np.array_equal(np.asarray(image), np.asarray(Image.open(raw_tree / "validation/scene_100" / name)))
    assert np.asarray(train[1]["valids"][0]).min() == 255


def test_streaming_workers_and_slices(prepared):
    for folder in (prepared, prepared.parent / "raw"):
        name = {"path": str(folder)} if folder == prepared else {"path": "gift_i", "data_dir": str(folder)}
        stream = datasets.load_dataset(**name, split="train", streaming=True)
        assert [len(row["images"]) for row in stream] == [2, 3]
        assert datasets.load_dataset(**name, split="train", num_proc=2)["group_id"][:] == ["scene_0", "scene_1"]
        assert datasets.load_dataset(**name, split="train[1:]")["group_id"][:] == ["scene_1"]
    stream = datasets.load_dataset(str(prepared), split="validation", streaming=True, features=FEATURES)
    row = next(iter(stream))
    assert row["surface"] == 0
    group = collate_group(row, tiny_processor(), SIZE)
    again = collate_group(load_gift_i(prepared, "validation")[0], tiny_processor(), SIZE)
    assert group.surface == "mirror" and torch.equal(group.pixel_values, again.pixel_values)
    assert torch.equal(group.mask, again.mask) and np.array_equal(group.pictures.depths[1], again.pictures.depths[1])


def test_inside_the_package_a_group_is_parsed_once(prepared, base_dir, monkeypatch):
    made = []
    check = GroupPictures.__post_init__
    monkeypatch.setattr(GroupPictures, "__post_init__", lambda self: made.append(self.group_id) or check(self))
    rows = load_gift_i(prepared, "validation")
    group = parsed(rows)[0]
    assert isinstance(group, GroupPictures) and group.surface == "mirror" and made == ["scene_100"]
    assert (group.images[0].mode, group.masks[0].dtype, group.depths[0].dtype) == ("RGB", bool, np.uint16)
    whole = collate_group(group, tiny_processor(), SIZE)
    assert whole.pictures is group and made == ["scene_100"]
    row = collate_group(rows[0], tiny_processor(), SIZE)  # a dict may have been changed, so it is parsed where taken
    assert torch.equal(row.mask, whole.mask) and torch.equal(row.pixel_values, whole.pixel_values)
    assert parsed([rows]) == [rows]
    options = {"kind": "depth", "processor": tiny_processor(), "size": SIZE, "progress": False}
    for read in (
        lambda: dataset_fingerprint(rows),
        lambda: make_proxies(base_dir, prepared, ["validation"], SIZE),
        lambda: GroupCache(rows, tiny_processor(), SIZE, None).read(0),
        lambda: evaluate_gift_i(rows, lambda pixels: pixels[:, 0], reference="depth", **options),
    ):
        made.clear()
        read()
        assert made == ["scene_100"]


def test_hand_made_rows_are_evaluated_as_ours(prepared):
    rows = load_gift_i(prepared, "validation")
    options = {"reference": "depth", "kind": "depth", "processor": tiny_processor(), "size": SIZE, "progress": False}
    want = evaluate_gift_i(rows, lambda pixels: pixels[:, 0], **options)
    columns = ("group_id", "image_names", "images", "masks", "depths")
    row = {key: rows[0][key] for key in columns} | {"surface": "mirror"}  # what else there may be is left out
    report = evaluate_gift_i([row], lambda pixels: pixels[:, 0], **options)
    assert report.rows == want.rows
    row["masks"] = [mask.crop((0, 0, 20, 20)) for mask in row["masks"]]
    with pytest.raises(ValueError, match=r"group scene_100: the mask of 0\.png is 20x20"):
        evaluate_gift_i([row], lambda pixels: pixels[:, 0], **options)


def test_rows_behave_as_a_dataset(prepared):
    rows = load_gift_i(prepared, "train")
    assert load_gift_i(prepared, "train[:1]")["group_id"][:] == ["scene_0"]
    for other in (rows.select([1]), rows.filter(lambda row: row["group_id"] == "scene_1"), rows.shuffle(seed=3)):
        assert 1 <= len(other) <= 2 and all(isinstance(row["images"][0], Image.Image) for row in other)
    assert [len(images) for images in rows["images"]] == [2, 3]
    assert rows[:2]["image_names"][1] == rows[1]["image_names"] == ["0.png", "1.png", "2.png"]
    assert rows.select_columns("group_id")[1] == {"group_id": "scene_1"}
    again = pickle.loads(pickle.dumps(rows))
    assert dataset_fingerprint(again) == dataset_fingerprint(rows)
    fresh = "import pickle, sys; print(len(pickle.load(sys.stdin.buffer)[1]['images']))"  # as a spawned worker does it
    done = subprocess.run([sys.executable, "-c", fresh], input=pickle.dumps(rows), capture_output=True, check=True)
    assert done.stdout.split() == [b"3"]
    loader = DataLoader(rows, batch_size=None, num_workers=2, collate_fn=lambda row: row["image_names"])
    assert [len(names) for names in loader] == [2, 3]


def test_writer_adds_and_replaces_groups(prepared, tmp_path):
    extra = write_group(tmp_path / "extra", 4, seed=9)
    images = [Image.open(extra / f"{index}.png") for index in range(4)]
    masks = [Image.open(extra / "masks" / f"{index}.png") for index in range(4)]
    group = {"split": "train", "group_id": "scene_1", "surface": "mirror", "images": images, "masks": masks}
    write_gift_i([group, {**group, "group_id": "new"}], prepared, license="cc0-1.0")
    rows = load_gift_i(prepared, "train")
    assert {row["group_id"]: len(row["images"]) for row in rows} == {"scene_0": 2, "scene_1": 4, "new": 4}
    assert len(list((prepared / "train/scene_1/images").iterdir())) == 4
    lines = (prepared / "groups.jsonl").read_text().splitlines()
    assert len(lines) == 4 and not list(prepared.rglob("*.partial"))
    assert "train: 3 groups, 10 images; validation: 1 groups, 2 images." in (prepared / "README.md").read_text()


def test_writer_leaves_nothing_of_a_bad_group(tmp_path):
    group = next(records(write_raw_tree(tmp_path / "raw")))
    bad = [
        ({"masks": group["masks"][:1]}, "2 image names, but 1 masks"),
        ({"surface": "chrome"}, "surface 'chrome'"),
        ({"group_id": "../up"}, "no separators"),
        ({"split": "test"}, "write train or validation"),
        ({"images": group["images"][:1] * 2}, "all different"),
        ({"depths": [np.zeros((60, 80), np.float32)] * 2}, "whole millimetres"),
        ({"depths": [group["images"][0]] * 2}, "16-bit PNG"),
    ]
    for change, words in bad:
        with pytest.raises(ValueError, match=words):
            write_gift_i([{**group, **change}], tmp_path / "out", license="cc0-1.0")
    assert not list((tmp_path / "out").rglob("*.p*"))


# ---- the raw tree ----


def test_raw_tree_by_name(raw_tree, tmp_path, monkeypatch):
    (tmp_path / "gift_i").mkdir()  # a folder of this name does not shadow the builder
    monkeypatch.chdir(tmp_path)
    loaded = datasets.load_dataset("gift_i", data_dir=str(raw_tree))
    assert loaded["train"].features == FEATURES and len(loaded["validation"]) == 1
    assert loaded["validation"][0]["reference"].size == (80, 60)
    stored = loaded["train"].with_format("arrow")[0].to_pydict()["images"][0][0]
    assert stored == {"bytes": None, "path": str(raw_tree / "train/scene_0/0.png")}  # no image is copied


def test_all_forms_hold_the_same(raw_tree, tmp_path):
    plain = [{**group, "valids": [], "depths": []} for group in records(raw_tree)]
    folder = write_gift_i(plain, tmp_path / "prepared", license="cc0-1.0")
    release = tmp_path / "release"
    (release / "data").mkdir(parents=True)
    for split in ("train", "validation"):
        rows = datasets.load_dataset(str(folder), split=split, features=FEATURES).with_format("arrow")
        rows = rows.map(embed_table_storage, batched=True, batch_size=1).with_format(None)
        rows.to_parquet(release / "data" / f"{split}-00000-of-00001.parquet")
    shutil.copytree(folder, moved := tmp_path / "moved")
    (moved / "README.md").unlink()  # without the card's data_files
    for split in ("train", "validation"):
        prints = {dataset_fingerprint(load_gift_i(path, split)) for path in (raw_tree, folder, release, moved)}
        assert len(prints) == 1
        assert all("train" in gift_i_splits(path) for path in (raw_tree, folder, release, moved))
    rows = load_gift_i(release, "train")
    shutil.rmtree(folder)
    assert rows.features == FEATURES and len(rows[1]["images"]) == 3
    assert dataset_fingerprint(rows) == dataset_fingerprint(rows.select([1, 0]))
    assert dataset_fingerprint(rows) != dataset_fingerprint(rows.select([1]))


def test_without_split_folders_references_decide(tmp_path):
    # Words such as "test" and "train" in names, by which `datasets` guesses splits, mean nothing here.
    for index, (name, reference) in enumerate({"test_mirror": True, "a": False, "train_01": False}.items()):
        write_group(tmp_path / "raw" / name, 2, index, reference)
    loaded = datasets.load_dataset("gift_i", data_dir=str(tmp_path / "raw"))
    assert {split: rows["group_id"][:] for split, rows in loaded.items()} == {
        "train": ["a", "train_01"],
        "validation": ["test_mirror"],
    }
    assert gift_i_splits(tmp_path / "raw") == ["train", "validation"]


@pytest.mark.parametrize("load", [lambda raw: load_gift_i(raw, "train"), lambda raw: GiftI(data_dir=str(raw))])
def test_a_changed_tree_is_read_again(tmp_path, load):
    def rows():
        loaded = load(raw)
        if isinstance(loaded, GiftI):
            loaded.download_and_prepare()
            loaded = loaded.as_dataset(split="train")
        return loaded

    raw = tmp_path / "raw"
    for index, name in enumerate(["test_mirror", "b", "c"]):
        write_group(raw / name, 2, index)
    assert len(rows()) == 3
    shutil.rmtree(raw / "b")
    assert rows()["group_id"][:] == ["c", "test_mirror"]
    (raw / "c" / "group.yaml").write_text("surface: mirror\nnotes: hallway\n")
    assert rows()[0]["surface"] == 0


def test_a_tree_changed_under_its_old_time_is_read_again(tmp_path):
    """As rsync leaves it, and of the same size."""
    folder = write_group(tmp_path / "raw/train/g", 2, 0)
    labels = np.zeros((60, 80), np.uint8)
    labels[10:30, 10:30], labels[40:, :] = 2, 7
    for index in range(2):
        save_mask(folder / "masks" / f"{index}.png", labels)
    facts = folder / "group.yaml"
    for target in (2, 7):
        before = facts.stat() if facts.exists() else None
        facts.write_text(f"mask_class: {target}\n")
        if before is not None:
            os.utime(facts, ns=(before.st_atime_ns, before.st_mtime_ns))
        row = load_gift_i(tmp_path / "raw", "train")[0]
        assert np.array_equal(np.asarray(row["masks"][0]) == 255, labels == target)


def test_natural_order_and_duplicates(tmp_path, caplog):
    folder = write_group(tmp_path / "raw" / "train" / "g", 12, 0)
    assert load_gift_i(tmp_path / "raw", "train")[0]["image_names"] == [f"{index}.png" for index in range(12)]
    Image.open(folder / "3.png").save(folder / "7.bmp")  # the same picture in another file
    (folder / "7.png").unlink()
    row = load_gift_i(tmp_path / "raw", "train")[0]
    assert row["image_names"] == [f"{index}.png" for index in range(12) if index != 7] and len(row["masks"]) == 11
    assert "7.bmp: dropped, the same picture as 3.png" in caplog.text


def test_prepared_lists_are_put_in_order(prepared):
    path = prepared / "train/metadata.parquet"
    table = pq.read_table(path)
    rows = table.to_pylist()
    for key in ("image_names", "images_file_names", "masks_file_names", "valids_file_names"):
        rows[1][key] = [rows[1][key][index] for index in (2, 0, 1, 0)]
    pq.write_table(table.from_pylist(rows, schema=SCHEMA), path)
    first = prepared / rows[0]["images_file_names"][0]
    row = load_gift_i(prepared, "train")[1]
    assert row["image_names"] == ["0.png", "1.png", "2.png"] and len(row["valids"]) == 3 and not first.exists()
    assert load_gift_i(prepared, "train")["image_names"][1] == row["image_names"]


def test_mask_class(tmp_path):
    folder = write_group(tmp_path / "raw" / "train" / "g", 2, 0)
    labels = np.zeros((60, 80), np.uint8)
    labels[10:30, 10:30], labels[40:, :] = 2, 7
    for index in range(2):
        save_mask(folder / "masks" / f"{index}.png", labels)
    with pytest.raises(ValueError) as excinfo:
        load_gift_i(tmp_path / "raw", "train")
    one_line(excinfo, folder / "masks/0.png", "3 different values")
    (folder / "group.yaml").write_text("surface: transparent\nmask_class: 2\n")
    row = load_gift_i(tmp_path / "raw", "train")[0]
    assert np.array_equal(np.asarray(row["masks"][1]) == 255, labels == 2)
    plain = datasets.load_dataset("gift_i", data_dir=str(tmp_path / "raw"), split="train")[0]
    assert np.array_equal(np.asarray(plain["masks"][0]) == 255, labels == 2)


# ---- real photographs ----


@pytest.mark.skipif(not os.path.isdir(CLEARGRASP), reason="the ClearGrasp samples are not beside the repository")
def test_cleargrasp_as_validation_groups(tmp_path):
    def groups():
        for scene in sorted(entry.path for entry in os.scandir(CLEARGRASP) if entry.is_dir()):
            depth = np.asarray(Image.open(f"{scene}/opaque_depth_mm.png"))
            yield (
                {
                    "split": "validation",
                    "group_id": os.path.basename(scene),
                    "surface": "transparent",
                    "images": [f"{scene}/transparent.jpg"],
                    "masks": [f"{scene}/mask.png"],
                    "depths": [f"{scene}/opaque_depth_mm.png"],
                    "reference": f"{scene}/opaque_sprayed.jpg",
                },
                depth,
            )

    expected = list(groups())
    folder = write_gift_i((group for group, _ in expected), tmp_path / "clear", license="apache-2.0")
    assert list(datasets.load_dataset(str(folder))) == ["validation"]
    rows = load_gift_i(folder, "validation")
    assert len(rows) == len(expected) == 2
    for row, (_, depth) in zip(rows, expected, strict=True):
        assert row["image_names"] == ["transparent.jpg"] and row["images"][0].size == (1280, 720)
        assert np.array_equal(np.asarray(row["depths"][0]), depth) and depth.max() > 300
        assert 0.001 < (np.asarray(row["masks"][0]) == 255).mean() < 0.5
        assert row["reference"].size == (1280, 720)


def test_saved_to_disk_and_loaded_again(raw_tree, base_dir, tmp_path):
    make_proxies(base_dir, raw_tree, size=SIZE)
    rows = load_gift_i(raw_tree, "train", teacher=base_dir)
    expected = list(rows)
    rows.save_to_disk(tmp_path / "one")
    both = datasets.DatasetDict({split: load_gift_i(raw_tree, split) for split in ("train", "validation")})
    both.save_to_disk(tmp_path / "both")
    names = dict(zip(rows["group_id"], rows["image_names"], strict=True))
    kept = datasets.load_from_disk(tmp_path / "one")  # with its proxies
    assert torch.equal(kept[0]["proxies"], expected[0]["proxies"])
    shutil.move(raw_tree / "train", tmp_path / "gone")  # the pictures are in it
    for folder, splits in ((tmp_path / "one", ["train"]), (tmp_path / "both", ["train", "validation"])):
        assert gift_i_splits(folder) == splits
        again = load_gift_i(folder, "train")
        assert dict(zip(again["group_id"], again["image_names"], strict=True)) == names
        for row, before in zip(again, expected, strict=True):
            for column in ("images", "masks"):
                assert all(np.array_equal(a, b) for a, b in zip(row[column], before[column], strict=True))
        assert load_gift_i(folder, "train[1:]")["group_id"][:] == rows["group_id"][1:]
    make_proxies(base_dir, tmp_path / "both", size=SIZE)
    assert torch.equal(load_gift_i(tmp_path / "both", "train", teacher=base_dir)[1]["proxies"], expected[1]["proxies"])
    with pytest.raises(ValueError, match="no split 'validation', only train"):
        load_gift_i(tmp_path / "one", "validation")
    datasets.Dataset.from_dict({"a": [1]}, split="train").save_to_disk(tmp_path / "other")
    with pytest.raises(ValueError, match="it lacks the column "):
        load_gift_i(tmp_path / "other", "train")
