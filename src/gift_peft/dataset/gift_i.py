"""GIFT-I as `datasets` rows, one per group, from any of its forms: raw tree, prepared folder, parquet, or hub id.

`load_gift_i` reads them all and attaches proxies; `GiftI` is the builder of the raw tree, so that after
`import gift_peft` also `datasets.load_dataset("gift_i", data_dir=RAW)` works (paper section 5, the GIFT-I dataset).
"""

import glob
import hashlib
import os
import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import datasets
import pyarrow as pa
from datasets import ClassLabel, Features, List, Value
from datasets import Image as ImageFeature
from datasets.builder import Key
from huggingface_hub.constants import HF_HUB_CACHE
from tqdm import tqdm

from gift_peft.captures.tree import list_groups, raw_example
from gift_peft.dataset.digests import DigestCache, fingerprint
from gift_peft.dataset.proxies import (
    EARLIER,
    FORMAT,
    ProxyStore,
    SurfaceSettings,
    SurfaceStore,
    default_proxies_dir,
    has_earlier_set,
    proxies_command,
    stored_sizes,
)
from gift_peft.dataset.row_checks import check_rows
from gift_peft.dataset.rows import RowRules
from gift_peft.files import is_hub_id, is_leftover, reason
from gift_peft.models.identity import earlier_revision, teacher_id, teacher_revision
from gift_peft.models.pixels import pixel_settings
from gift_peft.rules import SPLITS, SURFACES

FEATURES = Features(
    {
        "group_id": Value("string"),
        "surface": ClassLabel(names=SURFACES),
        "image_names": List(Value("string")),
        "images": List(ImageFeature()),
        "masks": List(ImageFeature(mode="L")),
        "valids": List(ImageFeature(mode="L")),
        "depths": List(ImageFeature(mode="I;16")),
        "reference": ImageFeature(),
    }
)


# ---- the builder of the raw tree ----


@dataclass
class GiftIConfig(datasets.BuilderConfig):
    """Adds the tree's listing (names, sizes, times, inodes) to the cache key: a changed folder is read again.

    `datasets` keys the cache by the files it guesses from split words in path names, which may be some or none.
    `empty_masks` ("refuse" or "allow") says what photos without a target are in groups whose others have one.
    """

    empty_masks: str = "refuse"

    def create_config_id(self, config_kwargs: dict, custom_features=None) -> str:
        config_id = super().create_config_id(config_kwargs, custom_features)
        return f"{config_id}-{_listing_digest(self.data_dir)}" if self.data_dir else config_id


class GiftI(datasets.GeneratorBasedBuilder):
    """Reads `RAW[/train|/validation]/<group>/` as it is; rows hold paths, no image is copied."""

    VERSION = datasets.Version("1.0.0")
    BUILDER_CONFIG_CLASS = GiftIConfig
    DEFAULT_WRITER_BATCH_SIZE = 8  # embedded, 8 groups of 55 images stay far below arrow's 2 GiB offsets

    def _info(self):
        return datasets.DatasetInfo(description=__doc__, features=FEATURES)

    def _split_generators(self, dl_manager):
        # `config.data_files` holds splits that `datasets` guessed from words in path names; the tree itself says it.
        if not self.config.data_dir:
            raise ValueError('GIFT-I needs its folder: load_dataset("gift_i", data_dir="path/to/RAW")')
        return [
            datasets.SplitGenerator(
                name=split,
                gen_kwargs={
                    "groups": [str(group) for group in groups],
                    "split": split,
                    "root": str(self.config.data_dir),
                    "empty_masks": self.config.empty_masks,
                },
            )
            for split, groups in list_groups(self.config.data_dir).items()
        ]

    def _generate_shards(self, groups, split, root, empty_masks):
        yield from groups

    def _generate_examples(self, groups, split, root, empty_masks):
        for shard, folder in enumerate(groups):
            yield Key(shard, 0), raw_example(Path(folder), split, Path(root), empty_masks)


def _listing_digest(folder: str) -> str:
    digest, seen = hashlib.sha256(), set()
    for root, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(root)
        if real in seen:  # links in a loop; reading the tree says so
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if name != "proxies" and not name.startswith("."))
        for name in sorted(files):
            try:
                stat = os.stat(os.path.join(root, name))
            except OSError as error:  # a link that leads nowhere
                digest.update(f"{os.path.relpath(root, folder)}/{name} {error.errno}\n".encode())
                continue
            # Of a file that is changed and has its old time of modification put back, as rsync does, ctime is new.
            marks = stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino
            digest.update(f"{os.path.relpath(root, folder)}/{name} {' '.join(map(str, marks))}\n".encode())
    return digest.hexdigest()[:16]


# ---- loading ----


