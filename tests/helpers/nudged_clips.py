"""Clips with a camera that is nudged, or shaken and comes back, or never touched: known poses, known views.

`make_nudged_clip` draws everything from its seed: how far the camera is pushed, turned and zoomed, how quickly, what
is shown before and after, who passes meanwhile, and what `fault_clips.Film` has: noise, rate, drift of the light.
"""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from helpers.clip_stills import at_size, distinct
from helpers.fault_clips import CODECS, Film, write_film

KINDS = ("nudge", "two nudges", "nudge and passer", "same view", "shake", "none")
SMALL, LARGE = (270, 480), (720, 1280)
LEAST, MOST = 1.5, 20.0  # pixels of the frame, mean over the picture
SHORTEST, LONGEST = 0.8, 1.8  # seconds that a view stands


@dataclass
class NudgedClip:
    """A clip and the truth about it; numbers of frames, both ends included.

    Args:
        path (`Path`): the file.
        mask (`np.ndarray`): (H, W) bool, the target in the first pose.
        kind (`str`): one of KINDS.
        views (`dict`): (pose, content) to the stretches in which it stands still.
        busy (`list`): stretches in which something moves.
        poses (`int`): how many there are.
        made (`str`): what was drawn.
    """

    path: Path
    mask: np.ndarray
    kind: str
    views: dict[tuple[int, int], list[tuple[int, int]]] = field(default_factory=dict)
    busy: list[tuple[int, int]] = field(default_factory=list)
    poses: int = 1
    frames: int = 0
    made: str = ""

    def pose_at(self, index: int) -> int | None:
        """The pose in which this frame stands still."""
        for (pose, _), stretches in self.views.items():
            if any(first <= index <= last for first, last in stretches):
                return pose
        return None


def judge(clip: NudgedClip, groups: list[list[int]]) -> tuple[bool, int, int]:
    """Whether the groups of frame numbers are the poses; how many views were found; frames while something moved."""
    flat = [index for group in groups for index in group]
    found = sum(
        any(first <= index <= last for index in flat for first, last in stretches) for stretches in clip.views.values()
    )
    mixed = sum(any(first <= index <= last for first, last in clip.busy) for index in flat)
    of_groups = [{clip.pose_at(index) for index in group} - {None} for group in groups]
    return of_groups == [{pose} for pose in range(clip.poses)], found, mixed


