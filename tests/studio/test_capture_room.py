"""The Capture room without its page, at a source that is ours: one tab captures, names become no paths, a tab that is
gone stops the camera, and what was taken stays."""

import base64
import io
import threading
import time
from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest
from helpers.clips import Making, views
from PIL import Image

from gift_peft.captures.clip import ClipFrame
from gift_peft.prepare.capture_session import Source
from gift_peft.studio import capture_room
from gift_peft.studio.capture_room import CaptureRoom

SIZE = (120, 160)
DEADLINE = 60.0  # seconds until a wait has failed


@dataclass(frozen=True)
class Camera(Source):
    """A camera that shows these views, faster than they were: one each time that it is opened."""

    shown: list = field(default_factory=list)
    opened: list = field(default_factory=list)
    closed: list = field(default_factory=list)
    wrong: list = field(default_factory=list)

    def frames(self):
        self.opened.append(True)
        made = Making(SIZE)
        try:
            if self.wrong:
                raise ValueError(self.wrong[0])
            made.hold(self.shown[min(len(self.opened), len(self.shown)) - 1], 1.5)
            for index in range(100_000):
                yield ClipFrame(index, index / 15, made.frames[index % len(made.frames)])
                time.sleep(0.002)
        finally:
            self.closed.append(True)


@pytest.fixture
def camera():
    return Camera("0", shown=views(3, SIZE, 2)[0])


@pytest.fixture
def room(tmp_path, camera):
    made = CaptureRoom(tmp_path / "raw", camera)
    yield made
    made.close()
    for one in threading.enumerate():
        if one.name == "capture":
            one.join(DEADLINE)
            assert not one.is_alive()


def until(room, holds, tab="a"):
    """What the room shows as soon as it is what is waited for."""
    end = time.monotonic() + DEADLINE
    while time.monotonic() < end:
        if holds(found := room.look({"tab": tab, "seen": -1})):
            return found
        time.sleep(0.01)
    raise AssertionError(found)


def running(found):
    return found["state"] == "running" and found.get("photos", 0) > 0


def stopped(found):
    return found["state"] == "stopped"


def test_a_tab_captures_and_another_one_is_told(room, camera, tmp_path):
    assert room.look({"tab": "a"}) == {
        **{"state": "idle", "number": 0, "version": 0, "said": [], "wrong": None},
        **{"source": "0", "free": {"": "group_1"}},
    }
    assert room.start({"tab": "a", "group": " door "}) == {}
    found = until(room, running)
    assert found["group"] == "door" and found["picture"].startswith("data:image/jpeg;base64,")
    assert found["figures"]["white"] == "0%" and found["next"].endswith(".") and found["well"]
    told = room.look({"tab": "b"})
    assert told["state"] == "elsewhere" and "photos of door (1 so far)" in told["next"] and "picture" not in told
    for method, more in ((room.start, {"group": "hall"}), (room.resume, {})):
        with pytest.raises(ValueError, match="Another tab of this studio takes photos of door"):
            method({"tab": "b", **more})
    for method, more in ((room.press, {"what": "end"}), (room.drop, {"photo": "door/001.png"})):
        with pytest.raises(ValueError, match=r"takes no photos now|there is no photo"):
            method({"tab": "b", **more})
    with pytest.raises(ValueError, match="it runs"):
        room.start({"tab": "a", "group": "hall"})
    room.press({"tab": "a", "what": "end"})
    found = until(room, stopped)
    assert found["said"][-1].endswith("stopped") and found["groups"] == ["train/door"] and found["resumes"]
    assert (
        found["told"][0]
        == f"{tmp_path / 'raw/door'}: 1 photo, too few for a group: add another to the folder, or delete it"
    )
    assert found["free"] == {"": "group_1"} and camera.closed == [True]
    assert room.look({"tab": "b"})["state"] == "stopped"


