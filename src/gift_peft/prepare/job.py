"""What the work on one group starts from and ends in, and the digest that tells whether it is done already."""

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from gift_peft.captures.foreign import Layout
from gift_peft.captures.group_facts import GROUP_FILES
from gift_peft.captures.known_datasets import KnownLayout
from gift_peft.captures.tree import Capture, read_capture
from gift_peft.files import printable
from gift_peft.prepare.entries import Remark
from gift_peft.prepare.settings import PrepareSettings

FORMAT = 1  # of records and report; a new one makes every group again


@dataclass(frozen=True)
class Job:
    """One group to prepare: `source` is its folder, or the capture itself; `known` the digest of what it was made from
    in an earlier run, `proposed` what that run proposed: `from`, a digest, the entry's `proposal`, and `out`.

    Of a group that was chosen from a clip, `source` lies below `root` and no longer in RAW, `clip_folder` is where the
    clip lies, `remarks` say how it was chosen, and `failure` is what was wrong with it."""

    raw: Path
    staging: Path
    source: Path | Capture
    split: str
    settings: PrepareSettings
    known: str | None = None
    proposed: dict | None = None
    root: Path | None = None
    clip_folder: Path | None = None
    remarks: tuple[Remark, ...] = ()
    failure: str | None = None

    @property
    def notes(self) -> Path:
        """Where its finished frames are noted, for the bar."""
        return self.staging / f"{self.split}.{self.group_id}.frames"

    @property
    def folder(self) -> Path:
        return self.clip_folder or (self.source.folder if isinstance(self.source, Capture) else self.source)

    def relative(self, path: Path) -> str:
        """A path below RAW as the report states it."""
        return printable(Path(os.path.relpath(path.absolute(), self.raw.absolute())).as_posix())

    def readable(self, error: Exception) -> str:
        """An error in one line, with paths relative to RAW."""
        text = " ".join(str(error).split()) or type(error).__name__
        return printable(text.replace(f"{self.raw}{os.sep}", ""))

    @property
    def group_id(self) -> str:
        if isinstance(self.source, Capture):
            return self.source.group_id
        if not isinstance(self.settings.layout, Layout):
            return self.source.name
        return self.settings.layout.group_id(self.source, self.split, self.raw)

    @property
    def may_be_single(self) -> bool:
        """Whether a train group of one photo is meant: in other raw trees the others were forgotten."""
        return self.clip_folder is not None or isinstance(self.settings.layout, KnownLayout)

    def read(self) -> Capture:
        if self.failure is not None:
            raise ValueError(self.failure)
        if isinstance(self.source, Capture):
            return self.source
        if isinstance(self.settings.layout, Layout):
            return self.settings.layout.read(self.source, self.split, self.raw)
        return read_capture(self.source, self.split, self.root or self.raw)


@dataclass
class Outcome:
    """What became of a group: the digest of what it was made from, its entry in the report, its metadata row if it
    is kept (then it lies in the staging folder), and the digest of what its masks were proposed from."""

    digest: str | None
    entry: dict
    row: dict | None = None
    proposed_from: str | None = None


ABOUT_PROPOSALS = ("propose_masks", "accept_proposed_masks", "min_proposal_score", "refine")
ABOUT_ACCEPTANCE = ABOUT_PROPOSALS[:3]


def group_choices(settings: PrepareSettings, capture: Capture) -> dict:
    """The settings that decide what becomes of this group: those about proposals only where a mask is missing."""
    choices = {name: value for name, value in asdict(settings).items() if name != "max_frames"}
    if all(mask is not None for mask in capture.masks):
        choices = {name: value for name, value in choices.items() if name not in ABOUT_PROPOSALS}
    return choices


def proposal_choices(settings: PrepareSettings) -> dict:
    """The settings that decide what is proposed, whether or not it is accepted."""
    return {name: value for name, value in asdict(settings).items() if name not in (*ABOUT_ACCEPTANCE, "max_frames")}


def capture_digest(capture: Capture, choices: dict) -> str:
    """Of the content of every file that decides what becomes of the group, and of what was chosen to do with it."""
    stated = json.dumps([FORMAT, capture.split, choices, [path.name for path in capture.skipped]], sort_keys=True)
    digest = hashlib.blake2b(stated.encode(), digest_size=16)
    files = [*capture.images, *(capture.folder / name for name in GROUP_FILES)]
    files += [path for mask in (*capture.masks, capture.common) if mask is not None for path in mask.files]
    files += [path for path in (capture.reference, capture.depth) if path is not None]
    for path in dict.fromkeys(files):
        if path.is_file():
            with path.open("rb") as file:
                content = hashlib.file_digest(file, "blake2b").hexdigest()
            digest.update(f"\n{os.path.relpath(path, capture.folder)} {content}".encode(errors="surrogateescape"))
    return digest.hexdigest()
