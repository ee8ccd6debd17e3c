"""What the data tests share: the groups of a raw tree as records, masks as files, messages of one line."""

import numpy as np
from PIL import Image


def records(raw):
    """The groups of a raw tree, as `write_gift_i` takes them."""
    for split in ("train", "validation"):
        for index, folder in enumerate(sorted((raw / split).iterdir())):
            images = sorted(path for path in folder.glob("*.png") if path.stem != "reference")
            size = Image.open(images[0]).size[::-1]
            depth = np.arange(size[0] * size[1], dtype=np.uint16).reshape(size) + 60000 % 65535
            reference = folder / "reference.png"
            yield {
                "split": split,
                "group_id": folder.name,
                "surface": ["mirror", None, "transparent"][index],
                "image_names": [path.name for path in images],
                "images": images,
                "masks": [folder / "masks" / path.name for path in images],
                "valids": [np.ones(size, bool) for _ in images] if index else [],
                "depths": [depth for _ in images] if split == "validation" else [],
                "reference": reference if reference.exists() else None,
            }


def one_line(excinfo, *words):
    message = str(excinfo.value)
    assert "\n" not in message
    for word in words:
        assert str(word) in message, message


def save_mask(path, array):
    Image.fromarray(np.asarray(array, np.uint8)).save(path)
