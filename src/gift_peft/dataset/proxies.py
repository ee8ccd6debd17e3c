"""Proxy files: what the frozen teacher predicts for a group, and everything needed to know that it still holds.

`proxies/<teacher>/<split>/<group_id>.safetensors` holds `proxies` (N, h, w) float32 in image order and, where the
group has a treated reference, `reference` (h, w). The header names the teacher, its revision, the size, the image
processor's settings and a digest of every image's decoded content: a proxy of other weights or pixels is never used.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import safetensors

from gift_peft.files import reason, write_whole
from gift_peft.images import image_digest
from gift_peft.rules import GroupPictures

if TYPE_CHECKING:
    import torch

FORMAT = "gift-peft proxies 1"
METADATA = "gift_peft"


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


def write_proxies(path: Path, header: dict, proxies: torch.Tensor, reference: torch.Tensor | None) -> None:
    """Write one file, whole or not at all."""
    import safetensors.torch

    tensors = {"proxies": proxies.float().contiguous()}
    if reference is not None:
        tensors["reference"] = reference.float().contiguous()
    # One entry, because safetensors writes several in random order, and equal proxies shall be equal files.
    write_whole(path, safetensors.torch.save(tensors, metadata={METADATA: json.dumps(header, sort_keys=True)}))


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


def read_header(path: Path, command: str = "gift-peft proxies") -> dict:
    """The header of a proxy file, empty if it is not one of ours; ValueError if the file is damaged.

    `command` makes these proxies, for the message.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            return json.loads((file.metadata() or {}).get(METADATA, "{}"))
    except (safetensors.SafetensorError, json.JSONDecodeError) as error:
        raise ValueError(
            f"damaged proxy {path} ({reason(error)}); make it again with `{command} --overwrite`"
        ) from None


def difference(header: dict, expected: dict, names: Sequence[str]) -> str | None:
    """In words, the first way in which a proxy's header is not the expected one; None if it is."""
    for key in ("format", "teacher", "revision", "size", "processor"):
        if key in expected and header.get(key) != expected[key]:
            what = {"revision": "model or revision", "processor": "image processor"}.get(key, key)
            return f"it was made with {what} {header.get(key)}, not {expected[key]}"
    made, now = header.get("images", []), expected["images"]
    if len(made) != len(now):
        return f"it was made for {len(made)} images, and the group has {len(now)}"
    for name, before, after in zip(names, made, now, strict=True):
        if before != after:
            return f"image {name} has changed since"
    if header.get("reference") != expected["reference"]:
        return "the treated reference has changed since"
    return None


@dataclass(frozen=True)
class ProxyStore:
    """The proxies of one split and teacher; reads one group at a time and checks it before handing it out.

    Args:
        folder (`str`): `proxies/<teacher>/<split>`.
        expected (`dict`): header entries known beforehand: format, teacher, revision and perhaps size.
        command (`str`): the shell command that makes these proxies, for messages.
    """

    folder: str
    expected: dict
    command: str

    def read(self, group_id: str, names: Sequence[str], digests: dict) -> tuple[torch.Tensor, torch.Tensor | None]:
        """(proxies (N, h, w), reference (h, w) or None), float32, of a group with these `picture_digests`.

        Raises FileNotFoundError for a missing file and ValueError for a stale, damaged or NaN one, naming it and the
        command that makes it again.
        """
        import safetensors.torch

        path = Path(self.folder) / f"{group_id}.safetensors"
        if not path.exists():
            raise FileNotFoundError(f"missing proxy {path}; make it with `{self.command}`")
        header, tensors = read_header(path, self.command), safetensors.torch.load_file(path)
        proxies, reference = tensors.get("proxies"), tensors.get("reference")
        again = f"make it again with `{self.command} --overwrite`"
        if proxies is None:
            raise ValueError(f"damaged proxy {path} (not a proxy file); {again}")
        made = len(header.get("images", proxies))
        if len(proxies) != made:
            raise ValueError(f"damaged proxy {path} (it holds {len(proxies)} of {made} proxies); {again}")
        for name, proxy in [*zip(names, proxies, strict=False), ("reference", reference)]:
            if proxy is not None and not proxy.isfinite().all():
                raise ValueError(f"NaN or infinite values in proxy {path} ({name}); {again}")
        if changed := difference(header, {**self.expected, **digests}, names):
            raise ValueError(f"stale proxy {path}: {changed}; {again}")
        return proxies, reference
