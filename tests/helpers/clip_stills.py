"""Pictures of one pose with other contents of the target, for clips: the embedded rendered groups, and real photos."""

from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from gift_peft.dataset.gift_i import load_gift_i

SHARED = Path(__file__).parents[3] / "shared" / "data"


def rendered_stills(size: tuple[int, int], most: int = 12) -> list[tuple[list[np.ndarray], np.ndarray]]:
    """(pictures (H, W, 3), mask (H, W) bool) of embedded groups, at (height, width)."""
    found = []
    for split in ("train", "validation"):
        rows = load_gift_i(str(files("gift_peft") / "demo" / "gift-i"), split)
        for row in rows.select(range(min(most, len(rows)))):
            pictures = [at_size(np.asarray(image), size) for image in row["images"]]
            masks = [at_size(np.asarray(mask), size) > 127 for mask in row["masks"]]
            found.append((pictures, np.any(masks, axis=0)))
    return found


def real_stills(size: tuple[int, int]) -> list[tuple[list[np.ndarray], np.ndarray]]:
    """The same of real photos that are not part of the project, other photos in the glass; [] where they are not."""
    pairs = [(folder / "transparent.jpg", folder / "mask.png") for folder in sorted(SHARED.glob("cleargrasp_d435/0*"))]
    photos = [at_size(np.asarray(Image.open(photo)), size) for photo, _ in pairs]
    photos += [at_size(np.asarray(Image.open(path)), size) for path in sorted(SHARED.glob("middlebury*/*.png"))]
    found = []
    for index, (_, mask) in enumerate(pairs):
        inside = at_size(np.asarray(Image.open(mask).convert("L")), size) > 127
        inside = cv2.dilate(inside.astype(np.uint8), np.ones((round(size[0] / 18),) * 2)) > 0
        for turn in range(6):
            others = [np.roll(photo[:, ::-1], size[1] // 8 * turn, axis=1) for photo in photos]
            found.append(([np.where(inside[..., None], other, photos[index]) for other in others], inside))
    return found


def at_size(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Scaled and cropped, (H, W, 3) or (H, W), to (height, width)."""
    scale = max(size[0] / picture.shape[0], size[1] / picture.shape[1])
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    large = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=method)
    return large[: size[0], : size[1]]


def distinct(pictures: list[np.ndarray], mask: np.ndarray, rng: np.random.Generator, most: int) -> list[np.ndarray]:
    """In random order, float32, those that clearly differ inside the mask from all before."""
    size = max(1, mask.shape[0] // 4), max(1, mask.shape[1] // 4)
    small = [at_size(picture, size).astype(np.int16) for picture in pictures]
    inside = at_size(mask.astype(np.uint8) * 255, size) > 127
    chosen: list[int] = []
    for index in rng.permutation(len(pictures)):
        if all((np.abs(small[index] - small[other]).max(axis=2)[inside] > 12).mean() > 0.1 for other in chosen):
            chosen.append(int(index))
    return [pictures[index].astype(np.float32) for index in chosen[:most]]
