"""Where the mask of a photo is, in whatever form people draw them, and its pixels.

`find_mask` looks, in this order, for: a picture `masks/<name>.png` (or another kind) or `<name>_mask.png`; labelme's
`<name>.json`; CVAT's `SegmentationClass/<name>.png` (colors named by `labelmap.txt`); and the exports of many images
(`exports.py`). The first found counts; an export that only lists the photo, unlabeled, counts last. Masks follow the
rules of `images.to_mask`; where a file knows several labels, `mask_class` names the target's.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from gift_peft.captures.cvat import labelmap_path, read_colors
from gift_peft.captures.exports import describe_export, find_entry, list_exports, load_json, namesakes, read_export
from gift_peft.captures.folders import EXPORTS, PICTURE_MASKS, Listing, holds_no_photos, same_name
from gift_peft.captures.labelme import read_labelme
from gift_peft.captures.labels import MaskClass, check_size, split_classes
from gift_peft.captures.links import checked
from gift_peft.images import SINGLE_CHANNEL, SUFFIXES, is_image_file, open_image, to_mask

MASK_SUFFIXES = SUFFIXES | {".gif"}
GROUP_MASK = "mask"  # `mask.*` beside the photos holds for all of them
MARK = re.compile(r"[-_. ]mask$", re.IGNORECASE)  # photo_mask.png beside photo.jpg, and the like
ENDINGS = ("_mask", "-mask", ".mask", " mask")
# Files of masks that are not read, and folders that people keep them in: named where a mask is missing.
UNREAD = {".npy", ".npz", ".mat", ".svg", ".psd", ".xcf", ".kra", ".txt", ".csv", ".jsonl", ".ndjson", ".icloud"}
MORE_FOLDERS = (*EXPORTS, "labels", "label", "ann", "jsons")
HIDES_EXIF = ("labelme", "coco", "cvat")  # forms whose tools do not all go by a photo's EXIF rotation


@dataclass(frozen=True)
class MaskSource:
    """One image's mask on disk.

    Args:
        path (`Path`): the file that holds it.
        kind (`str`): "png" (any picture), "labelme", "coco" or "label-studio".
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
        labelmap = labelmap_path(self.path) if self.kind == "png" else None
        return (self.path,) if labelmap is None else (self.path, labelmap)

    @property
    def annotated(self) -> bool:
        """False where a file only lists the image, and nobody has said what is in it."""
        return self.entry is None or self._record().annotated

    @property
    def hides_exif(self) -> bool:
        """Whether it may be from a tool that ignores a photo's EXIF rotation."""
        return ("cvat" if len(self.files) > 1 else self.kind) in HIDES_EXIF

    def read(self, size: tuple[int, int]) -> np.ndarray:
        """The (H, W) bool target region for an image of `size` (width, height).

        Raises ValueError naming the file: another size, several values or labels without a class, a class that is not
        there, damaged or unreadable content.
        """
        if self.kind == "png":
            return _read_picture(self.path, size, self.mask_class)
        try:
            if self.kind == "labelme":
                return read_labelme(load_json(self.path), size, self.mask_class)
            return self._record().read(size, self.mask_class)
        except ValueError as error:
            at = f"{self.path}, image {self.entry}" if self.entry else str(self.path)
            raise ValueError(str(error) if str(self.path) in str(error) else f"{at}: {error}") from None

    def _record(self) -> Any:
        record = read_export(self.path)[1].get(self.entry or "")
        if record is None:
            raise ValueError(f"{self.path}, image {self.entry}: the file has changed and no longer lists it")
        return record


def is_mask_file(path: Path, group_dir: Path) -> bool:
    """Whether a picture in a group's folder is a mask: in a mask folder, called `mask.*`, or `<name>_mask.*` beside
    <name>.
    """
    folders = path.relative_to(group_dir).parent.parts
    if any(map(holds_no_photos, folders)) or _is_label_studio_picture(path) or is_group_mask(path):
        return True
    stem = MARK.sub("", same_name(path.stem))
    return stem != same_name(path.stem) and any(
        same_name(other.stem) == stem and is_image_file(other) for other in path.parent.iterdir() if other != path
    )


