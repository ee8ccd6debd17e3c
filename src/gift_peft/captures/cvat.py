"""CVAT's *Segmentation mask* export: pictures in the colors of labels, which `labelmap.txt` names."""

from pathlib import Path

import numpy as np
from PIL import Image

from gift_peft.captures.labels import MaskClass, choose_labels
from gift_peft.images import SINGLE_CHANNEL


def labelmap_path(picture: Path) -> Path | None:
    """The list of labels and colors, beside the picture or its folder."""
    return next(
        (folder / "labelmap.txt" for folder in picture.parents[:2] if (folder / "labelmap.txt").is_file()), None
    )


def read_colors(image: Image.Image, path: Path, labelmap: Path, mask_class: MaskClass) -> np.ndarray:
    """(H, W) bool target of a picture in the colors of `labelmap`: lines `label:r,g,b:parts:actions`; "background" is
    no target. ValueError for another file, and for colors that it does not name.
    """
    colors: dict[str, tuple[int, ...]] = {}
    try:
        for line in labelmap.read_text(encoding="utf-8-sig").splitlines():
            if line.strip() and not line.startswith("#"):
                label, color = line.split(":")[:2]
                colors[label] = tuple(int(value) for value in color.split(","))
    except (OSError, ValueError):
        raise ValueError(f"{labelmap}: not CVAT's labelmap.txt (lines `label:r,g,b:parts:actions`)") from None
    if image.mode in SINGLE_CHANNEL and image.mode != "P":  # the color's index is the label's line
        values = np.asarray(image).astype(np.int64)
        codes = dict(zip(colors, range(len(colors)), strict=True))
    else:
        values = np.asarray(image.convert("RGB")).astype(np.int64) @ (65536, 256, 1)
        codes = {label: int(np.dot(color, (65536, 256, 1))) for label, color in colors.items() if len(color) == 3}
    unknown = np.setdiff1d(np.unique(values), list(codes.values()))
    if len(unknown):
        raise ValueError(f"{path}: {len(unknown)} colours that {labelmap} does not name")
    labels = {label: (index,) for index, label in enumerate(codes) if label.casefold() != "background"}
    chosen = choose_labels(labels, mask_class, f"labels of {labelmap}")
    return np.isin(values, [codes[label] for label in chosen])
