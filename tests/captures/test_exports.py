"""One labeling project for many groups: which of its entries is whose, and what is said where it is nobody's."""

import json

import numpy as np
import pytest
from helpers.drawn_masks import BOX, CORNERS, SIZE, coco, percent, picture, region, tasks
from PIL import Image

from gift_peft.captures.masks import find_mask
from gift_peft.captures.tree import list_groups, raw_example

REGION = region(points=percent(CORNERS))


@pytest.fixture
def raw(tmp_path):
    """Two groups; cup/1.jpg and hall/1.jpg share a name."""
    for group, names in (("cup", ("1", "2")), ("hall", ("1", "3"))):
        folder = tmp_path / "raw/train" / group
        folder.mkdir(parents=True)
        for name in names:
            seed = sum(map(ord, group + name))
            pixels = np.random.default_rng(seed).integers(0, 255, (8, 12, 3), np.uint8)
            Image.fromarray(pixels).save(folder / f"{name}.jpg")
    return tmp_path / "raw"


def many(*names, mark=True):
    content = coco(names[0])
    content["images"], annotations = [], []
    for number, name in enumerate(names):
        content["images"].append({"id": number, "file_name": name, "width": SIZE[0], "height": SIZE[1]})
        annotations.append({"image_id": number, "category_id": 2, "bbox": [3, 2, 6, 4]})
    return content | {"annotations": annotations if mark else []}


def look(raw, name):
    photo = raw / "train" / name
    return find_mask(photo, photo.parent, raw)


@pytest.mark.parametrize("place", ["", "train/", "annotations/"])
def test_a_bare_name_that_one_photo_has(raw, place):
    path = raw / f"{place}all.json"
    path.parent.mkdir(exist_ok=True)
    exports = (
        many("cup/1.jpg", "2.jpg", "hall/1.jpg", "3.jpg"),
        [tasks(REGION, image=f"/data/upload/9/0a1b2c3d-{name}.jpg")[0] for name in ("2", "3")],
    )
    for content in exports:
        path.write_text(json.dumps(content))
        for name in ("cup/2.jpg", "hall/3.jpg"):
            np.testing.assert_array_equal(look(raw, name).read(SIZE), BOX)
    path.write_text(json.dumps(many("cup/1.jpg", "2.jpg", "hall/1.jpg", "3.jpg")))
    assert len(list_groups(raw)["train"]) == 2
    assert len(raw_example(raw / "train/hall", "train", raw)["masks"]) == 2


def test_a_bare_name_that_two_photos_have(raw):
    (raw / "all.json").write_text(json.dumps(many("1.jpg", "2.jpg", "3.jpg")))
    assert look(raw, "cup/1.jpg") is None and look(raw, "hall/1.jpg") is None
    (raw / "train/hall/1.jpg").unlink()
    assert look(raw, "cup/1.jpg").entry == "1.jpg"


def test_the_name_of_another_folder_is_not_bare(raw):
    (raw / "all.json").write_text(json.dumps(many("mug/2.jpg", "x/3.jpg")))
    assert look(raw, "cup/2.jpg") is None and look(raw, "hall/3.jpg") is None


@pytest.mark.parametrize("place", ["", "train/", "annotations/"])
def test_cvat_pictures_for_all_groups(raw, place):
    folder = raw / f"{place}SegmentationClass"
    (folder / "cup").mkdir(parents=True)
    for name in ("2.png", "3.png", "1.png", "cup/1.png"):
        Image.fromarray(picture()).convert("RGB").save(folder / name)
    (folder.parent / "labelmap.txt").write_text("\ufeff# label:color_rgb\nbackground:0,0,0::\nglass:255,255,255::\n")
    for name in ("cup/1.jpg", "cup/2.jpg", "hall/3.jpg"):
        np.testing.assert_array_equal(look(raw, name).read(SIZE), BOX)
    assert look(raw, "hall/1.jpg") is None  # two photos are called 1
    assert list(list_groups(raw)) == ["train"]


def test_the_message_names_what_was_seen(raw):
    (raw / "train/hall/x.json").write_text(json.dumps(many("7.jpg", "8.jpg")))
    (raw / "all.json").write_text(json.dumps(many("1.jpg", "cup/1.jpg", "cup/2.jpg")))
    (raw / "camera.json").write_text('{"fx": 600}')
    (raw / "annotations.xml").write_text("<annotations/>")
    with pytest.raises(FileNotFoundError) as error:
        list_groups(raw)
    text = str(error.value)
    assert text.startswith(f"missing mask {raw}/train/hall/masks/1.png for the image 1.jpg; ")
    assert f"{raw}/train/hall/x.json (COCO, 2 images) does not list 1.jpg" in text
    assert f"{raw}/all.json (COCO) lists 1.jpg, a name that 2 photos below {raw} have; call it hall/1.jpg" in text
    assert f"{raw}/annotations.xml is not read (export as COCO, or as masks)" in text
    assert "--propose-masks" in text and "camera" not in text and "\n" not in text


@pytest.mark.parametrize("name", ["1.JPG", "1.png", "images/1.HEIC"])
def test_photos_that_were_converted(raw, name):
    (raw / "train/cup/x.json").write_text(json.dumps(many(name)))
    assert look(raw, "cup/1.jpg").entry == name
    assert look(raw, "cup/2.jpg") is None
    (raw / "train/cup/x.json").write_text(json.dumps(many(name, "1.tif")))
    with pytest.raises(ValueError, match=r"may both mean 1\.jpg"):
        look(raw, "cup/1.jpg")


def test_the_short_form_of_label_studio_is_refused(raw):
    short = [{"image": "/data/upload/1/0a1b2c3d-1.jpg", "id": 1, "annotation_id": 2, "label": [{"points": CORNERS}]}]
    (raw / "train/cup/x.json").write_text(json.dumps(short))
    with pytest.raises(ValueError, match=r"x\.json: Label Studio's short form \(JSON-MIN\)"):
        look(raw, "cup/1.jpg")


def test_an_export_that_only_lists_a_photo_counts_last(raw):
    (raw / "train/cup/a.json").write_text(json.dumps(many("1.jpg", "2.jpg", mark=False)))
    listed = look(raw, "cup/1.jpg")
    assert listed.path.name == "a.json" and not listed.annotated
    (raw / "all.json").write_text(json.dumps(many("cup/1.jpg")))
    found = look(raw, "cup/1.jpg")
    assert found.path.name == "all.json" and found.annotated
