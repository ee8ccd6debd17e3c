"""Proxy files: what the frozen teacher predicts for a group, and everything needed to know that it still holds.

`proxies/<teacher>/<h>x<w>/<split>/<group_id>.safetensors` holds `proxies` (N, h, w) float32 in image order and, where
the group has a treated reference, `reference` (h, w): sets of several sizes lie side by side. The header names the
teacher, its revision, the size, the image processor's settings and a digest of every image's decoded content and of
its values: a proxy of other weights or pixels, or a damaged one, is never used. Sets of 0.1.0, which lie one folder
higher, are read where their size fits.

`<group_id>.surface.safetensors` beside it holds the surface targets, `target` and `target_flipped` (N, h, w) float32,
the second in the orientation of the flipped photo. Its header states that besides the masks and how it was made.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import safetensors

from gift_peft.files import reason, write_whole
from gift_peft.images import image_digest
from gift_peft.rules import SPLITS, GroupPictures
from gift_peft.surface_targets import MODELS, RULE

if TYPE_CHECKING:
    import torch

FORMAT = "gift-peft proxies 1"
SURFACE_FORMAT = "gift-peft surface targets 1"
METADATA = "gift_peft"
SURFACE_SUFFIX = ".surface"
EARLIER = "earlier_revision"  # expected of files of 0.1.0 in place of the revision; never written
TOLD = "told"  # of a surface target's header: what `evaluation.surface_check.describe` knows; never compared
# What a header says apart from pixels, in the order in which differences are told, and in words where those differ.
STATED = ("format", "teacher", "revision", "size", "processor", "kind", "rule")
STATED += ("fills", "seed", "surface_model", "surface_quantile", "surface_tau")
IN_WORDS = {"revision": "model or revision", "processor": "image processor"}
# Whether there are fills: measured in docs/surface-targets.md.
LEVELS = {
    True: {"surface_quantile": 0.65, "surface_tau": 0.5},
    False: {"surface_quantile": 0.8, "surface_tau": 0.7},
}


@dataclass(frozen=True)
class SurfaceSettings:
    """How surface targets are made; a file's header states every value.

    Args:
        fills (`int`): copies of each photo with its target painted, predicted beside it; 0 is allowed.
        seed (`int`): of the fills' colors.
        surface_model (`str`): "auto", "plane" or "quantile", as `surface_target` takes it.
        surface_quantile, surface_tau (`float`, *optional*): levels of the two models; higher is nearer. Default 0.65
            and 0.5 with fills, which show the surface; 0.8 and 0.7 without, where what lies behind has most votes.

    Raises:
        ValueError: a value out of range.
    """

    fills: int = 6
    seed: int = 0
    surface_model: str = "auto"
    surface_quantile: float | None = None
    surface_tau: float | None = None

    def __post_init__(self) -> None:
        if self.fills < 0 or self.seed < 0:
            raise ValueError(f"fills and seed: must not be negative, got {self.fills} and {self.seed}")
        if self.surface_model not in MODELS:
            raise ValueError(f"surface_model {self.surface_model!r}: it is one of {', '.join(MODELS)}")
        for name, level in LEVELS[self.fills > 0].items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, level)  # the only way in a frozen dataclass
        if not 0 <= self.surface_quantile <= 1:
            raise ValueError(f"surface_quantile: must lie from 0 to 1, got {self.surface_quantile}")
        if not 0 < self.surface_tau < 1:
            raise ValueError(f"surface_tau: must lie between 0 and 1, got {self.surface_tau}")

    def header(self) -> dict:
        """What a file's header states about how it was made."""
        return {"format": SURFACE_FORMAT, "rule": RULE, **asdict(self)}


def default_proxies_dir(dataset: str | Path, teacher: str) -> Path:
    """Where a dataset's proxies are unless told: `<folder>/proxies`, or the cache for what cannot be written.

    A folder that cannot be written and brings no proxies of this teacher, and a hub id, use
    `$HF_HOME/gift-peft/proxies/<dataset>`.
    """
    folder = Path(dataset)
    if folder.is_dir() and (os.access(folder, os.W_OK) or (folder / "proxies" / teacher).is_dir()):
        return folder / "proxies"
    from huggingface_hub.constants import HF_HOME

    slug = str(dataset).replace("/", "--")
    if folder.is_dir():
        resolved = str(folder.resolve())
        slug = f"{folder.resolve().name}-{hashlib.sha256(resolved.encode()).hexdigest()[:12]}"
    return Path(HF_HOME) / "gift-peft" / "proxies" / slug


