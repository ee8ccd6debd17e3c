"""Clips in which one thing goes wrong that a coach must tell, or nothing: known views, known faults, known times.

`make_fault_clip` draws everything from its seed: the views, how one goes over into the next, noise, compression, drift
of the light, people who pass, and when and how strongly the fault comes.
"""

import shutil
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from helpers.clip_stills import at_size, distinct
from helpers.clips import pushed

FAULTS = ("moved", "blurred", "unchanged", "over_exposed")
FREE_ROWS = 0.13  # height of somebody who passes, of the picture's
SIZES = ((270, 480), (360, 640), (720, 1280))
CODECS = ("h264", "mp4v", "mjpeg")


@dataclass
class FaultClip:
    """A clip and the truth about it; times in seconds.

    Args:
        path (`Path`): the file.
        mask (`np.ndarray`): (H, W) bool, the target.
        fault (`str`, *optional*): one of FAULTS.
        spoiled (`tuple[float, float]`, *optional*): when the fault shows.
        views (`list[tuple[float, float]]`): when each view that should become a photo stands still.
        good (`list[tuple[float, float]]`): when all is well and something stands still.
    """

    path: Path
    mask: np.ndarray
    fault: str | None
    spoiled: tuple[float, float] | None = None
    views: list[tuple[float, float]] = field(default_factory=list)
    good: list[tuple[float, float]] = field(default_factory=list)
    made: str = ""


