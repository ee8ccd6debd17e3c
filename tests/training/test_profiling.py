"""What a profile counts and measures, without taking what it measures."""

import pytest
import torch
from helpers.group_tools import SIZE, gift_model
from helpers.tiny import tiny_model
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from gift_peft.adapters.recipes import get_gift_model
from gift_peft.training.precision import exact_output
from gift_peft.training.profiling import count_flops


@pytest.mark.parametrize("head", ["full", "lora"])
def test_flops_are_those_of_a_real_forward_and_backward(head):
    model = get_gift_model(tiny_model(), rank=2, head=head)
    exact_output(model)  # as a run does
    pixels = torch.rand(2, 3, *SIZE)
    with sdpa_kernel(SDPBackend.MATH):  # PyTorch counts nothing for the fused attention of CPUs
        with FlopCounterMode(display=False) as forward:
            depth = model(pixel_values=pixels).predicted_depth
        with FlopCounterMode(display=False) as backward:
            depth.sum().backward()
    want = tuple(counter.get_total_flops() / 2 for counter in (forward, backward))
    model.zero_grad(set_to_none=True)
    assert count_flops(model, pixels) == want
    assert all(p.grad is None for p in model.parameters())


def test_counting_flops_computes_nothing():
    model = gift_model(torch.float32)
    for p in model.parameters():
        p.data.fill_(float("nan"))
        p.grad = torch.ones_like(p) if p.requires_grad else None
    seen = []
    model.get_base_model().head.register_forward_hook(lambda module, args, output: seen.append(output.is_meta))
    flops = count_flops(model, torch.rand(1, 3, *SIZE))
    assert seen == [True] and flops.forward > 0 and flops.backward > flops.forward / 2
    assert all(p.grad.eq(1).all() for p in model.parameters() if p.requires_grad)
