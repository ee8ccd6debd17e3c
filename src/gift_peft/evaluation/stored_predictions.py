"""Depth maps that another program wrote, so that any model can stand in the table.

`<folder>/<Scene>/camera_00/<image stem>` with one of the suffixes below; where an image has several (many programs
write an array and a picture of it), the first in this order is read.
"""

import zlib
from collections.abc import Iterable
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from gift_peft.evaluation.booster_scenes import CAMERA, BoosterScene
from gift_peft.files import reason
from gift_peft.images import open_image

SUFFIXES = (".npy", ".npz", ".pfm", ".png")


class PredictionFolder:
    """Stored predictions of a set of scenes.

    Args:
        folder: the root.
        scale (`float`, *optional*): what the stored numbers are multiplied by, such as 1/256 for a PNG of 256 counts
            per unit; None is 1.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: a scale that is not positive.
    """

    def __init__(self, folder: str | Path, scale: float | None = None) -> None:
        self.folder, self.scale = Path(folder), scale
        if not self.folder.is_dir():
            raise FileNotFoundError(f"predictions {self.folder}: no such folder")
        if scale is not None and not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"prediction_scale {scale}: a positive number")

    def check(self, scenes: Iterable[BoosterScene], needs_scale: bool = False) -> None:
        """Every image has its prediction.

        Raises FileNotFoundError listing those that are missing and, where the protocol `needs_scale` because it fits
        none, ValueError for PNGs without one.
        """
        found = [
            (f"{scene.name}/{CAMERA}/{image.stem}", self._find(scene, image))
            for scene in scenes
            for image in scene.images
        ]
        pictures = [path for path in require_stored(self.folder, found) if path.suffix == ".png"]
        if needs_scale and pictures and self.scale is None:
            raise ValueError(f"{pictures[0]}: the protocol fits no scale, so say what one count is: prediction_scale")

    def read(self, scene: BoosterScene, image: Path) -> np.ndarray:
        """(h,w) float32 or float64, scaled; ValueError naming a file that is not one, or that holds a NaN."""
        path = self._find(scene, image)
        if path is None:
            raise FileNotFoundError(f"predictions {self.folder}: {scene.name}/{CAMERA}/{image.stem} is missing")
        values = read_stored(path)
        return values if self.scale is None else values * self.scale

    def _find(self, scene: BoosterScene, image: Path) -> Path | None:
        return find_stored(self.folder / scene.name / CAMERA, image.stem)


def find_stored(place: Path, stem: str) -> Path | None:
    """The stored prediction called `stem` in a folder, the first of `SUFFIXES`; None if there is none."""
    candidates = (place / f"{stem}{suffix}" for suffix in SUFFIXES)
    return next((path for path in candidates if path.is_file()), None)


def require_stored(folder: Path, found: Iterable[tuple[str, Path | None]]) -> list[Path]:
    """The files of (name, file) pairs; FileNotFoundError where there is no folder, or listing the names without."""
    if not folder.is_dir():
        raise FileNotFoundError(f"predictions {folder}: no such folder")
    pairs = list(found)
    missing = [name for name, path in pairs if path is None]
    if missing:
        more = f" and {len(missing) - 20} more" if len(missing) > 20 else ""
        raise FileNotFoundError(
            f"predictions {folder}: {len(missing)} missing (as {', '.join(SUFFIXES)}): {', '.join(missing[:20])}{more}"
        )
    return [path for _, path in pairs if path is not None]


def read_stored(path: Path) -> np.ndarray:
    """(h,w) float32 or float64 of a file; ValueError naming one that is no prediction, or that holds a NaN."""
    values = _read_picture(path) if path.suffix in (".png", ".pfm") else _read_array(path)
    if values.ndim != 2 or not values.size or values.dtype.kind not in "fiu":
        raise ValueError(f"{path}: {values.dtype} {values.shape}; a prediction is (h,w) numbers")
    if values.dtype != np.float64:
        values = values.astype(np.float32)
    bad = np.count_nonzero(~np.isfinite(values))
    if bad:
        raise ValueError(f"{path}: the prediction has {bad} NaN or infinite values")
    return values


def _read_array(path: Path) -> np.ndarray:
    try:
        values = np.load(path, allow_pickle=False)
        if isinstance(values, np.ndarray):
            return values
        with values as archive:
            if len(archive.files) != 1:
                raise ValueError(f"{len(archive.files)} arrays ({', '.join(archive.files)}) where one is expected")
            return archive[archive.files[0]]
    except (ValueError, OSError, EOFError, BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: not a readable prediction ({reason(error)})") from None


def _read_picture(path: Path) -> np.ndarray:
    image = open_image(path)
    wanted = ("I;16", "I;16B", "I;16L", "I") if path.suffix == ".png" else ("F",)
    if image.mode not in wanted:
        raise ValueError(f"{path}: mode {image.mode}; a stored prediction is 16-bit grey (PNG) or one channel (PFM)")
    return np.asarray(image)
