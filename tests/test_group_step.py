"""Snapshot and replay against autograd through the whole group, on one process."""

import math
from contextlib import contextmanager

import pytest
import torch
from accelerate import Accelerator, DistributedType
from accelerate.state import AcceleratorState
from helpers.group_tools import (
    COUNTS,
    CUTS,
    DEAD,
    Toy,
    autograd_gradients,
    gift_model,
    gradients,
    group,
    largest_error,
    num_retained,
    scale,
    step_gradients,
    toy,
)
from helpers.tiny import tiny_model
from peft import LoraConfig, get_peft_model
from torch import nn

from gift_peft.adapters.recipes import get_gift_model
from gift_peft.group_step import GroupStep
from gift_peft.losses import gift_loss


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("count", COUNTS)
def test_gradient_is_that_of_the_whole_group(model_of, count, cut):
    dtype = next(model_of.parameters()).dtype
    data = group(count, dtype)
    loss, want = autograd_gradients(model_of, count if dtype == torch.float64 else cut, *data)
    runs = {retain: step_gradients(model_of, cut, retain, data) for retain in (0, 2, count)}
    for retain, (output, got) in runs.items():
        assert largest_error(got, want) < (1e-10 if dtype == torch.float64 else 1e-6 * scale(want))
        assert all(torch.equal(got[name], runs[0][1][name]) for name in want)
        assert output.forwards == 2 * count - num_retained(count, cut, retain)
        assert output.num_pairs == loss.num_pairs
        for value, expected in zip(output[:3], loss[:3], strict=True):
            assert not value.requires_grad
            torch.testing.assert_close(
                value, expected.detach(), rtol=1e-5 if dtype == torch.float32 else 1e-12, atol=0
            )
    assert not any(DEAD in name for name in want) and any("lora_A" in name for name in want)


def test_adds_to_existing_gradients():
    model = gift_model()
    data, more = group(3), group(2, seed=1)
    _, first = step_gradients(model, 2, 0, data)
    _, second = step_gradients(model, 2, 0, more)
    step = GroupStep(model, 0.8, 1.5)
    model.zero_grad()
    step.accumulate(*data)
    step.accumulate(*more)
    assert largest_error(gradients(model), {name: first[name] + second[name] for name in first}) == 0


def test_first_step_of_a_fresh_adapter_has_no_distillation():
    """Proxies cut as the step cuts have the step's bits."""
    model = get_gift_model(tiny_model())
    pixels, mask, _, _ = group(5, torch.float32)
    with torch.no_grad(), model.disable_adapter():
        target = torch.cat([model(pixel_values=x).predicted_depth for x in pixels.split(2)])
    output = GroupStep(model).accumulate(pixels, mask, target)
    assert output.distillation == 0 and output.total == output.consistency > 0


@pytest.mark.parametrize("cut", [1, 2, 3, 5])
def test_first_distillation_is_zero_for_any_cut_and_rounding(cut):
    """Proxies of another cut, and a last digit apart, as another number of threads makes them."""
    model = get_gift_model(tiny_model())
    pixels, mask, _, _ = group(5, torch.float32)
    with torch.no_grad(), model.disable_adapter():
        target = torch.cat([model(pixel_values=x).predicted_depth for x in pixels.split(2)])
    target = target.nextafter(target + (torch.arange(target.numel()).view_as(target) % 3 - 1))
    step = GroupStep(model, micro_batch_size=cut)
    output = step.accumulate(pixels, mask, target)
    assert output.distillation == 0 and output.total == output.consistency > 0 and step.first_share == 0
    got = gradients(model)
    model.zero_grad()
    GroupStep(model, lambda_d=0, micro_batch_size=cut).accumulate(pixels, mask, target)
    assert largest_error(got, gradients(model)) == 0


def test_the_share_of_rounding_in_the_first_update_is_known():
    model, data = toy(), group(4, torch.float32)
    step = GroupStep(model, 0.8, 1.5)
    step.accumulate(*data)
    share = step.first_share
    depth = torch.cat([model(pixel_values=x) for x in data[0].split(2)]).detach().requires_grad_()
    loss = gift_loss(depth, data[2], data[1], valid=data[3])
    pulls = [torch.autograd.grad(term, depth, retain_graph=True)[0].abs().sum() for term in loss[1:3]]
    assert share.item() == pytest.approx((1.5 * pulls[1] / (0.8 * pulls[0] + 1.5 * pulls[1])).item(), rel=1e-5)
    step.accumulate(*group(3, torch.float32, seed=1))
    assert step.first_share is share  # of the first group


