"""`gift-peft export OUT DST`: parquet shards with the pictures' bytes inside and a card, the form to share.

A folder of thousands of small files is slow to upload and cannot be streamed; shards can, and hold the very bytes of
the files. Each row, a group, is a row group of its own, so that one group at a time is in memory, here and when
streaming. The folder goes to the Hub with `hf upload NAME DST . --repo-type dataset`, or row by row with
`datasets.load_dataset(DST).push_to_hub(NAME)`.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import datasets
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from datasets.info import DatasetInfosDict
from datasets.table import embed_table_storage
from huggingface_hub import DatasetCard
from tqdm import tqdm

from gift_peft.dataset.gift_i import FEATURES, gift_i_splits, load_gift_i
from gift_peft.dataset.writer import CARD
from gift_peft.files import check_replaceable, whole_folder

# The pictures are compressed already; statistics of them would be whole small pictures once more, several times;
# chunking by content lets a changed dataset upload only what changed.
OPTIONS = {
    "compression": "none",
    "write_statistics": ["group_id"],
    "use_content_defined_chunking": True,
    "write_page_index": True,
}
EMPTY_CARD = CARD.format(
    license="",
    pretty_name="GIFT-I",
    title="GIFT-I",
    description="Groups for GIFT fine-tuning of monocular depth models.",
    content="",
    counts="",
    data_files="",
)
UNITS = {"": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}


def export_parquet(
    source: str | Path, folder: str | Path, max_shard_size: int | str = "500MB", license: str | None = None
) -> Path:
    """Write a GIFT-I dataset as parquet shards, whole or not at all, and return the folder.

    `datasets.load_dataset(folder)`, also with `streaming=True`, and `load_gift_i(folder, split)` read it; images and
    masks are bit-equal to the source's. Every picture is decoded and checked before it is written.

    Args:
        source (`str` or `Path`): a dataset that `load_gift_i` reads, in any form.
        folder (`str` or `Path`): new or empty.
        max_shard_size (`int` or `str`): bytes, or for example "500MB". A group larger than that is a shard of its own.
        license (`str`, *optional*): for the card, for example "cc-by-4.0"; default: what the source's card states.

    Raises:
        ValueError, OSError: one line naming the file, group or argument.
    """
    source, folder = Path(source), Path(folder)
    limit = _bytes(max_shard_size)
    if folder.is_relative_to(source) or folder.resolve().is_relative_to(source.resolve()):
        raise ValueError(f"{folder} is inside {source}, whose files it would join; give another folder")
    check_replaceable(folder)
    card = _source_card(source, license)
    with whole_folder(folder) as place:
        splits = datasets.SplitDict()
        for split in gift_i_splits(source):
            rows = load_gift_i(source, split)
            content = _write_split(rows, split, place / "data", limit)
            splits.add(datasets.SplitInfo(split, num_bytes=content, num_examples=len(rows)))
        _complete_card(card, splits, place)
    return folder


def _write_split(rows: datasets.Dataset, split: str, folder: Path, limit: int) -> int:
    """Write `<split>-00000-of-0000N.parquet`; the rows' size in bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    total = size = 0
    writer = None
    try:
        for table in tqdm(_tables(rows), total=len(rows), desc=split, unit="group", disable=None):
            if writer is None or size + table.nbytes > limit:
                if writer is not None:
                    writer.close()
                written.append(folder / f"{split}-{len(written):05d}")
                writer = pq.ParquetWriter(written[-1], table.schema, **OPTIONS)
                size = 0
            writer.write_table(table)
            size += table.nbytes
            total += table.nbytes
    finally:
        if writer is not None:
            writer.close()
    for index, path in enumerate(written):
        path.rename(folder / f"{split}-{index:05d}-of-{len(written):05d}.parquet")
    return total


def _tables(rows: datasets.Dataset) -> Iterator[pa.Table]:
    """One-row tables with the pictures' bytes and file names in them."""
    stored = rows.with_format("arrow")
    for index in range(len(rows)):
        rows[index]  # decodes and checks the group: an error names its file
        yield embed_table_storage(stored[index : index + 1].cast(FEATURES.arrow_schema))


# ---- the card ----


def _source_card(source: Path, license: str | None) -> DatasetCard:
    """The source's card, or a new one; ValueError if neither it nor `license` states a licence."""
    path = source / "README.md"
    try:
        card = DatasetCard(path.read_text(encoding="utf-8") if path.is_file() else EMPTY_CARD)
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: its metadata is not valid YAML ({' '.join(str(error).split())})") from None
    card.data.license = license or card.data.license
    if not card.data.license:
        raise ValueError(f"{source} has no card (README.md) that states its licence; give --license")
    return card


def _complete_card(card: DatasetCard, splits: datasets.SplitDict, folder: Path) -> None:
    """State the shards of each split, its size and the features, and write the card."""
    files = [{"split": split, "path": f"data/{split}-*"} for split in splits]
    shards = sorted((folder / "data").iterdir())
    content = hashlib.blake2b(digest_size=8)  # without it `datasets` may take this folder for another of its name
    for shard in shards:
        with open(shard, "rb") as file:
            content.update(hashlib.file_digest(file, "blake2b").digest())
    description = f"content {content.hexdigest()}"
    card.data.configs = [{"config_name": "default", "description": description, "data_files": files}]
    info = datasets.DatasetInfo(
        features=FEATURES,
        splits=splits,
        download_size=sum(shard.stat().st_size for shard in shards),
        dataset_size=sum(split.num_bytes for split in splits.values()),
    )
    DatasetInfosDict({"default": info}).to_dataset_card_data(card.data)
    (folder / "README.md").write_text(str(card), encoding="utf-8")


def _bytes(size: int | str) -> int:
    text = str(size).strip().upper()
    digits = text.rstrip("KMGIB")
    unit = text[len(digits) :].strip()
    try:
        value = int(float(digits) * UNITS[unit])
    except (ValueError, KeyError, OverflowError):
        value = 0
    if value < 1:
        raise ValueError(f"max_shard_size {size!r}: write a size such as 500MB or 1GB")
    return value
