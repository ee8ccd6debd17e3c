"""The paper's Table 3: runs that differ in their loss weights, each at its checkpoint with the smallest GCE."""

from collections.abc import Sequence
from dataclasses import replace

from gift_peft.evaluation.protocols import PROTOCOLS
from gift_peft.evaluation.table_formats import Cell, Table, value_cell
from gift_peft.evaluation.tables import protocol_note, skipped_note
from gift_peft.reports.curves import DIVERGED
from gift_peft.reports.saved_run import SavedRun, ratio

# Column of metrics.jsonl, its heading; the last two from a Booster evaluation where training logged none.
COLUMNS = {
    "val_gce": "GCE ↓",
    "val_tom_rmse": "ToM RMSE ↓",
    "val_other_rmse": "Other RMSE ↓",
    "booster_tom_rmse": "ToM RMSE ↓",
    "booster_other_rmse": "Other RMSE ↓",
}
COLLAPSED = "†"


def is_ablation(runs: Sequence[SavedRun]) -> bool:
    """Whether these are trained runs of one base on one dataset with different loss weights."""
    weights = {run.weights for run in runs}
    subjects = {(run.arguments.get("model_name_or_path"), run.arguments.get("dataset_name")) for run in runs}
    trained = all(run.weights and run.best_row() for run in runs)
    return len(runs) > 1 and trained and len(weights) == len(runs) and len(subjects) == 1


def ablation_table(runs: Sequence[SavedRun]) -> Table:
    """One line per run; the best value of each column is marked.

    A run has collapsed if its evaluation raised the collapse alarm, or if its Other RMSE is more than twice the base's
    at its minimum-GCE checkpoint. It is marked, and its values are not compared.

    Args:
        runs: those of `is_ablation`.
    """
    rows = [(run, run.best_row(), _values(run)) for run in runs]
    shown = [key for key in COLUMNS if any(values[key] is not None for _, _, values in rows)]
    fallen = [_collapsed(run, row) for run, row, _ in rows]
    best = {}
    for key in shown:
        competing = [values[key] for (_, _, values), out in zip(rows, fallen, strict=True) if not out]
        best[key] = min((value for value in competing if value is not None), default=None)
    lines: list[list[str | Cell] | None] = []
    for (run, row, values), out in zip(rows, fallen, strict=True):
        cells = [value_cell(values[key], True if not out and values[key] == best[key] else None) for key in shown]
        lines.append([f"{ratio(run)}{COLLAPSED if out else ''}", str(row["step"]), *cells])
    booster = sum(key.startswith("booster") for key in shown)
    spans = [("GIFT-I validation", len(shown) - booster), *([("Booster (mm)", booster)] if booster else [])]
    title = "Loss weights at the minimum-GCE checkpoint"
    return Table(title, ["λc:λd", "step"], [COLUMNS[key] for key in shown], lines, spans, _notes(runs, any(fallen)))


def _values(run: SavedRun) -> dict[str, float | None]:
    row = run.best_row() or {}
    values = {key: row.get(key) for key in COLUMNS}
    for report in run.evaluations.values():
        if report.dataset == "booster" and report.adapted:
            for region in ("tom", "other"):
                if values[f"booster_{region}_rmse"] is None:
                    values[f"booster_{region}_rmse"] = report.summary[region]["rmse"]
    return values


def _collapsed(run: SavedRun, row: dict) -> bool:
    # The alarm counts, too: after an affine fit the error of a flattened output is never above the reference's spread.
    if any(report.collapse and report.collapse["alarm"] for report in run.evaluations.values()):
        return True
    base, adapted = run.history[0].get("val_other_rmse"), row.get("val_other_rmse")
    return None not in (base, adapted) and adapted > DIVERGED * base


def _notes(runs: Sequence[SavedRun], collapsed: bool) -> list[str]:
    notes = [f"GIFT-I: the validation of training, in proxy units. Protocol {PROTOCOLS['native'].describe()}."]
    reports = [report for run in runs for report in run.evaluations.values()]
    proxies = [r for r in reports if r.reference == "proxy"]
    notes += dict.fromkeys(map(skipped_note, proxies))
    if not proxies:
        notes.append("Skipped images are counted by `gift-peft evaluate`; these runs have no such evaluation.")
    if any(run.best_row().get("booster_tom_rmse") is not None for run in runs):
        logged = replace(PROTOCOLS["gift"], resolution=0.25)
        notes.append(f"Booster: measured in training. Protocol {logged.describe()}.")
    else:
        boosters = [report for report in reports if report.dataset == "booster"]
        notes += dict.fromkeys(f"Booster: {line}" for r in boosters for line in (protocol_note(r), skipped_note(r)))
    if collapsed:
        notes.append(f"{COLLAPSED} collapsed (alarm, or Other RMSE over {DIVERGED:g} times the base's): not compared.")
    return notes
