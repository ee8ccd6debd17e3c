"""What an evaluation leaves behind: per-image rows, their means per region, GCE, the collapse alarm, and the files.

Summaries are means over images (NaN left out and counted), whatever the order of the rows.
"""

import json
import math
from collections import Counter
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from gift_peft.evaluation.metrics import METRICS
from gift_peft.evaluation.protocols import Protocol
from gift_peft.files import jsonable, write_whole

REGIONS = ("tom", "other", "all")
COLLAPSE_RANGE = (0.5, 2.0)


@dataclass(kw_only=True)
class Report:
    """The result of `evaluate_gift_i` and `evaluate_booster`. Groups of Booster are its scenes.

    Args:
        summary (`dict`): {region: {metric: mean over images}} of the evaluated model or predictions.
        base (`dict`, *optional*): the same of the frozen model; equal to `summary` where that is what was evaluated.
        consensus (`dict`, *optional*): on GIFT-I, `base` with the target replaced by the group median.
        gce (`dict`): Eq. 7 inside the target, in native units: `base`, `adapted`, `base_normalized`,
            `adapted_normalized` (None where that model was not run), `num_groups`, `num_skipped`. On Booster it says
            how much a prediction changes with the light alone, and metrics.json calls it `illumination_gce`.
        collapse (`dict`, *optional*): adapted/base ratios `target_mean_ratio` and `spread_ratio`, and `alarm`.
        safety (`dict`, *optional*): where depth is known, {`base` | `adapted`: {`false_free_space` (percent of target
            pixels far behind the surface, mean over images), `flicker` (mm, mean over groups)}}, see `safety.py`.
        by_surface (`dict`): on GIFT-I, {surface: {`num_images` with a scored target, `summary`, `base`, `consensus`}}.
        per_scene (`dict`): on Booster, {scene: {`num_images`, `num_scored`, `summary`, `base`}}.
        counts (`dict`): `groups`, `images`, `scored`, `skipped`, `reasons` ({reason: images}), and
            `without_tom`, `without_other`: scored images that have no known pixel in that region.
        protocol (`dict`): the protocol's choices; `description` is the line under every table.
        reference (`str`): `proxy` or `depth`.
        adapted (`bool`): whether `summary` is of an adapted model, or of the base itself.
        unit (`str`): of MAE and RMSE.
        groups (`list[dict]`): GCE per group.
        rows (`list[dict]`): one per image, see `evaluate_gift_i`.
        about (`dict`): what was evaluated: on Booster `root`, `subset`, `resize`, `occlusion`, `tom_classes`, `kind`,
            `official` (whether it was the complete official training set), and, where the caller knows, `base`,
            `adapter`, `dataset`, `predictions`, ...
        dataset (`str`): `gift-i` or `booster`.
    """

    summary: dict
    base: dict | None
    consensus: dict | None = None
    gce: dict
    collapse: dict | None
    safety: dict | None = None
    by_surface: dict = field(default_factory=dict)
    per_scene: dict = field(default_factory=dict)
    counts: dict
    protocol: dict
    reference: str = "depth"
    adapted: bool
    unit: str
    groups: list[dict]
    rows: list[dict] = field(repr=False)
    about: dict = field(default_factory=dict)
    dataset: str = "gift-i"

    @property
    def group_noun(self) -> str:
        """What a group is called."""
        return "scene" if self.dataset == "booster" else "group"

    @property
    def gce_name(self) -> str:
        """What GCE is called: the reflected content of a Booster scene stays the same, only the light changes."""
        return "illumination GCE" if self.dataset == "booster" else "GCE"

    @property
    def illumination_gce(self) -> dict:
        """`gce` of Booster under the name that it has in metrics.json, and had here before both reports were one."""
        return self.gce

    def to_dict(self) -> dict:
        """Everything but the rows, in JSON types; NaN and infinity become None."""
        return jsonable({key: getattr(self, name) for name, key in _json_keys(self.dataset).items()})

    def save(self, folder: str | Path) -> Path:
        """Writes `metrics.json` and `rows.jsonl`, each at once or not at all; returns the folder."""
        return write_results(folder, self.rows, self.to_dict())

    @classmethod
    def load(cls, folder: str | Path) -> "Report":
        """What `gift-peft evaluate --out` left in a folder.

        Raises FileNotFoundError if the folder holds no evaluation, ValueError if it is damaged.
        """
        folder = Path(folder)
        for name in ("metrics.json", "rows.jsonl"):
            if not (folder / name).is_file():
                raise FileNotFoundError(f"no evaluation in {folder}: {name} is missing; run gift-peft evaluate --out")
        path = folder / "rows.jsonl"
        rows = [_parse(path, line) for line in path.read_text(encoding="utf-8").splitlines()]
        path = folder / "metrics.json"
        values = _parse(path, path.read_text(encoding="utf-8"))
        dataset = "booster" if "illumination_gce" in values else "gift-i"
        names = {key: name for name, key in _json_keys(dataset).items()}
        values.setdefault("safety", None)  # which evaluations before 0.2 did not have
        for keys, verb in ((values.keys() - names.keys(), "has"), (names.keys() - values.keys(), "lacks")):
            if keys:
                raise ValueError(f"{path} is no evaluation: it {verb} {', '.join(sorted(keys))}")
        return cls(rows=rows, dataset=dataset, **{names[key]: value for key, value in values.items()})


