"""Whether a model's forward gives the same bits twice, which a replay must do of its snapshot.

No dropout, no BatchNorm on batch statistics. Models have more than a thousand modules: they are walked once, and what
was found is looked at for every group.
"""

from collections.abc import Iterator
from typing import Any

from torch import nn


def dropout_rates(model: nn.Module) -> Iterator[tuple[str, nn.Module, str]]:
    """(module name, module, attribute) of every dropout or drop-path rate above 0, in whatever mode the model is."""
    for name, module, key in watched(model):
        if key != "training" and _rate(module, key) > 0:
            yield name, module, key


def check_replayable(model: nn.Module) -> None:
    """ValueError for a model whose replay would not repeat its snapshot: dropout, BatchNorm on batch statistics."""
    for part in watched(model):
        check_watched(*part)


def watched(model: nn.Module) -> Iterator[tuple[str, nn.Module, str]]:
    """(module name, module, attribute) of all that makes two forwards differ, or could."""
    for name, module in model.named_modules():
        keys = ["drop_prob", "dropout_prob", "attention_dropout"]
        if isinstance(module, nn.modules.dropout._DropoutNd):
            keys.append("p")
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            keys.append("training")
        for key in keys:
            if isinstance(getattr(module, key, None), int | float):
                yield name or type(module).__name__, module, key


def check_watched(name: str, module: nn.Module, key: str) -> None:
    if key == "training":
        if module.training:
            raise ValueError(f"BatchNorm layer {name} is in training mode: call model.eval() first")
    elif _rate(module, key) > 0:
        raise ValueError(f"dropout must be 0, but {name} has {key}={getattr(module, key)}")


def _rate(module: nn.Module, key: str) -> float:
    rate = getattr(module, key, 0)
    return rate if isinstance(rate, int | float) else 0


def mixed_precision_of(model: nn.Module, accelerator: Any) -> str:
    """ "no" or "bf16": the accelerator's, or without one bf16 on CUDA; ValueError for another."""
    if accelerator is not None:
        precision = accelerator.mixed_precision
    else:
        precision = "bf16" if next(model.parameters()).device.type == "cuda" else "no"
    if precision not in ("no", "bf16"):
        raise ValueError(
            f"mixed precision {precision} is not supported (a gradient scaler cannot follow a replay): use bf16 or no"
        )
    return precision
