"""Links of raw trees: into the tree, into the store that has the photos, and nowhere else."""

import hashlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.drawn_masks import BOX, SIZE, coco, labelme, picture
from PIL import Image

from gift_peft.captures.links import checked
from gift_peft.captures.masks import find_mask
from gift_peft.captures.tree import list_groups, raw_example


@pytest.fixture
def group(tmp_path) -> Path:
    folder = tmp_path / "raw/train/scene"
    (folder / "masks").mkdir(parents=True)
    for name in ("1", "2"):
        Image.fromarray(np.random.default_rng(int(name)).integers(0, 255, (8, 12, 3), np.uint8)).save(
            folder / f"{name}.png"
        )
        Image.fromarray(picture()).save(folder / f"masks/{name}.png")
    return folder


def stored(tree: Path, store: Path, deep: bool) -> None:
    """Move every file of a tree into a store and link to it, as the Hub's cache (flat) or git-annex and DVC (deep)."""
    for path in [path for path in sorted(tree.rglob("*")) if path.is_file()]:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        place = store / digest[:2] / digest[2:4] / digest if deep else store / digest
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(path, place)
        path.symlink_to(os.path.relpath(place, path.parent))


@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize("form", ["png", "labelme", "coco at the root", "mask for all"])
def test_masks_in_the_store_of_the_photos_are_read(group, tmp_path, deep, form):
    if form != "png":
        shutil.rmtree(group / "masks")
    if form == "labelme":
        for name in ("1", "2"):
            (group / f"{name}.json").write_text(json.dumps(labelme(imagePath=f"{name}.png")))
    elif form == "coco at the root":
        content = coco("scene/1.png")
        content["images"].append({"id": 6, "file_name": "scene/2.png"})
        content["annotations"].append({"image_id": 6, "category_id": 2, "bbox": [3, 2, 6, 4]})
        (tmp_path / "raw/all.json").write_text(json.dumps(content))
    elif form == "mask for all":
        Image.fromarray(picture()).save(group / "mask.png")
    stored(tmp_path / "raw", tmp_path / "cache/blobs", deep)
    assert list_groups(tmp_path / "raw") == {"train": [group]}
    row = raw_example(group, "train", tmp_path / "raw")
    for mask in row["masks"]:
        array = np.asarray(Image.open(mask)) if isinstance(mask, str) else picture()
        np.testing.assert_array_equal(array, picture())


def test_a_folder_of_groups_may_be_a_link(group, tmp_path):
    shutil.move(tmp_path / "raw/train", tmp_path / "elsewhere/train")
    (tmp_path / "raw/train").symlink_to(tmp_path / "elsewhere/train")
    assert len(raw_example(group, "train", tmp_path / "raw")["masks"]) == 2


def test_links_stay_inside_the_root(group, tmp_path):
    outside = tmp_path / "outside.png"
    Image.fromarray(picture()).save(outside)
    link = group / "masks/1.png"

    def look():
        return find_mask(group / "1.png", group, tmp_path / "raw")

    for goal, words in ((outside, "leads out of"), (Path("1.png"), "leads nowhere"), (tmp_path / "no", "nowhere")):
        link.unlink()
        link.symlink_to(goal)
        with pytest.raises(ValueError, match=rf"masks/1\.png: a link that .*{words}") as error:
            look()
        assert "\n" not in str(error.value)
    link.unlink()
    shutil.copy(outside, tmp_path / "raw/shared.png")
    link.symlink_to(tmp_path / "raw/shared.png")
    np.testing.assert_array_equal(look().read(SIZE), BOX)


def test_a_linked_photo_opens_no_other_folder(group, tmp_path, monkeypatch):
    """An archive may link photos and masks wherever it likes: what they share must be a store."""
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home/me")
    photo, secret = group / "1.png", tmp_path / "home/me/secret.png"
    for goal in (tmp_path / "home/me/pictures/1.png", tmp_path / "raw2/1.png"):
        goal.parent.mkdir(parents=True)
        shutil.copy(group / "2.png", goal)
        Image.fromarray(picture()).save(secret)
        photo.unlink()
        photo.symlink_to(goal)
        mask = group / "masks/1.png"
        mask.unlink()
        mask.symlink_to(secret)
        with pytest.raises(ValueError, match="leads out of"):
            find_mask(photo, group, tmp_path / "raw")
    with pytest.raises(ValueError, match="leads out of"):
        checked(mask, tmp_path / "raw")
