"""Where the mask of a photo is, in whatever form people draw them, and its pixels.

`find_mask` looks, in this order, for: `masks/<stem>.png` or `<stem>_mask.png`; labelme's `<stem>.json`; CVAT's
`SegmentationClass/<stem>.png` (colours named by `labelmap.txt`); and JSON exports that hold many images, COCO (CVAT,
Label Studio; polygons or run lengths) and Label Studio's own, in the group's folder, its `annotations/` or `masks/`,
or in a folder above it up to the root. The first found counts. Masks follow the rules of `images.to_mask`; where
an export knows several labels, `mask_class` names the target's.
"""

import json
import os
import re
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from gift_peft.captures.annotations import (
    MaskClass,
    check_size,
    choose_labels,
    coco_images,
    label_studio_images,
    read_coco,
    read_label_studio,
    read_labelme,
    relative_name,
    split_classes,
)
from gift_peft.images import SINGLE_CHANNEL, is_image_file, open_image, to_mask

MASK_FOLDERS = ("masks", "annotations", "SegmentationClass", "SegmentationObject", "masks_proposed")
UPLOAD_PREFIX = re.compile(r"^[0-9a-f]{8}-")  # Label Studio puts it before the names of uploaded files


@dataclass(frozen=True)
class MaskSource:
    """One image's mask on disk.

    Args:
        path (`Path`): the file that holds it.
        kind (`str`): "png", "labelme", "coco" or "label-studio".
        entry (`str`, *optional*): the image's name in a file that holds many.
        mask_class (*optional*): the target's value or values in a picture, its labels or category ids in an export.
    """

    path: Path
    kind: str
    entry: str | None = None
    mask_class: MaskClass = None

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that decide the mask, for a digest of the group."""
        labelmap = _labelmap_path(self.path) if self.kind == "png" else None
        return (self.path,) if labelmap is None else (self.path, labelmap)

    def read(self, size: tuple[int, int]) -> np.ndarray:
        """The (H, W) bool target region for an image of `size` (width, height).

        Raises ValueError naming the file: another size, several values or labels without a class, a class that is not
        there, damaged or unreadable content.
        """
        if self.kind == "png":
            return _read_picture(self.path, size, self.mask_class)
        try:
            if self.kind == "labelme":
                return read_labelme(_load(self.path), size, self.mask_class)
            record = _export(self.path)[1].get(self.entry)
            if record is None:
                raise ValueError("the file has changed and no longer lists it")
            read = read_coco if self.kind == "coco" else read_label_studio
            return read(record, size, self.mask_class)
        except ValueError as error:
            at = f"{self.path}, image {self.entry}" if self.entry else str(self.path)
            raise ValueError(str(error) if str(self.path) in str(error) else f"{at}: {error}") from None


def is_mask_file(path: Path, group_dir: Path) -> bool:
    """Whether a picture in a group's folder is a mask: in a mask folder, or `<stem>_mask.*` beside <stem>."""
    folders = path.relative_to(group_dir).parent.parts
    if any(folder in MASK_FOLDERS for folder in folders) or _is_label_studio_picture(path):
        return True
    stem = path.stem.removesuffix("_mask")
    return stem != path.stem and any(
        other.stem == stem and is_image_file(other) for other in path.parent.iterdir() if other != path
    )


