"""labelme, COCO and Label Studio where tools and people differ: turned boxes, holes, odd ids, leftovers."""

import copy
import math

import numpy as np
import pytest
from helpers.drawn_masks import BOX, CORNERS, POLYGON, SIZE, coco, labelme, percent, region, tasks
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.captures.coco import coco_images, coco_mask
from gift_peft.captures.label_studio import label_studio_images
from gift_peft.captures.labelme import read_labelme
from gift_peft.captures.shapes import polygon_mask

HOLE = [[4, 3], [8, 3], [8, 5], [4, 5]]
HOLED = BOX.copy()
HOLED[3:5, 4:8] = False


def turned(x, y, width, height, degrees):
    """Straight-line oracle: a box's corners turned clockwise, as seen on a screen, about its center."""
    angle = math.radians(degrees)
    middle = x + width / 2, y + height / 2
    corners = ((x, y), (x + width, y), (x + width, y + height), (x, y + height))
    return [
        (
            middle[0] + math.cos(angle) * (a - middle[0]) - math.sin(angle) * (b - middle[1]),
            middle[1] + math.sin(angle) * (a - middle[0]) + math.cos(angle) * (b - middle[1]),
        )
        for a, b in corners
    ]


# ---- COCO ----


@given(
    box=st.tuples(*[st.integers(0, 400).map(lambda value: value / 7)] * 4),
    degrees=st.integers(-720, 720).map(lambda value: value / 3),
    place=st.sampled_from(["attributes", "annotation", "text"]),
)
@settings(max_examples=60, deadline=None)
def test_a_box_with_a_rotation_is_turned(box, degrees, place):
    size = (70, 60)
    annotation = {"bbox": list(box), "segmentation": []}
    if place == "annotation":
        annotation["rotation"] = degrees
    else:
        annotation["attributes"] = {"occluded": False, "rotation": str(degrees) if place == "text" else degrees}
    read, expected = coco_mask(annotation, size), polygon_mask(turned(*box, degrees), size)
    assert (read != expected).sum() <= 2  # a pixel's center on an edge, to rounding


def test_what_cannot_be_turned_surely_is_refused():
    box = [3, 2, 6, 4]
    for change, words in (
        ({"bbox": [6, 4, 6, 4, 30]}, "a box of five numbers"),
        ({"attributes": {"angle": 0.5}}, "a box with `angle`"),
        ({"theta": 1}, "a box with `theta`"),
        ({"attributes": {"rotation": "left"}}, "not one number of degrees"),
        ({"attributes": {"rotation": math.nan}}, "not one number of degrees"),
        ({"attributes": {"rotation": 10}, "rotation": 20}, "not one number of degrees"),
        ({"attributes": {"rotation": 45}, "segmentation": [POLYGON]}, "whose segmentation is not turned"),
    ):
        with pytest.raises(ValueError, match=words):
            coco_mask({"bbox": box, **change}, SIZE)
    same = {"bbox": box, "attributes": {"rotation": 0, "angle": 0}}
    np.testing.assert_array_equal(coco_mask(same, SIZE), BOX)
    for degrees in (180, 0.0, None):  # a polygon that is the box as drawn
        content = {"bbox": box, "segmentation": [POLYGON], "attributes": {"rotation": degrees}}
        np.testing.assert_array_equal(coco_mask(content, SIZE), BOX)
    drawn = {"bbox": [0, 0, 12, 8], "segmentation": [POLYGON], "attributes": {"rotation": 45}}  # of a turned shape
    np.testing.assert_array_equal(coco_mask(drawn, SIZE), BOX)


def root_category(content):
    content["categories"] = [{"id": 0, "name": "glass"}, {"id": 2, "name": "glass"}]


def text_ids(content):
    content["categories"] = [{"id": str(item["id"]), "name": item["name"]} for item in content["categories"]]
    content["images"][0]["id"] = "5"


def text_references(content):
    content["annotations"][0] |= {"image_id": "5", "category_id": "2"}


ODD = {
    "a root category of the same name": root_category,
    "ids as text": text_ids,
    "references as text": text_references,
    "a flat polygon": lambda c: c["annotations"][0].update(segmentation=POLYGON),
    "a ring of two corners": lambda c: c["annotations"][0].update(segmentation=[[5, 5, 6, 6], POLYGON]),
    "an empty ring": lambda c: c["annotations"][0].update(segmentation=[POLYGON, []]),
    "another object of two corners": lambda c: c["annotations"].append(
        {"image_id": 5, "category_id": 2, "segmentation": [[1, 1, 2, 2]]}
    ),
    "an address": lambda c: c["images"][0].update(file_name="1.jpg?X-Amz-Signature=0a/1"),
    "no size": lambda c: c["images"][0].update(width=None, height=None),
    "size 0": lambda c: c["images"][0].update(width=0, height=0),
    "size in floats": lambda c: c["images"][0].update(width=12.0, height=8.0),
}


@pytest.mark.parametrize("name", ODD)
def test_coco_as_tools_write_it(name):
    content = coco(segmentation=[POLYGON])
    ODD[name](content)
    images = coco_images(copy.deepcopy(content))
    np.testing.assert_array_equal(images["1.jpg"].read(SIZE, None), BOX)


