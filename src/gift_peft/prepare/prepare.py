"""From a folder of raw photos to a checked, loadable GIFT-I: `gift-peft prepare RAW OUT` (paper, supplement A).

Each group is read, registered to its last observation, checked, and written whole or not at all (`group.py`). About
every frame the report says why it was kept, moved or dropped; `entries.py` types what `report.json` holds.
"""

import json
import os
import platform
import shutil
from collections.abc import Collection
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import PIL
from tqdm import tqdm

from gift_peft.captures.tree import find_groups
from gift_peft.dataset.writer import write_card, write_rows
from gift_peft.files import remove_files, strangers, write_whole
from gift_peft.options import package_version
from gift_peft.prepare.clip_groups import replace_clips
from gift_peft.prepare.entries import Statistics
from gift_peft.prepare.frame_bar import FrameBar
from gift_peft.prepare.group import prepare_group
from gift_peft.prepare.job import FORMAT, Job, Outcome
from gift_peft.prepare.out_folder import alone, check_card, check_places, note_card, side_by_side
from gift_peft.prepare.page import write_html
from gift_peft.prepare.settings import PrepareSettings
from gift_peft.rules import MAX_GROUP_ID, SPLITS

STATE = ".prepare"  # in OUT: one record per finished group, and groups on their way


def prepare_gift_i(
    raw: str | Path,
    out: str | Path,
    settings: PrepareSettings | None = None,
    *,
    num_proc: int = 1,
    license: str = "unknown",
    pretty_name: str | None = None,
) -> dict:
    """Make a prepared GIFT-I folder of a raw tree and return the report.

    RAW is only read. Groups come into OUT one by one, each whole or not at all; what was finished earlier with the
    same files and settings is not done again. A group with something wrong is rejected in the report and the others
    are made. At the end OUT holds exactly what RAW gives.

    Args:
        raw (`str` or `Path`): the raw tree, or whatever `settings.layout` describes.
        out (`str` or `Path`): new, empty, or made by this function before; neither inside RAW nor around it.
        settings (`PrepareSettings`, *optional*): thresholds and choices.
        num_proc (`int`): processes that prepare groups side by side.
        license, pretty_name (`str`): for the dataset card.

    Raises:
        ValueError, FileNotFoundError: one line; `raw` or `out` is not what it should be, another run is at work in
            `out`, or a group or the card would replace a file there that this function did not write, or that was
            changed since.
            What concerns one group of `raw` never raises.
    """
    raw, out = Path(raw), Path(out)
    settings = settings or PrepareSettings()
    if num_proc < 1:
        raise ValueError(f"num_proc: at least 1, got {num_proc}")
    jobs = list_jobs(raw, out, settings)
    staging = out / STATE / "staging"
    with alone("prepare", out, STATE):
        check_card("prepare", out, STATE)
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir()
        jobs = replace_clips(jobs, out / STATE / "clips", num_proc)
        _check_names(jobs)
        jobs = [_with_record(job, _read_record(out, job), out) for job in jobs]
        report, rows = _make_groups(raw, out, settings, jobs, num_proc)
        shutil.rmtree(staging, ignore_errors=True)
        if any(rows.values()):
            write_card(rows, out, license, pretty_name or f"GIFT-I: {raw.resolve().name}", _describe(report))
        else:
            for name in ("README.md", "groups.jsonl"):
                (out / name).unlink(missing_ok=True)
        note_card(out, STATE)
        write_whole(out / "report.json", json.dumps(report, indent=1, allow_nan=False, ensure_ascii=False))
        write_html(out, report)
    return report


def list_jobs(raw: Path, out: Path, settings: PrepareSettings) -> list[Job]:
    """Every group of RAW, with what an earlier run knows of it; nothing is written.

    Raises ValueError or FileNotFoundError: `raw` or `out` is not what it should be, or two groups have one name.
    """
    check_places("prepare", raw, "RAW", out, STATE)
    groups = settings.layout.find(raw) if settings.layout is not None else find_groups(raw)
    staging = out / STATE / "staging"
    jobs = [Job(raw, staging, source, split, settings) for split in SPLITS for source in groups.get(split, [])]
    _check_names(jobs)
    return [_with_record(job, _read_record(out, job), out) for job in jobs]


def _make_groups(
    raw: Path, out: Path, settings: PrepareSettings, jobs: list[Job], num_proc: int
) -> tuple[dict, dict[str, dict[str, dict]]]:
    """The report, and the dataset's rows, of what OUT now holds."""
    records = {(job.split, job.group_id): _read_record(out, job) for job in jobs}
    removed = _remove_others(out, records.keys())
    kept = {key: record["row"] for key, record in records.items() if record and record["row"]}
    write_rows(_rows(kept, jobs), out)
    with FrameBar(_count_frames(jobs), "prepare") as bar:
        for job, outcome in side_by_side("prepare", prepare_group, jobs, num_proc):
            if outcome.digest is None or outcome.digest != job.known:
                key = job.split, job.group_id
                _check_place(out, job, outcome)
                if kept.pop(key, None):  # first the table, then the files: the table never names what is not there
                    write_rows(_rows(kept, jobs), out)
                files = _install(out, job, outcome)
                if outcome.row is not None:
                    kept[key] = outcome.row
                    write_rows(_rows(kept, jobs), out)
                records[key] = _write_record(out, job, outcome, files)
            bar.group_done(job.notes)
    entries = [records[job.split, job.group_id]["entry"] for job in jobs]
    return _report(raw, out, settings, entries, removed), _rows(kept, jobs)


