"""A capture on its way: frames come in, the coach judges them, photos go into groups of a raw tree."""

import re
import shlex
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gift_peft.captures.clip import CLIP_SUFFIXES, Clip, ClipFrame, write_frame
from gift_peft.images import open_image, to_mask
from gift_peft.prepare.coach import Advice, Coach
from gift_peft.rules import check_group_id

ASK = "Now spray or cover the surface without touching the camera, then press Enter; q and Enter to end."
MAX_SILENCE = 5.0  # seconds without a frame, after which a camera counts as gone


@dataclass(frozen=True)
class Source:
    """Where frames come from: `clip`, or a live `device`, a camera's number or a stream's address."""

    clip: Clip | None = None
    device: int | str | None = None

    @property
    def live(self) -> bool:
        return self.clip is None

    def frames(self) -> Iterator[ClipFrame]:
        """Frames with their times. ValueError: the camera cannot be opened, or gives no picture."""
        return self.clip.frames() if self.clip is not None else self._live()

    def _live(self) -> Iterator[ClipFrame]:
        called = f"camera {self.device}" if isinstance(self.device, int) else str(self.device)
        capture = cv2.VideoCapture(self.device)
        if not capture.isOpened():
            hint = "plug it in, close other programs that use it, or name another number"
            if isinstance(self.device, str):
                hint = "check the address and the network"
            raise ValueError(f"{called}: cannot be opened; {hint}")
        start = last = time.monotonic()
        index = 0
        try:
            while time.monotonic() - last < MAX_SILENCE:
                there, pixels = capture.read()
                if not there:
                    time.sleep(0.05)
                    continue
                last = time.monotonic()
                yield ClipFrame(index, last - start, pixels)
                index += 1
        finally:
            capture.release()
        if not index:
            raise ValueError(f"{called}: opened, and gives no picture; close other programs that use it")


def open_source(text: str) -> Source:
    """The source of this name; FileNotFoundError or ValueError if it is a clip that cannot be opened."""
    if text.isdecimal():
        return Source(device=int(text))
    if re.match(r"[a-zA-Z][a-zA-Z0-9+.-]*://", text):
        return Source(device=text)
    if not Path(text).is_file():
        raise FileNotFoundError(
            f"{text}: neither a camera's number, a stream's address nor a clip ({', '.join(sorted(CLIP_SUFFIXES))})"
        )
    return Source(clip=Clip(text))


