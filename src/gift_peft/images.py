"""Picture files: find, order, decode, check and digest.

The same rules serve every reader: pictures come upright and in 8-bit RGB, masks as bool, and what cannot be read says
so in one line that names the file.
"""

import base64
import glob
import hashlib
import io
import logging
import os
import re
import struct
from collections.abc import Iterable, Sequence
from functools import lru_cache
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from gift_peft.files import is_in_the_cloud, is_leftover, is_lfs_pointer, reason

logger = logging.getLogger(__name__)

JPEG_SUFFIXES = {".jpg", ".jpeg", ".jpe", ".jfif", ".mpo"}  # .mpo: several JPEGs, of which the first is the photo
SUFFIXES = JPEG_SUFFIXES | {".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".avif"}
HEIF_SUFFIXES = {".heic", ".heif", ".hif"}
HEIF_BRANDS = {b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1"}
HEIF_HINT = "pip install 'gift-peft[heif]' reads HEIC, or export it as JPEG"
PREDICTED = ("Software", "gift-peft predict")  # a text in the PNGs of `predict`: what lacks it is somebody's own
BOMB = Image.DecompressionBombError
LOSSY = {"JPEG", "MPO", "WEBP", "AVIF", "HEIF"}  # formats that do not keep the values of a mask
# Files that people and cameras put beside photos and that are no pictures.
COMPANIONS = {
    ".txt", ".md", ".rst", ".csv", ".tsv", ".json", ".jsonl", ".yaml", ".yml", ".toml", ".xml", ".html", ".pdf",
    ".log", ".xmp", ".aae", ".thm", ".lrc", ".lnk", ".url", ".py", ".ipynb", ".npy", ".npz", ".parquet",
    ".safetensors", ".dvc", ".lock",
}  # fmt: skip
SINGLE_CHANNEL = ("1", "L", "P", "I", "I;16", "I;16B", "I;16L")


def is_image_file(path: Path) -> bool:
    """Whether a folder's entry counts as a picture: by its suffix, and not hidden."""
    suffix = path.suffix.lower()
    return (suffix in SUFFIXES or (suffix in HEIF_SUFFIXES and reads_heif())) and not is_leftover(path.name)


@lru_cache
def reads_heif() -> bool:
    """Whether HEIC can be read: the extra `heif` is installed. Then Pillow opens it from now on."""
    if find_spec("pillow_heif") is None:
        return False
    import pillow_heif

    pillow_heif.register_heif_opener()
    return True


def skipped_files(paths: Iterable[Path]) -> list[Path]:
    """Those of a folder's files that are neither read nor meant to lie beside photos, in natural order: pictures of
    kinds that are not read, videos, and what is not known.
    """
    skipped = [
        path
        for path in paths
        if not (is_image_file(path) or path.suffix.lower() in COMPANIONS or is_leftover(path.name))
    ]
    return sorted(skipped, key=lambda path: natural_key(path.as_posix()))


def name_skipped(names: Sequence[str]) -> str:
    """How messages tell of files that are not read: their number, their names, and what helps."""
    heif = any(Path(name).suffix.lower() in HEIF_SUFFIXES for name in names)
    count = f"{len(names)} file{'s are' if len(names) != 1 else ' is'} not read"
    hints = [HEIF_HINT] if heif else []
    if any(is_in_the_cloud(Path(name).name) for name in names):
        hints.append("download what is still in iCloud")
    return f"{count}: {', '.join(names)}" + (f" ({'; '.join(hints)})" if hints else "")


def open_image(source: str | Path | bytes | Image.Image, name: str | None = None) -> Image.Image:
    """Decode a file, its bytes, or an open image completely and turn it upright (EXIF orientation).

    `name` stands for the source in messages. Raises FileNotFoundError or ValueError with one line naming it.
    """
    name = name or str(source)
    try:
        image = source if isinstance(source, Image.Image) else _opened(source)
        pages = _pages(image)
        # Pillow reduces 16-bit RGB to 8 bits while decoding; only the tiles of a file not yet decoded tell.
        deep = any(";16" in str(tile[-1]) for tile in getattr(image, "tile", ()))
        image.load()
        if image.getexif().get(Image.ExifTags.Base.Orientation) is not None:
            stored = image.format
            image = ImageOps.exif_transpose(image)
            image.format = stored  # a copy has none, and masks go by it
    except FileNotFoundError:
        dangling = isinstance(source, str | Path) and Path(source).is_symlink()
        why = "; the link leads nowhere: fetch its content (git annex get, dvc pull, hf download)" if dangling else ""
        raise FileNotFoundError(f"{name}: no such file{why}") from None
    # TypeError and LookupError: a TIFF whose tags are damaged.
    except (OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, struct.error, BOMB) as error:
        if _is_heif(source) and not reads_heif():
            hint = f"; it is HEIC: {HEIF_HINT}"
        elif is_lfs_pointer(_start(source)):
            hint = "; only Git LFS's pointer to it is there: `git lfs pull` fetches the file"
        else:
            hint = f" ({reason(error)})"
        raise ValueError(f"{name}: not a readable image, or truncated{hint}") from None
    if pages > 1:
        raise ValueError(f"{name}: it holds {pages} pictures; save each as a file of its own")
    if deep and image.mode not in SINGLE_CHANNEL:
        raise ValueError(f"{name}: a 16-bit image; save it with 8 bits per channel")
    return image


def _opened(source: str | Path | bytes) -> Image.Image:
    try:
        return Image.open(io.BytesIO(source) if isinstance(source, bytes) else source)
    except Image.UnidentifiedImageError:
        if not (_is_heif(source) and reads_heif()):  # which registers the reader
            raise
        return Image.open(io.BytesIO(source) if isinstance(source, bytes) else source)


def _is_heif(source: str | Path | bytes | Image.Image) -> bool:
    """By the content: phones also call such files .jpg."""
    start = _start(source)
    return start[4:8] == b"ftyp" and start[8:12] in HEIF_BRANDS


def _start(source: str | Path | bytes | Image.Image) -> bytes:
    """The first bytes of a file, none of what is no file or cannot be read."""
    if isinstance(source, Image.Image | bytes):
        return source[:32] if isinstance(source, bytes) else b""
    try:
        with open(source, "rb") as file:
            return file.read(32)
    except OSError:
        return b""


def _pages(image: Image.Image) -> int:
    """How many pictures of its size a file of a kind for several holds. MPO, AVIF and HEIC say which one is the photo;
    TIFF also keeps small previews.
    """
    pages = getattr(image, "n_frames", 1) if image.format in ("TIFF", "GIF", "PNG", "WEBP") else 1
    if pages == 1 or image.format != "TIFF":
        return pages
    size, count = image.size, 0
    for page in range(pages):
        image.seek(page)
        count += image.size == size
    image.seek(0)
    return count


def hidden_turn(path: Path) -> int | None:
    """The EXIF orientation of a photo where turning it upright does not change its size (180 degrees, mirrored, or a
    square photo), so that nothing tells whether a program went by it; else None.
    """
    try:
        with _opened(path) as image:
            orientation = image.getexif().get(Image.ExifTags.Base.Orientation)
            keeps = orientation in (2, 3, 4) or (orientation in (5, 6, 7, 8) and image.width == image.height)
            return orientation if keeps else None
    except (OSError, SyntaxError, ValueError):
        return None  # whoever reads it says why


def to_rgb(image: Image.Image, name: str) -> Image.Image:
    """8-bit RGB from RGB, grey, palette and opaque RGBA; transparency, 16-bit, CMYK and others raise ValueError."""
    if image.mode == "RGB" and "transparency" not in image.info:
        return image
    if image.has_transparency_data:
        image = image.convert("RGBA")
        if np.asarray(image.getchannel("A")).min() < 255:
            raise ValueError(f"{name}: the image has transparent pixels; save it as RGB without an alpha channel")
    elif image.mode.startswith(("I", "F")):
        raise ValueError(f"{name}: a 16-bit (or deeper) image, mode {image.mode}; save it with 8 bits per channel")
    elif image.mode not in ("1", "L", "P"):
        raise ValueError(f"{name}: colour mode {image.mode}; save it as 8-bit RGB")
    return image.convert("RGB")


def read_image(source: str | Path | bytes | Image.Image, name: str | None = None) -> Image.Image:
    """An upright 8-bit RGB picture; ValueError or FileNotFoundError (one line, naming the file) for anything else."""
    return to_rgb(open_image(source, name), name or str(source))


def given_picture(image: str | Path | Image.Image | np.ndarray) -> tuple[Image.Image, str]:
    """(upright RGB picture, what messages call it) of a file, a picture, or an array (H,W,3) or grey (H,W), uint8.

    Raises as `read_image`, and ValueError for anything else.
    """
    name = str(image) if isinstance(image, str | Path) else "the picture"
    if isinstance(image, np.ndarray):
        if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)) or image.ndim < 2 or not image.size:
            raise ValueError(f"{name}: (H,W,3) uint8 is expected, not {image.shape} {image.dtype}")
        image = Image.fromarray(image)
    elif not isinstance(image, str | Path | Image.Image):
        raise ValueError(f"{name}: a path, a PIL picture or a uint8 array is expected, not {type(image).__name__}")
    return read_image(image, name), name


