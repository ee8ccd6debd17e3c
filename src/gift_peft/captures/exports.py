"""JSON exports that hold many images, COCO and Label Studio: where they are, and which of their entries is a photo's.

An export lies in the group's folder, its `annotations/` or `masks/`, or in a folder above it up to the root. In the
group's folder names may be longer (a path from elsewhere) or shorter than the photo's path from there. Above it photos
of several groups may have one name, so an entry names the group's folder too, or exactly one photo there has its name.
"""

import json
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from glob import escape
from pathlib import Path, PurePosixPath
from typing import Any

from gift_peft.captures.coco import CocoImage, coco_images
from gift_peft.captures.folders import EXPORTS, Listing, holds_no_photos, same_name, uploaded_names
from gift_peft.captures.label_studio import LabelStudioImage, label_studio_images
from gift_peft.files import is_lfs_pointer
from gift_peft.images import is_image_file

# Label Studio puts eight digits before the names of uploaded files; Roboflow makes photo_png.rf.<digest>.jpg of them.
UPLOAD_PREFIX = re.compile(r"^[0-9a-f]{8}-")
ROBOFLOW = re.compile(r"_([A-Za-z0-9]{2,5})\.rf\.[0-9A-Za-z]+\.[a-z]+$")
TOOLS = {"coco": "COCO", "label-studio": "Label Studio"}


def list_exports(base: Path, listing: Listing) -> Iterator[Path]:
    """JSON files of a folder that may hold many images: those that are not one image's own."""
    for folder in (base, *listing.subfolders(base, EXPORTS)):
        for path in listing.entries(folder):
            stem = same_name(path.stem)
            own = stem in listing.photo_stems(folder) or stem in listing.photo_stems(base)
            if path.suffix.lower() == ".json" and not own:
                yield path


def read_export(path: Path) -> tuple[str, dict[str, CocoImage] | dict[str, LabelStudioImage]]:
    """("coco" | "label-studio" | "other", what it says of each image name); ValueError naming a damaged file."""
    try:
        stat = path.stat()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    return _parsed(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=16)  # one file serves every image of a group, or of many groups
def _parsed(path: Path, modified: int, length: int) -> tuple[str, dict]:
    content = load_json(path)
    try:
        if isinstance(content, dict) and "images" in content and "annotations" in content:
            return "coco", coco_images(content)
        if isinstance(content, list) and all(isinstance(task, dict) and "data" in task for task in content):
            return "label-studio", label_studio_images(content)
        if (
            isinstance(content, list)
            and content
            and all(isinstance(item, dict) and "annotation_id" in item for item in content)
        ):
            raise ValueError("Label Studio's short form (JSON-MIN) is not read; export as JSON or COCO")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return "other", {}


def load_json(path: Path) -> Any:
    """A JSON file's content, with a byte order mark or without; ValueError naming the file."""
    try:
        content = path.read_bytes()
        if is_lfs_pointer(content):
            raise OSError(0, "only Git LFS's pointer to it is there: `git lfs pull` fetches the file")
        return json.loads(content)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):  # malformed, or not UTF-8
        raise ValueError(f"{path}: not valid JSON, or cut short") from None


def find_entry(
    names: Sequence[str], photo: Path, group_dir: Path, export: Path, base: Path, listing: Listing
) -> str | None:
    """Which of an export's image names means this photo; `base` is the folder that the export belongs to.

    ValueError where two names, or one name and two photos of the group, fit.
    """
    inside = base == group_dir
    whole = _parts(photo.relative_to(group_dir if inside else group_dir.parent).as_posix())
    forms = [(_parts, whole), (_stripped, whole)]
    # The export of photos that were converted, or renamed by a system without capitals.
    if sum(is_image_file(path) for path in listing.called(photo.parent, same_name(photo.stem))) <= 1:
        forms.append((_loose, _loose("/".join(whole))))
    for renamed in uploaded_names(photo.name):
        if listing.uploaded(photo.parent)[renamed] == 1:
            forms.append((_loose, _loose("/".join((*whole[:-1], renamed)))))
    for form, needed in forms:
        matches, short = [], False
        for name in names:
            parts = form(name)
            if parts[-len(needed) :] == needed:
                matches.append(name)
            elif inside and needed[-len(parts) :] == parts:
                matches.append(name)
                short = True
        if matches:
            found = _only(matches, photo, export)
            if short and namesakes(photo, group_dir):
                raise ValueError(f"{export}: {found} may mean several images called {photo.name}; rename them")
            return found
    if inside:
        return None
    called = same_name(photo.name)
    matches = _bare(names, called) if listing.photo_names(base)[called] == 1 else []
    for renamed in uploaded_names(photo.name):
        if not matches and listing.uploaded(base, deep=True)[renamed] == 1:
            matches = _bare(names, renamed)
    return _only(matches, photo, export) if matches else None


def describe_export(path: Path, photo: Path, base: Path, group_dir: Path, listing: Listing) -> str | None:
    """What to tell somebody whose photo is not in this export; None for a file that is none."""
    kind, images = read_export(path)
    if kind not in TOOLS:
        return None
    count = listing.photo_names(base)[same_name(photo.name)]
    if base != group_dir and count > 1 and _bare(list(images), same_name(photo.name)):
        below = photo.relative_to(group_dir.parent).as_posix()
        return (
            f"{path} ({TOOLS[kind]}) lists {photo.name}, a name that {count} photos below {base} have; call it {below}"
        )
    return f"{path} ({TOOLS[kind]}, {len(images)} images) does not list {photo.name}"


def namesakes(photo: Path, group_dir: Path) -> bool:
    """Whether another photo of the group, in another of its folders, has the same name."""
    for path in group_dir.rglob(f"{escape(photo.stem)}.*"):
        folders = path.relative_to(group_dir).parts[:-1]
        if (
            path != photo
            and path.stem == photo.stem
            and is_image_file(path)
            and not any(map(holds_no_photos, folders))
        ):
            return True
    return False


def _bare(names: Sequence[str], called: str) -> list[str]:
    """The names without a folder that are this one."""
    return [name for name in names if called in ("/".join(_parts(name)), "/".join(_stripped(name)))]


def _only(matches: list[str], photo: Path, export: Path) -> str:
    if len(matches) > 1:
        raise ValueError(f"{export}: {' and '.join(matches[:2])} may both mean {photo.name}; keep one")
    return matches[0]


def _parts(name: str) -> tuple[str, ...]:
    return PurePosixPath(same_name(name)).parts


def _loose(name: str) -> tuple[str, ...]:
    """Without regard to capitals and to the suffix of a picture."""
    *folders, last = _stripped(name)
    return (*folders, PurePosixPath(last).stem.casefold())


def _stripped(name: str) -> tuple[str, ...]:
    """Without what Label Studio and Roboflow add to names."""
    *folders, last = _parts(name)
    return (*folders, ROBOFLOW.sub(r".\1", UPLOAD_PREFIX.sub("", last)))
