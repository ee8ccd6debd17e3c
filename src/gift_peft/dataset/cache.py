"""Groups at network size, decoded and resized once: uint8 images and masks in memory-mapped files.

An entry's name is a digest of what it was made from (the bytes of the picture files, size, filter), so it can never be
stale, and runs, datasets and processes share it. It holds a checksum: a damaged one is noticed and made again.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from pathlib import Path
from threading import Lock

import datasets
import numpy as np
import PIL
import safetensors
import safetensors.numpy
import safetensors.torch

from gift_peft.dataset.proxies import METADATA, mask_digests, picture_digests
from gift_peft.dataset.rows import RowRules
from gift_peft.dataset.tensors import Group, resize_pictures, to_group
from gift_peft.files import write_whole
from gift_peft.models.pixels import pixel_settings
from gift_peft.rules import SURFACES

FORMAT = "gift-peft group 2"
PICTURES = ("images", "masks", "valids")

logger = logging.getLogger(__name__)


def default_cache_dir() -> Path:
    """`$HF_HOME/gift-peft/groups`; it may be deleted at any time."""
    from huggingface_hub.constants import HF_HOME

    return Path(HF_HOME) / "gift-peft" / "groups"


class GroupCache:
    """Reads rows of `load_gift_i` as `Group`s, through files in `folder`.

    Args:
        dataset: rows as `load_gift_i` gives them, with or without proxies (which stay in their own files).
        processor, size: as for `collate_group`.
        folder: of the entries; None keeps nothing. If it cannot be written, one warning says so and nothing is kept.
    """

    def __init__(self, dataset: datasets.Dataset, processor, size: tuple[int, int], folder: Path | None) -> None:
        self.processor = processor
        self.size = size
        self.folder = folder
        rules = RowRules.of(dataset) or RowRules()
        self._train, self._proxies, self._surface = rules.train, rules.proxies, rules.surface
        self._groups = RowRules(rules.train, parsed=True).apply(dataset)
        self._stored = dataset.with_format("arrow")
        self._checked: dict[int, Path] = {}  # the entries that were found whole in this run
        self._written: set[int] = set()
        self._locks: dict[int, Lock] = {}

    def read(self, index: int, image: int | None = None) -> Group:
        """The group of one row, without its `pictures`; or one image of it, with its surface targets alone.

        Raises as reading the row and `collate_group` do.
        """
        path = self._checked.get(index) or self._path(index)
        found = None if path is None else self._load(path, check=index not in self._checked)
        arrays, digests = self._made(index, path) if found is None else found
        if found is not None:
            self._checked[index] = path
        group_id, names, surface = self._facts(index)
        proxies, targets, part = (None, None), (None, None), slice(None)
        if image is not None:  # the arrays are mapped into memory: only this image's pages are read
            part = slice(image, image + 1)
            arrays = {name: arrays[name][part] for name in PICTURES if name in arrays}
        elif self._proxies is not None:
            proxies = self._proxies.read(group_id, names, digests)
        if self._surface is not None:
            targets = self._surface.read(group_id, names, digests, part)
        return to_group(group_id, names[part], surface, arrays, proxies, self.processor, self.size, targets)

    def _made(self, index: int, path: Path | None) -> tuple[dict[str, np.ndarray], dict]:
        """(arrays, digests of the pictures) of a row without an entry; threads that want the same one wait."""
        with self._locks.setdefault(index, Lock()):
            found = self._load(path, check=True) if path is not None and index in self._written else None
            if found is None:
                pictures = self._groups[index]
                arrays = resize_pictures(pictures, self.processor, self.size)
                found = arrays, picture_digests(pictures) | mask_digests(pictures)
                if path is not None:
                    self._write(path, *found)
                    self._written.add(index)
            return found

    def _facts(self, index: int) -> tuple[str, list[str], str | None]:
        """(group id, image names, surface) of a row, whose pictures stay as they are stored."""
        table = self._stored[index]
        group_id, names, surface = (table[name][0].as_py() for name in ("group_id", "image_names", "surface"))
        return group_id, names, None if surface is None else SURFACES[surface]

    def _path(self, index: int) -> Path | None:
        """Where a row's entry is or will be; None if nothing can be kept (no folder, pictures behind URLs)."""
        if self.folder is None:
            return None
        filter_ = [PIL.__version__, pixel_settings(self.processor)["resample"]]
        settings = [FORMAT, *self.size, *filter_, self._train]  # which asks more of a row than an evaluation does
        digest = hashlib.blake2b(json.dumps(settings).encode(), digest_size=20)
        row = self._stored[index]
        for column in (*PICTURES, "reference"):
            value = row[column][0].as_py() if column in row.column_names else None
            for item in [value] if column == "reference" else value or []:
                content = _content(item)
                if content is None and item is not None:
                    return None
                digest.update(f"{column} {-1 if content is None else len(content)} ".encode())
                digest.update(content or b"")
        return self.folder / f"{digest.hexdigest()}.safetensors"

    def _load(self, path: Path, check: bool) -> tuple[dict[str, np.ndarray], dict] | None:
        """(arrays, digests of the pictures) of an entry, mapped into memory; None without one, or if it is damaged."""
        if not path.exists():
            return None
        try:
            with safetensors.safe_open(path, framework="np") as file:
                header = json.loads((file.metadata() or {})[METADATA])
            arrays = {name: tensor.numpy() for name, tensor in safetensors.torch.load_file(path).items()}
            if not check or header["checksum"] == _checksum(arrays):
                return arrays, header["digests"]
        except (safetensors.SafetensorError, KeyError, ValueError, OSError) as error:
            logger.debug("%s: %s", path, error)
        logger.warning("%s is damaged: decoding the group again", path)
        return None

    def _write(self, path: Path, arrays: dict[str, np.ndarray], digests: dict) -> None:
        header = json.dumps({"format": FORMAT, "digests": digests, "checksum": _checksum(arrays)})
        try:
            arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}  # or bytes come in disorder
            write_whole(path, safetensors.numpy.save(arrays, metadata={METADATA: header}))
        except OSError as error:
            logger.warning("groups are decoded anew each time, because the cache cannot be written: %s", error)
            self.folder = None


def _content(item: dict | None) -> bytes | None:
    """The bytes of a stored picture; None for one behind a URL, or none at all."""
    if item is None or (item["bytes"] is None and "://" in item["path"]):
        return None
    return item["bytes"] if item["bytes"] is not None else Path(os.fspath(item["path"])).read_bytes()


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).view(np.uint8))
    return digest.hexdigest()
