"""One picture of a group on its way through `group.py`: its pixels, its mask, the map that registers it, and its entry
in the report.
"""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from gift_peft.prepare.entries import FrameEntry, Remark
from gift_peft.prepare.matching import Frame, Picture
from gift_peft.prepare.quality import SmallFrame
from gift_peft.prepare.registration import Registration, valid_area, warp
from gift_peft.prepare.settings import RegistrationSettings


class Rejection(Exception):
    """Ends the work on a group; carries the reason."""

    def __init__(self, code: str, text: str):
        super().__init__(text)
        self.reason = Remark(code, text)


@dataclass
class Photo:
    """One picture of a group, an observation or the treated reference.

    Args:
        entry (`FrameEntry`): its part of the report, which says whether it is dropped or warped.
        source (`Path`): its file, which is copied if the pixels stay as they are.
        pixels (`np.ndarray`): (H, W, 3) uint8.
        mask (`np.ndarray`, *optional*): (H, W) bool, as drawn or proposed.
        matrix (`np.ndarray`, *optional*): (3, 3), to the target frame; None if registration dropped it.
    """

    entry: FrameEntry
    source: Path
    pixels: np.ndarray
    mask: np.ndarray | None
    matrix: np.ndarray | None = None
    _seen: Picture | None = field(default=None, init=False, repr=False)

    @property
    def dropped(self) -> bool:
        return self.entry.status == "dropped"

    @property
    def warped(self) -> bool:
        return self.entry.status == "warped"

    @property
    def map(self) -> np.ndarray:
        """(3, 3): from its pixels to the target frame's, once it is registered."""
        return self.matrix if self.warped else np.eye(3)

    @property
    def gray(self) -> np.ndarray:
        return cv2.cvtColor(self.pixels, cv2.COLOR_RGB2GRAY)

    @property
    def picture(self) -> Path | Image.Image:
        """What is written: the file as it is, or the warped pixels."""
        return Image.fromarray(self.registered(self.pixels)) if self.warped else self.source

    def frame(self, target: np.ndarray | None, settings: RegistrationSettings, again: bool) -> Frame:
        """As registration sees it, with a `target` (H, W) bool; `again`: it will be registered once more."""
        frame = Frame(self.pixels, target, settings, self._seen)
        self._seen = frame.picture if again else None  # not the frame: it holds 8 bytes more per pixel
        return frame

    def decide(self, result: Registration) -> None:
        entry, self.matrix = self.entry, result.matrix
        entry.status, entry.reasons, entry.warnings = result.status, result.reasons, result.warnings
        entry.registration = result.figures

    def registered(self, array: np.ndarray) -> np.ndarray:
        """The picture, its mask or another map of it as the target frame's camera sees it."""
        return warp(array, self.matrix) if self.warped else array

    @cached_property
    def valid(self) -> np.ndarray:
        """(H, W) bool: where it has pixels once it is registered. Ask for it after that."""
        height, width = self.pixels.shape[:2]
        return valid_area(self.matrix, (width, height)) if self.warped else np.ones((height, width), bool)

    def small(self, mask: np.ndarray) -> SmallFrame:
        """For comparisons; `mask` (H, W) bool is registered."""
        return SmallFrame(cv2.cvtColor(self.registered(self.pixels), cv2.COLOR_RGB2GRAY), mask, self.valid)
