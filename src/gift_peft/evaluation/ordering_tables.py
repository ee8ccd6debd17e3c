"""The tables of a benchmark of orderings: accuracies of base and adapted, and the layer dial."""

import math

from gift_peft.evaluation.orderings import OrderingReport
from gift_peft.evaluation.table_formats import Cell, Table, to_markdown, to_text, value_cell

TITLES = {"layereddepth": "LayeredDepth, first layer", "md3k": "MD-3k, layer preference"}
NAMES = {"sra1": "SRA(1), the glass", "sra2": "SRA(2), what is behind", "alpha": "alpha = SRA(2) - SRA(1)"}
DIAL_COLUMNS = {
    "layereddepth": ("pairs", "triplets", "quadruplets"),
    "md3k": ("sra1", "sra2", "alpha", "reverse_alpha"),
}
DIAL_NOTE = (
    "Adapter scale: 0 is the base, 1 the adapter; below 0 it is turned the other way, toward what lies behind. Only 0 "
    "and 1 were trained: for the others the table says what comes out."
)


def ordering_tables(report: OrderingReport) -> list[Table]:
    """Accuracy per subset, with the change where there are two models; then the dial, if it was turned."""
    columns = ["base", *(["adapted", "change"] if report.base else []), "questions"]
    rows: list[list[str | Cell] | None] = [
        [question_name(key), *_values(report, key), str(report.counts["questions"].get(key, ""))]
        for key in report.summary
    ]
    skipped = sum(report.counts["outside"].values())
    notes = [*report.notes, f"{report.counts['photos']} photos; {skipped} questions skipped, with a point outside."]
    tables = [Table(TITLES[report.dataset], ["accuracy"], columns, rows, notes=notes)]
    return [*tables, dial_table(report)] if report.dial else tables


def dial_table(report: OrderingReport) -> Table:
    """The accuracies at each adapter scale."""
    keys = [key for key in DIAL_COLUMNS[report.dataset] if key in report.summary]
    rows: list[list[str | Cell] | None] = [
        [f"{entry['scale']:+g}" if entry["scale"] else "0", *(value_cell(entry[key]) for key in keys)]
        for entry in report.dial
    ]
    title = f"Layer dial: {TITLES[report.dataset]}"
    return Table(title, ["adapter scale"], [key.replace("_", " ") for key in keys], rows, notes=[DIAL_NOTE])


def ordering_text(report: OrderingReport, color: bool = False) -> str:
    """The report as aligned plain text."""
    return "\n".join(to_text(table, color) for table in ordering_tables(report))


def ordering_markdown(report: OrderingReport) -> str:
    """The report as Markdown."""
    return "\n".join(to_markdown(table) for table in ordering_tables(report))


def question_name(key: str) -> str:
    """What a subset or a derived number is called."""
    subset, _, rest = key.partition("_")
    return f"{NAMES[rest]}, {subset} pairs" if rest in NAMES else NAMES.get(key, key)


def _values(report: OrderingReport, key: str) -> list[str | Cell]:
    """Base, and where there is one the adapted model with its change; no mark: a preference has no better side."""
    own = report.summary[key]
    if report.base is None:
        return [value_cell(own)]
    base = report.base[key]
    change = Cell("-")
    if base is not None and own is not None and not math.isnan(base) and not math.isnan(own):
        change = Cell(f"{own - base:+.4f}", (own - base,))
    return [value_cell(base), value_cell(own), change]
