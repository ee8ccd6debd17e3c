"""Which model this is: the folder of its proxies, and what pins its weights."""

import functools
import hashlib
import re
from pathlib import Path

from gift_peft.files import is_hub_id, reason


def teacher_id(base: str | Path, revision: str | None = None) -> str:
    """The teacher's folder under `proxies/`: `owner--name[@revision]` for a hub id, the folder's name for a path."""
    name = Path(base).resolve().name if Path(base).is_dir() else str(base).replace("/", "--")
    name = re.sub(r"[^A-Za-z0-9._@-]", "_", name + (f"@{revision}" if revision else ""))
    if name.strip(".") == "":
        raise ValueError(f"base model {str(base)!r}: neither a folder nor a hub id")
    return name


def check_base_name(base: str | Path) -> None:
    """Raise FileNotFoundError unless `base` is a folder or could be a hub id."""
    if not Path(base).is_dir() and not is_hub_id(base):
        raise FileNotFoundError(f"base model {base}: no such folder")


def teacher_revision(base: str | Path, revision: str | None = None) -> str:
    """What pins the teacher's weights: the hub commit, or a digest of a local folder's configuration and weights.

    Raises FileNotFoundError if the model is neither a folder nor on the hub (or in its local cache).
    """
    if Path(base).is_dir():
        files = [Path(base) / name for name in ("config.json", "preprocessor_config.json")]
        files += sorted(path for path in Path(base).iterdir() if path.suffix in (".safetensors", ".bin"))
        files = [path for path in files if path.exists()]
        if not any(path.name == "config.json" for path in files):
            raise FileNotFoundError(f"base model {base}: the folder has no config.json")
        stats = tuple((str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files)
        return f"sha256:{_digest_files(stats)}"

    from transformers.utils.hub import cached_file, extract_commit_hash

    check_base_name(base)
    try:
        config = cached_file(str(base), "config.json", revision=revision)
    except OSError as error:
        raise FileNotFoundError(f"base model {base}: {reason(error)}") from None
    return extract_commit_hash(config, None) or "unknown"


@functools.lru_cache(maxsize=16)
def _digest_files(stats: tuple[tuple[str, int, int], ...]) -> str:
    """Of names and contents; sizes and times are in the key so that a changed file is read again."""
    digest = hashlib.sha256()
    for path, size, _ in stats:
        digest.update(f"{Path(path).name} {size} ".encode())
        with open(path, "rb") as file:
            while block := file.read(1 << 22):
                digest.update(block)
    return digest.hexdigest()[:32]
