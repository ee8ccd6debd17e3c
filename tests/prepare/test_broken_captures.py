"""A raw tree of groups that are each broken in another way: every one is rejected in the report, the rest is made."""

import json
import os
import struct
import tempfile
import zlib
from pathlib import Path
from shutil import copytree, rmtree

import cv2
import datasets
import numpy as np
import pytest
from helpers.photos import capture, scene
from PIL import Image

from gift_peft.cli import main
from gift_peft.prepare.prepare import prepare_gift_i

SIZE = (120, 160)


def header(path, side=40_000):
    """A PNG that claims to be enormous and is not."""
    chunk = struct.pack(">2I5B", side, side, 8, 2, 0, 0, 0)
    start = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + chunk
    path.write_bytes(start + struct.pack(">I", zlib.crc32(b"IHDR" + chunk)) + b"\0" * 64)


def jpeg(group):
    Image.open(group / "0.png").save(group / "0.jpg")
    (group / "0.png").unlink()
    return group / "0.jpg"


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def save(path, array):
    Image.fromarray(array).save(path)


def mask_of(group):
    return np.asarray(Image.open(group / "masks/1.png"))


def labelme(group, **changes):
    (group / "masks/0.png").unlink()
    shape = {"label": "glass", "shape_type": "rectangle", "points": [[10, 10], [90, 80]]}
    content = {"imagePath": "0.png", "imageWidth": 160, "imageHeight": 120, "shapes": [shape], **changes}
    (group / "0.json").write_text(json.dumps(content))


def coco(group, file_name):
    (group / "masks/0.png").unlink()
    content = {
        "images": [{"id": 1, "file_name": file_name, "width": 160, "height": 120}],
        "categories": [{"id": 1, "name": "glass"}],
        "annotations": [{"image_id": 1, "category_id": 1, "segmentation": [[10, 10, 90, 10, 90, 80]]}],
    }
    (group / "instances.json").write_text(json.dumps(content))


def relink(path, goal):
    path.unlink()
    path.symlink_to(goal)


def each(group, change):
    for index in range(2):
        path = group / f"{index}.png"
        save(path, change(np.asarray(Image.open(path))))


def replaced(group, index, frame):
    save(group / f"{index}.png", frame)


def empty(group):
    rmtree(group)
    group.mkdir()


def shifted(group, by):
    frame = np.asarray(Image.open(group / "0.png"))
    replaced(group, 0, np.roll(frame, by, axis=1))


def unchanged(group):
    frame = np.asarray(Image.open(group / "1.png")).copy()
    frame[::40, ::40] ^= 1  # not the same picture, but the same to look at
    replaced(group, 0, frame)


def transparent(group):
    image = Image.open(group / "1.png").convert("RGBA")
    image.putalpha(100)
    image.save(group / "1.png")


def elsewhere(group):
    mask = np.zeros(SIZE, np.uint8)
    row, column = np.argwhere(cv2.erode(255 - mask_of(group), np.ones((61, 61))) > 0)[0]
    mask[row - 8 : row + 8, column - 8 : column + 8] = 255
    save(group / "masks/0.png", mask)


def tiny(group):
    each(group, lambda frame: frame[:8, :8])
    for path in group.glob("masks/*"):
        save(path, np.full((8, 8), 255, np.uint8))


def surrogate(group):
    os.rename(group / "0.png", os.fsencode(group) + b"/\xff0.png")
    os.rename(group / "masks/0.png", os.fsencode(group / "masks") + b"/\xff0.png")


