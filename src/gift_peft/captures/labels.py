"""What the files of all labeling tools have in common: labels and which of them is the target, image names, sizes."""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from gift_peft.images import is_image_file

MaskClass = int | str | Sequence[int | str] | None


def split_classes(mask_class: MaskClass) -> tuple[list[int], list[str]]:
    """The numbers and the names of a `mask_class` of group.yaml."""
    given = [] if mask_class is None else [mask_class] if isinstance(mask_class, int | str) else list(mask_class)
    return [value for value in given if isinstance(value, int)], [value for value in given if isinstance(value, str)]


def choose_labels(known: Mapping[str, Collection], mask_class: MaskClass, what: str) -> list[str]:
    """The target's among `known` labels (and their numbers): those of `mask_class`, else the only one there is.

    ValueError if there are several and none is named, or the named ones are not there.
    """
    values, names = split_classes(mask_class)
    if mask_class is None:
        if len(known) > 1:
            raise ValueError(
                f"{len(known)} {what} ({', '.join(known)}); name the target's in group.yaml "
                f"(`mask_class: {next(iter(known))}`)"
            )
        return list(known)
    chosen = [label for label, numbers in known.items() if label in names or not set(numbers).isdisjoint(values)]
    for name in names:
        if name not in known:  # written in other capitals, if that can mean one label only
            alike = [label for label in known if _plain(label) == _plain(name)]
            if len(alike) > 1:
                raise ValueError(f"mask_class {name!r} may mean {' or '.join(map(repr, alike))}; write it as there")
            chosen += [label for label in alike if label not in chosen]
    if not chosen:
        raise ValueError(f"mask_class {mask_class!r} is none of the {what} there ({', '.join(known)})")
    return chosen


def _plain(label: str) -> str:
    return label.strip().casefold()


def check_size(name: str, size: tuple, expected: tuple[int, int]) -> None:
    """Raise ValueError unless a stated (width, height) is the image's; some exports state none, or 0."""
    if size in ((None, None), (0, 0)) or tuple(size) == tuple(expected):
        return
    swapped = tuple(size) == tuple(expected)[::-1]
    hint = "; the sides are swapped: one of the two ignores the photo's EXIF rotation" if swapped else ""
    raise ValueError(
        f"{name} {size[1]}x{size[0]} (height x width), but the image is {expected[1]}x{expected[0]}{hint}"
    )


def relative_name(name: Any) -> str:
    """An export's image name with forward slashes: of a path of another machine, or one that climbs with `..`, what is
    below that. It is compared with the names of photos, and nothing is opened by it. ValueError for no name.
    """
    if not isinstance(name, str) or not name.strip("/\\. ") or "\0" in name:
        raise ValueError(f"{name!r} is not an image's name")
    path = re.sub(r"^[A-Za-z]:", "", name.replace("\\", "/"))
    parts = [part for part in re.split(r"(?:^|.*/)\.\.(?=/|$)", path)[-1].split("/") if part not in ("", ".")]
    if not parts:
        raise ValueError(f"{name!r} is not an image's name")
    return "/".join(parts)


def without_query(name: str) -> str:
    """An address without what follows a `?`, as signed links have it."""
    start, mark, _ = name.partition("?")
    return start if mark and is_image_file(Path(start)) else name


def dicts(items: Any, what: str) -> list[dict]:
    """The list itself; ValueError unless all of it are objects."""
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise ValueError(f"its {what} are not a list of objects")
    return items


def checked_label(label: Any) -> str:
    """The label itself; ValueError unless it is a text."""
    if not isinstance(label, str) or not label:
        raise ValueError("a shape, region or category without a label")
    return label
