"""What stands in the tables: base, adapted, relative change with its sign, and the consensus that training pulls to.

One report gives the table of `gift-peft evaluate`; several give the paper's Tables 1 and 2 (`comparison_table`) and 3
(`ablation_table`). The protocol and the number of skipped images stand under each: without them numbers say little.
"""

import math
from collections.abc import Sequence

import numpy as np

from gift_peft.evaluation.metrics import METRICS
from gift_peft.evaluation.results import COLLAPSE_RANGE, REGIONS, Report, mean
from gift_peft.evaluation.statistics import GroupBootstrap, mean_interval, median_of, value_of
from gift_peft.evaluation.table_formats import (
    Cell,
    Table,
    change_cell,
    estimate_cell,
    number,
    to_markdown,
    to_text,
    value_cell,
)

REGION_NAMES = {"tom": "ToM", "other": "Other", "all": "All"}
METRIC_NAMES = {"mae": "MAE ↓", "abs_rel": "AbsRel ↓", "rmse": "RMSE ↓", "delta1": "δ1 % ↑"}
NO_TEACHING = (
    "The consensus (group median of the base inside the target) is no better than the base itself: "
    "these groups cannot teach accuracy."
)
INTERVALS = "In brackets: 95 % bootstrap intervals over groups (2,000 draws of whole groups, percentiles)."
SAFETY = (
    "False free space: target pixels reported more than 10 % and 200 mm behind the surface. Flicker: standard "
    "deviation inside the target over a group, in mm."
)
BACKBONE_UNITS = "Proxies are each backbone's own: compare a backbone with its adapted form only."


def relative_change(base: float | None, adapted: float | None) -> float:
    """(adapted - base) / |base| in percent; NaN where either is missing or the base is 0."""
    if base is None or adapted is None or not math.isfinite(base) or not math.isfinite(adapted) or base == 0:
        return math.nan
    return 100 * (adapted - base) / abs(base)


def improved(metric: str, change: float) -> bool:
    """Whether a change of this metric is for the better."""
    return change > 0 if metric.startswith("delta") else change < 0


def metric_heading(metric: str) -> str:
    """What a metric is called in a table."""
    return METRIC_NAMES.get(metric, f"δ{metric.removeprefix('delta_')} % ↑")


def consensus_teaches(report: Report) -> bool | None:
    """Whether the consensus beats the base inside the target, by RMSE; None where that is not known.

    It is not where no group has two observations of a target pixel: the median of one is that one.
    """
    if not report.consensus or not report.base or not report.gce["num_groups"]:
        return None
    base, consensus = report.base["tom"]["rmse"], report.consensus["tom"]["rmse"]
    if base is None or consensus is None or math.isnan(base) or math.isnan(consensus):
        return None
    return consensus < base


# ---- one report: `gift-peft evaluate` ----


def report_tables(report: Report) -> list[Table]:
    """Metrics per region (in two tables where the protocol asks for more deltas), and what has one number per model
    (GCE; RMSE per surface kind), with the notes."""
    more = [metric for metric in report.summary["all"] if metric not in METRICS]
    tables = [_region_table(_title(report), report, METRICS)]
    tables += [_region_table("", report, more)] if more else []
    return [*tables, Table("", [""], ["base", "adapted", "change", "consensus"], _pairs(report), notes=notes(report))]


def text_table(report: Report, color: bool = False) -> str:
    """The report as aligned plain text of at most 80 columns; improvements carry a `*` (and green if `color`)."""
    return "\n".join(to_text(table, color) for table in report_tables(report))


def markdown_table(report: Report) -> str:
    """The report as Markdown; improvements are bold."""
    return "\n".join(to_markdown(table) for table in report_tables(report))


def notes(report: Report) -> list[str]:
    """What stands under every table of a report: collapse check, consensus, protocol, skipped images."""
    lines = []
    if report.collapse:
        state = "COLLAPSE ALARM" if report.collapse["alarm"] else "no collapse alarm"
        ratios = [number(report.collapse[name]) for name in ("target_mean_ratio", "spread_ratio")]
        lines.append(
            f"Adapted/base: target mean x{ratios[0]}, spread x{ratios[1]}: {state} "
            f"(outside {COLLAPSE_RANGE[0]:g}..{COLLAPSE_RANGE[1]:g})."
        )
    if consensus_teaches(report) is False:
        lines.append(NO_TEACHING)
    if report.unit == "mm":
        lines.append(f"{report.gce_name} is in the model's own units, not in mm.")
    if report.safety:
        lines.append(SAFETY)
    return [*lines, protocol_note(report), skipped_note(report)]


