"""A capture on its way: frames come in, the coach judges them, photos go into groups of a raw tree."""

import re
import shlex
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gift_peft.captures.clip import CLIP_SUFFIXES, Clip, ClipFrame, find_clips, write_frame
from gift_peft.captures.folders import files_below
from gift_peft.captures.live import live_frames
from gift_peft.captures.tree import find_groups
from gift_peft.images import is_image_file, open_image, to_mask
from gift_peft.prepare.coach import Advice, Coach
from gift_peft.rules import SPLITS, check_group_id

ENOUGH = "enough: more photos add nothing"
TREAT = "now spray or cover the surface without touching the camera, then type r and Enter; q and Enter ends"


@dataclass(frozen=True)
class Source:
    """Where frames come from: a `clip`, or else a live `device`, a camera's number or a stream's address."""

    name: str
    clip: Clip | None = None
    device: int | str = 0

    def frames(self) -> Generator[ClipFrame, None, None]:
        """Frames with their times. ValueError: nothing can be read."""
        return live_frames(self.device) if self.clip is None else self.clip.frames()


def open_source(text: str) -> Source:
    """The source of this name; FileNotFoundError or ValueError if it is none, or a clip that cannot be opened."""
    if text.isdecimal() and len(text) < 10 and not Path(text).exists():  # OpenCV numbers devices by 32 bits
        return Source(text, device=int(text))
    if re.match(r"[a-zA-Z][a-zA-Z0-9+.-]*://", text):
        return Source(text, device=text)
    path = Path(text)
    if path.suffix.lower() in CLIP_SUFFIXES or path.is_file():
        return Source(text, clip=Clip(path))
    raise ValueError(f"{text}: neither a camera's number (0), nor a stream's address (rtsp://...), nor a clip")


def check_tree(out: Path) -> None:
    """Raise ValueError unless a group may be put into this folder: it is absent, empty, or a raw tree."""
    if out.exists() and not out.is_dir():
        raise ValueError(f"OUT {out} is a file: name a folder")
    if not out.is_dir() or not any(out.iterdir()):
        return
    for split in SPLITS:
        if (out / split).is_dir() and not (out / split / "metadata.parquet").exists():
            raise ValueError(f"OUT {out} has a folder {split}: name one of its splits, as {out / split}")
    try:
        folders = [folder for found in find_groups(out).values() for folder in found]
    except FileNotFoundError:
        folders = []
    files = [list(files_below(folder)) for folder in folders]
    if not files or not all(any(map(is_image_file, found)) or find_clips(found) for found in files):
        raise ValueError(f"OUT {out} holds something else than groups of photos: name another folder")


