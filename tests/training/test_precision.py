"""Which precision a run gets on which device, and what stays in float32 under autocast; devices are mocked."""

import pytest
import torch
from helpers.group_tools import SIZE, gift_model
from helpers.moge import tiny_moge, tiny_vit
from helpers.tiny import tiny_model
from torch import nn

from gift_peft.adapters.recipes import get_gift_model
from gift_peft.training.precision import choose_precision, exact_output

__all__ = ["tiny_vit"]  # a fixture

CPU, CUDA = torch.device("cpu"), torch.device("cuda", 0)


@pytest.mark.parametrize(
    ("device", "capability", "asked", "setting", "expected"),
    [
        (CPU, None, None, None, "no"),
        (CPU, None, None, "bf16", "bf16"),
        (CPU, None, "bf16", "no", "bf16"),
        (CUDA, (9, 0), None, None, "bf16"),
        (CUDA, (8, 0), None, "no", "bf16"),  # accelerate launch without a configuration
        (CUDA, (8, 9), "no", None, "no"),
        (CUDA, (8, 9), "no", "bf16", "no"),
        (CUDA, (7, 5), None, None, "no"),  # Turing emulates bf16
        (CUDA, (7, 0), None, "no", "no"),
        (CUDA, (7, 5), "bf16", "no", "bf16"),
        (torch.device("mps"), None, None, None, "no"),
    ],
)
def test_precision(device, capability, asked, setting, expected, monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device=None: capability)
    monkeypatch.delenv("ACCELERATE_MIXED_PRECISION", raising=False)
    if setting:
        monkeypatch.setenv("ACCELERATE_MIXED_PRECISION", setting)
    said = []
    assert choose_precision(asked, device, said.append) == expected
    assert len(said) == (device == CUDA and capability >= (8, 0) and setting == "no" and asked is None)
    assert all("--mixed_precision no" in line and "\n" not in line for line in said)


def test_what_accelerate_may_say_and_we_cannot(monkeypatch):
    monkeypatch.setenv("ACCELERATE_MIXED_PRECISION", "fp8")
    with pytest.raises(ValueError, match=r"fp8 .* is not supported; use bf16 or no"):
        choose_precision(None, CPU)


@pytest.mark.parametrize("head", ["full", "lora", "none"])
def test_depth_ends_in_float32_under_autocast(head):
    model = get_gift_model(tiny_model(), rank=2, head=head)
    pixels = torch.randn(2, 3, *SIZE, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        exact = model(pixel_values=pixels).predicted_depth
        with torch.autocast("cpu", torch.bfloat16):
            before = model(pixel_values=pixels).predicted_depth
        exact_output(model)
        assert torch.equal(model(pixel_values=pixels).predicted_depth, exact)  # nothing changes without autocast
        with torch.autocast("cpu", torch.bfloat16):
            after = model(pixel_values=pixels).predicted_depth
            assert torch.is_autocast_enabled("cpu")
            with model.disable_adapter():
                assert model(pixel_values=pixels).predicted_depth.dtype == torch.float32
    assert (before.dtype, after.dtype) == (torch.bfloat16, torch.float32)
    assert (after - exact).abs().mean() <= (before.float() - exact).abs().mean()


@pytest.mark.parametrize("head", ["full", "lora", "none"])
@pytest.mark.parametrize("name", ["v1", "v2-normal"])
def test_points_and_their_scale_end_in_float32_too(name, head, tiny_vit):
    """MoGe's depth is the third of three channels, times a scale of linear layers; its one channel is a mask."""
    model = get_gift_model(tiny_moge(name=name), rank=2, head=head)
    pixels = torch.rand(2, 3, 42, 56, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        exact = model(pixel_values=pixels).points
        with torch.autocast("cpu", torch.bfloat16):
            before = model(pixel_values=pixels).points
        exact_output(model)
        assert torch.equal(model(pixel_values=pixels).points, exact)
        with torch.autocast("cpu", torch.bfloat16):
            output = model(pixel_values=pixels)
    for part in [output.points, *([output.metric_scale] if name == "v2-normal" else [])]:
        assert (part.bfloat16().float() == part).float().mean() < 0.1, "it ended in bf16"
    assert (output.points - exact).abs().mean() < 0.7 * (before - exact).abs().mean()


def test_gradients_pass_and_autocast_comes_back_after_an_error():
    model = gift_model(torch.float32)
    exact_output(model)
    pixels = torch.randn(2, 3, *SIZE)
    with torch.autocast("cpu", torch.bfloat16):
        model(pixel_values=pixels).predicted_depth.sum().backward()
    conv = model.get_base_model().head.modules_to_save["default"].conv3
    assert conv.weight.grad.dtype == torch.float32 and conv.weight.grad.any()
    failing = nn.Conv2d(2, 1, 3)
    exact_output(failing)
    with torch.autocast("cpu", torch.bfloat16):
        with pytest.raises(RuntimeError):
            failing(torch.zeros(1, 3, 5, 5))
        assert torch.is_autocast_enabled("cpu")
