"""Which model this is: the folder of its proxies, and what pins its weights.

Weights are pinned by their tensors, not by their files: the same model re-saved, sharded or with Windows line ends is
the same model.
"""

import functools
import hashlib
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gift_peft.files import is_hub_id, reason

if TYPE_CHECKING:
    import torch

TENSORS, FILES = "tensors:", "sha256:"  # what pins a folder's weights, now and in 0.1.0
# What weights are loaded from, in transformers' order; a base of pickles alone is refused.
WEIGHTS = ("model.safetensors", "model.safetensors.index.json")
# Of config.json: what says nothing of the predictions, or changes when a model is saved again.
NOT_COMPARED = {"_name_or_path", "architectures", "auto_map", "dtype", "torch_dtype", "transformers_version"}


def teacher_id(base: str | Path, revision: str | None = None) -> str:
    """The teacher's folder under `proxies/`: `owner--name[@revision]` for a hub id, the folder's name for a path."""
    name = Path(base).resolve().name if Path(base).is_dir() else str(base).replace("/", "--")
    name = re.sub(r"[^A-Za-z0-9._@-]", "_", name + (f"@{revision}" if revision else ""))
    if name.strip(".") == "":
        raise ValueError(f"base model {str(base)!r}: neither a folder nor a hub id")
    return name


def check_base_name(base: str | Path) -> None:
    """Raise FileNotFoundError unless `base` is a folder or could be a hub id, ValueError for an adapter's folder."""
    folder = Path(base)
    if not folder.is_dir() and not is_hub_id(base):
        raise FileNotFoundError(f"base model {base}: no such folder")
    if (folder / "adapter_config.json").is_file() and not (folder / "config.json").is_file():
        raise adapter_as_base(base)


def adapter_as_base(base: str | Path) -> ValueError:
    """The error that says what to do with an adapter in the place of a base."""
    return ValueError(
        f"base model {base}: this is an adapter. To use it: --base ITS-BASE --adapter {base}. To go on with its run: "
        "the run's command with --resume_from_checkpoint latest. To train on top of it, merge it first: "
        f'PeftModel.from_pretrained(base, "{base}").merge_and_unload().save_pretrained("merged")'
    )


def pickles_alone(base: str | Path) -> ValueError:
    """The error for a base without safetensors: a pickle could run code."""
    return ValueError(f"base model {base}: it has pickled weights only (.bin); take safetensors")


def teacher_revision(base: str | Path, revision: str | None = None) -> str:
    """What pins the teacher: the hub commit, or of a local folder `weights_revision`.

    Raises FileNotFoundError if the model is neither a folder nor on the hub (or in its local cache).
    """
    if Path(base).is_dir():
        return weights_revision(base)
    from transformers.utils.hub import extract_commit_hash

    return extract_commit_hash(str(_config_file(base, revision)), None) or "unknown"


def weights_revision(base: str | Path, revision: str | None = None) -> str:
    """`tensors:COUNT-LAYOUT-VALUES-CONFIG`: digests of the tensors' names and shapes, of their float32 values, and of
    what config.json states besides, in whatever files they are.

    Raises FileNotFoundError where there is no config.json, ValueError for weights that cannot be read.
    """
    folder = _config_file(base, revision).parent
    paths = _weight_files(folder, base)
    tensors = "-".join(_digest_tensors(_stats(paths, base), str(base)))
    return f"{TENSORS}{tensors}-{_digest_config(folder)}"


def earlier_revision(base: str | Path) -> str:
    """What pinned a folder's weights in 0.1.0: a digest of the files of its configuration and weights."""
    files = [Path(base) / name for name in ("config.json", "preprocessor_config.json")]
    files += sorted(path for path in Path(base).iterdir() if path.suffix in (".safetensors", ".bin"))
    return f"{FILES}{_digest_files(_stats([path for path in files if path.exists()], base))}"


def weights_difference(one: str, other: str) -> str | None:
    """How the weights of `other` differ from those of `one` (each a `weights_revision`), in words; None if equal."""
    parts = [revision.removeprefix(TENSORS).split("-") for revision in (one, other)]
    if parts[0][0] != parts[1][0]:
        return f"it has {parts[1][0]} tensors, not {parts[0][0]}"
    words = ["its tensors have other names or shapes", "its tensors have other values"]
    words.append("its config.json says otherwise")
    return next((text for text, a, b in zip(words, parts[0][1:], parts[1][1:], strict=True) if a != b), None)


