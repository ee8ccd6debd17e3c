"""What a row of `load_gift_i` looks like when it is read: decoded by our image rules, checked, with its proxies.

A `datasets` formatter, not a wrapper: the result stays a plain `Dataset` (select, shuffle, slices, pickling,
DataLoader workers), only the rows that are accessed are decoded, and a damaged file is an error that names it, which
the decoding of the `Image` feature alone does not give.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import datasets
import numpy as np
import pyarrow as pa
from datasets import formatting
from datasets.formatting.formatting import Formatter
from PIL import Image

from gift_peft.dataset.proxies import ProxyStore, SurfaceStore, mask_digests, picture_digests
from gift_peft.images import open_image, to_mask, to_rgb
from gift_peft.rules import GroupPictures, parse_group

FORMAT_TYPE = "gift_i"
IMAGE_COLUMNS = ("images", "masks", "valids", "depths")


@dataclass(frozen=True)
class RowRules:
    """How rows are read.

    Args:
        train (`bool`): some mask of a group must have a target.
        proxies (`ProxyStore`, *optional*): adds `proxies` and `reference_proxy`.
        surface (`SurfaceStore`, *optional*): adds `surface_target` and `surface_target_flipped`.
        parsed (`bool`): a row is a `GroupPictures` in place of a dict.
    """

    train: bool = False
    proxies: ProxyStore | None = None
    surface: SurfaceStore | None = None
    parsed: bool = False

    @classmethod
    def of(cls, rows: Any) -> "RowRules | None":
        """Those of rows of `load_gift_i`; None of any other rows."""
        stated = rows.format["format_kwargs"].get("rules") if isinstance(rows, datasets.Dataset) else None
        return None if stated is None else cls.from_json(stated)

    @classmethod
    def from_json(cls, stated: dict) -> "RowRules":
        stores = {"proxies": ProxyStore, "surface": SurfaceStore}
        found = {name: kind(**stated[name]) for name, kind in stores.items() if stated.get(name) is not None}
        return cls(**{**stated, **found})

    def apply(self, rows: datasets.Dataset) -> datasets.Dataset:
        """The rows, read under these rules."""
        return rows.with_format(FORMAT_TYPE, rules=StatedRules(asdict(self)))


class StatedRules(dict):
    """Rules in JSON types, or `Dataset.save_to_disk` could not write them.

    Unpickling a dataset elsewhere imports this module for it, and with it the formatter.
    """


def parsed(rows: Any) -> Any:
    """Rows of `load_gift_i`, read as `GroupPictures` in place of dicts; any other rows as they are."""
    rules = RowRules.of(rows)
    return rows if rules is None else replace(rules, parsed=True).apply(rows)


class GiftIFormatter(Formatter):
    """Rows of GIFT-I, read under `rules`."""

    def __init__(self, rules: dict, features=None, token_per_repo_id=None):
        super().__init__(features=features, token_per_repo_id=token_per_repo_id)
        self.rules = RowRules.from_json(rules)

    def format_row(self, pa_table: pa.Table) -> dict | GroupPictures:
        return self._row(self.python_arrow_extractor().extract_row(pa_table))

    def format_batch(self, pa_table: pa.Table) -> dict[str, list]:
        rows = [self._row(row) for row in pa_table.to_pylist()]
        return {key: [row[key] for row in rows] for key in (rows[0] if rows else pa_table.column_names)}

    def format_column(self, pa_table: pa.Table) -> list:
        return self.format_batch(pa_table)[pa_table.column_names[0]]

    def _row(self, stored: dict) -> dict | GroupPictures:
        pictures = {key: stored[key] for key in (*IMAGE_COLUMNS, "reference") if key in stored}
        row = {key: value for key, value in stored.items() if key not in pictures}
        row = self.python_features_decoder.decode_row(row) if row else row
        at = f"group {stored.get('group_id', '?')}"
        for key, value in pictures.items():
            if key == "reference":
                row[key] = None if value is None else to_rgb(*_open(value, f"{at}, reference"))
            else:
                row[key] = [self._picture(key, item, at) for item in value or []]
        if pictures.keys() == {*IMAGE_COLUMNS, "reference"} and {"group_id", "image_names"} <= row.keys():
            group = self._parse(row)
            if self.rules.parsed:
                return group
            if self.rules.proxies is not None:
                row["proxies"], row["reference_proxy"] = group.proxies, group.reference_proxy
            if self.rules.surface is not None:
                row["surface_target"] = group.surface_target
                row["surface_target_flipped"] = group.surface_target_flipped
        return {key: row[key] for key in [*stored, *(key for key in row if key not in stored)]}

    def _picture(self, column: str, item: dict, at: str) -> Image.Image:
        image, name = _open(item, f"{at}, one of its {column}")
        if column == "images":
            return to_rgb(image, name)
        if column == "depths":
            if not image.mode.startswith("I"):
                raise ValueError(f"{name}: mode {image.mode}; depth is a 16-bit PNG in millimetres")
            return image
        # Other modes (palette, 16 bit) would change their values in a conversion to L: take the mask, write it as one.
        return image if image.mode == "L" else Image.fromarray(to_mask(image, name).astype(np.uint8) * 255)

    def _parse(self, row: dict) -> GroupPictures:
        group = parse_group(row)
        if self.rules.train:
            group.check_target()
        found, pixels = {}, {}
        if self.rules.proxies is not None:
            pixels = picture_digests(group)
            proxies, reference = self.rules.proxies.read(group.group_id, group.names, pixels)
            found = {"proxies": proxies, "reference_proxy": reference}
        if self.rules.surface is not None:
            pixels |= mask_digests(group)
            target, flipped = self.rules.surface.read(group.group_id, group.names, pixels)
            found |= {"surface_target": target, "surface_target_flipped": flipped}
        return replace(group, **found) if found else group


def _open(item: dict, fallback: str) -> tuple[Image.Image, str]:
    """The decoded image of a stored {"bytes", "path"} and the name to give it in messages."""
    name = fallback if item["bytes"] is not None else item["path"]
    if item["bytes"] is None and "://" in item["path"]:
        from datasets.utils.file_utils import xopen

        with xopen(item["path"], "rb") as file:
            return open_image(file.read(), name), name
    return open_image(item["path"] if item["bytes"] is None else item["bytes"], name), name


formatting._register_formatter(GiftIFormatter, FORMAT_TYPE)
