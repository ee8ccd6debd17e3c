"""What lies in a folder of photos: kinds that are read, kinds that are not and are named, and what systems leave."""

import json
import logging
import shutil

import numpy as np
import pytest
from helpers.drawn_masks import coco, labelme, tasks
from PIL import Image

import gift_peft.images
from gift_peft.captures.tree import decode_capture, find_groups, list_groups, read_capture
from gift_peft.images import list_images, read_image

SIZE = (64, 48)
HEIC = b"\x00\x00\x00\x18ftypheic\x00\x00\x00\x00heicmif1" + bytes(500)


def photo(seed) -> Image.Image:
    small = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8)
    return Image.fromarray(small).resize(SIZE, Image.Resampling.BICUBIC)


@pytest.fixture
def group(tmp_path):
    """RAW/train/scene with photos 1 and 2, and a mask for both."""
    folder = tmp_path / "raw/train/scene"
    folder.mkdir(parents=True)
    for name in (1, 2):
        photo(name).save(folder / f"{name}.png")
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[10:30, 10:30] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    return folder


def names(group):
    capture = read_capture(group, "train", group.parents[1])
    return [path.name for path in capture.images]


@pytest.fixture
def without_heif(monkeypatch):
    monkeypatch.setattr(gift_peft.images, "reads_heif", lambda: False)


def test_kinds_that_pillow_reads(group):
    for number, (suffix, kind) in enumerate(
        [("jfif", "JPEG"), ("JPE", "JPEG"), ("avif", "AVIF"), ("webp", "WEBP"), ("tiff", "TIFF")], start=3
    ):
        photo(number).save(group / f"{number}.{suffix}", kind, quality=95)
    photo(9).save(group / "9.MPO", "MPO", save_all=True, append_images=[photo(10)])
    decoded = decode_capture(read_capture(group, "train", group.parents[1]))
    assert len(decoded.images) == 8 and "skipped_files" not in decoded.notes
    for place, number in ((2, 3), (7, 9)):
        difference = np.asarray(decoded.images[place]).astype(int) - np.asarray(photo(number))
        assert np.abs(difference).mean() < 8


def test_heic_is_read_with_the_extra(group):
    pytest.importorskip("pillow_heif", reason="the extra heif is not installed")
    assert gift_peft.images.reads_heif()
    photo(3).save(group / "3.HEIC", "HEIF", quality=95)
    shutil.copy(group / "3.HEIC", group / "4.jpg")  # as some phones call it
    decoded = decode_capture(read_capture(group, "train", group.parents[1]))
    assert decoded.duplicates == {3: 2}
    assert np.abs(np.asarray(decoded.images[2]).astype(int) - np.asarray(photo(3))).mean() < 8


def test_what_is_not_read_is_counted_and_named(group, without_heif):
    for name in ("3.HEIC", "4.CR2", "5.mov", "noname"):
        (group / name).write_bytes(HEIC)
    for name in ("notes.txt", "5.AAE", "x.json"):
        (group / name).write_text("{}")
    (group / "depths").mkdir()
    (group / "depths/1.exr").write_bytes(b"")
    assert names(group) == ["1.png", "2.png"]
    note = decode_capture(read_capture(group, "train", group.parents[1])).notes["skipped_files"]
    assert note.startswith("4 files are not read: 3.HEIC, 4.CR2, 5.mov, noname (pip install 'gift-peft[heif]'")


def test_a_folder_of_nothing_else(group, without_heif):
    for name in (1, 2):
        (group / f"{name}.png").rename(group / f"{name}.HEIC")
    with pytest.raises(FileNotFoundError, match=r"holds no images; 2 files are not read: 1\.HEIC, 2\.HEIC \(pip"):
        list_groups(group.parents[1])


def test_a_reference_that_is_not_read_is_no_training_photo(group, without_heif, tmp_path):
    (group / "reference.heic").write_bytes(HEIC)
    with pytest.raises(ValueError, match=r"the treated reference cannot be read; 1 file is not read: reference\.heic"):
        names(group)
    assert list(find_groups(group.parent)) == ["validation"]
    photo(5).save(group / "reference.png")
    (group / "reference.mov").write_bytes(b"")  # a phone's moving copy of it
    assert names(group) == ["1.png", "2.png"]


def test_heic_in_a_file_of_another_name_says_what_it_is(tmp_path, without_heif):
    for name in ("a.jpg", "b.heic"):
        (tmp_path / name).write_bytes(HEIC)
        with pytest.raises(ValueError, match=r"not a readable image, or truncated; it is HEIC: pip install"):
            read_image(tmp_path / name)


LEFT = ["__MACOSX", ".AppleDouble", "@eaDir", "#recycle", "$RECYCLE.BIN", "lost+found", ".ipynb_checkpoints"]


