"""Snapshot and replay on two and three processes: the gradient and the adapter of one."""

import math

import pytest
import torch
from accelerate import Accelerator, debug_launcher
from accelerate.state import AcceleratorState, GradientState
from helpers.group_tools import (
    COUNTS,
    CUTS,
    DTYPES,
    gift_model,
    gradients,
    group,
    largest_error,
    num_retained,
    scale,
    step_gradients,
    toy,
)
from helpers.tiny import tiny_model, tiny_processor, write_raw_tree

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.evaluation.evaluate import evaluate_gift_i
from gift_peft.group_inputs import GroupInputs
from gift_peft.group_step import GroupStep
from gift_peft.training.teacher import make_proxies

UPDATES = 20


def train(model, accelerator, dtype):
    """20 Adam updates on groups of changing size; the adapter's weights."""
    parameters = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(parameters, lr=2e-5)
    step = GroupStep(model, accelerator=accelerator)
    for update in range(UPDATES):
        step.accumulate(*group((5, 2, 3)[update % 3], dtype, seed=update))
        optimizer.step()
        optimizer.zero_grad()
    return {name: p.detach().clone() for name, p in model.named_parameters() if p.requires_grad}


def retained(name, count):
    """Whether a graph was kept matters to the bits alone, so one precision will do."""
    return (0, 2, count) if name == "float64" else (0,)


def message_of(function, *args):
    try:
        function(*args)
    except ValueError as error:
        return str(error)


def work(folder):
    """Everything that two processes are asked, in one launch; each process leaves its answers in a file."""
    AcceleratorState._reset_state(reset_partial_state=True)  # forked from a process that may have had its own
    GradientState._reset_state()
    torch.set_num_threads(1)
    accelerator = Accelerator(cpu=True)
    assert accelerator.num_processes == 2
    answers = {}
    for name, dtype in DTYPES.items():
        model = gift_model(dtype)
        for count in COUNTS:
            for cut in CUTS:
                data = group(count, dtype)
                runs = {r: step_gradients(model, cut, r, data, accelerator) for r in retained(name, count)}
                answers[name, count, cut] = runs
        answers[name, "trained"] = train(gift_model(dtype, spread=0), accelerator, dtype)

    answers["auto"] = [GroupStep(toy(), accelerator=accelerator).accumulate(*group(n, torch.float32)) for n in COUNTS]
    for usual in (None, 3, 20):
        step = GroupStep(toy(), micro_batch_size="auto", accelerator=accelerator)
        data = GroupInputs(*group(9, torch.float32))
        answers["chosen", usual] = step.choose_micro_batch_size(data, largest=30, usual=usual)
    model, (pixels, mask, target, _) = toy(), group(2, torch.float32)
    for parameter in model.parameters():
        parameter.grad = torch.full_like(parameter, 100)
    step = GroupStep(model, accelerator=accelerator)
    step.accumulate(pixels, mask, target)  # one micro-batch: process 1 has none
    answers["on top"] = gradients(model)
    answers["size"] = message_of(step.accumulate, pixels, mask[:, :14], target[:, :14])
    with torch.no_grad():
        model.out.bias.fill_(math.inf)
    answers["infinite"] = message_of(step.accumulate, pixels, mask, target, None, ["left", "right"])
    answers["after errors"] = gradients(model)
    torch.save(answers, folder / f"{accelerator.process_index}.pt")


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """The answers of process 0 and of process 1."""
    folder = tmp_path_factory.mktemp("two")
    debug_launcher(work, (folder,), num_processes=2)
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in (0, 1)]


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("count", COUNTS)
def test_two_processes_sum_to_the_gradient(two, model_of, count, cut):
    dtype = next(model_of.parameters()).dtype
    name = str(dtype).removeprefix("torch.")
    expected, want = step_gradients(model_of, cut, 0, group(count, dtype))
    runs, other_runs = (answers[name, count, cut] for answers in two)
    for retain, (output, got) in runs.items():
        other_output, other = other_runs[retain]
        assert output == other_output and largest_error(got, other) == 0
        assert largest_error(got, runs[0][1]) == 0  # whatever is retained
        assert largest_error(got, want) < (1e-10 if dtype == torch.float64 else 1e-6 * scale(want))
        assert output[:4] == expected[:4] and output.forwards == 2 * count - num_retained(count, cut, retain)


