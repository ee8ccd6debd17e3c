"""The raw tree: what a person has after taking photos and drawing masks.

`RAW[/train|/validation]/<group>/` holds the observations, in folders of their own if need be, their masks in any form
that `masks.py` reads, perhaps the treated reference (`reference.*`, `ref.*`, `ref_*`) and `group.yaml` (`surface`,
`notes`, `mask_class`, `static_rig`; `synthesized` marks what `gift-peft synthesize` made). Without split folders,
groups with a reference are validation and the others train. `GiftI` reads it as it is; `gift-peft prepare` makes a
prepared folder of it.
"""

import io
import logging
import os
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from gift_peft.captures.masks import MaskSource, find_mask, is_mask_file
from gift_peft.files import read_yaml
from gift_peft.images import image_digest, is_image_file, natural_key, read_image
from gift_peft.rules import SPLITS, SURFACES, GroupPictures, check_count

logger = logging.getLogger(__name__)

GROUP_KEYS = {"surface", "notes", "mask_class", "static_rig", "synthesized"}
NOT_PHOTOS = {"valids", "depths", "proxies", "masks_proposed"}  # folders of a group that hold something else
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
    """

    folder: Path
    group_id: str
    split: str
    images: list[Path]
    masks: list[MaskSource | None]
    reference: Path | None = None
    facts: dict = field(default_factory=dict)

    def name(self, path: Path) -> str:
        """How an image is called in the dataset: its path inside the group's folder."""
        return path.relative_to(self.folder).as_posix()


@dataclass
class Decoded:
    """The pictures of one group: every one decoded and checked, none twice.

    Args:
        kept (`list[int]`): which of the capture's observations these are.
        images (`list[Image.Image]`): upright 8-bit RGB.
        masks (`list[np.ndarray | None]`): (H, W) bool.
        reference (`Image.Image`, *optional*).
        duplicates (`dict[int, int]`): the other observations, and the equal one that is kept.
    """

    kept: list[int]
    images: list[Image.Image]
    masks: list[np.ndarray | None]
    reference: Image.Image | None
    duplicates: dict[int, int]


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
    pictures = _pictures(folder)
    references = [path for path in pictures if _is_reference(path)]
    if len(references) > 1:
        raise ValueError(f"group {folder}: two references, {' and '.join(path.name for path in references[:2])}")
    images = [path for path in pictures if path not in references]
    if not images:
        raise FileNotFoundError(f"group folder {folder} holds no images")
    by_stem: dict[Path, Path] = {}
    for path in images:
        if by_stem.setdefault(path.with_suffix(""), path) != path:
            raise ValueError(
                f"{path} and {by_stem[path.with_suffix('')].name} would share one mask; rename one of them"
            )
    facts = _facts(folder)
    if split == "validation" and "synthesized" in facts:
        raise ValueError(f"group {folder}: painted copies of one photo (gift-peft synthesize) are for training only")
    masks = [find_mask(path, folder, root, facts.get("mask_class")) for path in images]
    return Capture(folder, folder.name, split, images, masks, references[0] if references else None, facts)


def check_masks(capture: Capture) -> None:
    """Raise FileNotFoundError naming the first mask that is missing."""
    for path, mask in zip(capture.images, capture.masks, strict=True):
        if mask is None:
            expected = path.parent / "masks" / f"{path.stem}.png"
            raise FileNotFoundError(f"missing mask {expected} for the image {path.name}")


