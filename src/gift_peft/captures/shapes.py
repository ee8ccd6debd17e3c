"""Drawn shapes to pixels: polygons, rectangles and ellipses as (H, W) bool arrays.

A pixel belongs to a shape if its center does (even-odd rule), so shapes that share an edge share no pixel and none is
left out between them. Nothing larger than the image is allocated.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np


class NoArea(ValueError):
    """A shape that covers nothing by what it is: a keypoint, a ring of two corners. Beside others it is left out."""


def polygon_mask(points: Sequence[Sequence[float]] | np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool from polygon corners (x, y) in pixels, where pixel (row, column) covers x in [column, column + 1].

    `size` is (width, height); what lies outside is cut off. ValueError for fewer than three corners (`NoArea`) or a
    coordinate that is not a finite number.
    """
    width, height = size
    try:
        corners = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        raise ValueError("a polygon's corners are not pairs of numbers") from None
    if len(corners) < 3 and corners.shape[1:] in ((), (2,)):
        raise NoArea("a polygon has fewer than three corners (x, y)")
    if corners.ndim != 2 or corners.shape[1] != 2:
        raise ValueError("a polygon's corners are not pairs of numbers")
    if not (np.abs(corners) < 1e9).all():  # NaN as well
        raise ValueError("a polygon's corner is not a number within reason")
    # Each edge flips everything to its right in the rows whose centers it crosses; what is flipped an odd number of
    # times is inside.
    flips = np.zeros((height, width + 1), bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 > y1:  # the same edge gives the same crossings in whichever direction it is drawn
            (x0, y0), (x1, y1) = (x1, y1), (x0, y0)
        first, last = (math.ceil(min(max(y, -1.0), height + 1.0) - 0.5) for y in (y0, y1))
        rows = np.arange(max(first, 0), min(last, height))
        if len(rows):
            crossings = x0 + (rows + 0.5 - y0) * ((x1 - x0) / (y1 - y0))
            columns = np.ceil(np.clip(crossings, 0, width) - 0.5).astype(int)
            flips[rows, columns] ^= True
    return np.logical_xor.accumulate(flips[:, :width], axis=1)


def rectangle_points(
    x: float, y: float, width: float, height: float, degrees: float = 0.0, about_center: bool = False
) -> np.ndarray:
    """(4, 2) corners of a rectangle turned clockwise, about its corner (x, y) or about its center."""
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
    pivot = np.array([width, height]) / 2 if about_center else np.zeros(2)
    return (corners - pivot) @ _turn(degrees) + pivot + (x, y)


def ellipse_points(x: float, y: float, radius_x: float, radius_y: float, degrees: float = 0.0) -> np.ndarray:
    """(360, 2) corners of an ellipse about (x, y), turned clockwise about its center."""
    angle = np.arange(360) * (math.pi / 180)
    return np.stack([radius_x * np.cos(angle), radius_y * np.sin(angle)], axis=1) @ _turn(degrees) + (x, y)


def union(
    draw: Callable[[Any, tuple[int, int]], np.ndarray], shapes: Iterable[Any], size: tuple[int, int]
) -> np.ndarray:
    """(H, W) bool of all shapes together, each by `draw(shape, size)`. Those without an area (`NoArea`) are left out,
    unless there is nothing else: then the first of them is raised.
    """
    mask, lacking, found = np.zeros(size[::-1], bool), None, False
    for shape in shapes:
        try:
            mask |= draw(shape, size)
            found = True
        except NoArea as error:
            lacking = lacking or error
    if lacking is not None and not found:
        raise lacking
    return mask


def _turn(degrees: float) -> np.ndarray:
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cosine, sine], [-sine, cosine]])  # rows are points; y points down