def is_group_mask(path: Path) -> bool:
    """Whether a file is called as the mask of all photos of a group is: `mask.*`, a picture or labelme's JSON."""
    return path.stem.casefold() == GROUP_MASK and path.suffix.lower() in (*MASK_SUFFIXES, ".json")


def find_group_mask(
    candidates: Sequence[Path], photo: Path, root: Path, mask_class: MaskClass = None
) -> MaskSource | None:
    """The mask of all photos of a group among files called `mask.*`; ValueError if there are two. `photo` is one of
    the group, whose links it may share.
    """
    found = []
    for path in candidates:
        kind = "labelme" if path.suffix.lower() == ".json" else "png"
        if kind == "png" or _is_labelme(load_json(checked(path, root, photo))):
            found.append(MaskSource(checked(path, root, photo), kind, None, mask_class))
    if len(found) > 1:
        raise ValueError(f"{found[0].path} and {found[1].path.name}: two masks for all photos of a group; keep one")
    return found[0] if found else None


def find_mask(
    image_path: Path, group_dir: Path, root: Path, mask_class: MaskClass = None, listing: Listing | None = None
) -> MaskSource | None:
    """The mask of an image inside `group_dir` (itself inside `root`), or None if there is no file that could hold it.

    Several images of a group share one `listing`.

    Raises ValueError naming the file for a damaged export, an ambiguous one, and for a mask whose links lead nowhere,
    or out of `root` and not where the photo's lead.
    """
    bases, listing = _bases(group_dir, root), listing or Listing()
    for path in _own_files(image_path, group_dir, bases, listing):
        kind = "png"
        if path.suffix.lower() == ".json":
            content = load_json(checked(path, root, image_path))
            if not _is_labelme(content):
                continue  # a camera's notes, perhaps
            kind = "labelme"
            _check_drawn_on(path, content, image_path)
        within = image_path.parent.relative_to(group_dir).parts
        own = path.is_relative_to(image_path.parent) or path.parent.match(str(Path("*", *within)))
        if not own and namesakes(image_path, group_dir):
            raise ValueError(f"{path} may belong to several images called {image_path.stem}; rename them")
        return MaskSource(checked(path, root, image_path), kind, None, mask_class)
    listed = None
    for base in bases:
        for path in list_exports(base, listing):
            kind, images = read_export(checked(path, root, image_path))
            entry = find_entry(list(images), image_path, group_dir, path, base, listing)
            if entry is not None:
                source = MaskSource(path, kind, entry, mask_class)
                if images[entry].annotated:
                    return source
                listed = listed or source
    for folder in (image_path.parent, group_dir, *listing.subfolders(group_dir, PICTURE_MASKS)):
        if unnamed := next(filter(_is_label_studio_picture, listing.entries(folder)), None):
            raise ValueError(
                f"{unnamed}: Label Studio's PNG export names the task but not the image; rename it to "
                f"{image_path.stem}_mask.png, or export as JSON or COCO"
            )
    return listed


