"""The tables and the picture: base, adapted, relative change with its sign, and the consensus that training pulls to.

Laid out like the paper's Tables 1 and 2, one block per region; below stand GCE, the collapse check, the protocol and
the number of skipped images, without which the numbers above say little (`gift_peft.evaluation.protocols`).
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gift_peft.evaluation.alignment import align, known
from gift_peft.evaluation.colormap import color_range, colorize
from gift_peft.evaluation.metrics import METRICS, depth_metrics
from gift_peft.evaluation.protocols import get_protocol
from gift_peft.evaluation.results import COLLAPSE_RANGE, REGIONS, GiftIReport

REGION_NAMES = {"tom": "ToM", "other": "Other", "all": "All"}
HIGHER_IS_BETTER = {"delta1"}
GREEN, RED, BOLD, RESET = "\x1b[32m", "\x1b[31m", "\x1b[1m", "\x1b[0m"
NO_TEACHING = (
    "The consensus (group median of the base inside the target) is no better than the base itself: "
    "these groups cannot teach accuracy."
)


def relative_change(base: float | None, adapted: float | None) -> float:
    """(adapted - base) / |base| in percent; NaN where either is missing or the base is 0."""
    if base is None or adapted is None or not math.isfinite(base) or not math.isfinite(adapted) or base == 0:
        return math.nan
    return 100 * (adapted - base) / abs(base)


def improved(metric: str, change: float) -> bool:
    """Whether a change of this metric is for the better."""
    return change > 0 if metric in HIGHER_IS_BETTER else change < 0


def consensus_teaches(report: GiftIReport) -> bool | None:
    """Whether the consensus beats the base inside the target, by RMSE; None where that is not known.

    It is not where no group has two observations of a target pixel: the median of one is that one.
    """
    if not report.consensus or not report.base or not report.gce["num_groups"]:
        return None
    base, consensus = report.base["tom"]["rmse"], report.consensus["tom"]["rmse"]
    if base is None or consensus is None or math.isnan(base) or math.isnan(consensus):
        return None
    return consensus < base


@dataclass
class Panel:
    """One row of `before_after`: a picture, its reference and two predictions, all arrays (H,W) of one size.

    Args:
        label (`str`): what stands above the row.
        image (`PIL.Image.Image`): the RGB picture, any size of the same shape.
        reference (`np.ndarray`): mm under `gift`; 0, negative or NaN where unknown (drawn grey).
        base, adapted (`np.ndarray`): predictions in native units.
        target (`np.ndarray`): bool, outlined in every picture.
        kind (`str`): what the predictions are, `depth` or `inverse_depth`.
        protocol (`str`): how they are aligned to the reference.
    """

    label: str
    image: Image.Image
    reference: np.ndarray
    base: np.ndarray
    adapted: np.ndarray
    target: np.ndarray
    kind: str
    protocol: str = "gift"


def text_table(report: GiftIReport, color: bool = False) -> str:
    """The report as aligned plain text of at most 80 columns; improvements carry a `*` (and green if `color`)."""
    lines = [_paint(_title(report), BOLD, color), ""]
    lines.append(_text_line("", ["MAE", "AbsRel", "RMSE", "delta1 %"], color, 18))
    for region in REGIONS:
        for index, (label, cells) in enumerate(_block(report, region)):
            name = REGION_NAMES[region] if index == 0 else ""
            lines.append(_text_line(f"{name:6}{label}", cells, color, 18))
        lines.append("")
    lines.append(_text_line("", ["base", "adapted", "change", "consensus"], color, 26))
    lines += [_text_line(label, cells, color, 26) for label, cells in _pairs(report)]
    notes = [line for note in _notes(report) for line in textwrap.wrap(note, 80)]
    return "\n".join([*lines, "", *notes]) + "\n"


def markdown_table(report: GiftIReport) -> str:
    """The report as Markdown; improvements are bold."""
    lines = [f"**{_title(report)}**", ""]
    lines += ["| region | | MAE ↓ | AbsRel ↓ | RMSE ↓ | δ1 (%) ↑ |", "|---|---|---:|---:|---:|---:|"]
    for region in REGIONS:
        for index, (label, cells) in enumerate(_block(report, region)):
            name = REGION_NAMES[region] if index == 0 else ""
            lines.append(f"| {name} | {label} | " + " | ".join(_markdown_cell(cell) for cell in cells) + " |")
    lines += ["", "| | base | adapted | change | consensus |", "|---|---:|---:|---:|---:|"]
    lines += [f"| {label} ↓ | " + " | ".join(map(_markdown_cell, cells)) + " |" for label, cells in _pairs(report)]
    return "\n".join([*lines, "", *(f"{note}  " for note in _notes(report))]) + "\n"


def number(value: float | None) -> str:
    """Five significant digits without an exponent, `-` for what is missing."""
    if value is None or math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf"
    digits = 0 if value == 0 else math.floor(math.log10(abs(value)))
    return f"{value:.{min(max(4 - digits, 0), 6)}f}"


def _title(report: GiftIReport) -> str:
    against = "the treated-reference proxy" if report.reference == "proxy" else "true depth"
    counts = report.counts
    split = report.about.get("split")
    return (
        f"GIFT-I{f' {split}' if split else ''} against {against}: "
        f"{_count(counts['groups'], 'group')}, {_count(counts['images'], 'image')} ({report.unit})"
    )


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _block(report: GiftIReport, region: str) -> list[tuple[str, list]]:
    """The lines of one region: (label, cells); a cell is a number or, for changes, (percent, improved)."""
    lines = []
    if report.base:
        lines.append(("base", [report.base[region][metric] for metric in METRICS]))
    if report.adapted:
        lines.append(("adapted", [report.summary[region][metric] for metric in METRICS]))
    if report.base and report.adapted:
        lines.append(("change", [_change(metric, report.base[region], report.summary[region]) for metric in METRICS]))
    if report.consensus and region == "tom":
        lines.append(("consensus", [report.consensus[region][metric] for metric in METRICS]))
    return lines


def _change(metric: str, base: dict, adapted: dict) -> tuple[float, bool]:
    change = relative_change(base[metric], adapted[metric])
    return change, improved(metric, change)


def _pairs(report: GiftIReport) -> list[tuple[str, list]]:
    """(label, [base, adapted, change, consensus]) of what has one number per model."""
    pairs = []
    for label, suffix in (("GCE", ""), ("GCE normalised", "_normalized")):
        base, adapted = report.gce[f"base{suffix}"], report.gce[f"adapted{suffix}"]
        change = relative_change(base, adapted)
        pairs.append((label, [base, adapted, (change, change < 0), None]))
    for surface, entry in report.by_surface.items():
        models = (entry["base"], entry["summary"] if report.adapted else None, entry["consensus"])
        base, adapted, consensus = (model and model["tom"]["rmse"] for model in models)
        change = relative_change(base, adapted)
        pairs.append(
            (f"ToM RMSE, {surface} ({entry['num_images']})", [base, adapted, (change, change < 0), consensus])
        )
    return pairs


def _notes(report: GiftIReport) -> list[str]:
    notes = []
    if report.collapse:
        state = "COLLAPSE ALARM" if report.collapse["alarm"] else "no collapse alarm"
        ratios = [number(report.collapse[name]) for name in ("target_mean_ratio", "spread_ratio")]
        notes.append(
            f"Adapted/base: target mean x{ratios[0]}, spread x{ratios[1]}: {state} "
            f"(outside {COLLAPSE_RANGE[0]:g}..{COLLAPSE_RANGE[1]:g})."
        )
    if consensus_teaches(report) is False:
        notes.append(NO_TEACHING)
    counts, gce = report.counts, report.gce
    reasons = ", ".join(f"{n} {reason}" for reason, n in counts["reasons"].items())
    other = f", {counts['without_other']} with nothing else" if counts["without_other"] else ""
    notes.append(f"Protocol {report.protocol['description']}.")
    notes.append(
        f"Skipped: {counts['skipped']} of {_count(counts['images'], 'image')}{f' ({reasons})' if reasons else ''}; "
        f"{counts['without_tom']} without known target pixels{other}; GCE over {_count(gce['num_groups'], 'group')}, "
        f"{gce['num_skipped']} without a pair."
    )
    return notes


def _text_line(label: str, cells: list, color: bool, indent: int) -> str:
    return (f"{label:{indent}}" + "".join(_text_cell(cell, color) for cell in cells)).rstrip()


def _text_cell(cell, color: bool) -> str:
    """13 columns, the last of them for the mark of an improvement."""
    if isinstance(cell, str):
        return f"{cell:>12} "
    if not isinstance(cell, tuple) or math.isnan(cell[0]):
        return f"{'-' if isinstance(cell, tuple) else number(cell):>12} "
    change, better = cell
    text = f"{change:+.1f} %"
    padding = " " * (12 - len(text))
    return padding + _paint(text, GREEN if better else RED, color and change != 0) + ("*" if better else " ")


def _markdown_cell(cell) -> str:
    if not isinstance(cell, tuple):
        return number(cell)
    change, better = cell
    if math.isnan(change):
        return "-"
    return f"**{change:+.1f} %**" if better else f"{change:+.1f} %"


def _paint(text: str, code: str, color: bool) -> str:
    return f"{code}{text}{RESET}" if color else text


# ---- the picture ----

TILE_WIDTH, GAP, HEADER, CAPTION = 360, 8, 34, 30


def before_after(
    rows: Sequence[Panel], path: str | Path, columns: Sequence[str] = ("RGB", "true depth", "base", "GIFT")
) -> Path:
    """Draws one row per panel: picture, reference, base, adapted, aligned and in one colour range; near is bright.

    The caption gives the RMSE inside the target before and after, and the range of the colours.

    Raises:
        ValueError: no rows, or a panel whose arrays differ in size.
    """
    if not rows:
        raise ValueError("before_after needs at least one panel")
    strips = [_draw_row(panel) for panel in rows]
    width = strips[0].width
    canvas = Image.new("RGB", (width, HEADER + sum(strip.height for strip in strips)), "white")
    draw = ImageDraw.Draw(canvas)
    for index, title in enumerate(columns):
        center = GAP + index * (TILE_WIDTH + GAP) + TILE_WIDTH // 2
        draw.text((center, HEADER // 2), title, fill="black", font=ImageFont.load_default(size=22), anchor="mm")
    top = HEADER
    for strip in strips:
        canvas.paste(strip, (0, top))
        top += strip.height
    canvas.save(path)
    return Path(path)


def _draw_row(panel: Panel) -> Image.Image:
    everywhere = np.ones(panel.reference.shape, bool)
    aligned = [
        align(prediction, panel.reference, everywhere, panel.protocol, panel.kind).aligned
        for prediction in (panel.base, panel.adapted)
    ]
    reference = np.where(known(panel.reference), panel.reference, np.nan)
    low, high = color_range(reference, *aligned)
    in_depth = get_protocol(panel.protocol).space != "native"
    maps = [colorize(depth, low, high, "depth" if in_depth else panel.kind) for depth in (reference, *aligned)]
    height = round(TILE_WIDTH * panel.reference.shape[0] / panel.reference.shape[1])
    strip = Image.new("RGB", (GAP + 4 * (TILE_WIDTH + GAP), CAPTION + height + GAP), "white")
    errors = [depth_metrics(depth, panel.reference, panel.target)["rmse"] for depth in aligned]
    before, after, near, far = (f"{v:.0f} mm" if in_depth else f"{v:.3g}" for v in (*errors, low, high))
    scores = "unknown" if np.isnan(errors).any() else f"{before} before, {after} after"
    caption = f"{panel.label}   RMSE in the outline: {scores}   (colours {near} to {far})"
    font = ImageFont.load_default(size=17)
    ImageDraw.Draw(strip).text((GAP, CAPTION // 2), caption, fill="black", font=font, anchor="lm")
    for index, picture in enumerate((panel.image, *map(Image.fromarray, maps))):
        tile = np.asarray(picture.convert("RGB").resize((TILE_WIDTH, height), Image.Resampling.BICUBIC))
        strip.paste(Image.fromarray(_outline(tile, panel.target)), (GAP + index * (TILE_WIDTH + GAP), CAPTION))
    return strip


def _outline(tile: np.ndarray, target: np.ndarray) -> np.ndarray:
    """A white line inside the target's border and a black one outside: visible on any colour."""
    mask = cv2.resize(target.astype(np.uint8), tile.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    kernel = np.ones((3, 3), np.uint8)
    tile = tile.copy()
    tile[cv2.dilate(mask, kernel) > mask] = 0
    tile[mask > cv2.erode(mask, kernel)] = 255
    return tile
