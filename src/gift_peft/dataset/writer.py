"""Write a prepared GIFT-I folder: the tree that plain `datasets.load_dataset(folder)` reads with no code of ours.

One `metadata.parquet` per split, both with the same explicit schema (ImageFolder refuses splits whose columns differ),
a readable copy `groups.jsonl`, and a dataset card whose YAML names the files of each split.
"""

import hashlib
import json
import re
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from gift_peft.files import whole_folder, write_whole
from gift_peft.images import HEIF_SUFFIXES, JPEG_SUFFIXES, image_digest, open_image, to_mask, to_rgb
from gift_peft.rules import SPLITS, SURFACES, check_group_id, parse_group

NAMES = pa.list_(pa.string())
SCHEMA = pa.schema(
    [
        ("group_id", pa.string()),
        ("surface", pa.string()),
        ("image_names", NAMES),
        ("images_file_names", NAMES),
        ("masks_file_names", NAMES),
        ("valids_file_names", NAMES),
        ("depths_file_names", NAMES),
        ("reference_file_name", pa.string()),
    ]
)

GROUP_FILES = ("images/*", "masks/*", "valids/*", "depths/*", "reference.*")  # what a group's folder holds
CARD = """---
license: {license}
pretty_name: {pretty_name}
task_categories:
- depth-estimation
tags:
- gift-peft
configs:
- config_name: default
  description: content {content}
  data_files:
{data_files}
---
# {title}

{description}

{counts}

Each row is a group: images of one camera pose and target geometry, in which what is reflected or seen through the
target changes. `masks` mark the target in each image, `reference` is the same scene with the target's surface treated,
`depths` is true z-depth in millimetres (0 = unknown), for evaluation only.

```python
import datasets
import gift_peft

groups = datasets.load_dataset("path/to/this/folder")  # plain rows
groups = gift_peft.load_gift_i("path/to/this/folder", "train")  # checked rows, with proxies if a teacher is named
```
"""


def write_gift_i(
    groups: Iterable[dict],
    folder: str | Path,
    *,
    license: str,
    pretty_name: str = "GIFT-I",
    description: str = "Groups for GIFT fine-tuning of monocular depth models.",
) -> Path:
    """Write groups as a prepared GIFT-I folder, each one whole or not at all, and return the folder.

    Groups already in the folder stay; one with the same split and id is replaced. Every image is decoded and checked
    before anything of its group is written.

    Args:
        groups (`Iterable[dict]`): each with `split` ("train" or "validation"), `group_id` (a file name without
            separators), `images` (N paths or PIL images), `masks` (N paths, PIL images or (H, W) bool arrays), and
            optionally `surface` ("mirror", "transparent" or None), `image_names` (N strings; default the files'
            names), `valids` (like masks, or empty), `depths` (N paths of 16-bit PNGs or (H, W) uint16 arrays in mm,
            0 = unknown, or empty) and `reference` (path or PIL image). Image files are copied, PIL images become PNG.
        folder (`str` or `Path`): made if it does not exist.
        license (`str`): for the card, for example "cc-by-4.0".

    Raises:
        ValueError, FileNotFoundError: one line naming the file or group.
    """
    folder = Path(folder)
    rows = {split: _read_rows(folder / split / "metadata.parquet") for split in SPLITS}
    for group in groups:
        row = write_group(group, folder)
        rows[group["split"]][row["group_id"]] = row
        write_rows(rows, folder)
    write_card(rows, folder, license, pretty_name, description)
    return folder


def write_rows(rows: dict[str, dict[str, dict]], folder: Path) -> None:
    """The table of each split: `rows[split][group_id]` as `write_group` gives them; no table for an empty split."""
    for split in SPLITS:
        path = folder / split / "metadata.parquet"
        if rows[split]:
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_metadata(path, rows[split].values())
        else:
            path.unlink(missing_ok=True)


def write_card(
    rows: dict[str, dict[str, dict]], folder: Path, license: str, pretty_name: str, description: str
) -> None:
    """The readable table and the dataset card; ValueError if there is no group."""
    lines = [json.dumps({"split": split, **row}) + "\n" for split in SPLITS for row in rows[split].values()]
    if not lines:
        raise ValueError(f"no groups to write to {folder}")
    # `datasets` caches what it reads under the folder's last name and what the card says of its files, nothing else:
    # two folders of one name would be taken for each other.
    content = hashlib.blake2b("\n".join([str(folder.resolve()), *lines]).encode(), digest_size=8).hexdigest()
    write_whole(folder / "groups.jsonl", "".join(lines))
    write_whole(folder / "README.md", _card(rows, license, pretty_name, description, content))


def _read_rows(path: Path) -> dict[str, dict]:
    return {row["group_id"]: row for row in pq.read_table(path).to_pylist()} if path.exists() else {}