def protocol_note(report: Report) -> str:
    """The protocol's line, with what else the numbers depend on."""
    about = report.about
    parts = [f"Protocol {report.protocol['description']}"]
    parts += [f"occlusion {about['occlusion']}"] if "occlusion" in about else []
    parts += [f"ToM is classes {', '.join(map(str, about['tom_classes']))}"] if about.get("tom_classes") else []
    parts += ["not the complete official set"] if about.get("official") is False else []
    return ", ".join(parts) + "."


def skipped_note(report: Report) -> str:
    """How many images are not in the means, and why."""
    counts, gce = report.counts, report.gce
    reasons = ", ".join(f"{n} {reason}" for reason, n in counts["reasons"].items())
    other = f", {counts['without_other']} with nothing else" if counts["without_other"] else ""
    return (
        f"Skipped: {counts['skipped']} of {counted(counts['images'], 'image')}{f' ({reasons})' if reasons else ''}; "
        f"{counts['without_tom']} without known target pixels{other}; {report.gce_name} over "
        f"{counted(gce['num_groups'], report.group_noun)}, {gce['num_skipped']} without a pair."
    )


def _region_table(title: str, report: Report, metrics: Sequence[str]) -> Table:
    rows: list[list[str | Cell] | None] = []
    for region in REGIONS:
        lines = _block(report, region, metrics)
        rows += [[REGION_NAMES[region] if i == 0 else "", label, *cells] for i, (label, cells) in enumerate(lines)]
        rows.append(None)
    return Table(title, ["region", ""], [metric_heading(metric) for metric in metrics], rows[:-1])


def _block(report: Report, region: str, metrics: Sequence[str]) -> list[tuple[str, list[Cell]]]:
    """The lines of one region."""

    def line(label: str, summary: dict) -> tuple[str, list[Cell]]:
        return label, [value_cell(summary[region][metric]) for metric in metrics]

    lines = [line("base", report.base)] if report.base else []
    if report.adapted:
        lines.append(line("adapted", report.summary))
    if report.base and report.adapted:
        lines.append(("change", [_change(report.base, report.summary, region, metric) for metric in metrics]))
    if region == "tom" and report.consensus:
        lines.append(line("consensus", report.consensus))
    return lines


def _change(base: dict, adapted: dict, region: str, metric: str) -> Cell:
    change = relative_change(base[region][metric], adapted[region][metric])
    return change_cell(change, improved(metric, change))


def _pair(label: str, base: float | None, adapted: float | None, consensus: float | None = None) -> list[str | Cell]:
    return [label, *_compared([base, adapted]), value_cell(consensus)]


def _pairs(report: Report) -> list[list[str | Cell] | None]:
    """Lines of what has one number per model."""
    gce, name = report.gce, report.gce_name
    pairs: list[list[str | Cell] | None] = [_pair(f"{name} ↓", gce["base"], gce["adapted"])]
    pairs.append(_pair(f"{name} normalised ↓", gce["base_normalized"], gce["adapted_normalized"]))
    for label, name in (("False free space % ↓", "false_free_space"), ("Flicker mm ↓", "flicker")):
        if report.safety:
            pairs.append(_pair(label, *(report.safety.get(model, {}).get(name) for model in ("base", "adapted"))))
    for surface, entry in report.by_surface.items():
        models = (entry["base"], entry["summary"] if report.adapted else None, entry["consensus"])
        values = [model and model["tom"]["rmse"] for model in models]
        pairs.append(_pair(f"ToM RMSE, {surface} ({entry['num_images']}) ↓", *values))
    return pairs


# ---- several reports: the paper's Tables 1 and 2 ----


def comparison_table(reports: Sequence[tuple[str, Report]], regions: Sequence[str] = ("tom", "all")) -> Table:
    """Bases and other unadapted models, then every adapted one with its relative change; paper, Tables 1 and 2.

    Args:
        reports: (name, report) of one dataset under one protocol.
        regions: those of the columns, four metrics each, and the one by which the protocol's benchmark ranks.
    """
    ranked = reports[0][1].protocol.get("ranked_by")  # (evaluations of 0.1.0 do not say)
    metrics = [*METRICS, *([ranked] if ranked and ranked not in METRICS else [])]
    columns = [(region, metric) for region in regions for metric in metrics]
    bases: dict[str, list[str | Cell]] = {}
    adapted: list[list[str | Cell] | None] = []
    for name, report in reports:
        base = report.base or (None if report.adapted else report.summary)
        if base:  # (one line for a base that several adapters share, if it has the same numbers)
            line = [name, *(value_cell(base[region][metric]) for region, metric in columns)]
            shown = "\0".join(map(str, line))
            bases.setdefault(shown, line)
        if report.adapted:
            adapted.append([f"{name} + GIFT", *(value_cell(report.summary[r][m]) for r, m in columns)])
            if report.base:
                adapted.append(["", *(_change(report.base, report.summary, r, m) for r, m in columns)])
    rows = [*bases.values(), *([None] if bases and adapted else []), *adapted]
    lines = list(dict.fromkeys(protocol_note(report) for _, report in reports))
    several = len(reports) > 1
    lines += [f"{name}: {skipped_note(report)}" if several else skipped_note(report) for name, report in reports]
    if several and any(report.reference == "proxy" for _, report in reports):
        lines.append(BACKBONE_UNITS)
    spans = [(REGION_NAMES[region], len(metrics)) for region in regions]
    return Table(
        _title(reports[0][1], with_counts=not several),
        ["model"],
        [metric_heading(m) for _, m in columns],
        rows,
        spans,
        lines,
    )


