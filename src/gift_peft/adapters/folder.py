"""An adapter as a folder in PEFT's format, with the image processor and `gift.json`, which says how it was made.

The folder is whole or absent. For Depth Anything it loads with peft and transformers alone.
"""

from __future__ import annotations

import copy
import functools
import json
import math
import platform
import warnings
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from peft import LoraConfig, PeftConfig, PeftModel
from peft.tuners.lora import LoraLayer

from gift_peft.adapters.scale import active_lora, active_saved_modules
from gift_peft.files import check_replaceable, is_hub_id, jsonable, reason, whole_folder
from gift_peft.rules import KINDS

ADAPTER_CONFIG = "adapter_config.json"
ADAPTER_WEIGHTS = "adapter_model.safetensors"
PROCESSOR_CONFIG = "preprocessor_config.json"
GIFT = "gift.json"
ADAPTER_FILES = {ADAPTER_CONFIG, ADAPTER_WEIGHTS, PROCESSOR_CONFIG, GIFT, "README.md"}
MAX_RANK = 4096  # above it an adapter is larger than any layer here, and asks for memory before its weights are read


def save_adapter(
    model: PeftModel,
    folder: str | Path,
    base_model_name_or_path: str | None = None,
    revision: str | None = None,
    *,
    processor: Any = None,
    size: tuple[int, int] | None = None,
    gift: Mapping[str, Any] | None = None,
    card: str | None = None,
) -> None:
    """Write an adapter folder in PEFT's format; it replaces an earlier one as a whole, or not at all.

    Args: `base_model_name_or_path`, `revision` of the base (default: where the model was loaded from); `processor` an
    image processor, written with `size` (height, width); `gift` what `gift.json` says besides versions and size (NaN
    becomes null); `card` the finished README.md. A local base path is warned about: others cannot load
    the adapter by name; it stays out of the card.
    Raises ValueError if an adapter scale other than 1 is set, if `folder` holds other files, and if the card names an
    absolute base path; NotADirectoryError if `folder` is a file.
    """
    if not isinstance(model, PeftModel) or "default" not in model.peft_config:
        raise ValueError(
            "save_adapter needs a PeftModel whose adapter is called 'default', as get_gift_model makes it"
        )
    if any(layer.scaling[name] != _full_scaling(layer, name) for layer, name in active_lora(model)) or any(
        vars(wrapper).get("_gift_trained") for wrapper, _ in active_saved_modules(model)
    ):
        raise ValueError("an adapter is saved at scale 1: call set_adapter_scale(model, 1) first")
    folder = Path(folder)
    check_replaceable(folder, ADAPTER_FILES)
    base = base_model_name_or_path or _base_name(model)
    hub_base = _hub_name(base, card)
    with whole_folder(folder, ADAPTER_FILES) as temporary:
        model.save_pretrained(str(temporary), selected_adapters=["default"], save_embedding_layers=False)
        config = json.loads((temporary / ADAPTER_CONFIG).read_text())
        config.update(base_model_name_or_path=base, revision=revision)
        _write_json(temporary / ADAPTER_CONFIG, config)
        if processor is not None:
            # Not save_pretrained: it would put the code of VGGT's and Metric3D's processors beside the adapter.
            processor_at_size(processor, size).to_json_file(temporary / PROCESSOR_CONFIG)
        _write_json(temporary / GIFT, _gift_json(gift, size))
        # Last: PEFT writes a README of its own, which names a local base path.
        (temporary / "README.md").write_text(card or _minimal_card(hub_base), encoding="utf-8")


def _full_scaling(layer: LoraLayer, name: str) -> float:
    rank = layer.r[name]
    return layer.lora_alpha[name] / (math.sqrt(rank) if layer.use_rslora.get(name) else rank)


def _base_name(model: PeftModel) -> str | None:
    name = model.peft_config["default"].base_model_name_or_path or getattr(model.get_base_model(), "name_or_path", "")
    if not name:
        warnings.warn("the adapter names no base model: give base_model_name_or_path to load it by name", stacklevel=3)
    return name or None


def _hub_name(base: str | None, card: str | None) -> str | None:
    """`base` if it may stand in a card: a hub id, not a path of this machine."""
    if base is None or is_hub_id(base):
        return base
    warnings.warn(
        f"the base is the local folder {base}: others cannot load this adapter by its base's name; "
        "give a hub id as base_model_name_or_path to publish it",
        stacklevel=2,
    )
    if card and Path(base).is_absolute() and base in card:
        raise ValueError(f"the card names the local base path {base}")
    return None


def processor_at_size(processor: Any, size: tuple[int, int] | None) -> Any:
    """A copy of the image processor that resizes every image to exactly (height, width)."""
    if size is None:
        return processor
    processor = copy.deepcopy(processor)
    processor.do_resize = True
    processor.size = {"height": size[0], "width": size[1]}
    if hasattr(processor, "keep_aspect_ratio"):
        processor.keep_aspect_ratio = False
    if getattr(processor, "do_pad", False):
        processor.do_pad = False
    return processor


