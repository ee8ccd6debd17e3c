"""`gift-peft capture`: a raw group that `prepare` takes, more where the camera was moved; bad input in a line."""

import os
import signal
import subprocess
import sys
import threading

import cv2
import numpy as np
import pytest
from helpers.clips import Making, pushed, views

from gift_peft.captures.clip import ClipFrame
from gift_peft.cli import main
from gift_peft.prepare import capture_session
from gift_peft.prepare.capture_session import TYPED, Session

SIZE = (240, 320)


def capture(*words) -> int:
    with pytest.raises(SystemExit) as leaving:
        main(["capture", *map(str, words)])
    return leaving.value.code


def test_the_verb_writes_a_raw_group_that_prepare_makes(tmp_path, capsys):
    pictures, mask = views(5, SIZE, 3)
    treated = np.where(mask[..., None], 150, pictures[0])
    made = Making(SIZE)
    for picture in (*pictures, treated):
        made.hold(picture, 1.2)
    clip = made.write(tmp_path / "a.mp4")
    cv2.imwrite(str(tmp_path / "m.png"), mask.astype(np.uint8) * 255)
    words = (clip, tmp_path / "raw", "--mask", tmp_path / "m.png", "--reference-at", "00:03.7")
    assert capture(*words, "--group", "door") == 0
    said = capsys.readouterr().out
    names = sorted(path.name for path in (tmp_path / "raw/door").iterdir())
    assert names == ["001.png", "002.png", "003.png", "mask.png", "reference.png"]
    assert f"Next: gift-peft prepare {tmp_path / 'raw'} {tmp_path / 'raw'}-prepared" in said
    with pytest.raises(SystemExit) as leaving:
        main(["prepare", str(tmp_path / "raw"), str(tmp_path / "out")])
    assert leaving.value.code == 0
    assert capture(*words, "--group", "door") == 1
    assert "door: it is there already; name another group" in capsys.readouterr().err
    capsys.readouterr()
    assert capture(clip, tmp_path / "raw") == 0
    assert (tmp_path / "raw/group_1/001.png").is_file()


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("99", "camera 99: cannot be opened; plug it in"),
        ("nowhere.mp4", "nowhere.mp4: no such file"),
        ("nowhere", "nowhere: neither a camera's number"),
        ("notes.mp4", "cannot be opened as a video"),
        ("moving.mp4", "no photo was taken in"),
    ],
)
def test_what_gives_no_photo_is_one_line(tmp_path, capsys, monkeypatch, source, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.mp4").write_text("notes")
    made, picture = Making(SIZE), views(6, SIZE, 1)[0][0]
    for step in range(20):
        made.add(pushed(picture, 4.0 * step))
    made.write(tmp_path / "moving.mp4")
    assert capture(source, "raw") == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert message in said[-1] and said[-1].startswith("gift-peft: error:") and len(said) == 1
    assert not (tmp_path / "raw").exists()


@pytest.mark.parametrize("source", ["99", "http://127.0.0.1:9/x"])
def test_no_camera_is_one_line_for_whoever_looks_at_the_terminal(tmp_path, source):
    """In a process of its own: OpenCV and FFmpeg write to stderr past Python."""
    command = [sys.executable, "-m", "gift_peft", "capture", source, str(tmp_path / "raw")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1 and done.stdout == ""
    assert len(done.stderr.splitlines()) == 1 and f"{source}: cannot be opened" in done.stderr


def still_clip(path, pictures, seconds=1.2):
    made = Making(SIZE)
    for picture in pictures:
        made.hold(picture, seconds)
    return made.write(path)


def test_a_moved_camera_makes_a_second_group_with_the_mask_carried(tmp_path, capsys):
    pictures, mask = views(3, SIZE, 3)
    clip = still_clip(tmp_path / "a.mp4", [pictures[0], *(pushed(picture, 5) for picture in pictures)], 3.2)
    cv2.imwrite(str(tmp_path / "m.png"), mask.astype(np.uint8) * 255)
    (tmp_path / "raw/door__2").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "raw/door__2/1.png"), pictures[0])
    assert capture(clip, tmp_path / "raw", "--mask", tmp_path / "m.png", "--group", "door") == 0
    said = capsys.readouterr().out
    assert "the camera moved by 5.0 px" in said and f"a new group, {tmp_path / 'raw/door__3'}" in said
    assert f"{tmp_path / 'raw/door'}: 1 photo, too few for a group" in said
    assert len(list((tmp_path / "raw/door__3").glob("0*.png"))) == 3
    found = cv2.imread(str(tmp_path / "raw/door__3/mask.png"), cv2.IMREAD_GRAYSCALE) > 127
    moved = pushed(mask.astype(np.uint8) * 255, 5) > 127
    assert (found & moved).sum() > 0.95 * (found | moved).sum()


