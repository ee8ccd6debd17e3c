"""What pins a group's pixels: digests of its decoded pictures and masks, kept so that no later start decodes them.

An entry's name says what they were made from: of a picture in a file its path, size, times and inode, of an embedded
one its bytes. Whatever changes a file, under any clock, changes one of those, and so the name; a file that was written
a moment ago may change once more within one tick of the clock, so its entry is not kept yet. Runs and processes share
the entries, which lie apart from the dataset, since that may be read-only; they may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import PIL

from gift_peft.dataset.proxies import mask_digests, picture_digests
from gift_peft.dataset.rows import RowRules
from gift_peft.files import write_whole
from gift_peft.rules import GroupPictures

FORMAT = "gift-peft digests 1"
COLUMNS = ("images", "masks", "valids", "reference")
SETTLED = 3.0  # seconds since a file's last change; FAT counts them in twos

logger = logging.getLogger(__name__)


def default_digests_dir() -> Path:
    """`$HF_HOME/gift-peft/digests`."""
    from huggingface_hub.constants import HF_HOME

    return Path(HF_HOME) / "gift-peft" / "digests"


@dataclass(frozen=True)
class GroupDigests:
    """Of one group: `pictures` and `masks` as headers of proxies state them, `content` of all that trains."""

    pictures: dict
    masks: dict
    content: str

    @classmethod
    def of(cls, group: GroupPictures) -> GroupDigests:
        pictures = picture_digests(group)
        return cls(pictures, mask_digests(group), _content_digest(group, pictures))


class DigestCache:
    """The digests of each row of a dataset; pictures are decoded only where nothing is known of them.

    Args:
        dataset: rows of `load_gift_i`.
        folder: of the entries; None keeps nothing. If it cannot be written, one warning says so and nothing is kept.
    """

    def __init__(self, dataset: datasets.Dataset, folder: Path | None = None) -> None:
        rules = RowRules.of(dataset) or RowRules()
        self.folder = folder
        self.groups = RowRules(rules.train, parsed=True).apply(dataset)
        self._train = rules.train  # asks more of a row than an evaluation does
        self._stored = dataset.with_format("arrow")

    def __len__(self) -> int:
        return len(self.groups)

    def read(self, index: int) -> tuple[GroupDigests, GroupPictures | None]:
        """(digests, the group if it was decoded for them); raises as reading the row does."""
        path = self._path(index)
        if (known := None if path is None else _load(path)) is not None:
            return known, None
        group = self.groups[index]
        found = GroupDigests.of(group)
        if path is not None:
            self._write(path, found)
        return found, group

    def facts(self, index: int) -> tuple[str, list[str]]:
        """(group id, image names) of a row, whose pictures stay as they are stored."""
        row = self._stored[index]
        return row["group_id"][0].as_py(), row["image_names"][0].as_py()

    def _path(self, index: int) -> Path | None:
        """Where a row's entry is or will be; None if nothing can be kept."""
        if self.folder is None:
            return None
        row = self._stored[index]
        known: list[Any] = [FORMAT, PIL.__version__, self._train, *self.facts(index)]
        for column in COLUMNS:
            value = row[column][0].as_py() if column in row.column_names else None
            items = [value] if column == "reference" else value or []
            marks = [None if item is None else _mark(item) for item in items]
            if any(mark is None and item is not None for mark, item in zip(marks, items, strict=True)):
                return None
            known.append([column, *marks])
        return self.folder / f"{hashlib.blake2b(json.dumps(known).encode(), digest_size=20).hexdigest()}.json"

    def _write(self, path: Path, found: GroupDigests) -> None:
        stated = asdict(found)
        try:
            write_whole(path, json.dumps({"digests": stated, "checksum": _checksum(stated)}))
        except OSError as error:
            logger.warning("pictures are decoded at each start, because their digests cannot be kept: %s", error)
            self.folder = None


def fingerprint(contents: Iterable[str]) -> str:
    """32 hex digits of a dataset, from the `content` of its groups in any order."""
    return hashlib.sha256("\n".join(sorted(contents)).encode()).hexdigest()[:32]


def _content_digest(group: GroupPictures, pictures: dict) -> str:
    """Of a group's name, and its images' names, contents, masks and reference."""
    digest = hashlib.sha256(group.group_id.encode())
    for name, image, mask in zip(group.names, pictures["images"], group.masks, strict=True):
        digest.update(f"\n{name} {image} ".encode())
        digest.update(np.packbits(mask).tobytes())
    for valid in group.valids:
        digest.update(np.packbits(valid).tobytes())
    if group.reference is not None:
        digest.update(pictures["reference"].encode())
    return digest.hexdigest()


def _mark(item: dict) -> list | None:
    """What changes when a stored picture does; None of one behind a URL, or that was written a moment ago."""
    if item["bytes"] is not None:
        return [len(item["bytes"]), hashlib.blake2b(item["bytes"], digest_size=20).hexdigest()]
    if "://" in item["path"]:
        return None
    try:
        stat = os.stat(item["path"])
    except OSError:  # whoever decodes it says so
        return None
    if time.time() - max(stat.st_mtime, stat.st_ctime) < SETTLED:  # or of a future that the clock has seen before
        return None
    return [os.path.abspath(item["path"]), stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]


def _load(path: Path) -> GroupDigests | None:
    """An entry; None without one that can be read, or if it is damaged."""
    try:
        entry = json.loads(path.read_text(encoding="utf-8"))
        if entry["checksum"] == _checksum(entry["digests"]):
            return GroupDigests(**entry["digests"])
    except OSError:  # there is none; or it cannot be read, and whoever makes it again says why
        return None
    except (ValueError, LookupError, TypeError) as error:
        logger.debug("%s: %s", path, error)
    logger.warning("%s is damaged: decoding the group again", path)
    return None


def _checksum(stated: dict) -> str:
    return hashlib.blake2b(json.dumps(stated, sort_keys=True).encode(), digest_size=16).hexdigest()