def _with_record(job: Job, record: dict | None, out: Path) -> Job:
    """The job with what an earlier run knows of its group."""
    if record is None:
        return job
    proposal, source = record["entry"].get("proposal"), record.get("proposed_from")
    proposed = {"from": source, "proposal": proposal, "out": out} if proposal and source else None
    return replace(job, known=record["digest"], proposed=proposed)


def _count_frames(jobs: list[Job]) -> dict[Path, int]:
    """{file of a group's notes: its number of frames}; a group that cannot be read is one frame's work."""
    counts = {}
    for job in tqdm(jobs, desc="looking through RAW", unit="group", disable=None, leave=False, delay=0.5):
        try:
            capture = job.read()
            counts[job.notes] = len(capture.images) + (capture.reference is not None)
        except (OSError, ValueError, RecursionError):  # its own job says what is wrong
            counts[job.notes] = 1
    return counts


def _check_names(jobs: list[Job]) -> None:
    seen: dict[tuple[str, str], Job] = {}
    for job in jobs:
        # Some file systems fold case: two such groups would share a folder there.
        other = seen.setdefault((job.split, job.group_id.casefold()), job)
        if other is not job:
            raise ValueError(f"{job.folder} and {other.folder}: two groups with one name; rename one")


# ---- what is in OUT ----


def _record_path(out: Path, split: str, group_id: str) -> Path:
    return out / STATE / split / f"{group_id}.json"


def _places(root: Path, split: str, group_id: str) -> tuple[Path, Path]:
    """A group's folder, in OUT or the staging folder, and that of its proposed masks."""
    return root / split / group_id, root / "masks_proposed" / split / group_id


def _read_record(out: Path, job: Job) -> dict | None:
    """What an earlier run noted about a group; None if a file that it made is missing or has another size."""
    path = _record_path(out, job.split, job.group_id)
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["format"] != FORMAT or record["digest"] is None:
            return None
        whole = all((out / name).stat().st_size == size for name, size in record["files"].items())
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return record if whole else None


def _own_files(out: Path, split: str, group_id: str) -> set[str]:
    """What earlier runs wrote of a group and nobody has changed since, by names in OUT; a killed run's record says
    what it was about to write."""
    try:
        record = json.loads(_record_path(out, split, group_id).read_text(encoding="utf-8"))
        stated = [record["files"], record.get("replaced", {})]
        sizes = {name: {files.get(name) for files in stated} for name in {*stated[0], *stated[1]}}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return set()
    found = _sizes(out, _places(out, split, group_id))
    return {name for name, size in found.items() if size in sizes.get(name, ())}


def _sizes(root: Path, places: Collection[Path]) -> dict[str, int]:
    """{name in `root`: size} of the files below `places`."""
    paths = [place / name for place in places for name in strangers(place)]
    return {path.relative_to(root).as_posix(): path.lstat().st_size for path in paths}


def _check_place(out: Path, job: Job, outcome: Outcome) -> None:
    """Raise ValueError if a staged group would replace a file that no run wrote, or that was changed since."""
    own = _own_files(out, job.split, job.group_id)
    for name in _staged(job, outcome):
        if os.path.lexists(out / name) and name not in own:
            raise ValueError(
                f"{out / name}: not written by gift-peft prepare, or changed since, and it would be replaced; "
                "move it away (or delete it, if it is damaged) and run again"
            )


def _staged(job: Job, outcome: Outcome) -> dict[str, int]:
    """{name in OUT: size} of what a group brings."""
    made, proposed = _places(job.staging, job.split, job.group_id)
    return _sizes(job.staging, [proposed] if outcome.row is None else [made, proposed])


def _write_record(out: Path, job: Job, outcome: Outcome, files: dict[str, int]) -> dict:
    """The last step of a group: only a group with a record that states its digest counts as finished.

    One that was rejected for its long name has no record.
    """
    record = {"format": FORMAT, **vars(outcome), "files": files}
    if len(os.fsencode(job.group_id)) <= MAX_GROUP_ID:
        write_whole(_record_path(out, job.split, job.group_id), json.dumps(record, allow_nan=False))
    return record


def _install(out: Path, job: Job, outcome: Outcome) -> dict[str, int]:
    """Put a staged group and its proposed masks in the place of what was there; {name in OUT: size} of its files.

    Files that no run wrote stay beside them. First a record without a digest says which are going and coming, so that
    after a kill they are still known as ours.
    """
    before, staged = _own_files(out, job.split, job.group_id), _staged(job, outcome)
    places = _places(out, job.split, job.group_id)
    replaced = {name: size for name, size in _sizes(out, places).items() if name in before}
    if not (before or staged):
        return {}
    claim = {"format": FORMAT, "digest": None, "files": staged, "replaced": replaced}
    write_whole(_record_path(out, job.split, job.group_id), json.dumps(claim))
    remove_files(out, before)
    for name in staged:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(job.staging / name, out / name)
    return staged


