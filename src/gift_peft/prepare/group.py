"""One group from photos to a checked, registered group on disk, in four steps: decode, register, check, write.

`prepare.py` runs this for every group of a tree.
"""

import math
import shutil
from dataclasses import asdict, fields
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from gift_peft.captures.measured_depth import read_measured_depth
from gift_peft.captures.tree import Capture, Decoded, check_masks, decode_capture
from gift_peft.dataset.writer import write_group
from gift_peft.files import printable
from gift_peft.prepare.entries import FrameEntry, GroupEntry, GroupQuality, ReferenceQuality, Remark
from gift_peft.prepare.frame_bar import note_frame
from gift_peft.prepare.job import Job, Outcome, capture_digest, group_choices, proposal_choices
from gift_peft.prepare.photo import Photo, Rejection
from gift_peft.prepare.quality import SmallFrame, check_frames, check_group_change, pairwise_changes
from gift_peft.prepare.registration import register, warp
from gift_peft.prepare.settings import QualitySettings
from gift_peft.rules import check_count, check_group_id, check_pair

MIN_SIDE = 32  # pixels; below, neither features nor local contrast mean anything
# Remarks that count for a treated reference; inside the target it differs by design.
ABOUT_REFERENCE = ("too_dark", "too_bright", "another_scene", "outside_change")


def prepare_group(job: Job) -> Outcome:
    """Read, register, check and stage one group. What is wrong with it ends in its entry, never in an exception."""
    cv2.setNumThreads(1)  # groups run side by side instead
    entry = GroupEntry(printable(job.group_id), job.split, job.relative(job.folder))
    digest = row = proposed_from = None
    try:
        check_group_id(job.group_id)
        capture = job.read()
        list_frames(capture, job, entry)
        digest = capture_digest(capture, group_choices(job.settings, capture))
        proposed_from = capture_digest(capture, proposal_choices(job.settings))
        if digest != job.known:
            row = _make(capture, job, entry, proposed_from)
    except Rejection as rejection:
        entry.reject(rejection.reason)
    except (OSError, ValueError, cv2.error, MemoryError, RecursionError) as error:
        entry.reject(Remark("unreadable", job.readable(error)))
        digest = None  # it may be a passing trouble (permissions, memory): try again next time
    return Outcome(digest, entry.as_json(), row, proposed_from)


def _make(capture: Capture, job: Job, entry: GroupEntry, proposed_from: str) -> dict:
    """The staged group's metadata row."""
    if not job.settings.propose_masks:
        try:
            check_masks(capture)
        except FileNotFoundError as error:
            raise Rejection("masks_missing", job.readable(error)) from None
    photos, reference, decoded = decode(capture, job, entry)
    entry.target_frame = photos[-1].entry.name
    static = job.settings.static_rig or capture.facts.get("static_rig", False)
    if decoded.common is not None:
        photos = carry_mask(photos, decoded.common, decoded.common_from, static, job)
    elif any(photo.mask is None for photo in photos):
        propose_masks(photos, reference, static, job, entry, proposed_from)
    register_photos(photos, reference, static, job)
    check(photos, reference, job, entry)
    depth = None if capture.depth is None else read_measured_depth(capture.depth, photos[-1].pixels.shape[:2])
    return write([photo for photo in photos if not photo.dropped], reference, depth, entry.surface, job)


def list_frames(capture: Capture, job: Job, entry: GroupEntry) -> None:
    """The group's facts and its pictures as the report lists them, before any is decoded."""
    notes = capture.facts.get("notes")
    entry.warnings += job.remarks
    entry.surface, entry.notes = capture.facts.get("surface"), None if notes is None else str(notes)
    paths = [(path, "observation") for path in capture.images]
    paths += [(capture.reference, "reference")] if capture.reference is not None else []
    for path, role in paths:
        name = capture.name(path) if path.is_relative_to(capture.folder) else path.name
        entry.frames.append(FrameEntry(printable(name), role, job.relative(path)))


