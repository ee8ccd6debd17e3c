"""One box as a mask, and the same box in the form of every annotation tool."""

import numpy as np

SIZE = (12, 8)  # width, height
BOX = np.zeros(SIZE[::-1], bool)
BOX[2:6, 3:9] = True
CORNERS = [[3, 2], [9, 2], [9, 6], [3, 6]]
POLYGON = [3, 2, 9, 2, 9, 6, 3, 6]


def picture(mask=BOX) -> np.ndarray:
    return mask.astype(np.uint8) * 255


def labelme(points=CORNERS, kind="polygon", label="glass", **more) -> dict:
    shape = {"label": label, "points": points, "shape_type": kind, "group_id": None, "flags": {}}
    return {
        "version": "5.4.1",
        "imagePath": "1.jpg",
        "imageData": "aGVsbG8=",
        "imageWidth": SIZE[0],
        "imageHeight": SIZE[1],
        "shapes": [shape],
        **more,
    }


def coco(name="1.jpg", segmentation=None, **annotation) -> dict:
    return {
        "images": [{"id": 5, "file_name": name, "width": SIZE[0], "height": SIZE[1]}],
        "categories": [{"id": 1, "name": "table"}, {"id": 2, "name": "glass"}],
        "annotations": [
            {"id": 1, "image_id": 5, "category_id": 2, "bbox": [3, 2, 6, 4], "segmentation": segmentation or []}
            | annotation
        ],
    }


def tasks(*results, image="/data/upload/3/0a1b2c3d-1.jpg", **task) -> list:
    return [{"id": 7, "data": {"image": image}, "annotations": [{"result": list(results)}], **task}]


def run_lengths(mask: np.ndarray) -> list[int]:
    """COCO's counts: column by column, background first."""
    counts, value, length = [], False, 0
    for pixel in mask.T.ravel():
        if pixel != value:
            counts.append(length)
            value, length = pixel, 0
        length += 1
    return [*counts, length]


def compressed(counts: list[int]) -> str:
    """The text that COCO stores such counts as."""
    text = ""
    for index, count in enumerate(counts):
        number = count - counts[index - 2] if index > 2 else count
        while True:
            low, number = number & 31, number >> 5
            more = number != (-1 if low & 16 else 0)
            text += chr(48 + low + 32 * more)
            if not more:
                break
    return text


def packed(values: np.ndarray, runs: bool) -> list[int]:
    """Label Studio's brush stream, either one long run a stretch of equal values, or singles only."""
    bits = f"{len(values):032b}{7:05b}" + "".join(f"{size - 1:04b}" for size in (2, 4, 8, 16))
    place = 0
    while place < len(values):
        end = place + 1
        while end < len(values) and end - place < 300 and (not runs or values[end] == values[place]):
            end += 1
        bits += f"{int(runs)}11{end - place - 1:016b}"
        bits += "".join(f"{value:08b}" for value in (values[place : place + 1] if runs else values[place:end]))
        place = end
    bits += "0" * (-len(bits) % 8)
    return [int(bits[start : start + 8], 2) for start in range(0, len(bits), 8)]


def region(kind="polygonlabels", label="glass", **value) -> dict:
    return {"type": kind, "original_width": SIZE[0], "original_height": SIZE[1], "value": {kind: [label], **value}}


def percent(points):
    return [[100 * x / SIZE[0], 100 * y / SIZE[1]] for x, y in points]
