"""Files and folders that are whole or absent, whenever their writer is killed; small files read with clear errors.

Whose a file is: no verb replaces or deletes what it did not write, or writes over what it reads. And what a name of a
model or dataset means: on the Hub, or a path here.
"""

import math
import os
import shutil
import unicodedata
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
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
_DESKTOP = (".DS_Store", "._*", "Thumbs.db", "desktop.ini")  # what file managers leave in every folder


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
def whole_folder(target: Path, own: Collection[str] = ()) -> Iterator[Path]:
    """A temporary folder beside `target`, which takes its name and place when the block ends without an error.

    What was at `target` goes as a whole, if `check_replaceable(target, own)` allows it; that is asked at both ends.
    After an error it is untouched and the temporary folder is deleted. Contents reach the disk before the name does.
    A killed writer leaves `.<name>.tmp` or, for the blink of an eye, the old folder as `.<name>.old`; the next one
    tidies up. A link to a folder stays one.
    """
    check_replaceable(target, own)
    target = Path(os.path.realpath(target))
    temporary, old = target.with_name(f".{target.name}.tmp"), target.with_name(f".{target.name}.old")
    for folder in (temporary, old):
        shutil.rmtree(folder, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        yield temporary
        for path in [*temporary.rglob("*"), temporary]:
            _sync(path)
        check_replaceable(target, own)  # again: the block took its time
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


# ---- whose a file is ----


def strangers(folder: Path, own: Collection[str] = ()) -> list[str]:
    """The files of a folder that match none of the patterns `own`, by their names in it, sorted; of no folder none.

    Patterns are those of `fnmatch` on names such as `data/a.png`; a `*` also stands for several parts of such a name.
    What file managers leave in every folder does not count.
    """

    def unreadable(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):
            raise error

    found: list[str] = []
    for place, folders, files in os.walk(folder, onerror=unreadable):
        linked = [name for name in folders if os.path.islink(os.path.join(place, name))]
        names = [name for name in files + linked if not any(fnmatchcase(name, pattern) for pattern in _DESKTOP)]
        found += [Path(os.path.relpath(os.path.join(place, name), folder)).as_posix() for name in names]
    return sorted(name for name in found if not any(fnmatchcase(name, pattern) for pattern in own))


def check_replaceable(folder: Path, own: Collection[str] = ()) -> None:
    """Raise ValueError unless a folder may be replaced or deleted as a whole.

    It may if it is absent, empty, or holds only files that match the patterns `own` (as `strangers` reads them): those
    that the caller writes.
    """
    if os.path.lexists(folder) and not folder.is_dir():
        raise NotADirectoryError(f"{folder} exists and is no folder: name another one")
    if others := strangers(folder, own):
        listed = ", ".join(others[:3]) + (f" and {len(others) - 3} more" if len(others) > 3 else "")
        raise ValueError(
            f"{folder} holds files that were not written by this command ({listed}): they are kept; "
            "name another folder, or move them away"
        )


def remove_files(root: Path, names: Iterable[str]) -> None:
    """Delete these files below `root`, and the folders there that are empty then; what is gone already is no error."""
    for name in names:
        path = root / name
        path.unlink(missing_ok=True)
        for folder in path.relative_to(root).parents:
            try:
                (root / folder).rmdir() if folder.name else None
            except OSError:
                break  # it holds something else, or is gone


def check_own_file(path: Path, mark: str, option: str) -> None:
    """Raise ValueError if the file that an option names is there and is not ours: it does not hold `mark`, a line that
    all of its kind have. IsADirectoryError for a folder.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{option} {path} is a folder: name a file in it")
    if os.path.lexists(path) and not (path.is_file() and mark.encode() in path.read_bytes()):
        raise ValueError(f"{option} {path} was not written by this command and is kept: name another file")


def check_inputs_stay(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Raise ValueError if a file to be written is one that is read: the same one, also through links, or one whose
    name differs in case or in the composition of accents alone, which is the same on many disks."""
    read = {key: path for path in inputs for key in _places(path)}
    for path in outputs:
        for key in _places(path):
            if key in read:
                raise ValueError(f"{path} would replace the input {read[key]}: choose another place for the output")


def _places(path: Path) -> list[tuple]:
    """What a path names: a folder and a name in it, as it is written and after links, and the file itself."""
    keys: list[tuple] = []
    for place in (path, Path(os.path.realpath(path))):
        folder = os.path.realpath(place.parent)
        try:
            at: Any = (os.stat(folder).st_dev, os.stat(folder).st_ino)
        except OSError:
            at = folder
        keys.append((at, unicodedata.normalize("NFC", place.name.casefold())))
    with suppress(OSError):
        keys.append((os.stat(path).st_dev, os.stat(path).st_ino))
    return keys


def printable(text: str) -> str:
    """File names may hold bytes that are no text; what is told and sent may not."""
    return text.encode("utf-8", "backslashreplace").decode()


def is_leftover(name: str) -> bool:
    """Whether a file or folder of this name is passed over wherever a person's files are listed: hidden ones
    (`.DS_Store`, `._photo.jpg`, `.AppleDouble`), and those of `LEFTOVERS`.
    """
    return (name.startswith(".") and not is_in_the_cloud(name)) or name.casefold() in LEFTOVERS


def is_in_the_cloud(name: str) -> bool:
    """Whether a file stands for one that is still in iCloud: `.photo.jpg.icloud` for photo.jpg."""
    return name.startswith(".") and name.endswith(".icloud")


def is_lfs_pointer(start: bytes) -> bool:
    """Whether a file begins as what Git LFS keeps in place of a file that was not fetched."""
    return start.startswith(b"version https://git-lfs")


def unfetched(folder: str | Path) -> str | None:
    """What to say of a folder of weights of which only Git LFS's pointers are there; None if they are all there."""
    for path in sorted(Path(folder).glob("*")) if Path(folder).is_dir() else ():
        if path.suffix in (".safetensors", ".bin") and path.is_file():
            with open(path, "rb") as file:
                if is_lfs_pointer(file.read(32)):
                    return f"of {path.name} only Git LFS's pointer is there: `git lfs pull` fetches it"
    return None


def existing_folder(path: Path) -> Path:
    """The path itself, or the nearest folder above it that is there: whose disk and permissions a new folder has."""
    return next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())


# ---- small files ----


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


def locate(name: str | Path, beside: Path) -> Path | None:
    """A file or folder that was named elsewhere, or None: as it is named from here, else from `beside` or a folder
    above it, else by its last part in `beside` (or next to it, for what can be no hub id)."""
    path = Path(os.path.expanduser(name))
    if path.exists():
        return path
    beside = Path(os.path.realpath(beside))
    places = [] if path.is_absolute() else [folder / path for folder in (beside, *beside.parents)]
    places += [beside / path.name, *([] if is_hub_id(name) else [beside.parent / path.name])]
    return next((place for place in places if path.name and place.exists()), None)


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