class Session:
    """Photos of one stream.

    Args:
        out (`Path`): the raw tree.
        group (`str`, *optional*): the group's name; default the next free `group_N`.
        mask (`str`, *optional*): file of the target's mask.
        most (`int`): photos of a group.
        reference_at (`float`, *optional*): seconds, when the treated surface is shown.
        asks (`bool`): whether there is a person to ask for the reference.

    Raises ValueError or FileNotFoundError naming the file or group.
    """

    def __init__(
        self, out: Path, group: str | None, mask: str | None, most: int, reference_at: float | None, asks: bool
    ) -> None:
        if out.exists() and not out.is_dir():
            raise ValueError(f"OUT {out}: not a folder")
        self.out, self.reference_at, self.asks = out, reference_at, asks
        self.name = self._free_name(group)
        self.mask = None if mask is None else to_mask(open_image(mask), mask)
        if self.mask is not None and not self.mask.any():
            raise ValueError(f"{mask}: the mask is empty; draw the target in white")
        self.coach = Coach(self.mask, most)
        self.advice = Advice()
        self.groups: dict[str, int] = {}
        self.number = 1
        self.ended = False
        self.asked = False
        self.frames, self.seconds = 0, 0.0
        self._said: frozenset[str] = frozenset()

    @property
    def folder(self) -> Path:
        name = self.name if self.number == 1 else f"{self.name}__{self.number}"
        return self.out / name

    @property
    def photos(self) -> int:
        return self.groups.get(self.folder.name, 0)

    @property
    def status(self) -> str:
        """One line for a terminal."""
        advice = self.advice
        drift = "-" if advice.drift is None else f"{advice.drift:.1f} px"
        sharp = "-" if advice.sharpness is None else f"{advice.sharpness:.0%}"
        parts = [
            "still " if advice.still else "moving",
            f"drift {drift}",
            f"sharp {sharp}",
            f"white {advice.bright:.0%}",
            f"black {advice.dark:.0%}",
            f"changed {advice.changed:.0%}",
            f"{self.photos} photos",
            *(item.code.replace("_", " ").upper() for item in advice.warnings),
        ]
        return " | ".join(parts)

    def see(self, frame: ClipFrame, typed: str | None = None) -> list[str]:
        """Look at a frame and keep a photo if one is due; what is to be said. OSError: the photo cannot be written."""
        said = self._listen(typed)
        self.frames, self.seconds = self.frames + 1, frame.seconds
        if self.reference_at is not None and frame.seconds >= self.reference_at:
            self.reference_at = None
            self.coach.ask_reference()
        self.advice = self.coach.see(frame.index, frame.seconds, frame.pixels)
        if self.advice.new_group:
            if self.photos:
                self.number += 1
            said.append(f"{frame.seconds:7.1f} s  the camera stays where it is now: the next photos are a new group")
        said += self._warn(frame.seconds)
        if self.advice.photo is not None:
            said.append(f"{frame.seconds:7.1f} s  {self._keep(self.advice)}")
        if self.advice.enough and not self.asked and self.reference_at is None:
            self.asked = True
            said.append(f"{frame.seconds:7.1f} s  enough: more photos add nothing")
            if self.asks:
                said.append(ASK)
        return said

    def finish(self, source: str) -> list[str]:
        """What there is now, and the command to type next. ValueError: no photo was taken."""
        if not self.groups:
            raise ValueError(
                f"{source}: no photo was taken in {self.seconds:.1f} s ({self.frames} frames); hold camera and scene "
                "still for a second after each change"
            )
        lines = [f"{self.out / name}: {count} photos" for name, count in self.groups.items()]
        if self.mask is None:
            lines.append(
                f"Draw the target in {self.out / next(iter(self.groups))}/mask.png, white where the glass is."
            )
        return [*lines, f"Next: {shlex.join(['gift-peft', 'prepare', str(self.out), f'{self.out}-prepared'])}"]

    def _free_name(self, group: str | None) -> str:
        if group is None:
            taken = [path.name for path in self.out.iterdir()] if self.out.is_dir() else []
            numbers = [int(found[1]) for name in taken if (found := re.match(r"group_(\d+)", name))]
            return f"group_{max(numbers, default=0) + 1}"
        check_group_id(group)
        if (self.out / group).exists():
            raise ValueError(f"{self.out / group}: it is there already; name another group (--group)")
        return group

    def _listen(self, typed: str | None) -> list[str]:
        if typed is None:
            return []
        if typed.lower() in ("q", "quit"):
            self.ended = True
            return []
        if not self.photos:
            return ["no photo yet; q and Enter to end"]
        if not self.asked:
            self.asked = True
            return [ASK]
        self.coach.ask_reference()
        return ["the next still moment is the treated reference"]

    def _warn(self, seconds: float) -> list[str]:
        """The warnings that were not there a frame ago."""
        there = frozenset(item.code for item in self.advice.warnings)
        new = [item.text for item in self.advice.warnings if item.code not in self._said]
        self._said = there
        return [f"{seconds:7.1f} s  {text}" for text in new]

    def _keep(self, advice: Advice) -> str:
        if advice.is_reference:
            path = self.folder / "reference.png"
            self.ended = self.asks
        else:
            path = self.folder / f"{self.photos + 1:03d}.png"
        if not self.photos and self.mask is not None:
            write_frame(self.folder / "mask.png", self._mask_here())
        write_frame(path, advice.photo)
        if not advice.is_reference:
            self.groups[self.folder.name] = self.photos + 1
        what = "target" if self.mask is not None else "picture"
        return f"photo {path}, {advice.changed:.0%} of the {what} changed so far"

    def _mask_here(self) -> np.ndarray:
        """(H, W) uint8: the mask where the camera now sees it."""
        mask = self.mask.astype(np.uint8) * 255
        if np.array_equal(self.coach.matrix, np.eye(3)):
            return mask
        return cv2.warpPerspective(mask, self.coach.matrix, mask.shape[::-1], flags=cv2.INTER_NEAREST)
