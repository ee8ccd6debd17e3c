"""What a depth camera would say of a rendered scene: holes, what lies behind the glass, noise, steps of disparity."""

import cv2
import numpy as np


def simulate_sensor(depth: np.ndarray, mask: np.ndarray, seed: int = 0) -> np.ndarray:
    """Depth (H,W) in mm, 0 where there is none, of a stereo camera before a true depth (H,W) in mm.

    Noise grows with the square of the depth and disparity comes in steps of a thirty-second of a pixel. Of the target
    a part is a hole and the rest a room behind it (a slanted plane 0.3 to 2 m farther away). Edges, and some blobs
    elsewhere, are holes.
    """
    random = np.random.default_rng(seed)
    depth = depth.astype(np.float64)
    height, width = depth.shape
    row, column = np.mgrid[:height, :width] / max(height, width)
    slope = random.uniform(-300, 300, 2)
    behind = depth + random.uniform(300, 2000) + slope[0] * (row - row.mean()) + slope[1] * (column - column.mean())
    seen = np.where(mask, np.maximum(behind, depth + 50), depth)
    noisy = seen * (1 + 0.0015 * seen / 1000 * random.standard_normal(depth.shape))
    factor = 32_000.0  # focal length in pixels times baseline in mm
    disparity = np.round(32 * factor / np.maximum(noisy, 1)) / 32
    reading = factor / np.maximum(disparity, 1 / 32)

    def blobs(share):
        noise = cv2.GaussianBlur(random.standard_normal(depth.shape), (0, 0), max(height, width) / 25)
        return noise > np.quantile(noise, 1 - share)

    steep = cv2.morphologyEx(depth, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0.06 * depth
    holes = steep | blobs(0.05) | (mask & blobs(0.5)) | (depth <= 0)
    return np.where(holes, 0, np.clip(reading, 0, 65535)).astype(np.uint16)