class Session:
    """Photos of one stream.

    Args:
        out (`Path`): the raw tree.
        group (`str`, *optional*): the group's name; default the next free `group_N`.
        mask (`str`, *optional*): file of the target's mask.
        most (`int`): photos of a group.
        reference_at (`float`, *optional*): seconds, when the treated surface is shown.
        asks (`bool`): whether there is a person to ask for the reference.

    Raises ValueError or an OSError naming the file or group.
    """

    def __init__(
        self, out: Path, group: str | None, mask: str | None, most: int, reference_at: float | None, asks: bool
    ) -> None:
        check_tree(out)
        self.out, self.reference_at, self.asks = out, reference_at, asks
        self.mask_file = mask
        self.mask = None if mask is None else to_mask(open_image(mask), mask)
        if self.mask is not None and not self.mask.any():
            raise ValueError(f"{mask}: the mask is empty; draw the target in white")
        self.name = self._free_name(group)
        self.folder = out / self.name
        self.coach = Coach(self.mask, most)
        self.advice = Advice()
        self.photos: dict[Path, int] = {}  # of each group
        self.references: list[Path] = []
        self.ended = False
        self.frames, self.seconds = 0, 0.0
        self.size: tuple[int, int] | None = None  # (height, width) of the frames
        self._reference_due = self._said_enough = False
        self._said: frozenset[str] = frozenset()

    @property
    def status(self) -> str:
        """One line for a terminal."""
        advice = self.advice
        drift = "-" if advice.drift is None else f"{advice.drift:.1f} px"
        sharp = "-" if advice.sharpness is None else f"{advice.sharpness:.0%}"
        parts = [
            f"{self.seconds:.0f} s",
            "still " if advice.still else "moving",
            f"drift {drift}",
            f"sharp {sharp}",
            f"white {advice.bright:.0%}",
            f"black {advice.dark:.0%}",
            f"changed {advice.changed:.0%}",
            f"{self.photos.get(self.folder, 0)} photos",
            *(item.code.replace("_", " ").upper() for item in advice.warnings),
        ]
        return " | ".join(parts)

    def see(self, frame: ClipFrame, typed: str | None = None) -> list[str]:
        """Look at a frame and keep a photo if one is due; what is to be said.

        Raises OSError if the photo cannot be written, ValueError if frame and mask are not of one size.
        """
        said = self._listen(typed)
        if self.ended:
            return []
        self.frames, self.seconds = self.frames + 1, frame.seconds
        size = frame.pixels.shape[:2]
        if self.size not in (None, size):
            self.ended = True
            (height, width), (old_height, old_width) = size, self.size
            text = f"the frames are {width}x{height} now, and were {old_width}x{old_height}: nothing more is taken"
            return [f"{frame.seconds:7.1f} s  {text}"]
        self.size = size
        if self.reference_at is not None and not self._reference_due and frame.seconds >= self.reference_at:
            if self.folder not in self.photos:
                raise ValueError(
                    f"--reference-at: no photo was taken in {self.folder} before that time; the reference comes last, "
                    "when the surface is treated"
                )
            self._reference_due = True
            self.coach.ask_reference()
        try:
            self.advice = self.coach.see(frame.index, frame.seconds, frame.pixels)
        except ValueError as error:
            raise ValueError(f"{self.mask_file}: {error}") from None
        if self.advice.new_group:
            self.folder, self._said_enough = self._next_folder(), False
            said.append(f"the camera stays where it is now: the next photos are a new group, {self.folder}")
        codes = self.advice.codes
        said += [item.text for item in self.advice.warnings if item.code not in self._said]
        self._said = codes
        if self.advice.photo is not None:
            said.append(self._keep(self.advice))
        if self.advice.enough and not self._said_enough:
            self._said_enough = True
            said.append(ENOUGH)
            said += [TREAT] if self.asks else []
        return [f"{frame.seconds:7.1f} s  {text}" for text in said]

    def finish(self, source: str) -> list[str]:
        """What there is now, and the command to type next.

        Raises ValueError: no photo was taken, or not the reference of `reference_at`.
        """
        if not self.photos:
            raise ValueError(
                f"{source}: no photo was taken in {self.seconds:.1f} s ({self.frames} frames); hold camera and scene "
                "still for a second after each change"
            )
        if self.reference_at is not None and not self.references:
            raise ValueError(
                f"{source}: no treated reference was taken: no still, sharp moment after the time that was asked for; "
                f"the photos are kept in {', '.join(map(str, self.photos))}"
            )
        lines = []
        for folder, count in self.photos.items():
            told = f"{folder}: {count} photo{'s' if count > 1 else ''}"
            if folder / "reference.png" in self.references:
                told += " and the treated reference"
            elif count == 1:
                told += ", too few for a group: add another to the folder, or delete it"
            lines.append(told)
        if self.coach.wanted == "reference":
            lines.append("The treated reference was asked for and not taken.")
        if self.mask is None:
            place = next(iter(self.photos)) / "mask.png"
            lines.append(f"Draw the target in {place}, white where the glass or mirror is.")
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

    def _next_folder(self) -> Path:
        number = 2
        while (folder := self.out / f"{self.name}__{number}").exists():
            number += 1
        return folder

    def _listen(self, typed: str | None) -> list[str]:
        if typed is None:
            return []
        word = typed.casefold()
        if word in ("q", "quit"):
            self.ended = True
            return []
        if word in ("r", "reference"):
            if self.folder not in self.photos:
                return ["take a photo first, then the reference"]
            self.coach.ask_reference()
            return ["the next still moment is the treated reference"]
        if word:
            return [f"{typed!r} is not known: Enter takes a photo, r the treated reference, q ends"]
        self.coach.ask_photo()
        return ["the next still moment is a photo"]

    def _keep(self, advice: Advice) -> str:
        count = self.photos.get(self.folder, 0)
        path = self.folder / ("reference.png" if advice.is_reference else f"{count + 1:03d}.png")
        if not count and self.mask is not None:
            write_frame(self.folder / "mask.png", self.coach.mask_here.astype(np.uint8) * 255)
        write_frame(path, advice.photo)
        if advice.is_reference:
            self.references.append(path)
            self.ended = True
            return f"treated reference {path}"
        self.photos[self.folder] = count + 1
        what = "target" if self.mask is not None else "picture"
        return f"photo {path}, {advice.changed:.0%} of the {what} changed so far"
