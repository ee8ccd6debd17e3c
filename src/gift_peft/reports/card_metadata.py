"""The metadata block of a model card in the Hub's terms, built from huggingface_hub's own classes.

Also what a card may call a model or dataset: a hub id, or of a path the last part.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from gift_peft.evaluation.metrics import METRICS
from gift_peft.evaluation.results import REGIONS, Report
from gift_peft.evaluation.tables import REGION_NAMES
from gift_peft.reports.backbones import BASES, Base

# As the models' pages state them: of Depth Anything V2 only the small one may be used commercially.
LICENSES = {
    "depth-anything/Depth-Anything-V2-Small-hf": "apache-2.0",
    "depth-anything/Depth-Anything-V2-Base-hf": "cc-by-nc-4.0",
    **{base.hub_id: base.license for base in BASES},
}
TAGS = ["gift", "lora", "depth-estimation", "transparent-objects", "mirrors"]
AGAINST = {"proxy": "against the treated-reference proxy", "depth": "against true depth"}
PLAIN_METRICS = {"mae": "MAE", "abs_rel": "AbsRel", "rmse": "RMSE", "delta1": "delta1 (%)"}


def is_local(name: str) -> bool:
    """Whether a model or dataset name is a path of this machine rather than a hub id."""
    return Path(name).expanduser().exists() or name.startswith(("/", ".", "~")) or name.count("/") > 1


def portable_name(name: str) -> str:
    """A hub id as it is, of a path the last part."""
    return Path(name).expanduser().resolve().name if is_local(name) else name


def base_license(base: str) -> str:
    """The base model's licence: known, or stated in a local folder's card, else "other"."""
    card = Path(base).expanduser() / "README.md"
    if card.is_file():
        from huggingface_hub import ModelCard

        try:
            return ModelCard.load(card).data.license or "other"
        except (ValueError, yaml.YAMLError):  # somebody else's file, and no reason to stop a training
            return "other"
    return LICENSES.get(base, "other")


def card_metadata(arguments: Mapping, record: Mapping | None, reports: Sequence[Report], base: Base | None) -> Any:
    """`ModelCardData` of an adapter; arguments as in `model_card`, `base` if it is one of the paper's backbones."""
    from huggingface_hub import ModelCardData

    name, dataset = arguments["model_name_or_path"], arguments.get("dataset_name") or ""
    hub_base = base.hub_id if base else None if is_local(name) else name
    public_data = bool(dataset) and not is_local(dataset) and "/" in dataset
    results = _eval_results(arguments, record, reports)
    repository = arguments.get("hub_model_id") or "gift-adapter"
    options: dict[str, Any] = {"base_model": hub_base, "base_model_relation": "adapter"} if hub_base else {}
    return ModelCardData(
        library_name="peft",
        pipeline_tag="depth-estimation",
        license=arguments.get("license") or (base.license if base else base_license(name)),
        datasets=[dataset] if public_data else None,
        tags=TAGS,
        model_name=repository.split("/")[-1] if results else None,
        eval_results=results or None,
        **options,
    )


def _eval_results(arguments: Mapping, record: Mapping | None, reports: Sequence[Report]) -> list:
    """One entry per metric of the adapter: of every report, else of the run's own validation."""
    entries = []
    dataset = arguments.get("dataset_name") or "gift-i"
    kind = "gift-i" if is_local(dataset) else dataset
    for report in reports:
        if report.dataset == "booster":
            config = f"{report.about.get('subset') or 'default'}, protocol {report.protocol['name']}"
            entries.append(("Booster", "booster", config, _flat(report.summary)))
            continue
        against = f"{AGAINST[report.reference]}, protocol {report.protocol['name']}"
        values = {"gce": report.gce["adapted"]} | _flat(report.summary)
        entries.append((f"{portable_name(dataset)} validation", kind, against, values))
    if not entries and record is not None:
        row = record["metrics"]["adapter"]
        values = {key: row.get(f"val_{key}") for key in ("gce", *_flat_keys())}
        entries.append((f"{portable_name(dataset)} validation", kind, f"{AGAINST['proxy']}, protocol native", values))
    return [
        _eval_result(name, kind_of, config, key, value)
        for name, kind_of, config, values in entries
        for key, value in values.items()
        if value is not None
    ]


def _eval_result(dataset_name: str, dataset_type: str, config: str, key: str, value: float) -> Any:
    """The config keeps evaluations apart: without it the Hub's client merges all of one dataset."""
    from huggingface_hub import EvalResult

    title = "GCE"
    if key != "gce":
        region, metric = key.split("_", 1)
        title = f"{REGION_NAMES[region]} {PLAIN_METRICS[metric]}"
    return EvalResult(
        task_type="depth-estimation",
        task_name="Depth Estimation",
        dataset_type=dataset_type,
        dataset_name=dataset_name,
        dataset_config=config,
        metric_type=key,
        metric_name=title,
        metric_value=round(value, 6),
    )


def _flat_keys() -> list[str]:
    return [f"{region}_{metric}" for region in REGIONS for metric in METRICS]


def _flat(summary: dict) -> dict[str, float | None]:
    return {f"{region}_{metric}": summary[region][metric] for region in REGIONS for metric in METRICS}
