"""The model card of an adapter, whether it was just trained, evaluated later, or is not trained yet.

One generator: `training` writes it beside the adapter, `gift-peft report --model-card` writes it again with the saved
evaluations. Its metadata are huggingface_hub's own classes; no path of this machine gets into it.
"""

import textwrap
from collections.abc import Mapping, Sequence
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
from gift_peft.reports.backbones import Base, adapter_sizes, find_base
from gift_peft.reports.card_metadata import card_metadata, is_local, portable_name

NOT_TRAINED = "**Not trained yet.** This page says how the adapter is made; it gets its results from the training run."
KINDS = {
    "depth": "The model predicts depth: larger is farther.",
    "inverse_depth": "The model predicts inverse depth: larger is nearer, up to an unknown scale and shift.",
}


def model_card(
    arguments: Mapping[str, Any], record: Mapping[str, Any] | None = None, reports: Sequence[Report] = ()
) -> str:
    """README.md of an adapter.

    Args:
        arguments: of the training (`config.yaml`): names of base and dataset, `license`, `hub_model_id`, settings.
        record (*optional*): gift.json: what was run, with the first and the adapter's row of metrics.jsonl in
            `metrics`; None for an adapter that is not trained yet.
        reports: saved evaluations of the adapter beside its base; without them the rows in `record` are shown.

    Raises:
        ValueError: `arguments` do not name a base model.
    """
    from huggingface_hub import ModelCard

    if not arguments.get("model_name_or_path"):
        raise ValueError("a model card needs model_name_or_path, the base model's name")
    base = _known_base(arguments, record)
    title = base.title if base else portable_name(arguments["model_name_or_path"])
    parts = [f"# GIFT adapter for {title}", _introduction(base, record)]
    if record is None:
        parts.insert(1, NOT_TRAINED)
    if base:
        size = base.parameters
        filled = base.about.replace("{parameters}", f"{size:,}").replace("{gigabytes}", f"{4 * size / 1e9:.2f}")
        parts += [f"## Base model\n\n{filled}", f"## Input and output\n\n{base.inout}"]
    parts += [f"## Use\n\n{_usage(arguments, record, base)}", f"## Results\n\n{_results(record, reports)}"]
    if retention := _retention(record, reports):
        parts.append(f"## Retention\n\n{retention}")
    if base and base.paper:
        parts.append(f"## What the paper reports\n\n{_paper(base)}")
    parts += [f"## Recipe\n\n{_recipe(arguments, record, base)}", f"## Data\n\n{_data(arguments, record)}"]
    if record is not None:
        parts.append(f"## What was run\n\n{_run_lines(record)}")
    parts.append(f"## Limits\n\n{_limits(record, reports)}")
    metadata = card_metadata(arguments, record, reports, base).to_yaml()
    text = f"---\n{metadata}\n---\n\n" + "\n\n".join(parts) + "\n"
    ModelCard(text)  # parses and checks the metadata block as the Hub's client does
    return text


def _known_base(arguments: Mapping[str, Any], record: Mapping[str, Any] | None) -> Base | None:
    """One of the paper's backbones; by a folder's name only for a run not made yet, as a folder may hold anything."""
    name = arguments["model_name_or_path"]
    base = find_base(name)
    return base if base and (name == base.hub_id or record is None) else None


# ---- sections ----


def _introduction(base: Base | None, record: Mapping | None) -> str:
    kind = record["kind"] if record else base.kind if base else None
    text = (
        "Trained without depth labels on groups of images in which only what a mirror or glass surface reflects or "
        "transmits changes (GIFT): the predictions inside the surface are made to agree, those outside stay with the "
        "frozen model."
    )
    return f"{_fill(text)}\n{KINDS[kind]}" if kind in KINDS else _fill(text)


def _usage(arguments: Mapping, record: Mapping | None, base: Base | None) -> str:
    repository = arguments.get("hub_model_id") or "path/to/this/adapter"
    model_type = record["model_type"] if record else base.model_type if base else ""
    first = ["import gift_peft  # registers the model class"] if model_type.startswith("gift_") else []
    name = arguments["model_name_or_path"]
    shown = "path/to/the/base" if is_local(name) else name
    if base:
        shown = base.folder or base.hub_id
    code = "\n".join(
        [
            *first,
            "from transformers import pipeline",
            "",
            f'estimate = pipeline("depth-estimation", model="{repository}")',
            'depth = estimate("photo.jpg")["predicted_depth"]',
        ]
    )
    return f"""```python
{code}
```

As a switch on the base model:

```python
from peft import PeftModel
from transformers import AutoModelForDepthEstimation

base = AutoModelForDepthEstimation.from_pretrained("{shown}")
model = PeftModel.from_pretrained(base, "{repository}")
```

`with model.disable_adapter():` is the base model exactly, `model.merge_and_unload()` a plain one. Needs transformers
5.18 or newer (module names changed there)."""


