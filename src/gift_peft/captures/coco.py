"""COCO's JSON, one file for many images, as CVAT, Label Studio, Roboflow, RectLabel and others write it."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from gift_peft.captures.labels import (
    MaskClass,
    check_size,
    checked_label,
    choose_labels,
    dicts,
    relative_name,
    without_query,
)
from gift_peft.captures.shapes import polygon_mask, rectangle_points, union


@dataclass(frozen=True)
class CocoImage:
    """What a COCO file says of one image.

    Args:
        size (`tuple`): width and height as stated, perhaps None or 0.
        annotations (`list[dict]`): this image's.
        categories (`dict[str, set]`): all names of the file, and their ids.
        used (`set`): ids that some annotation of the file has.
    """

    size: tuple
    annotations: list[dict]
    categories: dict[str, set]
    used: set

    @property
    def annotated(self) -> bool:
        """COCO lists every image of a project, also those that nobody has looked at."""
        return bool(self.annotations)

    def read(self, size: tuple[int, int], mask_class: MaskClass) -> np.ndarray:
        """(H, W) bool target of an image of `size` (width, height); ValueError for anything wrong."""
        check_size("its annotations are for", self.size, size)
        known = {name: ids for name, ids in self.categories.items() if ids & self.used or mask_class is not None}
        names = choose_labels(known, mask_class, "categories") if known else []
        chosen = set().union(*(self.categories[name] for name in names))
        shown = [item for item in self.annotations if _id(item.get("category_id")) in chosen]
        return union(coco_mask, shown, size)


def coco_images(content: dict) -> dict[str, CocoImage]:
    """What a COCO file says of each image, by its relative name.

    Raises ValueError for references to nothing, missing labels, and the panoptic form.
    """
    categories: dict[str, set] = {}
    listed = set()
    for category in dicts(content.get("categories"), "categories"):
        name, number = checked_label(category.get("name")), _id(category.get("id"))
        if number in listed:
            raise ValueError(f"the category id {number!r} is listed twice")
        listed.add(number)
        # Roboflow has a root category above all others, which may have the name of one of them.
        categories.setdefault(name, set()).add(number)
    images, names = {}, {}
    used = set()
    for image in dicts(content["images"], "images"):
        given = image.get("file_name")
        name, number = relative_name(without_query(given) if isinstance(given, str) else given), _id(image.get("id"))
        if name in images:
            raise ValueError(f"the image {name} is listed twice")
        if number in names:
            raise ValueError(f"the images {names[number]} and {name} have one id, {number!r}")
        images[name] = CocoImage((image.get("width"), image.get("height")), [], categories, used)
        names[number] = name
    for annotation in dicts(content["annotations"], "annotations"):
        if "segments_info" in annotation:
            raise ValueError("COCO's panoptic form is not read; export instances (polygons or run lengths)")
        image_id, category_id = _id(annotation.get("image_id")), _id(annotation.get("category_id"))
        if image_id not in names:
            raise ValueError(f"an annotation for image id {image_id!r}, which is not listed")
        if category_id not in listed:
            raise ValueError(f"an annotation of category {category_id!r}, which is not listed")
        used.add(category_id)
        images[names[image_id]].annotations.append(annotation)
    return images


def coco_mask(annotation: dict, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of one COCO annotation: polygons, run lengths (list or compressed string), or the bare box, which
    CVAT turns clockwise about its center by `attributes.rotation` degrees.

    Raises ValueError for anything else; `NoArea` for polygons of fewer than three corners.
    """
    segmentation = annotation.get("segmentation")
    if isinstance(segmentation, dict):
        return _run_lengths(segmentation, size)
    if not segmentation:
        return polygon_mask(_box(annotation), size)
    if isinstance(segmentation, list) and all(_is_number(value) for value in segmentation):
        segmentation = [segmentation]  # RectLabel's and others': a single ring, not in a list
    if not isinstance(segmentation, list) or not all(isinstance(ring, list) for ring in segmentation):
        raise ValueError("a segmentation is neither polygons nor run lengths")
    if _is_box_to_turn(segmentation, annotation):
        raise ValueError("a box with a rotation beside it, whose segmentation is not turned; export it as a polygon")
    return union(_ring_mask, segmentation, size)  # the parts of one object