# name: (what is done to a good group of two images, words of the reason)
BROKEN = {
    "empty": (empty, "holds no images"),
    "one image": (lambda g: (g / "1.png").unlink(), "1 different image; it takes two"),
    "the same picture twice": (lambda g: (g / "1.png").write_bytes((g / "0.png").read_bytes()), "1 different image"),
    "images of two sizes": (lambda g: save(g / "0.png", scene(1, (100, 160))), "100x160"),
    "truncated jpeg": (lambda g: cut(jpeg(g)), "0.jpg: not a readable image, or truncated"),
    "truncated png": (lambda g: cut(g / "1.png"), "1.png: not a readable image, or truncated"),
    "zero bytes": (lambda g: (g / "1.png").write_bytes(b""), "1.png: not a readable image"),
    "text called png": (lambda g: (g / "1.png").write_text("hello"), "1.png: not a readable image"),
    "16 bit": (lambda g: save(g / "0.png", np.ones(SIZE, np.uint16)), "0.png: a 16-bit"),
    "cmyk": (lambda g: Image.open(jpeg(g)).convert("CMYK").save(g / "0.jpg"), "colour mode CMYK"),
    "transparent": (transparent, "transparent pixels"),
    "enormous header": (lambda g: header(g / "1.png"), "1.png: not a readable image"),
    "tiny": (tiny, "8x8 pixels"),
    "missing masks": (lambda g: rmtree(g / "masks"), "missing mask"),
    "mask of another size": (lambda g: save(g / "masks/1.png", mask_of(g)[:60]), "the mask is 60x160"),
    "mask of zero bytes": (lambda g: (g / "masks/1.png").write_bytes(b""), "masks/1.png: not a readable image"),
    "mask with an enormous header": (lambda g: header(g / "masks/1.png"), "masks/1.png: not a readable image"),
    "multi-class mask": (lambda g: save(g / "masks/1.png", np.arange(19200, dtype=np.uint8).reshape(SIZE)), "values"),
    "colour mask": (lambda g: save(g / "masks/1.png", scene(1, SIZE)), "masks/1.png"),
    "empty masks": (lambda g: [save(p, mask_of(g) * 0) for p in g.glob("masks/*")], "every mask is empty"),
    "masks that do not overlap": (elsewhere, "overlap"),
    "labelme, absolute path": (lambda g: labelme(g, imagePath="/etc/passwd"), "/etc/passwd"),
    "labelme, path upwards": (lambda g: labelme(g, imagePath="../../../0/1.png"), ".."),
    "labelme, damaged": (lambda g: labelme(g, shapes=[{"points": [[0, float("nan")]]}]), "0.json"),
    "coco, path upwards to nothing": (lambda g: coco(g, "0.png/.."), "is not an image's name"),
    "json bomb": (lambda g: [labelme(g), (g / "0.json").write_text("[" * 200_000)], "0.json"),
    "link to itself": (lambda g: relink(g / "1.png", "1.png"), "1.png"),
    "link to nowhere": (lambda g: relink(g / "1.png", "gone.png"), "1.png: no such file"),
    "folder inside itself": (lambda g: (g / "more").symlink_to("."), "more: a link back to a folder above it"),
    "a pipe": (lambda g: [(g / "1.png").unlink(), os.mkfifo(g / "1.png")], "1.png: not a regular file"),
    "name that is no text": (surrogate, "not valid Unicode"),
    "two images, one mask": (lambda g: save(g / "1.jpg", scene(1, SIZE)), "would share one mask"),
    "two references": (
        lambda g: [save(g / f"{name}.png", scene(1, SIZE)) for name in ("reference", "ref_2")],
        "two references",
    ),
    "reference of another size": (lambda g: save(g / "ref.png", scene(1, (90, 90))), "the reference is 90x90"),
    "damaged reference": (lambda g: (g / "reference.jpg").write_bytes(b"\xff\xd8"), "reference.jpg: not a readable"),
    "group.yaml is not YAML": (lambda g: (g / "group.yaml").write_text("a: [b"), "group.yaml: not valid YAML"),
    "group.yaml, unknown key": (lambda g: (g / "group.yaml").write_text("color: red"), "it may have the keys"),
    "group.yaml, surface": (lambda g: (g / "group.yaml").write_text("surface: water"), "surface 'water'"),
    "group.yaml, static_rig": (lambda g: (g / "group.yaml").write_text("static_rig: maybe"), "static_rig 'maybe'"),
    "a colon: in the name": (lambda g: None, "it names a folder"),
    "another scene": (lambda g: replaced(g, 0, scene(90, SIZE)), "too_few_frames"),
    "another scene, declared static": (
        lambda g: [replaced(g, 0, scene(90, SIZE)), (g / "group.yaml").write_text("static_rig: true")],
        "outside the target",
    ),
    "flat frame": (lambda g: replaced(g, 0, np.full((*SIZE, 3), 99, np.uint8)), "too little texture"),
    "black frame, declared static": (
        lambda g: [replaced(g, 0, np.zeros((*SIZE, 3), np.uint8)), (g / "group.yaml").write_text("static_rig: true")],
        "black pixels",
    ),
    "moved too far": (lambda g: shifted(g, 50), "the camera moved too far"),
    "target that does not change": (unchanged, "the group teaches nothing"),
}


