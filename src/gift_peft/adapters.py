"""Where GIFT puts its trainable weights, and the adapter as a file (paper, "Implementation details"; supplement B).

Rank-8 LoRA on the attention of every encoder block, the depth head trained in full (PEFT's `modules_to_save`). The
result is a plain `PeftModel`: `disable_adapter()` is the frozen teacher, to the bit.
"""

from __future__ import annotations

import copy
import json
import math
import re
import shutil
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from peft import LoraConfig, PeftModel, get_peft_model
from peft.tuners.lora import LoraLayer
from peft.utils.other import ModulesToSaveWrapper
from torch import nn

from gift_peft.group_step import dropout_rates

HEADS = ("full", "lora", "none")
KINDS = ("depth", "inverse_depth")
ADAPTER_CONFIG = "adapter_config.json"
ADAPTER_FILES = {ADAPTER_CONFIG, "adapter_model.safetensors", "preprocessor_config.json", "gift.json", "README.md"}


@dataclass(frozen=True)
class GiftRecipe:
    """What of a depth model GIFT trains.

    Args:
        target_modules: LoRA targets in the encoder: a regular expression on whole names, or a list of last parts.
        modules_to_save: modules of the depth head, trained in full (`head="full"`) or by LoRA (`head="lora"`).
        kind: what the model predicts, "depth" or "inverse_depth"; None follows `config.depth_estimation_type`.
        size: (height, width) of the model's input; None takes it from the image processor.
        lora: further `LoraConfig` arguments, such as `{"lora_alpha": 16}`.
    """

    target_modules: str | list[str]
    modules_to_save: list[str]
    kind: str | None = None
    size: tuple[int, int] | None = None
    lora: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.kind not in (None, *KINDS):
            raise ValueError(f"kind must be one of {', '.join(KINDS)} or None, got {self.kind!r}")

    def kind_for(self, config: Any) -> str:
        """The kind of a model with this config. Raises ValueError if neither recipe nor config says it."""
        if self.kind is not None:
            return self.kind
        kinds = {"relative": "inverse_depth", "metric": "depth"}
        estimation = getattr(config, "depth_estimation_type", None)
        if estimation not in kinds:
            raise ValueError(f"{config.model_type}: the recipe must say kind='depth' or kind='inverse_depth'")
        return kinds[estimation]


RECIPES: dict[str, GiftRecipe] = {
    "depth_anything": GiftRecipe(
        target_modules=r"backbone\.encoder\.layer\.\d+\.attention\.(q_proj|k_proj|v_proj|o_proj)",
        modules_to_save=["neck", "head"],
        size=(476, 644),
    ),
    "gift_vggt": GiftRecipe(
        target_modules=r"aggregator\.(patch_embed\.blocks|frame_blocks|global_blocks)\.\d+\.attn\.(qkv|proj)",
        modules_to_save=["depth_head"],
        kind="depth",
        size=(476, 644),
    ),
    "gift_metric3d": GiftRecipe(
        target_modules=r"depth_model\.encoder\.blocks\.0\.\d+\.attn\.(qkv|proj)",
        modules_to_save=["depth_model.decoder"],
        kind="depth",
        size=(476, 644),
    ),
}


def get_recipe(model: nn.Module, recipe: GiftRecipe | None = None) -> GiftRecipe:
    """`recipe`, or the one in `RECIPES` for the model's `config.model_type`, PEFT-wrapped or not.

    Raises ValueError for a model type without a recipe.
    """
    if recipe is not None:
        return recipe
    model_type = getattr(getattr(model, "config", None), "model_type", None)
    if model_type not in RECIPES:
        raise ValueError(
            f"no recipe for model type {model_type!r} (there are: {', '.join(sorted(RECIPES))}); pass "
            "recipe=GiftRecipe(target_modules=<encoder attention>, modules_to_save=[<head modules>], kind=...)"
        )
    return RECIPES[model_type]


