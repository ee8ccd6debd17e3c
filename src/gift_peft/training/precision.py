"""Which precision a run computes in, and what stays in float32 under autocast.

bf16 has 8 bits: a prediction of 160 that ends in it moves in steps of 0.5 to 1. The last convolution of a head, a
thousandth of the work, is therefore left in float32; VGGT and Metric3D leave their heads there by themselves.
"""

import os
import re
from collections.abc import Callable
from typing import Any

import torch
from torch import nn

BF16_CAPABILITY = (8, 0)  # NVIDIA Ampere; older devices emulate bf16, slowly and without its attention kernels


def choose_precision(asked: str | None, device: torch.device, say: Callable[[str], Any] = print) -> str:
    """ "no" or "bf16": the argument, else accelerate's setting, else bf16 on CUDA where the device computes in it.

    `accelerate launch` sets "no" whenever nothing else was configured, so on CUDA that counts as no setting; `say`
    tells so in one line. ValueError for a setting that is neither.
    """
    setting = os.environ.get("ACCELERATE_MIXED_PRECISION")
    usual = "bf16" if device.type == "cuda" and torch.cuda.get_device_capability(device) >= BF16_CAPABILITY else "no"
    if asked is None and setting == "no" and usual == "bf16":
        say('Autocast bf16, the "no" of `accelerate launch` being its default; --mixed_precision no trains in float32')
        return usual
    precision = asked or setting or usual
    if precision not in ("no", "bf16"):
        raise ValueError(f"mixed_precision: {precision} (accelerate's setting) is not supported; use bf16 or no")
    return precision


def exact_output(model: nn.Module) -> None:
    """Leave what gives depth itself in float32 under autocast; else nothing changes.

    Convolutions of one channel; or, where a network has `depth_outputs`, the convolutions and linear layers in whose
    names this regular expression is found: MoGe's depth is one of three channels, and its one channel is a mask.
    """
    named = next((module.depth_outputs for module in model.modules() if hasattr(module, "depth_outputs")), None)
    for name, module in model.named_modules():
        if named is None:
            gives_depth = isinstance(module, nn.Conv2d) and module.out_channels == 1
        else:
            gives_depth = isinstance(module, nn.Conv2d | nn.Linear) and re.search(str(named), name)
        if gives_depth:
            hooks = _OutOfAutocast()
            module.register_forward_pre_hook(hooks.leave)
            module.register_forward_hook(hooks.enter, always_call=True)


class _OutOfAutocast:
    """One module's forward without autocast, on inputs in float32."""

    def __init__(self) -> None:
        self.left = False

    def leave(self, module: nn.Module, args: tuple) -> tuple | None:
        device = args[0].device.type  # meta, where arithmetic is counted, knows no autocast
        self.left = torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)
        if not self.left:
            return None
        torch.set_autocast_enabled(device, False)
        return args[0].float(), *args[1:]

    def enter(self, module: nn.Module, args: tuple, output: Any) -> None:
        if self.left:
            torch.set_autocast_enabled(args[0].device.type, True)
