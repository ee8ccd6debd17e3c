"""Captures in other folders than the raw tree's: one folder each with RGB and mask files, or lists of their paths.

The paper describes its release only as capture folders below a configurable root, with relative paths (supplement A,
"Mask processing and quality control"). A layout file says where the parts lie, so nothing has to be renamed:

```yaml
root: gift-i                  # optional, below RAW
splits: {train: train, validation: val}      # folder of each split, below the root
images: rgb/*.png             # below a capture folder, which is any folder where this finds something
mask: mask/{stem}.png         # {stem}: the image's name without its suffix
reference: treated/*.png      # optional
```

or, in place of the last four, lists of relative paths, one image a line, comma- or space-separated:

```yaml
lists: {train: train.txt, validation: val.csv}
columns: [image, mask, reference]            # reference is optional, the same for all lines of a capture
```

Every path is relative and stays below RAW; anything else is refused before a file is opened.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from gift_peft.captures.masks import MaskSource
from gift_peft.captures.tree import Capture
from gift_peft.files import is_leftover, read_yaml
from gift_peft.images import natural_key, sort_pictures
from gift_peft.rules import SPLITS

COLUMNS = ("image", "mask", "reference")


@dataclass(frozen=True)
class Layout:
    """Where the parts of a dataset lie below its root; the module's text explains the fields."""

    root: str = "."
    splits: dict[str, str] = field(default_factory=lambda: {"train": "train", "validation": "validation"})
    images: str = "rgb/*"
    mask: str = "mask/{stem}.png"
    reference: str | None = None
    lists: dict[str, str] = field(default_factory=dict)
    columns: tuple[str, ...] = ("image", "mask")

    def find(self, raw: Path) -> dict[str, list[Path | Capture]]:
        """The captures of each split: folders still to be listed by `read`, or, from lists, whole captures.

        Raises FileNotFoundError or ValueError naming the file and line.
        """
        base = _below(raw, self.root, "root")
        if self.lists:
            found = {split: list(self._from_list(base, split, name)) for split, name in self.lists.items()}
        else:
            found = {}
            for split, name in self.splits.items():
                folder = _below(base, name, f"splits, {split}")
                folders = [
                    path
                    for path in (sorted(folder.rglob("*")) if folder.is_dir() else [])
                    if path.is_dir() and not any(map(is_leftover, path.relative_to(folder).parts))
                ]
                found[split] = [path for path in [folder, *folders] if any(_pictures(path, self.images))]
        if not any(found.values()):
            raise FileNotFoundError(f"{base}: the layout finds no captures there")
        return {split: found[split] for split in SPLITS if found.get(split)}

    def read(self, folder: Path, split: str, raw: Path) -> Capture:
        """One capture folder; FileNotFoundError or ValueError naming the file that is missing."""
        images = _pictures(folder, self.images)
        references = _pictures(folder, self.reference) if self.reference else []
        if len(references) > 1:
            raise ValueError(f"{folder}: two references, {' and '.join(path.name for path in references[:2])}")
        masks = [_present(folder, self.mask.replace("{stem}", path.stem), raw) for path in images]
        return Capture(
            folder,
            self.group_id(folder, split, raw),
            split,
            [_inside(path, raw) for path in images],
            [MaskSource(path, "png") for path in masks],
            _inside(references[0], raw) if references else None,
        )

    def group_id(self, folder: Path, split: str, raw: Path) -> str:
        """The capture folder's path below its split's folder, with __ for the separators."""
        start = raw / self.root / self.splits[split]
        return folder.name if folder == start else folder.relative_to(start).as_posix().replace("/", "__")

    def _from_list(self, base: Path, split: str, name: str) -> Iterator[Capture]:
        path = _below(base, name, f"lists, {split}")
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except FileNotFoundError:
            raise FileNotFoundError(f"{path}: no such file, which the layout names") from None
        except UnicodeDecodeError:
            raise ValueError(f"{path}: not UTF-8 text") from None
        captures: dict[str, list[dict[str, Path]]] = {}
        for number, line in enumerate(lines, start=1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            values = [value.strip() for value in (line.split(",") if "," in line else line.split())]
            if len(values) != len(self.columns):
                wanted = ", ".join(self.columns)
                raise ValueError(f"{path}, line {number}: {len(values)} values, the layout's columns are {wanted}")
            at = f"{path}, line {number}"
            files = {
                column: _below(base, value, at) for column, value in zip(self.columns, values, strict=True) if value
            }
            if not {"image", "mask"} <= files.keys():
                raise ValueError(f"{at}: an image and a mask are needed")
            captures.setdefault(_common_folder([PurePosixPath(value) for value in values if value]), []).append(files)
        for folder, rows in captures.items():
            rows.sort(key=lambda files: natural_key(files["image"].name))
            references = {files["reference"] for files in rows if "reference" in files}
            if len(references) > 1:
                raise ValueError(f"{path}: capture {folder} has two references")
            yield Capture(
                base / folder,
                folder.replace("/", "__"),
                split,
                [files["image"] for files in rows],
                [MaskSource(files["mask"], "png") for files in rows],
                next(iter(references), None),
            )


def read_layout(path: str | Path) -> Layout:
    """The layout file; FileNotFoundError or ValueError naming it and the key."""
    path = Path(path)
    values = read_yaml(path, f"layout {path}")
    known = Layout.__dataclass_fields__
    for key, value in values.items():
        if key not in known:
            raise ValueError(f"layout {path}: unknown key {key!r}; it may have the keys {', '.join(known)}")
        if key in ("splits", "lists"):
            right = isinstance(value, dict) and set(value) <= set(SPLITS) and all(map(_is_text, value.values()))
        elif key == "columns":
            right = isinstance(value, list) and set(value) <= set(COLUMNS) and len(set(value)) == len(value)
        else:
            right = _is_text(value)
        if not right:
            raise ValueError(f"layout {path}: {key}: {value!r} is not what belongs there")
    for key in ("images", "mask", "reference"):
        if key in values:
            _check_relative(values[key], f"layout {path}, {key}")
            if {"{", "}"} & set(values[key].replace("{stem}", "")):
                raise ValueError(f"layout {path}: {key}: {values[key]!r}; the one placeholder is {{stem}}")
    if "columns" in values:
        values["columns"] = tuple(values["columns"])
    return Layout(**values)


def _is_text(value) -> bool:
    return isinstance(value, str) and bool(value)


def _check_relative(text: str, at: str) -> None:
    parts = PurePosixPath(text.replace("\\", "/")).parts
    if text.startswith(("/", "\\", "~")) or ".." in parts or (parts and ":" in parts[0]) or "\0" in text:
        raise ValueError(f"{at}: {text!r} is not a relative path below the dataset's root")


def _below(folder: Path, text: str, at: str) -> Path:
    _check_relative(text, at)
    return _inside(folder / text, folder)


def _inside(path: Path, folder: Path) -> Path:
    """The path, unless its links lead out of the folder."""
    try:
        real = path.resolve()
    except (OSError, RuntimeError):
        raise ValueError(f"{path}: a link that leads nowhere") from None
    if not real.is_relative_to(folder.resolve()):
        raise ValueError(f"{path}: a link that leads out of {folder}")
    return path


def _present(folder: Path, text: str, raw: Path) -> Path:
    path = _inside(folder / text, raw)
    if not path.is_file():
        raise FileNotFoundError(f"missing {path}, which the layout names")
    return path


def _pictures(folder: Path, pattern: str) -> list[Path]:
    return sort_pictures(folder.glob(pattern))


def _common_folder(paths: list[PurePosixPath]) -> str:
    """The capture directory: the deepest folder that holds all files of a line."""
    parts = [path.parent.parts for path in paths]
    depth = 0
    while all(len(part) > depth and part[depth] == parts[0][depth] for part in parts):
        depth += 1
    if not depth:
        raise ValueError(f"{paths[0]}: its capture has no folder of its own")
    return "/".join(parts[0][:depth])
