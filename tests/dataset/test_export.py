"""Parquet release: the same pixels in every way of reading it, shards of the stated size, nothing half-written."""

from itertools import pairwise

import datasets
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from helpers.tiny import write_group, write_raw_tree
from PIL import Image

from gift_peft.cli import main
from gift_peft.dataset.export import export_parquet
from gift_peft.dataset.gift_i import FEATURES, load_gift_i
from gift_peft.dataset.rows import IMAGE_COLUMNS
from gift_peft.dataset.writer import write_gift_i


def prepared(tmp_path, counts=(2, 3), size=(60, 80)):
    """A prepared folder: JPEG and PNG images, warped frames' valids, depths, a reference."""
    groups = []
    for split, number in (("train", counts), ("validation", (2,))):
        for index, count in enumerate(number):
            folder = write_group(tmp_path / "raw" / split / f"{split}{index}", count, index, split != "train", size)
            images = sorted(folder.glob("[0-9]*.png"))
            Image.open(images[0]).save(folder / "0.jpg", quality=90)
            images[0] = folder / "0.jpg"
            valid = np.ones(size, bool)
            valid[:, :4] = False
            groups.append(
                {
                    "split": split,
                    "group_id": folder.name,
                    "surface": "mirror" if index else None,
                    "images": images,
                    "masks": sorted((folder / "masks").iterdir()),
                    "valids": [valid] * count if index else [],
                    "depths": [np.full(size, 1234, np.uint16)] * count if split != "train" else [],
                    "reference": folder / "reference.png" if split != "train" else None,
                }
            )
    return write_gift_i(groups, tmp_path / "prepared", license="cc-by-4.0", pretty_name="Mirrors: mine")


def pixels(row) -> dict:
    """Every picture of a plain row as an array, and the rest as it is."""
    found = {key: value for key, value in row.items() if key not in (*IMAGE_COLUMNS, "reference")}
    for key in IMAGE_COLUMNS:
        found[key] = [(image.mode, np.asarray(image).tolist()) for image in row[key] or []]
    found["reference"] = None if row["reference"] is None else np.asarray(row["reference"]).tolist()
    return found


def test_every_way_of_reading_gives_the_source(tmp_path):
    source = prepared(tmp_path)
    release = export_parquet(source, tmp_path / "release")
    plain = datasets.load_dataset(str(source), features=FEATURES)
    for split in ("train", "validation"):
        expected = [pixels(row) for row in plain[split]]
        assert [pixels(row) for row in datasets.load_dataset(str(release), split=split)] == expected
        streamed = datasets.load_dataset(str(release), split=split, streaming=True)
        assert streamed.features == FEATURES
        assert [pixels(row) for row in streamed] == expected
        ours = list(load_gift_i(release, split))
        assert [pixels(row) for row in ours] == [pixels(row) for row in load_gift_i(source, split)]


def test_raw_tree_with_classes_and_a_licence(tmp_path):
    folder = write_group(tmp_path / "raw/train/scene", 2, 0)
    (folder / "group.yaml").write_text("surface: transparent\nmask_class: 255\n")
    with pytest.raises(ValueError, match=r"no card .* that states its licence; give --license"):
        export_parquet(tmp_path / "raw", tmp_path / "release")
    export_parquet(tmp_path / "raw", tmp_path / "release", license="mit")
    expected = [pixels(row) for row in load_gift_i(tmp_path / "raw", "train")]
    assert [pixels(row) for row in datasets.load_dataset(str(tmp_path / "release"), split="train")] == expected
    card = (tmp_path / "release/README.md").read_text()
    assert yaml.safe_load(card.split("---")[1])["license"] == "mit"


def test_shards_hold_what_fits_and_file_names_only(tmp_path):
    source = prepared(tmp_path, counts=(2, 2, 2, 9))
    limit = 60_000
    release = export_parquet(source, tmp_path / "release", f"{limit / 1000:g}KB")
    shards = sorted((release / "data").glob("train-*"))
    assert [path.name for path in shards] == [
        f"train-{k:05d}-of-{len(shards):05d}.parquet" for k in range(len(shards))
    ]
    tables = [pq.read_table(path) for path in shards]
    assert sum(len(table) for table in tables) == 4 and 1 < len(tables) < 4
    assert all(table.nbytes < 1.1 * limit or len(table) == 1 for table in tables)
    assert all(first.nbytes + second[:1].nbytes > 0.9 * limit for first, second in pairwise(tables))
    for path, table in zip(shards, tables, strict=True):
        assert pq.ParquetFile(path).num_row_groups == len(table)  # one group in memory at a time
        for images in table["images"].to_pylist():
            assert all("/" not in image["path"] and image["bytes"] for image in images)


