"""Which files of a folder are photos: links are followed, other folders and leftovers passed over.

Names are compared as people see them: accents composed or not, and where nothing else fits in any case.
"""

import os
import re
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


def uploaded_names(name: str) -> tuple[str, ...]:
    """What a labeling server makes of a name that browsers and phones give, `photo 1 (2).jpg`; () if it keeps it.

    Label Studio writes spaces as underscores and leaves out what is no letter, digit, `-`, `_` or `.` (Django's rule);
    Roboflow writes spaces as hyphens.
    """
    name = same_name(name)
    made = re.sub(r"[^-\w.]", "", name.strip().replace(" ", "_")), name.replace(" ", "-")
    return tuple(other for other in dict.fromkeys(made) if other != name)


def holds_no_photos(folder: str) -> bool:
    """Whether a folder of this name is passed over where photos are listed."""
    name = folder.casefold()
    return is_leftover(folder) or name in NOT_PHOTOS or name.startswith("segmentation")


class Listing:
    """What lies in folders, each listed once however many photos are looked up; not for longer than one group."""

    def __init__(self) -> None:
        self._entries: dict[Path, list[Path]] = {}
        self._stems: dict[Path, dict[str, list[Path]]] = {}
        self._photos: dict[Path, set[str]] = {}
        self._names: dict[Path, Counter] = {}
        self._uploaded: dict[tuple[Path, bool], Counter] = {}

    def entries(self, folder: Path) -> list[Path]:
        """Sorted, without leftovers; [] where there is no such folder."""
        if folder not in self._entries:
            there = folder.iterdir() if folder.is_dir() else ()
            self._entries[folder] = sorted(path for path in there if not is_leftover(path.name))
        return self._entries[folder]

    def subfolders(self, folder: Path, names: tuple[str, ...]) -> list[Path]:
        """Those with one of these names, written in any case, in the order of the names."""
        found = [path for path in self.entries(folder) if path.name.casefold() in names and path.is_dir()]
        return sorted(found, key=lambda path: (names.index(path.name.casefold()), path.name))

    def called(self, folder: Path, stem: str) -> list[Path]:
        """Entries whose name without its suffix is this one, in any case."""
        if folder not in self._stems:
            stems: dict[str, list[Path]] = {}
            for path in self.entries(folder):
                stems.setdefault(same_name(path.stem).casefold(), []).append(path)
            self._stems[folder] = stems
        return self._stems[folder].get(stem.casefold(), [])

    def photo_stems(self, folder: Path) -> set[str]:
        """Names of the pictures in a folder, without their suffixes."""
        if folder not in self._photos:
            self._photos[folder] = {same_name(path.stem) for path in self.entries(folder) if is_image_file(path)}
        return self._photos[folder]

    def photo_names(self, folder: Path) -> Counter:
        """How many pictures in and below a folder have each file name, and each name without its suffix."""
        if folder not in self._names:
            self._names[folder] = _counted(folder, _stamp(folder))
        return self._names[folder]

    def uploaded(self, folder: Path, deep: bool = False) -> Counter:
        """How many pictures in a folder (and below it) have each name once it was uploaded; their own names count."""
        if (folder, deep) not in self._uploaded:
            own = self.photo_names(folder) if deep else Counter(self._picture_names(folder))
            made: Counter = Counter()
            for name, count in own.items():
                for called in (name, *uploaded_names(name)):
                    made[called] += count
            self._uploaded[folder, deep] = made
        return self._uploaded[folder, deep]

    def _picture_names(self, folder: Path) -> list[str]:
        return [same_name(path.name) for path in self.entries(folder) if is_image_file(path)]


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


@lru_cache(maxsize=4)  # of a root, for all its groups
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
