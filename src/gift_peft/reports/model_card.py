"""The model card of an adapter, whether it was just trained, evaluated later, or is not trained yet.

Its prose is `templates/model_card.md` and, for the paper's backbones, `backbones/*.md`; here are the values it shows.
Training writes it beside the adapter, `gift-peft report --model-card` writes it again with the saved evaluations.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from gift_peft.evaluation.metrics import METRICS
from gift_peft.evaluation.results import REGIONS, Report
from gift_peft.evaluation.table_formats import number, to_markdown
from gift_peft.evaluation.tables import (
    METRIC_NAMES,
    NO_TEACHING,
    REGION_NAMES,
    consensus_teaches,
    markdown_table,
    relative_change,
    uncertainty_table,
)
from gift_peft.files import is_hub_id, portable_name

HERE = Path(__file__).parent
MARK = "# GIFT adapter for "  # of the template, by which a card of ours is known
TAGS = ["gift", "lora", "depth-estimation", "transparent-objects", "mirrors"]
# As the models' pages state them: of Depth Anything V2 only the small one may be used commercially.
LICENSES = {
    "depth-anything/Depth-Anything-V2-Small-hf": "apache-2.0",
    "depth-anything/Depth-Anything-V2-Base-hf": "cc-by-nc-4.0",
}
AGAINST = {"proxy": "against the treated-reference proxy", "depth": "against true depth"}
PLAIN_METRICS = {"mae": "MAE", "abs_rel": "AbsRel", "rmse": "RMSE", "delta1": "delta1 (%)"}
# What training does where a YAML file does not say otherwise.
DEFAULTS = {
    "lora_rank": 8,
    "head": "full",
    "target": "consensus",
    "lambda_d": 1,
    "learning_rate": 2e-5,
    "lr_scheduler_type": "constant",
    "weight_decay": 0,
}


@dataclass(frozen=True)
class Backbone:
    """What `backbones/*.md` tells of a backbone: facts in the front matter, then prose.

    Args:
        title (`str`): name in headings.
        hub_id (`str`): where its weights are.
        config (`str`): the settings in `examples/`.
        license (`str`): of the weights, a Hub license id; `unknown` where none is stated.
        model_type (`str`): of its transformers config.
        kind (`str`): what it predicts.
        parameters (`int`): of the whole model.
        encoder_lora, head_lora (`int`): LoRA parameters per rank on the encoder's attention, and on the head.
        head_parameters (`int`): what `head="full"` trains.
        targets (`str`): where LoRA goes, for the recipe.
        head (`str`): what is trained in full.
        paper (`dict`): {row title: RMSE of the base, and with GIFT if it was adapted}, the paper's figures.
        text (`str`): Markdown about origin, license, input and output.
        folder (`str`, *optional*): what the examples call the converted weights.
        precision (`str`): what of it is exempt from autocast.
    """

    title: str
    hub_id: str
    config: str
    license: str
    model_type: str
    kind: str
    parameters: int
    encoder_lora: int
    head_lora: int
    head_parameters: int
    targets: str
    head: str
    paper: dict[str, list[float]]
    text: str
    folder: str | None = None
    precision: str = ""

    @property
    def adapted_in_paper(self) -> bool:
        """Whether the paper has a row of it with GIFT."""
        return all(len(values) == 2 for values in self.paper.values())

    def adapter_sizes(self, rank: int) -> dict[str, tuple[int, int]]:
        """{head: (LoRA parameters, others)} that `get_gift_model` trains."""
        encoder, head = rank * self.encoder_lora, rank * self.head_lora
        return {"full": (encoder, self.head_parameters), "lora": (encoder + head, 0), "none": (encoder, 0)}


@functools.cache
def backbones() -> tuple[Backbone, ...]:
    """The paper's three backbones, and its strongest unadapted one."""
    from huggingface_hub import RepoCard

    found = []
    for path in sorted((HERE / "backbones").glob("*.md")):
        card = RepoCard.load(path)
        facts = card.data.to_dict()
        text = card.text.format(parameters=facts["parameters"], gigabytes=4 * facts["parameters"] / 1e9)
        found.append(Backbone(**facts, text=text.strip()))
    return tuple(found)


def find_backbone(name: str) -> Backbone | None:
    """The backbone of that hub id, or of the folder name that the examples use."""
    return next((backbone for backbone in backbones() if name in (backbone.hub_id, backbone.folder)), None)