def test_it_goes_on_with_the_group_and_a_reference_ends_it(room, tmp_path):
    room.start({"tab": "a", "group": ""})
    until(room, running)
    room.press({"tab": "a", "what": "end"})
    until(room, stopped)
    room.resume({"tab": "b"})  # whoever does, while nobody captures
    until(room, lambda found: running(found) and found["photos"] == 2, "b")
    room.press({"tab": "b", "what": "photo"})
    until(room, lambda found: found["photos"] == 3, "b")
    room.press({"tab": "b", "what": "reference"})
    found = until(room, stopped, "b")
    assert "and the treated reference" in found["told"][0] and found["groups"] == ["validation/group_1"]
    assert not found["resumes"]
    with pytest.raises(ValueError, match="nothing to go on with"):
        room.resume({"tab": "b"})
    names = [one["name"] for one in room.strip()["photos"]]
    assert names == ["group_1/001.png", "group_1/002.png", "group_1/003.png", "group_1/reference.png"]
    before = found["version"]
    room.drop({"tab": "b", "photo": "group_1/reference.png"})
    found = room.look({"tab": "b"})
    assert found["resumes"] and found["version"] > before and "reference" not in found["told"][0]
    assert sorted(path.name for path in (tmp_path / "raw/group_1").iterdir()) == ["001.png", "002.png", "003.png"]


def test_nothing_in_a_request_becomes_a_path(room, tmp_path):
    (tmp_path / "secret.png").write_bytes(b"a secret")
    for name in ("../door", "/etc", "a/b", ".hidden", "a\0b", "masks", "train", "x" * 300):
        with pytest.raises(ValueError, match=r"group"):
            room.start({"tab": "a", "group": name})
    for request in ({"group": "door"}, {"tab": "a"}, {"tab": 3, "group": "door"}, {"tab": "", "group": "door"}):
        with pytest.raises(ValueError, match=r"tab|group"):
            room.start(request)
    with pytest.raises(ValueError, match="nothing to go on with"):
        room.resume({"tab": "a"})
    for photo in ("../secret.png", str(tmp_path / "secret.png"), "door/001.png", None, ["a"]):
        with pytest.raises(ValueError, match="there is no photo"):
            room.drop({"tab": "a", "photo": photo})
    for what in ("q", "", None, ["photo"]):
        with pytest.raises(ValueError, match=r"what: one of|takes no photos"):
            room.press({"tab": "a", "what": what})
    assert [path.name for path in tmp_path.iterdir()] == ["secret.png"]
    (tmp_path / "raw").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "raw/train").symlink_to(tmp_path / "out")
    for split, message in (("../out", "split: one of train"), (None, "split: one of"), ("train", "leads out of")):
        with pytest.raises(ValueError, match=message):
            room.start({"tab": "a", "group": "door", "split": split})


def test_a_group_goes_into_the_split_that_is_chosen(room, tmp_path):
    for split in ("train", "validation"):
        (tmp_path / "raw" / split / "hall").mkdir(parents=True)
    assert room.look({"tab": "a"})["free"] == {"train": "group_1", "validation": "group_1"}
    room.start({"tab": "a", "group": "door", "split": "validation"})
    until(room, running)
    room.press({"tab": "a", "what": "end"})
    assert until(room, stopped)["groups"] == ["validation/door"]
    with pytest.raises(ValueError, match="door: it is there already"):
        room.start({"tab": "a", "group": "door", "split": "validation"})
    assert len(list((tmp_path / "raw/validation/door").iterdir())) == 1


def test_a_closed_tab_stops_the_camera(room, camera, monkeypatch):
    monkeypatch.setattr(capture_room, "GONE", 0.3)
    room.start({"tab": "a", "group": "door"})
    until(room, running)
    found = until(room, stopped, "b")  # another tab is no reason to go on
    assert found["said"][-1].endswith("the page was closed, and the camera is off") and camera.closed == [True]
    room.resume({"tab": "b"})
    assert until(room, running, "b")["group"] == "door"


def test_what_is_wrong_is_told_and_it_may_be_tried_again(room, camera, monkeypatch):
    camera.wrong.append("camera 0: cannot be opened; plug it in")
    room.start({"tab": "a", "group": "door"})
    found = until(room, stopped)
    assert found["wrong"] == camera.wrong[0] and found["told"] == [] and found["groups"] == []
    camera.wrong.clear()
    room.start({"tab": "a", "group": "door"})
    assert until(room, running)["wrong"] is None
    room.session.see = lambda *_: 1 / 0
    crashed = threading.Event()
    monkeypatch.setattr(threading, "excepthook", lambda args: crashed.set())
    assert "an error of its own" in until(room, stopped)["wrong"] and crashed.wait(DEADLINE)


