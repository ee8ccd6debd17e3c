"""What makes a step faster or smaller: the same gradient, and where not, how near."""

from functools import partial

import pytest
import torch
from helpers.group_tools import SIZE, gift_model, gradients, group, largest_error, step_gradients
from torch import nn

from gift_peft.adapters.recipes import get_gift_model
from gift_peft.memory import graph_bytes, is_compiled
from gift_peft.training.speed import (
    channels_last_head,
    checkpoint_blocks,
    compile_blocks,
    encoder_blocks,
    make_adam,
    tuned_for,
)


def relative_l2(got, want):
    assert got.keys() == want.keys()
    difference = sum((got[name] - want[name]).double().square().sum() for name in want)
    return (difference / sum(value.double().square().sum() for value in want.values())).sqrt().item()


def test_encoder_blocks_are_those_with_lora(model):
    adapted = get_gift_model(model, head="lora")
    assert encoder_blocks(adapted) == list(adapted.get_base_model().backbone.encoder.layer)


def test_an_architecture_without_marked_blocks_is_told(model):
    adapted = get_gift_model(model)
    for name, module in list(adapted.named_modules()):
        if type(module).__name__ == "Dinov2Layer":
            parent = adapted.get_submodule(name.rpartition(".")[0])
            parent[int(name.rpartition(".")[2])] = nn.Sequential(module.attention)
    with pytest.raises(ValueError, match="DepthAnythingForDepthEstimation has no block"):
        encoder_blocks(adapted)


@pytest.mark.parametrize("retain", [0, 5])
def test_checkpointed_blocks_give_the_same_bits_and_smaller_graphs(retain):
    data = group(5, torch.float32)
    model = gift_model(torch.float32)
    _, want = step_gradients(model, 2, retain, data)
    plain = graph_bytes(model, lambda: model(pixel_values=data[0]).predicted_depth)[1]
    checkpoint_blocks(model)
    _, got = step_gradients(model, 2, retain, data)
    assert largest_error(got, want) == 0
    less = graph_bytes(model, lambda: model(pixel_values=data[0]).predicted_depth)[1]
    assert less < 0.9 * plain  # most of a tiny model's graph is its head's


def test_channels_last_changes_the_trained_head_only():
    data = group(3, torch.float32)
    model = gift_model(torch.float32)
    _, want = step_gradients(model, 2, 0, data)
    with torch.no_grad(), model.disable_adapter():
        teacher = model(pixel_values=data[0]).predicted_depth
    formats = []
    head = model.get_base_model().head.modules_to_save["default"]
    head.conv1.register_forward_hook(
        lambda module, args, output: formats.append(args[0].is_contiguous(memory_format=torch.channels_last))
    )
    with channels_last_head(model):
        _, got = step_gradients(model, 2, 0, data)
        with torch.no_grad(), model.disable_adapter():
            assert torch.equal(model(pixel_values=data[0]).predicted_depth, teacher)
    assert formats and all(formats)
    assert relative_l2(got, want) < 1e-3
    assert all(got[name].is_contiguous() for name in got)


@pytest.mark.parametrize("wanted", [True, False])
def test_channels_last_leaves_nothing_behind(wanted):
    data = group(3, torch.float32)
    model = gift_model(torch.float32)
    _, before = step_gradients(model, 2, 0, data)
    with pytest.raises(RuntimeError, match="stop"), channels_last_head(model, wanted):
        raise RuntimeError("stop")
    _, after = step_gradients(model, 2, 0, data)
    assert largest_error(after, before) == 0
    assert not any(module._forward_pre_hooks for module in model.modules())


@pytest.mark.parametrize(
    ("device", "asked", "head", "expected"),
    [
        ("cpu", None, "full", True),
        ("cpu", None, "lora", False),
        ("cpu", False, "full", False),
        ("mps", None, "full", False),
        ("cpu", True, "full", True),
        ("cuda", None, "full", True),
        ("cuda", None, "lora", False),
        ("cuda", False, "full", False),
    ],
)
def test_channels_last_by_device(device, asked, head, expected, monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "benchmark", False)
    assert tuned_for(torch.device(device), asked, head) is expected
    assert torch.backends.cudnn.benchmark is (device == "cuda")