def model_card(
    arguments: Mapping[str, Any], record: Mapping[str, Any] | None = None, reports: Sequence[Report] = ()
) -> str:
    """README.md of an adapter; it names no path of this machine.

    Args:
        arguments: of the training (`config.yaml`): names of base and dataset, `license`, `hub_model_id`, settings.
        record (*optional*): gift.json: what was run, with the first and the adapter's row of metrics.jsonl in
            `metrics`; None for an adapter that is not trained yet.
        reports: saved evaluations of the adapter beside its base; without them the rows in `record` are shown.

    Raises:
        ValueError: `arguments` do not name a base model.
    """
    from huggingface_hub import ModelCard

    name, dataset = arguments.get("model_name_or_path"), arguments.get("dataset_name")
    if not name:
        raise ValueError("a model card needs model_name_or_path, the base model's name")
    backbone = find_backbone(name)
    # A folder may hold anything, whatever it is called: only for a run to come the name is believed.
    if record is not None and backbone and not (name == backbone.hub_id and is_hub_id(name)):
        backbone = None
    settings = DEFAULTS | dict(arguments)
    is_surface = settings["target"] == "surface"
    settings.setdefault("lambda_c", 2 if is_surface else 1)
    for key in ("lambda_c", "lambda_d", "learning_rate", "weight_decay"):
        settings[key] = f"{float(settings[key]):g}"
    about = record or (vars(backbone) if backbone else {})
    size = record["size"] if record else None
    tables = [text for report in reports for text in (markdown_table(report), to_markdown(uncertainty_table(report)))]
    values = {
        "title": backbone.title if backbone else portable_name(name),
        "kind": about.get("kind"),
        "own_class": about.get("model_type", "").startswith("gift_"),
        "repository": arguments.get("hub_model_id") or "path/to/this/adapter",
        "base": (backbone.folder or backbone.hub_id) if backbone else name if is_hub_id(name) else "path/to/the/base",
        "dataset": f"`{portable_name(dataset)}`" if dataset else "GIFT-I",
        "size": f"{size[0]}x{size[1]}" if size else arguments.get("size") or "476x644",
        "precision": (record or arguments).get("mixed_precision") or "bf16",
        "run_length": run_length(arguments),
        "surface_target": is_surface,
        "per_update": _per_update(settings, record),
        "tables": "\n".join(tables).strip(),
        "validation": _validation(record),
        "retention": _retention(record, reports),
        "limits": _limits(record, reports),
    }
    if backbone:
        values |= _sizes(backbone, settings)
    if record:
        dumped = yaml.safe_dump(dict(record["arguments"]), sort_keys=False, allow_unicode=True)
        values["run_arguments"] = dumped.strip()
    card = ModelCard.from_template(
        card_metadata(arguments, record, reports, backbone),
        template_path=str(HERE / "templates" / "model_card.md"),
        backbone=backbone,
        record=record,
        settings=settings,
        percent=_percent,
        **values,
    )
    return f"{card.content}\n"


def run_length(arguments: Mapping[str, Any]) -> str:
    """How long a training with these arguments is: "50 epochs", or "300 updates" where `max_steps` says so."""
    steps = int(arguments.get("max_steps", -1))
    return f"{steps} updates" if steps > 0 else f"{arguments.get('num_train_epochs', 50)} epochs"


# ---- values of the sections ----


def _row(label: str, base: float | None, adapted: float | None) -> tuple[str, str, str, str]:
    return label, number(base), number(adapted), _percent(base, adapted)


def _per_update(settings: Mapping, record: Mapping | None) -> str:
    """What an update takes, in words."""
    if settings["target"] != "surface":
        return "one update per group"
    images = settings.get("per_device_train_batch_size", 4) * settings.get("gradient_accumulation_steps", 1)
    if record is not None:
        images *= record["num_processes"]
    return f"{images} images of any groups per update"


def _percent(base: float | None, adapted: float | None) -> str:
    change = relative_change(base, adapted)
    return "-" if change != change else f"{change:+.1f} %"


def _validation(record: Mapping | None) -> list[tuple[str, str, str, str]]:
    """The run's own validation: GCE, and every metric of every region that was measured."""
    if record is None:
        return []
    base, adapted = record["metrics"]["base"], record["metrics"]["adapter"]
    rows = [("GCE ↓", "val_gce")]
    rows += [(f"{REGION_NAMES[r]} {METRIC_NAMES[m]}", f"val_{r}_{m}") for r in REGIONS for m in METRICS]
    return [_row(label, base[key], adapted[key]) for label, key in rows if adapted.get(key) is not None]


def _retention(record: Mapping | None, reports: Sequence[Report]) -> list[tuple[str, str, str, str]]:
    """What the adapter costs outside the target."""
    lines = []
    for report in reports:
        if report.base and report.adapted:
            where = "Booster" if report.dataset == "booster" else f"GIFT-I, {report.reference}"
            lines.append((where, report.base["other"], report.summary["other"]))
    if not lines and record is not None:
        base, adapted = ({m: record["metrics"][k].get(f"val_other_{m}") for m in METRICS} for k in ("base", "adapter"))
        lines = [("validation, proxy", base, adapted)] if adapted["rmse"] is not None else []
    return [
        _row(f"{where}: {METRIC_NAMES[metric]}", base[metric], adapted[metric])
        for where, base, adapted in lines
        for metric in ("rmse", "delta1")
    ]


