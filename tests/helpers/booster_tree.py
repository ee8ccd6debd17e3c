"""Synthetic scenes in Booster's layout, and a straight-line evaluator of them that shares no code with the package."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

CALIBRATION = """<?xml version="1.0"?>
<opencv_storage>
<mtxL type_id="opencv-matrix">
  <rows>3</rows>
  <cols>3</cols>
  <dt>d</dt>
  <data>
    {wrong} 0. 514. 0. {wrong} 376. 0. 0. 1.</data></mtxL>
<proj_matL type_id="opencv-matrix">
  <rows>3</rows>
  <cols>4</cols>
  <dt>d</dt>
  <data>
    {focal} 0. 514. 0. 0. {focal} 376. 0. 0. 0.
    1. 0.</data></proj_matL>
<baselineLR>{baseline}</baselineLR>
</opencv_storage>
"""


def write_scene(folder: Path, seed: int = 0, size=(60, 84), images=2, classes=None) -> dict:
    """One scene; returns `depth` (H,W) in mm (0 unknown), `classes`, `visible` as written."""
    focal, baseline = 900.5 + seed, 63.25
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: size[0], : size[1]]
    depth = 900 + 500 * np.sin(columns / 17 + seed) + 300 * np.cos(rows / 11) + rng.normal(0, 15, size)
    depth[:4, :6] = 15000  # farther than 10 m: dropped
    depth[8:10, :5] = 0.4  # nearer than 1 mm: dropped
    disparity = (focal * baseline / depth).astype(np.float32)
    disparity[rng.random(size) < 0.1] = 0
    if classes is None:
        classes = ((columns // 12 + rows // 12 + seed) % 4).astype(np.uint8)
    visible = rng.random(size) < 0.8
    (folder / "camera_00").mkdir(parents=True)
    np.save(folder / "disp_00.npy", disparity)
    Image.fromarray(classes).save(folder / "mask_cat.png")
    Image.fromarray(visible.astype(np.uint8) * 255).save(folder / "mask_00.png")
    text = CALIBRATION.format(focal=focal, wrong=1.07 * focal, baseline=baseline)
    (folder / "calib_00-02.xml").write_text(text)
    for index in range(images):
        picture = rng.integers(0, 255, (*size, 3), dtype=np.uint8)
        Image.fromarray(picture).save(folder / "camera_00" / f"im{index}.png")
    truth = {"depth": depth, "disparity": disparity, "classes": classes, "visible": visible}
    return truth | {"product": focal * baseline}


def write_root(root: Path, scenes=2, **options) -> dict[str, dict]:
    """`root/train/balanced/Scene<i>`."""
    names = [f"Scene{index}" for index in range(scenes)]
    return {name: write_scene(root / "train" / "balanced" / name, seed, **options) for seed, name in enumerate(names)}


def write_predictions(folder: Path, truths: dict[str, dict], images=2, noise=0.1, size=None, seed=0) -> dict:
    """Disparity with noise, an own scale and shift per image, and some pixels far below zero; float32 npy."""
    rng = np.random.default_rng(seed)
    maps = {}
    for name, truth in truths.items():
        (folder / name / "camera_00").mkdir(parents=True)
        for index in range(images):
            inverse = 1 / np.clip(truth["depth"], 200, 5000)
            inverse = inverse * (1 + noise * rng.normal(size=inverse.shape)) + (truth["classes"] >= 2) * 2e-4
            inverse[rng.random(inverse.shape) < 0.01] = -5e-4
            if size is not None:
                inverse = cv2.resize(inverse, size[::-1], interpolation=cv2.INTER_AREA)
            values = (inverse * rng.uniform(100, 5000) + rng.uniform(-2, 2)).astype(np.float32)
            np.save(folder / name / "camera_00" / f"im{index}.npy", values)
            maps[name, index] = values
    return maps


# ---- Depth4ToM's evaluator, step by step ----


def depth4tom_by_hand(truths: dict[str, dict], maps: dict, resize: float) -> dict:
    """{region: {metric}} from the published description, in float64, pixel lists and numpy's SVD solver."""
    collected = {region: [] for region in ("all", "tom", "other")}
    for (name, _), prediction in maps.items():
        truth = truths[name]
        disparity = nearest(truth["disparity"], resize).astype(np.float64) * resize
        product = truth["product"] * resize
        classes = nearest(truth["classes"], resize)
        prediction = bilinear(prediction.astype(np.float64), disparity.shape)
        usable = (disparity > 0) & (disparity <= product / 1) & (disparity >= product / 10000)
        design = np.stack([prediction[usable], np.ones(usable.sum())], axis=1)
        scale, shift = np.linalg.lstsq(design, disparity[usable], rcond=None)[0]
        regions = {"all": usable, "tom": usable & (classes >= 2), "other": usable & (classes <= 1)}
        for region, mask in regions.items():
            pairs = []
            for value, gt in zip(prediction[mask], disparity[mask], strict=True):
                aligned = scale * value + shift
                depth = product / aligned if aligned != 0 else 10000.0
                pairs.append((1.0 if depth < 1 else min(depth, 10000.0), product / gt))
            if pairs:
                collected[region].append(metrics_by_hand(pairs))
    return {
        region: {metric: float(np.mean([image[metric] for image in images])) for metric in images[0]}
        for region, images in collected.items()
    }


def metrics_by_hand(pairs: list[tuple[float, float]]) -> dict:
    count = len(pairs)
    return {
        "mae": sum(abs(d - y) for d, y in pairs) / count,
        "abs_rel": sum(abs(d - y) / y for d, y in pairs) / count,
        "rmse": (sum((d - y) ** 2 for d, y in pairs) / count) ** 0.5,
        "delta1": 100 * sum(max(d / y, y / d) < 1.25 for d, y in pairs) / count,
    }


def nearest(array: np.ndarray, resize: float) -> np.ndarray:
    """Every (1/resize)-th row and column, the first included."""
    rows, columns = (np.floor(np.arange(round(side * resize)) / resize).astype(int) for side in array.shape)
    return array[rows][:, columns]


def bilinear(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Pixel centres, no corner alignment, no smoothing, clamped at the border."""
    axes = []
    for old, new in zip(image.shape, size, strict=True):
        position = np.clip((np.arange(new) + 0.5) * old / new - 0.5, 0, old - 1)
        low = np.floor(position).astype(int)
        axes.append((low, np.minimum(low + 1, old - 1), position - low))
    (top, bottom, v), (left, right, u) = axes
    upper = image[top][:, left] * (1 - u) + image[top][:, right] * u
    lower = image[bottom][:, left] * (1 - u) + image[bottom][:, right] * u
    return upper * (1 - v)[:, None] + lower * v[:, None]
