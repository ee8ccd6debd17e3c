"""Files and folders that are whole or absent, whenever their writer is killed; small files read with clear errors.

And what a name of a model or dataset means: on the Hub, or a path here.
"""

import math
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

# What systems and network drives leave beside a person's files; `__MACOSX` comes out of zip files of a Mac.
LEFTOVERS = {
    "__macosx", "@eadir", "#recycle", "@recycle", "#snapshot", "$recycle.bin", "system volume information",
    "lost+found", "thumbs.db", "ehthumbs.db", "desktop.ini", "resource.frk", "network trash folder", "temporary items",
    "__pycache__",
}  # fmt: skip
_OPENS_FOLDERS = os.name != "nt"  # Windows does not, so there only files are synced


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


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """A temporary folder beside `target`, which takes its name and place when the block ends without an error.

    What was at `target` goes as a whole; after an error it is untouched and the temporary folder is deleted. Contents
    reach the disk before the name does. A killed writer leaves `.<name>.tmp` or, for the blink of an eye, the old
    folder as `.<name>.old`; the next one tidies up.
    """
    temporary, old = target.with_name(f".{target.name}.tmp"), target.with_name(f".{target.name}.old")
    for folder in (temporary, old):
        shutil.rmtree(folder, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        yield temporary
        for path in [*temporary.rglob("*"), temporary]:
            _sync(path)
        if target.exists():
            os.replace(target, old)
        os.replace(temporary, target)
        _sync(target.parent)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    shutil.rmtree(old, ignore_errors=True)


def remove_folder(folder: Path) -> None:
    """Delete a folder so that it is never seen half deleted: first its name goes, as `.<name>.tmp`, then its files."""
    gone = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(gone, ignore_errors=True)
    os.replace(folder, gone)
    shutil.rmtree(gone)


def is_leftover(name: str) -> bool:
    """Whether a file or folder of this name is passed over wherever a person's files are listed: hidden ones
    (`.DS_Store`, `._photo.jpg`, `.AppleDouble`), and those of `LEFTOVERS`.
    """
    return name.startswith(".") or name.casefold() in LEFTOVERS


def read_yaml(path: Path, name: str | None = None) -> dict:
    """The mapping in a YAML file, {} for an empty one; `name` is how messages call the file, default its path.

    Raises FileNotFoundError or ValueError, in one line.
    """
    name = name or str(path)
    if not path.is_file():
        raise FileNotFoundError(f"{name}: no such file")
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{name}: not valid YAML ({' '.join(str(error).split())})") from None
    if not isinstance(values or {}, dict):
        raise ValueError(f"{name}: expected lines of the form `key: value`")
    return values or {}


def reason(error: BaseException) -> str:
    """Why something failed, in one line of at most 200 characters: the first of the error's text, else its name."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


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


def _sync(path: Path) -> None:
    if path.is_dir() and not _OPENS_FOLDERS:
        return
    descriptor = os.open(path, os.O_RDONLY if _OPENS_FOLDERS else os.O_RDWR)  # Windows syncs what it may write
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