def uncertainty_table(report: Report) -> Table:
    """Means with 95 % intervals, and medians, of every region and metric; then GCE, a mean over groups."""
    models = _models(report)
    summaries = {"base": report.base, "adapted": report.summary}
    bootstrap = GroupBootstrap(report.rows)
    rows: list[list[str | Cell] | None] = []
    for region in REGIONS:
        for metric in report.summary[region]:
            cells = [
                estimate_cell(value_cell(summaries[model][region][metric]), bootstrap.interval(model, region, metric))
                for model in models
            ]
            if report.base and len(models) == 2:
                change = _change(report.base, report.summary, region, metric)
                cells.append(estimate_cell(change, bootstrap.change_interval(region, metric)))
            cells += [value_cell(median_of(report.rows, model, region, metric)) for model in models]
            rows.append([f"{REGION_NAMES[region]} {metric_heading(metric)}", *cells])
        rows.append(None)
    rows.append(_gce_line(report, models))
    change = ["base to adapted"] if len(models) == 2 else []
    spans = [("image mean", len(models)), *(("change", 1) for _ in change), ("image median", len(models))]
    title = f"{_title(report)}: intervals and medians"
    return Table(title, ["metric"], [*models, *change, *models], rows, spans, [INTERVALS, *notes(report)])


def group_table(report: Report) -> Table:
    """One line per group: images, RMSE inside and outside the target before and after, GCE before and after."""
    models = _models(report)
    gce = {group["group_id"]: group for group in report.groups}
    rows: list[list[str | Cell] | None] = []
    for group_id in dict.fromkeys(row["group_id"] for row in report.rows):
        own = [row for row in report.rows if row["group_id"] == group_id]
        line: list[str | Cell] = [group_id, own[0].get("surface") or "", str(len(own))]
        for region in ("tom", "other"):
            means = [mean([value_of(row, model, region, "rmse") for row in own]) for model in models]
            line += _compared(means)
        entry = gce.get(group_id, {"counted": False})
        line += _compared([entry[f"gce_{model}"] if entry["counted"] else None for model in models])
        rows.append(line)
    columns = [*models, *(["change"] if len(models) == 2 else [])]
    spans = [(title, len(columns)) for title in ("ToM RMSE ↓", "Other RMSE ↓", f"{report.gce_name} ↓")]
    noun = report.group_noun
    return Table(f"{_title(report)}, per {noun}", [noun, "surface", "images"], columns * 3, rows, spans, notes(report))


def _compared(values: Sequence[float | None]) -> list[Cell]:
    """The models' values of an error, and where there are two its change."""
    cells = [value_cell(value) for value in values]
    if len(values) == 2:
        change = relative_change(*values)
        cells.append(change_cell(change, change < 0))
    return cells


def _gce_line(report: Report, models: list[str]) -> list[str | Cell]:
    counted = [group for group in report.groups if group["counted"]]
    values = {model: [group[f"gce_{model}"] for group in counted] for model in models}
    cells = _compared([report.gce[model] for model in models])
    for index, model in enumerate(models):
        cells[index] = estimate_cell(cells[index], mean_interval(values[model]))
    medians = [value_cell(float(np.median(values[model])) if counted else None) for model in models]
    return [f"{report.gce_name} ↓", *cells, *medians]


def _models(report: Report) -> list[str]:
    """Those of base and adapted that the evaluation ran."""
    return [model for model in ("base", "adapted") if report.rows and model in report.rows[0]]


# ---- words ----


def _title(report: Report, with_counts: bool = True) -> str:
    if report.dataset == "booster":
        name = f"Booster {report.about.get('subset') or ''}".strip()
    else:
        against = "the treated-reference proxy" if report.reference == "proxy" else "true depth"
        split = report.about.get("split")
        name = f"GIFT-I{f' {split}' if split else ''} against {against}"
    counts = report.counts
    size = f": {counted(counts['groups'], report.group_noun)}, {counted(counts['images'], 'image')}"
    return f"{name}{size if with_counts else ''} ({report.unit})"


def counted(n: int, noun: str) -> str:
    """ "1 group", "2 groups"."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
