"""The Compare room without its page: a photo's depth by base and adapter, at any scale, and its points."""

import shutil
import tempfile
from pathlib import Path
from threading import Lock

import numpy as np
from PIL import Image

from gift_peft.adapters.scale import set_adapter_scale
from gift_peft.colormap import color_range, colorize
from gift_peft.deploy.intrinsics import Intrinsics
from gift_peft.deploy.pointcloud import encode_points, to_points
from gift_peft.deploy.space_app import distances
from gift_peft.files import write_whole
from gift_peft.images import read_image
from gift_peft.models.loading import DepthModel

SIDE = 1280  # of a photo: larger ones are made smaller, a page needs no more
CLOUD_SIDE = 480  # of the picture that becomes points: a browser turns a quarter of a million of them smoothly


class CompareRoom:
    """One model for all tabs; predictions are made one after the other.

    Args:
        model: a base with an adapter, or a base alone, which is shown without a scale.
        temporary: a folder of ours, for point clouds.
    """

    def __init__(self, model: DepthModel, temporary: Path) -> None:
        self.model, self.temporary = model, temporary
        self.kind = model.known_kind()
        self._predicting = Lock()
        self._base: tuple[tuple, np.ndarray] | None = None  # of the photo that was shown last

    def compare(self, photo: str | Path, scale: float) -> tuple[tuple[Image.Image, Image.Image], str]:
        """(base, adapted at `scale`) as pictures in one range of colors, and what is said of them.

        Raises ValueError or FileNotFoundError, in a line, for an unreadable photo or scale.
        """
        picture = _read(photo)
        base, adapted = self._depths(photo, picture, scale)
        low, high = color_range(base, adapted)
        pictures = tuple(Image.fromarray(colorize(depth, low, high, self.kind)) for depth in (base, adapted))
        if not self.model.adapted:
            return pictures, f"{picture.width}x{picture.height}: the base alone; an adapter is named by --adapter"
        change = float(np.abs(adapted - base).mean()) / max(float(np.abs(base).mean()), 1e-12)
        told = f"{picture.width}x{picture.height}, adapter at {scale:.2f}: on average {change:.1%} from the base"
        return pictures, told

    def points(self, photo: str | Path, scale: float, field_of_view: float) -> Path:
        """A file (.glb) of the adapted depth's points, seen through a horizontal field of view in degrees."""
        picture = _read(photo)
        depth = self._depths(photo, picture, scale)[1]
        step = max(1, -(-max(picture.size) // CLOUD_SIDE))
        z = np.ascontiguousarray(distances(depth, self.kind == "inverse_depth")[::step, ::step])
        pixels = np.asarray(picture)[::step, ::step]
        camera = Intrinsics.from_fov(field_of_view, z.shape[1], z.shape[0])
        positions, colors = to_points(z / max(float(np.median(z)), 1e-12), pixels, camera)
        folder = self.temporary / "points"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        path = Path(tempfile.mkdtemp(dir=folder)) / "points.glb"
        write_whole(path, encode_points(positions - np.float32([0, 0, 1]), colors, "glb"))
        return path

    def _depths(self, photo: str | Path, picture: Image.Image, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) float32 of the base and of the adapter at a scale."""
        if not 0 <= scale <= 1:
            raise ValueError(f"the adapter's scale is from 0 to 1, not {scale}")
        with self._predicting:
            key = str(photo), Path(photo).stat().st_mtime_ns, picture.size
            if self._base is None or self._base[0] != key:
                self._base = key, self.model.depth_at(picture, base=True)
            if not self.model.adapted:
                return self._base[1], self._base[1]
            set_adapter_scale(self.model.network, scale)
            return self._base[1], self.model.depth_at(picture)


def _read(photo: str | Path) -> Image.Image:
    picture = read_image(Path(photo))
    if max(picture.size) > SIDE:
        picture.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
    return picture
