"""Frozen weights in half precision once per group instead of once per forward.

Autocast casts every weight again in each forward, and a graph that is retained keeps its casts: of Depth Anything
V2-Large, 0.6 GB for each micro-batch. Its own cache holds weights that are trained only. The bits are those of
autocast's casts.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

LAYERS = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)  # what autocast runs in half precision, and these models have


@contextmanager
def cast_frozen_once(model: nn.Module, dtype: torch.dtype = torch.bfloat16) -> Iterator[None]:
    """Inside, frozen float32 layers share one cast of their weight over all forwards and backwards under autocast.

    A layer has the cast during its own forward only: what runs outside of autocast, and code that asks for the type of
    its weight, find it unchanged. Compiled blocks are left alone.
    """
    casts: dict[nn.Module, Tensor] = {}
    weights: dict[nn.Module, nn.Parameter] = {}

    def lend(module: nn.Module, args: tuple) -> None:
        weight = module.weight
        if torch.is_autocast_enabled(weight.device.type):
            if module not in casts:
                casts[module] = weight.detach().to(dtype)
            weights[module] = weight
            module._parameters["weight"] = casts[module]

    def take_back(module: nn.Module, args: tuple, output: object) -> None:
        if module in weights:
            module._parameters["weight"] = weights.pop(module)

    handles = []
    for module in _uncompiled_modules(model):
        if type(module) in LAYERS and module.weight.dtype == torch.float32 and not module.weight.requires_grad:
            handles.append(module.register_forward_pre_hook(lend))
            handles.append(module.register_forward_hook(take_back, always_call=True))  # also after an error
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def _uncompiled_modules(module: nn.Module) -> Iterator[nn.Module]:
    if module._compiled_call_impl is None:
        yield module
        for child in module.children():
            yield from _uncompiled_modules(child)
