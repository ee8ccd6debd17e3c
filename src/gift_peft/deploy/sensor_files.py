"""The files of a depth sensor: which belongs to which photo, in which unit, at the photo's size.

Depth is a 16-bit PNG or TIFF in millimetres, or an npy in metres (a whole-number npy in millimetres), as cameras and
their tools write it; `--sensor-unit` says otherwise. Files pair with photos by name, or by the time in their names.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gift_peft.deploy.sensor_checks import check_range
from gift_peft.images import SUFFIXES, natural_key, open_image, to_mask

DEPTH_SUFFIXES = {".npy", ".png", ".tif", ".tiff"}
UNITS = {"m": 1.0, "mm": 0.001}
# Words that say what a picture is, not which: `a_rgb.png`, `a_depth.png` and `a_mask.png` belong together.
KIND_WORDS = {"rgb", "color", "colour", "image", "img", "photo", "depth", "mask", "label", "aligned", "raw", "mm"}
KIND_WORDS |= {"sensor", "transparent", "opaque", "rect", "to"}
TIME = re.compile(r"(?:.*[^\d.])?(\d{9,}(?:\.\d+)?|\d+\.\d+)")  # 1305031102.175304, frame_1305031102175304000
ASPECT = 0.02  # by which the ratios of width to height may differ


def read_depth(path: Path, unit: str | None = None) -> np.ndarray:
    """(H,W) float64 in metres of a depth file; 0 is a hole (so are NaN, infinity, negative values and 65535).

    Args:
        unit (*optional*): `m`, `mm`, or metres per value as a number ("0.0001"); default by the file's type.

    Raises FileNotFoundError or ValueError in one line: no depth file, an 8-bit or color picture, no value in it,
    values that must be in another unit.
    """
    if path.suffix.lower() == ".npy":
        try:
            values = np.load(path, allow_pickle=False)
        except FileNotFoundError:
            raise FileNotFoundError(f"{path}: no such file") from None
        except (ValueError, OSError, EOFError) as error:
            raise ValueError(f"{path}: not a readable npy file ({error})") from None
        if values.ndim == 3 and 1 in values.shape:
            values = values.squeeze()
        if values.ndim != 2 or values.dtype.kind not in "fui" or not values.size:
            raise ValueError(f"{path}: {values.shape} {values.dtype}; depth is one (height, width) array of numbers")
    else:
        image = open_image(path)
        if image.mode != "F" and not image.mode.startswith("I"):
            deep = "an 8-bit" if image.mode in ("L", "P", "1") else "a"
            raise ValueError(
                f"{path}: {deep} picture of mode {image.mode}; depth is a 16-bit PNG in mm, or an npy in m"
            )
        values = np.asarray(image)
    taken = unit or ("m" if values.dtype.kind == "f" else "mm")
    whole = values.dtype.kind != "f"
    depth = values.astype(np.float64)
    depth[~np.isfinite(depth) | (depth <= 0) | (depth == 65535 if whole else False)] = 0
    depth *= UNITS[taken] if taken in UNITS else float(taken)
    check_range(depth, str(path), taken if taken in UNITS else f"{taken} m per value")
    return depth


def to_size(values: np.ndarray, size: tuple[int, int], name: str, what: str) -> np.ndarray:
    """Depth or mask at a photo's (height, width), nearest; ValueError for one of another shape."""
    height, width = values.shape
    if abs(width / height / (size[1] / size[0]) - 1) > ASPECT:
        raise ValueError(
            f"{name}: the {what} is {height}x{width} (height x width) and the photo {size[0]}x{size[1]}: "
            "another camera or crop; register it to the photo first"
        )
    if values.shape == size:
        return values
    resized = cv2.resize(
        values.astype(np.uint8) if values.dtype == bool else values, size[::-1], interpolation=cv2.INTER_NEAREST
    )
    return resized.astype(values.dtype)


@dataclass(frozen=True)
class SensorFiles:
    """The depth, and perhaps the target mask, of each photo.

    Args:
        depths (`dict[Path, Path]`): depth file per photo; a photo without one is not in it.
        masks (`dict[Path, Path]`, *optional*): mask per photo; None where no masks were given.
        unit (`str`, *optional*): as in `read_depth`.
    """

    depths: dict[Path, Path]
    masks: dict[Path, Path] | None = None
    unit: str | None = None

    @classmethod
    def find(
        cls,
        photos: Sequence[Path],
        depth: str | Path,
        mask: str | Path | None = None,
        unit: str | None = None,
        tolerance: float = 0.02,
    ) -> "SensorFiles":
        """Those of a file or folder, paired by `pair_files`; `tolerance` in seconds.

        Raises FileNotFoundError or ValueError: nothing there, no photo that has depth, a photo with depth but no mask.
        """
        depths = pair_files(photos, list_files(depth, DEPTH_SUFFIXES, "sensor depth"), "sensor depth", tolerance)
        masks = None
        if mask is not None:
            masks = pair_files(list(depths), list_files(mask, SUFFIXES, "mask"), "mask", tolerance)
            bare = [photo for photo in depths if photo not in masks]
            if bare:
                raise ValueError(f"{bare[0]}: no mask in {mask} (and {len(bare) - 1} more photos)")
        return cls(depths, masks, unit)

    def read(self, photo: Path, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray | None]:
        """(depth in metres, mask or None) of a photo at its (height, width); errors as `read_depth` and `to_size`."""
        path = self.depths[photo]
        depth = to_size(read_depth(path, self.unit), size, str(path), "sensor depth")
        return depth, None if self.masks is None else read_mask(self.masks[photo], size)