def load_gift_i(
    path: str | Path,
    split: str,
    teacher: str | Path | None = None,
    proxies_dir: str | Path | None = None,
    revision: str | None = None,
    size: tuple[int, int] | None = None,
    dataset_revision: str | None = None,
    surface: SurfaceSettings | None = None,
    empty_masks: str = "refuse",
) -> datasets.Dataset:
    """GIFT-I groups, checked, as a `datasets.Dataset` with `FEATURES`; with a teacher also their proxies.

    Groups stay in the dataset's order, images come in natural order, images listed twice are dropped. Rows are decoded
    when accessed, upright and 8-bit RGB. With `teacher`, accessed rows also have `proxies` (N, h, w) and
    `reference_proxy` (h, w) or None, float32 tensors, read from their own file and checked against the teacher's
    weights and the decoded images. Slices, shuffles, selections and DataLoader workers keep them.

    Args:
        path (`str` or `Path`): a prepared folder, a raw tree, a folder of parquet files, what `save_to_disk` wrote, or
            a hub dataset id.
        split (`str`): "train" or "validation", slices such as "train[:10]" included.
        teacher (`str` or `Path`, *optional*): the base model whose proxies to attach, a hub id or a folder.
        proxies_dir (`str` or `Path`, *optional*): where `gift-peft proxies` wrote them; default as it has it, the
            dataset's own `proxies` folder (see `default_proxies_dir`).
        revision (`str`, *optional*): of the teacher.
        size (`tuple[int, int]`, *optional*): (h, w) of the proxies; default that of the set that is there, if it is
            the only one.
        dataset_revision (`str`, *optional*): of a hub dataset.
        surface (`SurfaceSettings`, *optional*): with a teacher, attaches the surface targets made with these settings:
            accessed rows also have `surface_target` and `surface_target_flipped` (N, h, w), float32 tensors.
        empty_masks (`str`): of a raw tree, what photos without a target are in groups whose others have one: an error
            ("refuse"), or photos in which no target shows ("allow"). `empty_masks` in a `group.yaml` comes first.

    Raises:
        FileNotFoundError, ValueError: one line that names the file or group and says what to do.
    """
    dataset = _load_rows(path, split, dataset_revision, empty_masks)
    name = re.match(r"\w*", str(split)).group()
    dataset = check_rows(dataset, name, path, _picture_roots(path))
    rules = RowRules(train=name == "train")
    if teacher is not None:
        identity = teacher_id(teacher, revision)
        proxies = Path(proxies_dir) if proxies_dir else default_proxies_dir(path, identity)
        expected = {"format": FORMAT, "teacher": identity, "revision": teacher_revision(teacher, revision)}
        if Path(teacher).is_dir():  # of a hub id the commit pins all
            expected |= _expected_of_folder(teacher, has_earlier_set(proxies / identity))
        wanted = None if size is None else f"{size[0]}x{size[1]}"
        sizes = [wanted] if wanted else sorted(stored_sizes(proxies / identity, name))
        if len(sizes) > 1:
            raise ValueError(f"dataset {path}: proxies of {identity} at {' and '.join(sizes)}: give the size")
        expected |= {"size": sizes[0]} if sizes else {}
        command = partial(proxies_command, teacher, path, wanted, proxies_dir, revision)
        place = (str(proxies / identity), expected.get("size", "<size>"), name)
        rules = replace(rules, proxies=ProxyStore(*place, expected, command()))
        if surface is not None:
            rules = replace(rules, surface=SurfaceStore(*place, expected | surface.header(), command(surface)))
    return rules.apply(dataset)


def _expected_of_folder(teacher: str | Path, earlier: bool) -> dict:
    """What a proxy's header says of a teacher's folder besides its weights."""
    from gift_peft.models.loading import load_processor

    found = {EARLIER: earlier_revision(teacher)} if earlier else {}
    if (Path(teacher) / "preprocessor_config.json").is_file():
        found["processor"] = pixel_settings(load_processor(teacher))
    return found


def gift_i_splits(path: str | Path) -> list[str]:
    """Which of train and validation a dataset has, in any of its forms."""
    folder = Path(path)
    if not folder.is_dir():
        return [name for name in SPLITS if name in datasets.get_dataset_split_names(str(path))]
    if saved := _saved_splits(folder):
        return [name for name in SPLITS if name in saved]
    prepared = _prepared_splits(folder)
    if prepared or not _holds_parquet(folder):
        return prepared or list(list_groups(folder))
    return [name for name in SPLITS if name in datasets.get_dataset_split_names(str(folder))]


def _prepared_splits(folder: Path) -> list[str]:
    return [name for name in SPLITS if any((folder / name).glob("metadata.*"))]


