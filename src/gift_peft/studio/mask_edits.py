"""What somebody draws on a photo, as a list of edits, and the mask that it comes to.

The page keeps the list and the server draws it, so that undoing is leaving out the last one, and what is saved is
drawn at the photo's own size. Places are shares of the photo's width and height, from 0 to 1.

    {"tool": "click", "x": .5, "y": .4, "target": true}      beside the target: false
    {"tool": "brush", "points": [[.1, .2], ...], "size": .02, "target": true}      size: diameter, of the width
    {"tool": "polygon", "points": [[.1, .2], ...], "target": true}
    {"tool": "propose"}      what changes in the group, as `prepare --propose-masks` has it
    {"tool": "clear"}
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import cv2
import numpy as np

from gift_peft.captures.shapes import polygon_mask
from gift_peft.prepare.proposals import Proposal, clean, refine, strong
from gift_peft.studio.segment import Click, cut_away, segment

TOOLS = ("click", "brush", "polygon", "propose", "clear")
MOST = 1000  # edits of a mask
MOST_POINTS = 20_000  # of a stroke
SUBPIXEL = 4  # bits: OpenCV draws at sixteenths of a pixel


@dataclass
class View:
    """What clicks are judged by: a picture and what changes in its group, both at working size.

    Args:
        picture (`np.ndarray`): (h, w, 3) uint8 RGB.
        change (`np.ndarray`): (h, w) float32 of `proposals.change_map`, zeros where there is nothing to compare.
        noise (`float`): the change that counts as none.
        method (`str`, *optional*): "sam2:<model id>", which redraws the borders of what was clicked on.
    """

    picture: np.ndarray
    change: np.ndarray
    noise: float
    method: str | None = None
    drawn: dict = field(default_factory=dict)  # {edits of clicks: mask}, for the list grows by one each time

    def found(self, clicks: tuple[Click, ...]) -> np.ndarray:
        """(h, w) bool: `segment` of these clicks."""
        if clicks not in self.drawn:
            mask = segment(self.picture, self.change, self.noise, clicks)
            if self.method is not None and mask.any():
                mask = refine(Proposal(mask, 0.0), self.picture, self.method).mask
            if len(self.drawn) > 50:
                self.drawn.clear()
            self.drawn[clicks] = mask
        return self.drawn[clicks]


def check_edits(edits: Any) -> list[dict]:
    """The list itself; ValueError, in a line, unless it is one as above: it comes from a page."""
    if not isinstance(edits, list) or len(edits) > MOST:
        raise ValueError(f"edits: a list of at most {MOST}")
    for edit in edits:
        if not isinstance(edit, dict) or edit.get("tool") not in TOOLS:
            raise ValueError(f"edits: {str(edit)[:80]!r}; each names its tool, one of {', '.join(TOOLS)}")
        tool = edit["tool"]
        if tool in ("click", "brush", "polygon") and not isinstance(edit.get("target"), bool):
            raise ValueError(f"edits: a {tool} says whether it is target: true or false")
        points = {"click": [[edit.get("x"), edit.get("y")]]}.get(tool, edit.get("points"))
        if tool in ("click", "brush", "polygon") and not _are_points(points, 3 if tool == "polygon" else 1):
            raise ValueError(f"edits: a {tool} without places that are shares of width and height")
        if tool == "brush" and not (_is_number(edit.get("size")) and 0 < edit["size"] <= 1):
            raise ValueError("edits: a brush has a size, a share of the width")
    return edits


def _are_points(points: Any, least: int) -> bool:
    return (
        isinstance(points, list)
        and least <= len(points) <= MOST_POINTS
        and all(isinstance(point, list) and len(point) == 2 and all(map(_is_number, point)) for point in points)
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 10  # false for NaN too


def draw_edits(start: np.ndarray, edits: Sequence[dict], view: View) -> np.ndarray:
    """(H, W) bool: the mask `start` after these edits, in their order.

    Clicks that follow one another are one question: the hits among them are found together, and the misses say what is
    not meant. Strokes and polygons are drawn at the size of `start`, what was found at that of `view`.
    """
    mask = start.copy()
    for clicking, run in groupby(edits, lambda edit: edit["tool"] == "click"):
        if clicking:
            mask = _click(mask, list(run), view)
            continue
        for edit in run:
            if edit["tool"] == "clear":
                mask = np.zeros_like(mask)
            elif edit["tool"] == "propose":
                some = view.change.max() > view.noise
                found = clean(strong(view.change, view.noise), view.change) if some else view.change > np.inf
                mask |= _resized(found, mask.shape)
            else:
                shape = _stroke(edit, mask.shape) if edit["tool"] == "brush" else _polygon(edit, mask.shape)
                mask = mask | shape if edit["target"] else mask & ~shape
    return mask


def _click(mask: np.ndarray, run: list[dict], view: View) -> np.ndarray:
    height, width = view.change.shape
    clicks = tuple(Click(edit["x"] * width, edit["y"] * height, edit["target"]) for edit in run)
    small = _resized(mask, view.change.shape)
    kept = cut_away(small, view.picture, view.change, view.noise, clicks)
    if kept is not small:
        mask = mask & ~_resized(small & ~kept, mask.shape)
    return mask | _resized(view.found(clicks), mask.shape)


def _stroke(edit: dict, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) bool: a line with round ends."""
    height, width = shape
    points = np.array(edit["points"], np.float64) * (width, height) - 0.5  # OpenCV's pixels have their centers at 0
    canvas = np.zeros(shape, np.uint8)
    radius = max(edit["size"] * width / 2, 0.5)
    whole = np.rint(points * 2**SUBPIXEL).astype(np.int32)
    if len(whole) > 1:
        cv2.polylines(canvas, [whole], False, 1, max(1, round(2 * radius)), cv2.LINE_8, SUBPIXEL)
    else:
        cv2.circle(canvas, tuple(map(int, whole[0])), round(radius * 2**SUBPIXEL), 1, -1, cv2.LINE_8, SUBPIXEL)
    return canvas > 0


def _polygon(edit: dict, shape: tuple[int, ...]) -> np.ndarray:
    height, width = shape
    return polygon_mask(np.array(edit["points"], np.float64) * (width, height), (width, height))


def _resized(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) bool, with borders that are lines at any size."""
    if mask.shape == tuple(shape):
        return mask
    shrinks = shape[0] < mask.shape[0]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=how) > 0.5
