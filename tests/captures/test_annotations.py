"""The decoders of drawn masks (polygons, run lengths, brush strokes) against straight-line oracles."""

import numpy as np
from helpers.drawn_masks import BOX, SIZE, compressed, packed, region, run_lengths
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gift_peft.captures.coco import coco_mask
from gift_peft.captures.label_studio import label_studio_mask
from gift_peft.captures.shapes import ellipse_points, polygon_mask, rectangle_points


def inside(x: float, y: float, corners) -> bool | None:
    """Even-odd rule for one point, by its crossings with a ray to the right; None if it lies on an edge."""
    odd = False
    for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
        if (y0 <= y) != (y1 <= y):
            distance = x0 + (y - y0) / (y1 - y0) * (x1 - x0) - x
            if abs(distance) < 1e-9:
                return None
            odd ^= distance < 0
    return odd


# Multiples of an odd fraction: a corner is never level with a pixel's centre.
coordinate = st.integers(-400, 1500).map(lambda value: value / 77)


@given(st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=8))
def test_polygon_is_the_pixels_whose_centres_it_holds(corners):
    for mask in (polygon_mask(corners, SIZE), polygon_mask(corners[::-1], SIZE)):
        for y, x in np.ndindex(mask.shape):
            assert inside(x + 0.5, y + 0.5, corners) in (None, mask[y, x])


@given(coordinate, coordinate)
def test_polygons_that_share_an_edge_cover_every_pixel_once(x, y):
    middle = (x, y)
    border = [(-30, -30), (50, -30), (50, 50), (-30, 50)]
    parts = [polygon_mask([middle, border[k], border[(k + 1) % 4]], SIZE).astype(int) for k in range(4)]
    if -30 < x < 50 and -30 < y < 50:
        np.testing.assert_array_equal(sum(parts), 1)


def test_rectangles_and_ellipses():
    np.testing.assert_array_equal(polygon_mask(rectangle_points(3, 2, 6, 4), SIZE), BOX)
    np.testing.assert_array_equal(polygon_mask(rectangle_points(9, 6, -6, -4), SIZE), BOX)
    np.testing.assert_array_equal(polygon_mask(rectangle_points(9, 2, 4, 6, 90), SIZE), BOX)  # turned clockwise
    circle = polygon_mask(ellipse_points(50, 50, 30, 30), (100, 100))
    assert abs(circle.sum() - np.pi * 900) < 15
    tall = polygon_mask(ellipse_points(50, 50, 40, 10, 90), (100, 100))
    assert abs(tall.sum() - np.pi * 400) < 15 and tall[15, 50] and not tall[50, 15]


@given(arrays(bool, st.tuples(st.integers(1, 40), st.integers(1, 40))))
def test_run_lengths_give_the_mask_back(mask):
    height, width = mask.shape
    counts = run_lengths(mask)
    for form in (counts, compressed(counts)):
        decoded = coco_mask({"segmentation": {"size": [height, width], "counts": form}}, (width, height))
        np.testing.assert_array_equal(decoded, mask)


def test_run_lengths_as_pycocotools_writes_them():
    mask = np.zeros((3, 4), bool)
    mask[1, 1:3] = True
    np.testing.assert_array_equal(coco_mask({"segmentation": {"size": [3, 4], "counts": "41202"}}, (4, 3)), mask)


@given(arrays(bool, (8, 12)), st.booleans())
def test_brush_strokes_give_the_mask_back(mask, runs):
    values = np.repeat(mask.astype(np.uint8)[..., None] * 255, 4, axis=2).ravel()
    np.testing.assert_array_equal(label_studio_mask(region("brushlabels", rle=packed(values, runs)), SIZE), mask)
