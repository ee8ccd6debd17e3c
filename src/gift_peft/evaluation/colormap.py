"""Depth as colour: viridis, perceptually uniform and readable by colour-blind people, from OpenCV's own table.

Near is bright in every picture, whether the values are depth or inverse depth.
"""

import cv2
import numpy as np

GREY = (128, 128, 128)


def colorize(values: np.ndarray, low: float, high: float, kind: str) -> np.ndarray:
    """(H,W) values to (H,W,3) uint8 RGB; `low`..`high` spans the map, what is not finite becomes grey.

    Args:
        kind (`str`): `depth` (small is near) or `inverse_depth` (large is near).
    """
    finite = np.isfinite(values)
    share = (np.where(finite, values, low) - low) / (high - low if high > low else 1)
    share = np.clip(share if kind == "inverse_depth" else 1 - share, 0, 1)
    picture = cv2.applyColorMap(np.rint(share * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    picture[~finite] = GREY
    return picture


def color_range(*arrays: np.ndarray, percentiles: tuple[float, float] = (1, 99)) -> tuple[float, float]:
    """One range for several arrays, so that their colours can be compared; outliers do not set it."""
    values = np.concatenate([array[np.isfinite(array)] for array in arrays])
    if not values.size:
        return 0.0, 1.0
    low, high = np.percentile(values, percentiles)
    return float(low), float(high)
