"""`gift-peft synthesize`: what it paints and what it leaves, that it can be stopped and run again, what it refuses."""

import json
import shutil

import cv2
import numpy as np
import pytest
import yaml
from filelock import FileLock
from helpers.photos import scene, target
from helpers.runs import arguments
from helpers.tiny import write_group
from PIL import Image

from gift_peft.captures.tree import read_capture
from gift_peft.cli import main
from gift_peft.dataset.export import export_parquet
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.prepare import synthesize
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.synthesize import synthesize_groups
from gift_peft.surface_targets import paint_fills
from gift_peft.training import train

SIZE = (60, 80)
NAMES = ["0_photo.png", "1_fill.png", "2_fill.png", "3_fill.png"]

pytestmark = pytest.mark.usefixtures("fresh_cache")


def write_flat(folder, count=3):
    """A flat folder of JPEG photos and their masks."""
    (folder / "masks").mkdir(parents=True)
    for seed in range(count):
        Image.fromarray(scene(seed, SIZE)).save(folder / f"img_{seed}.jpg")
        write_mask(folder, f"img_{seed}", target(seed, SIZE))
    return folder


def write_mask(folder, stem, mask):
    Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "masks" / f"{stem}.png")


def tree_of(folder):
    """The bytes of every file, by its name."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def groups_of(out):
    """The files of the groups alone."""
    return {name: content for name, content in tree_of(out).items() if name.startswith("train/")}


def pixels(path):
    return np.asarray(Image.open(path))


@pytest.fixture
def flat(tmp_path):
    return write_flat(tmp_path / "photos")


@pytest.fixture
def run(capsys):
    """Run the verb: (exit code, stdout, stderr)."""

    def run(*argv):
        with pytest.raises(SystemExit) as exit:
            main(["synthesize", *map(str, argv)])
        return exit.value.code, *capsys.readouterr()

    return run


# ---- what comes out ----


def test_outside_of_the_mask_every_byte_stays(flat, tmp_path):
    report = synthesize_groups(flat, tmp_path / "out")
    assert report.groups == report.made == ["img_0", "img_1", "img_2"] and not report.rejected
    for seed, group_id in enumerate(report.groups):
        folder = tmp_path / "out/train" / group_id
        mask = target(seed, SIZE)
        photo, *fills = [pixels(folder / name) for name in NAMES]
        assert np.array_equal(photo, pixels(flat / f"img_{seed}.jpg"))  # as the JPEG was decoded, and no more lost
        inner = cv2.erode(mask.astype(np.uint8), np.ones((7, 7))) > 0  # the paint fades in over a pixel here
        for fill in fills:
            assert np.array_equal(fill[~mask], photo[~mask]) and not np.array_equal(fill, photo)
            assert len(np.unique(fill[inner], axis=0)) == 1
        assert len({fill[inner][0].tobytes() for fill in fills}) == 3
        assert all(np.array_equal(pixels(folder / "masks" / name) > 0, mask) for name in NAMES)


def test_group_and_card_say_what_they_are(flat, tmp_path):
    (flat / "group.yaml").write_text("surface: mirror\nnotes: hallway\n")
    synthesize_groups(flat, tmp_path / "out", fills=2, seed=7)
    facts = yaml.safe_load((tmp_path / "out/train/img_1/group.yaml").read_text())
    digest = facts["synthesized"].pop("digest")
    assert len(digest) == 32 and facts == {
        "surface": "mirror",
        "notes": "hallway",
        "static_rig": True,
        "synthesized": {"photo": "img_1.jpg", "fills": 2, "seed": 7},
    }
    card = (tmp_path / "out/README.md").read_text()
    assert "3 groups, 9 images, made by `gift-peft synthesize`" in card and "For training only" in card
    export_parquet(tmp_path / "out", tmp_path / "release", license="cc0-1.0")
    assert "made by `gift-peft synthesize`" in (tmp_path / "release/README.md").read_text()  # a copy says it too
    painted = tmp_path / "out/train/img_1"
    with pytest.raises(ValueError, match="for training only"):
        read_capture(painted, "validation", painted.parent)


def test_the_same_files_whatever_the_processes_and_another_seed_other_colors(flat, tmp_path):
    synthesize_groups(flat, tmp_path / "one")
    synthesize_groups(flat, tmp_path / "two", num_proc=2)
    assert groups_of(tmp_path / "one") == groups_of(tmp_path / "two")
    assert (tmp_path / "one/README.md").read_bytes() == (tmp_path / "two/README.md").read_bytes()
    synthesize_groups(flat, tmp_path / "more", fills=4)
    synthesize_groups(flat, tmp_path / "other", seed=1)
    for name, same in (("0_photo.png", True), ("1_fill.png", False)):
        one, other, more = ((tmp_path / out / "train/img_0" / name).read_bytes() for out in ("one", "other", "more"))
        assert (one == other) is same and one == more  # more fills are added to those that were there


def test_a_raw_tree_gives_a_group_for_every_train_photo(tmp_path):
    raw = tmp_path / "raw"
    write_group(raw / "train/pane", 2, 0)
    write_group(raw / "train/door", 1, 1)
    (raw / "train/door/group.yaml").write_text("surface: transparent\n")
    write_group(raw / "train/sprayed", 2, 2, reference=True)
    write_group(raw / "validation/shower", 2, 3, reference=True)
    nested = write_group(raw / "train/hall", 2, 4)
    (nested / "day 1").mkdir()
    (nested / "0.png").rename(nested / "day 1/img.png")
    (nested / "masks/0.png").rename(nested / "day 1/img_mask.png")
    before = tree_of(raw)
    report = synthesize_groups(raw, tmp_path / "out")
    assert report.groups == ["door", "hall__1", "hall__day 1__img", "pane__0", "pane__1"]
    assert list(report.skipped) == ["train/sprayed", "validation/shower"] and not report.rejected
    assert tree_of(raw) == before and not (tmp_path / "out/validation").exists()
    rows = load_gift_i(tmp_path / "out", "train")
    assert rows["group_id"][:] == report.groups and rows[0]["surface"] == 1 and rows[1]["surface"] is None
    assert all(row["image_names"] == NAMES for row in rows)
    again = synthesize_groups(tmp_path / "out", tmp_path / "twice")
    assert not again.groups and {*again.skipped.values()} == {"these are painted copies already"}


@pytest.mark.parametrize("form", ["mask.png", "the only mask", "the only annotation"])
def test_one_mask_for_a_group_is_that_of_each_of_its_photos(tmp_path, form):
    raw = tmp_path / "raw"
    group = write_group(raw / "train/pane", 3, 0)
    expected = pixels(group / "masks/1.png")
    if form == "mask.png":
        (group / "masks/1.png").rename(group / "mask.png")
    elif form == "the only annotation":
        rows, columns = np.nonzero(expected)
        corners = [[int(columns.min()), int(rows.min())], [int(columns.max()) + 1, int(rows.max()) + 1]]
        shape = {"label": "glass", "shape_type": "rectangle", "points": corners}
        (group / "1.json").write_text(json.dumps({"shapes": [shape], "imagePath": "1.png"}))
        (group / "masks/1.png").unlink()
    for name in ("0.png", "2.png"):
        (group / "masks" / name).unlink()
    report = synthesize_groups(raw, tmp_path / "out")
    assert report.groups == ["pane__0", "pane__1", "pane__2"] and not report.rejected
    for name in report.groups:
        found = pixels(tmp_path / "out/train" / name / "masks/1_fill.png") > 0
        assert np.mean(found != (expected > 0)) < 0.05
    trained = load_gift_i(raw, "train")[0]
    assert all(np.mean((np.asarray(mask) > 0) != (expected > 0)) < 0.05 for mask in trained["masks"])


def test_without_split_folders_a_group_with_a_reference_is_for_validation(tmp_path):
    write_group(tmp_path / "raw/pane", 1, 0)
    write_group(tmp_path / "raw/shower", 2, 3, reference=True)
    report = synthesize_groups(tmp_path / "raw", tmp_path / "out")
    assert report.groups == ["pane"] and list(report.skipped) == ["shower"]


def test_a_turned_photo_and_a_mask_of_another_form(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    exif = Image.Exif()
    exif[Image.ExifTags.Base.Orientation] = 6  # stored lying, shown upright
    Image.fromarray(scene(0, SIZE)).save(photos / "a.jpg", exif=exif)
    shape = {"label": "glass", "shape_type": "rectangle", "points": [[10, 20], [40, 60]]}
    (photos / "a.json").write_text(json.dumps({"shapes": [shape], "imagePath": "a.jpg"}))
    assert synthesize_groups(photos, tmp_path / "out").groups == ["a"]
    folder = tmp_path / "out/train/a"
    mask = pixels(folder / "masks/1_fill.png") > 0
    assert mask.shape == (80, 60) and mask[21:59, 11:39].all() and not mask[:19].any()
    assert pixels(folder / "1_fill.png").shape == (80, 60, 3)


def test_it_trains_and_can_be_prepared(flat, base_dir, tmp_path):
    synthesize_groups(flat, tmp_path / "out")
    assert len(load_gift_i(tmp_path / "out", "train")) == 3
    report = prepare_gift_i(tmp_path / "out", tmp_path / "gift-i")
    assert [group["status"] for group in report["groups"]] == ["kept"] * 3
    with pytest.warns(UserWarning):  # no validation split
        train(arguments(base_dir, tmp_path / "out", tmp_path / "run", max_steps=1))
    rows = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["step"] == 1 and rows[-1]["consistency"] > 0


# ---- run again ----


def test_only_what_changed_is_made_again(flat, tmp_path):
    out = tmp_path / "out"
    synthesize_groups(flat, out)
    before, times = groups_of(out), {path: path.stat().st_mtime_ns for path in out.rglob("*.png")}
    assert synthesize_groups(flat, out).made == []
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.png")} == times
    write_mask(flat, "img_0", target(9, SIZE))
    (out / "train/img_1/2_fill.png").unlink()
    report = synthesize_groups(flat, out)
    assert report.groups == ["img_0", "img_1", "img_2"] and report.made == ["img_0", "img_1"]
    after = groups_of(out)
    assert {name for name in before if before[name] != after[name]} == {
        f"train/img_0/{name}" for name in ("group.yaml", *NAMES[1:], *(f"masks/{name}" for name in NAMES))
    }
    assert len(synthesize_groups(flat, out, fills=2).made) == 3 and not (out / "train/img_0/3_fill.png").exists()
    assert len(synthesize_groups(flat, out, fills=2, seed=1).made) == 3
    (flat / "img_2.jpg").unlink()
    report = synthesize_groups(flat, out, fills=2, seed=1)
    assert report.removed == ["img_2"] and not (out / "train/img_2").exists()
    write_mask(flat, "img_1", np.zeros(SIZE, bool))  # what was made of it is no longer right
    report = synthesize_groups(flat, out, fills=2, seed=1)
    assert report.groups == ["img_0"] and [path.name for path in (out / "train").iterdir()] == ["img_0"]


def test_stopped_anywhere_no_group_is_half_there(flat, tmp_path, monkeypatch):
    synthesize_groups(flat, tmp_path / "whole")

    class Killed(BaseException):
        pass

    for step, count in (("write_whole", 3), ("write_whole", 12), ("_png", 7)):
        out, calls, real = tmp_path / f"{step}{count}", [], getattr(synthesize, step)

        def dies(*arguments, real=real, calls=calls, count=count):
            calls.append(None)
            if len(calls) > count:
                raise Killed
            return real(*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(synthesize, step, dies)
            with pytest.raises(Killed):
                synthesize_groups(flat, out)
        for leftover in (".img_0.tmp", ".img_1.old"):  # as a run that is really killed leaves them
            (out / "train" / leftover).mkdir(parents=True, exist_ok=True)
        for folder in (out / "train").glob("[!.]*"):
            assert tree_of(folder) == tree_of(tmp_path / "whole/train" / folder.name)
        synthesize_groups(flat, out)
        assert groups_of(out) == groups_of(tmp_path / "whole")


def test_what_others_put_there_is_left(flat, tmp_path):
    out = tmp_path / "out"
    synthesize_groups(flat, out)
    write_group(out / "validation/shower", 2, 3, reference=True)
    write_group(out / "train/mine", 2, 4)
    (out / "train/img_0/.DS_Store").write_text("")
    (out / "train/img_1/extra.png").write_bytes((out / "train/img_1/1_fill.png").read_bytes())
    (out / "train/img_2/notes.txt").write_text("mine")
    mine = {name: content for name, content in tree_of(out).items() if "img" not in name}
    assert len(synthesize_groups(flat, out).groups) == 3  # nothing is stale, so nothing is in the way
    (flat / "img_2.jpg").unlink()
    report = synthesize_groups(flat, out, seed=1)
    assert report.groups == report.made == ["img_0"]
    assert "img_1/extra.png: not made by gift-peft synthesize" in report.rejected["img_1.jpg"]
    assert "its photo is gone" in report.rejected["train/img_2"] and (out / "train/img_2/notes.txt").exists()
    shutil.copytree(out / "train/mine", out / "train/img_9")
    Image.fromarray(scene(9, SIZE)).save(flat / "img_9.jpg")
    write_mask(flat, "img_9", target(9, SIZE))
    report = synthesize_groups(flat, out, seed=1)
    assert "img_9: not made by gift-peft synthesize" in report.rejected["img_9.jpg"]
    left = tree_of(out)
    changed = {name for name, content in mine.items() if left.get(name) != content}
    assert changed <= {"README.md", ".synthesize/card"}


# ---- what is wrong ----


def break_photo(flat, what):
    """The first photo with something wrong."""
    if what == "no mask":
        (flat / "masks/img_0.png").unlink()
    elif what == "unreadable":
        (flat / "img_0.jpg").write_bytes((flat / "img_0.jpg").read_bytes()[:400])
    elif what == "broken mask":
        (flat / "masks/img_0.png").write_text("not a picture")
    else:
        masks = {
            "empty": np.zeros(SIZE, bool),
            "whole": np.ones(SIZE, bool),
            "size": np.ones((30, 40), bool),
        }
        write_mask(flat, "img_0", masks[what])


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("no mask", "missing mask {}/masks/img_0.png for the image img_0.jpg"),
        ("empty", "{}/img_0.jpg: its mask ({}/masks/img_0.png) is empty"),
        ("whole", "{}/img_0.jpg: its mask ({}/masks/img_0.png) covers the whole photo"),
        ("size", "{}/masks/img_0.png"),
        ("unreadable", "{}/img_0.jpg: not a readable image"),
        ("broken mask", "{}/masks/img_0.png: not a readable image"),
    ],
)
def test_a_bad_photo_is_named_and_the_others_are_made(what, words, flat, tmp_path, run):
    break_photo(flat, what)
    code, out, err = run(flat, tmp_path / "out")
    assert code == 3 and "2 groups, a photo and 3 painted copies each (2 made, 0 there before, 0 removed)" in out
    assert err.startswith("gift-peft: rejected: img_0.jpg: ") and len(err.splitlines()) == 1
    assert words.replace("{}", str(flat)) in err
    assert load_gift_i(tmp_path / "out", "train")["group_id"][:] == ["img_1", "img_2"]


def test_a_target_too_small_to_paint(flat, tmp_path, monkeypatch):
    def weak(image, mask, count, seed):  # as paint is on a pixel or two of a large photo
        return paint_fills(image, mask, count, seed) if mask.sum() > 1 else [image] * count

    monkeypatch.setattr(synthesize, "paint_fills", weak)
    one = np.zeros(SIZE, bool)
    one[30, 40] = True
    write_mask(flat, "img_0", one)
    report = synthesize_groups(flat, tmp_path / "out")
    assert "so small that painted copies do not differ (1 pixels)" in report.rejected["img_0.jpg"]
    assert report.groups == ["img_1", "img_2"]


def test_a_group_that_cannot_be_read_is_named_and_the_others_are_made(tmp_path, run):
    write_group(tmp_path / "raw/pane", 1, 0)
    write_group(tmp_path / "raw/door", 1, 1)
    (tmp_path / "raw/door/group.yaml").write_text("surface: water")
    write_group(tmp_path / "raw/shower", 2, 2, reference=True)
    code, out, err = run(tmp_path / "raw", tmp_path / "out", "--fills", 1)
    skipped, rejected = err.splitlines()
    assert code == 3 and skipped.startswith("gift-peft: skipped: shower: it is for validation")
    assert rejected.startswith("gift-peft: rejected: door: ") and "surface 'water'" in rejected
    assert "1 groups, a photo and 1 painted copy each" in out
    assert len(load_gift_i(tmp_path / "out", "train")[0]["images"]) == 2


def test_nothing_made_is_1_and_wrong_numbers_are_2(flat, tmp_path, run):
    shutil.rmtree(flat / "masks")
    code, _, err = run(flat, tmp_path / "out")
    assert code == 1 and len(err.splitlines()) == 4 and "no photo could be painted" in err.splitlines()[-1]
    assert not (tmp_path / "out/README.md").exists()
    for words in (["--fills", "0"], ["--seed=-1"], ["--num-proc", "0"], ["--fills", "many"]):
        assert run(flat, tmp_path / "out", *words)[0] == 2
    for name, value in (("fills", 0), ("seed", -1), ("num_proc", 0)):
        with pytest.raises(ValueError, match=f"{name}: at least"):
            synthesize_groups(flat, tmp_path / "out", **{name: value})


def test_places_that_are_refused(flat, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/holiday.txt").write_text("mine")
    mixed = write_flat(tmp_path / "mixed")
    write_group(mixed / "validation/pane", 1, 0)
    deeper = write_flat(tmp_path / "deeper")
    write_group(deeper / "pane", 1, 0)
    treated = write_flat(tmp_path / "treated")
    (treated / "img_0.jpg").rename(treated / "reference.jpg")
    painted = tmp_path / "painted"
    synthesize_groups(flat, painted)
    for places, words in (
        ((flat, flat), "neither inside PHOTOS"),
        ((flat, flat / "out"), "neither inside PHOTOS"),
        ((flat, flat.parent), "neither inside PHOTOS"),
        ((tmp_path / "nowhere", tmp_path / "new"), "PHOTOS .*: no such folder"),
        ((flat, tmp_path / "full"), "not made by gift-peft synthesize"),
        ((flat, tmp_path / "full/holiday.txt"), "not a folder"),
        ((tmp_path / "full", tmp_path / "new"), "no group folders"),
        ((mixed, tmp_path / "new"), "photos beside folders of photos"),
        ((deeper, tmp_path / "new"), "photos beside folders of photos"),
        ((treated, tmp_path / "new"), "reference.jpg: its name says"),
        ((painted / "train/img_0", tmp_path / "new"), "painted copies already"),
    ):
        with pytest.raises((ValueError, OSError), match=words) as error:
            synthesize_groups(*places)
        assert "\n" not in str(error.value)
    assert [*(tmp_path / "full").iterdir()] == [tmp_path / "full/holiday.txt"] and not (tmp_path / "new").exists()
    with FileLock(painted / ".synthesize/lock"), pytest.raises(ValueError, match="another gift-peft synthesize"):
        synthesize_groups(flat, painted)


def test_two_groups_of_one_name(tmp_path):
    write_group(tmp_path / "raw/a", 2, 0)
    write_group(tmp_path / "raw/A__1", 1, 1)
    with pytest.raises(ValueError, match=r"both would be group A__1; rename one"):
        synthesize_groups(tmp_path / "raw", tmp_path / "out")
