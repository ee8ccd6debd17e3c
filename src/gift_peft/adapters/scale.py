"""Fading an adapter in and out: LoRA times s, saved modules at base + s * (trained - base); s = 0 is the base itself.

That needs a base that the adapter leaves alone, which `check_lora_config` sees to.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import Any

import torch
from peft import LoraConfig
from peft.tuners.lora import LoraLayer
from peft.utils.other import ModulesToSaveWrapper
from torch import nn


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
    transformers loaded from an adapter folder. What was switched off, in part perhaps (transformers' own
    `enable_adapters()` leaves saved modules off), is on afterwards. Set the scale to 1 before training or saving.
    Raises ValueError for a non-finite scale, a model without or with a merged adapter, and weights changed meanwhile.
    """
    if not math.isfinite(scale):
        raise ValueError(f"the adapter scale must be finite, got {scale}")
    layers, wrappers = _scalable_parts(model)
    for config in getattr(model, "peft_config", {}).values():
        check_lora_config(config)
    trained = [_trained_state(wrapper, name) for wrapper, name in wrappers]  # checks all before changing any
    for module in [*(layer for layer, _ in layers), *(wrapper for wrapper, _ in wrappers)]:
        if module.disable_adapters:
            module.enable_adapters(True)
    for layer, name in layers:
        layer.set_scale(name, scale)
    for (wrapper, name), state in zip(wrappers, trained, strict=True):
        _scale_saved_module(wrapper, name, state, scale)


@contextlib.contextmanager
def scale_comes_back(model: nn.Module) -> Iterator[None]:
    """Inside, `set_adapter_scale` may be called at will; afterwards, whatever happened, all is as it was, to the bit.

    Raises ValueError, at once, for a model without or with a merged adapter.
    """
    layers, wrappers = _scalable_parts(model)
    scale, scalings = adapter_scale(model), [layer.scaling[name] for layer, name in layers]
    off = [module for module, _ in (*layers, *wrappers) if module.disable_adapters]
    try:
        yield
    finally:
        set_adapter_scale(model, scale)
        for (layer, name), scaling in zip(layers, scalings, strict=True):
            layer.scaling[name] = scaling
        for module in off:
            module.enable_adapters(False)


def _scalable_parts(
    model: nn.Module,
) -> tuple[list[tuple[LoraLayer, str]], list[tuple[ModulesToSaveWrapper, str]]]:
    """(active LoRA, active modules that are trained in full); ValueError without an adapter, or with a merged one."""
    layers, wrappers = active_lora(model), active_saved_modules(model)
    if not layers and not wrappers:
        raise ValueError("the model has no active LoRA adapter to scale")
    if any(layer.merged for layer, _ in layers):
        raise ValueError("the adapter is merged into the base: unmerge it before changing its scale")
    return layers, wrappers


def adapter_scale(model: nn.Module) -> float:
    """The scale that `set_adapter_scale` set last, 1 if none; ValueError without an active adapter."""
    for wrapper, name in active_saved_modules(model):
        return vars(wrapper).get("_gift_trained", {}).get(name, (1.0,))[0]
    for layer, name in active_lora(model):
        return layer.scaling[name] / full_scaling(layer, name)
    raise ValueError("the model has no active LoRA adapter")


def full_scaling(layer: LoraLayer, name: str) -> float:
    """What PEFT multiplies a LoRA by at scale 1."""
    rank = layer.r[name]
    return layer.lora_alpha[name] / (math.sqrt(rank) if layer.use_rslora.get(name) else rank)


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


def _active_parts(model: Any, kind: type[Any], weights: str) -> Iterator[tuple[Any, str]]:
    """(module, adapter name) of the modules of a kind that hold weights of an active adapter."""
    for module in model.modules():
        if isinstance(module, kind):
            yield from ((module, name) for name in module.active_adapters if name in getattr(module, weights))


def active_lora(model: nn.Module) -> list[tuple[LoraLayer, str]]:
    """(layer, adapter name) of the active LoRA."""
    return list(_active_parts(model, LoraLayer, "scaling"))


def active_saved_modules(model: nn.Module) -> list[tuple[ModulesToSaveWrapper, str]]:
    """(wrapper, adapter name) of the active modules that are trained in full."""
    return list(_active_parts(model, ModulesToSaveWrapper, "modules_to_save"))
