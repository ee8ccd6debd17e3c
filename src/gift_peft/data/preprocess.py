"""From image files to the tensors of one group: decode, check, resize, normalise.

The same resize and the same rules serve teacher, training, evaluation and prediction, so a proxy and the prediction it
is compared with come from identical pixels. Images are resized by the image processor's own PIL filter, masks by the
nearest pixel centre.
"""

from __future__ import annotations

import hashlib
import io
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageOps

if TYPE_CHECKING:  # torch takes longer to import than the command line takes to answer --help
    import torch

SURFACES = ["mirror", "transparent"]
SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm"}
MAX_SIDE = 16384  # of an image at the network: a damaged file shall not ask for all memory
SINGLE_CHANNEL = ("1", "L", "P", "I", "I;16", "I;16B", "I;16L")


@dataclass
class Group:
    """Images of one camera pose and target geometry, ready for the network: N observations at size (h, w).

    Args:
        group_id (`str`): its name in the dataset.
        names (`list[str]`): N image names, for messages and per-sample rows.
        pixel_values (`torch.Tensor`): (N, 3, h, w) float32.
        mask (`torch.Tensor`): (N, h, w) bool, the target (non-Lambertian) region.
        valid (`torch.Tensor`, *optional*): (N, h, w) bool, False where a warped frame has no pixels.
        target (`torch.Tensor`, *optional*): (N, h, w) float32 proxies in native units.
        reference_pixel_values (`torch.Tensor`, *optional*): (1, 3, h, w) float32, the treated reference.
        reference_target (`torch.Tensor`, *optional*): (h, w) float32, the teacher's prediction on it.
        depths (`list[torch.Tensor]`, *optional*): N times (H, W) float32 true z-depth in mm at the images' original
            size, 0 where unknown.
        surface (`str`, *optional*): "mirror" or "transparent".
    """

    group_id: str
    names: list[str]
    pixel_values: torch.Tensor
    mask: torch.Tensor
    valid: torch.Tensor | None = None
    target: torch.Tensor | None = None
    reference_pixel_values: torch.Tensor | None = None
    reference_target: torch.Tensor | None = None
    depths: list[torch.Tensor] | None = None
    surface: str | None = None


# ---- decoding ----


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
        raise ValueError(f"{name}: not a readable image, or truncated ({str(error).splitlines()[0]})") from None
    if deep and image.mode not in SINGLE_CHANNEL:
        raise ValueError(f"{name}: a 16-bit image; save it with 8 bits per channel")
    return image


def to_rgb(image: Image.Image, name: str) -> Image.Image:
    """8-bit RGB from RGB, grey, palette and opaque RGBA; transparency, 16-bit, CMYK and others raise ValueError."""
    if image.mode == "RGB" and "transparency" not in image.info:
        return image
    if image.has_transparency_data:
        image = image.convert("RGBA")
        if image.getchannel("A").getextrema()[0] < 255:
            raise ValueError(f"{name}: the image has transparent pixels; save it as RGB without an alpha channel")
    elif image.mode.startswith(("I", "F")):
        raise ValueError(f"{name}: a 16-bit (or deeper) image, mode {image.mode}; save it with 8 bits per channel")
    elif image.mode not in ("1", "L", "P"):
        raise ValueError(f"{name}: colour mode {image.mode}; save it as 8-bit RGB")
    return image.convert("RGB")


def read_image(source: str | Path | bytes, name: str | None = None) -> Image.Image:
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


def label_items(group_id: str, names: Sequence[str], kind: str, items: Sequence | None, optional: bool = False):
    """Pairs (item, how to call it in a message), one per image name; ValueError if their number differs.

    `optional`: there may be none at all.
    """
    items = [] if items is None else list(items)
    if len(items) != len(names) and (items or not optional):
        raise ValueError(f"group {group_id}: {len(names)} image names, but {len(items)} {kind}s")
    return [(item, f"group {group_id}: the {kind} of {name}") for item, name in zip(items, names, strict=False)]