def work_of_three(folder, base_dir, tree):
    """Training, proxies and evaluation by three processes, with fewer micro-batches and groups than processes."""
    AcceleratorState._reset_state(reset_partial_state=True)
    GradientState._reset_state()
    torch.set_num_threads(1)
    accelerator = Accelerator(cpu=True)
    assert accelerator.num_processes == 3
    answers = {(name, "trained"): train(gift_model(d, spread=0), accelerator, d) for name, d in DTYPES.items()}
    proxies = {"size": (56, 70), "proxies_dir": folder / "proxies"}
    make_proxies(base_dir, tree, accelerator=accelerator, **proxies)
    rows = load_gift_i(tree, "train", teacher=base_dir, **proxies)
    report = evaluate_gift_i(rows, tiny_model(), accelerator=accelerator, processor=tiny_processor(), progress=False)
    answers["evaluation"] = report.gce, report.rows
    torch.save(answers, folder / f"{accelerator.process_index}.pt")


@pytest.fixture(scope="module")
def three(base_dir, tmp_path_factory):
    """(the answers of each process, their folder, the tree they looked at: groups of 2 and of 5 images)."""
    folder = tmp_path_factory.mktemp("three")
    tree = write_raw_tree(folder / "raw", train=(2, 5), validation=())
    list_of_rows = load_gift_i(tree, "train")  # the listing is cached by one process
    assert len(list_of_rows) == 2
    debug_launcher(work_of_three, (folder, base_dir, tree), num_processes=3)
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(3)], folder, tree


@pytest.mark.parametrize(("name", "tolerance"), [("float64", 1e-9), ("float32", 1e-5)])
def test_two_and_three_processes_train_the_same_adapter(two, three, name, tolerance):
    model = gift_model(DTYPES[name], spread=0)
    start = {key: p.detach().clone() for key, p in model.named_parameters() if p.requires_grad}
    want = train(model, None, DTYPES[name])
    for processes in (two, three[0]):
        for answers in processes:
            assert largest_error(processes[0][name, "trained"], answers[name, "trained"]) == 0
        assert largest_error(processes[0][name, "trained"], want) < tolerance
    assert largest_error(start, want) > 1e-4  # it did train


def test_three_processes_share_proxies_and_evaluation(three, base_dir, tmp_path):
    processes, folder, tree = three
    options = {"size": (56, 70), "proxies_dir": tmp_path}
    make_proxies(base_dir, tree, **options)
    files = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*.safetensors"))
    assert len(files) == 2
    assert all((tmp_path / file).read_bytes() == (folder / "proxies" / file).read_bytes() for file in files)
    rows = load_gift_i(tree, "train", teacher=base_dir, **options)
    report = evaluate_gift_i(rows, tiny_model(), processor=tiny_processor(), progress=False)
    for answers in processes:
        assert repr(answers["evaluation"]) == repr((report.gce, report.rows))


def test_two_processes_add_this_group_only(two):
    model, data = toy(), group(2, torch.float32)
    GroupStep(model).accumulate(*data[:3])
    want = {name: g + 100 for name, g in gradients(model).items()} | {"unused": torch.full((3,), 100.0)}
    for answers in two:
        assert largest_error(answers["on top"], want) < 1e-5
        assert largest_error(answers["after errors"], answers["on top"]) == 0


def test_two_processes_retain_what_each_has_room_for(two):
    for answers in two:
        assert [output.forwards for output in answers["auto"]] == list(COUNTS)


@pytest.mark.parametrize(("usual", "chosen"), [(None, 6), (3, 2), (20, 10)])
def test_both_have_work_on_a_usual_group(two, usual, chosen):
    """Memory would hold all of its images in one micro-batch, which leaves the second process without one."""
    assert [answers["chosen", usual] for answers in two] == [chosen, chosen]


def test_two_processes_raise_together(two):
    for answers in two:
        assert "the prediction is 28x28 but mask and target are 14x28" in answers["size"]
        assert "the prediction of left (image 0) has NaN or infinite values" in answers["infinite"]
