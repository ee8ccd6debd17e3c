"""A run's course from metrics.jsonl: the paper's Figures 5 (everything falls together) and 6 (what Other costs).

Every curve is divided by its value at step 0, the base's, and smoothed by a centred mean over epochs; the unsmoothed
values stay visible behind it. Colours are Okabe and Ito's, and no two curves share colour and dashes.
"""

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gift_peft.files import write_whole

# Figure 5; of Figure 6 whichever a run has.
DYNAMICS = {
    "train_gce": "disagreement in the target (GCE), training groups",
    "val_gce": "disagreement in the target (GCE), validation groups",
    "booster_tom_rmse": "error in the target (ToM RMSE), Booster",
}
RETENTION = {
    "val_other_rmse": "Other RMSE, validation groups",
    "booster_other_rmse": "Other RMSE, Booster",
}
YLABEL = "times the base's value"
HINT = "1 is the base before training; lower is better. Thick: smoothed, thin: as measured."
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
DASHES = ("-", "--", "-.", ":")
DIVERGED = 2.0  # times the base: next to such a run the others look flat, so they get a second plot

Curve = tuple[str, list[float], list[float]]


def normalized(history: Sequence[dict], key: str) -> tuple[list[float], list[float]]:
    """(epochs, values over the first one) of a column of metrics.jsonl; empty where it was not measured.

    Rows without a value are left out. Raises ValueError if the first value is 0: nothing can be relative to it.
    """
    rows = [(row["epoch"], row[key]) for row in history if row.get(key) is not None]
    if not rows:
        return [], []
    first = rows[0][1]
    if first == 0:
        raise ValueError(f"{key} is 0 at step {history[0]['step']}: the curve cannot be relative to that")
    return [float(epoch) for epoch, _ in rows], [value / first for _, value in rows]


def smooth(values: Sequence[float], width: int) -> list[float]:
    """Centred mean over `width` values (odd), narrower towards both ends so that the first value stays itself."""
    half = width // 2
    means = []
    for index in range(len(values)):
        reach = min(half, index, len(values) - 1 - index)
        window = values[index - reach : index + reach + 1]
        means.append(math.fsum(window) / len(window))
    return means


def draw_dynamics(
    runs: Sequence[tuple[str, list[dict]]], paths: Sequence[Path], width: int | None = None
) -> list[str]:
    """Figure 5, a plot per run: train GCE, validation GCE and, if it was logged, Booster ToM RMSE.

    Args:
        runs: (name, rows of metrics.jsonl).
        paths: files to write, .png or .pdf.
        width: values in the smoothing window (odd); default a tenth of the curve, at least 3.

    Returns:
        `list[str]`: names of the curves drawn; nothing is written if there are none.
    """
    plots = [(name, _curves(history, DYNAMICS)) for name, history in runs]
    return _draw([plot for plot in plots if plot[1]], "What training changes inside the target", paths, width)


def draw_retention(
    runs: Sequence[tuple[str, list[dict]]], paths: Sequence[Path], width: int | None = None
) -> list[str]:
    """Figure 6, a plot per dataset: the error outside the target of all runs; if some diverge, a second without them.

    Arguments and result as in `draw_dynamics`.
    """
    plots = []
    for key, title in RETENTION.items():
        curves = [(name, *normalized(history, key)) for name, history in runs]
        curves = [curve for curve in curves if curve[1]]
        calm = [curve for curve in curves if max(curve[2]) <= DIVERGED]
        if curves:
            plots.append((title, curves))
        if 0 < len(calm) < len(curves):
            plots.append((f"{title}, without diverged runs", calm))
    return _draw(plots, "What training costs outside the target", paths, width)


def _curves(history: list[dict], keys: dict[str, str]) -> list[Curve]:
    curves = [(title, *normalized(history, key)) for key, title in keys.items()]
    return [curve for curve in curves if curve[1]]


def _draw(plots: list[tuple[str, list[Curve]]], title: str, paths: Sequence[Path], width: int | None) -> list[str]:
    if not plots:
        return []
    names = list(dict.fromkeys(name for _, curves in plots for name, _, _ in curves))
    pyplot = _import_pyplot()
    figure, axes = pyplot.subplots(
        1, len(plots), figsize=(max(5.6, 4.6 * len(plots)), 4.2), squeeze=False, layout="constrained"
    )
    try:
        figure.suptitle(f"{title}\n{HINT}", fontsize=9)
        for axis, (subtitle, curves) in zip(axes[0], plots, strict=True):
            for name, epochs, values in curves:
                number = names.index(name)
                style = {"color": COLORS[number % len(COLORS)], "linestyle": DASHES[number % len(DASHES)]}
                # a line between few points says little, so the points are marked
                marker = "o" if len(values) < 10 else None
                axis.plot(epochs, values, color=style["color"], alpha=0.25, linewidth=1, marker=marker)
                axis.plot(
                    epochs, smooth(values, width or max(3, len(values) // 10 | 1)), label=name, linewidth=1.8, **style
                )
            axis.axhline(1, color="0.5", linewidth=0.8, label="the base")
            if max(max(values) for _, _, values in curves) > 10:
                axis.set_yscale("log")
            axis.xaxis.get_major_locator().set_params(integer=True)
            axis.set(title=subtitle, xlabel="epoch", ylabel=YLABEL)
            axis.title.set_fontsize(10)
            # Below the plot, where it hides no curve.
            axis.legend(fontsize=8, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.16))
            axis.spines[["top", "right"]].set_visible(False)
        for path in paths:
            stream = io.BytesIO()
            metadata = {"CreationDate": None} if path.suffix == ".pdf" else None  # the same runs give the same bytes
            figure.savefig(stream, format=path.suffix[1:], dpi=150, metadata=metadata)
            write_whole(path, stream.getvalue())
    finally:
        pyplot.close(figure)
    return names


def _import_pyplot() -> Any:
    """matplotlib.pyplot without a display; ImportError with the line that installs it."""
    try:
        import matplotlib
    except ImportError:
        raise ImportError("this figure needs matplotlib: pip install gift-peft[plots]") from None
    matplotlib.use("agg")
    from matplotlib import pyplot

    return pyplot
