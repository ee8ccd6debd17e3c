"""`compare.html`: base and adapted depth of an image under a slider. One file that needs no network and no server."""

import base64
import html
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from gift_peft.files import write_whole
from gift_peft.reports.figures import GridRow, Panel, outline, panel_row

MIN_SIDE = 320  # smaller tiles are enlarged, so that the outline is a line and not a row of blocks

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>
  :root {{ color-scheme: light dark; font: 16px/1.4 system-ui, sans-serif; }}
  body {{ margin: 0 auto; max-width: 80rem; padding: 1rem; }}
  article {{ margin: 0 0 2.5rem; }}
  h2 {{ font-size: 1.05rem; margin: 0 0 .5rem; }}
  .row {{ display: grid; gap: .75rem; grid-template-columns: repeat(auto-fit, minmax(16rem, 1fr)); }}
  figure {{ margin: 0; }}
  img {{ display: block; width: 100%; }}
  figcaption {{ display: flex; justify-content: space-between; }}
  .compare {{ position: relative; --at: 50%; }}
  .compare .over {{ position: absolute; inset: 0; clip-path: inset(0 0 0 var(--at)); }}
  .compare .line {{ position: absolute; top: 0; bottom: 0; left: var(--at); width: 3px; margin-left: -1.5px;
    background: #fff; outline: 1px solid #000; pointer-events: none; }}
  input {{ width: 100%; margin: .25rem 0 0; }}
</style>
</head>
<body>
<h1>{title}</h1>
{notes}
{articles}
<script>
  for (const slider of document.querySelectorAll("input[type=range]")) {{
    const compare = slider.closest("figure").querySelector(".compare");
    const move = () => compare.style.setProperty("--at", slider.value + "%");
    slider.addEventListener("input", move);
    move();
  }}
</script>
</body>
</html>
"""

ARTICLE = """<article>
<h2>{caption}</h2>
<div class="row">
<figure><img src="{rgb}" alt="photograph, target outlined"><figcaption>{columns[0]}</figcaption></figure>
<figure><img src="{reference}" alt="reference depth"><figcaption>{columns[1]}</figcaption></figure>
<figure>
<div class="compare">
<img src="{base}" alt="depth of {columns[2]}">
<img class="over" src="{adapted}" alt="depth of {columns[3]}">
<div class="line"></div>
</div>
<input type="range" min="0" max="100" value="50" step="0.5" aria-label="{columns[2]} or {columns[3]}">
<figcaption><span>{columns[2]} (left)</span><span>(right) {columns[3]}</span></figcaption>
</figure>
</div>
</article>"""


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
    names = [html.escape(name) for name in columns]
    articles = "\n".join(_article(panel_row(panel), names) for panel in panels)
    if not articles:
        raise ValueError("compare.html needs at least one panel")
    paragraphs = "\n".join(f"<p>{html.escape(note)}</p>" for note in notes)
    write_whole(Path(path), PAGE.format(title=html.escape(title), notes=paragraphs, articles=articles))
    return Path(path)


def _article(row: GridRow, columns: list[str]) -> str:
    height, width = row.tiles[-1].shape[:2]
    factor = max(1, -(-MIN_SIDE // width))
    sources = []
    for tile in row.tiles:
        image = Image.fromarray(tile).resize((factor * width, factor * height), Image.Resampling.BICUBIC)
        sources.append(_data_uri(outline(np.asarray(image), row.target)))
    rgb, reference, base, adapted = sources
    return ARTICLE.format(
        caption=html.escape(row.caption), rgb=rgb, reference=reference, base=base, adapted=adapted, columns=columns
    )


def _data_uri(tile: np.ndarray) -> str:
    stream = io.BytesIO()
    Image.fromarray(tile).save(stream, "JPEG", quality=92, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode()
