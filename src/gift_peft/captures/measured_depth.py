"""Measured depth that comes with published data: an OpenEXR picture in metres, or a 16-bit PNG in millimetres."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from gift_peft.files import reason
from gift_peft.images import open_image

EXR_HINT = "pip install 'gift-peft[exr]' reads OpenEXR"


def read_measured_depth(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) uint16 z-depth in millimetres, 0 where unknown: not finite, not positive, or farther than 65 m.

    Raises ValueError naming the file: unreadable, not of `shape` (H, W), or an OpenEXR file without its extra.
    """
    if path.suffix.lower() == ".exr":
        millimetres = 1000.0 * _read_exr(path).astype(np.float64)
    else:
        image = open_image(path)
        if not image.mode.startswith("I"):
            raise ValueError(f"{path}: mode {image.mode}; depth is a 16-bit PNG in millimetres, or OpenEXR in metres")
        millimetres = np.asarray(image).astype(np.float64)
    if millimetres.shape != shape:
        raise ValueError(
            f"{path}: depth of {millimetres.shape[0]}x{millimetres.shape[1]} (height x width) beside a photo of "
            f"{shape[0]}x{shape[1]}"
        )
    known = np.isfinite(millimetres) & (millimetres > 0) & (millimetres < 65535.5)
    return np.round(np.where(known, millimetres, 0)).astype(np.uint16)


def _read_exr(path: Path) -> np.ndarray:
    """(H, W) float; of several channels, which hold the same, the first."""
    if find_spec("OpenEXR") is None:
        raise ValueError(f"{path}: {EXR_HINT}")
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            name = next((name for name in ("R", "Y", "Z") if name in channels), next(iter(channels)))
            return np.array(channels[name].pixels)
    except (OSError, RuntimeError, ValueError, StopIteration, TypeError) as error:
        raise ValueError(f"{path}: not a readable OpenEXR picture ({reason(error)})") from None
