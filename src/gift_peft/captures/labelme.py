"""labelme's JSON, one file a photo; X-AnyLabeling and AnyLabeling write the same.

Shapes lie on each other in the order of the file, as labelme's own converters paint them: a later shape of another
label (a hole, an object in front) cuts an earlier one.
"""

import base64
import binascii
import re

import numpy as np

from gift_peft.captures.labels import MaskClass, check_size, checked_label, choose_labels, dicts
from gift_peft.captures.shapes import NoArea, ellipse_points, polygon_mask, rectangle_points
from gift_peft.images import open_image

NEVER_A_TARGET = ("_background_", "background", "__ignore__")  # names of labelme's and its converters'
FOUR_CORNERS = ("rectangle", "rotation", "quadrilateral", "orientedrectangle", "rotatedrectangle", "rotatedbox")
POINTS = ("point", "points")  # a click, which covers nothing
LINES = ("line", "linestrip")


def read_labelme(content: dict, size: tuple[int, int], mask_class: MaskClass) -> np.ndarray:
    """(H, W) bool target of an image of `size` (width, height) from labelme's JSON; ValueError for anything wrong."""
    check_size("its shapes are for", (content.get("imageWidth"), content.get("imageHeight")), size)
    shapes = dicts(content["shapes"], "shapes")
    labels = [checked_label(shape.get("label")) for shape in shapes]
    known = {label: () for label in labels if mask_class is not None or label.casefold() not in NEVER_A_TARGET}
    chosen = choose_labels(known, mask_class, "labels") if known else []
    mask, lacking, found = np.zeros(size[::-1], bool), None, False
    for label, shape in zip(labels, shapes, strict=True):
        target = label in chosen
        if not target and (not mask.any() or _plain(shape.get("shape_type")) in LINES):
            continue  # nothing to cut, or nothing that cuts
        try:
            part = labelme_mask(shape, size)
        except NoArea as error:
            lacking = lacking or (error if target else None)
            continue
        found |= target
        mask = mask | part if target else mask & ~part
    if lacking is not None and not found:
        raise lacking
    return mask


def labelme_mask(shape: dict, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of one labelme shape: polygon, rectangle (turned ones too), circle, or a mask stored within its box.

    Raises ValueError for shapes without an area (`NoArea` for a point or two corners) and for malformed ones.
    """
    kind, points = shape.get("shape_type") or "polygon", shape.get("points")
    try:
        corners = np.asarray(points, np.float64).reshape(-1, 2)
    except (TypeError, ValueError):
        raise ValueError(f"the points of a {kind} are not pairs of numbers") from None
    if kind == "circle" and len(corners) == 2:
        radius = float(np.hypot(*(corners[1] - corners[0])))
        return polygon_mask(ellipse_points(*corners[0], radius, radius), size)
    if kind == "rectangle" and len(corners) == 2:
        return polygon_mask(rectangle_points(*corners[0], *(corners[1] - corners[0])), size)
    if kind == "mask" and len(corners) == 2:
        return _placed_mask(shape.get("mask"), corners[0], size)
    if (kind == "polygon" and len(corners) >= 3) or (_plain(kind) in FOUR_CORNERS and len(corners) == 4):
        return polygon_mask(corners, size)
    text = f"a shape of type {kind!r} with {len(corners)} points has no area; draw a polygon"
    # A line may be an outline that was never closed: that is not passed over.
    raise NoArea(text) if _plain(kind) in POINTS or kind == "polygon" else ValueError(text)


def _plain(kind) -> str:
    """`oriented_rectangle` and `Oriented Rectangle` are one."""
    return re.sub(r"[\W_]", "", str(kind)).lower()


def _placed_mask(encoded, corner: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    try:
        stored = np.asarray(open_image(base64.b64decode(encoded, validate=True), "its mask")) > 0
    except (TypeError, binascii.Error):
        raise ValueError("a stored mask is not base64") from None
    mask = np.zeros(size[::-1], bool)
    if stored.ndim != 2 or not np.isfinite(corner).all():
        raise ValueError("a stored mask has several channels or no place")
    left, top = (int(value) for value in corner)
    height, width = stored.shape
    if left < 0 or top < 0 or left + width > size[0] or top + height > size[1]:
        raise ValueError("a stored mask reaches beyond the image")
    mask[top : top + height, left : left + width] = stored
    return mask