def get_gift_model(model: nn.Module, rank: int = 8, head: str = "full", recipe: GiftRecipe | None = None) -> PeftModel:
    """Wrap a float32 depth model for GIFT; it starts as the base, to the bit.

    Args: `rank` of every LoRA; `head` "full" trains the recipe's `modules_to_save`, "lora" puts LoRA on their
    convolutions and linears (transposed and grouped convolutions stay frozen: PEFT cannot merge them), "none" leaves
    them frozen; `recipe` replaces the one for `config.model_type`.
    The model's own dropout and drop-path rates are set to 0, because a replay must repeat its snapshot.
    Raises ValueError for a half-precision base, an unknown head, names that match nothing or too much, and LoRA
    options that break `disable_adapter()`.
    """
    if isinstance(model, PeftModel):
        raise ValueError("the model already has an adapter: pass the base model")
    if head not in HEADS:
        raise ValueError(f"head must be one of {', '.join(HEADS)}, got {head!r}")
    recipe = get_recipe(model, recipe)
    _check_base(model)
    saved = _head_modules(model, recipe.modules_to_save) if head != "none" else []
    targets = recipe.target_modules
    if not any(re.fullmatch(_pattern(targets), name) for name, _ in model.named_modules()):
        raise ValueError(f"target_modules: {targets!r} names no module of this {type(model).__name__}")
    if head == "lora":
        targets = "|".join([f"({_pattern(targets)})", *map(re.escape, _lora_layers(model, saved))])
    saved = saved if head == "full" else None
    config = LoraConfig(r=rank, target_modules=targets, modules_to_save=saved, **recipe.lora)
    check_lora_config(config)
    if config.lora_dropout:
        raise ValueError(f"lora_dropout must be 0, got {config.lora_dropout}: a replay must repeat its snapshot")
    for _, module, key in list(dropout_rates(model)):
        setattr(module, key, 0.0)
    with warnings.catch_warnings():  # peft 0.21 reads an attribute that transformers 5.23 deprecates
        warnings.filterwarnings("ignore", "`is_gradient_checkpointing` is deprecated", FutureWarning)
        adapted = get_peft_model(model, config)
    return adapted.train(model.training)  # PEFT's new layers start in train mode, whatever the base is in


def check_lora_config(config: LoraConfig) -> None:
    """Raise ValueError for options under which `disable_adapter()` or adapter scale 0 is not the base."""
    if config.bias != "none":
        raise ValueError(f"bias={config.bias!r} trains the base's own biases, and the base is the teacher: use 'none'")
    initial = config.init_lora_weights
    if initial is not True and initial != "gaussian":
        raise ValueError(
            f"init_lora_weights={initial!r} changes the base or the adapter's start, and training must start at the "
            "base, which is the teacher: use True or 'gaussian'"
        )
    if config.use_dora:
        raise ValueError("use_dora=True is not supported: its magnitudes do not scale back to the base")


def set_adapter_scale(model: nn.Module, scale: float) -> None:
    """Fade the active adapter: LoRA times `scale`, saved modules at base + scale * (trained - base).

    0 is the base and 1 the adapter, to the bit, in any order of calls. `model` is a `PeftModel` or a model that
    transformers loaded from an adapter folder. Set the scale to 1 before training or saving.
    Raises ValueError for a non-finite scale, a model without or with a merged adapter, and weights changed meanwhile.
    """
    if not math.isfinite(scale):
        raise ValueError(f"the adapter scale must be finite, got {scale}")
    layers, wrappers = _lora_parts(model), _saved_parts(model)
    if not layers and not wrappers:
        raise ValueError("the model has no active LoRA adapter to scale")
    if any(layer.merged for layer, _ in layers):
        raise ValueError("the adapter is merged into the base: unmerge it before changing its scale")
    for config in getattr(model, "peft_config", {}).values():
        check_lora_config(config)
    trained = [_trained_state(wrapper, name) for wrapper, name in wrappers]  # checks all before changing any
    for layer, name in layers:
        layer.set_scale(name, scale)
    for (wrapper, name), state in zip(wrappers, trained, strict=True):
        _scale_saved_module(wrapper, name, state, scale)


def _scale_saved_module(wrapper: ModulesToSaveWrapper, name: str, trained: dict[str, torch.Tensor], scale: float):
    base = wrapper.original_module.state_dict()
    for key, value in wrapper.modules_to_save[name].state_dict().items():
        value.copy_(_between(base[key], trained[key], scale))
    stash = vars(wrapper).setdefault("_gift_trained", {})
    if scale == 1:
        stash.pop(name, None)
    else:
        stash[name] = (scale, trained)


