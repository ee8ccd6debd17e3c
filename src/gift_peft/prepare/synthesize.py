"""Groups from single photos: the photo, and copies whose target is painted in one plain color (beyond the paper).

For people who have no tripod series and want the group form, or the paper's loss: `gift-peft synthesize PHOTOS OUT`.
OUT is a raw tree with a train split alone. Each group is written whole or not at all, and its `group.yaml` says what
it was made from; that is how a later run knows what is still right, and which folders are its own.
"""

import io
import json
import os
import re
import shutil
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from PIL import Image
from tqdm import tqdm

from gift_peft.captures.masks import MaskSource, is_mask_file
from gift_peft.captures.tree import Capture, check_masks, find_groups, read_capture
from gift_peft.files import printable, read_yaml, remove_folder, strangers, whole_folder, write_whole
from gift_peft.images import image_digest, is_image_file, read_image
from gift_peft.prepare.job import capture_digest
from gift_peft.prepare.out_folder import alone, check_card, check_places, note_card, side_by_side
from gift_peft.rules import SPLITS, check_group_id
from gift_peft.surface_targets import paint_fills

VERB, STATE = "synthesize", ".synthesize"
PAINTING = 1  # a new number makes every group again
MARK = "synthesized"  # the key of group.yaml

CARD = """---
pretty_name: {name}
task_categories:
- depth-estimation
tags:
- gift-peft
- synthetic
---
# Painted copies of single photos

{groups} groups, {images} images, made by `gift-peft synthesize`. **These are not photos of one scene with different
reflections.** In each group `0_photo.png` is a photo; the others are copies of it whose target (the mask) is painted
in one plain color. Outside of the mask they are equal. `group.yaml` names the photo.

For training only: nothing here says where the surface really is.
"""


@dataclass(frozen=True)
class SynthesisReport:
    """What became of the photos.

    Args:
        groups (`list[str]`): ids of the groups of this command that OUT now holds, in the order of PHOTOS.
        made (`list[str]`): those of them that this run has written.
        removed (`list[str]`): ids of groups of earlier runs whose photo is gone.
        skipped (`dict[str, str]`): groups of PHOTOS that are not for training, and why.
        rejected (`dict[str, str]`): photos or groups with something wrong, and what.
    """

    groups: list[str] = field(default_factory=list)
    made: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    rejected: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Job:
    """One photo: its files, how it is called in PHOTOS, the folder that its group gets, and what is chosen."""

    capture: Capture
    name: str
    folder: Path
    fills: int
    seed: int


@dataclass(frozen=True)
class _Outcome:
    made: bool = False
    wrong: str | None = None


def synthesize_groups(
    photos: str | Path, out: str | Path, fills: int = 3, seed: int = 0, num_proc: int = 1
) -> SynthesisReport:
    """Make a training group of every single photo: the photo, and copies with its target painted in one plain color.

    PHOTOS is only read. OUT becomes a raw tree, `OUT/train/<group>/`, that `load_gift_i` and `train` read. Outside of
    the mask the copies equal the photo to the byte; the colors depend on the seed and the photo alone. What an earlier
    run made of the same files and choices stays, everything else of it is made again or removed; folders that this
    function did not make are left as they are. Groups in `validation/` or with a treated reference are skipped. A
    photo with something wrong (no mask, an empty one, one of another size or over the whole photo, a file that cannot
    be read) is rejected in the report, and the others are made.

    Args:
        photos (`str` or `Path`): a raw tree, each of whose train photos becomes a group, or a flat folder of photos
            with `masks/<stem>.png`; masks may have any form that the raw tree knows.
        out (`str` or `Path`): new, empty, or made by this function before; neither inside PHOTOS nor around it.
        fills (`int`): painted copies of each photo, at least 1.
        seed (`int`): of the colors, at least 0.
        num_proc (`int`): processes that paint photos side by side; the files do not depend on it.

    Raises:
        ValueError, OSError: one line; a number is too small, `photos` or `out` is not what it should be, two groups
            would have one name, another run is at work in `out`, or it cannot be written.
    """
    photos, out = Path(photos), Path(out)
    for name, value, least in (("fills", fills, 1), ("seed", seed, 0), ("num_proc", num_proc, 1)):
        if value < least:
            raise ValueError(f"{name}: at least {least}, got {value}")
    check_places(VERB, photos, "PHOTOS", out, STATE)
    report = SynthesisReport()
    jobs = _list_jobs(photos, out / "train", fills, seed, report)
    with alone(VERB, out, STATE):
        check_card(VERB, out, STATE)
        _tidy(out / "train", {job.folder.name for job in jobs}, report)
        outcomes = {}
        with tqdm(total=len(jobs), desc="photos", unit="photo", disable=None, delay=2) as bar:
            for job, outcome in side_by_side(VERB, _make_group, jobs, num_proc):
                outcomes[job.name] = outcome
                bar.update()
        for job in jobs:
            outcome = outcomes[job.name]
            if outcome.wrong is not None:
                report.rejected[job.name] = outcome.wrong
                continue
            report.groups.append(job.folder.name)
            if outcome.made:
                report.made.append(job.folder.name)
        _write_card(photos, out, len(report.groups), fills)
        note_card(out, STATE)
    return report


