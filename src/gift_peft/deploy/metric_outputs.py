"""What `gift-peft predict` writes beside a prediction: metric depth, a 16-bit PNG, a point cloud."""

import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from gift_peft.deploy.calibration import Calibration
from gift_peft.deploy.intrinsics import Intrinsics
from gift_peft.deploy.pointcloud import encode_points, to_points
from gift_peft.deploy.sensor import fill_sensor_depth
from gift_peft.deploy.sensor_checks import check_registration
from gift_peft.deploy.sensor_files import SensorFiles
from gift_peft.files import jsonable, write_whole
from gift_peft.images import PREDICTED, read_image

FARTHEST = 65535  # of a 16-bit picture
SUMMARY = "metric.json"


@dataclass
class MetricOutputs:
    """What is asked for, and for each photo the files that it gives.

    `<name>_metric.npy` (float32, metres), `<name>_metric.png` (16 bits, millimetres, 0 unknown),
    `<name>_confidence.png` (8 bits, 255 is 1) and `<name>_replaced.png` (255 where the sensor's value was not
    kept) with a sensor;
    `<name>_metric.*` with a calibration; `<name>_16bit.png`; `<name>.ply` or `.glb`.

    Args:
        sensor (`SensorFiles`, *optional*), calibration (`Calibration`, *optional*): what makes depth metric.
        png16 (`bool`): a 16-bit PNG of the prediction itself.
        pointcloud (`str`, *optional*): `ply` or `glb`.
        camera (`Intrinsics`, *optional*), fov (`float`, *optional*): of the photos; default their EXIF.
        rows (`list[dict]`): what was done to each photo, filled by `write`.
    """

    sensor: SensorFiles | None = None
    calibration: Calibration | None = None
    png16: bool = False
    pointcloud: str | None = None
    camera: Intrinsics | None = None
    fov: float | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)

    def check(self, folder: Path, names: Sequence[str], is_ours: Callable[[Path], bool]) -> None:
        """ValueError for a file that would be replaced though `gift-peft predict` did not write it.

        `names` are those of the photos' files; `is_ours` tells it of a PNG.
        """
        for name in names:
            for path in (folder / f"{name}.ply", folder / f"{name}.glb"):
                if path.suffix[1:] == self.pointcloud and path.exists() and not is_ours(folder / f"{name}.png"):
                    raise ValueError(f"{path} was not written by gift-peft predict and is kept: choose another folder")
        summary = folder / SUMMARY
        if summary.exists() and not summary.read_bytes().lstrip().startswith(b'[\n {\n  "photo":'):
            raise ValueError(f"{summary} was not written by gift-peft predict and is kept: choose another folder")

    def write(self, folder: Path, name: str, photo: Path, depth: np.ndarray, kind: str | None, unit: float) -> None:
        """The files of one photo, all computed before the first is written.

        Args:
            depth (`np.ndarray`): (H,W) float32, the prediction in native units.
            kind (`str`, *optional*): what it is, `depth` or `inverse_depth`; None where nothing says it.
            unit (`float`): millimetres per native unit of a metric model, else 1.

        Raises ValueError in one line that names the photo or the file that does not go with it.
        """
        if kind is None:
            raise ValueError("nothing says what the model predicts: give --kind depth or --kind inverse_depth")
        row: dict[str, Any] = {"photo": photo.name}
        files: dict[str, bytes] = {}
        metric = depth * (unit / 1000) if kind == "depth" and unit != 1 else None
        if self.sensor is not None:
            metric, own = self._from_sensor(photo, name, depth, kind, files)
            row |= own
        elif self.calibration is not None:
            metric, worst = self.calibration.apply(photo, depth, kind, self._camera(photo, depth))
            row["largest_error_m"] = worst
        if self.sensor is not None or self.calibration is not None:
            files[f"{name}_metric.npy"] = _npy(metric)
            files[f"{name}_metric.png"] = encode_png16(metric * 1000, "mm")
        if self.png16:
            files[f"{name}_16bit.png"], row["png16"] = self._native_png(depth, kind, unit)
        if self.pointcloud is not None:
            files[f"{name}.{self.pointcloud}"] = self._points(photo, depth, kind, metric)
        for file, content in files.items():
            write_whole(folder / file, content)
        self.rows.append(row)

    def suffixes(self) -> list[str]:
        """What is added to a photo's name in the names of its files."""
        metric = ["_metric"] if self.sensor or self.calibration else []
        return metric + (["_confidence", "_replaced"] if self.sensor else []) + (["_16bit"] if self.png16 else [])

    def finish(self, folder: Path) -> str | None:
        """Writes `metric.json`, one object per photo; a line that sums it up, None if nothing was metric."""
        if not self.rows or not (self.sensor or self.calibration or self.png16):
            return None
        write_whole(folder / SUMMARY, json.dumps(jsonable(self.rows), indent=1) + "\n")
        if self.sensor is not None:
            replaced, error = (np.median([row[key] for row in self.rows]) for key in ("replaced", "relative_error"))
            return (
                f"Metric depth in metres (npy) and millimetres (png): {100 * replaced:.1f} % of a photo is not the "
                f"sensor's; where it is trusted the fitted prediction differs by {100 * error:.1f} % (medians)"
            )
        if self.calibration is not None:
            worst = max(row["largest_error_m"] for row in self.rows)
            return f"Metric depth in metres (npy) and millimetres (png); largest error at a taped point {worst:.3f} m"
        return None

    def _from_sensor(
        self, photo: Path, name: str, depth: np.ndarray, kind: str, files: dict[str, bytes]
    ) -> tuple[np.ndarray, dict[str, Any]]:
        assert self.sensor is not None
        if photo not in self.sensor.depths:
            raise ValueError(f"{photo}: no sensor depth belongs to it")
        sensor, mask = self.sensor.read(photo, depth.shape)
        try:
            trusted = sensor > 0 if mask is None else (sensor > 0) & ~mask
            check_registration(depth, sensor, trusted, kind)
            filled = fill_sensor_depth(depth, sensor, mask, kind)
        except ValueError as error:
            raise ValueError(f"{self.sensor.depths[photo]}: {error}") from None
        files[f"{name}_confidence.png"] = _png(np.rint(255 * filled.confidence).astype(np.uint8))
        files[f"{name}_replaced.png"] = _png(np.where(filled.replaced, 255, 0).astype(np.uint8))
        facts = {"scale": filled.scale, "shift": filled.shift, "trusted": filled.trusted}
        facts |= {"relative_error": filled.relative_error, "replaced": float(filled.replaced.mean())}
        facts |= {"rejected": float(filled.rejected.mean()), "sensor": self.sensor.depths[photo].name}
        return filled.depth, facts

    def _native_png(self, depth: np.ndarray, kind: str, unit: float) -> tuple[bytes, dict[str, Any]]:
        if kind == "depth" and unit != 1:
            return encode_png16(depth * unit, "mm"), {"unit": "mm", "scale": 1.0, "offset": 0.0}
        low, high = float(depth.min()), float(depth.max())
        scale = (high - low) / (FARTHEST - 1) if high > low else 1.0
        meaning = {"unit": f"native units of {kind}", "scale": scale, "offset": low - scale}
        values = np.rint((depth.astype(np.float64) - low) / scale + 1).astype(np.uint16)
        return _png(values, {"Unit": f"{meaning['unit']} = {scale:.9g} * value + {meaning['offset']:.9g}"}), meaning

    def _points(self, photo: Path, depth: np.ndarray, kind: str, metric: np.ndarray | None) -> bytes:
        assert self.pointcloud is not None
        camera = self._camera(photo, depth)
        if camera is None:
            raise ValueError(f"{photo}: no focal length in its EXIF; give --fov DEGREES or --camera camera.yaml")
        if metric is None:  # no unit: the shape of what a relative model says, its median 1 away
            positive = np.maximum(depth, 1e-3 * float(np.percentile(depth, 99)))
            metric = positive if kind == "depth" else 1 / positive
            metric = metric / np.median(metric)
        points, colors = to_points(metric, np.asarray(read_image(photo)), camera)
        return encode_points(points, colors, self.pointcloud)

    def _camera(self, photo: Path, depth: np.ndarray) -> Intrinsics | None:
        height, width = depth.shape
        if self.camera is not None:
            return self.camera.at(width, height, str(photo))
        if self.fov is not None:
            return Intrinsics.from_fov(self.fov, width, height)
        return Intrinsics.from_exif(photo)


def encode_png16(millimetres: np.ndarray, unit: str) -> bytes:
    """A 16-bit PNG (H,W) of whole millimetres that says its unit; 0 where unknown or too far (over 65.5 m)."""
    known = np.isfinite(millimetres) & (millimetres > 0) & (millimetres <= FARTHEST)
    values = np.where(known, np.maximum(np.rint(np.where(known, millimetres, 0)), known), 0)
    return _png(values.astype(np.uint16), {"Unit": unit})


def _png(values: np.ndarray, text: dict[str, str] | None = None) -> bytes:
    info, content = PngInfo(), io.BytesIO()
    for key, value in (PREDICTED, *(text or {}).items()):
        info.add_text(key, value)
    Image.fromarray(values).save(content, "PNG", pnginfo=info)
    return content.getvalue()


def _npy(values: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.save(content, values.astype(np.float32))
    return content.getvalue()