def test_a_reference_that_does_not_come_is_an_error_and_photos_stay(tmp_path, capsys):
    clip = still_clip(tmp_path / "a.mp4", views(4, SIZE, 2)[0])
    assert capture(clip, tmp_path / "raw", "--reference-at", "00:30") == 1
    assert "no treated reference was taken" in capsys.readouterr().err
    assert len(list((tmp_path / "raw/group_1").glob("0*.png"))) == 2


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"notes.txt": b"mine"}, "holds something else than groups of photos"),
        ({"adapter/adapter_config.json": b"{}"}, "holds something else than groups of photos"),
        ({"train/door/1.png": b""}, "has a folder train: name one of its splits"),
        ({"train/metadata.parquet": b""}, "is a prepared folder, not a raw tree"),
        ({"metadata.parquet": b"", "door/1.png": b""}, "is part of a prepared folder"),
        ({"notes.txt": b"mine", "door/.DS_Store": b""}, "holds something else than groups of photos"),
    ],
)
def test_what_holds_something_else_stays_as_it_is(tmp_path, files, message):
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        Session(tmp_path)
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(ValueError, match="is a file: name a folder"):
        Session(file)


def test_masks_that_do_not_fit_are_named(tmp_path, capsys):
    clip = still_clip(tmp_path / "a.mp4", views(5, SIZE, 1)[0])
    for name, mask, message in (
        ("small.png", np.full((10, 10), 255, np.uint8), "small.png: the mask is 10x10, and the frames are 320x240"),
        ("empty.png", np.zeros(SIZE, np.uint8), "empty.png: the mask is empty"),
    ):
        cv2.imwrite(str(tmp_path / name), mask)
        assert capture(clip, tmp_path / "raw", "--mask", tmp_path / name) == 1
        assert message in capsys.readouterr().err
    assert not (tmp_path / "raw").exists()


def test_what_a_person_types(tmp_path):
    picture = views(6, SIZE, 1)[0][0]
    made = Making(SIZE)
    made.hold(picture, 4.0)
    session = Session(tmp_path / "raw", "door", asks=TYPED)
    typed, said = {2: "r", 20: "", 21: "help", 45: "r"}, []
    for index, frame in enumerate(made.frames):
        said += session.see(ClipFrame(index, index / 15, frame), typed.get(index))
        if session.ended:
            break
    text = "\n".join(said)
    assert "take a photo first, then the reference" in text and "'help' is not known" in text
    assert sorted(path.name for path in session.folder.iterdir()) == ["001.png", "002.png", "reference.png"]
    assert "2 photos and the treated reference" in session.finish("0")[0]


def test_ctrl_c_keeps_what_was_taken(tmp_path, capsys, monkeypatch):
    clip = still_clip(tmp_path / "a.mp4", views(7, SIZE, 3)[0])
    whole = capture_session.write_frame

    def interrupted(path, pixels):
        os.kill(os.getpid(), signal.SIGINT)
        whole(path, pixels)

    monkeypatch.setattr(capture_session, "write_frame", interrupted)
    assert threading.current_thread() is threading.main_thread()
    assert capture(clip, tmp_path / "raw") == 0
    said = capsys.readouterr().out
    assert "stopped" in said and "too few for a group" in said
    assert [path.name for path in (tmp_path / "raw/group_1").iterdir()] == ["001.png"]


def test_frames_of_another_size_end_it_and_photos_stay(tmp_path):
    made, session = Making(SIZE), Session(tmp_path / "raw", "door", asks=TYPED)
    made.hold(views(6, SIZE, 1)[0][0], 1.5)
    for index, frame in enumerate(made.frames):
        session.see(ClipFrame(index, index / 15, frame))
    said = session.see(ClipFrame(99, 9.0, made.frames[0][:-1, :-2]))
    assert session.ended and "the frames are 318x239 now, and were 320x240" in said[0]
    assert "1 photo" in session.finish("0")[0]


def test_a_reference_before_any_photo_leaves_nothing(tmp_path, capsys):
    clip = still_clip(tmp_path / "a.mp4", views(4, SIZE, 1)[0])
    assert capture(clip, tmp_path / "raw", "--reference-at", "00:00") == 1
    assert "--reference-at: no photo was taken in" in capsys.readouterr().err
    assert not (tmp_path / "raw").exists()


def test_q_after_r_ends_without_a_reference(tmp_path):
    made, session = Making(SIZE), Session(tmp_path / "raw", "door", asks=TYPED)
    made.hold(views(6, SIZE, 1)[0][0], 1.5)
    for index, frame in enumerate(made.frames):
        session.see(ClipFrame(index, index / 15, frame), {len(made.frames) - 1: "r"}.get(index))
    session.see(ClipFrame(99, 9.0, made.frames[0]), "q")
    told = session.finish("0")
    assert session.ended and "1 photo" in told[0] and "asked for and not taken" in "".join(told)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["99999999999"], "99999999999: neither a camera's number"),
        (["a.mp4", "--reference-at", "b.mp4 00:42"], "--reference-at b.mp4 00:42: the time alone, as 00:42"),
    ],
)
def test_numbers_and_times_that_mean_nothing_are_one_line(tmp_path, capsys, words, message):
    source, *options = words
    assert capture(source, tmp_path / "raw", *options) == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and message in said[0]
