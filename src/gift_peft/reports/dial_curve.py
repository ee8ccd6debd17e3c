"""LayeredDepth and MD-3k in a report: their tables, and the layer dial as a curve.

The dial says which layer a model reports when its adapter is turned from -1 (away from what it learned) over 0 (the
base) to 1.
"""

import io
from collections.abc import Sequence
from pathlib import Path

from gift_peft.evaluation.ordering_tables import DIAL_COLUMNS, TITLES, question_name
from gift_peft.evaluation.orderings import OrderingReport
from gift_peft.files import write_whole
from gift_peft.reports.curves import COLORS, DASHES, import_pyplot


def draw_dial(report: OrderingReport, paths: Sequence[Path]) -> None:
    """The accuracies over the adapter's scale, the base at 0; `paths` end in .png or .pdf.

    Raises ImportError with the line that installs matplotlib where it is missing, ValueError for a report that turned
    no dial.
    """
    if not report.dial:
        raise ValueError("the evaluation turned no dial: gift-peft evaluate --dial")
    pyplot = import_pyplot()
    entries = sorted(report.dial, key=lambda entry: entry["scale"])
    scales = [entry["scale"] for entry in entries]
    figure, axis = pyplot.subplots(figsize=(5.6, 3.4), layout="constrained")
    try:
        for number, key in enumerate(key for key in DIAL_COLUMNS[report.dataset] if key in report.summary):
            values = [float("nan") if entry[key] is None else entry[key] for entry in entries]
            color, dashes = COLORS[number % len(COLORS)], DASHES[number % len(DASHES)]
            axis.plot(
                scales, values, color=color, linestyle=dashes, marker="o", markersize=3, label=question_name(key)
            )
        axis.axvline(0, color="0.6", linewidth=0.8)
        axis.set(xlabel="adapter scale (0: the base, 1: the adapter)", ylabel="share of questions")
        axis.set_title(f"Layer dial: {TITLES[report.dataset]}", fontsize=10)
        axis.legend(fontsize=8, frameon=False)
        axis.spines[["top", "right"]].set_visible(False)
        for path in paths:
            stream = io.BytesIO()
            metadata = {"CreationDate": None} if path.suffix == ".pdf" else None  # the same report, the same bytes
            figure.savefig(stream, format=path.suffix[1:], dpi=150, metadata=metadata)
            write_whole(path, stream.getvalue())
    finally:
        pyplot.close(figure)