def _remove_others(out: Path, wanted: Collection[tuple[str, str]]) -> list[str]:
    """Remove what earlier runs made of groups that RAW no longer has, and return the names of these groups."""
    records = [(split, path.stem) for split in SPLITS for path in sorted((out / STATE / split).glob("*.json"))]
    gone = [key for key in records if key not in wanted]
    if gone:
        # First the tables, so that they never name a group that is not there; the caller writes the new ones.
        for split in SPLITS:
            (out / split / "metadata.parquet").unlink(missing_ok=True)
    for key in gone:
        remove_files(out, _own_files(out, *key))
        _record_path(out, *key).unlink()
    return ["/".join(key) for key in gone]


def _rows(kept: dict[tuple[str, str], dict], jobs: list[Job]) -> dict[str, dict[str, dict]]:
    """By split and group id, in the order of RAW."""
    rows: dict[str, dict[str, dict]] = {split: {} for split in SPLITS}
    for job in jobs:
        if row := kept.get((job.split, job.group_id)):
            rows[job.split][job.group_id] = row
    return rows


# ---- the report ----


def _report(raw: Path, out: Path, settings: PrepareSettings, entries: list[dict], removed: list[str]) -> dict:
    splits = {split: [entry for entry in entries if entry["split"] == split] for split in SPLITS}
    return {
        "format": FORMAT,
        "raw": Path(os.path.relpath(raw.resolve(), out.resolve())).as_posix(),
        "settings": asdict(settings),
        "versions": {
            "gift-peft": package_version("gift-peft"),
            "opencv": cv2.__version__,
            "numpy": np.__version__,
            "pillow": PIL.__version__,
            "python": platform.python_version(),
        },
        "removed": removed,
        "statistics": {split: asdict(_statistics(found)) for split, found in splits.items() if found},
        "groups": entries,
    }


def _statistics(entries: list[dict]) -> Statistics:
    kept = [entry for entry in entries if entry["status"] == "kept"]
    frames = [frame for entry in kept for frame in entry["frames"]]
    sizes = [
        sum(frame["role"] == "observation" and frame["status"] != "dropped" for frame in entry["frames"])
        for entry in kept
    ]
    areas = [frame["quality"]["mask_area"] for frame in frames if frame["mask"] is not None]
    return Statistics(
        groups=len(kept),
        images=sum(sizes),
        pairs=sum(size * (size - 1) // 2 for size in sizes),
        references=sum(frame["role"] == "reference" and frame["status"] != "dropped" for frame in frames),
        rejected_groups=len(entries) - len(kept),
        dropped_frames=sum(frame["status"] == "dropped" for frame in frames),
        warped_frames=sum(frame["status"] == "warped" for frame in frames),
        group_size=_range(sizes),
        mask_area=_range(areas),
    )


def _range(values: list) -> dict | None:
    return {"min": min(values), "max": max(values), "mean": float(np.mean(values))} if values else None


def _describe(report: dict) -> str:
    """The card's text: what was done, and the statistics."""
    lines = [
        "Groups for GIFT fine-tuning of monocular depth models, made from photos by `gift-peft prepare`: "
        "registered to the last observation of each group and checked. `report.html` says what was done with each "
        "frame, and why.",
        "",
        "| split | groups | images | group size | pairs | references | mask area | rejected groups | dropped frames "
        "| warped frames |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for split, found in report["statistics"].items():
        size, area = found["group_size"], found["mask_area"]
        size = "" if size is None else f"{size['min']}-{size['max']}, mean {size['mean']:.2f}"
        area = "" if area is None else f"{area['min']:.1%}-{area['max']:.1%}, mean {area['mean']:.1%}"
        lines.append(
            f"| {split} | {found['groups']} | {found['images']} | {size} | {found['pairs']} | {found['references']} "
            f"| {area} | {found['rejected_groups']} | {found['dropped_frames']} | {found['warped_frames']} |"
        )
    accepted = [entry for entry in report["groups"] if entry["status"] == "kept" and entry["proposal"]]
    if accepted:
        refined = sorted({entry["proposal"]["refined"] for entry in accepted if entry["proposal"]["refined"]})
        lines += [
            "",
            f"The masks of {len(accepted)} groups were not drawn but proposed from what changes within the group"
            + (f", refined by {', '.join(refined)}," if refined else "")
            + " and accepted by whoever made this dataset: "
            + ", ".join(f"`{entry['group_id']}`" for entry in accepted)
            + ".",
        ]
    if report["settings"]["registration"]["paper_exact"]:
        lines += ["", "Registered by the paper's thresholds alone (`--paper-exact`)."]
    return "\n".join(lines)
