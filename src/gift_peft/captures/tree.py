"""The raw tree: what a person has after taking photos and drawing masks.

`RAW[/train|/validation]/<group>/` holds the observations, in folders of their own if need be, their masks in any form
that `masks.py` reads or one for all of them (`mask.*`), perhaps the treated reference (`reference.*`, `ref.*`,
`ref_*`) and `group.yaml` (`surface`, `notes`, `mask_class`, `empty_masks`, `static_rig`; `synthesized` marks what
`gift-peft synthesize` made; `reference` is a time in a clip). Without split folders, groups with a reference are
validation and the others train. `GiftI` reads it as it is; `gift-peft prepare` makes a prepared folder of it, and
photos of a clip.
"""

import io
import logging
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from gift_peft.captures.clip import explain_clip, find_clips
from gift_peft.captures.folders import Listing, files_below, holds_no_photos
from gift_peft.captures.group_facts import read_facts
from gift_peft.captures.masks import (
    MaskSource,
    explain_missing,
    find_group_mask,
    find_mask,
    is_group_mask,
    is_mask_file,
)
from gift_peft.images import (
    hidden_turn,
    image_digest,
    is_image_file,
    name_skipped,
    natural_key,
    read_image,
    skipped_files,
)
from gift_peft.rules import SPLITS, GroupPictures, check_count

logger = logging.getLogger(__name__)

REFERENCE = re.compile(r"ref(erence)?([^a-z].*)?", re.IGNORECASE)  # but not reflection_1


@dataclass
class Capture:
    """The files of one group, before any picture is decoded.

    Args:
        folder (`Path`): the group's, inside the raw tree.
        group_id, split (`str`).
        images (`list[Path]`): observations in natural order.
        masks (`list[MaskSource | None]`): one per observation; None where there is none.
        reference (`Path`, *optional*): the treated reference.
        facts (`dict`): of `group.yaml`.
        common (`MaskSource`, *optional*): `mask.*`, for the observations that have none of their own.
        skipped (`list[Path]`): files of the folder that are not read.
        root (`Path`, *optional*): of the tree.
        depth (`Path`, *optional*): measured depth of the treated surface, as the reference's camera sees it.
    """

    folder: Path
    group_id: str
    split: str
    images: list[Path]
    masks: list[MaskSource | None]
    reference: Path | None = None
    facts: dict = field(default_factory=dict)
    common: MaskSource | None = None
    skipped: list[Path] = field(default_factory=list)
    root: Path | None = None
    depth: Path | None = None

    def name(self, path: Path) -> str:
        """How an image is called in the dataset: its path inside the group's folder."""
        return path.relative_to(self.folder).as_posix()


@dataclass
class Decoded:
    """The pictures of one group: every one decoded and checked, none twice.

    Args:
        kept (`list[int]`): which of the capture's observations these are.
        images (`list[Image.Image]`): upright 8-bit RGB.
        masks (`list[np.ndarray | None]`): (H, W) bool; None where there is none, or the common one holds.
        reference (`Image.Image`, *optional*).
        duplicates (`dict[int, int]`): the other observations, and the equal one that is kept.
        common (`np.ndarray`, *optional*): (H, W) bool, the mask for all that have none of their own.
        common_from (`int`, *optional*): which of `images` it was drawn on; None for `mask.*`.
        notes (`dict[str, str]`): what the person should know, by a short code.
    """

    kept: list[int]
    images: list[Image.Image]
    masks: list[np.ndarray | None]
    reference: Image.Image | None
    duplicates: dict[int, int]
    common: np.ndarray | None = None
    common_from: int | None = None
    notes: dict[str, str] = field(default_factory=dict)


def list_groups(root: str | Path) -> dict[str, list[Path]]:
    """The group folders of each split that has any, in natural order, after checking all that needs no decoding.

    Raises FileNotFoundError or ValueError naming the group or file: no groups, a missing mask, too few images.
    """
    groups = find_groups(root)
    for split, folders in groups.items():
        for folder in folders:
            capture = read_capture(folder, split, Path(root))
            check_masks(capture)
            check_count(folder.name, len(capture.images), split, capture.reference is not None)
    return groups