def corpus(root: Path) -> Path:
    """RAW with two good groups and all the broken ones."""
    good = capture(root / "good/model", 21, count=2, size=SIZE)
    raw = root / "raw"
    for name, (damage, _) in BROKEN.items():
        damage(copytree(good, raw / "train" / name))
    (raw / "train" / "link to nowhere, a group").symlink_to("gone")
    (raw / "train" / "link in a loop, a group").symlink_to("link in a loop, a group")
    for name in ("good", "spiegel im flur, größe 2 ♥"):
        group = copytree(good, raw / "train" / name)
        (group / "0.png").rename(group / "foto ü 1.png")
        (group / "masks/0.png").rename(group / "masks/foto ü 1.png")
    return raw


def listing(folder):
    return {
        path: (path.lstat().st_mtime_ns, path.lstat().st_size)
        for path in [folder, *folder.rglob("*")]
        if not path.is_dir() or path.is_symlink()
    }


def test_each_broken_group_is_rejected_and_the_rest_is_made(tmp_path, capsys, monkeypatch):
    raw, out = corpus(tmp_path), tmp_path / "out"
    before = listing(raw)
    assert len(BROKEN) >= 40
    with pytest.raises(SystemExit) as ended:
        main(["prepare", str(raw), str(out)])
    assert ended.value.code == 3
    assert listing(raw) == before  # RAW is left as it is
    report = json.loads((out / "report.json").read_text())
    entries = {entry["group_id"]: entry for entry in report["groups"]}
    said, wrong = capsys.readouterr().err, {}
    for name, (_, words) in BROKEN.items():
        entry = entries[name]
        text = " ".join(f"{item['code']} {item['text']}" for item in entry["reasons"])
        if entry["status"] != "rejected" or words not in text or "\n" in text or str(tmp_path) in text:
            wrong[name] = entry["status"], text
        assert f"train/{name}: " in said or name in wrong
        assert not (out / "train" / name).exists() or name in wrong
    assert not wrong
    for name in ("link to nowhere, a group", "link in a loop, a group"):
        assert entries[name]["status"] == "rejected"
    kept = [name for name, entry in entries.items() if entry["status"] == "kept"]
    assert kept == ["good", "spiegel im flur, größe 2 ♥"]
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "cache")
    rows = datasets.load_dataset(str(out), split="train")
    assert rows["group_id"][:] == kept and rows[0]["image_names"] == ["1.png", "foto ü 1.png"]
    assert not list(out.rglob("*.partial")) and not (out / ".prepare/staging").exists()
    assert report["statistics"]["train"]["rejected_groups"] == len(BROKEN) + 2
    assert (out / "report.html").is_file()


def test_nothing_but_broken_groups(tmp_path, capsys):
    good = capture(tmp_path / "good", 21, count=2, size=SIZE)
    (copytree(good, tmp_path / "raw/train/a") / "1.png").unlink()
    with pytest.raises(SystemExit) as ended:
        main(["prepare", str(tmp_path / "raw"), str(tmp_path / "out")])
    assert ended.value.code == 1 and "no group could be prepared" in capsys.readouterr().err
    assert not list((tmp_path / "out").rglob("metadata.parquet")) and (tmp_path / "out/report.json").is_file()


def test_without_permission(tmp_path):
    place = Path(tempfile.mkdtemp())  # other users may not enter tmp_path
    try:
        good = capture(tmp_path / "good", 21, count=2, size=SIZE)
        for name in ("fine", "image", "mask", "folder"):
            copytree(good, place / "raw/train" / name)
        for name in ("image/1.png", "mask/masks/0.png", "folder"):
            (place / "raw/train" / name).chmod(0)
        (place / "out").mkdir()
        for folder in (place, place / "out"):
            folder.chmod(0o777)
        uid = os.geteuid()
        if uid == 0:
            os.seteuid(65534)
        try:
            report = prepare_gift_i(place / "raw", place / "out")
        finally:
            os.seteuid(uid)
        entries = {entry["group_id"]: entry for entry in report["groups"]}
        assert {name for name, entry in entries.items() if entry["status"] == "kept"} == {"fine"}
        for name in ("image", "mask", "folder"):
            assert "Permission denied" in entries[name]["reasons"][0]["text"], entries[name]["reasons"]
        for name in ("image/1.png", "mask/masks/0.png", "folder"):
            (place / "raw/train" / name).chmod(0o755)
        report = prepare_gift_i(place / "raw", place / "out")  # what failed for a passing reason is tried again
        assert {entry["status"] for entry in report["groups"]} == {"kept"}
    finally:
        rmtree(place)