def _sizes(backbone: Backbone, settings: Mapping) -> dict[str, str]:
    sizes = backbone.adapter_sizes(int(settings["lora_rank"]))
    lora, full = sizes[settings["head"]]
    text = {head: _mebibytes(sum(size)) for head, size in sizes.items()}
    others = ", ".join(f"`head: {head}` {text[head]}" for head in sizes if head != settings["head"])
    return {
        "parameters": f"{lora:,} in LoRA" + (f", {full:,} in the head" if full else ""),
        "adapter_size": f"{text[settings['head']]} ({others})",
    }


def _mebibytes(parameters: int) -> str:
    size = 4 * parameters / 2**20
    return f"{size:.0f} MiB" if size >= 100 else f"{size:.3g} MiB"


def _limits(record: Mapping | None, reports: Sequence[Report]) -> list[str]:
    """What was measured and speaks against the adapter."""
    limits = []
    for report in reports:
        where = "Booster" if report.dataset == "booster" else f"GIFT-I ({report.reference})"
        if report.collapse and report.collapse["alarm"]:
            limits.append(f"Collapse alarm on {where}: the outputs shrank, grew or flattened. Do not use it.")
        if consensus_teaches(report) is False:
            limits.append(f"{where}: {NO_TEACHING}")
        if report.base and report.adapted:
            for region in ("tom", "other"):
                change = relative_change(report.base[region]["rmse"], report.summary[region]["rmse"])
                if change > 0:
                    limits.append(f"{REGION_NAMES[region]} RMSE on {where} got worse, by {change:.1f} %.")
    if not reports and record is not None:
        rows = record["metrics"]
        for region in ("tom", "other"):
            key = f"val_{region}_rmse"
            change = relative_change(rows["base"].get(key), rows["adapter"].get(key))
            if change > 0:
                limits.append(f"{REGION_NAMES[region]} RMSE on the validation groups got worse, by {change:.1f} %.")
    return limits


# ---- the metadata block, in huggingface_hub's own classes ----


def base_license(base: str) -> str:
    """The base model's license: known, or stated in a local folder's card, else "other"."""
    card = Path(base).expanduser() / "README.md"
    if card.is_file():
        from huggingface_hub import ModelCard

        try:
            return ModelCard.load(card).data.license or "other"
        except (ValueError, yaml.YAMLError):  # somebody else's file, and no reason to stop a training
            return "other"
    return LICENSES.get(base, "other")


def card_metadata(
    arguments: Mapping, record: Mapping | None, reports: Sequence[Report], backbone: Backbone | None
) -> Any:
    """`ModelCardData` of an adapter; arguments as in `model_card`, `backbone` if its base is one of the paper's."""
    from huggingface_hub import ModelCardData

    name, dataset = arguments["model_name_or_path"], arguments.get("dataset_name") or ""
    hub_base = backbone.hub_id if backbone else name if is_hub_id(name) else None
    results = _eval_results(arguments, record, reports)
    repository = arguments.get("hub_model_id") or "gift-adapter"
    options: dict[str, Any] = {"base_model": hub_base, "base_model_relation": "adapter"} if hub_base else {}
    return ModelCardData(
        library_name="peft",
        pipeline_tag="depth-estimation",
        license=arguments.get("license") or (backbone.license if backbone else base_license(name)),
        datasets=[dataset] if "/" in dataset and is_hub_id(dataset) else None,
        tags=TAGS,
        model_name=repository.split("/")[-1] if results else None,
        eval_results=results or None,
        **options,
    )


def _eval_results(arguments: Mapping, record: Mapping | None, reports: Sequence[Report]) -> list:
    """One entry per metric of the adapter: of every report, else of the run's own validation."""
    entries = []
    dataset = arguments.get("dataset_name") or "gift-i"
    kind = dataset if is_hub_id(dataset) else "gift-i"
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
        keys = ["gce", *(f"{region}_{metric}" for region in REGIONS for metric in METRICS)]
        values = {key: row.get(f"val_{key}") for key in keys}
        entries.append((f"{portable_name(dataset)} validation", kind, f"{AGAINST['proxy']}, protocol native", values))
    return [
        _eval_result(name, kind_of, config, key, value)
        for name, kind_of, config, values in entries
        for key, value in values.items()
        if value is not None and math.isfinite(value)  # the Hub refuses a card with a NaN
    ]


def _flat(summary: dict) -> dict[str, float | None]:
    return {f"{region}_{metric}": summary[region][metric] for region in REGIONS for metric in METRICS}


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