def _gift_json(gift: Mapping[str, Any] | None, size: tuple[int, int] | None) -> dict[str, Any]:
    return {"versions": versions(), "size": size, **(gift or {})}


@functools.cache
def versions() -> dict[str, str]:
    """Of what an adapter was made with: this package, those it uses, and Python."""
    packages = ("gift-peft", "torch", "transformers", "peft", "accelerate", "datasets")
    return {name: version(name) for name in packages} | {"python": platform.python_version()}


def _minimal_card(hub_base: str | None) -> str:
    base = [f"base_model: {hub_base}", "base_model_relation: adapter"] if hub_base else []
    head = ["---", "library_name: peft", "pipeline_tag: depth-estimation", *base, "tags:", "- gift", "- lora", "---"]
    return "\n".join(head) + "\n\n# GIFT adapter\n\nMade with gift-peft; `gift.json` says how.\n"


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(jsonable(content), indent=2, default=str, allow_nan=False) + "\n", encoding="utf-8")


# ---- reading ----


def read_adapter_config(adapter: str | Path) -> LoraConfig:
    """The PEFT configuration of a folder or hub id, checked before anything is built from it.

    Raises FileNotFoundError if there is none or, in a folder, no `adapter_model.safetensors` beside it (pickles are
    not read), ValueError naming file and field for what is no LoRA configuration.
    """
    if Path(adapter).is_file():
        raise FileNotFoundError(f"adapter {adapter}: name the folder, {Path(adapter).parent}, not a file in it")
    if Path(adapter).is_dir():
        for name in (ADAPTER_CONFIG, ADAPTER_WEIGHTS):
            if not (Path(adapter) / name).is_file():
                inside = Path(adapter) / "adapter"
                hint = f"; this is a run, whose adapter is {inside}" if (inside / name).is_file() else ""
                raise FileNotFoundError(f"adapter {adapter}: the folder has no {name}{hint}")
        _read_object(adapter, ADAPTER_CONFIG)
    where = f"adapter {adapter}: damaged {ADAPTER_CONFIG}"
    try:
        config = PeftConfig.from_pretrained(str(adapter))
    except (KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise ValueError(f"{where} ({reason(error)})") from None
    except (OSError, ValueError) as error:
        if Path(adapter).is_dir():
            raise ValueError(f"{where} ({reason(error)})") from None
        raise FileNotFoundError(f"adapter {adapter}: no such folder, and not on the hub ({reason(error)})") from None
    if not isinstance(config, LoraConfig):
        raise ValueError(f"adapter {adapter}: its peft_type is {config.peft_type}; GIFT adapters are LORA")
    _check_fields(config, where)
    return config


def read_gift(adapter: str | Path) -> dict[str, Any]:
    """An adapter folder's gift.json; empty without one (an adapter that PEFT alone saved, or one on the hub)."""
    content = _read_object(adapter, GIFT) if (Path(adapter) / GIFT).is_file() else {}
    for name, values in (("base_revision", None), ("base_weights", None), ("kind", KINDS)):
        value = content.get(name)
        if value is not None and (not isinstance(value, str) or (values and value not in values)):
            raise ValueError(f"adapter {adapter}: damaged {GIFT} ({name} cannot be {str(value)[:80]!r})")
    return content


def _read_object(adapter: str | Path, name: str) -> dict[str, Any]:
    """The object in a JSON file of an adapter; ValueError naming both for anything else."""
    try:
        content = json.loads((Path(adapter) / name).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise ValueError(f"adapter {adapter}: damaged {name} ({reason(error)})") from None
    if not isinstance(content, dict):
        raise ValueError(f"adapter {adapter}: damaged {name} (it holds a {type(content).__name__}, not an object)")
    return content


def _check_fields(config: LoraConfig, where: str) -> None:
    """Types and ranges, which a dataclass of PEFT takes as they come."""

    def is_rank(value: Any) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and 0 < value <= MAX_RANK

    def is_number(value: Any) -> bool:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)

    def is_text(value: Any) -> bool:
        return value is None or isinstance(value, str)

    def is_names(value: Any) -> bool:
        return value is None or (
            isinstance(value, (list, set, tuple)) and all(isinstance(name, str) for name in value)
        )

    def is_pattern(value: Any, check: Any) -> bool:
        return isinstance(value or {}, dict) and all(map(check, (value or {}).values()))

    checks = {
        "r": is_rank(config.r),
        "lora_alpha": is_number(config.lora_alpha),
        "rank_pattern": is_pattern(config.rank_pattern, is_rank),
        "alpha_pattern": is_pattern(config.alpha_pattern, is_number),
        "target_modules": is_text(config.target_modules) or is_names(config.target_modules),
        "modules_to_save": is_names(config.modules_to_save),
        "base_model_name_or_path": is_text(config.base_model_name_or_path),
        "revision": is_text(config.revision),
        "megatron_config": config.megatron_config is None,  # would import a module that the file names
    }
    for name, holds in checks.items():
        if not holds:
            raise ValueError(f"{where} ({name} cannot be {str(getattr(config, name))[:80]!r})")