def test_coco_that_says_nothing_clear():
    for change, words in (
        (lambda c: c["categories"].append({"id": "2", "name": "b"}), "the category id 2 is listed twice"),
        (lambda c: c["images"].append({"id": "5", "file_name": "2.jpg"}), "the images 1.jpg and 2.jpg have one id"),
        (lambda c: c["annotations"][0].update(segmentation=[[1, 1, 2, 2]]), "fewer than three corners"),
        (lambda c: c["annotations"][0].update(segmentation=[POLYGON, [1, 2, 3]]), "odd length"),
        (lambda c: c["images"][0].update(width=8, height=12), "the sides are swapped"),
    ):
        content = coco(segmentation=[POLYGON])
        change(content)
        with pytest.raises(ValueError, match=words):
            coco_images(content)["1.jpg"].read(SIZE, None)


# ---- labelme ----


def shapes(*items):
    content = labelme()
    base = content["shapes"][0]
    content["shapes"] = [
        base | {"label": label, "points": points, "shape_type": (kind or ["polygon"])[0]}
        for label, points, *kind in items
    ]
    return content


@pytest.mark.parametrize("hole", ["_background_", "background", "__ignore__"])
def test_a_hole_is_cut(hole):
    np.testing.assert_array_equal(read_labelme(shapes(("glass", CORNERS), (hole, HOLE)), SIZE, None), HOLED)


def test_what_lies_in_front_cuts_and_what_lies_behind_does_not():
    front, behind = ("hand", HOLE), ("table", [[0, 0], [12, 0], [12, 8], [0, 8]])
    content = shapes(behind, ("glass", CORNERS), front)
    np.testing.assert_array_equal(read_labelme(content, SIZE, "glass"), HOLED)
    content = shapes(("glass", CORNERS), front, ("glass", HOLE))  # and the glass once more, in front of the hand
    np.testing.assert_array_equal(read_labelme(content, SIZE, "glass"), BOX)
    content = shapes(("glass", CORNERS), ("edge", HOLE[:2], "line"), ("dot", HOLE[:1], "point"))
    np.testing.assert_array_equal(read_labelme(content, SIZE, "glass"), BOX)


@pytest.mark.parametrize(
    "kind", ["rotation", "quadrilateral", "oriented_rectangle", "oriented rectangle", "rectangle"]
)
def test_four_corners_are_a_polygon(kind):
    corners = turned(3, 2, 6, 4, 30)
    expected = polygon_mask(corners, SIZE)
    np.testing.assert_array_equal(read_labelme(labelme(corners, kind), SIZE, None), expected)
    with pytest.raises(ValueError, match=f"a shape of type '{kind}' with 3 points has no area"):
        read_labelme(labelme(corners[:3], kind), SIZE, None)


def test_a_click_beside_shapes_is_passed_over():
    for leftover in (("glass", [[1, 1]], "point"), ("glass", [[1, 1], [2, 2]])):
        np.testing.assert_array_equal(read_labelme(shapes(leftover, ("glass", CORNERS)), SIZE, None), BOX)
        with pytest.raises(ValueError, match="has no area"):
            read_labelme(shapes(leftover), SIZE, None)
    with pytest.raises(ValueError, match=r"type 'linestrip' .* has no area"):  # an outline that was never closed
        read_labelme(shapes(("glass", CORNERS), ("glass", HOLE, "linestrip")), SIZE, None)


# ---- Label Studio ----

GLASS = region(points=percent(CORNERS))


@pytest.mark.parametrize(
    "image, name",
    [
        ("https://host/bucket/1.jpg?X-Amz-Signature=ab%2Fc&se=2", "bucket/1.jpg"),
        ("s3://bucket/train/scene/1.jpg?versionId=3", "train/scene/1.jpg"),
        ("/data/local-files/?d=train/scene/1.jpg", "train/scene/1.jpg"),
        ("/data/upload/3/0a1b2c3d-1.jpg", "0a1b2c3d-1.jpg"),
        ("https://host/a%20b%3F.jpg?x=1", "a b?.jpg"),
    ],
)
def test_addresses_of_images(image, name):
    assert list(label_studio_images(tasks(GLASS, image=image))) == [name]


def test_a_leftover_keypoint_is_passed_over():
    dot = region("keypointlabels", x=1, y=2, width=0.5)
    record = label_studio_images(tasks(dot, GLASS))["0a1b2c3d-1.jpg"]
    np.testing.assert_array_equal(record.read(SIZE, None), BOX)
    with pytest.raises(ValueError, match="'keypointlabels' has no area"):
        label_studio_images(tasks(dot))["0a1b2c3d-1.jpg"].read(SIZE, None)


def test_labels_apart_from_the_shape():
    """<Labels> and <Rectangle>: the shape comes twice under one id, once without the label."""
    shape = {"x": 25, "y": 25, "width": 50, "height": 50}
    label = region("labels", **shape) | {"id": "a"}
    bare = region("labels", **shape) | {"id": "a", "type": "rectangle", "value": shape}
    record = label_studio_images(tasks(bare, label))["0a1b2c3d-1.jpg"]
    np.testing.assert_array_equal(record.read(SIZE, None), BOX)


def test_who_has_labeled():
    def task(**changes):
        return next(iter(label_studio_images([tasks()[0] | changes]).values()))

    assert not task(annotations=[]).annotated and not task(annotations=None, predictions=[{"result": []}]).annotated
    assert task().annotated  # submitted without a region
    assert task(annotations=[{"was_cancelled": True, "result": []}]).annotated  # skipped
    assert task(annotations=[], cancelled_annotations=1).annotated  # the same in newer exports
