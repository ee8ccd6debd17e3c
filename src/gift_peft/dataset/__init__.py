"""GIFT-I: groups of images as rows of a `datasets.Dataset`, with their proxies, and ready for the network."""

import hashlib
from importlib.util import find_spec

from gift_peft.options import package_version

# All code that decides what a raw tree becomes.
CAPTURES = (
    "tree",
    "masks",
    "folders",
    "links",
    "exports",
    "labels",
    "shapes",
    "labelme",
    "coco",
    "label_studio",
    "cvat",
)
SOURCES = ("dataset.gift_i", *(f"captures.{name}" for name in CAPTURES), "images", "rules")


def register_builder() -> None:
    """Make `datasets.load_dataset("gift_i", data_dir=RAW)` work; `import gift_peft` calls it. Idempotent.

    Touches one private dictionary of `datasets`, which has no public way since loading scripts were removed. The
    builder's module is named, not imported: a module beside it may be what imports `datasets`.
    """
    from datasets import packaged_modules

    from gift_peft.images import reads_heif

    reads_heif()  # rows hold paths, and `datasets` decodes them: with the extra, HEIC as well
    module = f"{__name__}.gift_i"
    packaged_modules._PACKAGED_DATASETS_MODULES["gift_i"] = (module, _code_digest())


def _code_digest() -> str:
    """Names the cache: a change of the code is another dataset; where no source is installed, of the version."""
    specs = [find_spec(f"gift_peft.{name}") for name in SOURCES]
    code = [spec.loader.get_source(spec.name) or package_version("gift-peft") for spec in specs]
    return hashlib.sha256("".join(code).encode()).hexdigest()