def _trained_state(wrapper: ModulesToSaveWrapper, name: str) -> dict[str, torch.Tensor]:
    """The module's weights at scale 1: what it holds, or what was put aside when it was scaled."""
    current = wrapper.modules_to_save[name].state_dict()
    stash = vars(wrapper).get("_gift_trained", {})
    if name not in stash:
        return {key: value.clone() for key, value in current.items()}
    scale, trained = stash[name]
    trained = {key: value.to(current[key]) for key, value in trained.items()}
    base = wrapper.original_module.state_dict()
    for key, value in current.items():
        if not torch.allclose(value, _between(base[key], trained[key], scale), rtol=1e-5, atol=1e-7):
            raise ValueError(f"saved module weights ({key}) changed at adapter scale {scale}: set it to 1 before that")
    return trained


def _between(base: torch.Tensor, trained: torch.Tensor, scale: float) -> torch.Tensor:
    """base + scale * (trained - base), exact at both ends; integers (step counters) are not interpolated."""
    if scale == 0:
        return base
    if scale == 1 or not trained.is_floating_point():
        return trained
    return base + scale * (trained - base)


def _active_parts(model: nn.Module, kind: type[nn.Module], weights: str) -> Iterator[tuple[Any, str]]:
    """(module, adapter name) of the modules of a kind that hold weights of an active adapter."""
    for module in model.modules():
        if isinstance(module, kind):
            yield from ((module, name) for name in module.active_adapters if name in getattr(module, weights))


def _lora_parts(model: nn.Module) -> list[tuple[LoraLayer, str]]:
    return list(_active_parts(model, LoraLayer, "scaling"))


def _saved_parts(model: nn.Module) -> list[tuple[ModulesToSaveWrapper, str]]:
    return list(_active_parts(model, ModulesToSaveWrapper, "modules_to_save"))


def _check_base(model: nn.Module) -> None:
    for name, parameter in model.named_parameters():
        if parameter.is_floating_point() and parameter.dtype not in (torch.float32, torch.float64):
            raise ValueError(
                f"the base is in {str(parameter.dtype).removeprefix('torch.')} ({name}): load it with "
                "dtype=torch.float32 and train under bf16 autocast, or the head has no full-precision weights"
            )


def _head_modules(model: nn.Module, names: list[str]) -> list[str]:
    """Full paths of the modules called `names`, so written that PEFT finds these and no others.

    PEFT takes every module whose path ends with a given text: `head` means `metric_head` as well, and the `head.head`
    inside `head`, which it would wrap twice. Such a module is written as its parts.
    """
    keys = [key for key, _ in model.named_modules()]
    wanted = []
    for name in names:
        found = [key for key in keys if key == name or key.endswith(f".{name}")]
        if not found:
            similar = [key for key in keys if key.endswith(name)]
            hint = f" (there are {', '.join(similar[:4])})" if similar else ""
            raise ValueError(f"modules_to_save: the model has no module {name!r}{hint}")
        wanted += found
    outer = [key for key in dict.fromkeys(wanted) if not any(key.startswith(f"{other}.") for other in wanted)]
    return [path for key in outer for path in _unambiguous(model, key, keys, outer)]


def _unambiguous(model: nn.Module, path: str, keys: list[str], wanted: list[str]) -> list[str]:
    others = [key for key in keys if key.endswith(path) and key != path and key not in wanted]
    if not others:
        return [path]
    module = model.get_submodule(path)
    parts = [name for name, child in module.named_children() if next(child.parameters(), None) is not None]
    if not parts or next(module.parameters(recurse=False), None) is not None:
        raise ValueError(f"modules_to_save: PEFT would take {path!r} for {', '.join(others[:4])} as well")
    return [found for part in parts for found in _unambiguous(model, f"{path}.{part}", keys, wanted)]


def _lora_layers(model: nn.Module, roots: list[str]) -> list[str]:
    """Names of the layers below `roots` on which PEFT has a mergeable LoRA."""
    return [
        f"{root}.{name}" if name else root
        for root in roots
        for name, module in model.get_submodule(root).named_modules()
        if isinstance(module, nn.Linear) or (isinstance(module, nn.Conv2d) and module.groups == 1)
    ]


