"""Clips in place of photos: which files they are, and their frames one after the other, upright, with their times.

Frames are decoded by OpenCV and never kept, so that the length of a clip does not matter. Which of them become photos
is chosen by `prepare/clip_frames.py`.
"""

import os
import shlex
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gift_peft.files import is_leftover, write_whole
from gift_peft.images import natural_key

if TYPE_CHECKING:
    import cv2

CLIP_SUFFIXES = {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts", ".3gp"}
MAX_SIDE = 32767  # pixels; beyond, OpenCV cannot warp
TAIL = 0.02  # share of the frames stated by the file that may be missing: many files state one too many


@dataclass(frozen=True)
class ClipFrame:
    """One frame: its number from 0, its time in seconds from the clip's start, and (H, W, 3) uint8 BGR, upright."""

    index: int
    seconds: float
    pixels: np.ndarray


@dataclass(frozen=True)
class TimeInClip:
    """A moment: `clip` is a file name, None where there is only one."""

    seconds: float
    clip: str | None = None


class Clip:
    """A video file.

    Args:
        path (`Path`): the file.

    `frames_stated` is the number of frames as the file tells it, 0 where it does not. Raises FileNotFoundError or
    ValueError naming the file if it cannot be opened.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"{self.path}: no such file")
        import cv2  # here and below, where a clip is read: readers of photos do without

        capture = self._open()
        self.frames_stated = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        rate = capture.get(cv2.CAP_PROP_FPS)
        self.rate = rate if 0 < rate < 1000 else 30.0
        capture.release()

    def frames(self, wanted: Iterable[int] | None = None) -> Generator[ClipFrame, None, None]:
        """All frames in order, or only those of these numbers; the others are then decoded, but not converted.

        The clip ends where no frame can be decoded any more. ValueError naming it: not even one can be.
        """
        import cv2

        left = None if wanted is None else set(wanted)
        capture, index, before = self._open(), 0, -1.0
        try:
            while left is None or left:
                if not capture.grab():
                    break
                seconds = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                if not before < seconds < before + 3600:  # no time stamps, or broken ones
                    seconds = before + 1 / self.rate if index else 0.0
                before = seconds
                if left is None or index in left:
                    there, pixels = capture.retrieve()
                    if not there:
                        break
                    check_frame(pixels, self.path)
                    yield ClipFrame(index, seconds, pixels)
                    if left is not None:
                        left.discard(index)
                index += 1
        finally:
            capture.release()
        if not index:
            raise ValueError(f"{self.path}: no frame can be decoded; is it a video, and whole?")

    def is_cut_short(self, frames: int) -> bool:
        """Whether `frames`, all that could be decoded, are clearly fewer than the file states."""
        return frames < self.frames_stated * (1 - TAIL) - 2

    def _open(self) -> "cv2.VideoCapture":
        import cv2

        capture = open_quietly(str(self.path))
        if not capture.isOpened():
            raise ValueError(
                f"{self.path}: cannot be opened as a video; a recording that was cut off, or a format that OpenCV "
                "does not decode (convert it: ffmpeg -i IN -c:v libx264 -crf 16 OUT.mp4)"
            )
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)  # phones store upright clips lying, with a rotation beside them
        return capture


def check_frame(pixels: np.ndarray, source: str | Path) -> None:
    """Raise ValueError, naming the source, unless it is (H, W, 3) uint8 and not too large to be warped."""
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ValueError(f"{source}: frames of {pixels.shape} {pixels.dtype}; it takes 8-bit color")
    if max(pixels.shape) > MAX_SIDE:
        raise ValueError(f"{source}: frames of {pixels.shape[1]}x{pixels.shape[0]}; a side is at most {MAX_SIDE}")


def open_quietly(source: int | str) -> "cv2.VideoCapture":
    """What FFmpeg opens, a file or an address, or a camera's number; it writes nothing to stderr."""
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # else it writes a line for each damaged byte
    log = cv2.utils.logging
    level = log.getLogLevel()
    log.setLogLevel(log.LOG_LEVEL_SILENT)  # else OpenCV writes a line of its own for each driver that it tries
    try:
        return cv2.VideoCapture(source) if isinstance(source, int) else cv2.VideoCapture(source, cv2.CAP_FFMPEG)
    finally:
        log.setLogLevel(level)


def write_frame(path: Path, pixels: np.ndarray) -> None:
    """A frame (H, W, 3), or a mask (H, W), uint8, as a PNG file; ValueError or OSError naming it."""
    import cv2

    there, content = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not there:
        raise ValueError(f"{path}: {pixels.shape} cannot be written as PNG")
    write_whole(path, content.tobytes())


def find_clips(files: Iterable[Path]) -> list[Path]:
    """Those of a group's files that are clips, in natural order."""
    clips = [path for path in files if path.suffix.lower() in CLIP_SUFFIXES and not is_leftover(path.name)]
    return sorted(clips, key=lambda path: natural_key(path.as_posix()))


def explain_clip(folder: Path, clips: list[Path], root: Path) -> str:
    """Why a group of clips is not read as photos, and the line to type."""
    names = ", ".join(path.name for path in clips)
    line = prepare_line(root)
    return f"group {folder} holds a clip ({names}) and no photos; choose its frames with `{line}`, and use that folder"


def prepare_line(root: Path) -> str:
    """The command that prepares a raw tree, to type: into a folder beside it, since OUT may not lie inside."""
    plain = root.name not in ("", "..")
    out = root.with_name(f"{root.name}-prepared") if plain else root / ".." / f"{root.resolve().name}-prepared"
    return shlex.join(["gift-peft", "prepare", str(root), str(out)])


def read_time(value: Any, at: str) -> TimeInClip:
    """A moment as `group.yaml` states it: seconds (42, 42.5), "00:42", "1:02:03.5", or "b.mp4 00:42" of several clips.

    Unquoted, YAML reads 1:42 as 102, which is the same moment. ValueError, beginning with `at`, for anything else.
    """
    wrong = f'{at}: {value!r} is not a time in a clip, as 00:42, or "b.mp4 00:42" where there are several'
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(wrong)
    clip, _, text = str(value).strip().rpartition(" ")
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        raise ValueError(wrong) from None
    if len(parts) > 3 or not all(0 <= part < float("inf") for part in parts) or any(part >= 60 for part in parts[1:]):
        raise ValueError(wrong)
    return TimeInClip(sum(part * 60**place for place, part in enumerate(reversed(parts))), clip.strip() or None)
