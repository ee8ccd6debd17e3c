"""The Targets room without its page: of a prepared folder, where the base sees each surface, where its surface target
has it, and how far they are apart.

Read is what `gift-peft proxies --target surface` left in the folder; no model is loaded.
"""

import shlex
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from gift_peft.dataset.gift_i import gift_i_splits, load_gift_i
from gift_peft.dataset.proxies import FORMAT, SURFACE_FORMAT, SURFACE_SUFFIX, ProxyStore, SurfaceStore, read_header
from gift_peft.dataset.rows import RowRules
from gift_peft.reports.targets_page import show_observation
from gift_peft.rules import SPLITS, GroupPictures


class TargetRoom:
    """Surface targets of a prepared folder.

    Args:
        root: the folder.

    Attributes:
        sets (`dict[str, tuple]`): {"<teacher> at <h>x<w>": where it is}, at least one.

    Raises ValueError, with the command to type, where there are none.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.sets = root, {}
        for file in sorted((root / "proxies").rglob(f"*{SURFACE_SUFFIX}.safetensors")):
            size, teacher = file.parents[1], file.parents[2]
            if file.parent.name in SPLITS:
                name = f"{teacher.relative_to(root / 'proxies').as_posix()} at {size.name}"
                self.sets.setdefault(name, (teacher, size.name))
        if not self.sets:
            command = shlex.join(
                ["gift-peft", "proxies", "--base", "BASE", "--dataset", str(root), "--target", "surface"]
            )
            raise ValueError(f"{root} has no surface targets to show yet: `{command}` makes them")
        self._rows = lru_cache(maxsize=4)(self._load)

    def groups(self, chosen: str) -> list[str]:
        """Names ("train/hall") of the groups of a set that have surface targets."""
        teacher, size = self._place(chosen)
        found = []
        for split in gift_i_splits(self.root):
            names = load_gift_i(self.root, split).select_columns(["group_id"])["group_id"]
            made = {path.name for path in (teacher / size / split).glob(f"*{SURFACE_SUFFIX}.safetensors")}
            found += [f"{split}/{name}" for name in names if f"{name}{SURFACE_SUFFIX}.safetensors" in made]
        return found

    def photos(self, chosen: str, group: str) -> list[str]:
        return list(self._group(chosen, group)[0].names)

    def show(self, chosen: str, group: str, photo: str) -> str:
        """HTML: the photo, the base's prediction, the surface target and their difference; a line of figures.

        Raises ValueError or FileNotFoundError, in a line: no such set, group or photo; stale or damaged files.
        """
        pictures, kind = self._group(chosen, group)
        if photo not in pictures.names:
            raise ValueError(f"group {group}: there is no photo {photo[:80]!r}")
        return show_observation(pictures, pictures.names.index(photo), kind, with_difference=True).text

    def _place(self, chosen: str) -> tuple[Path, str]:
        if chosen not in self.sets:
            raise ValueError(f"there is no set {chosen[:80]!r}")
        return self.sets[chosen]

    def _group(self, chosen: str, group: str) -> tuple[GroupPictures, str]:
        """The group with its targets, and what its teacher predicts."""
        if group not in self.groups(chosen):
            raise ValueError(f"there is no group {group[:80]!r}")
        teacher, size = self._place(chosen)
        split, name = group.split("/", 1)
        rows, index = self._rows(chosen, split)
        kind = read_header(teacher / size / split / f"{name}{SURFACE_SUFFIX}.safetensors")["kind"]
        return rows[index[name]], kind

    def _load(self, chosen: str, split: str) -> tuple:
        teacher, size = self._place(chosen)
        rows = load_gift_i(self.root, split)
        command = shlex.join(["gift-peft", "proxies", "--dataset", str(self.root), "--target", "surface"])
        place = str(teacher), size, split
        stores = {
            "proxies": ProxyStore(*place, {"format": FORMAT}, command),
            "surface": SurfaceStore(*place, {"format": SURFACE_FORMAT}, command),
        }
        rules = replace(RowRules.of(rows), parsed=True, **stores)
        names = rows.select_columns(["group_id"])["group_id"]
        return rules.apply(rows), {name: place for place, name in enumerate(names)}