def find_groups(root: str | Path) -> dict[str, list[Path]]:
    """The group folders of each split that has any, in natural order; nothing in them is read.

    Raises FileNotFoundError or ValueError: no such folder, no groups, not a raw tree.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"GIFT-I folder {root}: no such folder")
    if any((root / split / "metadata.parquet").exists() for split in SPLITS):
        raise ValueError(
            f"{root} is a prepared folder, not a raw tree: use load_gift_i or load_dataset({str(root)!r})"
        )
    found: dict[str, list[Path]] = {split: [] for split in SPLITS}
    for name in ("val", "valid"):
        if (root / name).is_dir() and (root / "train").is_dir():  # else it would be ignored without a word
            raise ValueError(f"{root / name}: the second split is called validation; rename the folder")
    if any((root / split).is_dir() for split in SPLITS):
        found = {split: _subfolders(root / split) for split in SPLITS}
    else:
        for folder in _subfolders(root):
            found["validation" if _has_reference(folder) else "train"].append(folder)
    if not any(found.values()):
        raise FileNotFoundError(
            f"{root}: no group folders; each holds images, masks/<name>.png and perhaps reference.png"
        )
    return {split: folders for split, folders in found.items() if folders}


def read_capture(folder: Path, split: str, root: Path) -> Capture:
    """The files of one group, their masks found; no picture is decoded.

    Raises FileNotFoundError, ValueError or another OSError naming the file: no images, names that clash, two
    references, links in a loop, an unreadable folder, a damaged `group.yaml` or mask file, painted copies as
    validation.
    """
    files = sorted(files_below(folder))
    pictures = _photos(files, folder)
    skipped = [path for path in skipped_files(files) if not is_mask_file(path, folder)]
    references = [path for path in pictures if is_reference(path)]
    if len(references) > 1:
        raise ValueError(f"group {folder}: two references, {' and '.join(path.name for path in references[:2])}")
    if not references and (unread := [path for path in skipped if is_reference(path)]):
        # Left out without a word, its group would train.
        raise ValueError(f"group {folder}: the treated reference cannot be read; {name_skipped([unread[0].name])}")
    images = [path for path in pictures if path not in references]
    if not images and (clips := find_clips(files)):
        raise ValueError(explain_clip(folder, clips, root))
    if not images:
        told = f"; {name_skipped([path.name for path in skipped])}" if skipped else ""
        raise FileNotFoundError(f"group folder {folder} holds no images{told}")
    by_stem: dict[Path, Path] = {}
    for path in images:
        if by_stem.setdefault(path.with_suffix(""), path) != path:
            raise ValueError(
                f"{path} and {by_stem[path.with_suffix('')].name} would share one mask; rename one of them"
            )
    facts = read_facts(folder)
    if "reference" in facts:
        raise ValueError(
            f"group {folder}: `reference` in group.yaml is a time in a clip, and here are photos; remove it"
        )
    if split == "validation" and "synthesized" in facts:
        raise ValueError(f"group {folder}: painted copies of one photo (gift-peft synthesize) are for training only")
    mask_class = facts.get("mask_class")
    listing = Listing()
    masks = [find_mask(path, folder, root, mask_class, listing) for path in images]
    common = find_group_mask([path for path in files if is_group_mask(path)], images[0], root, mask_class)
    reference = references[0] if references else None
    return Capture(folder, folder.name, split, images, masks, reference, facts, common, skipped, root)


def check_masks(capture: Capture) -> None:
    """Raise FileNotFoundError naming the first mask that is missing, unless another photo's may stand in for it."""
    labeled = sum(mask is not None and mask.annotated for mask in capture.masks)
    if capture.common is None and labeled != 1:
        for path, mask in zip(capture.images, capture.masks, strict=True):
            if mask is None:
                raise FileNotFoundError(explain_missing(path, capture.folder, capture.root or capture.folder))