# ---- which photos ----


def _list_jobs(photos: Path, train: Path, fills: int, seed: int, report: SynthesisReport) -> list[_Job]:
    """Every photo that is for training; groups that are not, or cannot be read, are noted in the report."""
    flat = any(is_image_file(path) and not is_mask_file(path, photos) for path in photos.iterdir())
    jobs: dict[str, _Job] = {}
    for capture in [_read_flat(photos)] if flat else _read_tree(photos, report):
        for path, mask in zip(capture.images, capture.masks, strict=True):
            stem = path.relative_to(capture.folder).with_suffix("").as_posix()
            one = [capture.group_id, stem] if len(capture.images) > 1 else [capture.group_id]
            group_id = re.sub(r'[\\:*?"<>|]', "_", "__".join([stem] if flat else one).replace("/", "__"))
            name = path.relative_to(photos).as_posix()
            job = _Job(replace(capture, images=[path], masks=[mask]), name, train / group_id, fills, seed)
            # Some file systems fold case: two such groups would share a folder there.
            other = jobs.setdefault(group_id.casefold(), job)
            if other is not job:
                raise ValueError(f"{path} and {photos / other.name}: both would be group {group_id}; rename one")
    return list(jobs.values())


def _read_flat(photos: Path) -> Capture:
    """All photos of a flat folder as one capture."""
    mixed = f"PHOTOS {photos}: photos beside folders of photos; it holds either, not both"
    if any((photos / split).is_dir() for split in SPLITS):
        raise ValueError(mixed)
    capture = read_capture(photos, "train", photos)
    if any(path.parent != photos for path in capture.images):
        raise ValueError(mixed)
    if capture.common is not None:
        raise ValueError(f"{capture.common.path}: one mask for all photos of a group, and these are of many scenes")
    if MARK in capture.facts:
        raise ValueError(f"PHOTOS {photos}: these are painted copies already")
    if capture.reference is not None:
        raise ValueError(
            f"{capture.reference}: its name says that it is a treated reference, so this is a validation group; "
            "painted copies are for training (a photo of another name is one)"
        )
    return capture


def _read_tree(photos: Path, report: SynthesisReport) -> list[Capture]:
    captures = []
    for split, folders in find_groups(photos).items():
        for folder in folders:
            name = folder.relative_to(photos).as_posix()
            try:
                capture = read_capture(folder, split, photos)
            except (OSError, ValueError) as error:
                report.rejected[name] = " ".join(str(error).split())
                continue
            if split == "validation" or capture.reference is not None:
                report.skipped[name] = "it is for validation (by its folder or its treated reference)"
            elif MARK in capture.facts:
                report.skipped[name] = "these are painted copies already"
            else:
                captures.append(replace(capture, common=_for_all(capture)))
    return captures


def _for_all(capture: Capture) -> MaskSource | None:
    """What holds for the photos of a group without a mask of their own: `mask.*`, or the only annotation there is."""
    annotated = [mask for mask in capture.masks if mask is not None and mask.annotated]
    return annotated[0] if capture.common is None and len(annotated) == 1 else capture.common


# ---- one group ----


