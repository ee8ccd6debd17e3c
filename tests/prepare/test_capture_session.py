"""A capture on its way: photos kept and dropped, pauses, full disks, files of others that are left alone."""

import errno
import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.clips import Making, views

from gift_peft.captures.clip import ClipFrame
from gift_peft.captures.tree import find_groups
from gift_peft.prepare import capture_session
from gift_peft.prepare.capture_session import TYPED, Session
from gift_peft.prepare.out_folder import check_places

SIZE = (240, 320)


def watched(session, pictures, seconds=1.2):
    """Everything said while these are shown, each held still."""
    made, said = Making(SIZE), []
    for picture in pictures:
        made.hold(picture, seconds)
    start = session.frames
    for index, frame in enumerate(made.frames):
        said += session.see(ClipFrame(start + index, (start + index) / 15, frame[..., ::-1].copy()))
    return "\n".join(said)


def test_empty_group_folders_are_passed_over_and_filled(tmp_path):
    """Somebody makes the folders first; `prepare` names those that stay empty."""
    for name in ("door", "later/photos", "hall"):
        (tmp_path / "raw" / name).mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "raw/hall/1.png"), np.zeros((4, 4, 3), np.uint8))
    session = Session(tmp_path / "raw", "door")
    watched(session, views(3, SIZE, 1)[0])
    assert [path.name for path in (tmp_path / "raw/door").iterdir()] == ["001.png"]
    assert "Without photos yet, which `prepare` will say, too: later." in session.finish("0")
    (tmp_path / "raw/hall/1.png").unlink()
    Session(tmp_path / "raw", "hall")
    with pytest.raises(ValueError, match="door: it is there already; name another group"):
        Session(tmp_path / "raw", "door")


@pytest.mark.parametrize("name", ["train", "Validation", "val", "masks", "annotations"])
def test_names_that_mean_something_else_in_a_raw_tree_are_refused(tmp_path, name):
    with pytest.raises(ValueError, match=f"group {name}: a folder of this name is no group"):
        Session(tmp_path / "raw", name)


@pytest.mark.parametrize(
    ("out", "line"),
    [
        ("raw", "gift-peft prepare raw raw-prepared"),
        ("raw/train", "gift-peft prepare raw raw-prepared"),
        ("train", "gift-peft prepare . ../{here}-prepared"),
        (".", "gift-peft prepare . ../{here}-prepared"),
        ("../raw", "gift-peft prepare ../raw ../raw-prepared"),
    ],
)
def test_the_last_line_prepares_raw_into_a_folder_beside_it(tmp_path, monkeypatch, out, line):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    session = Session(Path(out))
    watched(session, views(3, SIZE, 1)[0])
    told = session.finish("0")[-1]
    assert told == f"Next: {line.format(here='here')}"
    raw, prepared = told.split()[-2:]
    check_places("prepare", Path(raw), "RAW", Path(prepared), ".prepare")
    assert find_groups(raw)


def test_a_dropped_photo_goes_and_comes_only_when_it_is_asked_for(tmp_path):
    pictures, mask = views(3, SIZE, 3)
    cv2.imwrite(str(tmp_path / "m.png"), mask.astype(np.uint8) * 255)
    session = Session(tmp_path / "raw", "door", str(tmp_path / "m.png"), asks=TYPED)
    watched(session, pictures[:2])
    first, second = session.photos[session.folder]
    assert session.drop(second) == f"dropped {second}" and not second.exists()
    assert "  photo " not in watched(session, [pictures[1]], 1.5)  # it still stands there
    assert "002.png" in watched(session, [pictures[2]])
    session.see(ClipFrame(session.frames, session.frames / 15, pictures[1].astype(np.uint8)), "")
    assert "003.png" in watched(session, [pictures[1]])  # asked for
    session.see(ClipFrame(session.frames, session.frames / 15, pictures[1].astype(np.uint8)), "r")
    assert "treated reference" in watched(session, [pictures[1]]) and session.ended
    for path in list(session.photos[session.folder])[:-1]:
        session.drop(path)
    (last,) = session.photos[session.folder]
    with pytest.raises(ValueError, match="the last photo beside the treated reference"):
        session.drop(last)
    session.drop(session.references[0])
    session.drop(last)
    assert not session.folder.exists() and session.photos == {}
    session.resume()
    assert "door/001.png" in watched(session, [pictures[0]], 2.0)  # the folder is ours, and the group begins anew
    session.drop(session.photos[session.folder][0])
    for other in (last, tmp_path / "m.png", first):
        with pytest.raises(ValueError, match="no photo that was taken here"):
            session.drop(other)


def test_a_capture_goes_on_after_a_pause_with_what_it_knows(tmp_path):
    pictures, _ = views(5, SIZE, 2)
    session = Session(tmp_path / "raw", "door", asks=TYPED)
    made = Making(SIZE)
    for picture in (pictures[0], pictures[0], pictures[1]):
        made.hold(picture)
    for index, frame in enumerate(made.frames):
        if index == 15:
            before = session.seconds
            session.resume()
        session.see(ClipFrame(index % 15 if index < 30 else index - 15, (index - 15 * (index >= 15)) / 15, frame))
    assert [path.name for path in session.photos[session.folder]] == ["001.png", "002.png"]
    assert session.seconds > before + 2


