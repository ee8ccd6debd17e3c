"""Pictures of predictions: before and after, error maps, and the same photograph under several checkpoints.

A figure is a grid of colour tiles (paper, qualitative figures and supplement C): one range per row, near is bright,
the target outlined, unknown pixels grey in the reference and nowhere else. Pillow draws it once, for PNG and for PDF.
"""

import html
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gift_peft.colormap import color_range, colorize, colorize_error
from gift_peft.evaluation.alignment import align, known
from gift_peft.evaluation.metrics import depth_metrics
from gift_peft.evaluation.protocols import get_protocol
from gift_peft.files import write_whole
from gift_peft.images import jpeg_uri

TILE_WIDTH, GAP, HEADER, CAPTION, LEGEND = 512, 12, 54, 48, 46  # pixels
TITLE, TEXT = 37, 29  # sizes of type in pixels: 9 and 7 points in print
BAR_WIDTH, BAR_HEIGHT = 420, 22  # of the color bar
MILLIMETERS, NATIVE = "mm", "(the model's units)"
# How Pillow saves it. No dates in a PDF: the same panels give the same bytes.
FORMATS = {
    ".png": {"optimize": True, "dpi": (300, 300)},
    ".pdf": {"resolution": 300, "quality": 95, "subsampling": 0, "creationDate": None, "modDate": None},
}


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
        valid (`np.ndarray`, *optional*): bool, the pixels that count for alignment and error; default all.
    """

    label: str
    image: Image.Image
    reference: np.ndarray
    base: np.ndarray
    adapted: np.ndarray
    target: np.ndarray
    kind: str
    protocol: str = "gift"
    valid: np.ndarray | None = None


@dataclass
class Aligned:
    """A panel's maps in the reference's space: `reference` with NaN where unknown, `base`, `adapted`, (H,W) float64.

    Args:
        errors (`tuple[float, float]`): RMSE inside the target, base and adapted; NaN where nothing is known there.
        unit (`str`): MILLIMETERS or NATIVE.
        kind (`str`): of all three maps, for the colours.
    """

    reference: np.ndarray
    base: np.ndarray
    adapted: np.ndarray
    errors: tuple[float, float]
    unit: str
    kind: str


@dataclass
class GridRow:
    """One line of a figure: (H,W,3) uint8 tiles under a caption, and the colors' meaning below them.

    The first tile is the photo, whose aspect ratio all are shown in; `target` (h,w) bool is outlined.
    """

    caption: str
    tiles: list[np.ndarray]
    bar: "ColorBar"
    target: np.ndarray | None = None


@dataclass(frozen=True)
class ColorBar:
    """The colors of a row from `left` to `right`, which are texts: (1,256,3) uint8."""

    colors: np.ndarray
    left: str
    right: str


def align_panel(panel: Panel) -> Aligned:
    """Both predictions aligned as the protocol says; ValueError if the arrays differ in size."""
    valid = np.ones(panel.reference.shape, bool) if panel.valid is None else panel.valid
    base, adapted = (
        align(prediction, panel.reference, valid, panel.protocol, panel.kind).aligned
        for prediction in (panel.base, panel.adapted)
    )
    reference = np.where(valid & known(panel.reference), panel.reference, np.nan)
    errors = tuple(depth_metrics(d, panel.reference, panel.target & valid)["rmse"] for d in (base, adapted))
    native = get_protocol(panel.protocol).space == "native"
    unit, kind = (NATIVE, panel.kind) if native else (MILLIMETERS, "depth")
    return Aligned(reference, base, adapted, errors, unit, kind)


def before_after(
    rows: Sequence[Panel], path: str | Path, columns: Sequence[str] = ("RGB", "true depth", "base", "GIFT")
) -> Path:
    """Draws one row per panel: picture, reference, base, adapted, aligned and in one colour range; near is bright.

    The caption gives the RMSE inside the target before and after, the bar the range of the colors; `path` ends in .png
    or .pdf.

    Raises:
        ValueError: no rows, or a panel whose arrays differ in size.
    """
    return save_grid([panel_row(panel) for panel in rows], columns, path)


def panel_row(panel: Panel, *others: Panel) -> GridRow:
    """RGB, reference, base and adapted of one panel as coloured tiles.

    `others`: the same picture, reference and base with other adapted predictions, each one tile more.
    """
    aligned, more = align_panel(panel), [align_panel(other) for other in others]
    maps = (aligned.reference, aligned.base, aligned.adapted, *(other.adapted for other in more))
    low, high = color_range(*maps)
    tiles = [colorize(depth, low, high, aligned.kind) for depth in maps]
    errors = (*aligned.errors, *(other.errors[1] for other in more))
    bar = _bar(low, high, aligned.kind, aligned.unit)
    return GridRow(_caption(panel.label, errors, aligned.unit), [_picture(panel), *tiles], bar, panel.target)


def error_maps(
    rows: Sequence[Panel], path: str | Path, columns: Sequence[str] = ("RGB", "|error| base", "|error| GIFT")
) -> Path:
    """Absolute errors of both predictions after alignment, in one range from 0; grey where the reference is unknown.

    Raises:
        ValueError: no rows, or a panel whose arrays differ in size.
    """
    return save_grid([error_row(panel) for panel in rows], columns, path)


def error_row(panel: Panel) -> GridRow:
    """RGB and the two error maps of one panel as coloured tiles; bright is wrong."""
    aligned = align_panel(panel)
    errors = [np.abs(depth - aligned.reference) for depth in (aligned.base, aligned.adapted)]
    high = color_range(*errors)[1]
    tiles = [_picture(panel), *(colorize_error(error, high) for error in errors)]
    colors = colorize_error(np.linspace(0, high, 256)[None], high)
    bar = ColorBar(colors, "no error", f"{_in_units(high, aligned.unit)} or more{_unit(aligned.unit)}")
    return GridRow(_caption(panel.label, aligned.errors, aligned.unit), tiles, bar, panel.target)


def prediction_row(label: str, image: Image.Image, predictions: Sequence[np.ndarray], kind: str) -> GridRow:
    """A photograph and predictions (H,W) of it in native units, in one range, without any reference."""
    low, high = color_range(*predictions)
    tiles = [colorize(depth, low, high, kind) for depth in predictions]
    return GridRow(label, [np.asarray(image.convert("RGB")), *tiles], _bar(low, high, kind, NATIVE))


def _picture(panel: Panel) -> np.ndarray:
    return np.asarray(panel.image.convert("RGB"))


def _caption(label: str, errors: Sequence[float], unit: str) -> str:
    """What the row shows, and the error of the base and of each adapted prediction."""
    scores = "unknown"
    if not np.isnan(errors).any():
        before, *after = (_in_units(error, unit) for error in errors)
        scores = f"{before} before, {' and '.join(after)} after{_unit(unit)}"
    return f"{label} · RMSE in the outline: {scores}"


def _bar(low: float, high: float, kind: str, unit: str) -> ColorBar:
    """From near to far, whatever is larger in this kind of prediction."""
    near, far = (high, low) if kind == "inverse_depth" else (low, high)
    colors = colorize(np.linspace(near, far, 256)[None], low, high, kind)
    return ColorBar(colors, f"near: {_in_units(near, unit)}", f"far: {_in_units(far, unit)}{_unit(unit)}")


def _in_units(value: float, unit: str) -> str:
    """Whole millimeters; three digits of the model's own units, never with an exponent."""
    if unit == MILLIMETERS:
        return f"{value:,.0f} mm"
    digits = 0 if value == 0 else math.floor(math.log10(abs(value)))
    return f"{value:,.{min(max(2 - digits, 0), 6)}f}"


