"""A capture on its way: frames come in, the coach judges them, photos go into groups of a raw tree."""

import errno
import itertools
import os
import re
import unicodedata
from collections.abc import Generator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gift_peft.captures.clip import CLIP_SUFFIXES, Clip, ClipFrame, find_clips, prepare_line, write_frame
from gift_peft.captures.folders import files_below, holds_no_photos
from gift_peft.captures.live import live_frames
from gift_peft.captures.tree import find_groups
from gift_peft.files import is_leftover, printable
from gift_peft.images import is_image_file, open_image, to_mask
from gift_peft.prepare.coach import BLINK, Advice, Coach
from gift_peft.rules import SPLITS, check_group_id

PAUSE = 2.0  # seconds, as which the time counts in which a stream was closed
ENOUGH = "enough: more photos add nothing"
TREAT = "now spray or cover the surface without touching the camera, then {}"
TYPED = "type r and Enter; q and Enter ends"  # how a person at a terminal asks for the reference, and ends without


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
    """Raise ValueError unless a group may be put into this folder: it is absent, empty, or a raw tree.

    Group folders that are empty, perhaps made for photos to come, are passed over.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"OUT {out} is a file: name a folder")
    if not (there := _contents(out)):
        return
    for split in SPLITS:
        if (out / split).is_dir() and not (out / split / "metadata.parquet").exists():
            raise ValueError(f"OUT {out} has a folder {split}: name one of its splits, as {out / split}")
    if (out / "metadata.parquet").exists():
        raise ValueError(f"OUT {out} is part of a prepared folder: name a folder of photos as they were taken")
    groups = _files_of_groups(out)
    files = list(filter(None, groups.values()))
    loose = not files and any(path.is_file() for path in there)
    others = [one for one in files if not any(map(is_image_file, one)) and not find_clips(one)]
    if not groups or loose or others:
        raise ValueError(f"OUT {out} holds something else than groups of photos: name another folder")


def read_target(mask: str | None) -> np.ndarray | None:
    """The target that a file shows, (H, W) bool. Raises ValueError or an OSError naming the file."""
    target = None if mask is None else to_mask(open_image(mask), mask)
    if target is not None and not target.any():
        raise ValueError(f"{mask}: the mask is empty; draw the target in white")
    return target


def _files_of_groups(out: Path) -> dict[Path, list[Path]]:
    """What lies in each group's folder of a raw tree; nothing where there are none."""
    try:
        return {folder: list(files_below(folder)) for found in find_groups(out).values() for folder in found}
    except FileNotFoundError:
        return {}


def _contents(folder: Path) -> list[Path]:
    """What a person has put into a folder; nothing where there is none."""
    return [path for path in folder.iterdir() if not is_leftover(path.name)] if folder.is_dir() else []


def free_name(out: Path) -> str:
    """The next free `group_N`."""
    taken = [path.name for path in out.iterdir()] if out.is_dir() else []
    numbers = [int(found[1]) for name in taken if (found := re.match(r"group_(\d+)", name))]
    return f"group_{max(numbers, default=0) + 1}"


