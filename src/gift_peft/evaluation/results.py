"""What an evaluation leaves behind: per-image rows, their means per region, GCE, the collapse alarm, and the files.

Summaries are means over images, pixels or groups (NaN left out and counted), whatever the order of the rows.
"""

import json
import math
from collections import Counter
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from gift_peft.evaluation.metrics import METRICS
from gift_peft.files import jsonable, write_whole

REGIONS = ("tom", "other", "all")
COLLAPSE_RANGE = (0.5, 2.0)


class Report:
    """What the reports have in common: their files. Subclasses are dataclasses with a field `rows`."""

    rows: list[dict]

    def to_dict(self) -> dict:
        """Everything but the rows, in JSON types; NaN and infinity become None."""
        return jsonable({item.name: getattr(self, item.name) for item in fields(self) if item.name != "rows"})

    def save(self, folder: str | Path) -> Path:
        """Writes `metrics.json` and `rows.jsonl`, each at once or not at all; returns the folder."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "rows.jsonl", "".join(json.dumps(jsonable(row)) + "\n" for row in self.rows))
        write_whole(folder / "metrics.json", json.dumps(self.to_dict(), indent=2) + "\n")
        return folder

    @classmethod
    def load(cls, folder: str | Path) -> "Report":
        """A saved report; FileNotFoundError if the folder holds none, ValueError if it is one of another dataset."""
        folder = Path(folder)
        for name in ("metrics.json", "rows.jsonl"):
            if not (folder / name).is_file():
                raise FileNotFoundError(f"no evaluation in {folder}: {name} is missing; run gift-peft evaluate --out")
        path = folder / "rows.jsonl"
        rows = [_parse(path, line) for line in path.read_text(encoding="utf-8").splitlines()]
        path = folder / "metrics.json"
        values = _parse(path, path.read_text(encoding="utf-8"))
        known = {item.name for item in fields(cls)} - {"rows"}
        for names, verb in ((values.keys() - known, "has"), (known - values.keys(), "lacks")):
            if names:
                raise ValueError(f"{path} is no {cls.__name__}: it {verb} {', '.join(sorted(names))}")
        return cls(rows=rows, **values)


def load_report(folder: str | Path) -> "GiftIReport | BoosterReport":
    """The report that `gift-peft evaluate --out` left in a folder, of either dataset.

    Raises FileNotFoundError or ValueError where there is none.
    """
    path = Path(folder) / "metrics.json"
    booster = path.is_file() and "illumination_gce" in _parse(path, path.read_text(encoding="utf-8"))
    return (BoosterReport if booster else GiftIReport).load(folder)


def _parse(path: Path, text: str) -> dict:
    try:
        values = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{path}: damaged ({error})") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path}: damaged (a {type(values).__name__} where an object is expected)")
    return values


@dataclass
class GiftIReport(Report):
    """The result of `evaluate_gift_i`.

    Args:
        summary (`dict`): {region: {metric: mean over images}} of the evaluated model.
        base (`dict`, *optional*): the same of the frozen model.
        consensus (`dict`, *optional*): the same of the base with the target replaced by the group median.
        gce (`dict`): `base`, `adapted`, `base_normalized`, `adapted_normalized` (None where that model was not run),
            `num_groups`, `num_skipped`.
        collapse (`dict`, *optional*): adapted/base ratios `target_mean_ratio` and `spread_ratio`, and `alarm`.
        by_surface (`dict`): {surface: {`num_images` with a scored target, `summary`, `base`, `consensus`}}.
        counts (`dict`): `groups`, `images`, `scored`, `skipped`, `reasons` ({reason: images}), and
            `without_tom`, `without_other`: scored images that have no known pixel in that region.
        protocol (`dict`): the protocol's choices; `description` is the line under every table.
        reference (`str`): `proxy` or `depth`.
        adapted (`bool`): whether `summary` is of an adapted model, or of the base itself.
        unit (`str`): of MAE and RMSE.
        groups (`list[dict]`): GCE per group.
        rows (`list[dict]`): one per observation, see `evaluate_gift_i`.
        about (`dict`): what was evaluated (base, adapter, dataset, ...), where the caller knows.
    """

    summary: dict
    base: dict | None
    consensus: dict | None
    gce: dict
    collapse: dict | None
    by_surface: dict
    counts: dict
    protocol: dict
    reference: str
    adapted: bool
    unit: str
    groups: list[dict]
    rows: list[dict] = field(repr=False)
    about: dict = field(default_factory=dict)


@dataclass
class BoosterReport(Report):
    """The result of `evaluate_booster`; MAE and RMSE in mm. Groups are scenes: one pose and geometry, several lights.

    Args:
        summary (`dict`): {region: {metric: mean as the protocol aggregates}} of the evaluated model or predictions.
        base (`dict`, *optional*): the same of the frozen model; equal to `summary` where that is what was evaluated.
        illumination_gce (`dict`): Eq. 7 over a scene's images inside ToM, in native units: how much a prediction
            changes with the light alone. Not GIFT-I's GCE, whose reflected content changes. `base`, `adapted`,
            `base_normalized`, `adapted_normalized` (None where that model was not run), `num_groups`, `num_skipped`.
        collapse (`dict`, *optional*): adapted/base ratios `target_mean_ratio` and `spread_ratio`, and `alarm`.
        per_scene (`dict`): {scene: {`num_images`, `num_scored`, `summary`, `base`}}.
        counts (`dict`): `groups` (scenes), `images`, `scored`, `skipped`, `reasons` ({reason: images}), and
            `without_tom`, `without_other`: scored images that have no known pixel in that region.
        protocol (`dict`): the protocol's choices at the resolution used; `description` is the line under every table.
        adapted (`bool`): whether `summary` is of an adapted model.
        groups (`list[dict]`): illumination GCE per scene.
        rows (`list[dict]`): one per image, see `evaluate_booster`.
        about (`dict`): `root`, `subset`, `resize`, `occlusion`, `tom_classes`, `kind`, `official` (whether it was the
            complete official training set), and, where the caller knows, `predictions`, `base`, `adapter`, ...
    """

    summary: dict
    base: dict | None
    illumination_gce: dict
    collapse: dict | None
    per_scene: dict
    counts: dict
    protocol: dict
    adapted: bool
    unit: str
    groups: list[dict]
    rows: list[dict] = field(repr=False)
    about: dict = field(default_factory=dict)


def mean(values: list[float]) -> float:
    """Mean of the values that are not NaN; NaN if none is."""
    values = [value for value in values if not math.isnan(value)]
    return math.fsum(values) / len(values) if values else math.nan


def summarize(rows: list[dict], model: str, aggregation: str = "image") -> dict:
    """{region: {metric: mean}} of one of `base`, `adapted`, `consensus`, over images, pixels or groups."""
    if aggregation == "group":
        groups = [
            summarize([row for row in rows if row["group_id"] == group_id], model)
            for group_id in dict.fromkeys(row["group_id"] for row in rows)
        ]
        return {region: {m: mean([group[region][m] for group in groups]) for m in METRICS} for region in REGIONS}
    average = pooled_mean if aggregation == "pixel" else image_mean
    return {region: {metric: average(rows, model, region, metric) for metric in METRICS} for region in REGIONS}


def image_mean(rows: list[dict], model: str, region: str, metric: str) -> float:
    """The mean over images of each image's own metric."""
    return mean([row[model][region][metric] for row in rows])


