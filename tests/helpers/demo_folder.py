"""What `gift-peft demo` leaves, made in a moment: tiny base, an adapter that changes it, groups."""

from pathlib import Path

from helpers.adapted import trained
from helpers.tiny import SIZE, tiny_model, tiny_processor, write_base, write_raw_tree

from gift_peft import get_gift_model, save_adapter


def write_demo(folder: Path) -> Path:
    """`base/`, `adapter/` and `gift-i/`; warns that the base is a local folder, as the demo does."""
    write_base(folder / "base")
    model = trained(get_gift_model(tiny_model()))
    save_adapter(model, folder / "adapter", str(folder / "base"), processor=tiny_processor(), size=SIZE)
    write_raw_tree(folder / "gift-i")
    return folder