def _ring_mask(ring: list, size: tuple[int, int]) -> np.ndarray:
    if len(ring) % 2:
        raise ValueError("a polygon's list of x, y, x, y, ... has an odd length")
    return polygon_mask(list(zip(ring[::2], ring[1::2], strict=True)), size)


def _box(annotation: dict) -> np.ndarray:
    box = annotation.get("bbox")
    if isinstance(box, list) and len(box) == 5:
        raise ValueError(
            "a box of five numbers: tools disagree about its angle (degrees or radians, either way round); "
            "export polygons"
        )
    if not isinstance(box, list) or len(box) != 4 or not all(_is_number(side) for side in box):
        raise ValueError("an annotation has neither a segmentation nor a box")
    return rectangle_points(*box, degrees=_rotation(annotation), about_center=True)


def _rotation(annotation: dict) -> float:
    """Degrees clockwise, as CVAT states them, 0 if nothing is stated."""
    attributes = annotation.get("attributes")
    places = [annotation, attributes if isinstance(attributes, dict) else {}]
    for key in ("angle", "theta"):
        if any(place.get(key) not in (None, 0, "0", "") for place in places):
            raise ValueError(f"a box with `{key}`: tools disagree about what it means; export polygons")
    found = set()
    for stated in (place.get("rotation") for place in places):
        try:
            found |= set() if stated is None else {float(stated)}
        except (TypeError, ValueError):
            found.add(math.nan)
    if len(found) > 1 or not all(map(math.isfinite, found)):
        raise ValueError("a box's rotation is not one number of degrees")
    return found.pop() if found else 0.0


def _is_box_to_turn(rings: list[list], annotation: dict) -> bool:
    """Whether the polygon is the box as it was before a rotation that is stated beside it."""
    box = annotation.get("bbox")
    if not isinstance(box, list) or len(box) != 4 or not all(_is_number(side) for side in box):
        return False
    if len(rings) != 1 or len(rings[0]) not in (8, 10) or not all(_is_number(value) for value in rings[0]):
        return False
    corners = {(round(x, 1), round(y, 1)) for x, y in zip(rings[0][::2], rings[0][1::2], strict=True)}
    if corners != {(round(float(x), 1), round(float(y), 1)) for x, y in rectangle_points(*box)}:
        return False
    try:
        return _rotation(annotation) % 180 != 0
    except ValueError:
        return True


def _run_lengths(segmentation: dict, size: tuple[int, int]) -> np.ndarray:
    width, height = size
    counts, stated = segmentation.get("counts"), segmentation.get("size")
    if stated != [height, width]:
        raise ValueError(f"run lengths for size {stated} ([height, width]), but the image is [{height}, {width}]")
    if isinstance(counts, str):
        counts = _uncompress(counts)
    if not isinstance(counts, list) or not all(type(count) is int and count >= 0 for count in counts):
        raise ValueError("run lengths are not whole numbers from 0")
    if sum(counts) != width * height:
        raise ValueError(f"run lengths cover {sum(counts)} pixels, but the image has {width * height}")
    values = np.arange(len(counts)) % 2 == 1
    return np.repeat(values, counts).reshape(width, height).T  # column by column, starting outside


def _uncompress(text: str) -> list[int]:
    """COCO's string form: five bits a character, low ones first; from the fourth on, the change over two runs."""
    counts: list[int] = []
    value = shift = 0
    for character in text:
        code = ord(character) - 48
        if not 0 <= code < 64:
            raise ValueError(f"compressed run lengths hold {character!r}")
        value |= (code & 31) << shift
        shift += 5
        if code & 32:  # more to come
            continue
        if code & 16:
            value -= 1 << shift
        counts.append(value + counts[-2] if len(counts) > 2 else value)
        value = shift = 0
    if shift:
        raise ValueError("compressed run lengths end in the middle of a number")
    return counts


def _id(value: Any) -> int | str:
    """Some tools write an id as a number in one place and as text in another: "7" and 7 are one."""
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise ValueError(f"{value!r} is not the id of an image or a category")
    return int(value) if isinstance(value, str) and value.isdecimal() else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