def to_mask(image: Image.Image, name: str, target_class: int | Sequence[int] | None = None) -> np.ndarray:
    """The (H, W) bool target region of a mask in one channel, or in grey saved as RGB, RGBA, LA or palette.

    Without `target_class` the mask has at most two values: up to 1, what is above 0 is target; else what is at least
    128. In a JPEG (or another lossy format) nearly all are close to black or white, and it is cut at 128. With it (a
    value or several, from `group.yaml`), pixels of those values are target: of a palette picture its numbers, or its
    grey values if none of its numbers is meant. Colors without a class raise ValueError, as does real transparency.
    """
    if image.mode == "P" and target_class is not None:
        return _palette_class(image, name, np.atleast_1d(target_class))
    if image.mode == "F":  # what NumPy users save: 0.0 and 1.0, or 0.0 and 255.0
        values = np.asarray(image)
        if not (values == np.round(values).clip(0, 65535)).all():  # NaN as well
            raise ValueError(f"{name}: its values are fractions, negative or not finite; save it as black and white")
        values = values.astype(np.int64)
    else:
        values = np.asarray(image) if image.mode in SINGLE_CHANNEL and image.mode != "P" else _grey(image, name)
    if values.dtype == bool:
        return values if target_class is None else np.isin(values * 255, target_class) | np.isin(values, target_class)
    levels = (
        np.flatnonzero(np.bincount(values.ravel(), minlength=2)) if values.dtype == np.uint8 else np.unique(values)
    )
    if image.format in LOSSY and (len(levels) > 2 or levels[-1:] == [1]):  # a 1 may be a target or a trace of noise
        black, white = values <= 32, values >= 223
        near = float((black | white).mean())
        if target_class not in (None, 255, [255]) or near < 0.99 or not (black.any() and white.any()):
            raise ValueError(
                f"{name}: {len(levels)} different values, {near:.1%} of the pixels near black or white, in a format "
                f"({image.format}) that does not keep them; save the mask as PNG"
            )
        return values >= 128
    if target_class is not None:
        return np.isin(values, target_class)
    if len(levels) > 2:
        raise ValueError(
            f"{name}: {len(levels)} different values ({', '.join(map(str, levels[:4]))}, ...); a mask has at most "
            "two, or name the target's value in group.yaml (`mask_class: 2`)"
        )
    return values > 0 if values.max(initial=0) <= 1 else values >= 128


