"""One network that goes from the base to the adapter: the adapter's scale as an input.

LoRA adds `scale * B A` to a weight and a part trained in full is base + scale * (trained - base), as in
`set_adapter_scale`; both are worked out inside the graph, from the base's weights and what the adapter adds to them.
"""

from typing import Any

import torch
from peft import PeftModel
from peft.tuners.lora import LoraLayer
from torch import Tensor, nn

from gift_peft.adapters.scale import active_lora, active_saved_modules, set_adapter_scale

INPUT = "adapter_scale"


class DialedNetwork(nn.Module):
    """Predictions of pixel values (B,3,h,w) and a scale (1,): 0 is the base, 1 the adapter.

    Args:
        model: with a LoRA adapter; it is taken apart.

    Raises ValueError for a LoRA layer whose weight is not one that a product of its two matrices adds to.
    """

    def __init__(self, model: PeftModel) -> None:
        super().__init__()
        set_adapter_scale(model, 1)
        names = {id(module): name for name, module in model.get_base_model().named_modules()}
        lora = [(names[id(layer)], layer, name) for layer, name in active_lora(model)]
        saved = [(names[id(wrapper)], wrapper, name) for wrapper, name in active_saved_modules(model)]
        self.low_rank: dict[str, tuple[str, str, float, torch.Size]] = {}
        self.added: dict[str, str] = {}
        self.deltas = nn.ParameterDict()
        for place, layer, name in lora:
            self._take_lora(f"{place}.weight", layer, name)
        bases: dict[str, Tensor] = {}
        for place, wrapper, name in saved:
            original = wrapper.original_module.state_dict()
            for key, value in wrapper.modules_to_save[name].state_dict().items():
                path = f"{place}.{key}" if place else key
                bases[path] = original[key].clone()
                if value.is_floating_point() and not torch.equal(value, original[key]):
                    self.added[path] = self._keep(value - original[key])
        self.network = model.unload().eval()
        self.network.load_state_dict(bases, strict=False)
        self.requires_grad_(False)

    def _take_lora(self, weight: str, layer: LoraLayer, name: str) -> None:
        down, up = layer.lora_A[name].weight, layer.lora_B[name].weight
        shape = layer.get_base_layer().weight.shape
        groups = getattr(layer.get_base_layer(), "groups", 1)
        if getattr(layer, "fan_in_fan_out", False) or groups != 1 or up.flatten(1).shape[1] != down.shape[0]:
            raise ValueError(f"--dial: the LoRA on {weight} is not a product of two matrices; export without a dial")
        self.low_rank[weight] = (self._keep(up.flatten(1)), self._keep(down.flatten(1)), layer.scaling[name], shape)

    def _keep(self, tensor: Tensor) -> str:
        key = str(len(self.deltas))
        self.deltas[key] = nn.Parameter(tensor.detach().clone(), requires_grad=False)
        return key

    def forward(self, pixel_values: Tensor, adapter_scale: Tensor, token_grid: Tensor | None = None) -> Tensor:
        weights = dict(self.network.named_parameters()) | dict(self.network.named_buffers())
        changed = {}
        for path, key in self.added.items():
            changed[path] = weights[path] + adapter_scale.reshape(()) * self.deltas[key]
        for path, (up, down, scaling, shape) in self.low_rank.items():
            product = (self.deltas[up] @ self.deltas[down]).reshape(shape)
            changed[path] = weights[path] + adapter_scale.reshape(()) * scaling * product
        inputs = _inputs(pixel_values, token_grid)
        return torch.func.functional_call(self.network, changed, kwargs=inputs).predicted_depth


class PlainNetwork(nn.Module):
    """A depth model of transformers as a function of tensors alone."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, pixel_values: Tensor, token_grid: Tensor | None = None) -> Tensor:
        return self.network(**_inputs(pixel_values, token_grid)).predicted_depth


def _inputs(pixel_values: Tensor, token_grid: Tensor | None) -> dict[str, Any]:
    """A network's arguments; of `token_grid` (rows, columns) the shape counts, see `token_grid.py`."""
    inputs: dict[str, Any] = {"pixel_values": pixel_values}
    return inputs if token_grid is None else inputs | {"token_grid": tuple(token_grid.shape)}
