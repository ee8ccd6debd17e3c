"""`gift-peft evaluate`: load, evaluate, print the table, leave the files."""

from pathlib import Path
from typing import Any

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.evaluation.booster_scenes import find_booster
from gift_peft.evaluation.evaluate import evaluate_booster, evaluate_gift_i
from gift_peft.evaluation.protocols import get_protocol
from gift_peft.evaluation.results import Report
from gift_peft.evaluation.tables import markdown_table, text_table
from gift_peft.files import write_whole
from gift_peft.models.loading import DepthModel


def run_evaluation(
    base: str | Path,
    dataset: str | Path,
    adapter: str | Path | None = None,
    *,
    reference: str = "proxy",
    protocol: str | None = None,
    split: str = "validation",
    out: str | Path = "evaluation",
    adapter_scale: float | None = None,
    size: str | tuple[int, int] | None = None,
    kind: str | None = None,
    revision: str | None = None,
    dataset_revision: str | None = None,
    prediction_scale: float | None = None,
    batch_size: int = 2,
    device: str | None = None,
    color: bool = False,
    progress: bool = True,
) -> Report:
    """`gift-peft evaluate`: loads, evaluates, prints the table, writes `metrics.json`, `rows.jsonl`, `report.md`."""
    model = DepthModel.from_pretrained(base, adapter, adapter_scale, revision, size, kind, device)
    groups = load_gift_i(dataset, split, dataset_revision=dataset_revision)
    report = evaluate_gift_i(
        groups,
        model,
        protocol=protocol,
        reference=reference,
        prediction_scale=prediction_scale,
        batch_size=batch_size,
        progress=progress,
    )
    report.about = {
        "base": str(base),
        "revision": revision,
        "adapter": adapter and str(adapter),
        "adapter_scale": adapter_scale,
        "dataset": str(dataset),
        "dataset_revision": dataset_revision,
        "split": split,
        "size": list(model.size),
        "kind": model.kind,
    }
    write_report(report, out, color)
    return report


def run_booster(
    root: str | Path,
    base: str | Path | None = None,
    adapter: str | Path | None = None,
    *,
    predictions: str | Path | None = None,
    out: str | Path = "evaluation",
    adapter_scale: float | None = None,
    size: str | tuple[int, int] | None = None,
    kind: str | None = None,
    revision: str | None = None,
    device: str | None = None,
    color: bool = False,
    **options: Any,
) -> Report:
    """`gift-peft evaluate --booster`: as `run_evaluation`, of a base or of stored predictions.

    `options` are those of `evaluate_booster`.
    """
    if predictions is not None:
        report = evaluate_booster(root, predictions=predictions, kind=kind, **options)
    else:
        # What is wrong with these is said before large weights are loaded.
        get_protocol(options.get("protocol", "gift"))
        find_booster(root, options.get("subset"), options.get("official"))
        model = DepthModel.from_pretrained(base, adapter, adapter_scale, revision, size, kind, device)
        report = evaluate_booster(root, model, **options)
        report.about |= {
            "base": str(base),
            "revision": revision,
            "adapter": adapter and str(adapter),
            "adapter_scale": adapter_scale,
            "size": list(model.size),
        }
    write_report(report, out, color)
    return report


def write_report(report: Report, out: str | Path, color: bool = False) -> None:
    """Leaves the report in a folder and prints its table."""
    folder = report.save(out)
    write_whole(folder / "report.md", markdown_table(report))
    print(text_table(report, color=color))
    print(f"Written: {folder}/metrics.json, rows.jsonl, report.md")
