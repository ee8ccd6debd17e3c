"""Metric depth from a handful of taped distances (`--calibrate points.csv`): scale and shift of a prediction.

A line of the table is a pixel of a photo and how far away it is: `depth_m` or `depth_mm` along the camera's axis, as
depth maps count, or `distance_m` or `distance_mm` along the line of sight, as a tape measures, which takes a camera.
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gift_peft.deploy.intrinsics import Intrinsics
from gift_peft.deploy.sensor import FAR, UnrelatedDepthError, robust_line

COLUMNS = {"depth_m": 1.0, "depth_mm": 0.001, "distance_m": 1.0, "distance_mm": 0.001}
ROBUST = 6  # points from which one that is wrong is found out


@dataclass(frozen=True)
class Calibration:
    """Taped points.

    Args:
        path (`Path`): of the table.
        points (`dict[str | None, np.ndarray]`): per photo's file name (None: of every photo) (K,3) x, y in pixels,
            metres.
        along_sight (`bool`): the metres are along the line of sight.
    """

    path: Path
    points: dict[str | None, np.ndarray]
    along_sight: bool

    @classmethod
    def read(cls, path: str | Path) -> "Calibration":
        """A CSV table with the columns `x`, `y`, one of `COLUMNS`, and `image` where photos differ.

        Raises FileNotFoundError, or ValueError naming file, line and column.
        """
        path = Path(path)
        try:
            lines = list(csv.DictReader(path.read_text(encoding="utf-8-sig").splitlines(), skipinitialspace=True))
        except FileNotFoundError:
            raise FileNotFoundError(f"{path}: no such file") from None
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"{path}: not a table in CSV ({error})") from None
        there = [name for name in COLUMNS if lines and name in lines[0]]
        if len(there) != 1 or not {"x", "y"} <= lines[0].keys():
            raise ValueError(f"{path}: it takes lines under the columns x, y and one of {', '.join(COLUMNS)}")
        found: dict[str | None, list[list[float]]] = {}
        for number, line in enumerate(lines, 2):
            values = [_number(line[name], f"{path}, line {number}, {name}") for name in ("x", "y", there[0])]
            if values[2] <= 0:
                raise ValueError(f"{path}, line {number}, {there[0]}: {values[2]:g} is not positive")
            values[2] *= COLUMNS[there[0]]
            found.setdefault((line.get("image") or "").strip() or None, []).append(values)
        if None in found and len(found) > 1:
            raise ValueError(f"{path}: some lines name an image and others do not")
        points = {image: np.array(values) for image, values in found.items()}
        return cls(path, points, there[0].startswith("distance"))

    def check(self, photos: list[Path]) -> None:
        """ValueError for a photo without points, or an image of the table that is no photo."""
        names = {photo.name for photo in photos} | {photo.stem for photo in photos}
        unknown = [image for image in self.points if image is not None and image not in names]
        if unknown:
            raise ValueError(f"{self.path}: image {unknown[0]} is none of the photos")
        for photo in photos:
            self.of(photo)

    def of(self, photo: Path) -> np.ndarray:
        """(K,3) points of a photo."""
        for name in (None, photo.name, photo.stem):
            if name in self.points:
                return self.points[name]
        raise ValueError(f"{self.path}: no point for {photo.name}")

    def apply(
        self, photo: Path, prediction: np.ndarray, kind: str, camera: Intrinsics | None
    ) -> tuple[np.ndarray, float]:
        """Depth (H,W) float32 in metres, and the largest error at a point, in metres.

        One point fixes a factor, two or more scale and shift; from six on a wrong one is outvoted. The fit is in the
        prediction's space, where an error counts relative to the distance.

        Args:
            photo: names the points, and stands in messages.
            prediction (`np.ndarray`): (H,W) in native units.
            kind (`str`): `depth` or `inverse_depth`.
            camera (*optional*): of the photo, for distances along the line of sight.

        Raises ValueError: a point outside the photo, a line of sight without a camera, points that contradict the
        prediction or do not fix a fit.
        """
        points = self.of(photo)
        height, width = prediction.shape
        columns, rows = np.rint(points[:, :2]).astype(int).T
        outside = (columns < 0) | (rows < 0) | (columns >= width) | (rows >= height)
        if outside.any():
            x, y, _ = points[np.argmax(outside)]
            raise ValueError(f"{self.path}: the point {x:g}, {y:g} is outside {photo.name} ({width}x{height})")
        depth = points[:, 2]
        if self.along_sight:
            if camera is None:
                raise ValueError(
                    f"{self.path}: distances along the line of sight take a camera (--fov or --camera); or measure "
                    "along the camera's axis and call the column depth_m"
                )
            depth = depth / np.linalg.norm(camera.rays()[rows, columns], axis=-1)
        x, y = prediction[rows, columns].astype(np.float64), 1 / depth if kind == "inverse_depth" else depth
        scale, shift = self._fit(photo, x, y)
        aligned = scale * prediction.astype(np.float64) + shift
        farthest, nearest = FAR * depth.max(), depth.min() / 100
        if kind == "inverse_depth":
            result = 1 / np.clip(aligned, 1 / farthest, 1 / nearest)
        else:
            result = np.clip(aligned, nearest, farthest)
        return result.astype(np.float32), float(np.abs(result[rows, columns] - depth).max())

    def _fit(self, photo: Path, x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
        trouble = f"{self.path}: the points of {photo.name}"
        if len(x) == 1 or np.ptp(x) <= 1e-3 * np.abs(x).max():
            if len(x) > 1 and np.ptp(y) > 0.2 * y.max():
                raise ValueError(f"{trouble} differ in distance, but the model sees them equally far")
            if np.median(x) <= 0:
                raise ValueError(f"{trouble}: the prediction there is not positive; measure two points or more")
            return float(np.median(y) / np.median(x)), 0.0
        if len(x) >= ROBUST:
            try:
                return robust_line(x, y, 1 / y)
            except UnrelatedDepthError:
                raise ValueError(f"{trouble} contradict the prediction: nearer ones are predicted farther") from None
        basis = np.stack([x, np.ones_like(x)], 1) / y[:, None]
        scale, shift = np.linalg.lstsq(basis, np.ones_like(y), rcond=None)[0]
        if scale <= 0:
            raise ValueError(f"{trouble} contradict the prediction: nearer ones are predicted farther")
        return float(scale), float(shift)


def _number(text: str | None, where: str) -> float:
    try:
        value = float((text or "").replace(",", ".") if (text or "").count(",") == 1 else text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{where}: {text!r} is not a number")
    return value
