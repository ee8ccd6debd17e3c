"""`validation.html`: what the demo is measured on. Every validation group's observations, their targets outlined.

One file without scripts or links: the groups themselves are parquet shards, which no picture viewer opens.
"""

import html
from collections.abc import Iterable

import numpy as np
from PIL import Image

from gift_peft.reports.figures import html_figure, outline
from gift_peft.rules import GroupPictures

ENLARGE = 2  # the pictures are small; the outline stays a line

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Validation groups</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">
<style>
  :root {{ color-scheme: light dark; font: 16px/1.4 system-ui, sans-serif; }}
  body {{ margin: 0 auto; max-width: 80rem; padding: 1rem; }}
  h2 {{ font-size: 1.05rem; margin: 1.5rem 0 .5rem; }}
  div {{ display: flex; flex-wrap: wrap; gap: .75rem; }}
  figure {{ margin: 0; }}
  img {{ display: block; }}
</style></head><body>
<h1>Validation groups</h1>
<p>The observations of each group with the target mask outlined, then the treated reference: the same scene with the
target's surface made visible.</p>
{groups}
</body></html>
"""


def validation_page(groups: Iterable[GroupPictures]) -> str:
    """The page of these groups, read one at a time."""
    return PAGE.format(groups="\n".join(map(_group, groups)))


def _group(group: GroupPictures) -> str:
    figures = list(map(_figure, group.names, group.images, group.masks))
    if group.reference is not None:
        figures.append(_figure("treated reference", group.reference))
    title = ", ".join(filter(None, (group.group_id, group.surface)))
    return f"<h2>{html.escape(title)}</h2>\n<div>{''.join(figures)}</div>"


def _figure(caption: str, image: Image.Image, mask: np.ndarray | None = None) -> str:
    image = image.resize((ENLARGE * image.width, ENLARGE * image.height), Image.Resampling.BICUBIC)
    if mask is not None:
        image = Image.fromarray(outline(np.asarray(image), mask))
    return html_figure(caption, image, quality=90)
