"""Clips are decoded upright, in order and with their times, and what is no readable clip says so in one line."""

import shutil
import subprocess

import cv2
import numpy as np
import pytest
from helpers.clips import RATE

from gift_peft.captures.clip import Clip, TimeInClip, find_clips, read_time
from gift_peft.captures.clip_group import find_clip_group
from gift_peft.captures.tree import find_groups
from gift_peft.cli import main
from gift_peft.dataset.gift_i import load_gift_i

SIZE = (48, 64)  # height, width


def number_frame(index: int) -> np.ndarray:
    """(H, W, 3) uint8 whose grey value is the frame's number, with a white upper left corner."""
    frame = np.full((*SIZE, 3), 8 * index + 16, np.uint8)
    frame[:16, :16] = 255
    return frame


def write(path, count=30, codec="mp4v", size=SIZE):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), RATE, size[::-1])
    assert writer.isOpened()
    for index in range(count):
        writer.write(cv2.resize(number_frame(index), size[::-1], interpolation=cv2.INTER_NEAREST))
    writer.release()
    return path


def numbers(frames):
    """Which frames these are; a codec's conversion of colors darkens by about three grey levels."""
    return [round((float(frame.pixels[24:, 24:].mean()) - 14) / 8) for frame in frames]


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "mp4v"), ("a.mov", "mp4v"), ("a.avi", "MJPG"), ("a.mkv", "FFV1")]
)
def test_frames_come_in_order_with_their_times(tmp_path, name, codec):
    frames = list(Clip(write(tmp_path / name, codec=codec)).frames())
    assert numbers(frames) == [frame.index for frame in frames] == list(range(30))
    assert np.allclose([frame.seconds for frame in frames], np.arange(30) / RATE, atol=0.002)
    assert frames[0].pixels.shape == (*SIZE, 3)


def test_wanted_frames_are_the_same_pixels(tmp_path):
    clip = Clip(write(tmp_path / "a.mp4"))
    every = list(clip.frames())
    some = list(clip.frames([21, 3, 4]))
    assert [frame.index for frame in some] == [3, 4, 21]
    for frame in some:
        assert np.array_equal(frame.pixels, every[frame.index].pixels) and frame.seconds == every[frame.index].seconds


def turned(path, degrees_code: bytes):
    """The file with a display matrix in its track header in place of the identity, as phones write it."""
    content = path.read_bytes()
    at = content.index(b"tkhd") + 4 + 40
    identity = bytes.fromhex("00010000 00000000 00000000 00000000 00010000 00000000 00000000 00000000 40000000")
    assert content[at : at + 36] == identity
    path.write_bytes(content[:at] + degrees_code + content[at + 36 :])
    return path


@pytest.mark.parametrize(
    ("matrix", "corner"),
    [
        ("00000000 00010000 00000000 ffff0000 00000000 00000000 00000000 00000000 40000000", (0, -1)),  # 90 clockwise
        ("ffff0000 00000000 00000000 00000000 ffff0000 00000000 00000000 00000000 40000000", (-1, -1)),  # 180
        ("00000000 ffff0000 00000000 00010000 00000000 00000000 00000000 00000000 40000000", (-1, 0)),  # 90 against it
    ],
)
def test_a_phones_rotation_is_applied(tmp_path, matrix, corner):
    clip = Clip(turned(write(tmp_path / "a.mp4"), bytes.fromhex(matrix)))
    frame = next(iter(clip.frames())).pixels.astype(int)
    assert frame.shape == ((*SIZE, 3) if corner == (-1, -1) else (*SIZE[::-1], 3))
    quarters = {(row, column): frame[row][column].mean() for row in (0, -1) for column in (0, -1)}
    assert max(quarters, key=quarters.get) == corner


def test_a_damaged_tail_ends_the_clip_and_is_told(tmp_path):
    path = write(tmp_path / "a.avi", codec="MJPG")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    clip = Clip(path)
    frames = list(clip.frames())
    # The frame that the cut goes through may be there, made up by the decoder of the one before.
    assert 5 < len(frames) < 25 and numbers(frames)[:-1] == list(range(len(frames) - 1))


def by_ffmpeg(path, *words):
    """A clip of numbered frames again, with other options."""
    source = write(path.with_name("source.avi"), codec="MJPG")
    subprocess.run(["ffmpeg", "-loglevel", "error", "-y", "-i", source, *words, path], check=True)
    return path


needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg to make the clip")