def test_channels_last_wants_a_head_that_is_trained(model):
    with pytest.raises(ValueError, match="head: full"), channels_last_head(get_gift_model(model, head="lora")):
        pass
    with pytest.raises(ValueError, match="head: full"):
        tuned_for(torch.device("cpu"), True, "lora")


def test_adam_is_pytorchs_in_one_kernel():
    """Against the plain loop over the weights, in float64."""
    torch.manual_seed(0)
    weights = [nn.Parameter(torch.randn(shape, dtype=torch.float64)) for shape in ((3, 5), (7,), (2, 3, 2, 2))]
    others = [nn.Parameter(w.detach().clone()) for w in weights]
    options = {"betas": (0.8, 0.95), "eps": 1e-6, "weight_decay": 0.1}
    fused = make_adam(iter(weights), 0.01, **options)
    plain = torch.optim.Adam(others, lr=0.01, foreach=False, fused=False, **options)
    assert fused.param_groups[0]["fused"] is True
    for _ in range(5):
        for w, o in zip(weights, others, strict=True):
            w.grad = torch.randn_like(w)
            o.grad = w.grad.clone()
        fused.step()
        plain.step()
    for w, o in zip(weights, others, strict=True):
        torch.testing.assert_close(w, o, rtol=1e-12, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-3)])
def test_compiled_blocks_give_the_same_gradient(dtype, tolerance):
    data = group(5, dtype, size=SIZE)
    model = gift_model(dtype)
    _, want = step_gradients(model, 2, 0, data)
    names = [name for name, _ in model.named_parameters()]
    compile_blocks(model)
    for retain in (0, 5):
        _, got = step_gradients(model, 2, retain, data)
        assert relative_l2(got, want) < tolerance
    assert [name for name, _ in model.named_parameters()] == names
    assert gradients(model).keys() == want.keys()


def test_compiled_blocks_are_one_graph_with_the_same_bits_for_batches_of_any_size(monkeypatch):
    """Without code generation (aot_eager): what Dynamo sees is the point."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))
    model = gift_model(torch.float32)
    names = [name for name, _ in model.named_parameters()]
    batches = {count: group(count, torch.float32)[0] for count in (2, 3, 1, 4, 5, 7, 9)}

    def predict(pixels):
        with torch.no_grad():
            exact = model(pixel_values=pixels).predicted_depth
        with torch.autocast("cpu", torch.bfloat16):
            return exact, model(pixel_values=pixels).predicted_depth.detach()

    want = {count: predict(pixels) for count, pixels in batches.items()}
    torch._dynamo.reset()
    counters = torch._dynamo.utils.counters
    counters.clear()
    compile_blocks(model)
    graphs = []
    for count, pixels in batches.items():
        for got, expected in zip(predict(pixels), want[count], strict=True):
            assert torch.equal(got, expected)
        graphs.append(counters["stats"]["unique_graphs"])
    assert not counters["graph_break"]
    assert graphs[0] >= 2 and graphs[2:] == [graphs[2]] * 5  # after two sizes and a single image none is added
    assert [name for name, _ in model.named_parameters()] == names
    assert all(is_compiled(block) for block in encoder_blocks(model))
    torch._dynamo.reset()


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-3)])
def test_one_graph_over_the_whole_group_gives_the_same_gradient(dtype, tolerance):
    """No micro-batches: other kernels for other batch sizes, and L1 signs that flip on ties."""
    data = group(9, dtype)
    model = gift_model(dtype)
    _, want = step_gradients(model, 2, 0, data)
    _, got = step_gradients(model, 9, 9, data)
    assert relative_l2(got, want) < tolerance
