"""Picture files: find, order, decode, check and digest.

The same rules serve every reader: pictures come upright and in 8-bit RGB, masks as bool, and what cannot be read says
so in one line that names the file.
"""

import base64
import hashlib
import io
import re
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from gift_peft.files import reason

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm"}
SINGLE_CHANNEL = ("1", "L", "P", "I", "I;16", "I;16B", "I;16L")


def is_image_file(path: Path) -> bool:
    """Whether a folder's entry counts as a picture: by its suffix, and not hidden."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def open_image(source: str | Path | bytes | Image.Image, name: str | None = None) -> Image.Image:
    """Decode a file, its bytes, or an open image completely and turn it upright (EXIF orientation).

    `name` stands for the source in messages. Raises FileNotFoundError or ValueError with one line naming it.
    """
    name = name or str(source)
    try:
        if isinstance(source, Image.Image):
            image = source
        else:
            image = Image.open(io.BytesIO(source) if isinstance(source, bytes) else source)
        # Pillow reduces 16-bit RGB to 8 bits while decoding; only the tiles of a file not yet decoded tell.
        deep = any(";16" in str(tile[-1]) for tile in getattr(image, "tile", ()))
        image.load()
        if image.getexif().get(Image.ExifTags.Base.Orientation) is not None:
            image = ImageOps.exif_transpose(image)
    except FileNotFoundError:
        raise FileNotFoundError(f"{name}: no such file") from None
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, Image.DecompressionBombError) as error:
        raise ValueError(f"{name}: not a readable image, or truncated ({reason(error)})") from None
    if deep and image.mode not in SINGLE_CHANNEL:
        raise ValueError(f"{name}: a 16-bit image; save it with 8 bits per channel")
    return image


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


def to_mask(image: Image.Image, name: str, target_class: int | Sequence[int] | None = None) -> np.ndarray:
    """The (H, W) bool target region of a single-channel mask.

    Without `target_class` the mask has at most two values: up to 1, what is above 0 is target; else what is at least
    128. With it (a value or several, from `group.yaml`), pixels of those values are target. Raises ValueError.
    """
    if image.mode not in SINGLE_CHANNEL:
        raise ValueError(f"{name}: mode {image.mode}; a mask has a single channel")
    values = np.asarray(image)
    if target_class is not None:
        return np.isin(values, target_class)
    if values.dtype == bool:
        return values
    levels = (
        np.flatnonzero(np.bincount(values.ravel(), minlength=2)) if values.dtype == np.uint8 else np.unique(values)
    )
    if len(levels) > 2:
        raise ValueError(
            f"{name}: {len(levels)} different values ({', '.join(map(str, levels[:4]))}, ...); a mask has at most "
            "two, or name the target's value in group.yaml (`mask_class: 2`)"
        )
    return values > 0 if values.max(initial=0) <= 1 else values >= 128


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


def list_images(images: Sequence[str | Path]) -> list[Path]:
    """Picture files, and those of the folders named; FileNotFoundError or ValueError where there are none."""
    files: list[Path] = []
    for path in map(Path, images):
        files += sort_pictures(path.iterdir()) if path.is_dir() else [path]
    missing = [str(path) for path in files if not path.is_file()]
    if missing:
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise FileNotFoundError(f"no such image: {missing[0]}{more}")
    if not files:
        listed = ", ".join(map(str, images)) or "an empty list"
        raise ValueError(f"no images in {listed} (folders within folders are not searched)")
    return files