def find_mask(image_path: Path, group_dir: Path, root: Path, mask_class: MaskClass = None) -> MaskSource | None:
    """The mask of an image inside `group_dir` (itself inside `root`), or None if there is no file that could hold it.

    Raises ValueError naming the file for a damaged export, an ambiguous one, one that names files by absolute paths
    or with `..`, and for a mask whose links lead out of `root` or nowhere.
    """
    bases = [group_dir, *(folder for folder in group_dir.parents if folder.is_relative_to(root))]
    for path in _own_files(image_path, group_dir, bases):
        if not os.path.lexists(path) or path == image_path:
            continue
        kind = "png"
        if path.suffix == ".json":
            content = _load(_checked(path, root))
            if not isinstance(content, dict) or "shapes" not in content:
                continue  # a camera's notes, perhaps
            kind = "labelme"
            _check_labelme_path(path, content, image_path)
        within = image_path.parent.relative_to(group_dir).parts
        own = path.is_relative_to(image_path.parent) or path.parent.match(str(Path("*", *within)))
        if not own and _namesakes(image_path, group_dir):
            raise ValueError(f"{path} may belong to several images called {image_path.stem}; rename them")
        return MaskSource(_checked(path, root), kind, None, mask_class)
    for base in bases:
        for path in _exports(base):
            kind, images = _export(_checked(path, root))
            entry = _entry(list(images), image_path, group_dir, path, inside=base == group_dir)
            if entry is not None:
                return MaskSource(path, kind, entry, mask_class)
    for folder in (image_path.parent, group_dir, group_dir / "masks"):
        if unnamed := next(filter(_is_label_studio_picture, folder.iterdir() if folder.is_dir() else ()), None):
            raise ValueError(
                f"{unnamed}: Label Studio's PNG export names the task but not the image; rename it to "
                f"{image_path.stem}_mask.png, or export as JSON or COCO"
            )
    return None


def _own_files(image_path: Path, group_dir: Path, bases: Sequence[Path]) -> Iterator[Path]:
    """Where a file with this image's mask alone may be, most specific first."""
    stem, within = image_path.stem, image_path.relative_to(group_dir).parent
    folders = list(dict.fromkeys([image_path.parent / "masks", group_dir / "masks" / within, group_dir / "masks"]))
    yield from (folder / f"{stem}.png" for folder in folders)
    yield from (folder / f"{stem}_mask.png" for folder in (*folders, image_path.parent))
    yield from (folder / f"{stem}.json" for folder in (image_path.parent, *folders, group_dir / "annotations"))
    for base in bases:  # CVAT keeps the images' folders below its own, as they were uploaded
        start = image_path.parent if base == group_dir else group_dir.parent
        for name in dict.fromkeys(image_path.relative_to(folder).with_suffix(".png") for folder in (base, start)):
            for folder in (base, *(base / name for name in MASK_FOLDERS[:2])):
                yield folder / "SegmentationClass" / name


def _is_label_studio_picture(path: Path) -> bool:
    return re.match(r"task-\d+-annotation-\d+-.*\.png$", path.name) is not None


def _checked(path: Path, root: Path) -> Path:
    """The path, unless its links end nowhere, in a loop, or outside the root."""
    try:
        real = path.resolve(strict=True)
    except (OSError, RuntimeError):  # RuntimeError: how Python before 3.13 reports a loop
        raise ValueError(f"{path}: a link that leads nowhere") from None
    if not real.is_relative_to(root.resolve()):
        raise ValueError(f"{path}: a link that leads out of {root}; copy the file")
    return path


# ---- pictures ----


def _read_picture(path: Path, size: tuple[int, int], mask_class: MaskClass) -> np.ndarray:
    image = open_image(path)
    check_size(f"{path}: the mask is", image.size, size)
    labelmap = _labelmap_path(path)
    values, names = split_classes(mask_class)
    if labelmap is not None and (names or image.mode == "P" or image.mode not in SINGLE_CHANNEL):
        return _read_colours(image, path, labelmap, mask_class)
    if names and not values:
        raise ValueError(f"{path}: mask_class {names[0]!r} is a label, and this mask holds numbers; name its number")
    return to_mask(image, str(path), values or None)


def _labelmap_path(path: Path) -> Path | None:
    """CVAT's list of labels and colours, beside the picture or its folder."""
    return next((folder / "labelmap.txt" for folder in path.parents[:2] if (folder / "labelmap.txt").is_file()), None)


