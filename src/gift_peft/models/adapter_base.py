"""Which base an adapter belongs to: the one it names, found where it is now, and whether a base is that one.

Two bases are the same if their tensors are, whatever files and folders they are in.
"""

import warnings
from pathlib import Path

from gift_peft.files import is_hub_id, locate
from gift_peft.models.identity import (
    FILES,
    TENSORS,
    earlier_revision,
    teacher_revision,
    weights_difference,
    weights_revision,
)


def find_base(base: str | Path | None, adapter: str | Path, revision: str | None) -> tuple[str | Path, str | None]:
    """(base, revision) to load under an adapter: what is named, else what the adapter names.

    A path that is not there as it is named is sought beside the adapter, and a warning says where it was found.
    ValueError if neither names a base.
    """
    from gift_peft.adapters.folder import read_adapter_config, read_gift

    if base is not None and Path(base).exists():
        return base, revision
    config = read_adapter_config(adapter)
    named = base or config.base_model_name_or_path
    if not named:
        raise ValueError(f"adapter {adapter} names no base model: give --base")
    if base is None:
        revision = revision or config.revision
    was_folder = (read_gift(adapter).get("base_revision") or "").startswith((TENSORS, FILES))
    if is_hub_id(named) and not (was_folder and str(named) == config.base_model_name_or_path):
        return named, revision
    found = locate(named, Path(adapter)) or locate(named, Path(adapter).parent)
    if found is None or found == Path(named):
        return named, revision
    warnings.warn(f"base model {named}: taken from {found}", stacklevel=2)
    return found, revision


def check_base(
    base: str | Path, revision: str | None, adapter: str | Path, made_for: str | None, accept: bool
) -> None:
    """ValueError unless the adapter was trained on this base, as far as weights and names tell; a warning if accepted.

    Weights are compared where gift.json pins them (or the folder that the adapter names is still there), else two hub
    ids by name. A folder on one side and a hub id on the other may be copies of one model: then shapes decide.
    """
    if (difference := _difference(base, revision, adapter, made_for)) is None:
        return
    message = f"adapter {adapter} was trained on {made_for}, whose weights are not those of base {base}: {difference}"
    if not accept:
        raise ValueError(f"{message}; --accept-base uses it all the same")
    warnings.warn(message, stacklevel=3)


def _difference(base: str | Path, revision: str | None, adapter: str | Path, made_for: str | None) -> str | None:
    from gift_peft.adapters.folder import read_gift

    gift, present = read_gift(adapter), teacher_revision(base, revision)
    pinned = gift.get("base_revision") or ""
    if pinned == present:
        return None
    trained = gift.get("base_weights") or (pinned if pinned.startswith(TENSORS) else "")
    is_folder, was_folder = Path(base).is_dir(), pinned.startswith((TENSORS, FILES))
    if not trained and pinned.startswith(FILES) and is_folder and pinned == earlier_revision(base):
        return None
    if not trained and made_for and (was_folder or Path(made_for).exists()):
        found = locate(made_for, Path(adapter)) or locate(made_for, Path(adapter).parent)
        trained = weights_revision(found) if found is not None and (found / "config.json").is_file() else ""
    if trained:
        return weights_difference(trained, weights_revision(base, revision))
    if was_folder and is_folder:
        return "the files are others, and the adapter does not say what was in them"
    if made_for not in (None, str(base)) and not was_folder and not is_folder:
        return "it is another model on the hub"
    return None