def test_schedule():
    model, data = toy(), group(5, torch.float32)
    assert GroupStep(model, retain=0).accumulate(*data).forwards == 10
    assert model.seen == [(2, False), (2, False), (1, False), (2, True), (2, True), (1, True)]
    model.seen.clear()
    assert GroupStep(model, retain=3).accumulate(*data).forwards == 7
    assert model.seen == [(2, False), (2, True), (1, True), (2, True)]
    assert model.unused.grad is None


def test_phases_of_a_step():
    names = []

    @contextmanager
    def phase(name):
        names.append(name)
        yield
        names.append("end")

    step = GroupStep(toy(), retain=0)
    step.phase = phase
    step.accumulate(*group(3, torch.float32))
    assert names == ["snapshot", "end", "loss", "end", "replay", "end"]


def test_works_under_no_grad_and_leaves_the_mode_alone():
    model, data = toy(), group(3, torch.float32)
    GroupStep(model).accumulate(*data)
    want = gradients(model)
    model.zero_grad()
    model.eval()
    with torch.no_grad():
        GroupStep(model).accumulate(*data)
    assert largest_error(gradients(model), want) == 0 and not model.training


def test_no_pair_and_no_other_region_give_zero_gradients():
    model, (pixels, mask, target, _) = toy(), group(3, torch.float32)
    output = GroupStep(model).accumulate(pixels, torch.zeros_like(mask), target, torch.zeros_like(mask))
    assert output.total == 0 and output.num_pairs == 0
    assert model.conv.weight.grad is not None and not model.conv.weight.grad.any()


def test_bf16_autocast():
    model, data = toy(), group(3, torch.float32)
    AcceleratorState._reset_state(reset_partial_state=True)
    step = GroupStep(model, accelerator=Accelerator(cpu=True, mixed_precision="bf16"))
    AcceleratorState._reset_state(reset_partial_state=True)
    assert step.mixed_precision == "bf16" and GroupStep(model).mixed_precision == "no"
    step.accumulate(*data)
    bf16 = gradients(model)
    with torch.autocast("cpu", torch.bfloat16):
        predictions = torch.cat([model(pixel_values=x) for x in data[0].split(2)])
        assert predictions.dtype == torch.bfloat16
    model.zero_grad()
    gift_loss(predictions, data[2], data[1], valid=data[3]).total.backward()
    assert largest_error(bf16, gradients(model)) < 1e-2 * scale(bf16)
    assert all(g.dtype == torch.float32 for g in bf16.values())


def test_own_autocast_inside_a_caching_one():
    """Weights cast under no_grad by the snapshots must not be reused, without gradient, by the replays."""
    model, data = toy(), group(4, torch.float32)
    AcceleratorState._reset_state(reset_partial_state=True)
    step = GroupStep(model, accelerator=Accelerator(cpu=True, mixed_precision="bf16"))
    AcceleratorState._reset_state(reset_partial_state=True)
    step.accumulate(*data)
    want = gradients(model)
    model.zero_grad()
    with torch.autocast("cpu", torch.bfloat16):
        step.accumulate(*data)
    assert largest_error(gradients(model), want) == 0


# ---- what is refused, with .grad as it was ----


def refused(model, data, message, **kwargs):
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    with pytest.raises(ValueError, match=message) as error:
        GroupStep(model, **kwargs).accumulate(*data)
    assert "\n" not in str(error.value)
    assert all(torch.equal(p.grad, torch.ones_like(p)) for p in model.parameters())


def test_non_finite_prediction_names_the_image():
    model, data = toy(), group(5, torch.float32)
    with torch.no_grad():
        model.out.bias.fill_(math.nan)
    refused(model, (*data, ["a.png", "b.png", "c.png", "d.png", "e.png"]), r"prediction of a.png \(image 0\) has NaN")
    refused(model, data, "prediction of image 0 has NaN", retain=5)


def test_non_finite_gradient_leaves_gradients_alone():
    model, data = toy(), group(4, torch.float32)
    count = []

    def hook(gradient):
        count.append(None)
        return gradient * math.inf if len(count) == 2 else gradient

    model.out.weight.register_hook(hook)
    refused(model, data, "gradient of this group has NaN or infinite")