def decode(capture: Capture, job: Job, entry: GroupEntry) -> tuple[list[Photo], Photo | None, Decoded]:
    """The observations without those that occur twice, the treated reference, and what else was found."""
    for path in capture.images:
        if str(path) != printable(str(path)):
            raise ValueError(f"{path}: the name is not valid Unicode text; rename the file")
    decoded = decode_capture(capture, job.settings.empty_masks, may_lack=job.settings.propose_masks)
    entry.warnings += [Remark(code, printable(text)) for code, text in decoded.notes.items()]
    if capture.split == "train" and (len(capture.images) > 1 or not job.may_be_single):
        check_pair(capture.group_id, len(decoded.kept))
    elif capture.split == "train":
        text = "a group of one photo: it trains with --target surface; --target consensus takes two to compare"
        entry.warnings.append(Remark("one_photo", text))
    size = decoded.images[0].size
    entry.size = list(size)
    if min(size) < MIN_SIDE:
        raise ValueError(f"group {entry.group_id}: {size[0]}x{size[1]} pixels; a side has at least {MIN_SIDE}")
    for index, first in decoded.duplicates.items():
        entry.frames[index].drop([Remark("duplicate", f"the same picture as {entry.frames[first].name}")])
    photos = [
        Photo(entry.frames[index], capture.images[index], np.asarray(image), mask)
        for index, image, mask in zip(decoded.kept, decoded.images, decoded.masks, strict=True)
    ]
    if decoded.reference is None:
        return photos, None, decoded
    return photos, Photo(entry.frames[-1], capture.reference, np.asarray(decoded.reference), None), decoded


def register_photos(photos: list[Photo], reference: Photo | None, static: bool, job: Job, again: bool = False) -> None:
    """Every other observation, and the treated reference, to the last observation.

    `again`: this will be done once more, with other masks, for which the photos' features need not be found again.
    """
    settings = job.settings.registration
    *others, last = photos
    last.matrix = np.eye(3)
    target = last.frame(last.mask, settings, again)
    for photo in others:
        photo.decide(register(photo.frame(photo.mask, settings, again), target, static))
        note_frame(job.notes)
    if reference is None:
        return
    # Nobody draws a mask for it, and the camera may have moved a little: the target's, and some more.
    around = None if last.mask is None else _around(last.mask)
    reference.decide(register(reference.frame(around, settings, again), target, static, treated=True))
    if reference.warped:
        text = "the camera moved before the treated reference was taken; it is warped"
        reference.entry.warnings.append(Remark("reference_moved", text))


def _around(mask: np.ndarray) -> np.ndarray:
    """The mask and a margin of a hundredth of the diagonal."""
    side = 2 * round(0.01 * float(np.hypot(*mask.shape))) + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side))) > 0


def carry_mask(photos: list[Photo], mask: np.ndarray, drawn_on: int | None, static: bool, job: Job) -> list[Photo]:
    """Give the one mask of a group to the photos that have none, each where its camera sees it.

    `drawn_on` is the photo of the mask, None for `mask.*`, which is of the target frame. Registered once for this,
    with the place of the target roughly known, photos are registered again with their own masks. Returns those.
    """
    source = photos[-1] if drawn_on is None else photos[drawn_on]
    lacking = [photo for photo in photos if photo.mask is None]
    for photo in lacking:
        photo.mask = mask if photo is source else _around(mask)
    register_photos(photos, None, static, job, again=True)
    if source.dropped:
        text = "; ".join(item.text for item in source.entry.reasons)
        raise Rejection("mask_not_carried", f"{source.entry.name} alone has a mask, and cannot be registered: {text}")
    for photo in lacking:
        if not photo.dropped:
            there = np.linalg.inv(photo.map) @ source.map
            photo.mask = mask if np.array_equal(there, np.eye(3)) else warp(mask, there)
    return [photo for photo in photos if not photo.dropped]