def test_another_dataset_in_a_folder_of_the_same_name_is_not_taken_for_this_one(tmp_path):
    """Equal but for one mask: `datasets` caches by the folder's last name and the card."""
    shown = []
    for value in (0, 255):
        source = prepared(tmp_path / str(value))
        path = next((source / "train/train0/masks").iterdir())
        Image.fromarray(np.where(np.asarray(Image.open(path)) > 0, 255, value).astype(np.uint8)).save(path)
        release = export_parquet(source, tmp_path / str(value) / "release")
        for folder in (source, release):
            row = datasets.load_dataset(str(folder), split="train")[0]
            shown.append((np.asarray(row["masks"][0]) == 255).mean())
        assert len(load_gift_i(release, "train")) == 2
    assert shown[0] == shown[1] < shown[2] == shown[3] == 1


def test_card_keeps_what_the_source_says(tmp_path):
    source = prepared(tmp_path)
    release = export_parquet(source, tmp_path / "release")
    text = (release / "README.md").read_text()
    facts = yaml.safe_load(text.split("---")[1])
    assert facts["configs"][0]["description"].startswith("content ")
    assert facts["license"] == "cc-by-4.0" and facts["pretty_name"] == "Mirrors: mine"
    assert facts["configs"][0]["data_files"] == [
        {"split": "train", "path": "data/train-*"},
        {"split": "validation", "path": "data/validation-*"},
    ]
    counted = {split["name"]: split["num_examples"] for split in facts["dataset_info"]["splits"]}
    assert counted == {"train": 2, "validation": 1}
    assert str(tmp_path) not in text and "train: 2 groups, 5 images" in text


def test_damaged_picture_leaves_nothing(tmp_path):
    source = prepared(tmp_path)
    damaged = sorted((source / "validation/validation0/masks").iterdir())[-1]
    damaged.write_bytes(damaged.read_bytes()[:60])
    with pytest.raises(ValueError, match=damaged.name):
        export_parquet(source, tmp_path / "release")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["prepared", "raw"]


def test_refusals(tmp_path):
    source = prepared(tmp_path)
    (tmp_path / "used").mkdir()
    (tmp_path / "used/file").touch()
    for folder, message in (("used", "holds files that were not written"), ("prepared/release", "is inside")):
        with pytest.raises(ValueError, match=message):
            export_parquet(source, tmp_path / folder)
    for size in ("0MB", "many", "-1", "5 TBs", "nan", "1e999"):
        with pytest.raises(ValueError, match="max_shard_size"):
            export_parquet(source, tmp_path / "release", size)
    (source / "README.md").write_text("---\n: [\n---\n")
    with pytest.raises(ValueError, match=r"README\.md: its metadata is not valid YAML"):
        export_parquet(source, tmp_path / "release")
    with pytest.raises(FileNotFoundError, match="nothing"):
        export_parquet(tmp_path / "nothing", tmp_path / "release", license="mit")
    assert not (tmp_path / "release").exists()


def test_command(tmp_path, capsys):
    raw = write_raw_tree(tmp_path / "raw")
    (tmp_path / "release").mkdir()  # empty: fine
    arguments = ["export", str(raw), str(tmp_path / "release"), "--format", "parquet", "--max-shard-size", "1GB"]
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 1 and "give --license" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        main([*arguments, "--license", "mit"])
    assert stop.value.code == 0 and capsys.readouterr().out == f"Dataset: {tmp_path / 'release'}\n"
    assert len(load_gift_i(tmp_path / "release", "train")) == 2


@pytest.mark.slow
def test_groups_of_55_images_at_1280x720(tmp_path):
    source = prepared(tmp_path, counts=(55,), size=(720, 1280))
    release = export_parquet(source, tmp_path / "release")
    for split in ("train", "validation"):
        streamed = datasets.load_dataset(str(release), split=split, streaming=True)
        for row, expected in zip(streamed, load_gift_i(source, split), strict=True):
            for column in ("images", "masks"):
                assert len(row[column]) == len(expected[column]) == (55 if split == "train" else 2)
                for image, other in zip(row[column], expected[column], strict=True):
                    np.testing.assert_array_equal(np.asarray(image), np.asarray(other))