def _read_colours(image: Image.Image, path: Path, labelmap: Path, mask_class: MaskClass) -> np.ndarray:
    """A mask in the colours of CVAT's `labelmap.txt`: lines `label:r,g,b:parts:actions`, "background" not a target."""
    colours: dict[str, tuple[int, ...]] = {}
    try:
        for line in labelmap.read_text(encoding="utf-8").splitlines():
            if line.strip() and not line.startswith("#"):
                label, colour = line.split(":")[:2]
                colours[label] = tuple(int(value) for value in colour.split(","))
    except (OSError, ValueError):
        raise ValueError(f"{labelmap}: not CVAT's labelmap.txt (lines `label:r,g,b:parts:actions`)") from None
    if image.mode in SINGLE_CHANNEL and image.mode != "P":  # the colour's index is the label's line
        values = np.asarray(image).astype(np.int64)
        codes = dict(zip(colours, range(len(colours)), strict=True))
    else:
        values = np.asarray(image.convert("RGB")).astype(np.int64) @ (65536, 256, 1)
        codes = {label: int(np.dot(colour, (65536, 256, 1))) for label, colour in colours.items() if len(colour) == 3}
    unknown = np.setdiff1d(np.unique(values), list(codes.values()))
    if len(unknown):
        raise ValueError(f"{path}: {len(unknown)} colours that {labelmap} does not name")
    labels = {label: index for index, label in enumerate(codes) if label != "background"}
    chosen = choose_labels(labels, mask_class, f"labels of {labelmap}")
    return np.isin(values, [codes[label] for label in chosen])


# ---- JSON exports ----


def _exports(base: Path) -> Iterator[Path]:
    """JSON files that may hold many images: those that are not one image's own."""
    for folder in (base, *(base / name for name in MASK_FOLDERS[:2])):
        if folder.is_dir():
            files = sorted(folder.iterdir())
            images = {path.stem for path in (*files, *base.iterdir()) if is_image_file(path)}
            yield from (path for path in files if path.suffix.lower() == ".json" and path.stem not in images)


def _export(path: Path) -> tuple[str, dict]:
    try:
        stat = path.stat()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    return _parsed_export(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=16)  # one file serves every image of a group, or of many groups
def _parsed_export(path: Path, modified: int, length: int) -> tuple[str, dict]:
    """("coco" | "label-studio" | "other", what it says of each image name)."""
    content = _load(path)
    try:
        if isinstance(content, dict) and "images" in content and "annotations" in content:
            return "coco", coco_images(content)
        if isinstance(content, list) and all(isinstance(task, dict) and "data" in task for task in content):
            return "label-studio", label_studio_images(content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return "other", {}


def _entry(names: Sequence[str], image_path: Path, group_dir: Path, export: Path, inside: bool) -> str | None:
    """Which of an export's image names means this image.

    In the group's folder the names may be longer (a path from elsewhere) or shorter than the image's path from there;
    above it they must at least name the group, since image names come back in every group.
    """
    needed = _parts(image_path.relative_to(group_dir if inside else group_dir.parent).as_posix())
    for strip in (False, True):
        matches, short = [], False
        for name in names:
            parts = _parts(name)
            if strip:
                parts = (*parts[:-1], UPLOAD_PREFIX.sub("", parts[-1]))
            if parts[-len(needed) :] == needed:
                matches.append(name)
            elif inside and needed[-len(parts) :] == parts:
                matches.append(name)
                short = True
        if len(matches) > 1:
            raise ValueError(f"{export}: {' and '.join(matches[:2])} may both mean {image_path.name}; keep one")
        if matches:
            if short and _namesakes(image_path, group_dir):
                raise ValueError(
                    f"{export}: {matches[0]} may mean several images called {image_path.name}; rename them"
                )
            return matches[0]
    return None


def _parts(name: str) -> tuple[str, ...]:
    return PurePosixPath(unicodedata.normalize("NFC", name)).parts  # macOS decomposes accents in file names


def _namesakes(image_path: Path, group_dir: Path) -> bool:
    """Whether another image of the group, in another of its folders, has the same name."""
    same = (path for path in group_dir.rglob("*") if path.stem == image_path.stem and path != image_path)
    return any(is_image_file(path) and not is_mask_file(path, group_dir) for path in same)


# ---- shared checks ----


def _load(path: Path):
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):  # malformed, or not UTF-8
        raise ValueError(f"{path}: not valid JSON, or cut short") from None


def _check_labelme_path(path: Path, content: dict, image_path: Path) -> None:
    drawn_on = content.get("imagePath")
    if drawn_on is None:
        return
    try:
        name = PurePosixPath(relative_name(drawn_on))
    except ValueError as error:
        raise ValueError(f"{path}: imagePath: {error}") from None
    if name.stem != image_path.stem:
        raise ValueError(
            f"{path}: drawn on {drawn_on}, not on {image_path.name}; correct its imagePath if it is right"
        )