def read_mask(path: Path, size: tuple[int, int]) -> np.ndarray:
    """A target mask file as (H,W) bool at a photo's (height, width)."""
    return to_size(to_mask(open_image(path), str(path)), size, str(path), "mask")


def list_files(source: str | Path, suffixes: set[str], what: str) -> list[Path]:
    """The file named, or the files of these types in the folder named, in natural order."""
    source = Path(source)
    if source.is_file():
        return [source]
    if not source.is_dir():
        raise FileNotFoundError(f"{what} {source}: no such file or folder")
    files = [path for path in source.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    if not files:
        raise ValueError(f"{what} {source}: the folder has no file of {', '.join(sorted(suffixes))}")
    return sorted(files, key=lambda path: natural_key(path.name))


def pair_files(photos: Sequence[Path], files: Sequence[Path], what: str, tolerance: float) -> dict[Path, Path]:
    """The file of each photo that has one.

    One photo and one file are a pair. Otherwise the same name, then the same name but for words as rgb, color and
    depth, then, where all names hold a time, the nearest in time within `tolerance` seconds, each file once.

    Raises ValueError where no photo has a file, or where two files would do.
    """
    if len(photos) == len(files) == 1:
        return {photos[0]: files[0]}
    found: dict[Path, Path] = {}
    for key in (lambda path: path.stem, _without_kind):
        found = _pair_by_name(photos, files, key, what)
        if len(found) == len(photos):
            return found
    times = _times([*photos, *files])
    if times is not None and not found:
        found = _pair_by_time(photos, files, times, tolerance)
    if not found:
        within = f" within {tolerance:g} s" if times is not None else ""
        raise ValueError(
            f"no {what} belongs to a photo by its name{' or time' if times else ''}{within}: "
            f"{photos[0].name} beside {files[0].name}"
        )
    return found


def _without_kind(path: Path) -> tuple[str, ...]:
    """`0001-transparent-rgb-img` and `0001_depth` are both ("0001",)."""
    words = [word for word in re.split(r"[-_. ]+", path.stem.lower()) if word]
    return tuple(word for word in words if word not in KIND_WORDS)


def _pair_by_name(
    photos: Sequence[Path], files: Sequence[Path], key: Callable[[Path], object], what: str
) -> dict[Path, Path]:
    by_key: dict[object, Path] = {}
    for file in files:
        other = by_key.setdefault(key(file), file)
        if other != file and any(key(photo) == key(file) for photo in photos):
            raise ValueError(f"{what}: both {other} and {file} would belong to one photo")
    found: dict[object, Path] = {}
    for photo in photos:
        if key(photo) in by_key and found.setdefault(key(photo), photo) != photo:
            raise ValueError(f"{what}: {by_key[key(photo)]} would belong to both {found[key(photo)]} and {photo}")
    return {photo: by_key[name] for name, photo in found.items()}


def _times(paths: Sequence[Path]) -> dict[Path, float] | None:
    """Seconds in the names of all files, by their number of digits s, ms, us or ns; None if one has no time."""
    times = {}
    for path in paths:
        match = TIME.fullmatch(path.stem)
        if match is None:
            return None
        whole = match.group(1).partition(".")[0]
        times[path] = float(match.group(1)) / 10 ** {0: 0, 1: 3, 2: 6, 3: 9}[max(0, min(3, (len(whole) - 9) // 3))]
    return times


def _pair_by_time(
    photos: Sequence[Path], files: Sequence[Path], times: dict[Path, float], tolerance: float
) -> dict[Path, Path]:
    """Nearest first; a photo and a file are taken once."""
    ordered = np.array(sorted(times[file] for file in files))
    by_time = sorted(files, key=times.__getitem__)
    candidates = []
    for photo in photos:
        low, high = np.searchsorted(ordered, [times[photo] - tolerance, times[photo] + tolerance])
        candidates += [(abs(times[file] - times[photo]), photo, file) for file in by_time[max(0, low - 1) : high + 1]]
    found: dict[Path, Path] = {}
    taken: set[Path] = set()
    for distance, photo, file in sorted(candidates, key=lambda item: (item[0], str(item[1]), str(item[2]))):
        if distance <= tolerance * (1 + 1e-9) and photo not in found and file not in taken:
            found[photo] = file
            taken.add(file)
    return {photo: found[photo] for photo in photos if photo in found}
