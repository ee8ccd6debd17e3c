"""Where GIFT puts its trainable weights (paper, "Implementation details"; supplement B).

Rank-8 LoRA on the attention of every encoder block, the depth head trained in full (PEFT's `modules_to_save`). The
result is a plain `PeftModel`: `disable_adapter()` is the frozen teacher, to the bit.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from peft import LoraConfig, PeftModel, get_peft_model
from torch import nn

from gift_peft.adapters.scale import check_lora_config
from gift_peft.replayable import dropout_rates
from gift_peft.rules import KINDS

HEADS = ("full", "lora", "none")


@dataclass(frozen=True)
class GiftRecipe:
    """What of a depth model GIFT trains.

    Args:
        target_modules: LoRA targets in the encoder: a regular expression on whole names, or a list of last parts.
        modules_to_save: modules of the depth head, trained in full (`head="full"`) or by LoRA (`head="lora"`).
        kind: what the model predicts, "depth" or "inverse_depth"; None follows `config.depth_estimation_type`.
        size: (height, width) of the model's input; None takes it from the image processor.
        where_present (`bool`): `modules_to_save` lists what several versions of a network have: those that this one
            lacks are left out, all but one.
        lora: further `LoraConfig` arguments, such as `{"lora_alpha": 16}`.
    """

    target_modules: str | list[str]
    modules_to_save: list[str]
    kind: str | None = None
    size: tuple[int, int] | None = None
    where_present: bool = False
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
    "gift_moge": GiftRecipe(
        target_modules=r"network\.(encoder\.)?backbone\.blocks\.\d+\.attn\.(qkv|proj)",
        # MoGe-2: what leads from tokens to points and their scale, but neither mask nor normals; MoGe: its one head.
        modules_to_save=[
            "network.encoder.output_projections",
            "network.neck",
            "network.points_head",
            "network.scale_head",
            "network.head",
        ],
        kind="depth",
        size=(476, 644),
        where_present=True,
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
    convolutions and linears (transposed and grouped ones, and those that do not pad with zeros, stay frozen: PEFT
    cannot merge them), "none" leaves them frozen; `recipe` replaces the one for `config.model_type`.
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
    saved = _head_modules(model, recipe.modules_to_save, recipe.where_present) if head != "none" else []
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


def _check_base(model: nn.Module) -> None:
    for name, parameter in model.named_parameters():
        if parameter.is_floating_point() and parameter.dtype not in (torch.float32, torch.float64):
            raise ValueError(
                f"the base is in {str(parameter.dtype).removeprefix('torch.')} ({name}): load it with "
                "dtype=torch.float32 and train under bf16 autocast, or the head has no full-precision weights"
            )


def _head_modules(model: nn.Module, names: list[str], where_present: bool = False) -> list[str]:
    """Full paths of the modules called `names`, so written that PEFT finds these and no others.

    PEFT takes every module whose path ends with a given text: `head` means `metric_head` as well, and the `head.head`
    inside `head`, which it would wrap twice. Such a module is written as its parts.
    """
    keys = [key for key, _ in model.named_modules()]
    found_by_name = {name: [key for key in keys if key == name or key.endswith(f".{name}")] for name in names}
    if where_present:
        found_by_name = {name: found for name, found in found_by_name.items() if found} or found_by_name
    wanted = []
    for name, found in found_by_name.items():
        if not found:
            similar = [key for key in keys if key.endswith(name)]
            hint = f" (there are {', '.join(similar[:4])})" if similar else ""
            raise ValueError(f"modules_to_save: the model has no module {name!r}{hint}")
        wanted += found
    outer = [key for key in dict.fromkeys(wanted) if not any(key.startswith(f"{other}.") for other in wanted)]
    return [path for key in outer for path in _unambiguous(model, key, keys, outer)]


def _unambiguous(model: nn.Module, path: str, keys: list[str], wanted: list[str]) -> list[str]:
    others = [key for key in keys if key.endswith(path) and key != path and key not in wanted]
    module = model.get_submodule(path)
    if not others and not isinstance(module, nn.ModuleList):  # PEFT wraps what has a forward
        return [path]
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
        if isinstance(module, nn.Linear) or (isinstance(module, nn.Conv2d) and _merges(module))
    ]


def _merges(convolution: nn.Conv2d) -> bool:
    """PEFT's own convolutions pad with zeros, and have no groups."""
    pads_as_they_do = convolution.padding_mode == "zeros" or max(convolution.kernel_size) == 1
    return convolution.groups == 1 and pads_as_they_do


def _pattern(targets: str | list[str]) -> str:
    """PEFT's reading of `target_modules` as one regular expression."""
    return targets if isinstance(targets, str) else rf"(.*\.)?({'|'.join(map(re.escape, targets))})"
