"""The camera that took a photo: focal lengths and center in pixels, from a file, a field of view, or EXIF."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from gift_peft.files import read_yaml

FULL_FRAME = math.hypot(36, 24)  # mm: the diagonal that "35 mm equivalent" refers to
INCH, CENTIMETER, MILLIMETER = 25.4, 10.0, 1.0  # mm: units of EXIF's focal plane resolution
NAMES = {"width": ("width", "image_width", "xres"), "height": ("height", "image_height", "yres")}


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion.

    Args:
        fx, fy, cx, cy (`float`): in pixels of a picture of `width` x `height`; the first pixel's center is 0.
        width, height (`int`).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def at(self, width: int, height: int, name: str) -> "Intrinsics":
        """The same camera for a picture of another size; ValueError, naming the photo, for another shape."""
        across, down = width / self.width, height / self.height
        if abs(across / down - 1) > 0.02:
            raise ValueError(f"{name}: {width}x{height}, but the camera's pictures are {self.width}x{self.height}")
        # Centers of pixels lie at whole numbers, so the picture's corner is at -0.5.
        cx, cy = (self.cx + 0.5) * across - 0.5, (self.cy + 0.5) * down - 0.5
        return Intrinsics(self.fx * across, self.fy * down, cx, cy, width, height)

    def rays(self) -> np.ndarray:
        """(H,W,3) directions of the pixels with z = 1; x right, y down, z away from the camera."""
        x = (np.arange(self.width) - self.cx) / self.fx
        y = (np.arange(self.height) - self.cy) / self.fy
        return np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], -1)

    @classmethod
    def centered(cls, focal: float, width: int, height: int) -> "Intrinsics":
        """Square pixels and the middle of the picture as center."""
        return cls(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)

    @classmethod
    def from_fov(cls, degrees: float, width: int, height: int) -> "Intrinsics":
        """Of a horizontal field of view."""
        return cls.centered(width / 2 / math.tan(math.radians(degrees) / 2), width, height)

    @classmethod
    def from_yaml(cls, path: str | Path) -> "Intrinsics":
        """Of a camera file: `fx fy cx cy` with `xres yres` (or `width height`), or ROS's `camera_matrix` (or `K`).

        Raises FileNotFoundError, or ValueError naming the file and what it lacks.
        """
        path = Path(path)
        values = read_yaml(path, f"camera {path}")
        matrix = values.get("camera_matrix", values.get("K", values.get("k")))
        matrix = matrix.get("data") if isinstance(matrix, dict) else matrix
        if matrix is not None:
            try:
                numbers = np.asarray(matrix, float).reshape(3, 3)
            except (TypeError, ValueError):
                raise ValueError(f"camera {path}: its camera matrix is not nine numbers") from None
            values = values | dict(zip(("fx", "fy", "cx", "cy"), numbers[(0, 1, 0, 1), (0, 1, 2, 2)], strict=True))
        for name, others in NAMES.items():
            values[name] = next((values[other] for other in others if other in values), None)
        wanted = ("fx", "fy", "cx", "cy", "width", "height")
        bad = [name for name in wanted if not _is_positive(values.get(name))]
        if bad:
            raise ValueError(f"camera {path}: no positive number for {', '.join(bad)}; it takes {', '.join(wanted)}")
        focal = [float(values[name]) for name in wanted[:4]]
        return cls(*focal, int(values["width"]), int(values["height"]))

    @classmethod
    def from_exif(cls, path: str | Path) -> "Intrinsics | None":
        """Of what the camera wrote into the photo, turned as the photo is; None if it did not.

        The 35 mm equivalent refers to the diagonal (CIPA DC-008); without it, focal length and focal plane resolution.
        """
        try:
            with Image.open(path) as image:
                exif, (width, height) = image.getexif(), image.size
        except (OSError, ValueError, SyntaxError):
            return None
        tags = exif.get_ifd(ExifTags.IFD.Exif)
        if exif.get(ExifTags.Base.Orientation, 1) in (5, 6, 7, 8):
            width, height = height, width
        equivalent = tags.get(ExifTags.Base.FocalLengthIn35mmFilm)
        if _is_positive(equivalent):
            return cls.centered(float(equivalent) / FULL_FRAME * math.hypot(width, height), width, height)
        focal, density = tags.get(ExifTags.Base.FocalLength), tags.get(ExifTags.Base.FocalPlaneXResolution)
        unit = {2: INCH, 3: CENTIMETER, 4: MILLIMETER}.get(tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
        taken = tags.get(ExifTags.Base.ExifImageWidth)
        if not (_is_positive(focal) and _is_positive(density) and unit):
            return None
        smaller = max(width, height) / float(taken) if _is_positive(taken) else 1.0  # a photo made smaller since
        return cls.centered(float(focal) * float(density) / unit * min(1.0, smaller), width, height)


def _is_positive(value: Any) -> bool:
    try:
        return math.isfinite(float(value)) and float(value) > 0
    except (TypeError, ValueError, ZeroDivisionError):
        return False
