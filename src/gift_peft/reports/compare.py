"""`compare.html`: base and adapted depth of an image under a slider. One file that needs no network and no server."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import jinja2
import numpy as np
from PIL import Image

from gift_peft.files import write_whole
from gift_peft.images import jpeg_uri
from gift_peft.reports.figures import ColorBar, GridRow, Panel, outline, panel_row

TEMPLATE = Path(__file__).parent / "templates" / "compare.html"
MIN_SIDE = 320  # smaller tiles are enlarged, so that the outline is a line and not a row of blocks


def write_compare(
    panels: Iterable[Panel],
    path: str | Path,
    *,
    title: str = "Before and after",
    notes: Sequence[str] = (),
    columns: Sequence[str] = ("RGB", "true depth", "base", "GIFT"),
) -> Path:
    """One article per panel: photograph, reference, and base and adapted under a slider; colours as in `before_after`.

    Panels are taken one at a time, so that they may come from a generator and need not fit in memory together.

    Raises:
        ValueError: no panels, or one whose arrays differ in size.
    """
    articles = [(row.caption, _pictures(row), _legend(row.bar)) for row in map(panel_row, panels)]
    if not articles:
        raise ValueError("compare.html needs at least one panel")
    template = jinja2.Template(TEMPLATE.read_text(encoding="utf-8"), autoescape=True, keep_trailing_newline=True)
    write_whole(Path(path), template.render(title=title, notes=notes, columns=columns, articles=articles))
    return Path(path)


def _pictures(row: GridRow) -> list[str]:
    """The row's tiles as data URIs, outlined."""
    width = row.tiles[-1].shape[1]
    width *= max(1, -(-MIN_SIDE // width))
    photo = row.tiles[0]
    height = round(width * photo.shape[0] / photo.shape[1])
    sources = []
    for tile in row.tiles:
        image = Image.fromarray(tile).resize((width, height), Image.Resampling.BICUBIC)
        outlined = Image.fromarray(outline(np.asarray(image), row.target))
        sources.append(jpeg_uri(outlined, quality=92, subsampling=0))
    return sources


def _legend(bar: ColorBar) -> dict[str, str]:
    """The color bar's two texts, and its colors as stops of a CSS gradient."""
    stops = ", ".join("#{:02x}{:02x}{:02x}".format(*bar.colors[0, index]) for index in range(0, 256, 17))
    return {"left": bar.left, "right": bar.right, "stops": stops}
