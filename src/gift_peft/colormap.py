"""Depth as viridis, errors as magma: uniform to the eye and readable by colour-blind people; OpenCV's own tables.

Near is bright in every picture of depth, of inverse depth too; wrong is bright in an error map.
"""

import cv2
import numpy as np

GREY = (128, 128, 128)


def colorize(values: np.ndarray, low: float, high: float, kind: str) -> np.ndarray:
    """(H,W) values to (H,W,3) uint8 RGB; `low`..`high` spans the map, what is not finite becomes grey.

    Args:
        kind (`str`): `depth` (small is near) or `inverse_depth` (large is near).
    """
    share = (np.where(np.isfinite(values), values, low) - low) / (high - low if high > low else 1)
    return _paint(share if kind == "inverse_depth" else 1 - share, np.isfinite(values), cv2.COLORMAP_VIRIDIS)


def colorize_error(values: np.ndarray, high: float) -> np.ndarray:
    """(H,W) absolute errors to (H,W,3) uint8 RGB; 0..`high` spans the map, what is not finite becomes grey."""
    share = np.where(np.isfinite(values), values, 0) / (high if high > 0 else 1)
    return _paint(share, np.isfinite(values), cv2.COLORMAP_MAGMA)


def _paint(share: np.ndarray, finite: np.ndarray, table: int) -> np.ndarray:
    picture = cv2.applyColorMap(np.rint(np.clip(share, 0, 1) * 255).astype(np.uint8), table)[..., ::-1].copy()
    picture[~finite] = GREY
    return picture


def color_range(*arrays: np.ndarray, percentiles: tuple[float, float] = (1, 99)) -> tuple[float, float]:
    """One range for several arrays, so that their colours can be compared; outliers do not set it."""
    values = np.concatenate([array[np.isfinite(array)] for array in arrays])
    if not values.size:
        return 0.0, 1.0
    low, high = np.percentile(values, percentiles)
    return float(low), float(high)
