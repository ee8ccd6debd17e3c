"""The step on single images: its gradient is that of one straight line, however it is cut, on one process or two."""

import math

import pytest
import torch
from accelerate import Accelerator, debug_launcher
from accelerate.state import AcceleratorState, GradientState
from accelerate.utils import DistributedDataParallelKwargs
from helpers.group_tools import gift_model, gradients, group, largest_error, toy

from gift_peft.memory import GraphBudget
from gift_peft.training.surface_step import PredictedDepth, SurfaceStep

LAMBDAS = 1.5, 0.8
COUNT = 5


def images(count=COUNT, dtype=torch.float64):
    """As the group step's, and one image whose mask is empty."""
    pixels, mask, target, valid = group(count, dtype)
    mask[2:3] = False
    return pixels, mask, target, valid


def straight_line(model, pixels, mask, target, valid=None):
    """The mean over images of the loss as the paper's symbols have it, in one graph; the three means."""
    model.zero_grad(set_to_none=True)
    valid = torch.ones_like(mask) if valid is None else valid
    output = model(pixel_values=pixels)
    difference = (getattr(output, "predicted_depth", output) - target).abs()
    inside, other = (mask & valid).double(), (~mask & valid).double()
    first = (difference * inside).sum((1, 2)) / inside.sum((1, 2)).clamp(min=1)
    second = 2 * (difference * other).sum((1, 2)) / other.sum((1, 2)).clamp(min=1)
    total = (LAMBDAS[0] * first + LAMBDAS[1] * second).mean()
    total.backward()
    return (total.item(), first.mean().item(), second.mean().item()), gradients(model)


def accumulated(model, data, micro_batch_size=4, accelerator=None, **options):
    step = SurfaceStep(PredictedDepth(model), *LAMBDAS, micro_batch_size, accelerator)
    return step.accumulate(*data, **options), gradients(model)


@pytest.mark.parametrize("with_valid", [True, False])
@pytest.mark.parametrize("cut", [1, 2, 3, 8])
def test_gradient_and_loss_for_any_micro_batch_size(cut, with_valid):
    """An image that is all target, one without a target, pixels that do not exist."""
    model, data = gift_model(), images()
    data = data if with_valid else data[:3]
    losses, expected = straight_line(model, *data)
    output, got = accumulated(model, data, cut)
    assert largest_error(got, expected) < 1e-10
    assert tuple(output) == pytest.approx(losses, abs=1e-10)


def test_what_was_in_the_gradient_is_replaced():
    model, data = toy(torch.float64), images()
    _, expected = straight_line(model, *data)
    for parameter in model.parameters():
        parameter.grad = torch.full_like(parameter, 100)
    assert largest_error(accumulated(model, data)[1], expected) < 1e-10


def test_an_image_with_neither_target_nor_other_counts_0():
    model, (pixels, mask, target, valid) = toy(torch.float64), images(2)
    valid[1] = False
    output, got = accumulated(model, (pixels, mask, target, valid))
    alone, half = accumulated(model, (pixels[:1], mask[:1], target[:1], valid[:1]))
    assert output.total == pytest.approx(alone.total / 2)
    assert largest_error(got, {name: value / 2 for name, value in half.items()}) < 1e-12
    nothing, zeros = accumulated(model, (pixels[1:], mask[1:], target[1:], valid[1:]))
    assert nothing.total == 0 and all(not value.any() for value in zeros.values())


def test_a_target_of_one_pixel_and_a_mask_over_the_whole_photo():
    model, (pixels, mask, target, _) = toy(torch.float64), images(2)
    mask[0], mask[1] = False, True
    mask[0, 3, 5] = True
    losses, expected = straight_line(model, pixels, mask, target)
    output, got = accumulated(model, (pixels, mask, target))
    assert tuple(output) == pytest.approx(losses) and largest_error(got, expected) < 1e-10


