"""One cast per frozen weight and group: autocast's bits, smaller graphs, and weights that are back afterwards."""

import math

import pytest
import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from helpers.group_tools import gift_model, gradients, group, largest_error
from torch import nn

from gift_peft.group_step import GroupStep
from gift_peft.memory import FrozenCasts, graph_bytes


@pytest.fixture
def accelerator():
    AcceleratorState._reset_state(reset_partial_state=True)
    yield Accelerator(cpu=True, mixed_precision="bf16")
    AcceleratorState._reset_state(reset_partial_state=True)


def snapshot_of(model):
    return {name: (p, p.dtype, p.detach().clone()) for name, p in model.named_parameters()}


def assert_unchanged(model, before):
    assert [name for name, _ in model.named_parameters()] == list(before)
    for name, p in model.named_parameters():
        assert p is before[name][0] and p.dtype == before[name][1] and torch.equal(p, before[name][2])


def hooks_of(model):
    hooks = [h for m in model.modules() for h in (*m._forward_hooks.values(), *m._forward_pre_hooks.values())]
    return [hook for hook in hooks if hook.__module__ == "gift_peft.memory"]  # transformers has some of its own


@pytest.mark.parametrize("retain", [0, 2, 5])
def test_the_step_has_autocasts_bits(accelerator, retain):
    model, data = gift_model(torch.float32), group(5, torch.float32)
    before = snapshot_of(model)
    step = GroupStep(model, retain=retain, accelerator=accelerator)
    output = step.accumulate(*data)
    got = gradients(model)
    model.zero_grad()
    assert hooks_of(model) and not step._casts.tensors()  # nothing is kept between groups
    step._casts = None  # and with it its hooks
    assert not hooks_of(model)
    expected = step.accumulate(*data)
    assert output == expected
    assert largest_error(got, gradients(model)) == 0
    assert_unchanged(model, before)


def test_a_weight_is_cast_once_and_its_cast_is_kept_once():
    """Two forwards: without, each graph has its own half-precision copy of the frozen weights."""
    model, (pixels, *_) = gift_model(torch.float32), group(4, torch.float32)

    def forward():
        with torch.autocast("cpu", torch.bfloat16, cache_enabled=False):
            return torch.cat([model(pixel_values=x).predicted_depth for x in pixels.split(2)])

    apart = graph_bytes(model, forward)[1]
    with FrozenCasts(model):
        shared = graph_bytes(model, forward)[1]
    layers = [m for m in model.base_model.model.backbone.encoder.modules() if type(m) is nn.Linear]
    frozen = sum(2 * m.weight.numel() for m in layers if not m.weight.requires_grad)
    assert frozen * 0.9 < apart - shared < frozen * 1.1  # the first block's query needs no gradient of its input


def test_casts_that_graphs_share_are_not_counted_as_an_images(accelerator):
    """On a CPU too, where the graph's tensors are looked at one by one."""
    model, data = gift_model(torch.float32), group(4, torch.float32)
    step = GroupStep(model, accelerator=accelerator)
    step.accumulate(*data)
    (measured,) = step.budget._image_bytes.values()

    def forward():
        with torch.autocast("cpu", torch.bfloat16, cache_enabled=False):
            return model(pixel_values=data[0][:2]).predicted_depth

    with FrozenCasts(model) as casts:
        everything = graph_bytes(model, forward, data[0])[1]
        own = graph_bytes(model, forward, data[0], shared=casts.tensors)[1]
    assert measured == math.ceil(own / 2) and everything - own > 10_000


def test_outside_of_autocast_layers_stay_in_float32():
    class Model(nn.Module):
        def __init__(self):
            super().__init__()
            self.low, self.exact = (nn.Linear(3, 3).requires_grad_(False) for _ in range(2))

        def forward(self, x):
            low = self.low(x.to(self.low.weight.dtype))
            with torch.autocast("cpu", enabled=False):
                return low, self.exact(low.to(self.exact.weight.dtype))

    model = Model()
    with FrozenCasts(model), torch.autocast("cpu", torch.bfloat16):
        low, exact = model(torch.ones(2, 3))
    assert (low.dtype, exact.dtype) == (torch.bfloat16, torch.float32)


def test_weights_are_back_after_an_error(accelerator):
    model, data = gift_model(torch.float32), group(3, torch.float32)
    layer = model.base_model.model.backbone.encoder.layer[1].mlp.fc1

    def fail(x):
        raise torch.OutOfMemoryError("CUDA out of memory")

    before = snapshot_of(model)
    layer.forward = fail
    with pytest.raises(torch.OutOfMemoryError):
        GroupStep(model, accelerator=accelerator).accumulate(*data)
    assert_unchanged(model, before)
    del layer.forward
    data[2][0, 0, 0] = math.nan
    with pytest.raises(ValueError, match="proxy"):
        GroupStep(model, accelerator=accelerator).accumulate(*data)
    assert_unchanged(model, before)