def _results(record: Mapping | None, reports: Sequence[Report]) -> str:
    if reports:
        parts = []
        for report in reports:
            parts += [markdown_table(report), to_markdown(uncertainty_table(report))]
        return "\n".join(parts).strip()
    if record is None:
        return "Not trained yet: nothing was measured."
    base, adapted = record["metrics"]["base"], record["metrics"]["adapter"]
    rows = [("GCE ↓", "val_gce")]
    rows += [(f"{REGION_NAMES[r]} {METRIC_NAMES[m]}", f"val_{r}_{m}") for r in REGIONS for m in METRICS]
    lines = [
        f"| {label} | {number(base[key])} | {number(adapted[key])} | {_percent(base[key], adapted[key])} |"
        for label, key in rows
        if adapted.get(key) is not None
    ]
    if not lines:
        return "No validation split was given, so nothing was measured."
    head = (
        "On the validation groups, against the frozen model's own prediction on the treated reference (the surface "
        "sprayed or covered) after a scale and shift fit, in native units (protocol `native`, image mean). ToM is the "
        "transparent or mirror surface; GCE is the mean disagreement inside it between the images of a group."
    )
    return "\n".join([_fill(head), "", "| | base | adapted | change |", "|---|---:|---:|---:|", *lines])


def _retention(record: Mapping | None, reports: Sequence[Report]) -> str:
    """What the adapter costs outside the target."""
    lines = []
    for report in reports:
        if report.base and report.adapted:
            where = "Booster" if report.dataset == "booster" else f"GIFT-I, {report.reference}"
            lines.append((where, report.base["other"], report.summary["other"]))
    if not lines and record is not None:
        base, adapted = ({m: record["metrics"][k].get(f"val_other_{m}") for m in METRICS} for k in ("base", "adapter"))
        lines = [("validation, proxy", base, adapted)] if adapted["rmse"] is not None else []
    if not lines:
        return ""
    table = ["| Other (outside the target) | base | adapted | change |", "|---|---:|---:|---:|"]
    for where, base, adapted in lines:
        for metric in ("rmse", "delta1"):
            values = base[metric], adapted[metric]
            label = f"{where}: {METRIC_NAMES[metric]}"
            table.append(f"| {label} | {number(values[0])} | {number(values[1])} | {_percent(*values)} |")
    return "\n".join(table)


def _paper(base: Base) -> str:
    rows = [
        f"| {row} | {before:.3f} | {after:.3f} | {_percent(before, after)} |"
        for row, (before, after) in base.paper.items()
    ]
    head = (
        "RMSE after an affine fit. These are the paper's figures (its Tables 1 and 2), measured by its authors with "
        "their own adapter on their own GIFT-I; nothing in this table was run here."
    )
    return "\n".join([_fill(head), "", "| paper | base | + GIFT | change |", "|---|---:|---:|---:|", *rows])


def _recipe(arguments: Mapping, record: Mapping | None, base: Base | None) -> str:
    rank, head = int(arguments.get("lora_rank", 8)), arguments.get("head", "full")
    size = record["size"] if record else None
    height_width = f"{size[0]}x{size[1]}" if size else arguments.get("size") or "476x644"
    precision = record["mixed_precision"] if record else arguments.get("mixed_precision") or "bf16"
    adapter = [f"| LoRA | rank {rank} on {base.targets if base else 'the attention of every encoder block'} |"]
    trained = {"full": "trained in full", "lora": "by LoRA", "none": "frozen"}[head]
    adapter.append(f"| depth head | {f'{base.head}, {trained}' if base else trained} |")
    if base:
        sizes = adapter_sizes(base, rank)
        lora, full = sizes[head]
        others = ", ".join(f"`head: {name}` {_mebibytes(*sizes[name])}" for name in sizes if name != head)
        adapter.append(f"| parameters | {lora:,} in LoRA{f', {full:,} in the head' if full else ''} |")
        adapter.append(f"| adapter size | {_mebibytes(lora, full)} ({others}) |")
    if kind := record["kind"] if record else base.kind if base else None:
        adapter.append(f'| prediction | `kind="{kind}"` |')
    rows = [
        "| | |",
        "|---|---|",
        *adapter,
        f"| input size | {height_width} (height x width), plain bicubic resize |",
        f"| loss | consistency : distillation = {_get(arguments, 'lambda_c', 1)}:{_get(arguments, 'lambda_d', 1)} |",
        f"| optimisation | Adam, learning rate {_get(arguments, 'learning_rate', 2e-5)} "
        f"({arguments.get('lr_scheduler_type', 'constant')}), weight decay {_get(arguments, 'weight_decay', 0)}, "
        f"{run_length(arguments)}, one update per group |",
        f"| precision | {_precision(precision, base)} |",
    ]
    text = "\n".join(rows)
    if record is None and (config := EXAMPLES.get(base.hub_id if base else "")):
        text += f"\n\n```\naccelerate launch examples/train_gift.py --config examples/{config}\n```"
    return text


