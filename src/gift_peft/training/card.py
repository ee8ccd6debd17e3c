"""What goes with an adapter: the record for gift.json, the model card, and the upload of both to the Hub.

Neither record nor card holds a path of this machine; a local base or dataset appears by its folder's name only.
"""

import functools
import platform
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import torch
import yaml

from gift_peft.evaluation.report import REGION_NAMES, number, relative_change
from gift_peft.training.arguments import FREE_TO_CHANGE, GiftTrainingArguments

UPLOADED = ["adapter_model.safetensors", "adapter_config.json", "gift.json", "preprocessor_config.json", "README.md"]
PACKAGES = ("gift-peft", "torch", "transformers", "peft", "accelerate", "datasets")
# And all that a resumed run may not change.
RECORDED = ("model_revision", "dataset_name", "num_train_epochs", "max_steps", "retain")
METRICS = {"mae": "MAE", "abs_rel": "AbsRel", "rmse": "RMSE", "delta1": "delta1 (%)"}
# As the models' pages state them: only the small one may be used commercially.
LICENSES = {
    "depth-anything/Depth-Anything-V2-Small-hf": "apache-2.0",
    "depth-anything/Depth-Anything-V2-Base-hf": "cc-by-nc-4.0",
    "depth-anything/Depth-Anything-V2-Large-hf": "cc-by-nc-4.0",
    "facebook/VGGT-1B": "cc-by-nc-4.0",
}


def is_local(name: str) -> bool:
    """Whether a model or dataset name is a path of this machine rather than a hub id."""
    return Path(name).expanduser().exists() or name.startswith(("/", ".", "~")) or name.count("/") > 1


def portable_name(name: str) -> str:
    """A hub id as it is, of a path the last part."""
    return Path(name).expanduser().resolve().name if is_local(name) else name


def run_record(args: GiftTrainingArguments, **about) -> dict:
    """What was run, for gift.json: arguments, versions, kind of machine, and `about` (size, metrics, fingerprint)."""
    arguments = {k: v for k, v in asdict(args).items() if k in RECORDED or k not in FREE_TO_CHANGE}
    arguments = {k: v for k, v in arguments.items() if v is not None and v != []}
    for name in ("model_name_or_path", "dataset_name"):
        arguments[name] = portable_name(arguments[name])
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else f"{platform.machine()} CPU"
    return {
        "arguments": arguments,
        "versions": _versions(),
        "device": device,
        **about,
    }


@functools.cache
def _versions() -> dict[str, str]:
    return {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}


def model_card(args: GiftTrainingArguments, record: dict) -> str:
    """README.md of an adapter. `record` is `run_record`'s, with the rows of metrics.jsonl that belong to it."""
    base, adapted = record["metrics"]["base"], record["metrics"]["adapter"]
    name = record["arguments"]["model_name_or_path"]
    repository = args.hub_model_id or "path/to/this/adapter"
    metadata = yaml.safe_dump(_metadata(args, adapted), sort_keys=False, allow_unicode=True)
    return f"""---
{metadata}---

# GIFT adapter for {name}

Trained without depth labels on groups of images in which only what a mirror or glass surface reflects or transmits
changes (GIFT): the predictions inside the surface are made to agree, those outside stay with the frozen model.
{_kind_line(record)}

## Use

```python
{_usage(record, repository)}
```

`PeftModel.from_pretrained(base, "{repository}")` gives the switchable form: `model.disable_adapter()` is the base
model exactly, `model.merge_and_unload()` a plain one. Needs transformers 5.18 or newer (module names changed there).

## Results

{_results(base, adapted)}

## What was run

{_run_lines(record)}

```yaml
{yaml.safe_dump(record["arguments"], sort_keys=False, allow_unicode=True).strip()}
```
"""


def _metadata(args: GiftTrainingArguments, adapted: dict) -> dict:
    base, dataset = args.model_name_or_path, args.dataset_name
    metadata: dict = {"library_name": "peft"}
    if not is_local(base):
        metadata |= {"base_model": base, "base_model_relation": "adapter"}
    metadata["pipeline_tag"] = "depth-estimation"
    metadata["license"] = args.license or base_license(base)
    if not is_local(dataset):
        metadata["datasets"] = [dataset]
    metadata["tags"] = ["gift", "lora", "depth-estimation", "transparent-objects", "mirrors"]
    metrics = [_metric("gce", "GCE", adapted["val_gce"])]
    for region, title in REGION_NAMES.items():
        metrics += [_metric(f"{region}_{m}", f"{title} {n}", adapted[f"val_{region}_{m}"]) for m, n in METRICS.items()]
    if metrics := [metric for metric in metrics if metric]:
        data = {"name": f"{portable_name(dataset)} validation", "type": "gift-i" if is_local(dataset) else dataset}
        task = {"type": "depth-estimation", "name": "Depth Estimation"}
        name = (args.hub_model_id or "gift-adapter").split("/")[-1]
        metadata["model-index"] = [{"name": name, "results": [{"task": task, "dataset": data, "metrics": metrics}]}]
    return metadata


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


