"""Files that are whole whenever the writer is killed; valid JSON; and what a name of a model or dataset means."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name, sync it and rename it; text as UTF-8.

    What killed attempts at it left behind is removed. OSError, always with the file's name: the disk is full, or the
    folder cannot be written; then the old file is as it was and nothing else remains.
    """
    if isinstance(content, str):
        content = content.encode()
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except FileNotFoundError:  # another run wrote the same at the same time and tidied up below
        if not path.exists():
            raise
    except OSError as error:
        partial.unlink(missing_ok=True)
        # Python knows the file's name only where opening or renaming fails, not where the disk is full.
        raise type(error)(error.errno, error.strerror, str(path)) from None
    for leftover in path.parent.glob(f".{_escaped(path.name)}.*.partial"):
        if leftover.name.removeprefix(f".{path.name}.").removesuffix(".partial").isdigit():  # not of a file "a.b"
            leftover.unlink(missing_ok=True)


def jsonable(value: Any) -> Any:
    """Nested JSON types; numbers that JSON cannot hold (NaN, infinity) become None."""
    if isinstance(value, Mapping):
        return {key: jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def is_hub_id(name: str | Path) -> bool:
    """Whether a model or dataset of this name is on the Hub: `name` or `owner/name`, and no file or folder here.

    What is neither (`a/b/c`, `./x`, `x/`, `/x`, `~/x`) can only be a path that is wrong, or of another machine.
    """
    from huggingface_hub.utils import validate_repo_id

    try:
        validate_repo_id(str(name))
    except ValueError:
        return False
    return not Path(name).exists()


def portable_name(name: str | Path) -> str:
    """What others may read: a hub id as it is, of a path the last part."""
    return str(name) if is_hub_id(name) else Path(name).expanduser().resolve().name


def _escaped(name: str) -> str:
    return "".join(f"[{character}]" if character in "*?[" else character for character in name)