def propose_masks(
    photos: list[Photo], reference: Photo | None, static: bool, job: Job, entry: GroupEntry, proposed_from: str
) -> None:
    """Masks for a group that lacks some; they stay beside the dataset unless accepted.

    What an earlier run proposed from the same files and settings is taken as it is.
    """
    drawn = [photo.mask for photo in photos]
    if job.proposed is not None and job.proposed["from"] == proposed_from:
        entry.proposal = _take_over(photos, job)
    else:
        entry.proposal = _propose(photos, reference, static, job)
    score, least = entry.proposal["score"], job.settings.min_proposal_score
    if not entry.proposal["masks"]:
        raise Rejection("no_proposal", "nothing stands out from noise and changes of the light; draw the masks")
    if not job.settings.accept_proposed_masks:
        text = "masks are missing; look at the proposed ones, then copy them into masks/ or accept them"
        raise Rejection("masks_proposed", f"{text} (--accept-proposed-masks)")
    if score < least:
        text = (
            f"the proposed mask has a score of {score:.2f}, below {least:g}, and is not accepted: much of what "
            "changes lies elsewhere, so this may be no target; look at it, then copy it into masks/, draw another, "
            f"or accept it with --min-proposal-score {math.floor(100 * score) / 100:g}"
        )
        raise Rejection("weak_proposal", text)
    entry.proposal["accepted"] = True
    for photo, mask in zip(photos, drawn, strict=True):
        if mask is not None:
            photo.mask = mask
        elif photo.mask is None:  # dropped by registration, and it will be again
            photo.mask = np.zeros(photo.pixels.shape[:2], bool)


def _propose(photos: list[Photo], reference: Photo | None, static: bool, job: Job) -> dict:
    """The entry's `proposal`, its masks in the staging folder and in `photos` (None where there is none)."""
    from gift_peft.prepare.proposals import propose, refine

    for photo in photos:
        photo.mask = None
    register_photos(photos, reference, static, job, again=True)
    usable = [photo for photo in photos if not photo.dropped]
    compared = [photo.registered(photo.pixels) for photo in usable]
    if len(compared) < 2 and reference is not None and not reference.dropped:
        # The treated surface looks different too, and what changes beside it is the same as ever.
        compared.insert(0, reference.registered(reference.pixels))
    if len(compared) < 2:
        text = (
            "a mask is proposed from what differs between two photos of one camera pose, and this group has one that "
            "can be used; draw its mask, or add another photo or the treated reference"
        )
        raise Rejection("no_proposal", text)
    proposal = propose(compared)
    if job.settings.refine is not None and proposal.mask.any():
        proposal = refine(proposal, compared[-1], job.settings.refine)
    paths = []
    for photo in usable if proposal.mask.any() else ():
        photo.mask = warp(proposal.mask, np.linalg.inv(photo.matrix))
        path = _proposed_path(job, photo)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(photo.mask.astype(np.uint8) * 255).save(path)
        paths.append(path.relative_to(job.staging).as_posix())
    more = {"mask_area": float(proposal.mask.mean()), "accepted": False, "masks": paths}
    return {key: value for key, value in asdict(proposal).items() if key != "mask"} | more


def _take_over(photos: list[Photo], job: Job) -> dict:
    """The proposal of an earlier run, its masks copied to the staging folder and read into `photos`."""
    proposal, out = job.proposed["proposal"], job.proposed["out"]
    for photo in photos:
        path = _proposed_path(job, photo)
        photo.mask = None
        if (name := path.relative_to(job.staging).as_posix()) in proposal["masks"]:
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(out / name, path)
            with Image.open(path) as mask:
                photo.mask = np.asarray(mask) > 0
    return proposal | {"accepted": False}


def _proposed_path(job: Job, photo: Photo) -> Path:
    return (job.staging / "masks_proposed" / job.split / job.group_id / photo.entry.name).with_suffix(".png")


