"""The models that an evaluation compares, as functions of pixel values, and what they are fed.

A `PeftModel` is its own base under `disable_adapter()`; anything else is compared with a `teacher`.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from gift_peft.evaluation.protocols import Protocol
from gift_peft.models.loading import load_model, predict_depth
from gift_peft.models.pixels import resolve_size

Predictor = Callable[[torch.Tensor], torch.Tensor]
METRIC_MODELS = {"zoedepth", "depth_pro", "prompt_depth_anything"}  # they predict metres without saying so


def make_predictors(model, teacher, baseline: bool, batch_size: int) -> tuple[dict[str, Predictor], Predictor]:
    """The predictors to compare, and the frozen one."""

    def plain(network):
        return lambda pixel_values: predict_depth(network, pixel_values, batch_size)

    own = plain(model)
    if hasattr(model, "disable_adapter"):

        def frozen(pixel_values):
            with model.disable_adapter():
                return own(pixel_values)

    elif teacher is not None:
        frozen = plain(load_model(teacher).model if isinstance(teacher, str | Path) else teacher)
    else:
        return {"base": own}, own
    return ({"base": frozen, "adapted": own} if baseline else {"adapted": own}), frozen


@contextmanager
def evaluating(*models: Any) -> Iterator[None]:
    """Eval mode inside; afterwards every module's mode and every parameter's requires_grad are as before.

    (`disable_adapter()` turns gradients on for every adapter parameter when it ends, frozen ones included.)
    """
    networks = [model for model in models if isinstance(model, torch.nn.Module)]
    modes = [(module, module.training) for network in networks for module in network.modules()]
    gradients = [(weight, weight.requires_grad) for network in networks for weight in network.parameters()]
    for network in networks:
        network.eval()
    try:
        yield
    finally:
        for module, mode in modes:
            module.training = mode
        for weight, flag in gradients:
            weight.requires_grad_(flag)


def own_processor(model: Any) -> Any:
    """The image processor of the place the model came from; ValueError if it does not say."""
    from transformers import AutoImageProcessor

    source = getattr(getattr(model, "config", None), "_name_or_path", "")
    if not source:
        raise ValueError("the model does not say where it came from; pass its processor=")
    return AutoImageProcessor.from_pretrained(source)


def network_size(size: tuple[int, int] | None, model: Any, processor: Any) -> tuple[int, int]:
    """(height, width) at the network: `size`, else the recipe's, else the image processor's."""
    return tuple(size) if size is not None else resolve_size(None, _recipe(model), processor)


def _recipe(model):
    from gift_peft.adapters.recipes import get_recipe

    try:
        return get_recipe(model)
    except ValueError:
        return None  # an architecture without a recipe: its image processor states the size


def to_millimetres(model: Any, protocol: Protocol) -> float:
    """What a prediction is multiplied by where the protocol fits no scale: 1000 for models in metres, else 1."""
    if protocol.dof not in ("none", "shift"):
        return 1.0
    config = getattr(model, "config", None)
    metric = getattr(config, "depth_estimation_type", None) == "metric"
    return 1000.0 if metric or getattr(config, "model_type", None) in METRIC_MODELS else 1.0
