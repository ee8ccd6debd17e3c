"""LayeredDepth's first layer: photos of glass, with points in the order in which their nearest surfaces lie.

    <root>/{pairs,triplets,quadruplets}_layer1_val/<index>.jsonl   each line a list of [x, y, layer], nearest first
    <root>/[<folder>/]<index>.png                                  the photos

as the validation set is unpacked (Wen et al., "Seeing and Seeing Through the Glass", ICCV 2025). The benchmark's data
are CC0, its code is BSD-3-Clause.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from gift_peft.evaluation.orderings import OrderingReport, PhotoQuestions, evaluate_orderings
from gift_peft.files import reason
from gift_peft.images import SUFFIXES, natural_key

SUBSETS = {"pairs": 2, "triplets": 3, "quadruplets": 4}
LAYOUT = "{pairs,triplets,quadruplets}_layer1_val/<index>.jsonl"
NOTES = (
    "LayeredDepth, first layer: right if depth strictly grows along the tuple; accuracy is right / all; tuples with a "
    "point outside the photo are skipped.",
    "Data: princeton-vl/LayeredDepth, CC0 (Wen et al., ICCV 2025).",
)


def evaluate_layered_depth(
    root: str | Path,
    model: Any = None,
    predictions: str | Path | None = None,
    kind: str | None = None,
    *,
    partial: bool = False,
    dial: Sequence[float] = (),
    **options: Any,
) -> OrderingReport:
    """Accuracy of a model, beside its base, or of stored predictions on LayeredDepth's first layer.

    A photo is predicted as `gift-peft predict` writes it, at its own size.

    Args:
        root: of the unpacked validation set.
        model, kind: as in `evaluate_booster`; further `options` are `teacher`, `processor`, `size`, `progress`.
        predictions: folder `<index>.npy` (or npz, pfm, png) or, as the benchmark's own, `<index>_1.png`, in place of
            a model; those of another size than the photo are resized bilinearly.
        partial (`bool`): evaluate what is there where one of the three folders is missing.
        dial: adapter scales at which to evaluate as well.

    Raises:
        FileNotFoundError: no such tree, a folder, photo or prediction that is missing.
        ValueError: a damaged line, naming file and line, and as `evaluate_booster`.
    """
    photos = read_layered_depth(root, partial, options.get("progress", True))
    report = evaluate_orderings(
        "layereddepth", photos, model, predictions, kind, derive=dict, notes=NOTES, dial=dial, **options
    )
    report.about["root"] = str(root)
    return report


def read_layered_depth(root: str | Path, partial: bool = False, progress: bool = True) -> list[PhotoQuestions]:
    """The photos of a tree that have tuples, in natural order."""
    files, pictures = find_layered_depth(root, partial)
    ordered = tqdm(sorted(files, key=natural_key), "read", unit="photo", delay=2, disable=None if progress else True)
    return [PhotoQuestions(pictures[i].name, pictures[i], _read_questions(files[i])) for i in ordered]


def find_layered_depth(root: str | Path, partial: bool = False) -> tuple[dict[str, dict[str, Path]], dict[str, Path]]:
    """({index: {subset: file of tuples}}, {index: photo}) of a tree; raises as `evaluate_layered_depth`."""
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"LayeredDepth root {root}: no such folder")
    folders = {subset: root / f"{subset}_layer1_val" for subset in SUBSETS}
    there = {subset: folder for subset, folder in folders.items() if folder.is_dir()}
    absent = [folder.name for subset, folder in folders.items() if subset not in there]
    if not there:
        raise FileNotFoundError(f"LayeredDepth root {root}: no first layer; expected {LAYOUT} below it{_hint(root)}")
    if absent and not partial:
        raise FileNotFoundError(
            f"LayeredDepth root {root}: {', '.join(absent)} is missing (partial=True, or --partial, evaluates the "
            "rest)"
        )
    files: dict[str, dict[str, Path]] = {}
    for subset, folder in there.items():
        for path in folder.glob("*.jsonl"):
            files.setdefault(path.stem, {})[subset] = path
    if not files:
        raise FileNotFoundError(f"LayeredDepth root {root}: no .jsonl files; expected {LAYOUT} below it")
    return files, _pictures(root, files)


def _hint(root: Path) -> str:
    """What to name instead, where a neighboring folder looks right, or these are tuples of all layers."""
    below = sorted(path.name for path in root.iterdir() if path.is_dir())
    inner = [name for name in below if any((root / name / f"{subset}_layer1_val").is_dir() for subset in SUBSETS)]
    if inner:
        return f"; name {root / inner[0]}"
    every = [name for name in below if any(name.startswith(subset) for subset in SUBSETS)]
    return f" ({every[0]} holds tuples of all layers)" if every else ""


def _pictures(root: Path, files: dict[str, Any]) -> dict[str, Path]:
    """{index: photo}, all in the root or in one of its folders."""
    places = [root, *sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))]
    found: dict[Path, dict[str, Path]] = {}
    for place in places:
        own = {path.stem: path for path in sorted(place.iterdir()) if path.suffix.lower() in SUFFIXES}
        if own.keys() & files.keys():
            found[place] = own
    complete = [place for place, own in found.items() if files.keys() <= own.keys()]
    if len(complete) > 1:
        listed = ", ".join(str(place) for place in complete)
        raise ValueError(f"LayeredDepth root {root}: {listed} all hold photos of these names; keep one")
    if complete:
        return found[complete[0]]
    place, own = max(found.items(), key=lambda item: len(item[1]), default=(root, {}))
    missing = sorted(files.keys() - own.keys(), key=natural_key)
    raise FileNotFoundError(
        f"LayeredDepth root {root}: {len(missing)} of {len(files)} photos are missing in {place}, the first is "
        f"{missing[0]}.png"
    )


def _read_questions(files: dict[str, Path]) -> dict[str, np.ndarray]:
    return {subset: _read_tuples(files[subset], count) for subset, count in SUBSETS.items() if subset in files}


def _read_tuples(path: Path, count: int) -> np.ndarray:
    """(T, count, 2) points of a file; ValueError naming file and line."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: damaged ({reason(error)})") from None
    tuples = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            points = np.asarray(json.loads(line), np.float64)
        except (ValueError, TypeError, RecursionError) as error:
            raise ValueError(f"{path}, line {number}: not a list of [x, y, layer] ({reason(error)})") from None
        if points.shape != (count, 3):
            raise ValueError(f"{path}, line {number}: {count} points [x, y, layer] are expected, got {line[:80]}")
        if not np.isfinite(points).all():
            raise ValueError(f"{path}, line {number}: a coordinate is not a finite number")
        tuples.append(points[:, :2])
    return np.asarray(tuples, np.float64).reshape(-1, count, 2)
