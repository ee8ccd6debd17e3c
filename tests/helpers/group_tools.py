"""Groups, models and gradients with which the group step is tested."""

import torch
from helpers.tiny import tiny_model
from torch import nn

from gift_peft.adapters.recipes import get_gift_model
from gift_peft.group_step import GroupStep
from gift_peft.losses import gift_loss

SIZE = (28, 28)
COUNTS, CUTS = (2, 3, 5, 9), (1, 2, 4)
DTYPES = {"float64": torch.float64, "float32": torch.float32}
DEAD = "neck.fusion_stage.layers.0.residual_layer1"  # the first fusion has no residual: never a gradient


def gift_model(dtype=torch.float64, spread=0.02):
    """A tiny Depth Anything with a rank-2 adapter that is not at its start."""
    torch.manual_seed(0)
    model = get_gift_model(tiny_model(), rank=2).to(dtype)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter += torch.randn(parameter.shape) * spread
    return model


def group(count, dtype=torch.float64, seed=0, size=SIZE):
    """Pixels, masks (some pairs disjoint, one image all target), proxies near the predictions, valid masks."""
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.randn(count, 3, *size, generator=generator, dtype=torch.float64)
    mask = torch.rand(count, *size, generator=generator) < 0.5
    mask[0, :, : size[1] // 2] = False
    mask[-1, :, size[1] // 2 :] = False
    if count > 2:
        mask[1] = True
    target = torch.rand(count, *size, generator=generator, dtype=torch.float64) * 40
    valid = torch.rand(count, *size, generator=generator) < 0.9
    return pixels.to(dtype), mask, target.to(dtype), valid


def gradients(model):
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


def autograd_gradients(model, cut, pixels, mask, target, valid):
    """Through one graph over all images, in float64 in one batch, in float32 over the same micro-batches."""
    model.zero_grad(set_to_none=True)
    predictions = torch.cat([model(pixel_values=x).predicted_depth for x in pixels.split(cut)])
    loss = gift_loss(predictions, target, mask, 0.8, 1.5, valid)
    loss.total.backward()
    return loss, gradients(model)


def step_gradients(model, cut, retain, data, accelerator=None):
    model.zero_grad(set_to_none=True)
    step = GroupStep(model, 0.8, 1.5, cut, retain, accelerator)
    return step.accumulate(*data), gradients(model)


def largest_error(got, want):
    assert got.keys() == want.keys()
    return max((got[name] - want[name]).abs().max().item() for name in want)


def scale(values):
    return max(value.abs().max().item() for value in values.values())


def num_retained(count, cut, retain):
    """Images of the last whole micro-batches that fit, counted one by one."""
    sizes = [min(cut, count - start) for start in range(0, count, cut)]
    kept = 0
    while sizes and kept + sizes[-1] <= retain:
        kept += sizes.pop()
    return kept


class Toy(nn.Module):
    """Predicts (B,H,W) directly; `.seen` lists the batches, with grad or not."""

    def __init__(self, dtype=torch.float32):
        super().__init__()
        self.conv = nn.Conv2d(3, 4, 3, padding=1, dtype=dtype)
        self.out = nn.Conv2d(4, 1, 1, dtype=dtype)
        self.unused = nn.Parameter(torch.zeros(3, dtype=dtype))
        self.seen = []

    def forward(self, pixel_values):
        self.seen.append((len(pixel_values), torch.is_grad_enabled()))
        return self.out(self.conv(pixel_values).tanh())[:, 0]


def toy(dtype=torch.float32):
    torch.manual_seed(0)
    return Toy(dtype)
