"""The strict raw tree: what a person has after taking photos and drawing masks, read as it is.

`RAW[/train|/validation]/<group>/` holds the observations, `masks/<stem>.png`, perhaps `reference.*` (the treated
surface) and `group.yaml` (`surface`, `notes`, `mask_class`). Without split folders, groups with a reference are
validation and the others train.
"""

import io
import logging
import re
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from gift_peft.data.preprocess import (
    SURFACES,
    check_group,
    image_digest,
    is_image_file,
    open_image,
    read_image,
    to_mask,
)

logger = logging.getLogger(__name__)

SPLITS = ("train", "validation")
GROUP_KEYS = {"surface", "notes", "mask_class"}


def natural_key(name: str) -> list:
    """Sorts image_2 before image_10."""
    return [
        (0, int(part), "") if part.isdigit() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name) if part
    ]


def check_count(group_id: str, count: int, split: str, has_reference: bool) -> None:
    """A group takes two observations to compare; in validation one will do if there is a treated reference."""
    if count < (1 if split == "validation" and has_reference else 2):
        hint = "" if split == "train" else ", or one and a treated reference"
        raise ValueError(f"group {group_id} has {count} different image{'s' * (count != 1)}; it takes two{hint}")


def list_groups(root: str | Path) -> dict[str, list[Path]]:
    """The group folders of each split that has any, in natural order, after checking all that needs no decoding.

    Raises FileNotFoundError or ValueError naming the group or file: no groups, a missing mask, too few images.
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
            found["validation" if _reference(folder) else "train"].append(folder)
    for split, folders in found.items():
        for folder in folders:
            images = _images(folder)
            for image in images:
                _mask_path(folder, image)
            check_count(folder.name, len(images), split, _reference(folder) is not None)
    if not any(found.values()):
        raise FileNotFoundError(
            f"{root}: no group folders; each holds images, masks/<name>.png and perhaps reference.png"
        )
    return {split: folders for split, folders in found.items() if folders}


def raw_example(folder: Path, split: str) -> dict:
    """One group as a row of `FEATURES` with paths in place of pictures; every picture is decoded and checked once.

    A mask is embedded as a two-valued picture only where its file is not one (a class named, a palette, 16 bits).
    """
    facts = _facts(folder)
    seen: dict[str, str] = {}
    kept, images, masks, mask_items = [], [], [], []
    for path in _images(folder):
        image = read_image(path)
        digest = image_digest(image)
        if digest in seen:
            logger.warning("%s: dropped, the same picture as %s", path, seen[digest])
            continue
        seen[digest] = path.name
        mask_path = _mask_path(folder, path)
        mask = open_image(mask_path)
        target = to_mask(mask, str(mask_path), facts.get("mask_class"))
        as_it_is = mask.mode in ("1", "L") and "mask_class" not in facts
        kept.append(path)
        images.append(image)
        masks.append(target)
        mask_items.append(str(mask_path) if as_it_is else _png(target))
    reference = _reference(folder)
    names = [path.name for path in kept]
    check_count(folder.name, len(kept), split, reference is not None)
    treated = None if reference is None else read_image(reference)
    check_group(folder.name, names, images, masks, reference=treated, train=split == "train")
    return {
        "group_id": folder.name,
        "surface": facts.get("surface"),
        "image_names": names,
        "images": [str(path) for path in kept],
        "masks": mask_items,
        "valids": [],
        "depths": [],
        "reference": None if reference is None else str(reference),
    }


def _subfolders(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    folders = (path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    return sorted((path for path in folders if path.name != "proxies"), key=lambda path: natural_key(path.name))


def _pictures(folder: Path) -> list[Path]:
    return sorted(filter(is_image_file, folder.iterdir()), key=lambda path: natural_key(path.name))


def _images(folder: Path) -> list[Path]:
    images = [path for path in _pictures(folder) if path.stem != "reference"]
    if not images:
        raise FileNotFoundError(f"group folder {folder} holds no images")
    by_stem: dict[str, Path] = {}
    for path in images:
        if by_stem.setdefault(path.stem, path) != path:
            raise ValueError(f"{path} and {by_stem[path.stem].name} would share one mask; rename one of them")
    return images


def _reference(folder: Path) -> Path | None:
    references = [path for path in _pictures(folder) if path.stem == "reference"]
    if len(references) > 1:
        raise ValueError(f"group {folder}: two references, {' and '.join(path.name for path in references)}")
    return references[0] if references else None


def _mask_path(folder: Path, image: Path) -> Path:
    path = folder / "masks" / f"{image.stem}.png"
    if not path.exists():
        raise FileNotFoundError(f"missing mask {path} for the image {image.name}")
    return path


def _facts(folder: Path) -> dict:
    path = folder / "group.yaml"
    if not path.exists():
        return {}
    try:
        facts = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from None
    if not isinstance(facts, dict) or not facts.keys() <= GROUP_KEYS:
        raise ValueError(f"{path}: it may have the keys {', '.join(sorted(GROUP_KEYS))} and no others")
    if facts.get("surface") not in (None, *SURFACES):
        raise ValueError(f"{path}: surface {facts['surface']!r}; it is one of {', '.join(SURFACES)}")
    classes = facts.get("mask_class", [])
    if not all(isinstance(value, int) for value in (classes if isinstance(classes, list) else [classes])):
        raise ValueError(f"{path}: mask_class {classes!r}; it is the target's value in the masks, or a list of values")
    return facts


def _png(mask: np.ndarray) -> dict:
    buffer = io.BytesIO()
    Image.fromarray(mask.astype(np.uint8) * 255).save(buffer, "PNG")
    return {"bytes": buffer.getvalue(), "path": None}
