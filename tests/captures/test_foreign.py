"""Layouts of capture folders and of lists: the same groups come out, and no path leaves the dataset's root."""

import shutil

import numpy as np
import pytest
from helpers.photos import capture, motion
from PIL import Image

from gift_peft.captures.foreign import read_layout
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.settings import PrepareSettings

SIZE = (160, 200)
FOLDERS = """
root: release
splits: {train: training, validation: val}
images: rgb/*.png
mask: mask/{stem}.png
reference: treated/*.png
"""


def release(root):
    """A capture with a moved frame and one with a treated reference."""
    shift = motion(np.random.default_rng(0), SIZE, translation=5, degrees=1)
    for split, name, seed, reference, motions in (
        ("training", "hall/mirror 1", 4, False, [shift]),
        ("val", "cup", 3, True, []),
    ):
        made = capture(root / "made" / name, seed, count=3, size=SIZE, reference=reference, motions=motions)
        folder = root / "raw/release" / split / name
        for part in ("rgb", *(["treated"] if reference else [])):
            (folder / part).mkdir(parents=True)
        shutil.move(made / "masks", folder / "mask")
        for index in range(3):
            shutil.move(made / f"{index}.png", folder / "rgb" / f"{index}.png")
        if reference:
            shutil.move(made / "reference.png", folder / "treated/spray.png")
    return root / "raw"


@pytest.fixture
def raw(tmp_path):
    return release(tmp_path)


def settings(tmp_path, text):
    (tmp_path / "layout.yaml").write_text(text)
    return PrepareSettings(layout=read_layout(tmp_path / "layout.yaml"))


def lists(raw):
    for split, name, folder in (
        ("train", "train.txt", "training/hall/mirror 1"),
        ("validation", "val.csv", "val/cup"),
    ):
        del split
        lines = [f"{folder}/rgb/{k}.png, {folder}/mask/{k}.png" for k in range(3)]
        lines += lines[:1]  # listed twice, as the paper's loader allows
        if folder == "val/cup":
            lines = [f"{line}, {folder}/treated/spray.png" for line in lines]
        else:
            lines = [f"{line}, " for line in lines]
        (raw / "release" / name).write_text("# a comment\n" + "\n".join(lines) + "\n\n")
    return """
root: release
lists: {train: train.txt, validation: val.csv}
columns: [image, mask, reference]
"""


def test_folders_and_lists_give_the_same_groups(raw, tmp_path):
    report = prepare_gift_i(raw, tmp_path / "folders", settings(tmp_path, FOLDERS))
    assert [(g["split"], g["group_id"], g["status"]) for g in report["groups"]] == [
        ("train", "hall__mirror 1", "kept"),
        ("validation", "cup", "kept"),
    ], report["groups"]
    listed = prepare_gift_i(raw, tmp_path / "lists", settings(tmp_path, lists(raw)))
    assert [g["group_id"] for g in listed["groups"]] == ["training__hall__mirror 1", "val__cup"]
    for split in ("train", "validation"):
        one, other = (load_gift_i(tmp_path / place, split)[0] for place in ("folders", "lists"))
        assert len(one["images"]) == len(other["images"]) == 3
        for key in ("images", "masks", "valids"):
            for image, same in zip(one[key], other[key], strict=True):
                assert np.array_equal(np.asarray(image), np.asarray(same))
        assert (one["reference"] is None) == (split == "train")


def test_a_missing_file_rejects_its_group(raw, tmp_path):
    (raw / "release/val/cup/mask/1.png").unlink()
    report = prepare_gift_i(raw, tmp_path / "out", settings(tmp_path, FOLDERS))
    assert [group["status"] for group in report["groups"]] == ["kept", "rejected"]
    assert "missing release/val/cup/mask/1.png" in report["groups"][1]["reasons"][0]["text"]


@pytest.mark.parametrize(
    "text, words",
    [
        ("images: /data/*.png", "images: '/data/*.png' is not a relative path"),
        ("mask: ../../{stem}.png", "not a relative path"),
        ("mask: mask/{name}.png", "the one placeholder is {stem}"),
        ("mask: mask/{stem.__class__}.png", "the one placeholder is {stem}"),
        ("reference: 'C:\\treated\\{stem}.png'", "not a relative path"),
        ("proxy: proxy/{stem}.npy", "unknown key 'proxy'; it may have the keys root,"),
        ("columns: [image, mask, proxy]", "columns"),
        ("splits: {test: test}", "splits"),
        ("columns: [image, image]", "columns"),
        ("colums: [image]", "it may have the keys"),
        ("- a", "`key: value`"),
        ("a: [", "not valid YAML"),
    ],
)
def test_layouts_that_are_refused(tmp_path, text, words):
    (tmp_path / "layout.yaml").write_text(text)
    with pytest.raises(ValueError) as error:
        read_layout(tmp_path / "layout.yaml")
    assert words in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(FileNotFoundError):
        read_layout(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    "text, line, words",
    [
        ("root: ..", "", "not a relative path"),
        ("splits: {train: /etc}", "", "not a relative path"),
        ("lists: {train: ../list.txt}", "", "not a relative path"),
        ("lists: {train: none.txt}", "", "no such file"),
        ("lists: {train: l.txt}", "a/0.png ../m.png", "l.txt, line 2: '../m.png' is not a relative path"),
        ("lists: {train: l.txt}", "/etc/0.png a/m.png", "line 2: '/etc/0.png'"),
        ("lists: {train: l.txt}", "a/0.png", "line 2: 1 values"),
        ("lists: {train: l.txt}", "a/0.png,", "line 2: an image and a mask"),
        ("lists: {train: l.txt}", "a/0.png b/0.png", "no folder of its own"),
        ("lists: {train: l.txt}", "out/0.png out/m.png", "leads out of"),
        ("images: none/*", "", "finds no captures"),
    ],
)
def test_paths_that_leave_the_root_are_refused(raw, tmp_path, text, line, words):
    (raw / "l.txt").write_text(f"# first\n{line}\n")
    (raw / "out").symlink_to("/etc")
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        prepare_gift_i(raw, tmp_path / "out", settings(tmp_path, text))
    assert words in str(error.value) and "\n" not in str(error.value)


def test_a_link_out_of_the_root_rejects_its_group(raw, tmp_path):
    mask = raw / "release/val/cup/mask/1.png"
    shutil.copy(mask, tmp_path / "elsewhere.png")
    mask.unlink()
    mask.symlink_to(tmp_path / "elsewhere.png")
    report = prepare_gift_i(raw, tmp_path / "out", settings(tmp_path, FOLDERS))
    assert report["groups"][1]["status"] == "rejected" and "leads out of" in report["groups"][1]["reasons"][0]["text"]
    assert np.asarray(Image.open(tmp_path / "elsewhere.png")).any()
