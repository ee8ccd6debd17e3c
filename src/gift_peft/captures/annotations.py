"""Shapes and run lengths to pixels: what annotation tools write, as (H, W) bool arrays.

A pixel belongs to a shape if its centre does (even-odd rule), so shapes that share an edge share no pixel and none is
left out between them. Every size is checked against the image's before anything is allocated.
"""

import base64
import binascii
import math
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np

from gift_peft.images import is_image_file, open_image

MaskClass = int | str | Sequence[int | str] | None

NO_AREA = ("choices", "textarea", "rating", "number", "taxonomy", "relation")  # Label Studio's answers about an image


def polygon_mask(points: Sequence[Sequence[float]], size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool from polygon corners (x, y) in pixels, where pixel (row, column) covers x in [column, column + 1].

    `size` is (width, height); what lies outside is cut off. ValueError for fewer than three corners or a coordinate
    that is not a finite number.
    """
    width, height = size
    try:
        corners = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        raise ValueError("a polygon's corners are not pairs of numbers") from None
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise ValueError("a polygon has fewer than three corners (x, y)")
    if not (np.abs(corners) < 1e9).all():  # NaN as well
        raise ValueError("a polygon's corner is not a number within reason")
    # Each edge flips everything to its right in the rows whose centres it crosses; what is flipped an odd number of
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


def rectangle_points(x: float, y: float, width: float, height: float, degrees: float = 0.0) -> np.ndarray:
    """(4, 2) corners of a rectangle turned clockwise about its corner (x, y)."""
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
    return corners @ _turn(degrees) + (x, y)


def ellipse_points(x: float, y: float, radius_x: float, radius_y: float, degrees: float = 0.0) -> np.ndarray:
    """(360, 2) corners of an ellipse about (x, y), turned clockwise about its centre."""
    angle = np.arange(360) * (math.pi / 180)
    return np.stack([radius_x * np.cos(angle), radius_y * np.sin(angle)], axis=1) @ _turn(degrees) + (x, y)


def _turn(degrees: float) -> np.ndarray:
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cosine, sine], [-sine, cosine]])  # rows are points; y points down


# ---- COCO ----


def coco_mask(annotation: dict, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of one COCO annotation: polygons, run lengths (list or compressed string), or the bare box.

    Raises ValueError for anything else.
    """
    segmentation = annotation.get("segmentation")
    if isinstance(segmentation, dict):
        return _coco_rle(segmentation, size)
    if segmentation:
        if not isinstance(segmentation, list) or not all(isinstance(ring, list) for ring in segmentation):
            raise ValueError("a segmentation is neither polygons nor run lengths")
        mask = np.zeros(size[::-1], bool)
        for ring in segmentation:  # the parts of one object: their union
            if len(ring) % 2:
                raise ValueError("a polygon's list of x, y, x, y, ... has an odd length")
            mask |= polygon_mask(list(zip(ring[::2], ring[1::2], strict=True)), size)
        return mask
    box = annotation.get("bbox")
    if not isinstance(box, list) or len(box) != 4 or not all(isinstance(side, int | float) for side in box):
        raise ValueError("an annotation has neither a segmentation nor a box")
    return polygon_mask(rectangle_points(*box), size)


def _coco_rle(segmentation: dict, size: tuple[int, int]) -> np.ndarray:
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


# ---- labelme ----


def labelme_mask(shape: dict, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of one labelme shape: polygon, rectangle, circle, or a mask stored within its box.

    Raises ValueError for shapes without an area and for malformed ones.
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
    if kind in ("polygon", "rectangle", "rotation") and len(corners) >= 3:
        return polygon_mask(corners, size)
    raise ValueError(f"a shape of type {kind!r} with {len(corners)} points has no area; draw a polygon")


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


# ---- Label Studio ----


def label_studio_mask(result: dict, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of one region of Label Studio's own JSON: brush, polygon, rectangle or ellipse.

    Raises ValueError for other regions, for another image size and for a rotated view.
    """
    width, height = size
    stated = result.get("original_width"), result.get("original_height")
    if stated != tuple(size):
        raise ValueError(f"a region for an image of {stated[0]}x{stated[1]}, but this one is {width}x{height} pixels")
    if result.get("image_rotation"):
        raise ValueError("the image was rotated in Label Studio; draw on it as it is")
    value = result.get("value")
    if not isinstance(value, dict):
        raise ValueError("a region without a value")
    if "rle" in value:
        # Four channels of equal bytes, or only the last one set: it holds the mask.
        return _unpack(value["rle"], width * height * 4).reshape(height, width, 4)[..., 3] > 127
    try:
        across, down = width / 100, height / 100  # everything else is in percent
        turn = float(value.get("rotation", 0))
        if "points" in value:
            return polygon_mask([(point[0] * across, point[1] * down) for point in value["points"]], size)
        if "radiusX" in value:
            radii = value["radiusX"] * across, value["radiusY"] * down
            return polygon_mask(ellipse_points(value["x"] * across, value["y"] * down, *radii, turn), size)
        sides = value["width"] * across, value["height"] * down
        return polygon_mask(rectangle_points(value["x"] * across, value["y"] * down, *sides, turn), size)
    except (KeyError, IndexError, TypeError):
        raise ValueError(f"a region of type {result.get('type')!r} has no area; use brush or polygon") from None


def _unpack(packed, count: int) -> np.ndarray:
    """Label Studio's brush format, a bit stream: header, then runs of one value or stretches of single values."""
    if not isinstance(packed, list) or not all(type(byte) is int and 0 <= byte < 256 for byte in packed):
        raise ValueError("a brush region's run lengths are not bytes")
    stream = np.unpackbits(np.array(packed, np.uint8))
    bits = f"{int.from_bytes(packed):0{8 * len(packed)}b}"  # the same as text, quicker to read a few from
    place = 0

    def read(number: int) -> int:
        nonlocal place
        if place + number > len(bits):
            raise ValueError("a brush region's run lengths are cut short")
        place += number
        return int(bits[place - number : place], 2)

    stated, word = read(32), read(5) + 1
    if stated != count or word != 8:
        raise ValueError(f"a brush region of {stated} values of {word} bits, not {count} of 8")
    sizes = [read(4) + 1 for _ in range(4)]
    values = np.zeros(count, np.uint8)
    done = 0
    while done < count:
        repeated = read(1)
        length = read(sizes[read(2)]) + 1
        if done + length > count:
            raise ValueError("a brush region's run lengths reach beyond the image")
        if repeated:
            values[done : done + length] = read(8)
        elif place + 8 * length > len(bits):
            raise ValueError("a brush region's run lengths are cut short")
        else:
            values[done : done + length] = np.packbits(stream[place : place + 8 * length])
            place += 8 * length
        done += length
    return values


# ---- whole files: which image, which label ----


def read_labelme(content: dict, size: tuple[int, int], mask_class: MaskClass) -> np.ndarray:
    """(H, W) bool target of an image of `size` (width, height) from labelme's JSON; ValueError for anything wrong."""
    check_size("its shapes are for", (content.get("imageWidth"), content.get("imageHeight")), size)
    shapes = _dicts(content["shapes"], "shapes")
    labels = [_label(shape.get("label")) for shape in shapes]
    chosen = choose_labels(dict.fromkeys(labels), mask_class, "labels") if shapes else []
    mask = np.zeros(size[::-1], bool)
    for label, shape in zip(labels, shapes, strict=True):
        if label in chosen:
            mask |= labelme_mask(shape, size)
    return mask


def read_coco(record: tuple, size: tuple[int, int], mask_class: MaskClass) -> np.ndarray:
    """(H, W) bool target of an image of `size` (width, height) from its record of `coco_images`."""
    image, annotations, categories, used = record
    check_size("its annotations are for", (image.get("width"), image.get("height")), size)
    known = {name: number for name, number in categories.items() if number in used or mask_class is not None}
    chosen = {categories[name] for name in choose_labels(known, mask_class, "categories")} if known else set()
    mask = np.zeros(size[::-1], bool)
    for annotation in annotations:
        if annotation["category_id"] in chosen:
            mask |= coco_mask(annotation, size)
    return mask


def read_label_studio(record: tuple, size: tuple[int, int], mask_class: MaskClass) -> np.ndarray:
    """(H, W) bool target of an image of `size` (width, height) from its record of `label_studio_images`."""
    regions, labels = record
    chosen = choose_labels(labels, mask_class, "labels") if labels else []
    mask = np.zeros(size[::-1], bool)
    for label, region in regions:
        if label in chosen:
            mask |= label_studio_mask(region, size)
    return mask


def coco_images(content: dict) -> dict[str, tuple]:
    """What a COCO file says of each image, by its relative name: (image, its annotations, all categories, used ids).

    Raises ValueError for references to nothing, missing labels, and absolute names or ones with `..`.
    """
    categories = {}
    for category in _dicts(content.get("categories"), "categories"):
        name = _label(category.get("name"))
        if name in categories or not isinstance(category.get("id"), int):
            raise ValueError(f"the category {name} is listed twice, or has no number")
        categories[name] = category["id"]
    images, names = {}, {}
    used = set()
    for image in _dicts(content["images"], "images"):
        name = relative_name(image.get("file_name"))
        if name in images:
            raise ValueError(f"the image {name} is listed twice")
        images[name] = (image, [], categories, used)
        names[_id(image.get("id"))] = name
    for annotation in _dicts(content["annotations"], "annotations"):
        image_id, category_id = _id(annotation.get("image_id")), _id(annotation.get("category_id"))
        if image_id not in names:
            raise ValueError(f"an annotation for image id {image_id!r}, which is not listed")
        if category_id not in categories.values():
            raise ValueError(f"an annotation of category {category_id!r}, which is not listed")
        used.add(category_id)
        images[names[image_id]][1].append(annotation)
    return images


def label_studio_images(content: list) -> dict[str, tuple]:
    """What Label Studio's own JSON says of each image, by its name: ((label, region) pairs, all labels of the file).

    Raises ValueError for two annotations of one image, missing labels, and names with `..`.
    """
    images, labels = {}, {}
    for task in content:
        name = _task_image(task)
        if name in images:
            raise ValueError(f"the image {name} has two tasks")
        done = [item for item in _dicts(task.get("annotations"), "annotations") if not item.get("was_cancelled")]
        if len(done) > 1:
            raise ValueError(f"the image {name} has {len(done)} annotations; keep one")
        regions = []
        for region in _dicts(done[0].get("result"), "results") if done else []:
            kind, value = region.get("type"), region.get("value")
            if kind not in NO_AREA:
                given = value.get(_label(kind)) if isinstance(value, dict) else None
                label = _label(given[0] if isinstance(given, list) and given else None)
                labels[label] = None
                regions.append((label, region))
        images[name] = (regions, labels)
    return images


def _task_image(task: dict) -> str:
    data = task["data"] if isinstance(task["data"], dict) else {}
    for value in [*data.values(), task.get("file_upload")]:
        if isinstance(value, str) and is_image_file(Path(unquote(value))):
            address = unquote(value).rpartition("?d=")[2]
            return relative_name(re.sub(r"^\w+://[^/]*", "", address).lstrip("/"))  # an address, not a path
    raise ValueError(f"task {task.get('id')} names no image file")


def relative_name(name) -> str:
    """An export's image name with forward slashes; ValueError for absolute ones and those that climb out."""
    if not isinstance(name, str) or not name.strip("/\\. "):
        raise ValueError(f"{name!r} is not an image's name")
    path = name.replace("\\", "/")
    if path.startswith(("/", "~")) or re.match(r"[A-Za-z]:", path) or ".." in path.split("/") or "\0" in path:
        raise ValueError(f"{name!r} is an absolute path or climbs with `..`; name images relative to the group")
    return str(PurePosixPath(path))


def check_size(name: str, size: tuple, expected: tuple[int, int]) -> None:
    if size != (None, None) and tuple(size) != tuple(expected):  # some exports do not state it
        raise ValueError(f"{name} {size[1]}x{size[0]} (height x width), but the image is {expected[1]}x{expected[0]}")


def _dicts(items, what: str) -> list[dict]:
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise ValueError(f"its {what} are not a list of objects")
    return items


def _id(value) -> int | str:
    if not isinstance(value, int | str):
        raise ValueError(f"{value!r} is not the id of an image or a category")
    return value


def _label(label) -> str:
    if not isinstance(label, str) or not label:
        raise ValueError("a shape, region or category without a label")
    return label


def split_classes(mask_class: MaskClass) -> tuple[list[int], list[str]]:
    given = [] if mask_class is None else [mask_class] if isinstance(mask_class, int | str) else list(mask_class)
    return [value for value in given if isinstance(value, int)], [value for value in given if isinstance(value, str)]


def choose_labels(known: dict[str, int | None], mask_class: MaskClass, what: str) -> list[str]:
    """The target's among `known` labels (and their numbers): those of `mask_class`, else the only one there is."""
    values, names = split_classes(mask_class)
    if mask_class is None:
        if len(known) > 1:
            raise ValueError(
                f"{len(known)} {what} ({', '.join(known)}); name the target's in group.yaml "
                f"(`mask_class: {next(iter(known))}`)"
            )
        return list(known)
    chosen = [label for label, number in known.items() if label in names or (number is not None and number in values)]
    if not chosen:
        raise ValueError(f"mask_class {mask_class!r} is none of the {what} there ({', '.join(known)})")
    return chosen