def decode_capture(capture: Capture, empty_masks: str = "refuse", may_lack: bool = False) -> Decoded:
    """Decode and check every picture of a group once.

    A photo without an annotation takes the group's `mask.*`, or the mask of the only annotated photo; how it gets
    there is the caller's. `empty_masks` says what a photo without a target is where others have one: an error
    ("refuse"), or one in which the target does not show ("allow"); `group.yaml` comes first. With `may_lack`, masks
    that are missing are still to be proposed.

    Raises ValueError, FileNotFoundError or another OSError naming the file or group.
    """
    seen: dict[str, int] = {}
    kept, images, masks, duplicates = [], [], [], {}
    for index, (path, source) in enumerate(zip(capture.images, capture.masks, strict=True)):
        image = read_image(path)
        first = seen.setdefault(image_digest(image), index)
        if first != index:
            duplicates[index] = first
            continue
        kept.append(index)
        images.append(image)
        masks.append(None if source is None or not source.annotated else source.read(image.size))
    reference = None if capture.reference is None else read_image(capture.reference)
    check_count(capture.group_id, len(kept), capture.split, reference is not None)
    decoded = Decoded(kept, images, masks, reference, duplicates)
    _share_mask(capture, decoded)
    _check_empty(capture, decoded, capture.facts.get("empty_masks", empty_masks), may_lack)
    blank = np.zeros(images[0].size[::-1], bool)  # where the mask is still to be proposed
    filled = [decoded.common if mask is None else mask for mask in masks]
    names = [capture.name(capture.images[index]) for index in kept]
    drawn = [blank if mask is None else mask for mask in filled]
    pictures = GroupPictures(capture.group_id, names, images, drawn, reference=reference)
    if capture.split == "train" and all(mask is not None for mask in filled):
        pictures.check_target()
    _note_files(capture, decoded)
    return decoded


def _share_mask(capture: Capture, decoded: Decoded) -> None:
    """The mask that holds for the photos that nobody annotated."""
    lacking = sum(mask is None for mask in decoded.masks)
    labeled = [place for place, mask in enumerate(decoded.masks) if mask is not None]
    if not lacking:
        return
    if capture.common is not None:
        decoded.common, name = capture.common.read(decoded.images[0].size), capture.common.path.name
    elif len(labeled) == 1 and decoded.masks[labeled[0]].any():
        decoded.common_from = labeled[0]
        decoded.common = decoded.masks[labeled[0]]
        name = f"the mask of {capture.name(capture.images[decoded.kept[labeled[0]]])}, the only photo that has one,"
    else:
        return
    others = f"the {lacking} photos" if lacking > 1 else "the photo"
    decoded.notes["one_mask"] = f"{name} holds for {others} without an annotation"


def _check_empty(capture: Capture, decoded: Decoded, empty_masks: str, may_lack: bool) -> None:
    """Refuse, or allow, photos without a target beside others that have one."""
    files = [(capture.images[index], capture.masks[index]) for index in decoded.kept]
    shown = [*decoded.masks, decoded.common]
    some = any(mask is not None and mask.any() for mask in shown)
    without = []
    for place, ((path, source), mask) in enumerate(zip(files, decoded.masks, strict=True)):
        if mask is None and decoded.common is not None:  # an empty one is no stand-in for a target either
            mask, source = decoded.common, capture.common or source
            if mask.any() or not some:
                continue
        elif may_lack if mask is None else mask.any():
            continue
        if source is None:
            raise FileNotFoundError(explain_missing(path, capture.folder, capture.root or capture.folder))
        inside = source.path.is_relative_to(capture.folder)
        without.append(f"{path.name} ({capture.name(source.path) if inside else source.path.name})")
        if decoded.masks[place] is None:
            decoded.masks[place] = np.zeros(decoded.images[place].size[::-1], bool)
    if empty_masks == "refuse" and without and (some or not all(source.annotated for _, source in files if source)):
        one = len(without) == 1
        beside = "; other photos of the group have one" if some else ""
        raise ValueError(
            f"group {capture.folder}: {', '.join(without)} {'has' if one else 'have'} no target in "
            f"{'its' if one else 'their'} mask or annotation{beside}. Annotate {'it' if one else 'them'}, or, if no "
            "mirror or glass shows there, say so: `empty_masks: allow` in group.yaml, or for all groups "
            "`gift-peft prepare --empty-masks allow`"
        )


