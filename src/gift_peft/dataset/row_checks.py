"""What can be known of a dataset's rows without decoding a picture: names, counts, order, and where the files lie."""

import hashlib
import os
from collections import Counter
from pathlib import Path

import datasets
import pyarrow as pa
import pyarrow.compute as pc
from datasets import Features, List
from datasets import Image as ImageFeature

from gift_peft.dataset.rows import IMAGE_COLUMNS
from gift_peft.images import natural_key
from gift_peft.rules import check_count, check_group_id


def check_rows(dataset: datasets.Dataset, split: str, path: str | Path, roots: list[str]) -> datasets.Dataset:
    """The dataset with images in natural order and none listed twice, if its rows hold.

    Args:
        dataset: under FEATURES. split, path: of it, for messages. roots: where pictures may lie that a row names by
            path; none where all are embedded.

    Raises:
        ValueError: two groups of one name, lists of different lengths, too few images, a picture outside of `roots`.
        FileNotFoundError: a picture that is not there.
    """
    counts = Counter(dataset["group_id"])
    for group_id, count in counts.items():
        check_group_id(group_id)
        if count > 1:
            raise ValueError(f"dataset {path}: {count} groups are called {group_id!r} in split {split}")
    tables = dataset.with_format("arrow")
    keep = [_check_row(tables[index], split, roots) for index in range(len(dataset))]
    if all(order == list(range(count)) for order, count in keep):
        return dataset
    stored = dataset.cast(_undecoded(dataset.features))
    columns = ("image_names", *IMAGE_COLUMNS)
    return stored.map(
        lambda row, index: {key: [row[key][k] for k in keep[index][0]] for key in columns if row[key]},
        with_indices=True,
        features=stored.features,
    ).cast(dataset.features)


def _check_row(table: pa.Table, split: str, roots: list[str]) -> tuple[list[int], int]:
    """Of one row: the images to keep, in natural order, and how many there are."""
    group_id, names = table["group_id"][0].as_py(), table["image_names"][0].as_py() or []
    for column in IMAGE_COLUMNS:
        files = table[column][0].values
        count = 0 if files is None else len(files)
        if count != len(names) and (count or column in ("images", "masks")):
            raise ValueError(f"group {group_id}: {len(names)} image names, but a list of {count} {column}")
        _check_present(files, f"group {group_id}: missing {column.removesuffix('s')}", roots)
    _check_present(table["reference"].combine_chunks(), f"group {group_id}: missing reference", roots)
    contents = _contents(table["images"][0].values)
    order = sorted(range(len(names)), key=lambda index: natural_key(names[index]))
    first = {}
    for index in order:
        first.setdefault(contents[index], index)
    check_count(group_id, len(first), split, table["reference"][0].is_valid)
    return list(first.values()), len(names)


def _check_present(files: pa.StructArray | None, missing: str, roots: list[str]) -> None:
    files = None if files is None else files.drop_null()  # a null's fields may hold anything, an empty path for one
    for file in [] if files is None else files.field("path").filter(files.field("bytes").is_null()).to_pylist():
        if file is None:
            continue
        if not _is_inside(file, roots):
            hint = "" if roots else "; in a parquet release the pictures are embedded (`gift-peft export`)"
            raise ValueError(f"{missing.replace(': missing ', ', ')}: {file} is a path outside of the dataset{hint}")
        if "://" not in file and not os.path.exists(file):
            raise FileNotFoundError(f"{missing} {file}")


def _is_inside(file: str, roots: list[str]) -> bool:
    place = file.rsplit("::", 1)[-1]  # of an archive's member, the archive
    if "://" in place:
        return "hf://" in roots and place.startswith("hf://")
    return any(os.path.abspath(place).startswith(os.path.join(root, "")) for root in roots)


def _contents(images: pa.StructArray) -> list:
    """Something equal for equal files: a digest where sizes collide, else just the position."""
    paths = images.field("path").to_pylist()
    lengths = pc.binary_length(images.field("bytes")).to_pylist()
    sizes = [
        length if length is not None else path if "://" in path else os.path.getsize(path)
        for path, length in zip(paths, lengths, strict=True)
    ]
    counts = Counter(sizes)
    contents = []
    for index, size in enumerate(sizes):
        if counts[size] == 1 or isinstance(size, str):
            contents.append(size if isinstance(size, str) else index)
        else:
            content = images.field("bytes")[index].as_py() or Path(paths[index]).read_bytes()
            contents.append(hashlib.sha256(content).digest())
    return contents


def _undecoded(features: Features) -> Features:
    plain = ImageFeature(decode=False)
    return Features({**features, **dict.fromkeys(IMAGE_COLUMNS, List(plain)), "reference": plain})