def check_group(
    group_id: str,
    names: Sequence[str],
    images: Sequence[Image.Image],
    masks: Sequence[np.ndarray],
    valids: Sequence[np.ndarray] = (),
    depths: Sequence[np.ndarray] = (),
    reference: Image.Image | None = None,
    train: bool = False,
) -> None:
    """Raise ValueError unless every part of a group has the size of its images and, in `train`, a target somewhere."""
    size = images[0].size[::-1]
    parts = [("image", [image.size[::-1] for image in images])]
    parts += [(kind, [array.shape for array in arrays]) for kind, arrays in (("mask", masks), ("valid mask", valids))]
    parts += [("depth", [array.shape for array in depths])]
    for kind, shapes in parts:
        for name, shape in zip(names, shapes, strict=False):
            if tuple(shape) != size:
                raise ValueError(
                    f"group {group_id}: the {kind} of {name} is {shape[0]}x{shape[1]} (height x width), "
                    f"but the image {names[0]} is {size[0]}x{size[1]}"
                )
    if reference is not None and reference.size[::-1] != size:
        raise ValueError(
            f"group {group_id}: the reference is {reference.height}x{reference.width} (height x width), "
            f"but the image {names[0]} is {size[0]}x{size[1]}"
        )
    if train and not any(mask.any() for mask in masks):
        raise ValueError(
            f"group {group_id}: every mask is empty, so there is nothing to train on; draw the target in 255, "
            "or name its value in group.yaml (`mask_class: 2`)"
        )


# ---- resizing ----


def parse_size(text: str) -> tuple[int, int]:
    """(476, 644) from "476x644" (height x width)."""
    height, cross, width = text.lower().replace("×", "x").partition("x")
    if not (cross and height.strip().isdigit() and width.strip().isdigit()):
        raise ValueError(f"size {text!r}: write HEIGHTxWIDTH, for example 476x644")
    return int(height), int(width)


def resolve_size(size, recipe=None, processor=None, config=None) -> tuple[int, int]:
    """The (height, width) everything is resized to: `size` ("HxW" or a pair), else the recipe's, else the processor's.

    `config` is the model's configuration, whose patch size the processor does not always know. Raises ValueError when
    no size is fixed, or when it is not a multiple of the patch size.
    """
    if size is None:
        size = getattr(recipe, "size", None)
    if size is None:
        stated = getattr(processor, "size", None) or {}
        size = (stated["height"], stated["width"]) if "height" in stated and "width" in stated else None
    if not size:
        raise ValueError("the image processor states no height and width; give a size, for example --size 476x644")
    height, width = parse_size(size) if isinstance(size, str) else (int(side) for side in size)
    multiple = _size_multiple(processor, config)
    if height < 1 or width < 1 or height % multiple or width % multiple:
        near = tuple(max(multiple, round(side / multiple) * multiple) for side in (height, width))
        raise ValueError(
            f"size {height}x{width}: both sides must be positive multiples of the patch size {multiple}, "
            f"for example {near[0]}x{near[1]}"
        )
    if max(height, width) > MAX_SIDE:
        raise ValueError(f"size {height}x{width}: at most {MAX_SIDE} on a side")
    return height, width


def _size_multiple(processor, config) -> int:
    backbone = getattr(config, "backbone_config", None)
    candidates = (
        getattr(processor, "ensure_multiple_of", None),
        getattr(config, "patch_size", None),
        getattr(backbone, "patch_size", None),
    )
    return math.lcm(*(value for value in candidates if isinstance(value, int) and value > 0))


def pixel_settings(processor) -> dict:
    """What a processor does to pixels besides the size: resample filter, rescale factor (or None), mean and std."""
    normalize = getattr(processor, "do_normalize", True)
    rescale = getattr(processor, "do_rescale", True)
    resample = getattr(processor, "resample", None)
    return {
        "resample": int(Image.Resampling.BILINEAR if resample is None else resample),  # None is bilinear to HF as well
        "rescale_factor": float(processor.rescale_factor) if rescale else None,
        "image_mean": [float(value) for value in processor.image_mean] if normalize else None,
        "image_std": [float(value) for value in processor.image_std] if normalize else None,
    }


def to_pixel_values(images: Sequence[Image.Image], processor, size: tuple[int, int]) -> torch.Tensor:
    """N RGB images to (N, 3, h, w) float32, bit for bit what the processor's PIL backend gives when set to `size`.

    Keep-aspect and padding settings are ignored: `size` is final. Spelled out here because the torchvision backend,
    which transformers takes where torchvision is installed, has another bicubic.
    """
    return normalize_pixels(resize_images(images, processor, size), processor)


def resize_images(images: Sequence[Image.Image], processor, size: tuple[int, int]) -> np.ndarray:
    """N RGB images to (N, 3, h, w) uint8 with the processor's filter."""
    height, width = size
    resample = Image.Resampling(pixel_settings(processor)["resample"])
    return np.stack([np.asarray(image.resize((width, height), resample)).transpose(2, 0, 1) for image in images])