def proxies_command(
    teacher, path, size=None, proxies_dir=None, revision=None, surface: SurfaceSettings | None = None
) -> str:
    """The shell command that makes these proxies, or surface targets."""
    options = {
        "--base": teacher,
        "--dataset": path,
        "--size": size,
        "--proxies_dir": proxies_dir,
        "--revision": revision,
    }
    if surface is not None:
        options["--target"] = "surface"
        defaults = SurfaceSettings(surface.fills)
        for field in fields(surface):
            value = getattr(surface, field.name)
            default = field.default if field.name == "fills" else getattr(defaults, field.name)
            options[f"--{field.name}"] = None if value == default else value
    given = [part for option, value in options.items() if value is not None for part in (option, str(value))]
    return shlex.join(["gift-peft", "proxies", *given])


def write_proxies(path: Path, header: dict, proxies: torch.Tensor, reference: torch.Tensor | None) -> None:
    """Write one file, whole or not at all."""
    _write(path, header, {"proxies": proxies} | ({} if reference is None else {"reference": reference}))


def write_surface(path: Path, header: dict, target: torch.Tensor, target_flipped: torch.Tensor) -> None:
    """Write the surface targets of a group, whole or not at all."""
    _write(path, header, {"target": target, "target_flipped": target_flipped})


def _write(path: Path, header: dict, tensors: dict[str, torch.Tensor]) -> None:
    import safetensors.torch

    tensors = {name: tensor.float().contiguous() for name, tensor in tensors.items()}
    digests = {name: [_digest(part) for part in _entries(tensor)] for name, tensor in tensors.items()}
    header = {**header, "values": digests}
    # One entry, because safetensors writes several in random order, and equal proxies shall be equal files.
    write_whole(path, safetensors.torch.save(tensors, metadata={METADATA: json.dumps(header, sort_keys=True)}))


def _entries(tensor: torch.Tensor) -> list[torch.Tensor]:
    """The (h, w) parts of what has an entry per image, or of one image."""
    return list(tensor.reshape(-1, *tensor.shape[-2:]))


def _digest(values: torch.Tensor) -> str:
    return hashlib.blake2b(values.contiguous().numpy().tobytes(), digest_size=16).hexdigest()


def make_header(teacher: str, revision: str, size: tuple[int, int], settings: dict) -> dict:
    """The part of a file's header that all groups share; `picture_digests` is the rest."""
    return {
        "format": FORMAT,
        "teacher": teacher,
        "revision": revision,
        "size": f"{size[0]}x{size[1]}",
        "processor": settings,
    }


def picture_digests(group: GroupPictures) -> dict:
    """The part of a header that pins one group's pixels: `images`, in order, and `reference` (None without one)."""
    return {
        "images": [image_digest(image) for image in group.images],
        "reference": None if group.reference is None else image_digest(group.reference),
    }


def mask_digests(group: GroupPictures) -> dict:
    """The part of a surface target's header that pins one group's masks, and the pixels that exist."""
    parts = {"masks": group.masks, "valids": group.valids}
    return {name: [_mask_digest(mask) for mask in masks] for name, masks in parts.items()}


def _mask_digest(mask: np.ndarray) -> str:
    digest = hashlib.blake2b(f"{mask.shape} ".encode(), digest_size=16)
    digest.update(np.packbits(mask).tobytes())
    return digest.hexdigest()


def read_header(path: Path, command: str = "gift-peft proxies", what: str = "proxy") -> dict:
    """The header of a proxy file, empty if it is not one of ours; ValueError if the file is damaged.

    For the message, `command` makes it, and it is called `what`.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            return json.loads((file.metadata() or {}).get(METADATA, "{}"))
    except (safetensors.SafetensorError, json.JSONDecodeError) as error:
        raise ValueError(
            f"damaged {what} {path} ({reason(error)}); make it again with `{command} --overwrite`"
        ) from None


def difference(header: dict, expected: dict, names: Sequence[str]) -> str | None:
    """In words, the first way in which a header is not the expected one; None if it is."""
    for key in STATED:
        if key == "revision" and header.get(key) == expected.get(EARLIER, ""):
            continue
        if key in expected and header.get(key) != expected[key]:
            return f"it was made with {IN_WORDS.get(key, key)} {header.get(key)}, not {expected[key]}"
    made, now = header.get("images", []), expected["images"]
    if len(made) != len(now):
        return f"it was made for {len(made)} images, and the group has {len(now)}"
    for what, part in (("image", "images"), ("the mask of", "masks"), ("the valid mask of", "valids")):
        if part not in expected or part not in header:
            continue
        if len(header[part]) != len(expected[part]):
            return "the valid masks have changed since"
        for name, before, after in zip(names, header[part], expected[part], strict=False):
            if before != after:
                return f"{what} {name} has changed since"
    if header.get("reference") != expected["reference"]:
        return "the treated reference has changed since"
    return None


def stored_sizes(folder: Path, split: str) -> set[str]:
    """The sizes ("<h>x<w>") of the sets of one teacher, whose folder this is, that have files of a split."""
    found = {path.name for path in folder.glob("*x*") if re.fullmatch(r"\d+x\d+", path.name)}
    found = {size for size in found if any((folder / size / split).glob("*.safetensors"))}
    return found | {_stated_size(path) for path in list((folder / split).glob("*.safetensors"))[:1]} - {""}


def has_earlier_set(folder: Path) -> bool:
    """Whether 0.1.0 has made proxies of the teacher whose folder this is."""
    return any((folder / split).is_dir() for split in SPLITS)


def _stated_size(path: Path) -> str:
    """What a file's header says; "" for one that is damaged or none of ours."""
    try:
        return str(read_header(path).get("size", ""))
    except (ValueError, AttributeError):
        return ""