def test_the_end_of_the_studio_keeps_what_was_taken(room, camera, tmp_path):
    assert room.close() == []
    room.start({"tab": "a", "group": "door"})
    until(room, running)
    lines = room.close()
    assert lines[0].startswith(f"{tmp_path / 'raw/door'}: 1 photo") and lines[-1].startswith(
        "Next: gift-peft prepare "
    )
    assert camera.closed == [True] and [path.name for path in (tmp_path / "raw/door").iterdir()] == ["001.png"]


def test_pictures_are_small_and_in_their_colors():
    frame = np.zeros((1000, 2000, 3), np.uint8)
    frame[..., 0] = 200  # blue, as OpenCV has it
    small = capture_room._small(frame, 960)
    assert small.size == (960, 480) and small.getpixel((5, 5)) == (0, 0, 200)
    assert capture_room._small(frame[:100, :100], 960).size == (100, 100)
    mask = np.zeros(frame.shape[:2], bool)
    mask[200:800, 400:1600] = True
    drawn = np.asarray(capture_room._small(frame, 960, mask)) != np.asarray(small)
    ys, xs = np.nonzero(drawn.any(axis=2))
    assert (ys.min(), ys.max(), xs.min(), xs.max()) == pytest.approx((96, 384, 192, 768), abs=2)
    assert not drawn[200:280, 300:600].any()


def test_the_targets_border_stands_on_the_picture_and_not_on_the_photo(tmp_path, camera):
    pictures, mask = views(3, SIZE, 2)
    Image.fromarray(mask).save(tmp_path / "m.png")
    room = CaptureRoom(tmp_path / "raw", camera, str(tmp_path / "m.png"))
    room.start({"tab": "a", "group": "door"})
    found = until(room, running)
    room.close()
    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(found["picture"].split(",")[1]))), float)
    photo = np.asarray(Image.open(tmp_path / "raw/door/001.png"), float)[..., ::-1]  # the camera gives RGB
    border = mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    away = np.abs(shown[..., ::-1] - photo).mean(axis=2)
    assert found["of"] == "target" and away[border].mean() > 3 * away[~mask].mean()
    assert np.abs(photo - pictures[0])[border].mean() < 10
    assert np.array_equal(np.asarray(Image.open(tmp_path / "raw/door/mask.png")) > 0, mask)


def test_a_tab_that_is_closed_in_a_long_pause_of_a_clip_stops_it(tmp_path, camera, monkeypatch):
    """Recorders of screens write no frame while nothing moves."""
    monkeypatch.setattr(capture_room, "GONE", 0.3)
    monkeypatch.setattr(capture_room, "PATIENCE", 0.05)

    class Paused(Camera):
        def frames(self):
            frames = super().frames()
            for frame in frames:
                yield ClipFrame(frame.index, 3600.0 * frame.index, frame.pixels)

    room = CaptureRoom(tmp_path / "raw", Paused("a.mp4", clip=object(), shown=camera.shown))
    room.start({"tab": "a", "group": "door"})
    assert until(room, stopped, "b")["said"][-1].endswith("the page was closed, and the camera is off")


def test_it_says_that_the_camera_is_being_opened_and_closed(room, camera, monkeypatch):
    opened, whole = threading.Event(), Camera.frames

    def slow(self):
        opened.wait(DEADLINE)
        yield from whole(self)

    monkeypatch.setattr(Camera, "frames", slow)
    room.start({"tab": "a", "group": "door"})
    found = room.look({"tab": "a"})
    assert found["next"] == "The camera is being opened." and found["figures"]["drift"] == "-"
    room.press({"tab": "a", "what": "end"})
    assert room.look({"tab": "a"})["next"] == "The camera is being closed."
    opened.set()
    assert until(room, stopped)["wrong"].startswith("0: no photo was taken")


def test_a_mask_that_was_drawn_is_not_asked_for(room, tmp_path):
    room.start({"tab": "a", "group": "door"})
    until(room, running)
    room.press({"tab": "a", "what": "end"})
    assert any(line.startswith("Draw the target") for line in until(room, stopped)["told"])
    (tmp_path / "raw/door/mask.png").write_bytes(b"drawn")
    assert not any(line.startswith("Draw the target") for line in room.look({"tab": "a"})["told"])


def test_a_photo_that_somebody_deleted_has_no_picture(room, tmp_path, capfd):
    room.start({"tab": "a", "group": "door"})
    until(room, running)
    room.close()
    (tmp_path / "raw/door/001.png").unlink()
    assert room.strip() == {"photos": [{"name": "door/001.png", "picture": None}]}
    assert capfd.readouterr().err == ""