def write_group(group: dict, root: Path) -> dict:
    """Check a group, write its folder beside the final place and rename it there; its metadata row.

    `group` as `write_gift_i` takes it, `root` the prepared folder. Until the row is in the table the group is not
    part of the dataset. Raises ValueError or FileNotFoundError naming the file or group.
    """
    group_id, split = group["group_id"], group.get("split")
    if split not in SPLITS:
        raise ValueError(f"group {group_id}: split {split!r}; write train or validation")
    check_group_id(group_id)
    surface, reference = group.get("surface"), group.get("reference")
    if surface is not None and surface not in SURFACES:
        raise ValueError(f"group {group_id}: surface {surface!r}; it is one of {', '.join(SURFACES)} or None")
    names = list(group.get("image_names") or _default_names(group["images"]))
    pictures = parse_group({**group, "image_names": names}, _rgb, _mask, _depth)
    if split == "train":
        pictures.check_target()
    least = 1 if split == "train" or reference is not None else 2
    if len({image_digest(image) for image in pictures.images}) < max(least, len(names)):
        raise ValueError(f"group {group_id}: {len(names)} images; it takes at least {least}, all different")

    stems = [f"{index:02d}_{re.sub(r'[^A-Za-z0-9_.-]', '_', Path(name).stem)}" for index, name in enumerate(names)]
    parts = {"images": group["images"], **{kind: getattr(pictures, kind) for kind in ("masks", "valids", "depths")}}
    row = {"group_id": group_id, "surface": surface, "image_names": names}
    with whole_folder(root / split / group_id, GROUP_FILES) as folder:
        for kind, items in parts.items():
            files = [_save(item, folder / kind / stem) for item, stem in zip(items, stems, strict=False)]
            row[f"{kind}_file_names"] = [f"{group_id}/{kind}/{file}" for file in files]
        file = None if reference is None else f"{group_id}/{_save(reference, folder / 'reference')}"
    return row | {"reference_file_name": file}


def _default_names(images: list) -> list[str]:
    return [
        f"{index:02d}.png" if isinstance(image, Image.Image) else Path(image).name
        for index, image in enumerate(images)
    ]


def _rgb(source, name: str) -> Image.Image:
    at = name if isinstance(source, Image.Image) else str(source)
    return to_rgb(open_image(source, at), at)


def _mask(source, name: str) -> np.ndarray:
    if isinstance(source, np.ndarray):
        if source.ndim != 2 or source.dtype not in (bool, np.uint8):
            raise ValueError(f"{name}: a mask is (H, W) bool, got {source.shape} {source.dtype}")
        return source if source.dtype == bool else to_mask(Image.fromarray(source), name)
    at = name if isinstance(source, Image.Image) else str(source)
    return to_mask(open_image(source, at), at)


def _depth(source, name: str) -> np.ndarray:
    if not isinstance(source, np.ndarray):
        image = open_image(source, str(source))
        if not image.mode.startswith("I"):
            raise ValueError(f"{source}: mode {image.mode}; depth is a 16-bit PNG in millimetres")
        source = np.asarray(image)
    if source.ndim != 2 or not np.issubdtype(source.dtype, np.integer) or source.min() < 0 or source.max() > 65535:
        raise ValueError(f"{name}: depth is (H, W), whole millimetres from 0 (unknown) to 65535")
    return source.astype(np.uint16)


def _save(item, stem: Path) -> str:
    """Write one picture under `stem` and return its file name: files are copied, everything else becomes PNG."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(item, str | Path):
        suffix = Path(item).suffix.lower()
        if suffix not in (*HEIF_SUFFIXES, ".avif"):  # those become PNG: not every reader of the folder knows them
            target = stem.with_name(stem.name + (".jpg" if suffix in JPEG_SUFFIXES else suffix))
            shutil.copyfile(item, target)
            return target.name
    target = stem.with_name(stem.name + ".png")
    if isinstance(item, np.ndarray):
        item = Image.fromarray(item.astype(np.uint8) * 255 if item.dtype == bool else item)
    else:
        item = _rgb(item, str(item) if isinstance(item, str | Path) else stem.name)
    item.save(target, compress_level=4)  # of a photo as small as at the usual 6, in a third of the time
    return target.name


def _write_metadata(path: Path, rows: Iterable[dict]) -> None:
    sink = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist(list(rows), schema=SCHEMA), sink)
    write_whole(path, sink.getvalue().to_pybytes())


def _card(rows: dict[str, dict], license: str, pretty_name: str, description: str, content: str) -> str:
    present = [split for split in SPLITS if rows[split]]
    images = {split: sum(len(row["image_names"]) for row in rows[split].values()) for split in present}
    counts = [f"{split}: {len(rows[split])} groups, {images[split]} images" for split in present]
    return CARD.format(
        license=license,
        pretty_name=json.dumps(pretty_name),
        title=pretty_name,
        description=description,
        content=content,
        counts="; ".join(counts) + ".",
        data_files="\n".join(f"  - split: {split}\n    path: {split}/**" for split in present),
    )