def _pattern(targets: str | list[str]) -> str:
    """PEFT's reading of `target_modules` as one regular expression."""
    return targets if isinstance(targets, str) else rf"(.*\.)?({'|'.join(map(re.escape, targets))})"


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
    if any(layer.scaling[name] != _full_scaling(layer, name) for layer, name in _lora_parts(model)) or any(
        vars(wrapper).get("_gift_trained") for wrapper, _ in _saved_parts(model)
    ):
        raise ValueError("an adapter is saved at scale 1: call set_adapter_scale(model, 1) first")
    folder = Path(folder)
    _check_replaceable(folder)
    base = base_model_name_or_path or _base_name(model)
    hub_base = _hub_name(base, card)
    temporary = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        model.save_pretrained(temporary, selected_adapters=["default"], save_embedding_layers=False)
        config = json.loads((temporary / ADAPTER_CONFIG).read_text())
        config.update(base_model_name_or_path=base, revision=revision)
        _write_json(temporary / ADAPTER_CONFIG, config)
        if processor is not None:
            # Not save_pretrained: it would put the code of VGGT's and Metric3D's processors beside the adapter.
            _at_size(processor, size).to_json_file(temporary / "preprocessor_config.json")
        _write_json(temporary / "gift.json", _gift_json(gift, size))
        # Last: PEFT writes a README of its own, which names a local base path.
        (temporary / "README.md").write_text(card or _minimal_card(hub_base), encoding="utf-8")
        _replace_folder(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _full_scaling(layer: LoraLayer, name: str) -> float:
    rank = layer.r[name]
    return layer.lora_alpha[name] / (math.sqrt(rank) if layer.use_rslora.get(name) else rank)


def _base_name(model: PeftModel) -> str | None:
    name = model.peft_config["default"].base_model_name_or_path or getattr(model.get_base_model(), "name_or_path", "")
    if not name:
        warnings.warn("the adapter names no base model: give base_model_name_or_path to load it by name", stacklevel=3)
    return name or None


def _hub_name(base: str | None, card: str | None) -> str | None:
    """`base` if it may stand in a card: not a path of this machine."""
    if base is None or not Path(base).exists():
        return base
    warnings.warn(
        f"the base is the local folder {base}: others cannot load this adapter by its base's name; "
        "give a hub id as base_model_name_or_path to publish it",
        stacklevel=2,
    )
    if card and Path(base).is_absolute() and base in card:
        raise ValueError(f"the card names the local base path {base}")
    return None


def _check_replaceable(folder: Path) -> None:
    if folder.exists() and (others := sorted({path.name for path in folder.iterdir()} - ADAPTER_FILES)):
        raise ValueError(
            f"{folder} holds files that are no adapter's ({', '.join(others[:3])}): choose another folder"
        )


def _replace_folder(new: Path, folder: Path) -> None:
    old = folder.with_name(f".{folder.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if folder.exists():
        folder.rename(old)
    new.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def _at_size(processor: Any, size: tuple[int, int] | None) -> Any:
    """A copy of the image processor that resizes every image to exactly (height, width)."""
    if size is None:
        return processor
    processor = copy.deepcopy(processor)
    processor.do_resize = True
    processor.size = {"height": size[0], "width": size[1]}
    if hasattr(processor, "keep_aspect_ratio"):
        processor.keep_aspect_ratio = False
    return processor


def _gift_json(gift: Mapping[str, Any] | None, size: tuple[int, int] | None) -> dict[str, Any]:
    packages = ("gift-peft", "torch", "transformers", "peft", "accelerate")
    return {
        "versions": {name: version(name) for name in packages},
        "size": size,
        **(gift or {}),
    }


def _minimal_card(hub_base: str | None) -> str:
    base = [f"base_model: {hub_base}", "base_model_relation: adapter"] if hub_base else []
    head = ["---", "library_name: peft", "pipeline_tag: depth-estimation", *base, "tags:", "- gift", "- lora", "---"]
    return "\n".join(head) + "\n\n# GIFT adapter\n\nMade with gift-peft; `gift.json` says how.\n"


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(_nan_to_null(content), indent=2, default=str, allow_nan=False) + "\n", encoding="utf-8")


def _nan_to_null(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _nan_to_null(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_nan_to_null(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
