"""What the demo shows of its runs, side by side: a table, one per kind of target, a picture, the details of each.

A run is called by what it was pulled to; its reports are `{"proxy": ..., "depth": ...}` of one set of groups.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict

from gift_peft.evaluation.results import Report, mean
from gift_peft.evaluation.table_formats import Cell, Table, change_cell, to_markdown, to_text, value_cell
from gift_peft.evaluation.tables import improved, markdown_table, notes, relative_change
from gift_peft.models.loading import DepthModel
from gift_peft.reports.figures import GridRow, panel_row
from gift_peft.reports.model_card import run_length
from gift_peft.reports.panels import group_panels
from gift_peft.rules import GroupPictures
from gift_peft.training.arguments import GiftTrainingArguments

Runs = Mapping[str, Mapping[str, Report]]

KINDS = {"mirror": "mirror", "pane": "glass pane", "solid": "glass object"}


def summary(runs: Runs, color: bool) -> str:
    """What a terminal shows: the table and its notes, which an alarm is part of."""
    return f"\n{to_text(_table(runs), color)}"


def markdown(runs: Runs, arguments: Mapping[str, GiftTrainingArguments]) -> str:
    """`report.md`: how each run was trained, all of them in one table, and each in full."""
    trained = "\n".join(f"- {name}: {_settings(args)}" for name, args in arguments.items())
    details = "\n".join(
        f"## {name.capitalize()}, in full\n\n{markdown_table(run['depth'])}\n{markdown_table(run['proxy'])}"
        for name, run in runs.items()
    )
    return f"""# GIFT on the embedded groups

Rendered scenes, and a base of two million weights that never saw a mirror or glass. These are results on rendered
scenes; they show the method at work, not what a large model gains on photographs.

{trained}

![RGB, true depth, the base and each adapter for a mirror, a pane and a glass object](before_after.png)

For each kind of target the picture shows the observation on which the base errs most;
[validation.html](validation.html) shows every validation group.

{to_markdown(_table(runs))}
ToM is the target (mirror or glass), Other the rest. Errors against true depth are in mm; the proxy is the base's own
prediction on the treated reference, in the model's units, and so are errors against it and GCE, the disagreement of a
group's predictions inside the target.

{details}"""


def panels(groups: Sequence[GroupPictures], runs: Runs, models: Mapping[str, DepthModel]) -> list[GridRow]:
    """For each kind of target the observation on which the base errs most inside it: the worst hallucination."""
    by_name = {group.group_id: group for group in groups}
    report = next(iter(runs.values()))["depth"]
    rows = []
    for kind, label in KINDS.items():
        worst = max(_scored(report, kind), key=lambda row: row["base"]["tom"]["rmse"])
        group = by_name[worst["group_id"]]
        rows.append(panel_row(*(group_panels(group, {worst["image"]: label}, model)[0] for model in models.values())))
    return rows


def _scored(report: Report, kind: str) -> list[dict]:
    """The rows of one kind of target that have metrics."""
    return [row for row in report.rows if row["group_id"].startswith(kind) and not row["skipped"]]


def _settings(args: GiftTrainingArguments) -> str:
    text = f"{run_length(asdict(args))}, learning rate {args.learning_rate:g} ({args.lr_scheduler_type}), "
    text += f"lambda_c {args.lambda_c:g}, lambda_d {args.lambda_d:g}, seed {args.seed}"
    return f"{text}, {args.fills} fills" if args.target == "surface" else text


def _table(runs: Runs) -> Table:
    """One column per run, with its change against the base."""
    first = next(iter(runs.values()))
    base = first["proxy"].gce["base"]
    agreement = [_changed(base, run["proxy"].gce["adapted"]) for run in runs.values()]
    rows: list[list[str | Cell] | None] = [["GCE ↓", value_cell(base), *agreement]]
    for reference, against in (("depth", "true depth"), ("proxy", "the proxy")):
        rows.append(None)
        rows.append(_line(f"ToM RMSE, {against} ↓", runs, reference, "tom"))
        rows += [_line(f"  {label}", runs, reference, "tom", kind) for kind, label in KINDS.items()]
        rows.append(_line(f"Other RMSE, {against} ↓", runs, reference, "other"))
    alarms = [
        f"COLLAPSE ALARM: {name} (see report.md)" for name, run in runs.items() if run["proxy"].collapse["alarm"]
    ]
    return Table("", [""], ["base", *runs], rows, notes=[*alarms, notes(first["depth"])[-1]])


def _line(label: str, runs: Runs, reference: str, region: str, kind: str = "") -> list[str | Cell]:
    """Mean RMSE over the images of all kinds of target, or of one."""
    found = []
    for run in runs.values():
        rows = _scored(run[reference], kind)
        found.append([mean([row[model][region]["rmse"] for row in rows]) for model in ("base", "adapted")])
    return [label, value_cell(found[0][0]), *(_changed(*pair) for pair in found)]


def _changed(base: float, adapted: float) -> Cell:
    value, change = value_cell(adapted), relative_change(base, adapted)
    part = change_cell(change, improved("rmse", change))
    return Cell(f"{value.text} ({part.text})", value.values + part.values, part.good)