def _make_group(job: _Job) -> _Outcome:
    """Write the group of one photo unless it is there already. What is wrong with the photo is in the outcome."""
    foreign = _foreign(job.folder)
    try:
        check_group_id(job.folder.name)
        check_masks(job.capture)
        if job.name != printable(job.name):
            raise ValueError(f"{printable(job.name)}: the name is not valid Unicode text; rename the file")
        mark = {"photo": job.name, "fills": job.fills, "seed": job.seed}
        digest = capture_digest(job.capture, {**mark, "painting": PAINTING})
        if _is_current(job.folder, digest):
            return _Outcome()
        if foreign is not None:
            return _Outcome(wrong=foreign)
        pictures, mask = _paint(job)
    except (OSError, ValueError, cv2.error, MemoryError, RecursionError) as error:
        if foreign is None and os.path.lexists(
            job.folder
        ):  # what an earlier run made of this photo is no longer right
            remove_folder(job.folder)
        return _Outcome(wrong=" ".join(str(error).split()) or type(error).__name__)
    known = {key: value for key, value in job.capture.facts.items() if key in ("surface", "notes")}
    facts = {**known, "static_rig": True, MARK: {**mark, "digest": digest}}
    mask_file = _png(Image.fromarray(mask.astype(np.uint8) * 255))
    with whole_folder(job.folder, _files(_mark(job.folder))) as folder:
        for name, picture in zip(_names(job.fills), pictures, strict=True):
            write_whole(folder / name, _png(picture))
            write_whole(folder / "masks" / name, mask_file)
        write_whole(folder / "group.yaml", yaml.safe_dump(facts, sort_keys=False, allow_unicode=True))
    return _Outcome(made=True)


def _paint(job: _Job) -> tuple[list[Image.Image], np.ndarray]:
    """The photo and its painted copies, and the mask; ValueError or another error naming the file."""
    path, source = job.capture.images[0], job.capture.masks[0]
    if source is None or not source.annotated:
        source = job.capture.common or source
    image = read_image(path)
    mask = source.read(image.size)
    if not mask.any():
        raise ValueError(f"{path}: its mask ({source.path}) is empty, so there is no target to paint")
    if mask.all():
        raise ValueError(f"{path}: its mask ({source.path}) covers the whole photo; painted, nothing would be left")
    pixels = np.asarray(image)
    pictures = [Image.fromarray(array) for array in (pixels, *paint_fills(pixels, mask, job.fills, job.seed))]
    if len({image_digest(picture) for picture in pictures}) < len(pictures):
        raise ValueError(f"{path}: its target is so small that painted copies do not differ ({mask.sum()} pixels)")
    return pictures, mask


def _png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", compress_level=4)  # of a photo as small as at the usual 6, in a third of the time
    return buffer.getvalue()


def _names(fills: int) -> list[str]:
    """The images of a group; in natural order the photo comes first."""
    return ["0_photo.png", *(f"{number}_fill.png" for number in range(1, fills + 1))]


# ---- what is in OUT ----


def _mark(folder: Path) -> dict | None:
    """What this command noted in a group's folder; None if the folder is not its work."""
    try:
        mark = read_yaml(folder / "group.yaml").get(MARK)
    except (OSError, ValueError):
        return None
    return mark if isinstance(mark, dict) and isinstance(mark.get("fills"), int) else None


def _files(mark: dict | None) -> set[str]:
    """The files of a group that bears this mark; without one none is ours."""
    if mark is None:
        return set()
    names = _names(mark["fills"])
    return {"group.yaml", *names, *(f"masks/{name}" for name in names)}


def _is_current(folder: Path, digest: str) -> bool:
    mark = _mark(folder)
    return (
        mark is not None and mark.get("digest") == digest and all((folder / name).is_file() for name in _files(mark))
    )


def _foreign(folder: Path) -> str | None:
    """Why what lies at a group's place may not be replaced or removed; None if it may, or nothing is there."""
    if not os.path.lexists(folder):
        return None
    mark = _mark(folder)
    if mark is None:
        return f"{folder}: not made by gift-peft synthesize, so it is left as it is; move it away"
    if others := strangers(folder, _files(mark)):
        return f"{folder / others[0]}: not made by gift-peft synthesize, so its group is left as it is; move it away"
    return None


def _tidy(train: Path, wanted: Collection[str], report: SynthesisReport) -> None:
    """Remove what killed runs left half done, and the groups of this command whose photo is gone."""
    for leftover in [*train.glob(".*.tmp"), *train.glob(".*.old")]:
        shutil.rmtree(leftover, ignore_errors=True)
    for folder in sorted(train.glob("*")):
        if folder.name in wanted or _mark(folder) is None:
            continue
        if (foreign := _foreign(folder)) is not None:
            report.rejected[f"train/{folder.name}"] = f"its photo is gone; {foreign}"
            continue
        remove_folder(folder)
        report.removed.append(folder.name)


def _write_card(photos: Path, out: Path, groups: int, fills: int) -> None:
    if not groups:
        (out / "README.md").unlink(missing_ok=True)
        return
    name = json.dumps(f"Painted copies: {photos.resolve().name}")
    write_whole(out / "README.md", CARD.format(name=name, groups=groups, images=groups * (fills + 1)))