def _config_file(base: str | Path, revision: str | None) -> Path:
    if Path(base).is_dir():
        check_base_name(base)
        if not (Path(base) / "config.json").is_file():
            raise FileNotFoundError(f"base model {base}: the folder has no config.json")
        return Path(base) / "config.json"
    from transformers.utils.hub import cached_file

    check_base_name(base)
    try:
        return Path(str(cached_file(str(base), "config.json", revision=revision)))
    except OSError as error:
        raise FileNotFoundError(f"base model {base}: {reason(error)}") from None


def _weight_files(folder: Path, base: str | Path) -> list[Path]:
    """The files that weights are loaded from; empty where there is none."""
    for name in WEIGHTS:
        path = folder / name
        if path.is_file() and path.suffix != ".json":
            return [path]
        if path.is_file():
            try:
                named = set(json.loads(path.read_text(encoding="utf-8-sig"))["weight_map"].values())
                return sorted(folder / Path(shard).name for shard in named)
            except (ValueError, LookupError, TypeError, AttributeError) as error:
                raise ValueError(f"base model {base}: {name} is damaged ({reason(error)})") from None
    if any(folder.glob("*.bin")):
        raise pickles_alone(base)
    return []


def _stats(paths: list[Path], base: str | Path) -> tuple[tuple[str, int, int], ...]:
    """Names, and what tells that a file has changed; FileNotFoundError for one that is not there."""
    if missing := [path.name for path in paths if not path.is_file()]:
        raise FileNotFoundError(f"base model {base}: {missing[0]} is missing")
    return tuple((str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in paths)


@functools.lru_cache(maxsize=16)
def _digest_tensors(stats: tuple[tuple[str, int, int], ...], base: str) -> tuple[str, str, str]:
    """(count, digest of names and shapes, digest of values) over all files, by name; half precision as float32."""
    import torch
    from safetensors import SafetensorError
    from tqdm import tqdm

    layout, values = (hashlib.blake2b(digest_size=12) for _ in range(2))
    try:
        places = sorted((name, path) for path, *_ in stats for name in _names(Path(path)))
        for name, path in tqdm(places, f"looking at {base}", unit="tensor", delay=2, disable=None):
            tensor = _tensor(Path(path), name)
            tensor = tensor.float() if tensor.is_floating_point() else tensor
            layout.update(f"{name} {tuple(tensor.shape)}\n".encode())
            values.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    except (SafetensorError, RuntimeError, ValueError, LookupError, EOFError, TypeError, AttributeError) as error:
        raise ValueError(f"base model {base}: its weights cannot be read ({reason(error)})") from None
    return str(len(places)), layout.hexdigest(), values.hexdigest()


def _names(path: Path) -> list[str]:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        return list(file.keys())


def _tensor(path: Path, name: str) -> "torch.Tensor":
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        return file.get_tensor(name)


def _digest_config(folder: Path) -> str:
    """Of what differs from the defaults, so that it does not matter which version of transformers wrote the file."""
    from transformers import AutoConfig

    try:
        stated = AutoConfig.from_pretrained(folder, trust_remote_code=False).to_diff_dict()
    except (OSError, ValueError, TypeError, LookupError, AttributeError):  # of no architecture here: as it is written
        try:
            stated = json.loads((folder / "config.json").read_text(encoding="utf-8-sig"))
        except ValueError as error:
            raise ValueError(f"base model {folder}: config.json is not valid JSON ({reason(error)})") from None
    text = json.dumps(_compared(stated), sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=6).hexdigest()


def _compared(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _compared(item) for key, item in value.items() if key not in NOT_COMPARED}
    return [_compared(item) for item in value] if isinstance(value, list | tuple) else value


@functools.lru_cache(maxsize=16)
def _digest_files(stats: tuple[tuple[str, int, int], ...]) -> str:
    """Of names and contents."""
    digest = hashlib.sha256()
    for path, size, _ in stats:
        digest.update(f"{Path(path).name} {size} ".encode())
        with open(path, "rb") as file:
            while block := file.read(1 << 22):
                digest.update(block)
    return digest.hexdigest()[:32]