@needs_ffmpeg
@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_variable_frame_rate_keeps_the_times(tmp_path, suffix):
    """Of 15 frames a second, every third from the second second on, as phones do in the dark."""
    chosen = "select='lt(t,1)+not(mod(n,3))'"
    path = by_ffmpeg(tmp_path / f"a.{suffix}", "-vf", chosen, "-fps_mode", "vfr", "-c:v", "mpeg4", "-q:v", "2")
    frames = list(Clip(path).frames())
    expected = [index for index in range(30) if index < 15 or index % 3 == 0]
    assert numbers(frames) == expected
    assert np.allclose([frame.seconds for frame in frames], np.array(expected) / RATE, atol=0.002)


@needs_ffmpeg
def test_the_frames_before_a_damaged_tail_of_mp4_are_read(tmp_path):
    path = by_ffmpeg(tmp_path / "a.mp4", "-c:v", "mpeg4", "-q:v", "2", "-movflags", "+faststart")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    clip = Clip(path)
    frames = list(clip.frames())
    # The frame that the cut goes through may be there, made up by the decoder of the one before.
    assert 5 < len(frames) < 25 and numbers(frames)[:-1] == list(range(len(frames) - 1))
    assert clip.frames_stated == 30 and clip.is_cut_short(len(frames))


def test_fewer_frames_than_stated_are_a_cut(tmp_path):
    clip = Clip(write(tmp_path / "a.mp4"))
    assert clip.frames_stated == 30
    assert clip.is_cut_short(20) and not clip.is_cut_short(30) and not clip.is_cut_short(29)


@pytest.mark.parametrize("content", [b"", b"not a video at all" * 50, None])
def test_what_is_no_clip_is_named(tmp_path, capfd, content):
    path = tmp_path / "a.mp4"
    if content is None:
        whole = write(path).read_bytes()
        content = whole[: whole.index(b"moov") - 4]  # a recording whose index was never written
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.mp4: cannot be opened as a video") as caught:
        list(Clip(path).frames())
    assert "\n" not in str(caught.value) and "WARN" not in capfd.readouterr().err


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("00:42", (42, None)),
        (102, (102, None)),  # what YAML makes of 1:42
        (42.5, (42.5, None)),
        ("1:02:03.5", (3723.5, None)),
        ("b one.mp4 00:42", (42, "b one.mp4")),
    ],
)
def test_times(value, expected):
    assert read_time(value, "x") == TimeInClip(*expected)


@pytest.mark.parametrize("value", ["soon", "-1", "1:75", "1:2:3:4", None, True, [1], "", "nan", "inf"])
def test_no_times(value):
    with pytest.raises(ValueError, match=r"^group\.yaml: .* is not a time in a clip"):
        read_time(value, "group.yaml")


def test_clips_in_natural_order(tmp_path):
    names = ["c10.MP4", "c2.mov", "._c1.mp4", "notes.txt", "photo.png"]
    assert [path.name for path in find_clips(tmp_path / name for name in names)] == ["c2.mov", "c10.MP4"]


@pytest.fixture
def raw(tmp_path):
    (tmp_path / "raw/hall").mkdir(parents=True)
    write(tmp_path / "raw/hall/clip.mp4", count=3)
    return tmp_path / "raw"


def test_readers_of_photos_refuse_a_clip_and_print_the_line_to_type(raw, base_dir, capsys):
    line = f"gift-peft prepare {raw} {raw}-prepared"
    with pytest.raises(ValueError, match="holds a clip") as caught:
        load_gift_i(raw, "train")
    assert f"`{line}`" in str(caught.value)
    with pytest.raises(SystemExit) as leaving:
        main(["train", "--base", str(base_dir), "--dataset", str(raw), "--out", str(raw.parent / "run")])
    said = capsys.readouterr().err.strip().splitlines()
    assert leaving.value.code == 1 and f"`{line}`" in said[-1]


def test_a_clip_with_a_reference_in_it_is_validation(raw):
    assert list(find_groups(raw)) == ["train"]
    (raw / "hall/group.yaml").write_text("reference: 00:01\n")
    assert list(find_groups(raw)) == ["validation"]


def test_photos_win_over_clips_and_two_references_are_one_too_many(raw):
    cv2.imwrite(str(raw / "hall/reference.png"), number_frame(0))
    group = find_clip_group(raw / "hall", raw)
    assert group.reference == raw / "hall/reference.png" and [path.name for path in group.clips] == ["clip.mp4"]
    (raw / "hall/group.yaml").write_text("reference: 00:01\n")
    with pytest.raises(ValueError, match=r"two references, reference\.png and the time"):
        find_clip_group(raw / "hall", raw)
    cv2.imwrite(str(raw / "hall/1.png"), number_frame(1))
    assert find_clip_group(raw / "hall", raw) is None


def test_clips_of_one_name_are_refused(raw):
    write(raw / "hall/clip.avi", count=3, codec="MJPG")
    with pytest.raises(ValueError, match="2 clips are called clip"):
        find_clip_group(raw / "hall", raw)
