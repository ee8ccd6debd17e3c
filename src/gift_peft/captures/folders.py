"""Which files of a folder are photos: links are followed, other folders and leftovers passed over.

Names are compared as people see them: accents composed or not, and where nothing else fits in any case.
"""

import os
import unicodedata
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from gift_peft.files import is_leftover
from gift_peft.images import is_image_file

PICTURE_MASKS = ("masks", "mask")  # folders of one mask a photo
EXPORTS = (*PICTURE_MASKS, "annotations")  # and of exports of labeling tools
# Folders of a group that hold no photos; CVAT's and labelme's converters write several `Segmentation...`.
NOT_PHOTOS = {*EXPORTS, "masks_proposed", "valids", "depths", "proxies", "imagesets"}


def same_name(name: str) -> str:
    """The name with accents composed: macOS takes them apart in file names."""
    return unicodedata.normalize("NFC", name)


def holds_no_photos(folder: str) -> bool:
    """Whether a folder of this name is passed over where photos are listed."""
    name = folder.casefold()
    return is_leftover(folder) or name in NOT_PHOTOS or name.startswith("segmentation")


def subfolders(folder: Path, names: tuple[str, ...]) -> list[Path]:
    """Folders in `folder` with one of these names, written in any case, in the order of the names."""
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if path.name.casefold() in names and path.is_dir()]
    return sorted(found, key=lambda path: (names.index(path.name.casefold()), path.name))


def files_below(folder: Path) -> Iterator[Path]:
    """All files in and below a folder, but those of folders that hold no photos; links are followed.

    Raises OSError or ValueError: links in a loop, an unreadable folder, a pipe or device that reading would wait for.
    """

    def complain(error: OSError):
        raise error

    ancestors = {}
    for place, folders, files in os.walk(folder, followlinks=True, onerror=complain):
        real = os.path.realpath(place)
        above = ancestors.get(os.path.dirname(place), frozenset())
        if real in above:
            raise ValueError(f"{place}: a link back to a folder above it")
        ancestors[place] = above | {real}
        folders[:] = [name for name in folders if not holds_no_photos(name)]
        for path in (Path(place, name) for name in files if not is_leftover(name)):
            if path.exists() and not path.is_file():
                raise ValueError(f"{path}: not a regular file")
            yield path


def photo_names(folder: Path) -> Counter:
    """How many pictures in and below a folder have each file name, and each name without its suffix."""
    return _counted(folder, _stamp(folder))


@lru_cache(maxsize=4)
def _counted(folder: Path, _: tuple) -> Counter:
    names: Counter = Counter()
    for path in files_below(folder):
        if is_image_file(path):
            names.update({same_name(path.name), same_name(path.stem)})
    return names


def _stamp(folder: Path) -> tuple:
    """Changes when a file comes or goes down to the groups' own folders."""
    below = [folder, *(path for path in (*folder.glob("*/"), *folder.glob("*/*/"), *folder.glob("*/*/*/")))]
    return tuple((str(path), path.stat().st_mtime_ns) for path in below if path.is_dir())