def test_a_group_that_another_program_filled_meanwhile_is_left_alone(tmp_path):
    session = Session(tmp_path / "raw", "door")
    (tmp_path / "raw/door").mkdir(parents=True)
    (tmp_path / "raw/door/001.png").write_bytes(b"of somebody else")
    said = watched(session, views(3, SIZE, 1)[0])
    assert (tmp_path / "raw/door/001.png").read_bytes() == b"of somebody else"
    assert f"photo {tmp_path / 'raw/door__2/001.png'}" in said


def test_a_full_disk_leaves_no_group_and_the_photo_comes_again(tmp_path, monkeypatch):
    pictures, mask = views(3, SIZE, 1)
    cv2.imwrite(str(tmp_path / "m.png"), mask.astype(np.uint8) * 255)
    session = Session(tmp_path / "raw", "door", str(tmp_path / "m.png"))
    whole = capture_session.write_frame

    def full(path, pixels):
        if path.name == "001.png":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        whole(path, pixels)

    monkeypatch.setattr(capture_session, "write_frame", full)
    with pytest.raises(OSError, match="No space left"):
        watched(session, pictures)
    assert not session.folder.exists() and session.photos == {}
    monkeypatch.undo()
    session.resume()
    watched(session, pictures, 2.0)
    assert sorted(path.name for path in session.folder.iterdir()) == ["001.png", "mask.png"]


def test_what_to_do_next_is_one_sentence(tmp_path):
    pictures = views(3, SIZE, 2)[0]
    session = Session(tmp_path / "raw", "door", most=2, asks="press R")
    steps = []
    made = Making(SIZE)
    made.hold(pictures[0], 1.5)
    made.fade(*pictures)
    made.hold(pictures[1], 1.5)
    for index, frame in enumerate(made.frames):
        session.see(ClipFrame(index, index / 15, frame))
        steps += [session.next_step] if session.next_step not in steps[-1:] else []
    assert steps[0].startswith("Hold camera and scene still") and steps[1].startswith("Keep still: a photo")
    assert "Change what is reflected or seen through, and step aside." in steps
    assert steps[-1].startswith("Enough: more photos add nothing; now spray") and steps[-1].endswith("press R.")
    assert all(step[0].isupper() and step.endswith(".") and "\n" not in step for step in steps)
    session.see(ClipFrame(session.frames, session.frames / 15, made.frames[-1]), "r")
    assert session.next_step == "Keep still: the next still moment is the treated reference."
    assert session.figures.keys() == {"drift", "sharp", "white", "black", "changed"}
    assert all(f"{name} {value}" in session.status for name, value in session.figures.items())


def test_a_mask_that_somebody_drew_is_never_written_over(tmp_path):
    pictures, mask = views(3, SIZE, 2)
    cv2.imwrite(str(tmp_path / "m.png"), mask.astype(np.uint8) * 255)
    session = Session(tmp_path / "raw", "door", str(tmp_path / "m.png"))
    watched(session, pictures[:1])
    (photo,), drawn = session.photos[session.folder], session.folder / "mask.png"
    drawn.write_bytes(b"drawn better")
    session.drop(photo)
    watched(session, pictures[1:], 2.0)
    assert photo.exists() and drawn.read_bytes() == b"drawn better"


@pytest.mark.parametrize("other", ["masks/002.png", "002.jpg", "002.json", "002_mask.png", "002.png"])
def test_a_photo_takes_no_number_that_a_file_of_somebody_else_has(tmp_path, other):
    """A mask of its own would become the mask of the photo that comes in place of a dropped one."""
    pictures, _ = views(3, SIZE, 2)
    session = Session(tmp_path / "raw", "door")
    watched(session, pictures[:1])
    (session.folder / other).parent.mkdir(exist_ok=True)
    (session.folder / other).write_bytes(b"of somebody else")
    watched(session, pictures[1:])
    assert [path.name for path in session.photos[session.folder]] == ["001.png", "003.png"]
    assert (session.folder / other).read_bytes() == b"of somebody else"


def test_the_end_asks_for_masks_that_are_not_there(tmp_path):
    session = Session(tmp_path / "raw", "door")
    watched(session, views(3, SIZE, 1)[0])
    assert f"Draw the target in {session.folder / 'mask.png'}" in "\n".join(session.finish("0"))
    (session.folder / "mask.png").write_bytes(b"drawn")
    assert "Draw the target" not in "\n".join(session.finish("0"))


@pytest.mark.parametrize("name", ["a\nb", "a\tb", "\ud800", "bar\udce9"])
def test_names_that_are_no_text_are_refused_in_a_line(tmp_path, name):
    with pytest.raises(ValueError, match="no text") as told:
        Session(tmp_path / "raw", name)
    str(told.value).encode()
    assert "\n" not in str(told.value)


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes on Linux alone")
def test_a_folder_whose_name_is_no_text_is_named_so_that_it_can_be_told(tmp_path):
    (tmp_path / "raw").mkdir()
    os.mkdir(os.fsencode(tmp_path / "raw") + b"/bar\xe9")
    session = Session(tmp_path / "raw", "door")
    watched(session, views(3, SIZE, 1)[0])
    assert r"too: bar\udce9." in "\n".join(session.finish("0"))