def test_half_the_images_at_half_the_weight_add_up():
    model, data = toy(torch.float64), images(4)
    whole, expected = accumulated(model, data)
    parts = [accumulated(model, [part[half] for part in data], weight=1 / 4) for half in (slice(2), slice(2, 4))]
    summed = {name: sum(got[name] for _, got in parts) for name in expected}
    assert largest_error(summed, expected) < 1e-12
    assert sum(output.total for output, _ in parts) == pytest.approx(whole.total)


def test_memory_that_runs_out_halves_the_micro_batch():
    model, data = toy(torch.float64), images()
    _, expected = straight_line(model, *data)
    forward, sizes = model.forward, []

    def tight(pixel_values):
        sizes.append(len(pixel_values))
        if len(pixel_values) > 1:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return forward(pixel_values)

    model.forward = tight
    step = SurfaceStep(PredictedDepth(model), *LAMBDAS, 8)
    step.accumulate(*data)
    assert sizes == [5, 2] + [1] * 5 and step.micro_batch_size == 1
    assert largest_error(gradients(model), expected) < 1e-10
    model.forward = lambda pixel_values: (_ for _ in ()).throw(torch.OutOfMemoryError("CUDA out of memory"))
    with pytest.raises(torch.OutOfMemoryError):
        step.accumulate(*data)


@pytest.mark.parametrize(("room", "expected"), [(0, 2), (1, 2), (3, 2), (4, 4), (7, 4), (8, 8), (100, 8)])
def test_the_micro_batch_is_measured(room, expected, monkeypatch):
    """Of up to eight: all where their graphs fit beside the measured one, else what a backward leaves, evenly."""
    monkeypatch.setattr(GraphBudget, "images", lambda self, pixel_values, canvas: room)
    model, (pixels, *_) = gift_model(), images()
    step, forwards = SurfaceStep(PredictedDepth(model), micro_batch_size=8), []
    handle = model.register_forward_hook(lambda module, args, output: forwards.append(output.predicted_depth))
    assert step.choose_micro_batch_size(pixels[:1], 8) == step.micro_batch_size == expected
    handle.remove()
    assert [len(depth) for depth in forwards] == [2] and forwards[0].requires_grad
    assert all(p.grad is None for p in model.parameters())
    assert step.choose_micro_batch_size(pixels[:1], 3) == (3 if room >= 3 else 2)
    assert step.choose_micro_batch_size(pixels[:1], 1) == 1


@pytest.mark.parametrize("fits", [0, 1])
def test_one_image_where_two_do_not_fit_and_not_even_one(fits):
    model, (pixels, *_) = toy(torch.float64), images()
    forward = model.forward

    def tight(pixel_values):
        if len(pixel_values) > fits:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return forward(pixel_values)

    model.forward = tight
    step = SurfaceStep(PredictedDepth(model), micro_batch_size=4)
    if fits:
        assert step.choose_micro_batch_size(pixels[:1], 4) in (1, 2, 4)  # by what this machine has
        model.forward = forward
    else:
        with pytest.raises(torch.OutOfMemoryError, match="not even one image"):
            step.choose_micro_batch_size(pixels[:1], 4)
        assert step.micro_batch_size == 4


def test_bad_input_is_one_line():
    model, (pixels, mask, target, valid) = toy(), images(3, torch.float32)
    names = ["g/a.png", "g/b.png", "g/c.png"]
    bad, infinite = pixels.clone(), target.clone()
    bad[2], infinite[1] = math.nan, math.inf
    cases = {
        "the prediction of g/c.png (image 2) has NaN": (bad, mask, target, valid, names),
        "the surface target of g/b.png (image 1) has NaN": (pixels, mask, infinite, valid, names),
        "the prediction is 28x28 but mask and target are 14x28": (pixels, mask[:, :14], target[:, :14], None, names),
        "the loss of this update is NaN or infinite": (pixels, mask, torch.full_like(target, 3e38), valid, names),
    }
    for words, data in cases.items():
        step = SurfaceStep(PredictedDepth(model), *LAMBDAS, 2)
        with pytest.raises(ValueError) as excinfo:
            step.accumulate(*data)
        assert words in str(excinfo.value) and "\n" not in str(excinfo.value)
    for parameter in model.parameters():
        parameter.requires_grad_(False)
    with pytest.raises(ValueError, match="no trainable parameter"):
        accumulated(model, images(2, torch.float32))