def write_results(
    folder: str | Path, rows: list[dict], values: dict, names: tuple[str, str] = ("metrics.json", "rows.jsonl")
) -> Path:
    """The two files of an evaluation, each at once or not at all; returns the folder, which is made if it is new."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / names[1], "".join(json.dumps(jsonable(row)) + "\n" for row in rows))
    write_whole(folder / names[0], json.dumps(jsonable(values), indent=2) + "\n")
    return folder


def _json_keys(dataset: str) -> dict[str, str]:
    """{field of a report: its key in metrics.json}, which has what the dataset has."""
    booster = dataset == "booster"
    absent = {"rows", "dataset", *(("reference", "consensus", "by_surface") if booster else ("per_scene",))}
    keys = {item.name: item.name for item in fields(Report) if item.name not in absent}
    return keys | ({"gce": "illumination_gce"} if booster else {})


def make_report(
    dataset: str, groups: list[dict], rows: list[dict], models: list[str], protocol: Protocol, reference: str
) -> Report:
    """The report of an evaluation's rows and the GCE of its groups."""
    subject = "adapted" if "adapted" in models else "base"
    booster = dataset == "booster"
    return Report(
        summary=summarize(rows, subject),
        base=summarize(rows, "base") if "base" in models else None,
        consensus=summarize(rows, "consensus") if "consensus" in models else None,
        gce=summarize_gce(groups, models),
        collapse=detect_collapse(rows) if {"base", "adapted"} <= set(models) else None,
        safety=summarize_safety(rows, groups, models) if reference == "depth" else None,
        by_surface={} if booster else _by_surface(rows, models, subject),
        per_scene=_per_scene(groups, rows, models, subject) if booster else {},
        counts=count_rows(rows, len(groups), subject),
        protocol=protocol.to_dict() | {"description": protocol.describe()},
        reference=reference,
        adapted=subject == "adapted",
        unit="native units" if reference == "proxy" else "cm" if protocol.unit == "cm" else "mm",
        groups=groups,
        rows=rows,
        dataset=dataset,
    )


def _parse(path: Path, text: str) -> dict:
    try:
        values = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{path}: damaged ({error})") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path}: damaged (a {type(values).__name__} where an object is expected)")
    return values


def mean(values: list[float]) -> float:
    """Mean of the values that are not NaN; NaN if none is."""
    values = [value for value in values if not math.isnan(value)]
    return math.fsum(values) / len(values) if values else math.nan


def summarize(rows: list[dict], model: str) -> dict:
    """{region: {metric: mean over images}} of one of `base`, `adapted`, `consensus`, with the metrics of the rows."""
    metrics = rows[0][model]["all"] if rows else METRICS
    return {
        region: {metric: mean([row[model][region][metric] for row in rows]) for metric in metrics}
        for region in REGIONS
    }


def summarize_gce(groups: list[dict], models: list[str]) -> dict:
    """Eq. 7 over the groups of rows `groups`, for every model that was run."""
    counted = [group for group in groups if group["counted"]]
    gce: dict[str, Any] = {}
    for suffix in ("", "_normalized"):
        for model in ("base", "adapted"):
            values = [group[f"gce_{model}{suffix}"] for group in counted] if model in models else None
            gce[model + suffix] = None if values is None else mean(values)
    return gce | {"num_groups": len(counted), "num_skipped": len(groups) - len(counted)}


def summarize_safety(rows: list[dict], groups: list[dict], models: list[str]) -> dict | None:
    """The safety figures of base and adapted; None where nothing is known: no true depth, or no target."""
    result = {
        model: {
            "false_free_space": mean([row[model]["false_free_space"] for row in rows]),
            "flicker": mean([group[f"flicker_{model}"] for group in groups]),
        }
        for model in ("base", "adapted")
        if model in models
    }
    return None if all(math.isnan(value) for own in result.values() for value in own.values()) else result


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


def _by_surface(rows: list[dict], models: list[str], subject: str) -> dict:
    """The summaries per surface kind, `unknown` where the group states none."""
    result = {}
    for surface in sorted({row["surface"] or "unknown" for row in rows}):
        own = [row for row in rows if (row["surface"] or "unknown") == surface]
        result[surface] = {"num_images": count_scored(own, subject, "tom"), "summary": summarize(own, subject)}
        for model in ("base", "consensus"):
            result[surface][model] = summarize(own, model) if model in models else None
    return result


def _per_scene(groups: list[dict], rows: list[dict], models: list[str], subject: str) -> dict:
    result = {}
    for scene in (group["group_id"] for group in groups):
        own = [row for row in rows if row["group_id"] == scene]
        result[scene] = {
            "num_images": len(own),
            "num_scored": count_scored(own, subject, "all"),
            "summary": summarize(own, subject),
            "base": summarize(own, "base") if "base" in models else None,
        }
    return result
