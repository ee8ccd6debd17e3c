"""Published datasets by name, and the flat form of public mask datasets: `gift-peft prepare --layout booster`.

`booster`: `[train/][balanced|unbalanced/]<Scene>/camera_00/*` and `mask_cat.png`, whose classes 2 and 3 are the
target. The illuminations of a scene are a training group.
`cleargrasp`: the real pairs `<set>/<camera>/<id>-transparent-rgb-img.jpg`, `-opaque-rgb-img.jpg` (the sprayed twin),
`-mask.png` and `-opaque-depth-img.exr`. Each is a validation group with reference and depth.
`photos`: `[train/]images/<name>.*` and `[train/]masks/<name>.*`, perhaps a `group.yaml` beside them for all.
Each photo is a group of one.
docs/capture.md says how to get the data and what their licenses are.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gift_peft.captures.folders import Listing, same_name
from gift_peft.captures.foreign import Layout, read_layout
from gift_peft.captures.group_facts import read_facts
from gift_peft.captures.links import checked
from gift_peft.captures.masks import MASK_SUFFIXES, MaskSource
from gift_peft.captures.tree import Capture
from gift_peft.files import is_leftover
from gift_peft.images import is_image_file, natural_key, sort_pictures
from gift_peft.options import did_you_mean

logger = logging.getLogger(__name__)

BOOSTER_CAMERA, BOOSTER_CLASSES, BOOSTER_TARGET = "camera_00", "mask_cat.png", [2, 3]
CLEARGRASP_PHOTO, CLEARGRASP_REFERENCE = "-transparent-rgb-img", "-opaque-rgb-img"
CLEARGRASP_MASK, CLEARGRASP_DEPTH = "-mask.png", "-opaque-depth-img.exr"
# As public mask datasets call them (GDD, GSD, MSD, PMD, Trans10K), written in any case.
PHOTO_FOLDERS = ("images", "image", "imgs", "img", "rgb", "jpegimages")
MASK_FOLDERS = ("masks", "mask", "gt", "labels", "segmentationclass")
TRAIN_FOLDERS = ("train", "training")
OTHER_FOLDERS = ("validation", "val", "valid", "test", "testing")


@dataclass(frozen=True)
class KnownLayout:
    """A layout that has a name; one of `LAYOUTS`."""

    name: str

    def find(self, raw: Path) -> dict[str, list[Capture]]:
        """The groups of each split, whole, in natural order. Raises FileNotFoundError naming what is missing."""
        split, groups = LAYOUTS[self.name]
        found = list(groups(raw))
        if not found:
            raise FileNotFoundError(f"{raw}: the layout {self.name} finds nothing there; {EXPECTED[self.name]}")
        return {split: found}


def choose_layout(name: str) -> Layout | KnownLayout:
    """The layout of this name, or else of the YAML file; FileNotFoundError or ValueError if there is neither."""
    if name in LAYOUTS:
        return KnownLayout(name)
    if not Path(name).exists():
        names = ", ".join(LAYOUTS)
        raise FileNotFoundError(f"layout {name}: neither a file nor one of {names}{did_you_mean(name, LAYOUTS)}")
    return read_layout(name)


# ---- Booster ----


def _booster(raw: Path) -> Iterator[Capture]:
    for camera in _folders_called(raw, BOOSTER_CAMERA):
        scene = camera.parent
        images = [checked(path, raw) for path in sort_pictures(camera.iterdir())]
        classes = scene / BOOSTER_CLASSES
        if not images:
            continue
        if not classes.is_file():
            if "test" in scene.relative_to(raw).parts:  # its ground truth is not published
                logger.warning("%s: a test scene, without %s; it is left out", scene, BOOSTER_CLASSES)
                continue
            raise FileNotFoundError(f"missing {classes}, the material classes of the scene")
        mask = MaskSource(checked(classes, raw, images[0]), "png", None, BOOSTER_TARGET)
        yield Capture(scene, _group_id(scene, raw), "train", images, [mask] * len(images), root=raw)


# ---- ClearGrasp ----


def _cleargrasp(raw: Path) -> Iterator[Capture]:
    photos = [path for path in raw.rglob(f"*{CLEARGRASP_PHOTO}.*") if _counts(path, raw)]
    for photo in sorted(photos, key=lambda path: natural_key(path.relative_to(raw).as_posix())):
        start = photo.stem.removesuffix(CLEARGRASP_PHOTO)
        references = sort_pictures(photo.parent.glob(f"{start}{CLEARGRASP_REFERENCE}.*"))
        mask, depth = (photo.with_name(start + ending) for ending in (CLEARGRASP_MASK, CLEARGRASP_DEPTH))
        if not references:
            missing = photo.with_name(start + CLEARGRASP_REFERENCE + photo.suffix)
            raise FileNotFoundError(f"missing {missing}, the sprayed twin of {photo.name}")
        if not mask.is_file():
            raise FileNotFoundError(f"missing {mask}, the mask of {photo.name}")
        yield Capture(
            photo.parent,
            f"{_group_id(photo.parent, raw)}__{start}",
            "validation",
            [checked(photo, raw)],
            [MaskSource(checked(mask, raw, photo), "png")],
            checked(references[0], raw, photo),
            {"surface": "transparent"},
            root=raw,
            depth=checked(depth, raw, photo) if depth.is_file() else None,
        )


# ---- photos ----


def _photos(raw: Path) -> Iterator[Capture]:
    listing = Listing()
    bases = [raw, *listing.subfolders(raw, TRAIN_FOLDERS)]
    for folder in listing.subfolders(raw, OTHER_FOLDERS):
        logger.warning("%s: left out; to measure on, a photo needs a treated reference or a series", folder)
    for base in bases:
        masks, facts = listing.subfolders(base, MASK_FOLDERS), read_facts(base)
        for folder in listing.subfolders(base, PHOTO_FOLDERS):
            if not masks:
                raise FileNotFoundError(f"{base}: {folder.name}/ and no masks/ beside it")
            drawn = {
                (place, same_name(path.stem)): path
                for place, masks_folder in enumerate(masks)
                for path in sorted(masks_folder.iterdir())
                if path.suffix.lower() in MASK_SUFFIXES and not is_leftover(path.name)
            }
            for photo in sort_pictures(folder.iterdir()):
                keys = [(place, same_name(photo.stem)) for place in range(len(masks))]
                path = next((checked(drawn[key], raw, photo) for key in keys if key in drawn), None)
                # Where there is none, reading this one says so, and the other photos are made.
                path = path or masks[0] / f"{photo.stem}.png"
                mask = MaskSource(path, "png", None, facts.get("mask_class"))
                yield Capture(folder, photo.stem, "train", [checked(photo, raw)], [mask], facts=facts, root=raw)


# ---- parts ----


def _folders_called(raw: Path, name: str) -> list[Path]:
    """Folders of this name in and below `raw`, in natural order."""
    found = [path for path in raw.rglob(name) if path.is_dir() and _counts(path, raw)]
    return sorted(found, key=lambda path: natural_key(path.relative_to(raw).as_posix()))


def _counts(path: Path, raw: Path) -> bool:
    """Whether neither the path nor a folder above it is a leftover."""
    inside = path.relative_to(raw)
    return not any(map(is_leftover, inside.parts)) and (path.is_dir() or is_image_file(path))


def _group_id(folder: Path, raw: Path) -> str:
    """The folder's path below the root, with __ for the separators."""
    return folder.resolve().name if folder == raw else folder.relative_to(raw).as_posix().replace("/", "__")


LAYOUTS = {"booster": ("train", _booster), "cleargrasp": ("validation", _cleargrasp), "photos": ("train", _photos)}
EXPECTED = {
    "booster": f"it looks for <Scene>/{BOOSTER_CAMERA}/*.png and <Scene>/{BOOSTER_CLASSES}",
    "cleargrasp": f"it looks for <camera>/<id>{CLEARGRASP_PHOTO}.jpg, its {CLEARGRASP_REFERENCE}.jpg and "
    f"{CLEARGRASP_MASK}",
    "photos": "it looks for images/<name>.jpg and masks/<name>.png, also in train/",
}
