"""MultiDepth-3k: on a pane of glass, does a model report the pane or what lies behind it?

    <root>/annotations.json   {photo: [{point1, point2, foreground_label, background_label, subset}]}
    <root>/images/...         the photos, named from the root

A pair of points has an order on the first layer (the glass) and one on the second (what is behind); `near` says that
point1 is nearer than point2, `far` the opposite. SRA(1) and SRA(2) are the accuracies with regard to each, and
alpha = SRA(2) - SRA(1): positive prefers what is behind. This is the schema that the authors suggest (Xu et al., "One
Scene, Two Depths", ECCV 2026); their data are elsewhere: photos of GDD, under its terms.
"""

import json
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from gift_peft.evaluation.orderings import OrderingReport, PhotoQuestions, evaluate_orderings
from gift_peft.files import reason

ANNOTATIONS = "annotations.json"
LAYERS = {"sra1": "foreground_label", "sra2": "background_label"}
LABELS = ("near", "far")  # point1 is nearer than point2, or farther
SUBSETS = ("same", "reverse")
NOTES = (
    "MD-3k: SRA(1), SRA(2): share of pairs ordered as on the glass and as behind it; alpha = SRA(2) - SRA(1), "
    "positive prefers what is behind; equal depths are wrong in both.",
    "Schema: the one its authors suggest (Xu et al., ECCV 2026); the photos are GDD's, whose terms hold.",
)


def evaluate_md3k(
    root: str | Path,
    model: Any = None,
    predictions: str | Path | None = None,
    kind: str | None = None,
    *,
    dial: Sequence[float] = (),
    **options: Any,
) -> OrderingReport:
    """Layer preference of a model, beside its base, or of stored predictions on MD-3k.

    Args:
        root: folder of `annotations.json` and the photos that it names.
        model, kind: as in `evaluate_booster`; further `options` are `teacher`, `processor`, `size`, `progress`.
        predictions: folder `<photo without suffix>.npy` (or npz, pfm, png), in place of a model; those of another
            size than the photo are resized bilinearly.
        dial: adapter scales at which to evaluate as well.

    Returns:
        `OrderingReport`: its summary has `sra1`, `sra2`, `alpha`, and the same per subset (`same_sra1`, ...).

    Raises:
        FileNotFoundError: no annotations, a photo or prediction that is missing.
        ValueError: an annotation that is none, naming photo and number, and as `evaluate_booster`.
    """
    photos = read_md3k(root)
    report = evaluate_orderings(
        "md3k", photos, model, predictions, kind, derive=_with_alpha, notes=NOTES, dial=dial, **options
    )
    report.about["root"] = str(root)
    return report


def _with_alpha(accuracy: dict[str, float]) -> dict[str, float]:
    summary = {}
    for prefix in ("", *(f"{subset}_" for subset in SUBSETS)):
        first, second = accuracy[f"{prefix}sra1"], accuracy[f"{prefix}sra2"]
        summary |= {f"{prefix}sra1": first, f"{prefix}sra2": second, f"{prefix}alpha": second - first}
    return summary


def read_md3k(root: str | Path) -> list[PhotoQuestions]:
    """The annotated photos, in the order of the file."""
    path = Path(root) / ANNOTATIONS
    if not Path(root).is_dir():
        raise FileNotFoundError(f"MD-3k root {root}: no such folder")
    if not path.is_file():
        raise FileNotFoundError(f"MD-3k root {root}: {ANNOTATIONS} is missing; expected it beside images/")
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: damaged ({reason(error)})") from None
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{path}: an object is expected, {{photo: [pairs]}}")
    photos = []
    for name, pairs in content.items():
        inner = PurePosixPath(name)
        if inner.is_absolute() or ".." in inner.parts:
            raise ValueError(f"{path}: {name!r} leaves the root; photos are named from there")
        if not isinstance(pairs, list):
            raise ValueError(f"{path}: {name}: a list of pairs is expected")
        parsed = [_parse(pair, f"{path}: {name}, pair {number}") for number, pair in enumerate(pairs, start=1)]
        photos.append(PhotoQuestions(str(inner), Path(root) / inner, _questions(parsed)))
    return photos


def _parse(pair: Any, where: str) -> tuple[np.ndarray, dict[str, str], str]:
    """((2, 2) points, {layer: label}, subset) of one annotation."""
    wanted = ("point1", "point2", *LAYERS.values(), "subset")
    if not isinstance(pair, dict) or not pair.keys() >= set(wanted):
        is_legacy = isinstance(pair, dict) and "label" in pair
        legacy = " (a single `label` does not say which layer it means)" if is_legacy else ""
        raise ValueError(f"{where}: {', '.join(wanted)} are expected{legacy}")
    try:
        points = np.asarray([pair["point1"], pair["point2"]], np.float64)
    except (ValueError, TypeError):
        points = np.zeros(0)
    if points.shape != (2, 2) or not np.isfinite(points).all():
        raise ValueError(f"{where}: point1 and point2 are [x, y], got {pair['point1']} and {pair['point2']}")
    labels = {layer: pair[key] for layer, key in LAYERS.items()}
    for layer, label in labels.items():
        if label not in LABELS:
            raise ValueError(f"{where}: {LAYERS[layer]} is {label!r}; it is one of {', '.join(LABELS)}")
    if pair["subset"] not in SUBSETS:
        raise ValueError(f"{where}: subset is {pair['subset']!r}; it is one of {', '.join(SUBSETS)}")
    return points, labels, pair["subset"]


def _questions(pairs: list[tuple[np.ndarray, dict[str, str], str]]) -> dict[str, np.ndarray]:
    """{layer, and subset_layer: (T, 2, 2)}, the nearer point of each pair first."""
    questions: dict[str, list[np.ndarray]] = {
        f"{prefix}{layer}": [] for prefix in ("", *(f"{subset}_" for subset in SUBSETS)) for layer in LAYERS
    }
    for points, labels, subset in pairs:
        for layer, label in labels.items():
            ordered = points if label == "near" else points[::-1]
            questions[layer].append(ordered)
            questions[f"{subset}_{layer}"].append(ordered)
    return {name: np.asarray(points, np.float64).reshape(-1, 2, 2) for name, points in questions.items()}