EXAMPLES = {
    "depth-anything/Depth-Anything-V2-Large-hf": "depth_anything_v2_large.yaml",
    "facebook/VGGT-1B": "vggt_1b.yaml",
    "JUGGHM/Metric3D": "metric3d_v2_giant.yaml",
}


def _get(arguments: Mapping, name: str, default: float) -> str:
    return f"{float(arguments.get(name, default)):g}"


def run_length(arguments: Mapping[str, Any]) -> str:
    """How long a training with these arguments is: "50 epochs", or "300 updates" where `max_steps` says so."""
    steps = int(arguments.get("max_steps", -1))
    return f"{steps} updates" if steps > 0 else f"{arguments.get('num_train_epochs', 50)} epochs"


def _precision(precision: str, base: Base | None) -> str:
    if precision == "no":
        return "float32"
    return f"{precision} autocast over float32 weights{base.precision if base else ''}"


def _mebibytes(lora: int, full: int) -> str:
    size = 4 * (lora + full) / 2**20
    return f"{size:.0f} MiB" if size >= 100 else f"{size:.3g} MiB"


def _data(arguments: Mapping, record: Mapping | None) -> str:
    dataset = arguments.get("dataset_name")
    name = f"`{portable_name(dataset)}`" if dataset else "GIFT-I"
    lines = [f"Groups of images of one camera pose and target geometry, with a mask of the target each: {name}."]
    if record is None:
        lines.append(
            "The paper's GIFT-I (353 training groups, 3,268 images; 41 validation groups, 350 images) does not come "
            "with this project; the recipe takes any GIFT-I of your own."
        )
    else:
        fingerprint = record.get("dataset_fingerprint")
        mark = f"; fingerprint `{fingerprint.split('-')[0]}`" if fingerprint else ""
        lines.append(f"{record['num_groups']} training groups{mark}.")
    lines.append("No depth label is used in training: outside the surface the frozen model's own predictions are.")
    return _fill(" ".join(lines))


def _run_lines(record: Mapping) -> str:
    height, width = record["size"]
    lines = [
        f"- {record['num_groups']} training groups at {height}x{width} (height x width), one update per group",
        f"- update {record['step']} (epoch {record['epoch']:g}), seed {record['arguments']['seed']}",
        f"- autocast {record['mixed_precision']} over float32 weights, {record['num_processes']} process(es), "
        f"{record['device']}",
        f"- {', '.join(f'{name} {version}' for name, version in record['versions'].items())}",
        "",
        "```yaml",
        yaml.safe_dump(dict(record["arguments"]), sort_keys=False, allow_unicode=True).strip(),
        "```",
    ]
    return "\n".join(lines)


def _limits(record: Mapping | None, reports: Sequence[Report]) -> str:
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
    limits += [
        "Agreement is not accuracy: the loss pulls a group's predictions together, and where most of them are wrong "
        "they agree on something wrong. The base decides what can be learned.",
        "The proxy references of GIFT-I are the base's own predictions on treated surfaces, not measured depth: such "
        "figures compare an adapter with its base and nothing else.",
        "Trained on still groups of one camera pose; nothing is known about video, about other materials than mirrors "
        "and glass, or about uses in which safety depends on depth.",
        "Whatever the base's licence forbids, the adapter's use forbids as well.",
    ]
    return "\n".join(_fill(limit, initial_indent="- ", subsequent_indent="  ") for limit in limits)


def _fill(text: str, **options: str) -> str:
    """Markdown source in lines of at most 119 characters; names are not cut."""
    return textwrap.fill(text, 119, break_long_words=False, break_on_hyphens=False, **options)


def _percent(base: float | None, adapted: float | None) -> str:
    change = relative_change(base, adapted)
    return "-" if change != change else f"{change:+.1f} %"