class Session:
    """Photos of one stream.

    Args:
        out (`Path`): the raw tree.
        group (`str`, *optional*): the group's name; default the next free `group_N`.
        mask (`str`, *optional*): file of the target's mask.
        most (`int`): photos of a group.
        reference_at (`float`, *optional*): seconds, when the treated surface is shown.
        asks (`str`, *optional*): how a person asks for the reference, as TYPED; None if there is nobody.

    Attributes:
        photos (`dict[Path, list[Path]]`): of each group's folder, those that were taken and not dropped.
        references (`list[Path]`).
        ended (`bool`): nothing more is taken.
        advice (`Advice`): on the last frame.

    Raises ValueError or an OSError naming the file or group.
    """

    def __init__(
        self,
        out: Path,
        group: str | None = None,
        mask: str | None = None,
        most: int = 12,
        reference_at: float | None = None,
        asks: str | None = None,
    ) -> None:
        check_tree(out)
        self.out, self.reference_at, self.asks = out, reference_at, asks
        self.mask_file, self.mask = mask, read_target(mask)
        self.name = free_name(out) if group is None else self._checked_name(group)
        self.folder = out / self.name
        self.coach = Coach(self.mask, most)
        self.advice = Advice()
        self.photos: dict[Path, list[Path]] = {}
        self.references: list[Path] = []
        self.ended = False
        self.frames, self.seconds = 0, 0.0
        self.size: tuple[int, int] | None = None  # (height, width) of the frames
        self._last_still = float("-inf")  # seconds
        self._before = 0, 0.0  # frames and seconds of streams that ended
        self._began: set[Path] = set()  # folders of groups that are ours
        self._masks: dict[Path, int] = {}  # of each group that has one of ours, when it was written
        self._reference_due = self._said_enough = False
        self._said: frozenset[str] = frozenset()

    @property
    def figures(self) -> dict[str, str]:
        """What was measured of the last frame, in words."""
        advice = self.advice
        return {
            "drift": "-" if advice.drift is None else f"{advice.drift:.1f} px",
            "sharp": "-" if advice.sharpness is None else f"{advice.sharpness:.0%}",
            "white": f"{advice.bright:.0%}",
            "black": f"{advice.dark:.0%}",
            "changed": f"{advice.changed:.0%}",
        }

    @property
    def status(self) -> str:
        """One line for a terminal."""
        parts = [
            f"{self.seconds:.0f} s",
            "still " if self.advice.still else "moving",
            *(f"{name} {value}" for name, value in self.figures.items()),
            f"{len(self.photos.get(self.folder, ()))} photos",
            *(item.code.replace("_", " ").upper() for item in self.advice.warnings),
        ]
        return " | ".join(parts)

    @property
    def next_step(self) -> str:
        """What a person does now, in one sentence."""
        advice, wanted = self.advice, self.coach.wanted
        if advice.warnings and wanted != "photo":
            text = advice.warnings[0].text
        elif wanted is not None:
            what = "the treated reference" if wanted == "reference" else "a photo"
            text = f"keep still: the next still moment is {what}"
        elif advice.enough:
            text = f"{ENOUGH}; {TREAT.format(self.asks)}" if self.asks else ENOUGH
        elif self.seconds - self._last_still > BLINK:
            text = "hold camera and scene still for a second"
        elif self.coach.waits:
            text = "change what is reflected or seen through, and step aside"
        else:
            text = "keep still: a photo is taken if this is new"
        return f"{text[0].upper()}{text[1:]}."

    def see(self, frame: ClipFrame, typed: str | None = None) -> list[str]:
        """Look at a frame and keep a photo if one is due; what is to be said.

        Raises OSError if the photo cannot be written, ValueError if frame and mask are not of one size.
        """
        said = self._listen(typed)
        if self.ended:
            return []
        index, seconds = self._before[0] + frame.index, self._before[1] + frame.seconds
        self.frames, self.seconds = self.frames + 1, seconds
        size = frame.pixels.shape[:2]
        if self.size not in (None, size):
            self.ended = True
            (height, width), (old_height, old_width) = size, self.size
            text = f"the frames are {width}x{height} now, and were {old_width}x{old_height}: nothing more is taken"
            return [f"{seconds:7.1f} s  {text}"]
        self.size = size
        if self.reference_at is not None and not self._reference_due and seconds >= self.reference_at:
            if self.folder not in self.photos:
                raise ValueError(
                    f"--reference-at: no photo was taken in {self.folder} before that time; the reference comes last, "
                    "when the surface is treated"
                )
            self._reference_due = True
            self.coach.ask_reference()
        try:
            self.advice = self.coach.see(index, seconds, frame.pixels)
        except ValueError as error:
            raise ValueError(f"{self.mask_file}: {error}") from None
        if self.advice.still:
            self._last_still = seconds
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
            said += [TREAT.format(self.asks)] if self.asks else []
        return [f"{seconds:7.1f} s  {text}" for text in said]

    def resume(self) -> None:
        """Frames of a stream that was opened again follow, of the same camera."""
        self.ended = False
        self._before = self.frames, self.seconds + PAUSE
        self.coach.restart()

    def drop(self, photo: Path) -> str:
        """Delete a photo that was taken here, or the treated reference, which may then be taken again; what was done.

        Raises ValueError: it is none of these, or the last photo beside a reference.
        """
        if photo in self.references:
            photo.unlink(missing_ok=True)
            self.references.remove(photo)
            return f"dropped the treated reference {photo}"
        folder = photo.parent
        if photo not in self.photos.get(folder, ()):
            raise ValueError(f"{photo}: no photo that was taken here")
        left = self.photos[folder]
        if len(left) == 1 and any(path.parent == folder for path in self.references):
            raise ValueError(f"{photo}: the last photo beside the treated reference; drop that first")
        photo.unlink(missing_ok=True)
        if folder == self.folder:
            self.coach.drop(left.index(photo))
            self._said_enough = False
        left.remove(photo)
        if not left:
            del self.photos[folder]
            self._remove_empty(folder)
        return f"dropped {photo}"

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
        for folder, photos in self.photos.items():
            count = len(photos)
            told = f"{folder}: {count} photo{'s' if count > 1 else ''}"
            if folder / "reference.png" in self.references:
                told += " and the treated reference"
            elif count == 1:
                told += ", too few for a group: add another to the folder, or delete it"
            lines.append(told)
        if self.coach.wanted == "reference":
            lines.append("The treated reference was asked for and not taken.")
        if undrawn := self.undrawn:
            lines.append(f"Draw the target in {undrawn[0] / 'mask.png'}, white where the glass or mirror is.")
        if empty := [printable(folder.name) for folder, files in _files_of_groups(self.out).items() if not files]:
            lines.append(f"Without photos yet, which `prepare` will say, too: {', '.join(empty)}.")
        raw = self.out
        if Path(os.path.abspath(raw)).name in SPLITS:  # a split of the raw tree above
            raw = raw.parent if raw.name not in ("", "..") else raw / ".."
        return [*lines, f"Next: {prepare_line(raw)}"]

    @property
    def undrawn(self) -> list[Path]:
        """Folders of groups that have no mask yet."""
        return [folder for folder in self.photos if not any(folder.glob("mask*"))]

    def _checked_name(self, group: str) -> str:
        if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in group):
            raise ValueError(f"group {group!r}: there is something in it that is no text; name another")
        check_group_id(group)
        if group.casefold() in (*SPLITS, "val", "valid") or holds_no_photos(group):
            raise ValueError(f"group {group}: a folder of this name is no group in a raw tree; name another")
        if not self._is_free(self.out / group):
            raise ValueError(f"{self.out / group}: it is there already; name another group")
        return group

    @staticmethod
    def _is_free(folder: Path) -> bool:
        """Whether a group may begin there: it is absent, or somebody made an empty folder for it."""
        return not os.path.lexists(folder) or (folder.is_dir() and not folder.is_symlink() and not _contents(folder))

    def _next_folder(self) -> Path:
        number = 2
        while not self._is_free(folder := self.out / f"{self.name}__{number}"):
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
        try:
            path = self._write(advice)
        except OSError:
            if not advice.is_reference:
                self.coach.drop(-1, again=True)  # when the disk has room
            raise
        if advice.is_reference:
            self.references.append(path)
            self.ended = True
            return f"treated reference {path}"
        self.photos.setdefault(self.folder, []).append(path)
        what = "target" if self.mask is not None else "picture"
        return f"photo {path}, {advice.changed:.0%} of the {what} changed so far"

    def _write(self, advice: Advice) -> Path:
        """The photo in its group; the folder of one that another program has filled meanwhile is left alone."""
        taken = self.photos.get(self.folder, ())
        if not taken and self.folder not in self._began and not self._is_free(self.folder):
            self.folder = self._next_folder()
        self._began.add(self.folder)
        path = self.folder / ("reference.png" if advice.is_reference else f"{self._free_number():03d}.png")
        if path.exists():
            raise FileExistsError(errno.EEXIST, "another program has put a file there meanwhile", str(path))
        try:
            if not taken and self.mask is not None and not any(self.folder.glob("mask.*")):
                mask = self.folder / "mask.png"
                write_frame(mask, self.coach.mask_here.astype(np.uint8) * 255)
                self._masks[self.folder] = mask.stat().st_mtime_ns
            write_frame(path, advice.photo)
        except OSError:
            if not taken:
                self._remove_empty(self.folder)
            raise
        return path

    def _free_number(self) -> int:
        """Of the next photo: no file has it, not even the mask of a photo that was dropped, which would become its."""
        taken = self.photos.get(self.folder)
        first = int(taken[-1].stem) + 1 if taken else 1
        return next(number for number in itertools.count(first) if not any(self.folder.rglob(f"{number:03d}*")))

    def _remove_empty(self, folder: Path) -> None:
        """A group without photos goes, unless something of somebody else's is in it."""
        mask = folder / "mask.png"
        written = self._masks.pop(folder, None)
        if written is not None and mask.is_file() and mask.stat().st_mtime_ns == written:
            mask.unlink()
        with suppress(OSError):
            folder.rmdir()
