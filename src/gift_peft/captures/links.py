"""Which links a reader follows: those that stay in the tree, and those into the store that holds the photos as well.

The Hub's cache, git-annex and DVC keep files in a store and link to them. A mask or an export that lies in the store
of its own photo is as good as one in the tree. Any other link that leaves the tree is refused: it is how a downloaded
archive would read a file of ours.
"""

from pathlib import Path


def checked(path: Path, root: Path, photo: Path | None = None) -> Path:
    """The path; ValueError if its links end nowhere, in a loop, or outside of `root` and of the photo's store."""
    try:
        real = path.resolve(strict=True)
    except (OSError, RuntimeError):  # RuntimeError: how Python before 3.13 reports a loop
        hint = "fetch the files of this dataset first (git annex get, dvc pull, hf download)"
        raise ValueError(f"{path}: a link that leads nowhere; {hint}") from None
    tree = root.resolve()
    if real.is_relative_to(tree) or (photo is not None and _one_store(real, photo.resolve(), tree)):
        return path
    raise ValueError(f"{path}: a link that leads out of {root}; copy the file")


def _one_store(real: Path, photo: Path, tree: Path) -> bool:
    """Whether both lie outside of the tree in one store: a folder that holds neither the tree nor somebody's home."""
    if photo.is_relative_to(tree):
        return False
    store = next((folder for folder in real.parents if photo.is_relative_to(folder)), None)
    around = (tree, Path.home().resolve())
    return store not in (None, Path(real.anchor)) and not any(place.is_relative_to(store) for place in around)