@pytest.mark.parametrize("split", [True, False])
def test_what_systems_leave_is_passed_over(group, split):
    raw = group.parents[1]
    if not split:
        shutil.move(group, raw / "scene")
        (raw / "train").rmdir()
        group = raw / "scene"
    for place in (raw, group.parent, group):
        for name in LEFT:
            (place / name / "scene").mkdir(parents=True, exist_ok=True)
            for file in ("1.png", "scene/7.png", "scene/instances.json"):
                (place / name / file).write_bytes(b"junk")
        for file in ("._1.png", "._instances.json", "._mask.png", ".DS_Store", "Thumbs.db", "desktop.ini"):
            (place / file).write_bytes(b"junk")
    (group / "masks").mkdir()
    (group / "masks/._1.png").write_bytes(b"junk")
    assert list_groups(raw) == {"train": [group]}
    decoded = decode_capture(read_capture(group, "train", raw))
    assert len(decoded.images) == 2 and set(decoded.notes) == {"one_mask"}


def test_folders_of_exports_are_no_groups(group):
    raw = group.parents[1]
    for place in (raw, raw / "train"):
        for name in ("annotations", "SegmentationClass", "SegmentationObject", "ImageSets", "masks"):
            (place / name).mkdir()
    assert list_groups(raw) == {"train": [group]}


def test_lists_of_pictures_name_what_they_leave_out(tmp_path, caplog, without_heif):
    photo(1).save(tmp_path / "a.jpg")
    photo(2).save(tmp_path / "b.jfif", "JPEG")
    for name in ("c.HEIC", "d.gif", "._a.jpg", "Thumbs.db", "notes.txt"):
        (tmp_path / name).write_bytes(HEIC)
    (tmp_path / "@eaDir").mkdir()
    photo(3).save(tmp_path / "@eaDir/thumb.jpg")
    with caplog.at_level(logging.WARNING):
        assert [path.name for path in list_images([tmp_path])] == ["a.jpg", "b.jfif"]
    assert f"2 files are not read: {tmp_path}/c.HEIC, {tmp_path}/d.gif (pip install" in caplog.text
    inside = [path for path in tmp_path.iterdir() if path.suffix in (".jpg", ".jfif") or path.is_dir()]
    assert [path.name for path in sorted(list_images(inside))] == ["a.jpg", "b.jfif"]  # as a shell expands `photos/*`
    for path in tmp_path.glob("*.j*"):
        path.unlink()
    with pytest.raises(ValueError, match=r"no images in .*; 2 files are not read: .*c\.HEIC"):
        list_images([tmp_path])


# ---- EXIF ----


@pytest.mark.parametrize(
    "orientation, size, tool, told",
    [
        (3, SIZE, "coco", True),
        (2, SIZE, "labelme", True),
        (3, SIZE, "cvat", True),
        (6, (48, 48), "coco", True),
        (1, SIZE, "coco", False),
        (3, SIZE, "picture", False),
        (3, SIZE, "label studio", False),
    ],
)
def test_turned_photos_whose_masks_may_not_be(group, orientation, size, tool, told):
    (group / "mask.png").unlink()
    exif = Image.Exif()
    exif[0x0112] = orientation
    for name in (1, 2):
        (group / f"{name}.png").unlink()
        photo(name).resize(size).save(group / f"{name}.jpg", exif=exif if name == 1 else b"")
    shape = {"imageWidth": size[0], "imageHeight": size[1]}
    box = {"x": 10, "y": 10, "width": 50, "height": 50, "rectanglelabels": ["glass"]}
    found = {"type": "rectanglelabels", "original_width": size[0], "original_height": size[1], "value": box}
    mask = Image.new("L", size)
    mask.paste(255, (4, 4, 20, 20))
    for name in ("1", "2"):
        if tool == "labelme":
            (group / f"{name}.json").write_text(json.dumps(labelme(imagePath=f"{name}.jpg", **shape)))
        elif tool in ("picture", "cvat"):
            folder = group / ("masks" if tool == "picture" else "SegmentationClass")
            folder.mkdir(exist_ok=True)
            mask.convert("RGB").save(folder / f"{name}.png")
    if tool == "cvat":
        (group / "labelmap.txt").write_text("background:0,0,0::\nglass:255,255,255::\n")
    if tool == "coco":
        content = coco("1.jpg", width=1)
        content["images"] = [
            {"id": int(name), "file_name": f"{name}.jpg", "width": size[0], "height": size[1]} for name in "12"
        ]
        content["annotations"] = [{"image_id": int(name), "category_id": 2, "bbox": [3, 2, 6, 4]} for name in "12"]
        (group / "x.json").write_text(json.dumps(content))
    if tool == "label studio":
        content = [tasks(found, image=f"/x/{name}.jpg")[0] for name in "12"]
        (group / "x.json").write_text(json.dumps(content))
    notes = decode_capture(read_capture(group, "train", group.parents[1])).notes
    assert ("exif_turned" in notes) == told
    if told:
        assert notes["exif_turned"].startswith("1.jpg: turned or mirrored by an EXIF mark")