def _note_files(capture: Capture, decoded: Decoded) -> None:
    """What is in the group's folder and was not read, or may be read wrongly."""
    if capture.skipped:
        decoded.notes["skipped_files"] = name_skipped([capture.name(path) for path in capture.skipped])
    turned = []
    for index in decoded.kept:
        source = capture.masks[index]
        if source is not None and source.hides_exif and hidden_turn(capture.images[index]) is not None:
            turned.append(capture.name(capture.images[index]))
    if turned:
        decoded.notes["exif_turned"] = (
            f"{', '.join(turned)}: turned or mirrored by an EXIF mark, and annotated with a tool that may ignore such "
            "marks (labelme, CVAT, COCO files); check that the mask is not upside down"
        )


def raw_example(folder: Path, split: str, root: Path, empty_masks: str = "refuse") -> dict:
    """One group as a row of `FEATURES` with paths in place of pictures; every picture is decoded and checked once.

    A mask is embedded as a picture of 0 and 255 only where its file is not one. A mask for all photos is taken as it
    is: nothing is registered here.
    """
    capture = read_capture(folder, split, root)
    check_masks(capture)
    decoded = decode_capture(capture, empty_masks)
    for note in decoded.notes.values():
        logger.warning("group %s: %s", capture.folder, note)
    shared = capture.common if decoded.common_from is None else capture.masks[decoded.kept[decoded.common_from]]
    for index, first in decoded.duplicates.items():
        logger.warning(
            "%s: dropped, the same picture as %s", capture.images[index], capture.name(capture.images[first])
        )
    return {
        "group_id": capture.group_id,
        "surface": capture.facts.get("surface"),
        "image_names": [capture.name(capture.images[index]) for index in decoded.kept],
        "images": [str(capture.images[index]) for index in decoded.kept],
        "masks": [
            _mask_item(shared, decoded.common) if mask is None else _mask_item(capture.masks[index], mask)
            for index, mask in zip(decoded.kept, decoded.masks, strict=True)
        ],
        "valids": [],
        "depths": [],
        "reference": None if capture.reference is None else str(capture.reference),
    }


def _subfolders(folder: Path) -> list[Path]:
    """In natural order, with links that lead nowhere, so that reading those is an error that names them."""
    if not folder.is_dir():
        return []
    folders = (
        path
        for path in folder.iterdir()
        if not _is_no_group(path.name) and (path.is_dir() or (path.is_symlink() and not path.exists()))
    )
    return sorted(folders, key=lambda path: natural_key(path.name))


def _is_no_group(folder: str) -> bool:
    """Folders of exports lie beside groups; but a group may be called `mask`."""
    return folder.casefold() != "mask" and holds_no_photos(folder)


def _photos(files: list[Path], folder: Path) -> list[Path]:
    """Those of a group's files that are photos, in natural order."""
    photos = [path for path in files if is_image_file(path) and not is_mask_file(path, folder)]
    return sorted(photos, key=lambda path: natural_key(path.relative_to(folder).as_posix()))


def is_reference(path: Path) -> bool:
    return REFERENCE.fullmatch(path.stem) is not None and path.suffix != ""


def _has_reference(folder: Path) -> bool:
    """Whether a group has one; a folder that cannot be listed is an error when the group is read, not here."""
    try:
        files = list(files_below(folder))
        unread = skipped_files(files)  # a reference in HEIC: reading the group says what to install
        return any(map(is_reference, (*_photos(files, folder), *unread))) or "reference" in read_facts(folder)
    except (OSError, ValueError):
        return False


def _mask_item(source: MaskSource | None, mask: np.ndarray) -> str | dict:
    if source is not None and source.kind == "png":
        with Image.open(source.path) as image:
            if image.mode in ("1", "L") and image.size == mask.shape[::-1]:
                values = np.asarray(image)
                if values.dtype == bool or np.array_equal(values, mask * np.uint8(255)):
                    return str(source.path)
    buffer = io.BytesIO()
    Image.fromarray(mask.astype(np.uint8) * 255).save(buffer, "PNG")
    return {"bytes": buffer.getvalue(), "path": None}
