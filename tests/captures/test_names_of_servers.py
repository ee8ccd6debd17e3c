"""Names and labels as labeling servers and other machines write them, and what is said of files that are not read."""

import json

import numpy as np
import pytest
from helpers.drawn_masks import BOX, CORNERS, SIZE, coco, labelme, percent, picture, region, tasks
from PIL import Image

from gift_peft.captures.labels import choose_labels, relative_name
from gift_peft.captures.masks import find_mask
from gift_peft.captures.tree import decode_capture, list_groups, read_capture

DIGEST = "2d11fcb83b85cc9e091781222d714baa"
REGION = region(points=percent(CORNERS))


def photos(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(names):
        pixels = np.random.default_rng(seed).integers(0, 255, (8, 12, 3), np.uint8)
        Image.fromarray(pixels).save(folder / name)
    return folder


def many(*names):
    """A COCO file: the box in the first image, another shape in the others, so that a mix-up shows."""
    content = coco(names[0])
    content["images"] = [
        {"id": number, "file_name": name, "width": SIZE[0], "height": SIZE[1]} for number, name in enumerate(names)
    ]
    content["annotations"] = [
        {"image_id": number, "category_id": 2, "bbox": [0, 0, 1, 1] if number else [3, 2, 6, 4]}
        for number in range(len(names))
    ]
    return content


def look(root, group, name):
    return find_mask(group / name, group, root)


@pytest.mark.parametrize(
    ("photo", "given"),
    [
        ("hall 7.png", f"hall-7_png.rf.{DIGEST}.jpg"),
        ("IMG_1.JPG", f"IMG_1_JPG.rf.{DIGEST}.jpg"),
        ("IMG_1.jpeg", f"test/IMG_1_jpeg.rf.Zk3{DIGEST[:9]}.jpg"),
        ("Capture d’écran (3).png", "images/0a1b2c3d-Capture_décran_3.png"),
        ("WhatsApp Image 2024-05-01 at 09.11.12.jpeg", "9f8e7d6c-WhatsApp_Image_2024-05-01_at_09.11.12.jpeg"),
        ("a b.jpg", "a_b.jpg"),
        ("1.jpg", "C:\\Users\\me\\photos\\1.jpg"),
        ("1.jpg", "/srv/data/1.jpg"),
        ("1.jpg", "..\\label\\1.jpg"),
        ("1.jpg", "file:///home/me/1.jpg"),
    ],
)
def test_the_photo_that_a_name_means(tmp_path, photo, given):
    group = photos(tmp_path / "train/cup", photo, "other.jpg")
    (group / "x.json").write_text(json.dumps(many(given, "else.jpg")))
    np.testing.assert_array_equal(look(tmp_path, group, photo).read(SIZE), BOX)
    assert look(tmp_path, group, "other.jpg") is None


@pytest.mark.parametrize("given", [f"a-b_jpg.rf.{DIGEST}.jpg", "0a1b2c3d-a_b.jpg", "a_b.jpg"])
def test_at_the_root_an_uploaded_name_counts_where_one_photo_has_it(tmp_path, given):
    cup, hall = photos(tmp_path / "train/cup", "a b.jpg"), photos(tmp_path / "train/hall", "2.jpg")
    (tmp_path / "all.json").write_text(json.dumps(many(given)))
    np.testing.assert_array_equal(look(tmp_path, cup, "a b.jpg").read(SIZE), BOX)
    assert look(tmp_path, hall, "2.jpg") is None
    photos(hall, "a_b.jpg" if "_b" in given else "a-b.jpg")  # which the server would have called the same
    assert look(tmp_path, cup, "a b.jpg") is None


def test_a_name_goes_to_the_photo_that_has_it(tmp_path):
    group = photos(tmp_path / "train/cup", "a b.jpg", "a_b.jpg")
    (group / "x.json").write_text(json.dumps(many("a_b.jpg")))
    assert look(tmp_path, group, "a_b.jpg").entry == "a_b.jpg"
    assert look(tmp_path, group, "a b.jpg") is None


def test_two_copies_of_a_photo_are_refused(tmp_path):
    group = photos(tmp_path / "train/cup", "1.jpg")
    (group / "x.json").write_text(json.dumps(many(f"1_jpg.rf.{DIGEST}.jpg", f"1_jpg.rf.0{DIGEST[1:]}.jpg")))
    with pytest.raises(ValueError, match=r"may both mean 1\.jpg; keep one"):
        look(tmp_path, group, "1.jpg")


def test_a_path_of_another_machine_keeps_its_folders(tmp_path):
    cup, hall = (photos(tmp_path / f"train/{name}", "1.jpg") for name in ("cup", "hall"))
    (tmp_path / "all.json").write_text(json.dumps(many("/home/me/caps/cup/1.jpg")))
    np.testing.assert_array_equal(look(tmp_path, cup, "1.jpg").read(SIZE), BOX)
    assert look(tmp_path, hall, "1.jpg") is None


@pytest.mark.parametrize("name", ["", "/", "..", "a/..", "C:\\", "a\0.jpg", None, 7])
def test_no_name(name):
    with pytest.raises(ValueError, match="is not an image's name"):
        relative_name(name)


def test_label_in_other_capitals():
    known = {"Glass ": (), "frame": ()}
    assert choose_labels(known, "glass", "labels") == ["Glass "]
    assert choose_labels(known, ["FRAME", "frame"], "labels") == ["frame"]
    assert choose_labels({"Glass": (), "glass": ()}, "glass", "labels") == ["glass"]
    with pytest.raises(ValueError, match="mask_class 'GLASS' may mean 'Glass' or 'glass'; write it as there"):
        choose_labels({"Glass": (), "glass": ()}, "GLASS", "labels")
    with pytest.raises(ValueError, match="none of the labels there"):
        choose_labels(known, "glas", "labels")


def test_background_in_capitals_is_no_target(tmp_path):
    group = photos(tmp_path / "train/cup", "1.jpg")
    content = labelme()
    whole = {"label": "Background", "points": [[0, 0], [12, 0], [12, 8], [0, 8]], "shape_type": "polygon"}
    content["shapes"].insert(0, whole)
    (group / "1.json").write_text(json.dumps(content))
    np.testing.assert_array_equal(look(tmp_path, group, "1.jpg").read(SIZE), BOX)
    (group / "1.json").unlink()
    (group / "SegmentationClass").mkdir()
    Image.fromarray(picture()).convert("RGB").save(group / "SegmentationClass/1.png")
    (group / "labelmap.txt").write_text("Background:0,0,0::\nglass:255,255,255::\n")
    np.testing.assert_array_equal(look(tmp_path, group, "1.jpg").read(SIZE), BOX)


@pytest.mark.parametrize(("text", "message"), [("yes", "need quotes"), ("[1, off]", "need quotes"), ("1.5", "value")])
def test_mask_class_that_yaml_reads_otherwise(tmp_path, text, message):
    group = photos(tmp_path / "train/cup", "1.jpg", "2.jpg")
    (group / "group.yaml").write_text(f"mask_class: {text}\n")
    with pytest.raises(ValueError, match=rf"group\.yaml: mask_class .*{message}"):
        read_capture(group, "train", tmp_path)


def test_surface_in_capitals(tmp_path):
    group = photos(tmp_path / "train/cup", "1.jpg", "2.jpg")
    (group / "group.yaml").write_text("surface: Mirror\n")
    assert read_capture(group, "train", tmp_path).facts["surface"] == "mirror"


@pytest.mark.parametrize("end", ["-mask.png", ".mask.PNG", " mask.png", "_Mask.png"])
def test_a_mask_beside_its_photo(tmp_path, end):
    group = photos(tmp_path / "train/cup", "1.jpg", "2.jpg")
    for name in ("1", "2"):
        Image.fromarray(picture()).save(group / f"{name}{end}")
    capture = read_capture(group, "train", tmp_path)
    assert [path.name for path in capture.images] == ["1.jpg", "2.jpg"]
    assert all(np.array_equal(mask, BOX) for mask in decode_capture(capture).masks)


def test_two_masks_beside_a_photo_are_refused(tmp_path):
    group = photos(tmp_path / "train/cup", "1.jpg", "1-mask.png", "1_mask.png")
    with pytest.raises(ValueError, match=r"1_mask\.png and 1-mask\.png may both be the mask of 1\.jpg"):
        read_capture(group, "train", tmp_path)


@pytest.mark.parametrize(
    "place",
    ["masks/1.npy", "labels/1.txt", "1.txt", "masks/1.psd", "masks/.1.png.icloud", "via.json", "ann/1.jpg.json"],
)
def test_what_is_not_read_is_named(tmp_path, place):
    group = photos(tmp_path / "train/cup", "1.jpg", "2.jpg")
    path = group / place
    path.parent.mkdir(exist_ok=True)
    path.write_text('{"k": {"filename": "1.jpg", "regions": []}}')
    with pytest.raises(FileNotFoundError, match="missing mask") as error:
        list_groups(tmp_path)
    assert f"not read: train/cup/{place} (masks are pictures" in str(error.value) and "\n" not in str(error.value)


def test_a_folder_of_masks_under_another_name(tmp_path):
    group = photos(tmp_path / "train/cup", "1.jpg", "2.jpg")
    photos(group / "labels", "1.png", "2.png")
    with pytest.raises(FileNotFoundError, match="if labels/ holds masks and not photos, call it masks/"):
        list_groups(tmp_path)


def test_forms_that_are_refused_by_their_name(tmp_path):
    group = photos(tmp_path / "train/cup", "1.jpg", "2.jpg")
    panoptic = coco() | {"annotations": [{"image_id": 5, "file_name": "1.png", "segments_info": [{"id": 1}]}]}
    predicted = tasks(image="1.jpg")
    predicted[0] |= {"annotations": [], "predictions": [{"result": [REGION]}]}
    for content, message in ((panoptic, "panoptic"), (predicted, "predictions only")):
        (group / "x.json").write_text(json.dumps(content))
        with pytest.raises(ValueError, match=rf"x\.json: .*{message}"):
            look(tmp_path, group, "1.jpg")