def explain_missing(image_path: Path, group_dir: Path, root: Path) -> str:
    """What was looked for in vain and what was seen instead, in one line."""
    expected = image_path.parent / "masks" / f"{image_path.stem}.png"
    parts = [f"missing mask {expected} for the image {image_path.name}"]
    listing = Listing()
    names = listing.photo_names(group_dir)
    for folder in dict.fromkeys(
        [*listing.subfolders(image_path.parent, EXPORTS), *listing.subfolders(group_dir, EXPORTS)]
    ):
        files = [path for path in listing.entries(folder) if path.suffix.lower() in MASK_SUFFIXES]
        strange = [path.name for path in files if same_name(path.stem) not in names]
        if strange:
            more = f" and {len(strange) - 2} more fit" if len(strange) > 2 else " fit" + "s" * (len(strange) == 1)
            parts.append(f"in {folder.name}/ {', '.join(strange[:2])}{more} no photo's name")
    for base in _bases(group_dir, root):
        for folder in (base, *listing.subfolders(base, EXPORTS)):
            xml = [str(path) for path in listing.entries(folder) if path.suffix.lower() == ".xml"]
            parts += [f"{path} is not read (export as COCO, or as masks)" for path in xml]
        seen = list_exports(base, listing)
        parts += filter(None, (describe_export(path, image_path, base, group_dir, listing) for path in seen))
    if unread := _unread(image_path, group_dir, root, listing):
        more = f" and {len(unread) - 2} more" if len(unread) > 2 else ""
        forms = "masks are pictures, or files of labelme, CVAT, COCO or Label Studio"
        parts.append(f"not read: {', '.join(unread[:2])}{more} ({forms})")
    for folder in filter(Path.is_dir, listing.entries(group_dir)):
        if not holds_no_photos(folder.name) and same_name(image_path.stem) in listing.photo_stems(folder):
            parts.append(f"if {folder.name}/ holds masks and not photos, call it masks/")
    return "; ".join(
        [
            *parts,
            "draw it with `gift-peft studio RAW`, or `gift-peft prepare RAW OUT --propose-masks` draws first ones",
        ]
    )


def _unread(image_path: Path, group_dir: Path, root: Path, listing: Listing) -> list[str]:
    """Files that may hold masks in a form that is not read, by their places in the tree."""
    within = [image_path.parent, *_bases(group_dir, root)]
    folders = [path for folder in within for path in (folder, *listing.subfolders(folder, MORE_FOLDERS))]
    found = []
    for folder in dict.fromkeys(folders):
        below = folder.is_relative_to(group_dir)  # above the group, text files are notes and lists
        for path in listing.entries(folder):
            kind = path.suffix.lower()
            if _is_strange_json(path, root, image_path) if kind == ".json" else kind in UNREAD and below:
                found.append(path.relative_to(root).as_posix())
    return found


def _is_strange_json(path: Path, root: Path, photo: Path) -> bool:
    """Whether a JSON is about this photo, in a form of no tool that is known here."""
    try:
        known = _is_labelme(load_json(checked(path, root, photo))) or read_export(path)[0] != "other"
        return not known and (path.stem in (photo.stem, photo.name) or photo.name.encode() in path.read_bytes())
    except (OSError, ValueError):
        return False


def _bases(group_dir: Path, root: Path) -> list[Path]:
    return [group_dir, *(folder for folder in group_dir.parents if folder.is_relative_to(root))]


def _own_files(image_path: Path, group_dir: Path, bases: Sequence[Path], listing: Listing) -> Iterator[Path]:
    """Where a file with this image's mask alone may be, most specific first."""
    within = image_path.relative_to(group_dir).parent
    of_group = listing.subfolders(group_dir, PICTURE_MASKS)
    folders = list(
        dict.fromkeys(
            [
                *listing.subfolders(image_path.parent, PICTURE_MASKS),
                *(folder / within for folder in of_group),
                *of_group,
            ]
        )
    )
    for folder in folders:
        yield from _called(listing, folder, image_path, MASK_SUFFIXES)
    for folder in (*folders, image_path.parent):
        found = [path for end in ENDINGS for path in _called(listing, folder, image_path, MASK_SUFFIXES, end)]
        if len(found) > 1:
            raise ValueError(f"{found[0]} and {found[1].name} may both be the mask of {image_path.name}; keep one")
        yield from found
    for folder in (image_path.parent, *folders, *listing.subfolders(group_dir, EXPORTS)):
        yield from _called(listing, folder, image_path, {".json"})
    for base in bases:  # CVAT keeps the images' folders below its own, as they were uploaded
        start = image_path.parent if base == group_dir else group_dir.parent
        places = [image_path.parent.relative_to(folder) for folder in (base, start)]
        for folder in (base, *listing.subfolders(base, EXPORTS)):
            pictures = folder / "SegmentationClass"
            if pictures.is_dir():
                bare = base != group_dir and listing.photo_names(base)[same_name(image_path.stem)] == 1
                for place in dict.fromkeys([*places, *([Path()] if bare else [])]):
                    yield from _called(listing, pictures / place, image_path, MASK_SUFFIXES)


