"""`gift-peft prepare --dry-run`: which groups would be made, what they lack, and how long it takes.

Files are listed and their masks found, as a run does it; one group is prepared in a temporary folder, and its time per
frame is what the estimate stands on. RAW and OUT stay as they are.
"""

import os
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

from gift_peft.captures.tree import Capture, check_masks
from gift_peft.files import existing_folder, printable
from gift_peft.prepare.clip_groups import is_clip_job
from gift_peft.prepare.group import prepare_group
from gift_peft.prepare.job import Job, capture_digest, group_choices
from gift_peft.prepare.prepare import list_jobs
from gift_peft.prepare.settings import PrepareSettings
from gift_peft.rules import SPLITS, check_count, check_group_id, check_pair


def tell_plan(raw: Path, out: Path, settings: PrepareSettings, num_proc: int) -> int:
    """Print the plan; 0 if every group could be made, 3 if some would be rejected, 1 if all would.

    A picture that cannot be decoded, or that does not fit its group, is found by the run alone. Raises ValueError or
    FileNotFoundError where the run would not even start.
    """
    jobs = list_jobs(raw, out, settings)
    rejected: dict[str, str] = {}
    new: list[Planned] = []
    clips: list[str] = []
    done = 0
    for job in jobs:
        if is_clip_job(job):
            clips.append(f"{job.split}/{printable(job.group_id)}")
            continue
        try:
            capture = _read(job)
        except (OSError, ValueError, RecursionError) as error:
            text = " ".join(str(error).split()) or type(error).__name__
            rejected[f"{job.split}/{printable(job.group_id)}"] = printable(text.replace(f"{raw}{os.sep}", ""))
            continue
        if job.known is not None and job.known == capture_digest(capture, group_choices(settings, capture)):
            done += 1
        else:
            frames = len(capture.images) + (capture.reference is not None)
            new.append(Planned(job, frames, sum(mask is None for mask in capture.masks)))
    for split in SPLITS:
        own = [planned.frames for planned in new if planned.job.split == split]
        if own:
            print(f"{split}: {len(own)} groups to make, {sum(own)} frames")
    if done:
        print(f"{done} groups are as an earlier run left them")
    bare = [planned for planned in new if planned.without_mask]
    if bare:
        what = "and accepted if they stand out enough" if settings.accept_proposed_masks else "for you to look at"
        names = ", ".join(f"{one.job.split}/{one.job.group_id} ({one.without_mask})" for one in bare)
        print(f"Masks would be proposed, {what}: {names}")
    if clips:
        print(f"Clips, of which at most {settings.max_frames} frames a pose would be chosen: {', '.join(clips)}")
    if new:
        print(_estimate(new, out, num_proc))
    for name, text in rejected.items():
        print(f"gift-peft: would be rejected: {name}: {text}", file=sys.stderr)
    print("Nothing was written.")
    failing = len(rejected) + (0 if settings.accept_proposed_masks else len(bare))
    return 1 if failing == len(jobs) else 3 if failing else 0


@dataclass(frozen=True)
class Planned:
    """A group that would be made."""

    job: Job
    frames: int
    without_mask: int


def _read(job: Job) -> Capture:
    """The group's files; raises what would reject it, as far as that needs no decoding."""
    check_group_id(job.group_id)
    capture = job.read()
    if not job.settings.propose_masks:
        check_masks(capture)
    check_count(capture.group_id, len(capture.images), capture.split, capture.reference is not None)
    if capture.split == "train" and not job.may_be_single:
        check_pair(capture.group_id, len(capture.images))
    return capture


def _estimate(new: list[Planned], out: Path, num_proc: int) -> str:
    """Time and disk, from the group whose number of frames is in the middle."""
    middle = sorted(new, key=lambda planned: planned.frames)[len(new) // 2]
    job, frames, total = middle.job, middle.frames, sum(planned.frames for planned in new)
    print(f"Measuring {job.split}/{job.group_id} ...", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        start = time.monotonic()
        prepare_group(replace(job, staging=Path(folder), known=None, proposed=None))
        seconds = (time.monotonic() - start) / frames * total / min(num_proc, len(new))
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file()) / frames * total
    place = existing_folder(out)
    free = shutil.disk_usage(place).free
    short = "" if size < free else f"; only {free / 2**20:.0f} MiB are free"
    text = f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
    return f"Time: about {text} with --num-proc {num_proc}; disk: about {size / 2**20:.0f} MiB{short}"