def pooled_mean(rows: list[dict], model: str, region: str, metric: str) -> float:
    """The metric of all the rows' known pixels of the region (`pixels`) taken together, from the images' own."""
    known = [(row[model][region][metric], row["pixels"][region]) for row in rows]
    known = [(value, pixels) for value, pixels in known if not math.isnan(value)]
    if not known:
        return math.nan
    power = 2 if metric == "rmse" else 1  # a root does not average, its square does
    total = math.fsum(pixels * value**power for value, pixels in known)
    return (total / sum(pixels for _, pixels in known)) ** (1 / power)


def summarize_gce(groups: list[dict], models: list[str]) -> dict:
    """Eq. 7 over the groups of rows `groups`, for every model that was run."""
    counted = [group for group in groups if group["counted"]]
    gce: dict[str, Any] = {}
    for suffix in ("", "_normalized"):
        for model in ("base", "adapted"):
            values = [group[f"gce_{model}{suffix}"] for group in counted] if model in models else None
            gce[model + suffix] = None if values is None else mean(values)
    return gce | {"num_groups": len(counted), "num_skipped": len(groups) - len(counted)}


def detect_collapse(rows: list[dict]) -> dict:
    """Did the adapted outputs shrink, grow or flatten? A ratio outside [0.5, 2], or over zero, raises the alarm.

    Without a single target pixel there is no mean target prediction, and only the spread is checked.
    """
    target_mean, spread = (
        [[row[model][name] for row in rows if not math.isnan(row[model][name])] for model in ("adapted", "base")]
        for name in ("target_mean", "spread")
    )
    ratios = {
        "target_mean_ratio": _ratio(*map(mean, target_mean)),
        "spread_ratio": _ratio(*(float(np.median(values)) if values else math.nan for values in spread)),
    }
    low, high = COLLAPSE_RANGE
    checked = [ratio for name, ratio in ratios.items() if name != "target_mean_ratio" or target_mean[1]]
    return ratios | {"alarm": any(not low <= ratio <= high for ratio in checked)}


def _ratio(adapted: float, base: float) -> float:
    return adapted / base if base else math.nan


def count_rows(rows: list[dict], num_groups: int, subject: str) -> dict:
    """How many images the means are over, and why others are not in them."""
    reasons = Counter(row["skipped"] for row in rows if row["skipped"])
    skipped = sum(reasons.values())
    return {
        "groups": num_groups,
        "images": len(rows),
        "scored": len(rows) - skipped,
        "skipped": skipped,
        "reasons": dict(sorted(reasons.items())),
        "without_tom": len(rows) - skipped - count_scored(rows, subject, "tom"),
        "without_other": len(rows) - skipped - count_scored(rows, subject, "other"),
    }


def count_scored(rows: list[dict], subject: str, region: str) -> int:
    """Images with a value in the region; not those without its pixels, or whose reference is unknown all over it."""
    return sum(not row["skipped"] and not math.isnan(row[subject][region]["mae"]) for row in rows)


def by_surface(rows: list[dict], models: list[str], subject: str, aggregation: str = "image") -> dict:
    """The summaries per surface kind, `unknown` where the group states none."""
    surfaces = sorted({row["surface"] or "unknown" for row in rows})
    result = {}
    for surface in surfaces:
        own = [row for row in rows if (row["surface"] or "unknown") == surface]
        result[surface] = {"num_images": count_scored(own, subject, "tom")}
        result[surface]["summary"] = summarize(own, subject, aggregation)
        for model in ("base", "consensus"):
            result[surface][model] = summarize(own, model, aggregation) if model in models else None
    return result