def _grey(image: Image.Image, name: str) -> np.ndarray:
    """(H, W) uint8 of a picture in color channels that holds grey only; what is transparent is 0.

    ValueError for colors, and where transparency and grey contradict each other.
    """
    if image.mode not in ("P", "PA", "LA", "RGB", "RGBA"):
        raise ValueError(f"{name}: mode {image.mode}; a mask has a single channel")
    pixels = np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))
    opaque = pixels[..., 3] == 255 if pixels.shape[-1] == 4 else np.ones(pixels.shape[:2], bool)
    spread = pixels[..., :3].max(axis=-1).astype(int) - pixels[..., :3].min(axis=-1)
    if (spread[opaque] > (16 if image.format in LOSSY else 0)).any():
        hint = (
            "name the target's number in group.yaml (`mask_class: 1`), or save it" if image.mode == "P" else "save it"
        )
        raise ValueError(f"{name}: mode {image.mode}; a mask has a single channel, or grey: {hint} as black and white")
    grey = pixels[..., 1]
    if opaque.all():
        return grey
    white, hidden = opaque & (grey >= 128), ~opaque & (grey >= 128)
    # Painted white on nothing, whatever color nothing has; or black and white, with black where it is transparent.
    sure = white.any() and ((white == opaque).all() or not hidden.any())
    empty = not opaque.any() and not grey.any()
    if (pixels[..., 3][~opaque] > 0).any() or not (sure or empty):
        raise ValueError(f"{name}: the mask has transparent pixels that may mean either; save it as black and white")
    return np.where(opaque, grey, np.uint8(0))