def test_failing_replay_leaves_gradients_alone():
    class Failing(Toy):
        def forward(self, pixel_values):
            if len(self.seen) == 3:
                raise ValueError("out of luck")
            return super().forward(pixel_values)

    refused(Failing(), group(4, torch.float32), "out of luck", retain=0)


def test_bad_groups():
    model, (pixels, mask, target, valid) = toy(), group(3, torch.float32)
    bad = target.clone()
    bad[1, 0, 0] = math.inf
    refused(model, (pixels, mask, bad), r"target \(proxy\) of image 1 has NaN or infinite")
    refused(model, (pixels, mask, bad, valid, ["x/0", "x/1", "x/2"]), r"target \(proxy\) of x/1")
    refused(model, (pixels * math.nan, mask, target), "pixel_values of image 0")
    refused(model, (pixels, mask[:2], target), "mask has 2 entries for 3 images")
    refused(model, (pixels, mask, target, valid, ["one"]), "names has 1 entries for 3 images")
    refused(model, (pixels.half(), mask, target), "not fp16")
    refused(model, (pixels[:0], mask[:0], target[:0]), "no images")
    refused(model, (pixels, mask.float(), target), "mask must be a bool tensor")
    half = slice(None, 14)
    refused(model, (pixels, mask[:, half], target[:, half]), "the prediction is 28x28 but mask and target are 14x28")


def test_bad_models():
    data = group(2, torch.float32)
    model = toy()
    model.forward = lambda pixel_values: nn.functional.conv2d(pixel_values, model.conv.weight, padding=1)
    refused(model, data, r"must predict \(2,H,W\)")
    refused(toy().half(), data, "fp16 parameters")
    with pytest.raises(ValueError, match="no trainable parameter"):
        GroupStep(toy().requires_grad_(False)).accumulate(*data)
    batch_norm = nn.Sequential(nn.BatchNorm2d(3), nn.Conv2d(3, 1, 1))
    with pytest.raises(ValueError, match="BatchNorm layer 0 is in training mode"):
        GroupStep(batch_norm)
    GroupStep(batch_norm.eval())


@pytest.mark.parametrize("layer", [nn.Dropout(0.1), nn.Dropout2d(0.5)])
def test_dropout_is_refused(layer):
    model = toy()
    step = GroupStep(model)
    model.add_module("noise", layer)
    refused(model, group(2, torch.float32), "dropout must be 0, but noise has p=")
    with pytest.raises(ValueError, match="dropout"):
        step.accumulate(*group(2, torch.float32))
    model.noise.p = 0.0
    GroupStep(model)


def test_lora_and_attention_dropout_are_refused():
    noisy = get_peft_model(tiny_model(), LoraConfig(target_modules=["q_proj"], lora_dropout=0.1))
    with pytest.raises(ValueError, match=r"q_proj.lora_dropout.default has p=0.1"):
        GroupStep(noisy)
    model = tiny_model()
    model.backbone.encoder.layer[0].attention.attention_dropout = 0.2
    with pytest.raises(ValueError, match=r"attention_dropout=0\.2"):
        GroupStep(model)


def test_bad_arguments():
    for kwargs, message in (
        ({"micro_batch_size": 0}, "micro_batch_size must be a positive integer"),
        ({"retain": -1}, "retain must be"),
        ({"retain": "all"}, "retain must be"),
        ({"retain": 1.5}, "retain must be"),
    ):
        with pytest.raises(ValueError, match=message):
            GroupStep(toy(), **kwargs)


def test_fp16_and_ddp_are_refused():
    class Fp16:
        mixed_precision = "fp16"

    with pytest.raises(ValueError, match="mixed precision fp16 is not supported"):
        GroupStep(toy(), accelerator=Fp16())

    class Sharded:
        mixed_precision = "no"
        distributed_type = DistributedType.FSDP

    with pytest.raises(ValueError, match="FSDP is not supported"):
        GroupStep(toy(), accelerator=Sharded())
    wrapped = nn.parallel.DistributedDataParallel.__new__(nn.parallel.DistributedDataParallel)
    with pytest.raises(ValueError, match="DistributedDataParallel"):
        GroupStep(wrapped)