def _unit(unit: str) -> str:
    """What follows the last of several numbers: millimeters stand behind each, the model's units once."""
    return "" if unit == MILLIMETERS else f" {unit}"


# ---- drawing ----


def save_grid(rows: Sequence[GridRow], columns: Sequence[str], path: str | Path) -> Path:
    """The figure as .png or .pdf, both the same picture; four columns fill a page of 7 inches at 300 dots per inch."""
    path = Path(path)
    if not rows:
        raise ValueError(f"{path.name} needs at least one panel")
    if path.suffix not in FORMATS:
        raise ValueError(f"{path}: a figure is .png or .pdf")
    stream = io.BytesIO()
    _draw(rows, columns).save(stream, path.suffix[1:].upper(), **FORMATS[path.suffix])
    write_whole(path, stream.getvalue())
    return path


def _draw(rows: Sequence[GridRow], columns: Sequence[str]) -> Image.Image:
    strips = [_draw_strip(row) for row in rows]
    canvas = Image.new("RGB", (strips[0].width, HEADER + sum(strip.height for strip in strips)), "white")
    for index, title in enumerate(columns):
        center = GAP + index * (TILE_WIDTH + GAP) + TILE_WIDTH // 2
        _write(canvas, (center, HEADER // 2), title, TITLE, "mm")
    top = HEADER
    for strip in strips:
        canvas.paste(strip, (0, top))
        top += strip.height
    return canvas


def _draw_strip(row: GridRow) -> Image.Image:
    height, width = row.tiles[0].shape[:2]
    height = round(TILE_WIDTH * height / width)
    total = GAP + len(row.tiles) * (TILE_WIDTH + GAP)
    lines = _wrapped(row.caption, TEXT, total - 2 * GAP)
    top = len(lines) * CAPTION
    strip = Image.new("RGB", (total, top + height + LEGEND + GAP), "white")
    for number, line in enumerate(lines):
        _write(strip, (GAP, number * CAPTION + CAPTION // 2), line, TEXT, "lm")
    for index, tile in enumerate(row.tiles):
        resized = Image.fromarray(tile).resize((TILE_WIDTH, height), Image.Resampling.BICUBIC)
        shown = np.asarray(resized) if row.target is None else outline(np.asarray(resized), row.target)
        strip.paste(Image.fromarray(shown), (GAP + index * (TILE_WIDTH + GAP), top))
    middle, left = top + height + LEGEND // 2, 2 * GAP + TILE_WIDTH  # below the first tile that has these colors
    font = ImageFont.load_default(TEXT)
    start = left + round(font.getlength(row.bar.left)) + GAP
    bar = Image.fromarray(row.bar.colors).resize((BAR_WIDTH, BAR_HEIGHT))
    strip.paste(bar, (start, middle - BAR_HEIGHT // 2))
    _write(strip, (left, middle), row.bar.left, TEXT, "lm")
    _write(strip, (start + BAR_WIDTH + GAP, middle), row.bar.right, TEXT, "lm")
    return strip


def _wrapped(text: str, size: int, room: int) -> list[str]:
    """The text in lines of at most `room` pixels, broken at spaces, and inside a word that is longer than a line."""
    font, lines = ImageFont.load_default(size), [""]
    for word in text.split(" "):
        if lines[-1] and font.getlength(f"{lines[-1]} {word}") > room:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}" if lines[-1] else word
        while font.getlength(lines[-1]) > room:
            kept = next(end for end in range(len(lines[-1]) - 1, 0, -1) if font.getlength(lines[-1][:end]) <= room)
            lines[-1:] = [lines[-1][:kept], lines[-1][kept:]]
    return lines


def _write(canvas: Image.Image, at: tuple[int, int], text: str, size: int, anchor: str) -> None:
    ImageDraw.Draw(canvas).text(at, text, fill="black", font=ImageFont.load_default(size), anchor=anchor)


def html_figure(caption: str, picture: Image.Image, quality: int) -> str:
    """A picture with its caption for a page of one file; `quality` of the JPEG."""
    size, caption = f'width="{picture.width}" height="{picture.height}"', html.escape(caption)
    source = jpeg_uri(picture, quality=quality)
    return f'<figure><img src="{source}" {size} alt="{caption}"><figcaption>{caption}</figcaption></figure>\n'


def outline(tile: np.ndarray, target: np.ndarray) -> np.ndarray:
    """A white line inside the target's border and a black one outside: visible on any colour."""
    mask = cv2.resize(target.astype(np.uint8), tile.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    width = max(1, tile.shape[1] // 256)
    kernel = np.ones((2 * width + 1, 2 * width + 1), np.uint8)
    tile = tile.copy()
    tile[cv2.dilate(mask, kernel) > mask] = 0
    tile[mask > cv2.erode(mask, kernel)] = 255
    return tile