def _palette_class(image: Image.Image, name: str, classes: np.ndarray) -> np.ndarray:
    by_number = np.isin(np.asarray(image), classes)
    pixels = np.asarray(image.convert("RGB"))
    if (pixels != pixels[..., :1]).any():
        return by_number
    by_grey = np.isin(pixels[..., 0], classes)
    if by_number.any() and by_grey.any() and (by_number != by_grey).any():
        raise ValueError(
            f"{name}: mask_class {', '.join(map(str, classes))} is a palette number and, elsewhere, a grey value; "
            "save the mask without a palette"
        )
    return by_number if by_number.any() else by_grey


def image_digest(image: Image.Image) -> str:
    """32 hex digits of an RGB image's decoded content: the same picture in another file gives the same digest."""
    digest = hashlib.blake2b(f"{image.mode} {image.width}x{image.height} ".encode(), digest_size=16)
    digest.update(image.tobytes())
    return digest.hexdigest()


def jpeg_uri(image: Image.Image, **options: Any) -> str:
    """An RGB picture as a JPEG inside its own address, for pages of one file; `options` as Pillow saves it."""
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", **options)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()


def natural_key(name: str) -> list:
    """Sorts image_2 before image_10."""
    return [
        (0, int(part), "") if part.isdigit() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name) if part
    ]


def sort_pictures(paths: Iterable[Path]) -> list[Path]:
    """Those of the paths that are pictures, in the natural order of their names."""
    return sorted(filter(is_image_file, paths), key=lambda path: natural_key(path.name))


def _matching(path: str | Path) -> list[Path]:
    """The files of a pattern like `photos/*.jpg`, which shells of Windows leave to the program; else the path."""
    if glob.has_magic(str(path)) and not os.path.lexists(path):
        return [Path(name) for name in sorted(glob.glob(str(path)))] or [Path(path)]
    return [Path(path)]


def list_images(images: Sequence[str | Path]) -> list[Path]:
    """Picture files, and those of the folders named; FileNotFoundError or ValueError where there are none.

    A warning names the files of those folders that are not read.
    """
    files: list[Path] = []
    skipped: list[Path] = []
    for path in chain.from_iterable(map(_matching, images)):
        if path.is_dir():
            if path.name in (".", "..") or not is_leftover(path.name) or len(images) == 1:
                inside = [entry for entry in path.iterdir() if not entry.is_dir()]
                files += sort_pictures(inside)
                skipped += skipped_files(inside)
        elif not is_leftover(path.name) or len(images) == 1:  # of a pattern that a shell expanded
            files.append(path)
    missing = [str(path) for path in files if not path.is_file()]
    if missing:
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise FileNotFoundError(f"no such image: {missing[0]}{more}")
    told = name_skipped(list(map(str, skipped))) if skipped else ""
    if not files:
        listed = ", ".join(map(str, images)) or "an empty list"
        raise ValueError(f"no images in {listed} (folders within folders are not searched)" + (told and f"; {told}"))
    if told:
        logger.warning("%s", told)
    return files
