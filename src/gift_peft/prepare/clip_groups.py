"""Groups of clips become groups of photos, in OUT's own folder, before `gift-peft prepare` goes on with them.

What was chosen of a clip is kept there with a digest of the clip and of all else that decides it, so that a clip is
read once. A camera that was moved makes several groups of one clip: `hall`, `hall__2`.
"""

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from tqdm import tqdm

from gift_peft.captures.clip import Clip, write_frame
from gift_peft.captures.clip_group import ClipGroup, find_clip_group, holds_clips
from gift_peft.files import remove_folder, whole_folder, write_whole
from gift_peft.images import is_image_file
from gift_peft.prepare.clip_frames import Chosen, ClipChoice, Pose, choose_frames, read_frames
from gift_peft.prepare.entries import Remark
from gift_peft.prepare.job import Job
from gift_peft.prepare.out_folder import side_by_side
from gift_peft.prepare.registration import warp

CHOOSING = 2  # a new number chooses the frames of every clip again
CHOSEN = ".chosen.json"  # digest, notes, and {group: what is wrong with it, or null}
MASK_LEFT = 0.5  # share of the mask that must stay in the picture where the camera was moved


@dataclass(frozen=True)
class _Choosing:
    """A group of clips to choose from, as `side_by_side` sends it to a process."""

    job: Job
    folder: Path  # where its groups of photos are put


def is_clip_job(job: Job) -> bool:
    """Whether the job is a folder of clips; False where it cannot be read, which its own work says."""
    if job.settings.layout is not None or not isinstance(job.source, Path):
        return False
    try:
        return holds_clips(job.source)
    except (OSError, ValueError):
        return False


def replace_clips(jobs: Sequence[Job], store: Path, num_proc: int) -> list[Job]:
    """The jobs, those of clips replaced by those of the photos chosen from them; folders of clips that RAW no longer
    has are deleted from `store`.
    """
    work = [_Choosing(job, store / job.split / job.group_id) for job in jobs if is_clip_job(job)]
    _remove_others(store, {one.folder for one in work})
    if not work:
        return list(jobs)
    made: dict[Path, list[Job]] = {}
    with tqdm(total=len(work), desc="clips", unit="clip", dynamic_ncols=True) as bar:
        for one, result in side_by_side("prepare", _choose, work, num_proc):
            made[one.folder] = result
            bar.update()
    return [new for job in jobs for new in made.get(store / job.split / job.group_id, [job])]


def _choose(work: _Choosing) -> list[Job]:
    """The jobs of a group of clips: its groups of photos, or the job itself with what is wrong."""
    job, folder = work.job, work.folder
    try:
        group = find_clip_group(job.source, job.raw)
        digest = _digest(group, job.settings.max_frames)
        made = _made_before(folder, digest) or _make(group, folder, job, digest)
    except (OSError, ValueError, cv2.error, MemoryError) as error:
        if folder.is_dir():
            remove_folder(folder)
        return [replace(job, failure=" ".join(str(error).split()) or type(error).__name__)]
    remarks = tuple(Remark("clip", note) for note in made["notes"])
    return [
        replace(
            job,
            source=folder / name,
            root=folder,
            clip_folder=job.source,
            remarks=remarks if not place else (),
            failure=failure,
        )
        for place, (name, failure) in enumerate(made["groups"].items())
    ]


def _digest(group: ClipGroup, max_frames: int) -> str:
    digest = hashlib.blake2b(json.dumps([CHOOSING, max_frames]).encode(), digest_size=16)
    for path in group.files:
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "blake2b").hexdigest()
        digest.update(f"\n{path.name} {content}".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _made_before(folder: Path, digest: str) -> dict | None:
    try:
        made = json.loads((folder / CHOSEN).read_text(encoding="utf-8"))
        return made if made["digest"] == digest else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _make(group: ClipGroup, folder: Path, job: Job, digest: str) -> dict:
    """Choose, write the groups of photos, and note what was done; returns the note."""
    stated = sum(Clip(path).frames_stated for path in group.clips)
    read = None if group.mask is None else group.mask.read
    with tqdm(total=stated or None, desc=job.group_id, unit="frame", leave=False, delay=2, dynamic_ncols=True) as bar:
        choice = choose_frames(group.clips, read, job.settings.max_frames, group.reference_time, bar.update)
    names = [job.group_id if not place else f"{job.group_id}__{place + 1}" for place in range(len(choice.poses))]
    photos = sum(len(pose.frames) for pose in choice.poses)
    told = f"{photos} of {stated} frames chosen from {', '.join(path.name for path in group.clips)}"
    made = {"digest": digest, "groups": dict.fromkeys(names), "notes": [told, *choice.notes]}
    with whole_folder(folder, ["*"]) as temporary:  # it lies in OUT's own folder: nobody else writes there
        for name, pose in zip(names, choice.poses, strict=True):
            made["groups"][name] = _write_group(group, choice, pose, temporary / name)
        write_whole(temporary / CHOSEN, json.dumps(made))
    return made


def _write_group(group: ClipGroup, choice: ClipChoice, pose: Pose, folder: Path) -> str | None:
    """Write the photos of a pose and what belongs to them; what is wrong, if something is."""
    folder.mkdir()
    mask = None if group.mask is None else _mask_of(group, choice, pose)
    if isinstance(mask, str):
        return mask
    wanted = [*pose.frames, *([pose.reference] if pose.reference else [])]
    for frame, pixels in read_frames(group.clips, wanted):
        name = "reference.png" if frame is pose.reference else f"{_name(group, frame)}.png"
        write_frame(folder / name, pixels)
    if group.reference is not None and pose is choice.poses[0]:
        shutil.copyfile(group.reference, folder / f"reference{group.reference.suffix}")
    if mask is not None:
        write_frame(folder / "mask.png", mask.astype(np.uint8) * 255)
    names = {_name(group, frame) for frame in pose.frames}
    for masks in group.mask_folders:
        for path in filter(is_image_file, masks.iterdir()):
            if path.stem in names:
                (folder / "masks").mkdir(exist_ok=True)
                shutil.copyfile(path, folder / "masks" / path.name)
    facts = {key: value for key, value in group.facts.items() if key != "reference"}
    if group.mask is not None:
        facts.pop("mask_class", None)  # mask.png is drawn in 255
    if facts:
        write_whole(folder / "group.yaml", yaml.safe_dump(facts, sort_keys=False, allow_unicode=True))
    return None


def _mask_of(group: ClipGroup, choice: ClipChoice, pose: Pose) -> np.ndarray | str:
    """(H, W) bool: the group's mask where this pose's camera sees it; a text if it does not."""
    mask = group.mask.read(choice.size)
    if pose is choice.poses[0]:
        return mask
    moved = None if pose.matrix is None else warp(mask, pose.matrix)
    if moved is not None and moved.sum() >= MASK_LEFT * mask.sum():
        return moved
    happened = "the clip shows another view" if moved is None else "the mask moves out of the picture"
    return (
        f"{group.folder}: from {pose.frames[0].seconds:.1f} s on, {happened}, so {group.mask.path.name} does not "
        "hold; "
        "cut the clip there, and give the second part a folder and a mask of its own"
    )


def _name(group: ClipGroup, frame: Chosen) -> str:
    """How a frame is called: its clip's name and its number, which does not change when other frames are chosen."""
    return f"{group.clips[frame.clip].stem}_{frame.index:06d}"


def _remove_others(store: Path, wanted: set[Path]) -> None:
    for folder in store.glob("*/*"):
        if folder not in wanted and folder.is_dir():
            shutil.rmtree(folder, ignore_errors=True)
