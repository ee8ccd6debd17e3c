"""Clips made of still pictures: held, faded, crossed by somebody, by a camera that is pushed, with noise and drift."""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from helpers.photos import scene, target

RATE = 15.0


@dataclass
class Making:
    """A clip on its way: `add` appends frames; `holds` are the first and last frame of each still view."""

    size: tuple[int, int]  # height, width
    seed: int = 0
    noise: float = 2.0
    drift: float = 0.0  # gain per second
    frames: list[np.ndarray] = field(default_factory=list)
    holds: list[tuple[int, int]] = field(default_factory=list)
    busy: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)

    def add(self, picture: np.ndarray) -> None:
        gain = 1 + self.drift * len(self.frames) / RATE
        noisy = picture * gain + self.rng.normal(0, self.noise, picture.shape)
        self.frames.append(np.clip(np.round(noisy), 0, 255).astype(np.uint8))

    def hold(self, picture: np.ndarray, seconds: float = 1.0) -> None:
        first = len(self.frames)
        for _ in range(round(seconds * RATE)):
            self.add(picture)
        self.holds.append((first, len(self.frames) - 1))

    def fade(self, before: np.ndarray, after: np.ndarray, seconds: float = 0.6) -> None:
        first, count = len(self.frames), round(seconds * RATE)
        for step in range(1, count):
            share = step / count
            self.add((1 - share) * before + share * after)
        self.busy.append((first, len(self.frames) - 1))

    def cross(self, picture: np.ndarray, rows: tuple[int, int], seconds: float = 1.0) -> None:
        """Something dark passes through these rows from left to right."""
        first, count, width = len(self.frames), round(seconds * RATE), self.size[1]
        for step in range(count):
            there, start = picture.copy(), int((step + 1) / (count + 1) * (1.2 * width) - 0.2 * width)
            there[rows[0] : rows[1], max(start, 0) : max(start + width // 5, 0)] = (60, 50, 40)
            self.add(there)
        self.busy.append((first, len(self.frames) - 1))

    def write(self, path: Path, codec: str = "mp4v") -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), RATE, self.size[::-1])
        assert writer.isOpened()
        for frame in self.frames:
            writer.write(frame[..., ::-1])
        writer.release()
        return path


def views(seed: int, size: tuple[int, int], count: int) -> tuple[list[np.ndarray], np.ndarray]:
    """`count` pictures of one scene with other contents of its target, and the target's mask."""
    picture, mask = scene(seed, size), target(seed, size)
    contents = [scene(1000 * seed + index + 1, size) for index in range(count)]
    return [np.where(mask[..., None], content, picture) for content in contents], mask


def pushed(picture: np.ndarray, pixels: float) -> np.ndarray:
    """As a camera sees it that was pushed aside by so many pixels."""
    height, width = picture.shape[:2]
    matrix = np.array([[1, 0, pixels * 0.8], [0, 1, pixels * 0.6]])
    return cv2.warpAffine(picture, matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
