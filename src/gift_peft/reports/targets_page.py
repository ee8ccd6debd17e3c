"""`targets.html`: what training with surface targets would pull each photo to, to be looked at before it does.

Per observation the photo, the base's prediction, the surface target and, where there is one, the prediction of the
treated reference, in the same colors; the largest differences come first. One file without scripts or links.
"""

import heapq
import html
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from PIL import Image

from gift_peft.colormap import color_range, colorize
from gift_peft.evaluation.alignment import align
from gift_peft.models.pixels import resize_mask
from gift_peft.reports.figures import html_figure, outline
from gift_peft.rules import UNKNOWN, GroupPictures

WIDTH = 320  # of a picture
LIMIT = 400  # observations: a page of more is slow to open

MARK = "<title>Surface targets</title>"  # by which a page of ours is known
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Surface targets</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">
<style>
  :root {{ color-scheme: light dark; font: 16px/1.4 system-ui, sans-serif; }}
  body {{ margin: 0 auto; max-width: 86rem; padding: 1rem; }}
  h2 {{ font-size: 1.05rem; margin: 1.5rem 0 0; overflow-wrap: anywhere; }}
  p {{ margin: .2rem 0 .5rem; }}
  div {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(15rem, 1fr)); gap: .75rem; }}
  figure {{ margin: 0; }}
  img {{ display: block; height: auto; width: 100%; }}
</style></head><body>
<h1>Surface targets</h1>
<p>Inside the outlined target, training pulls the base's prediction to the surface target; outside both are the same.
Bright is near. {told} Percentages are of the prediction's range, P95 - P5 over the photo.</p>
{observations}
</body></html>
"""


@dataclass(frozen=True)
class Shown:
    """An observation on the page: how far its target was moved, in the median, and what stands there."""

    difference: float
    text: str


def targets_page(groups: Iterable[GroupPictures], kind: str) -> str:
    """The page.

    Args:
        groups: with proxies and surface targets, read one at a time; of one or of several splits.
        kind: what the teacher predicts, `depth` or `inverse_depth`.
    """
    total = 0

    def shown() -> Iterator[Shown]:
        nonlocal total
        for group in groups:
            for index in range(len(group.names)):
                total += 1
                yield _shown(group, index, kind)

    largest = heapq.nlargest(LIMIT, shown(), key=lambda one: one.difference)
    told = f"{total} observations, sorted by how far the surface target is from the base."
    if total > LIMIT:
        told = f"The {LIMIT} of {total} observations whose surface target is farthest from the base."
    return PAGE.format(told=told, observations="\n".join(one.text for one in largest))


def _shown(group: GroupPictures, index: int, kind: str) -> Shown:
    base, target = group.proxies[index].numpy(), group.surface_target[index].numpy()
    mask = resize_mask(group.masks[index], base.shape)
    valid = resize_mask(group.valids[index], base.shape) if len(group.valids) else np.ones_like(mask)
    valid &= base != UNKNOWN
    region, spread = mask & valid, float(np.subtract(*np.percentile(base[valid], (95, 5)))) if valid.any() else 0.0
    maps, told = {"the base": base, "surface target": target}, "no target at this size"
    difference = 0.0
    if region.any() and not spread:
        told = "the base says one depth for the whole photo"
    elif region.any():
        moved = (target - base)[region]
        nearer = np.mean(moved > 0 if kind == "inverse_depth" else moved < 0)
        difference = float(np.median(np.abs(moved))) / spread
        told = f"moved by {difference:.1%} in the median, nearer on {nearer:.0%} of the target"
    reference = None if group.reference_proxy is None else group.reference_proxy.numpy()
    other = ~mask & valid & (base > 0)  # `align` takes no others
    if reference is not None:
        other &= reference != UNKNOWN
    if reference is not None and region.any() and spread > 0 and other.any() and np.ptp(reference[other]) > 0:
        reference = np.asarray(align(reference, base, other, "native", kind).aligned)
        maps["treated reference"] = reference
        before, after = (float(np.median(np.abs(each - reference)[region])) / spread for each in (base, target))
        told += f"; from the treated reference {before:.1%} before, {after:.1%} after"
    low, high = color_range(*(values[valid] for values in maps.values()))
    height = round(WIDTH * base.shape[0] / base.shape[1])
    photo = group.images[index].convert("RGB").resize((WIDTH, height), Image.Resampling.BICUBIC)
    pictures = {group.names[index]: photo}
    for name, values in maps.items():
        pictures[name] = Image.fromarray(colorize(values, low, high, kind)).resize((WIDTH, height))
    figures = [
        html_figure(name, Image.fromarray(outline(np.asarray(picture), mask)), quality=85)
        for name, picture in pictures.items()
    ]
    title = html.escape(", ".join(filter(None, (f"{group.group_id}/{group.names[index]}", group.surface))))
    return Shown(difference, f"<h2>{title}</h2>\n<p>{told}</p>\n<div>{''.join(figures)}</div>")
