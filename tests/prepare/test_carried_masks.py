"""One mask for a group, in `prepare`: it follows the camera from the photo that it was drawn on to all others."""

import json

import numpy as np
import pytest
from helpers.photos import capture, entry, motion, scene, statuses
from PIL import Image

from gift_peft.cli import main
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.settings import PrepareSettings

SIZE = (240, 320)


def moved_group(folder, seed=5):
    """Four photos, of which the first two are of a camera that had not yet settled; all masks are there."""
    rng = np.random.default_rng(seed)
    motions = [motion(rng, SIZE, translation=6, degrees=1) for _ in range(2)]
    return capture(folder, seed, count=4, size=SIZE, motions=motions)


def masks(out, group_id):
    return [np.asarray(Image.open(path)) > 0 for path in sorted((out / "train" / group_id / "masks").iterdir())]


def iou(one, other):
    return (one & other).sum() / (one | other).sum()


@pytest.mark.parametrize("kept", ["0", "2", "3", "mask"])
def test_the_only_mask_is_carried(tmp_path, kept, capsys):
    drawn = moved_group(tmp_path / "drawn/train/g")
    prepare_gift_i(tmp_path / "drawn", tmp_path / "all")
    group = moved_group(tmp_path / "raw/train/g")
    for path in (group / "masks").iterdir():
        if path.stem == "3" and kept == "mask":
            path.rename(group / "mask.png")
        elif path.stem != kept:
            path.unlink()
    with pytest.raises(SystemExit) as ended:
        main(["prepare", str(tmp_path / "raw"), str(tmp_path / "out")])
    assert ended.value.code == 0
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert statuses(report, "g") == ["warped", "warped", "identity", "kept"]
    (note,) = [note["text"] for note in entry(report, "g")["warnings"] if note["code"] == "one_mask"]
    assert "holds for the" in note and f"train/g: {note}" in capsys.readouterr().err
    for mask, right in zip(masks(tmp_path / "out", "g"), masks(tmp_path / "all", "g"), strict=True):
        assert iou(mask, right) > 0.96  # a pixel at the border, there and back
    assert drawn.is_dir()


def test_a_photo_that_has_its_own_mask_keeps_it(tmp_path):
    group = capture(tmp_path / "raw/train/g", 7, count=3, size=SIZE)
    first, second, _ = sorted((group / "masks").iterdir())
    own = np.asarray(Image.open(first)) > 0
    smaller = own & (np.cumsum(own, axis=1) > 6)
    Image.fromarray(own.astype(np.uint8) * 255).save(group / "mask.png")
    Image.fromarray(smaller.astype(np.uint8) * 255).save(second)
    for path in (group / "masks").iterdir():
        if path != second:
            path.unlink()
    prepare_gift_i(tmp_path / "raw", tmp_path / "out")
    for mask, right in zip(masks(tmp_path / "out", "g"), (own, smaller, own), strict=True):
        np.testing.assert_array_equal(mask, right)


def test_a_mask_of_a_photo_that_cannot_be_registered_is_not_carried(tmp_path):
    group = capture(tmp_path / "raw/train/g", 7, count=4, size=SIZE)
    Image.fromarray(scene(99, SIZE)).save(group / "0.png")
    for path in (group / "masks").iterdir():
        if path.stem != "0":
            path.unlink()
    report = prepare_gift_i(tmp_path / "raw", tmp_path / "out")
    (reason,) = entry(report, "g")["reasons"]
    assert reason["code"] == "mask_not_carried"
    assert reason["text"].startswith("0.png alone has a mask, and cannot be registered: ")


def test_empty_masks_are_refused_or_allowed(tmp_path, capsys):
    group = capture(tmp_path / "raw/train/g", 7, count=3, size=SIZE)
    Image.fromarray(np.zeros(SIZE, np.uint8)).save(group / "masks/1.png")
    raw, out = str(tmp_path / "raw"), str(tmp_path / "out")
    with pytest.raises(SystemExit):
        main(["prepare", raw, out])
    assert "1.png (masks/1.png) has no target in its mask" in capsys.readouterr().err
    report = prepare_gift_i(raw, out, PrepareSettings(empty_masks="allow"))
    text = str(entry(report, "g")["frames"][1]["reasons"])
    assert "has no target" not in text and entry(report, "g")["status"] == "kept"
    with pytest.raises(SystemExit) as ended:
        main(["prepare", raw, out, "--empty-masks", "perhaps"])
    assert ended.value.code == 2


def test_what_is_not_read_is_in_the_output_and_the_report(tmp_path, capsys):
    group = capture(tmp_path / "raw/train/g", 7, count=2, size=SIZE)
    for name in ("7.CR2", "clip.wmv"):
        (group / name).write_bytes(b"raw")
    with pytest.raises(SystemExit) as ended:
        main(["prepare", str(tmp_path / "raw"), str(tmp_path / "out")])
    assert ended.value.code == 0
    told = "2 files are not read: 7.CR2, clip.wmv"
    assert f"train/g: {told}" in capsys.readouterr().err
    assert told in (tmp_path / "out/report.html").read_text()


def test_kinds_that_others_do_not_read_become_png(tmp_path):
    group = capture(tmp_path / "raw/train/g", 7, count=4, size=SIZE)
    kinds = {"0": ("avif", "AVIF"), "1": ("jfif", "JPEG"), "2": ("mpo", "MPO"), "3": ("png", "PNG")}
    for stem, (suffix, kind) in kinds.items():
        picture = Image.open(group / f"{stem}.png").convert("RGB")
        (group / f"{stem}.png").unlink()
        picture.save(group / f"{stem}.{suffix}", kind, quality=95)
    report = prepare_gift_i(tmp_path / "raw", tmp_path / "out")
    written = [frame["prepared"].rpartition(".")[2] for frame in entry(report, "g")["frames"]]
    assert written == ["png", "jpg", "jpg", "png"]