class Film:
    """Frames on their way, with the light and the noise of one camera."""

    def __init__(self, size, rng, mask) -> None:
        self.size, self.rng = size, rng
        self.rate = float(rng.choice([15.0, 15.0, 24.0, 30.0]))
        self.noise = float(rng.uniform(0.5, 4.0))
        self.drift = float(rng.uniform(-0.02, 0.02))  # of the light, per second
        self.frames: list[np.ndarray] = []
        self.pool = rng.standard_normal((size[0] + 64, size[1] + 64, 3), np.float32)
        height = round(FREE_ROWS * size[0])
        rows = range(0, size[0] - height, max(1, size[0] // 30))
        self.free = [row for row in rows if not mask[row : row + height].any()]
        inside = np.flatnonzero(mask.any(axis=1))
        self.across = int(inside[0]), int(inside[-1]) + 1
        self.passer_height = height

    @property
    def now(self) -> float:
        return len(self.frames) / self.rate

    def add(self, picture: np.ndarray) -> None:
        y, x = self.rng.integers(0, 64, 2)
        noise = self.pool[y : y + self.size[0], x : x + self.size[1]]
        gain = 1 + self.drift * self.now
        self.frames.append(cv2.addWeighted(picture, gain, noise, self.noise, 0, dtype=cv2.CV_8U))

    def hold(self, picture, seconds: float) -> tuple[float, float]:
        start = self.now
        for _ in range(round(seconds * self.rate)):
            self.add(picture)
        return start, self.now

    def ramp(self, picture_at, seconds: float) -> None:
        count = max(1, round(seconds * self.rate))
        for step in range(1, count):
            self.add(picture_at(step / count))

    def cross(self, before, after, rows, seconds: float) -> None:
        """Somebody passes through these rows, behind whom `before` becomes `after`."""
        width, color = self.size[1], self.rng.uniform(10, 220, 3)

        def picture_at(share):
            there = (before if share < 0.5 else after).copy()
            start = (
                int(share * 1.9 * width - 0.9 * width)
                if rows == self.across
                else int(share * 1.2 * width) - width // 5
            )
            long = int(0.9 * width) if rows == self.across else width // 5
            there[rows[0] : rows[1], max(start, 0) : max(start + long, 0)] = color
            return there

        self.ramp(picture_at, seconds)

    def passes(self, picture) -> bool:
        """Somebody crosses outside the target, if there is room."""
        if not self.free:
            return False
        row = self.free[int(self.rng.integers(len(self.free)))]
        self.cross(picture, picture, (row, row + self.passer_height), float(self.rng.uniform(0.5, 1.2)))
        return True

    def change(self, before, after) -> str:
        """One view becomes the next."""
        kind = str(self.rng.choice(["fade", "hand", "cut"]))
        if kind == "fade":
            self.ramp(lambda share: (1 - share) * before + share * after, float(self.rng.uniform(0.4, 1.2)))
        elif kind == "hand":
            self.cross(before, after, self.across, float(self.rng.uniform(0.6, 1.2)))
        else:
            self.passes(before)
        return kind


def make_fault_clip(seed: int, stills, folder: Path, fault: str | None, size=None) -> FaultClip:
    """A clip of one of `stills`, [(pictures (H, W, 3), mask (H, W) bool)], scaled to `size` (height, width)."""
    rng = np.random.default_rng(seed)
    size = size or SIZES[int(rng.choice(len(SIZES), p=(0.45, 0.45, 0.1)))]
    pictures, mask = stills[int(rng.integers(len(stills)))]
    shown = distinct(pictures, mask, rng, int(rng.integers(3, 6)))
    shown = [at_size(picture, size).astype(np.float32) for picture in shown]
    mask = at_size(mask.astype(np.uint8) * 255, size) > 127
    film = Film(size, rng, mask)
    clip = FaultClip(folder / f"{seed}.mp4", mask, fault)
    place = int(rng.integers(1, len(shown))) if fault else None
    told = [f"{size[1]}x{size[0]} noise {film.noise:.1f} drift {film.drift:+.3f} rate {film.rate:.0f}"]
    before, offset = shown[0], 0.0
    _good_view(film, clip, before)
    for number in range(1, len(shown)):
        view = shown[number]
        if number == place:
            spoiled, text, offset = _spoil(film, fault, shown[number - 1], view)
            told.append(text)
            if fault == "unchanged":
                view = shown[number - 1]
            if fault == "moved" and rng.random() < 0.4:  # in the middle of a still view
                told.append(f"to it {film.change(before, view)}, nudged in the middle")
                _good_view(film, clip, view, passing=False)
            else:
                told.append(film.change(before, spoiled))
            if fault == "blurred" and rng.random() < 0.4:
                told.append("gradually")
                film.hold(view, 0.2)
                film.ramp(lambda share, view=view, spoiled=spoiled: (1 - share) * view + share * spoiled, 0.6)
            clip.spoiled = film.hold(spoiled, float(rng.uniform(1.2, 2.0)))
            before = spoiled
        else:
            view = pushed(view, offset) if offset else view
            film.change(before, view)
            if not offset:
                _good_view(film, clip, view)
            else:
                film.hold(view, float(rng.uniform(1.0, 2.0)))
            before = view
    codec = str(rng.choice(CODECS))
    clip.path = write_film(film.frames, film.rate, clip.path, codec)
    clip.made = ", ".join([*told, codec])
    return clip


def _good_view(film: Film, clip: FaultClip, picture, passing=True) -> None:
    held = film.hold(picture, float(film.rng.uniform(1.0, 2.0)))
    clip.views.append(held)
    clip.good.append(held)
    if passing and film.rng.random() < 0.3 and film.passes(picture):
        clip.good.append(film.hold(picture, float(film.rng.uniform(0.6, 1.2))))


def _spoil(film: Film, fault: str, before, view) -> tuple[np.ndarray, str, float]:
    """The view with the fault, what it is, and by how many pixels the camera stays away from where it was."""
    rng, larger = film.rng, max(1.0, film.size[1] / 640)
    if fault == "moved":
        sign = float(rng.choice([-1, 1]))
        return pushed(view, 3.0 * sign), f"nudge {3 * sign:+.0f}", 3.0 * sign if rng.random() < 0.5 else 0.0
    if fault == "blurred":
        sigma = float(rng.uniform(1.5, 3.0)) * larger
        return cv2.GaussianBlur(view, (0, 0), sigma), f"defocus {sigma:.1f}", 0.0
    if fault == "over_exposed":
        gain = float(rng.uniform(1.6, 2.6))
        return np.clip(view * gain, 0, 255), f"gain {gain:.2f}", 0.0
    return before, "no change", 0.0


def write_film(frames, rate: float, path: Path, codec: str) -> Path:
    """Frames (H, W, 3) uint8 RGB as a file: H.264 by ffmpeg, where that is installed, else what OpenCV writes."""
    height, width = frames[0].shape[:2]
    if codec == "h264" and shutil.which("ffmpeg"):
        command = f"ffmpeg -loglevel error -y -f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate:g} -i -"
        command += " -c:v libx264 -preset superfast -threads 1 -crf 24 -pix_fmt yuv420p"
        subprocess.run([*command.split(), str(path)], input=b"".join(f.tobytes() for f in frames), check=True)
        return path
    path, code = (path.with_suffix(".avi"), "MJPG") if codec == "mjpeg" else (path, "mp4v")
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), rate, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    return path