def decode_capture(capture: Capture) -> Decoded:
    """Decode and check every picture of a group once.

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
        masks.append(None if source is None else source.read(image.size))
    reference = None if capture.reference is None else read_image(capture.reference)
    names = [capture.name(capture.images[index]) for index in kept]
    check_count(capture.group_id, len(kept), capture.split, reference is not None)
    blank = np.zeros(images[0].size[::-1], bool)  # where the mask is still to be proposed
    drawn = [blank if mask is None else mask for mask in masks]
    pictures = GroupPictures(capture.group_id, names, images, drawn, reference=reference)
    if capture.split == "train" and all(mask is not None for mask in masks):
        pictures.check_target()
    return Decoded(kept, images, masks, reference, duplicates)


def raw_example(folder: Path, split: str, root: Path) -> dict:
    """One group as a row of `FEATURES` with paths in place of pictures; every picture is decoded and checked once.

    A mask is embedded as a picture of 0 and 255 only where its file is not one.
    """
    capture = read_capture(folder, split, root)
    check_masks(capture)
    decoded = decode_capture(capture)
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
            _mask_item(capture.masks[index], mask) for index, mask in zip(decoded.kept, decoded.masks, strict=True)
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
        if not path.name.startswith(".") and (path.is_dir() or (path.is_symlink() and not path.exists()))
    )
    return sorted((path for path in folders if path.name != "proxies"), key=lambda path: natural_key(path.name))


def _pictures(folder: Path) -> list[Path]:
    """All photos of a group, in natural order.

    Raises OSError or ValueError: links in a loop, an unreadable folder, a pipe or device that reading would wait for.
    """

    def complain(error: OSError):
        raise error

    found, ancestors = [], {}
    for place, folders, files in os.walk(folder, followlinks=True, onerror=complain):
        real = os.path.realpath(place)
        above = ancestors.get(os.path.dirname(place), frozenset())
        if real in above:
            raise ValueError(f"{place}: a link back to a folder above it")
        ancestors[place] = above | {real}
        folders[:] = [name for name in folders if not name.startswith(".") and name not in NOT_PHOTOS]
        for path in (Path(place, name) for name in files):
            if path.exists() and not path.is_file():
                raise ValueError(f"{path}: not a regular file")
            if is_image_file(path):
                found.append(path)
    photos = [path for path in found if not is_mask_file(path, folder)]
    return sorted(photos, key=lambda path: natural_key(path.relative_to(folder).as_posix()))


def _is_reference(path: Path) -> bool:
    return REFERENCE.fullmatch(path.stem) is not None


def _has_reference(folder: Path) -> bool:
    """Whether a group has one; a folder that cannot be listed is an error when the group is read, not here."""
    try:
        return any(_is_reference(path) for path in _pictures(folder))
    except (OSError, ValueError):
        return False


def _facts(folder: Path) -> dict:
    path = folder / "group.yaml"
    if not path.exists():
        return {}
    facts = read_yaml(path)
    if not facts.keys() <= GROUP_KEYS:
        raise ValueError(f"{path}: it may have the keys {', '.join(sorted(GROUP_KEYS))} and no others")
    if facts.get("surface") not in (None, *SURFACES):
        raise ValueError(f"{path}: surface {facts['surface']!r}; it is one of {', '.join(SURFACES)}")
    classes = facts.get("mask_class", [])
    if not all(isinstance(value, int | str) for value in (classes if isinstance(classes, list) else [classes])):
        raise ValueError(f"{path}: mask_class {classes!r}; it is the target's value or label in the masks, or a list")
    if not isinstance(facts.get("static_rig", False), bool):
        raise ValueError(f"{path}: static_rig {facts['static_rig']!r}; it is true or false")
    if not isinstance(facts.get("synthesized", {}), dict):
        raise ValueError(f"{path}: synthesized {facts['synthesized']!r}; it is what gift-peft synthesize wrote there")
    return facts


def _mask_item(source: MaskSource, mask: np.ndarray) -> str | dict:
    if source.kind == "png":
        with Image.open(source.path) as image:
            if image.mode in ("1", "L") and image.size == mask.shape[::-1]:
                values = np.asarray(image)
                if values.dtype == bool or np.array_equal(values, mask * np.uint8(255)):
                    return str(source.path)
    buffer = io.BytesIO()
    Image.fromarray(mask.astype(np.uint8) * 255).save(buffer, "PNG")
    return {"bytes": buffer.getvalue(), "path": None}