@dataclass(frozen=True)
class ProxyStore:
    """The proxies of one split and teacher; reads one group at a time and checks it before handing it out.

    Args:
        teacher_folder (`str`): `proxies/<teacher>`.
        size (`str`): "<h>x<w>".
        split (`str`).
        expected (`dict`): header entries known beforehand: format, teacher, revision; and of sets of 0.1.0
            `earlier_revision`.
        command (`str`): the shell command that makes these proxies, for messages.
    """

    teacher_folder: str
    size: str
    split: str
    expected: dict
    command: str

    def path(self, file: str) -> Path:
        """Where a file is, or belongs if it is not there."""
        place, earlier = self.place(file), Path(self.teacher_folder) / self.split / file
        old = not place.exists() and earlier.exists() and _stated_size(earlier) == self.size
        return earlier if old else place

    def place(self, file: str) -> Path:
        """Where a file belongs."""
        return Path(self.teacher_folder) / self.size / self.split / file

    def read(self, group_id: str, names: Sequence[str], digests: dict) -> tuple[torch.Tensor, torch.Tensor | None]:
        """(proxies (N, h, w), reference (h, w) or None), float32, of a group with these `picture_digests`.

        Raises FileNotFoundError for a missing file and ValueError for a stale, damaged or NaN one, naming it and the
        command that makes it again.
        """
        tensors = self._read(f"{group_id}.safetensors", "proxy", ("proxies",), names, digests)
        return tensors["proxies"], tensors.get("reference")

    def _read(
        self,
        file: str,
        what: str,
        columns: tuple[str, ...],
        names: Sequence[str],
        digests: dict,
        part: slice = slice(None),
    ) -> dict[str, torch.Tensor]:
        """The tensors of a file, checked; of the columns, which have an entry per image, only this part."""
        path = self.path(file)
        if not path.exists():
            raise FileNotFoundError(f"missing {what} {path}; make it with `{self.command}`")
        header, again = read_header(path, self.command, what), f"make it again with `{self.command} --overwrite`"
        with safetensors.safe_open(path, framework="pt") as opened:
            stored = set(opened.keys())
            if not stored.issuperset(columns):
                raise ValueError(f"damaged {what} {path} (not a {what} file); {again}")
            tensors = {name: opened.get_tensor(name) for name in stored.difference(columns)}
            for name in columns:
                count, *_ = opened.get_slice(name).get_shape()
                if count != (made := len(header.get("images", range(count)))):
                    many = "proxies" if what == "proxy" else f"{what}s"
                    raise ValueError(f"damaged {what} {path} (it holds {count} of {made} {many}); {again}")
                tensors[name] = opened.get_slice(name)[part]
        for name, tensor in tensors.items():
            labels = names[part] if name in columns else [name]
            for label, values in zip(labels, tensor if name in columns else [tensor], strict=False):
                if not values.isfinite().all():
                    raise ValueError(f"NaN or infinite values in {what} {path} ({label}); {again}")
        for name, stated in header.get("values", {}).items():  # files of 0.1.0 have none
            stated = stated[part] if name in columns else stated
            if name in tensors and stated != [_digest(values) for values in _entries(tensors[name])]:
                raise ValueError(f"damaged {what} {path} (values of {name} have changed since it was made); {again}")
        if changed := difference(header, {**self.expected, **digests}, names):
            raise ValueError(f"stale {what} {path}: {changed}; {again}")
        return tensors


@dataclass(frozen=True)
class SurfaceStore(ProxyStore):
    """Likewise the surface targets; `expected` holds the entries of `SurfaceSettings.header` besides."""

    def read(
        self, group_id: str, names: Sequence[str], digests: dict, part: slice = slice(None)
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(target, target_flipped), each (N, h, w) float32 or of the images in `part`; `mask_digests` count too.

        Raises as `ProxyStore.read`.
        """
        columns = ("target", "target_flipped")
        file = f"{group_id}{SURFACE_SUFFIX}.safetensors"
        tensors = self._read(file, "surface target", columns, names, digests, part)
        return tensors["target"], tensors["target_flipped"]