def check(photos: list[Photo], reference: Photo | None, job: Job, entry: GroupEntry) -> None:
    """Quality of the frames that registration left, which drops some of them, then of the group."""
    settings = job.settings.quality
    there = [photo for photo in photos if not photo.dropped]
    names, grays = [photo.entry.name for photo in there], [photo.gray for photo in there]
    smalls = [photo.small(photo.registered(photo.mask)) for photo in there]
    changes = pairwise_changes(smalls)
    found = check_frames(names, smalls, grays, len(there) - 1, changes, settings)
    for photo, figures, reasons, warnings in zip(there, *found, strict=True):
        photo.entry.quality = figures
        photo.entry.warnings += warnings
        if reasons:
            photo.entry.drop(reasons)
    if reference is not None and not reference.dropped:
        check_reference(reference, photos[-1], smalls[-1], settings)
    left = [index for index, photo in enumerate(there) if not photo.dropped]
    areas = [smalls[index].mask_area for index in left]
    most, complaint = check_group_change(changes[np.ix_(left, left)], settings)
    measured = [photo.entry.quality for photo in there]
    entry.quality = GroupQuality(
        target_change=most,
        mask_area=float(np.mean(areas)) if areas else None,
        outside_change=max(figures.outside_change or 0.0 for figures in measured),
        mask_iou=min((figures.mask_iou for figures in measured if figures.mask_iou is not None), default=None),
    )
    check_left(len(left), reference, job, entry)
    if complaint is not None and job.split == "train":
        raise Rejection("target_unchanged", complaint)
    if complaint is not None:
        entry.warnings.append(Remark("target_unchanged", complaint))
    if job.split == "train" and not any(areas):
        raise Rejection("masks_empty", "every mask is empty, so there is nothing to train on")


def check_reference(reference: Photo, last: Photo, target: SmallFrame, settings: QualitySettings) -> None:
    """Only what concerns the picture as a whole and its surroundings: inside the target it differs by design."""
    names, grays, unknown = [reference.entry.name, last.entry.name], [reference.gray] * 2, np.full((2, 2), np.nan)
    figures, reasons, warnings = check_frames(names, [reference.small(last.mask), target], grays, 1, unknown, settings)
    reference.entry.quality = ReferenceQuality(
        **{f.name: getattr(figures[0], f.name) for f in fields(ReferenceQuality)}
    )
    reference.entry.warnings += [item for item in warnings[0] if item.code in ABOUT_REFERENCE]
    if bad := [item for item in reasons[0] if item.code in ABOUT_REFERENCE]:
        reference.entry.drop(bad)


def check_left(count: int, reference: Photo | None, job: Job, entry: GroupEntry) -> None:
    """Whether `count` observations are enough, with or without the treated reference."""
    if reference is not None and reference.dropped:
        text = "; ".join(item.text for item in reference.entry.reasons)
        entry.warnings.append(Remark("reference_dropped", f"the treated reference is dropped: {text}"))
    taken = sum(frame.role == "observation" for frame in entry.frames)
    try:
        check_count(job.group_id, count, job.split, reference is not None and not reference.dropped)
        if job.split == "train" and (taken > 1 or not job.may_be_single):
            check_pair(job.group_id, count)
    except ValueError:
        frames = [frame for frame in entry.frames if frame.status == "dropped"]
        dropped = "; ".join(f"{frame.name}: {', '.join(item.text for item in frame.reasons)}" for frame in frames)
        text = f"{count} of {taken} observations are left; dropped are {dropped}"
        raise Rejection("too_few_frames", text) from None


def write(
    photos: list[Photo], reference: Photo | None, depth: np.ndarray | None, surface: str | None, job: Job
) -> dict:
    """Stage the group of these photos, note their files in their entries, and return the metadata row.

    `depth` (H, W) uint16 in mm is of the treated surface as the reference's camera sees it.
    """
    treated = [] if reference is None or reference.dropped else [reference]
    valids = []
    if any(photo.warped for photo in (*photos, *treated)):
        # Where the reference has no pixels nothing can be compared with it, in any frame.
        valids = [np.logical_and.reduce([photo.valid, *(shown.valid for shown in treated)]) for photo in photos]
    row = write_group(
        {
            "split": job.split,
            "group_id": job.group_id,
            "surface": surface,
            "image_names": [photo.entry.name for photo in photos],
            "images": [photo.picture for photo in photos],
            "masks": [photo.registered(photo.mask) for photo in photos],
            "valids": valids,
            "depths": [treated[0].registered(depth)] * len(photos) if depth is not None and treated else [],
            "reference": treated[0].picture if treated else None,
        },
        job.staging,
    )
    for key, column in (("prepared", "images"), ("mask", "masks"), ("valid", "valids")):
        for photo, path in zip(photos, row[f"{column}_file_names"], strict=False):
            setattr(photo.entry, key, f"{job.split}/{path}")
    for shown in treated:
        shown.entry.prepared = f"{job.split}/{row['reference_file_name']}"
    return row
