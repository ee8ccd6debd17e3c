"""Label Studio's own JSON export, one file for many images: brush, polygon, rectangle and ellipse.

A task that nobody opened says nothing about its image. One that was skipped, or submitted without a region, says that
there is no target in it.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from gift_peft.captures.labels import (
    MaskClass,
    checked_label,
    choose_labels,
    dicts,
    relative_name,
    without_query,
)
from gift_peft.captures.shapes import NoArea, ellipse_points, polygon_mask, rectangle_points, union
from gift_peft.images import is_image_file

NOT_REGIONS = ("choices", "textarea", "rating", "number", "taxonomy", "relation")  # answers about the whole image
UPLOAD_FOLDER = re.compile(r"^/?data/upload/(\d+/)?")  # of its own server, whatever the user's folders are


@dataclass(frozen=True)
class LabelStudioImage:
    """What an export says of one image.

    Args:
        regions (`list[tuple[str, dict]]`): label and region.
        labels (`dict[str, tuple]`): all of the file.
        annotated (`bool`): somebody labeled, submitted or skipped it.
    """

    regions: list[tuple[str, dict]]
    labels: dict[str, tuple]
    annotated: bool

    def read(self, size: tuple[int, int], mask_class: MaskClass) -> np.ndarray:
        """(H, W) bool target of an image of `size` (width, height); ValueError for anything wrong."""
        chosen = choose_labels(self.labels, mask_class, "labels") if self.labels else []
        return union(label_studio_mask, [region for label, region in self.regions if label in chosen], size)


def label_studio_images(content: list) -> dict[str, LabelStudioImage]:
    """What Label Studio's own JSON says of each image, by its name.

    Raises ValueError for two annotations of one image, missing labels, and a file of nothing but predictions.
    """
    images: dict[str, LabelStudioImage] = {}
    labels: dict[str, tuple] = {}
    if any(map(_is_predicted, content)) and not any(task.get("annotations") for task in content):
        raise ValueError("it holds predictions only, which nobody has submitted as annotations in Label Studio")
    for task in content:
        name = _task_image(task)
        if name in images:
            raise ValueError(f"the image {name} has two tasks")
        all_of_it = dicts(task.get("annotations") or [], "annotations")
        done = [item for item in all_of_it if not item.get("was_cancelled")]
        if len(done) > 1:
            raise ValueError(f"the image {name} has {len(done)} annotations; keep one")
        skipped = bool(all_of_it) or bool(task.get("cancelled_annotations"))  # newer exports only count them
        regions = list(_regions(dicts(done[0].get("result") or [], "results"))) if done else []
        labels |= {label: () for label, _ in regions}
        images[name] = LabelStudioImage(regions, labels, skipped)
    return images


def label_studio_mask(result: dict, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of one region of Label Studio's own JSON: brush, polygon, rectangle or ellipse.

    Raises ValueError for other regions (`NoArea`), for another image size and for a rotated view.
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
        if str(result.get("type")).startswith("keypoint"):  # its `width` is the size of the dot on the screen
            raise KeyError
        return polygon_mask(rectangle_points(value["x"] * across, value["y"] * down, *sides, turn), size)
    except (KeyError, IndexError, TypeError):
        raise NoArea(f"a region of type {result.get('type')!r} has no area; use brush or polygon") from None


def _is_predicted(task: dict) -> bool:
    """Whether a model drew something; newer exports only name the prediction by its number."""
    given = task.get("predictions")
    return isinstance(given, list) and any(not isinstance(one, dict) or one.get("result") for one in given)


def _task_image(task: dict) -> str:
    data = task["data"] if isinstance(task["data"], dict) else {}
    for value in [*data.values(), task.get("file_upload")]:
        if not isinstance(value, str):
            continue
        stored = unquote(value.rpartition("?d=")[2] if "?d=" in value else without_query(value))
        if is_image_file(Path(stored)):
            address = re.sub(r"^\w+://[^/]*", "", stored)  # an address, not a path
            return relative_name(UPLOAD_FOLDER.sub("", address).lstrip("/"))
    raise ValueError(f"task {task.get('id')} names no image file")


def _regions(results: list[dict]) -> Iterator[tuple[str, dict]]:
    """Label and region of everything that was drawn. Where labels stand apart from the shape (<Labels> and
    <Rectangle>), the shape comes twice under one id, once without its label.
    """
    labeled = {result.get("id") for result in results if _own_label(result) is not None} - {None}
    for result in results:
        if result.get("type") in NOT_REGIONS:
            continue
        label = _own_label(result)
        if label is None and result.get("id") in labeled:
            continue
        yield checked_label(label), result


def _own_label(result: dict) -> str | None:
    kind, value = result.get("type"), result.get("value")
    given = value.get(kind) if isinstance(value, dict) and isinstance(kind, str) else None
    return given[0] if isinstance(given, list) and given else None


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