# ---- two processes ----

SHARES = {"even": (4, 2), "uneven": (5, 2), "one": (1, 4)}  # images of the update, per forward


def message_of(function, *args):
    try:
        function(*args)
    except ValueError as error:
        return str(error)


def work(folder):
    """Everything that two processes are asked, in one launch; each leaves its answers in a file."""
    AcceleratorState._reset_state(reset_partial_state=True)
    GradientState._reset_state()
    torch.set_num_threads(1)
    options = DistributedDataParallelKwargs(find_unused_parameters=True, broadcast_buffers=False)
    accelerator = Accelerator(cpu=True, kwargs_handlers=[options])
    rank, answers = accelerator.process_index, {}
    for name, (count, cut) in SHARES.items():
        model = gift_model()
        shell = accelerator.prepare(PredictedDepth(model))
        assert isinstance(shell, torch.nn.parallel.DistributedDataParallel)
        data = images(5) if count == 5 else tuple(part[:count] for part in images(5))
        mine = [part[rank::2] if len(part) > rank else part[:1] for part in data]
        step = SurfaceStep(shell, *LAMBDAS, cut, accelerator)
        for update in range(2):  # the second in the buckets that DDP has rearranged
            output = step.accumulate(*mine, weight=1 / count if count > rank else 0.0)
            answers[name, update] = (tuple(output), gradients(model))
    budget, GraphBudget.images = GraphBudget.images, lambda self, pixel_values, canvas: 8 - 4 * rank
    step = SurfaceStep(shell, *LAMBDAS, 8, accelerator)
    answers["chosen"] = step.choose_micro_batch_size(data[0][:1], 8)  # between two updates
    GraphBudget.images = budget
    answers["after"] = tuple(step.accumulate(*mine, weight=1 / count if count > rank else 0.0)), gradients(model)
    bad = [part.clone() for part in images(4)]
    bad[0][2] = math.nan  # of process 0 alone
    shell = accelerator.prepare(PredictedDepth(toy(torch.float64)))
    step = SurfaceStep(shell, *LAMBDAS, 1, accelerator)
    answers["bad"] = message_of(step.accumulate, *(part[rank::2] for part in bad), None, 1 / 4)
    torch.save(answers, f"{folder}/{rank}.pt")


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two")
    debug_launcher(work, (str(folder),), num_processes=2)
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


@pytest.mark.parametrize("name", SHARES)
def test_two_processes_give_the_gradient_of_one(answers, name):
    count, _ = SHARES[name]
    data = [part[:count] for part in images(5)]
    losses, expected = straight_line(gift_model(), *data)
    for each in answers:
        for update in range(2):
            output, got = each[name, update]
            assert output == pytest.approx(losses, abs=1e-9)
            assert largest_error(got, expected) < 1e-9
        assert all(torch.equal(got[key], answers[0][name, 1][1][key]) for key in got)


def test_processes_take_the_least_and_measuring_leaves_no_trace(answers):
    assert [each["chosen"] for each in answers] == [4, 4]
    last = list(SHARES)[-1]
    for each in answers:
        output, got = each["after"]
        assert output == pytest.approx(each[last, 1][0], abs=1e-12)
        assert largest_error(got, each[last, 1][1]) < 1e-9


def test_what_one_process_stumbles_over_all_report(answers):
    assert "the prediction of image 1 has NaN" in answers[0]["bad"] and answers[0]["bad"] == answers[1]["bad"]
