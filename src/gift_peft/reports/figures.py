"""Pictures of predictions: before and after, error maps, and the same photograph under several checkpoints.

A figure is a grid of colour tiles (paper, qualitative figures and supplement C): one range per row, near is bright,
the target outlined, unknown pixels grey in the reference and nowhere else. Pillow draws it once, for PNG and for PDF.
"""

import html
import io
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

TILE_WIDTH, GAP, HEADER, CAPTION = 512, 12, 54, 48  # pixels; text of 9 and 7 points in print
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
        unit (`str`): ` mm`, or nothing for native units.
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
    """One line of a figure: (H,W,3) uint8 tiles of one shape under a caption; `target` (h,w) bool is outlined."""

    caption: str
    tiles: list[np.ndarray]
    target: np.ndarray | None = None


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
    return Aligned(reference, base, adapted, errors, "" if native else " mm", panel.kind if native else "depth")


def before_after(
    rows: Sequence[Panel], path: str | Path, columns: Sequence[str] = ("RGB", "true depth", "base", "GIFT")
) -> Path:
    """Draws one row per panel: picture, reference, base, adapted, aligned and in one colour range; near is bright.

    The caption gives the RMSE inside the target before and after, and the range of the colours; `path` ends in .png or
    .pdf.

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
    before, *after, near, far = _in_units((*errors, low, high), aligned.unit)
    scores = "unknown" if np.isnan(errors).any() else f"{before} before, {' and '.join(after)} after"
    caption = f"{panel.label}   RMSE in the outline: {scores}   (colours {near} to {far})"
    return GridRow(caption, [_picture(panel), *tiles], panel.target)


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
    before, after, end = _in_units((*aligned.errors, high), aligned.unit)
    scores = "unknown" if np.isnan(aligned.errors).any() else f"{before} before, {after} after"
    caption = f"{panel.label}   RMSE in the outline: {scores}   (colours 0 to {end})"
    return GridRow(caption, [_picture(panel), *(colorize_error(error, high) for error in errors)], panel.target)


def prediction_row(label: str, image: Image.Image, predictions: Sequence[np.ndarray], kind: str) -> GridRow:
    """A photograph and predictions (H,W) of it in native units, in one range, without any reference."""
    low, high = color_range(*predictions)
    tiles = [colorize(depth, low, high, kind) for depth in predictions]
    caption = f"{label}   (colours {low:.3g} to {high:.3g})"
    return GridRow(caption, [np.asarray(image.convert("RGB")), *tiles])


def _picture(panel: Panel) -> np.ndarray:
    return np.asarray(panel.image.convert("RGB"))


def _in_units(values: Sequence[float], unit: str) -> list[str]:
    return [f"{value:.0f}{unit}" if unit else f"{value:.3g}" for value in values]


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
        _write(canvas, (center, HEADER // 2), title, 37, TILE_WIDTH, "mm")
    top = HEADER
    for strip in strips:
        canvas.paste(strip, (0, top))
        top += strip.height
    return canvas


def _draw_strip(row: GridRow) -> Image.Image:
    height, width = row.tiles[-1].shape[:2]
    height = round(TILE_WIDTH * height / width)
    strip = Image.new("RGB", (GAP + len(row.tiles) * (TILE_WIDTH + GAP), CAPTION + height + GAP), "white")
    _write(strip, (GAP, CAPTION // 2), row.caption, 29, strip.width - 2 * GAP, "lm")
    for index, tile in enumerate(row.tiles):
        resized = Image.fromarray(tile).resize((TILE_WIDTH, height), Image.Resampling.BICUBIC)
        shown = np.asarray(resized) if row.target is None else outline(np.asarray(resized), row.target)
        strip.paste(Image.fromarray(shown), (GAP + index * (TILE_WIDTH + GAP), CAPTION))
    return strip


def _write(canvas: Image.Image, at: tuple[int, int], text: str, size: int, room: int, anchor: str) -> None:
    """One line of text, smaller where it would be wider than `room`."""
    font = ImageFont.load_default(size)
    while font.getlength(text) > room and size > 8:
        size -= 1
        font = ImageFont.load_default(size)
    ImageDraw.Draw(canvas).text(at, text, fill="black", font=font, anchor=anchor)


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