class _Camera:
    """Films pictures from where it stands."""

    def __init__(self, film: Film, clip: NudgedClip) -> None:
        self.film, self.clip = film, clip
        self.matrix = np.eye(3)

    def sees(self, picture: np.ndarray, matrix: np.ndarray | None = None) -> np.ndarray:
        matrix = self.matrix if matrix is None else matrix
        if np.array_equal(matrix, np.eye(3)):
            return picture
        size = picture.shape[1::-1]
        return cv2.warpAffine(picture, matrix[:2], size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)

    def hold(self, content: int, picture: np.ndarray, seconds: float | None = None) -> None:
        first = len(self.film.frames)
        self.film.hold(self.sees(picture), seconds or float(self.film.rng.uniform(SHORTEST, LONGEST)))
        self.clip.views.setdefault((self.clip.poses - 1, content), []).append((first, len(self.film.frames) - 1))

    def busy(self, doing) -> None:
        first = len(self.film.frames)
        doing()
        if len(self.film.frames) > first:
            self.clip.busy.append((first, len(self.film.frames) - 1))

    def nudge(self, before: np.ndarray, after: np.ndarray, passer: bool) -> str:
        """Pushed, turned and zoomed a little, within a frame or in half a second; the target's content may change."""
        rng, (height, width) = self.film.rng, self.film.size
        pixels, heading = np.exp(rng.uniform(np.log(LEAST), np.log(MOST))), rng.uniform(0, 2 * np.pi)
        turn, zoom = np.deg2rad(rng.normal(0, 0.03)) * pixels**0.7, 1 + rng.normal(0, 0.0003) * pixels**0.7
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        linear = zoom * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        x, y = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9))
        grid = np.stack([x.ravel(), y.ravel()], 1) - middle
        away = grid @ linear.T - grid
        direction = np.array([np.cos(heading), np.sin(heading)])
        length = pixels  # such that the mean over the picture is what was drawn
        for _ in range(20):
            length *= pixels / np.linalg.norm(away + length * direction, axis=1).mean()
        step = np.eye(3)
        step[:2, :2], step[:2, 2] = linear, middle + length * direction - linear @ middle
        start, end = self.matrix, step @ self.matrix
        seconds = float(rng.choice([0.0, rng.uniform(0.1, 0.5)]))
        row = self.film.free[int(rng.integers(len(self.film.free)))] if passer and self.film.free else None

        def picture_at(share):
            moving = [
                self.sees(after if share > 0.5 else before, start + (end - start) * at)
                for at in np.clip([share - 0.1, share, share + 0.1], 0, 1)
            ]
            picture = np.mean(moving, axis=0, dtype=np.float32)
            if row is not None:
                left = int(share * 1.2 * width) - width // 5
                picture[row : row + self.film.passer_height, max(left, 0) : max(left + width // 5, 0)] = 60
            return picture

        self.busy(lambda: self.film.ramp(picture_at, max(seconds, 0.7 if row is not None else 0)))
        self.matrix = end
        self.clip.poses += 1
        return f"nudge {pixels:.1f} px turn {np.rad2deg(turn):+.2f} zoom {zoom:.4f} in {seconds:.1f} s"

    def shake(self, picture: np.ndarray) -> str:
        """Somebody stamps on the floor: the camera swings and comes to rest where it was."""
        rng = self.film.rng
        pixels, heading, swing = rng.uniform(2, 12), rng.uniform(0, 2 * np.pi), rng.uniform(3, 7)
        seconds = float(rng.uniform(0.4, 1.0))

        def picture_at(share):
            there = self.matrix.copy()
            away = pixels * np.exp(-4 * share) * np.sin(2 * np.pi * swing * share * seconds)
            there[:2, 2] += away * np.array([np.cos(heading), np.sin(heading)])
            return self.sees(picture, there)

        self.busy(lambda: self.film.ramp(picture_at, seconds))
        return f"shake {pixels:.1f} px for {seconds:.1f} s"


def _mirror(stills, rng: np.random.Generator) -> tuple[list[np.ndarray], np.ndarray]:
    """One of the pictures with a mirror of a third to two thirds of it, in which the others show."""
    pictures = [stills[place][0][0] for place in rng.permutation(len(stills))[:8]]
    height, width = pictures[0].shape[:2]
    side = np.sqrt(rng.uniform(0.33, 0.67))
    high, wide = round(side * height), round(side * width)
    top, left = int(rng.integers(0, height - high + 1)), int(rng.integers(0, width - wide + 1))
    mask = np.zeros((height, width), bool)
    mask[top : top + high, left : left + wide] = True
    others = [np.roll(picture[:, ::-1], int(rng.integers(width)), axis=1) for picture in pictures[1:]]
    return [np.where(mask[..., None], other, pictures[0]) for other in others], mask


def make_nudged_clip(seed: int, stills, folder: Path, mirror: bool = False) -> NudgedClip:
    """A clip of one of `stills`, [(pictures (H, W, 3), mask (H, W) bool)]; of six kinds in turn, one in eight 720p.

    With `mirror`, the target is much of the picture.
    """
    rng = np.random.default_rng(seed)
    size, kind = (LARGE if rng.random() < 0.125 else SMALL), KINDS[seed % len(KINDS)]
    pictures, mask = _mirror(stills, rng) if mirror else stills[int(rng.integers(len(stills)))]
    shown = distinct(pictures, mask, rng, int(rng.integers(3, 6)))
    shown = [at_size(picture, size).astype(np.float32) for picture in shown]
    mask = at_size(mask.astype(np.uint8) * 255, size) > 127
    film = Film(size, rng, mask)
    clip = NudgedClip(folder / f"{seed}.mp4", mask, kind)
    camera = _Camera(film, clip)
    told = [f"{kind}: {size[1]}x{size[0]} noise {film.noise:.1f} drift {film.drift:+.3f} rate {film.rate:.0f}"]
    count = {"none": 0, "shake": 0, "two nudges": 2}.get(kind, 1)
    nudged = set(rng.choice(np.arange(1, len(shown)), min(count, len(shown) - 1), replace=False).tolist())
    shaken = int(rng.integers(len(shown))) if kind == "shake" else None
    camera.hold(0, shown[0])
    for number, view in enumerate(shown):
        if number in nudged:
            before = shown[number - 1]
            told.append(camera.nudge(before, before if kind == "same view" else view, kind == "nudge and passer"))
            if kind == "same view":
                camera.hold(number - 1, before)
        if number and (number not in nudged or kind == "same view"):
            before, after = camera.sees(shown[number - 1]), camera.sees(view)
            camera.busy(lambda before=before, after=after: told.append(film.change(before, after)))
        if number:
            camera.hold(number, view)
        if number == shaken:
            told.append(camera.shake(view))
            camera.hold(number, view)
        elif rng.random() < 0.3:
            seen = camera.sees(view)
            camera.busy(lambda seen=seen: film.passes(seen))
            camera.hold(number, view)
    codec, clip.frames = str(rng.choice(CODECS)), len(film.frames)
    clip.path = write_film(film.frames, film.rate, clip.path, codec)
    clip.made = ", ".join([*told, codec])
    return clip