def _metric(kind: str, name: str, value: float | None) -> dict | None:
    return None if value is None else {"type": kind, "name": name, "value": round(value, 6)}


def _kind_line(record: dict) -> str:
    if record["kind"] == "depth":
        return "The model predicts depth: larger is farther."
    return "The model predicts inverse depth: larger is nearer, up to an unknown scale and shift."


def _usage(record: dict, repository: str) -> str:
    lines = ["from transformers import pipeline", ""]
    if record["model_type"].startswith("gift_"):
        lines.insert(0, "import gift_peft  # registers the model class")
    lines += [f'estimate = pipeline("depth-estimation", model="{repository}")']
    return "\n".join([*lines, 'depth = estimate("photo.jpg")["predicted_depth"]'])


def _results(base: dict, adapted: dict) -> str:
    rows = [("GCE ↓", "val_gce")] + [
        (f"{title} {name} {'↑' if metric == 'delta1' else '↓'}", f"val_{region}_{metric}")
        for region, title in REGION_NAMES.items()
        for metric, name in METRICS.items()
    ]
    lines = [
        f"| {label} | {number(base[key])} | {number(adapted[key])} | {_percent(base[key], adapted[key])} |"
        for label, key in rows
        if adapted[key] is not None
    ]
    if not lines:
        return "No validation split was given, so nothing was measured."
    return "\n".join(
        [
            "On the validation groups, against the frozen model's own prediction on the treated reference (the",
            "surface sprayed or covered) after a scale and shift fit, in native units. ToM is the transparent or",
            "mirror surface; GCE is the mean disagreement inside it between the images of a group.",
            "",
            "| | base | adapted | change |",
            "|---|---:|---:|---:|",
            *lines,
        ]
    )


def _percent(base: float | None, adapted: float | None) -> str:
    change = relative_change(base, adapted)
    return "-" if change != change else f"{change:+.1f} %"


def _run_lines(record: dict) -> str:
    height, width = record["size"]
    return "\n".join(
        [
            f"- {record['num_groups']} training groups at {height}x{width} (height x width), one update per group",
            f"- update {record['step']} (epoch {record['epoch']:g}), seed {record['arguments']['seed']}",
            f"- autocast {record['mixed_precision']} over float32 weights, {record['num_processes']} process(es), "
            f"{record['device']}",
            f"- {', '.join(f'{name} {number}' for name, number in record['versions'].items())}",
        ]
    )


def check_push(args: GiftTrainingArguments) -> None:
    """Raise ValueError before training starts if the upload at its end could not work."""
    if not args.push_to_hub:
        return
    from huggingface_hub import get_token
    from huggingface_hub.utils import validate_repo_id

    if is_local(args.model_name_or_path):
        raise ValueError(
            "push_to_hub: model_name_or_path is a local folder, which nobody else could load; give the base's hub id"
        )
    if get_token() is None:
        raise ValueError("push_to_hub: no token; run `hf auth login` or set HF_TOKEN")
    try:
        validate_repo_id(_repository(args))
    except ValueError as error:
        raise ValueError(f"push_to_hub: {error} Give another --hub_model_id") from None


def _repository(args: GiftTrainingArguments) -> str:
    return args.hub_model_id or Path(args.output_dir).resolve().name


def push(folder: Path, args: GiftTrainingArguments) -> str:
    """Upload an adapter folder (the five files of `UPLOADED`); returns the repository's id.

    OSError if that fails; the run itself is complete then, and resuming it uploads again.
    """
    from huggingface_hub import HfApi

    api = HfApi()
    try:
        repository = api.create_repo(repo_id=_repository(args), private=args.hub_private_repo, exist_ok=True).repo_id
        api.upload_folder(
            repo_id=repository, folder_path=folder, allow_patterns=UPLOADED, commit_message="GIFT adapter"
        )
    except (OSError, ValueError) as error:  # HfHubHTTPError is an OSError, a malformed repository name a ValueError
        raise OSError(
            f"push_to_hub: {error} (the adapter is in {folder}; the same command with "
            "--resume_from_checkpoint latest uploads it again)"
        ) from error
    return repository