def normalize_pixels(pixels: np.ndarray, processor) -> torch.Tensor:
    """(N, 3, h, w) uint8 to float32 with the processor's scale, mean and std, looked up: there are 256 values."""
    import torch

    settings = pixel_settings(processor)
    levels = np.arange(256, dtype=np.uint8)
    if settings["rescale_factor"] is not None:
        levels = levels.astype(np.float64) * settings["rescale_factor"]  # float64 first, as transformers does
    table = np.repeat(levels.astype(np.float32)[None], 3, axis=0)
    if settings["image_mean"] is not None:
        table = (table - np.float32(settings["image_mean"])[:, None]) / np.float32(settings["image_std"])[:, None]
    values = torch.empty(pixels.shape, dtype=torch.float32)
    for planes, target in zip(pixels, values.numpy(), strict=True):
        for channel in range(3):
            np.take(table[channel], planes[channel], out=target[channel], mode="clip")  # "raise" makes a copy
    return values


def resize_mask(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool to (h, w) bool by nearest neighbour: it stays a set of pixels, nothing is invented between."""
    # In whole numbers: Pillow's nearest takes either side where the centre falls between two pixels.
    rows, columns = ((2 * np.arange(new) + 1) * old // (2 * new) for new, old in zip(size, mask.shape, strict=True))
    return np.asarray(mask, dtype=bool)[np.ix_(rows, columns)]


# ---- one row of the dataset ----


def collate_group(row: dict, processor, size: tuple[int, int]) -> Group:
    """One GIFT-I row (decoded images; proxies if `load_gift_i` attached them) as a `Group` at size (h, w).

    Raises ValueError naming the group and image for a mask of another size, a mask that is not one, an image that is
    not 8-bit RGB, and proxies made at another size.
    """
    import torch

    group = to_group(row, resize_row(row, processor, size), processor, size)
    group.depths = [
        torch.from_numpy(np.asarray(depth).astype(np.float32)) for depth in row.get("depths") or []
    ] or None
    return group


def resize_row(row: dict, processor, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """What of a decoded row depends on pixels, at size (h, w).

    `images` (N, 3, h, w) uint8, `masks` (N, h, w) bool and, where the row has them, `valids` (N, h, w) bool and
    `reference` (1, 3, h, w) uint8. Raises ValueError as `collate_group`.
    """
    group_id, names = row["group_id"], list(row["image_names"])
    images = [to_rgb(*item) for item in label_items(group_id, names, "image", row["images"])]
    masks = [to_mask(*item) for item in label_items(group_id, names, "mask", row["masks"])]
    valids = [to_mask(*item) for item in label_items(group_id, names, "valid mask", row.get("valids"), True)]
    depths = [np.asarray(depth) for depth, _ in label_items(group_id, names, "depth", row.get("depths"), True)]
    reference = row.get("reference")
    reference = None if reference is None else to_rgb(reference, f"group {group_id}: the reference")
    check_group(group_id, names, images, masks, valids, depths, reference)
    arrays = {"images": resize_images(images, processor, size), "masks": _stack_masks(masks, size)}
    if valids:
        arrays["valids"] = _stack_masks(valids, size)
    if reference is not None:
        arrays["reference"] = resize_images([reference], processor, size)
    return arrays


def to_group(row: dict, arrays: dict[str, np.ndarray], processor, size: tuple[int, int]) -> Group:
    """A `Group` of a row's names and proxies, and what `resize_row` gives; ValueError for proxies of another size."""
    import torch

    surface = row.get("surface")
    return Group(
        group_id=row["group_id"],
        names=list(row["image_names"]),
        pixel_values=normalize_pixels(arrays["images"], processor),
        mask=torch.from_numpy(arrays["masks"]),
        valid=torch.from_numpy(arrays["valids"]) if "valids" in arrays else None,
        target=_sized_proxies(row.get("proxies"), size, row["group_id"]),
        reference_pixel_values=normalize_pixels(arrays["reference"], processor) if "reference" in arrays else None,
        reference_target=_sized_proxies(row.get("reference_proxy"), size, row["group_id"]),
        surface=SURFACES[surface] if isinstance(surface, int) else surface,
    )


def _stack_masks(masks: Sequence[np.ndarray], size: tuple[int, int]) -> np.ndarray:
    return np.stack([resize_mask(mask, size) for mask in masks])


def _sized_proxies(proxies, size: tuple[int, int], group_id: str) -> torch.Tensor | None:
    if proxies is None:
        return None
    import torch

    proxies = torch.as_tensor(proxies)
    if tuple(proxies.shape[-2:]) != tuple(size):
        made = "x".join(map(str, proxies.shape[-2:]))
        raise ValueError(
            f"group {group_id}: its proxies are {made} but the size in use is {size[0]}x{size[1]}; "
            f"make them again with `gift-peft proxies --size {size[0]}x{size[1]} --overwrite`"
        )
    return proxies