def _called(listing: Listing, folder: Path, photo: Path, suffixes: Collection[str], ending: str = "") -> list[Path]:
    """The file of a folder that is called as the photo is, with `ending`: exactly, else in another case, else with the
    photo's whole name (`1.jpg.png`), unless another photo is called so; [] if there is none, ValueError if several.
    """
    stem, name = same_name(photo.stem), same_name(photo.name)
    levels: tuple[list[Path], ...] = [], [], []
    for path in listing.called(folder, stem + ending):
        given = same_name(path.stem)[: len(stem)]
        if path == photo or path.suffix.lower() not in suffixes:
            continue
        if given == stem:
            levels[0].append(path)
        elif given not in listing.photo_stems(photo.parent):
            levels[1].append(path)
    for path in listing.called(folder, name + ending):
        if path.suffix.lower() in suffixes and name not in listing.photo_stems(photo.parent):
            levels[2].append(path)
    for found in filter(None, levels):
        found = [path for path in found if path.suffix == ".png"] or found
        if len(found) > 1:
            raise ValueError(f"{found[0]} and {found[1].name} may both be the mask of {photo.name}; keep one")
        return found
    return []


def _is_label_studio_picture(path: Path) -> bool:
    return re.match(r"task-\d+-annotation-\d+-.*\.png$", path.name) is not None


def _is_labelme(content: Any) -> bool:
    return isinstance(content, dict) and "shapes" in content


def _check_drawn_on(path: Path, content: dict, image_path: Path) -> None:
    """labelme notes which photo it drew on, by a path from the JSON or of another machine: the name alone counts."""
    drawn_on = content.get("imagePath") or image_path.name
    if not isinstance(drawn_on, str):
        raise ValueError(f"{path}: imagePath: {drawn_on!r} is not an image's name")
    stem = PurePosixPath(drawn_on.replace("\\", "/")).stem
    if same_name(stem).casefold() != same_name(image_path.stem).casefold():
        raise ValueError(
            f"{path}: drawn on {drawn_on}, not on {image_path.name}; correct its imagePath if it is right"
        )


def _read_picture(path: Path, size: tuple[int, int], mask_class: MaskClass) -> np.ndarray:
    image = open_image(path)
    check_size(f"{path}: the mask is", image.size, size)
    labelmap = labelmap_path(path)
    values, names = split_classes(mask_class)
    if labelmap is not None and (names or image.mode == "P" or image.mode not in SINGLE_CHANNEL):
        return read_colors(image, path, labelmap, mask_class)
    if names and not values:
        raise ValueError(f"{path}: mask_class {names[0]!r} is a label, and this mask holds numbers; name its number")
    mask = to_mask(image, str(path), values or None)
    if not values and image.mode in (*SINGLE_CHANNEL, "RGB"):
        _check_levels(image, mask, path)
    return mask


def _check_levels(image: Image.Image, mask: np.ndarray, path: Path) -> None:
    """Raise ValueError where a mask is empty or full only because what is drawn in it is neither black nor white."""
    levels = np.asarray(image.convert("L") if image.mode in ("P", "RGB") else image)
    low, high = int(levels.min()), int(levels.max())
    drawn = low != high and (mask.all() or not mask.any())
    if drawn or 1 < high < 128:
        found = f"the values {low} and {high}" if drawn else f"the value {high}"
        raise ValueError(
            f"{path}: {found}, not black and white; name the target's in group.yaml (`mask_class: {high}`)"
        )