def _saved_splits(folder: Path) -> dict[str, datasets.Dataset]:
    """What `Dataset.save_to_disk` or `DatasetDict.save_to_disk` left in a folder; empty for any other folder."""
    if not any((folder / name).is_file() for name in ("state.json", "dataset_dict.json")):
        return {}
    saved = datasets.load_from_disk(str(folder))
    return dict(saved) if isinstance(saved, datasets.DatasetDict) else {str(saved.split): saved}


def _load_saved(saved: dict[str, datasets.Dataset], split: str, path: str | Path) -> datasets.Dataset:
    """The rows of a split, or a slice of it, without what was added to them."""
    _check_split(split, saved, path)
    name = re.match(r"\w*", str(split)).group()
    (part,) = datasets.ReadInstruction.from_spec(str(split)).to_absolute({name: len(saved[name])})
    rows = saved[name].with_format(None)
    if missing := FEATURES.keys() - rows.features.keys():
        raise ValueError(f"dataset {path}: it lacks the column {min(missing)} of GIFT-I")
    rows = rows.select_columns(list(FEATURES)).select(range(part.from_, part.to))
    return rows if rows.features == FEATURES else rows.cast(FEATURES)


def _holds_parquet(folder: Path) -> bool:
    found = (*folder.glob("*.parquet"), *folder.glob("*/*.parquet"))
    return any(not any(map(is_leftover, path.relative_to(folder).parts)) for path in found)


def _load_rows(path: str | Path, split: str, revision: str | None, empty_masks: str) -> datasets.Dataset:
    """Rows whose images are still paths or bytes, under FEATURES."""
    folder = Path(path)
    if "+" in str(split):
        raise ValueError(f"split {split!r}: load one split at a time")
    try:
        if not folder.is_dir():
            return _load_from_hub(str(path), split, revision)
        if saved := _saved_splits(folder):
            return _load_saved(saved, split, path)
        if prepared := _prepared_splits(folder):
            # Named here, not left to the card: without one, `datasets` guesses splits from words in path names.
            # Escaped, because they are patterns, and a folder may be called "data [v2]".
            files = {name: f"{glob.escape(str(folder.absolute()))}/{name}/**" for name in prepared}
            _check_split(split, prepared, path)
            return datasets.load_dataset("imagefolder", data_files=files, split=split, features=FEATURES)
        if _holds_parquet(folder):
            return datasets.load_dataset(str(folder), split=split, features=FEATURES)
        _check_split(split, list_groups(folder), path)
        builder = GiftI(data_dir=str(folder), empty_masks=empty_masks)
        builder.download_and_prepare()
        return builder.as_dataset(split=split)
    except (FileNotFoundError, ValueError):
        raise
    except datasets.exceptions.DatasetGenerationError as error:
        if isinstance(cause := error.__cause__, FileNotFoundError | ValueError) and "\n" not in str(cause):
            raise cause from None
        raise _unreadable(path, cause or error) from None
    except (OSError, pa.ArrowException, TypeError, LookupError, AttributeError, RecursionError) as error:
        raise _unreadable(path, error) from None


def _unreadable(path: str | Path, error: BaseException) -> ValueError:
    return ValueError(f"dataset {path}: its metadata cannot be read ({reason(error)})")


def _load_from_hub(repository: str, split: str, revision: str | None) -> datasets.Dataset:
    if not is_hub_id(repository):
        raise FileNotFoundError(f"dataset {repository}: no such folder")
    try:
        return datasets.load_dataset(repository, split=split, features=FEATURES, revision=revision)
    except (FileNotFoundError, ConnectionError) as error:
        why = reason(error)
        raise FileNotFoundError(f"dataset {repository}: no such folder, nor on the hub ({why})") from None


def _check_split(split: str, present, path) -> None:
    if re.match(r"\w*", str(split)).group() not in present:
        raise ValueError(f"dataset {path}: no split {split!r}, only {', '.join(present)}")


def _picture_roots(path: str | Path) -> list[str]:
    """Where pictures may lie that a row names by path: whoever wrote the row shall not choose any file of ours."""
    folder = Path(path)
    if not folder.is_dir():
        caches = (datasets.config.HF_DATASETS_CACHE, datasets.config.DOWNLOADED_DATASETS_PATH, HF_HUB_CACHE)
        return ["hf://", *(os.path.abspath(cache) for cache in caches)]
    if not _prepared_splits(folder) and _holds_parquet(folder):
        return []
    return [os.path.abspath(folder)]


def dataset_fingerprint(dataset: datasets.Dataset) -> str:
    """32 hex digits of what a dataset holds: every group's names, image contents, masks and reference.

    The same for raw tree, prepared folder and parquet of the same groups, and for any order of the groups.
    """
    digests = DigestCache(dataset)
    bar = tqdm(range(len(digests)), "reading the dataset", unit="group", delay=2)
    return fingerprint(digests.read(index)[0].content for index in bar)
