"""Where a drawn mask is kept, and that it is kept safely: whole or not at all, in the given folder, over nothing that
somebody else has saved meanwhile, and so that it is read again as it was drawn.

A group's mask is `<group>/mask.png`, a photo's `masks/<name>.png` beside it.
"""

import hashlib
import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import numpy as np
from PIL import Image

from gift_peft.captures.clip_group import find_clip_group
from gift_peft.captures.folders import PICTURE_MASKS
from gift_peft.captures.labels import split_classes
from gift_peft.captures.masks import MaskSource, find_mask
from gift_peft.captures.tree import read_capture
from gift_peft.files import write_whole

_SAVING = Lock()  # one save after the other: each looks first whether the file is still what its page has loaded


class Changed(ValueError):
    """A mask was saved by somebody else since it was loaded."""


@dataclass(frozen=True)
class MaskPlace:
    """Where the mask of a group, or of one of its photos, belongs, and what is there.

    Args:
        path (`Path`): the file that is written.
        source (`MaskSource`, *optional*): what is read today.
        mask_class (*optional*): of the group's `group.yaml`.
    """

    path: Path
    source: MaskSource | None
    mask_class: object = None

    @property
    def version(self) -> str:
        """Of the content of the files that decide the mask."""
        digest = hashlib.blake2b(digest_size=16)
        for path in dict.fromkeys((self.path, *(self.source.files if self.source else ()))):
            digest.update(b"\n" + (path.read_bytes() if path.is_file() else b"-"))
        return digest.hexdigest()

    def read(self, size: tuple[int, int]) -> np.ndarray | None:
        """(H, W) bool of what is there, None where nothing is; ValueError if it cannot be read."""
        return None if self.source is None or not self.source.annotated else self.source.read(size)


def group_place(folder: Path, split: str, root: Path, from_clip: bool) -> MaskPlace:
    """That of a group's mask. Raises as reading the group does."""
    if from_clip:
        group = find_clip_group(folder, root)
        source, facts = (None, {}) if group is None else (group.mask, group.facts)
    else:
        capture = read_capture(folder, split, root)
        source, facts = capture.common, capture.facts
    return MaskPlace(_in_place_of(source, folder / "mask.png"), source, facts.get("mask_class"))


def photo_place(photo: Path, folder: Path, root: Path, mask_class: object) -> MaskPlace:
    """That of a photo's own mask. Raises as finding one does."""
    source = find_mask(photo, folder, root, mask_class)
    return MaskPlace(_in_place_of(source, photo.parent / "masks" / f"{photo.stem}.png"), source, mask_class)


def frame_place(frame: Path, folder: Path, root: Path) -> MaskPlace:
    """That of a frame which `prepare` chooses from the clip in `folder`."""
    group, path = find_clip_group(folder, root), folder / "masks" / f"{frame.stem}.png"
    # With a mask for the whole clip, `prepare` takes the class for that one's.
    mask_class = None if group is None or group.mask is not None else group.facts.get("mask_class")
    source = MaskSource(path, "png", None, mask_class) if path.is_file() else None
    return MaskPlace(path, source, mask_class)


def _in_place_of(source: MaskSource | None, usual: Path) -> Path:
    """A PNG that somebody has drawn is replaced where it lies, so that there are not two; else the usual place."""
    own = source is not None and source.kind == "png" and source.path.suffix == ".png" and len(source.files) == 1
    if not own or source.path.stem.casefold() != usual.stem.casefold():
        return usual
    place, there = source.path.parent, usual.parent
    beside = place.parent == there.parent and {place.name.casefold(), there.name} <= set(PICTURE_MASKS)
    return source.path if place == there or beside else usual


def save_mask(find: Callable[[], MaskPlace], mask: np.ndarray, version: str, root: Path) -> MaskPlace:
    """Write a mask (H, W) bool and return its place as it is then.

    Args:
        find: `group_place` or `photo_place`; asked before, and after, to see that the mask is read as it was drawn.
        version: of the place as it was when the mask was loaded.
        root: RAW, out of which nothing is written, also not through links.

    Raises:
        Changed: the files are not those of `version`; they are left alone.
        ValueError, OSError: in a line; the files are as they were.
    """
    with _SAVING:
        place = find()
        if place.version != version:
            raise Changed(f"{_shown(place.path, root)} was changed since it was loaded here; nothing was saved")
        inside = Path(os.path.realpath(root))
        if not Path(os.path.realpath(place.path.parent)).is_relative_to(inside):
            raise ValueError(
                f"{_shown(place.path, root)}: its folder is a link out of {root}; nothing is written there"
            )
        value = _value(place.mask_class)
        before = place.path.read_bytes() if place.path.is_file() else None
        content = io.BytesIO()
        Image.fromarray(np.where(mask, np.uint8(value), np.uint8(0))).save(content, "PNG", optimize=True)
        made = not place.path.parent.is_dir()
        write_whole(place.path, content.getvalue())
        try:
            saved = find()
            read = saved.read(mask.shape[::-1])
            if saved.source is None or saved.source.path != place.path or read is None or (read != mask).any():
                other = "it" if saved.source is None else _shown(saved.source.path, root)
                raise ValueError(f"{_shown(place.path, root)} would not be read, because {other} is; move that away")
        except (ValueError, OSError):
            if before is not None:
                write_whole(place.path, before)
            else:
                place.path.unlink()
                if made:
                    place.path.parent.rmdir()
            raise
        return saved


def _value(mask_class: object) -> int:
    """The target's value in a mask that is read with this `mask_class`."""
    numbers, names = split_classes(mask_class)
    if names and not numbers:
        raise ValueError(
            f"group.yaml names the target by a label (mask_class: {names[0]}), and a drawn mask holds numbers; "
            "remove that line, or write 255"
        )
    if numbers and not 0 < numbers[0] < 256:
        raise ValueError(f"group.yaml: mask_class {numbers[0]} cannot be drawn; write 255")
    return numbers[0] if numbers else 255


def _shown(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
