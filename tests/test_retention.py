"""How much memory graphs may take: what is measured, what limits count, and what happens when it proves too much."""

import logging

import pytest
import torch
from helpers.group_tools import Toy, autograd_gradients, gift_model, gradients, group, largest_error, toy
from torch import nn

from gift_peft import memory
from gift_peft.group_inputs import GroupInputs
from gift_peft.group_step import GroupStep
from gift_peft.memory import GraphBudget, available_memory, graph_bytes

GIB = 2**30


def step_with_room_for(images, model, data, monkeypatch):
    """A step with retain="auto" on a machine whose memory is just enough for the graphs of so many images."""
    pixels, mask = data[0], data[1]
    size = graph_bytes(model, lambda: model(pixel_values=pixels[:2]), pixels)[1]
    reserved = 4 * sum(p.nbytes for p in model.parameters())
    needed = images * (size // 2) + memory.GROUP_TENSORS * mask.numel() * pixels.element_size() + size + reserved
    monkeypatch.setattr(memory, "available_memory", lambda: int(needed / memory.CPU_SHARE) + 4)
    model.seen.clear()
    return GroupStep(model)


@pytest.mark.parametrize("room", [0, 1, 2, 3, 4, 5, 7, 9, 100])
def test_auto_keeps_the_last_micro_batches_that_fit(room, monkeypatch):
    """The same bits as the paper's schedule, with fewer forwards."""
    data = group(7, torch.float32)
    model = toy()
    GroupStep(model, retain=0).accumulate(*data)
    want = gradients(model)
    model.zero_grad()
    step = step_with_room_for(room, model, data, monkeypatch)
    outputs = []
    for _ in range(2):  # the first measures, the second knows
        outputs.append(step.accumulate(*data))
        assert largest_error(gradients(model), want) == 0
        model.zero_grad()
    kept = next(k for k in (7, 5, 3, 1, 0) if k <= room)
    assert [output.forwards for output in outputs] == [14 - kept] * 2
    assert sum(count for count, _ in model.seen) == 2 * (14 - kept)


def test_nothing_is_forwarded_twice_when_all_fits():
    model, data = toy(), group(5, torch.float32)
    GroupStep(model).accumulate(*data)
    assert model.seen == [(2, True), (2, True), (1, True)]


def test_graph_bytes_counts_what_the_graph_keeps_and_not_the_weights():
    """conv -> tanh -> 1x1 conv: kept are the input, tanh's output, and the prediction itself."""
    model, (pixels, *_) = toy(), group(2, torch.float32)
    prediction, size = graph_bytes(model, lambda: model(pixel_values=pixels))
    assert size == pixels.nbytes + 4 * prediction.nbytes + prediction.nbytes
    assert graph_bytes(model, lambda: model(pixel_values=pixels[:1]), pixels)[1] == (4 + 1) * pixels[0, 0].nbytes
    assert prediction.requires_grad


def test_frozen_layers_before_the_first_trained_one_keep_nothing():
    model, (pixels, *_) = toy(), group(2, torch.float32)
    model.conv.requires_grad_(False)
    assert graph_bytes(model, lambda: model(pixel_values=pixels))[1] == (4 + 1) * pixels[:, 0].nbytes


# ---- out of memory ----


class Narrow(Toy):
    """A device that holds the graphs of `room` images, and beside them one micro-batch at work.

    A forward that keeps its graph, or with `when="backward"` the backward of one, fails while more graphs live.
    """

    def __init__(self, room, when):
        super().__init__()
        self.room, self.when, self.alive = room, when, 0

    def forward(self, pixel_values):
        output = super().forward(pixel_values)
        if not output.requires_grad:
            return output
        if self.when == "forward" and self.alive + len(pixel_values) > self.room:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
        return Graph.apply(output, self)


class Graph(torch.autograd.Function):
    @staticmethod
    def forward(ctx, output, model):
        class Life:
            def __init__(self):
                model.alive += len(output)
                self.count = len(output)

            def __del__(self):
                model.alive -= self.count

        ctx.life, ctx.model = Life(), model
        return output.clone()

    @staticmethod
    def backward(ctx, gradient):
        if ctx.model.when == "backward" and ctx.model.alive > ctx.model.room:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
        return gradient, None


def narrow(room, when):
    torch.manual_seed(0)
    return Narrow(room, when)


@pytest.mark.parametrize("when", ["forward", "backward"])
@pytest.mark.parametrize("room", [2, 4, 7])
def test_out_of_memory_halves_the_budget_and_the_group_is_done_again(room, when, caplog):
    data = group(9, torch.float32)
    model = toy()
    GroupStep(model, 0.8, 1.5, retain=0).accumulate(*data)
    want = gradients(model)

    model = narrow(room, when)
    step = GroupStep(model, 0.8, 1.5)
    for p in model.parameters():
        p.grad = torch.ones_like(p)
    with caplog.at_level(logging.WARNING, "gift_peft"):
        step.accumulate(*data)
        assert "out of memory" in caplog.text
        got = gradients(model)
        assert all(torch.equal(got[name], torch.ones_like(want[name]).add_(want[name])) for name in want)
        budget = step.budget.bytes
        for _ in range(3):
            step.accumulate(*data)
        learned = len(caplog.records)
        step.accumulate(*data)
    assert step.budget.bytes <= budget and step.budget.images(data[0], data[1].float()) <= room
    assert len(caplog.records) == learned <= 4  # 9, 4, 2, 1 are halves
    assert model.alive == 0


def test_a_single_micro_batch_that_does_not_fit_is_an_error():
    model, data = narrow(1, "forward"), group(4, torch.float32)
    with pytest.raises(torch.OutOfMemoryError):
        GroupStep(model).accumulate(*data)
    assert all(p.grad is None for p in model.parameters())


def test_a_fixed_number_is_taken_at_its_word():
    with pytest.raises(torch.OutOfMemoryError):
        GroupStep(narrow(2, "forward"), retain=6).accumulate(*group(6, torch.float32))


def raising(error, room):
    """A model whose graphs of more than `room` images end in this error."""
    model = narrow(room, "forward")
    forward = model.forward

    def fail(pixel_values):
        try:
            return forward(pixel_values)
        except torch.OutOfMemoryError:
            raise error from None

    model.forward = fail
    return model


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
        RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED"),
        RuntimeError("CUDA error: out of memory"),
        RuntimeError("NCCL Error 1: unhandled cuda error: Failed to CUDA malloc: out of memory"),
        RuntimeError("MPS backend out of memory (MPS allocated: 5.05 GB)"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:75] err == 0. DefaultCPUAllocator: can't allocate memory"),
    ],
)
def test_other_words_for_out_of_memory_are_understood(error):
    data = group(9, torch.float32)
    model = toy()
    GroupStep(model, retain=0).accumulate(*data)
    narrow_model = raising(error, 4)
    GroupStep(narrow_model).accumulate(*data)
    assert largest_error(gradients(narrow_model), gradients(model)) == 0


def test_another_error_is_not_taken_for_it():
    with pytest.raises(RuntimeError, match="device-side assert"):
        GroupStep(raising(RuntimeError("CUDA error: device-side assert triggered"), 4)).accumulate(
            *group(9, torch.float32)
        )


def test_a_budget_that_proved_too_much_is_measured_anew_after_a_while(monkeypatch):
    monkeypatch.setattr(memory, "PATIENCE", 3)
    data, model = group(6, torch.float32), narrow(4, "forward")
    step = GroupStep(model)
    forwards = [step.accumulate(*data).forwards for _ in range(3)]
    assert forwards[-1] > 6 and step.budget.bytes < 10**6
    model.room = 100  # who took the memory has gone
    assert 6 in [step.accumulate(*data).forwards for _ in range(8)]
    assert step.budget.bytes > 10**6


def test_halving_keeps_half(caplog):
    """What was kept, and not that less the group's own tensors, which were there as well."""
    data, model = group(9, torch.float32), narrow(7, "backward")
    step = GroupStep(model)
    step.accumulate(*data)
    before = len(caplog.records)
    assert before and step.budget.images(data[0], data[1].float()) == int(caplog.records[-1].args[1])


# ---- micro-batches by memory ----


def with_room(images, model, data, monkeypatch):
    step_with_room_for(images, model, data, monkeypatch)
    return GroupStep(model, micro_batch_size="auto")


@pytest.mark.parametrize("room", [0, 1, 2, 3, 5, 6, 8, 9, 30])
def test_micro_batches_take_the_whole_group_or_an_even_number_that_fits(room, monkeypatch):
    data, model = group(9, torch.float32), toy()
    step = with_room(room, model, data, monkeypatch)
    chosen = step.choose_micro_batch_size(GroupInputs(*data))
    assert chosen == 9 if room >= 9 else (chosen % 2 == 0 and 2 <= chosen <= 2 + room // 2)
    GroupStep(model, micro_batch_size=chosen, retain=0).accumulate(*data)
    want = gradients(model)
    model.zero_grad()
    output = step.accumulate(*data)
    assert step.micro_batch_size == chosen and largest_error(gradients(model), want) == 0
    kept = 18 - output.forwards
    assert kept == 9 if room >= 9 else kept + 2 * (chosen - 2) <= room


@pytest.mark.parametrize(("room", "cut"), [(0, 2), (4, 4), (7, 4), (9, 9)])
def test_the_cut_of_auto_has_the_gradient_of_one_graph(room, cut, monkeypatch):
    """In float64; to the bit what a full graph gives where the cut is the whole group."""
    data, model = group(9), gift_model()
    _, want = autograd_gradients(model, 9, *data)
    monkeypatch.setattr(GraphBudget, "images", lambda self, pixel_values, canvas: room)
    results = {}
    for name, options in {"auto": ("auto",), "full": (9, 9)}.items():
        model.zero_grad(set_to_none=True)
        step = GroupStep(model, 0.8, 1.5, *options)
        step.accumulate(*data)
        results[name] = gradients(model)
        assert largest_error(results[name], want) < 1e-10
        assert step.micro_batch_size == (cut if name == "auto" else 9)
    assert cut < 9 or largest_error(results["auto"], results["full"]) == 0


def test_the_largest_group_decides_and_the_choice_stays(monkeypatch):
    data, model = group(4, torch.float32), toy()
    step = with_room(6, model, group(9, torch.float32), monkeypatch)
    assert step.choose_micro_batch_size(GroupInputs(*data), largest=9) < 6
    step = with_room(100, model, data, monkeypatch)
    assert step.choose_micro_batch_size(GroupInputs(*data), largest=9) == step.micro_batch_size == 9
    step = with_room(100, model, data, monkeypatch)
    assert (step.accumulate(*data).forwards, step.micro_batch_size) == (4, 4)
    step.accumulate(*group(9, torch.float32))
    assert step.micro_batch_size == 4


def test_at_most_eight_on_cuda(monkeypatch):
    data, model = group(20, torch.float32), toy()
    budget = GraphBudget(model)
    budget.measure(data[0][:2], lambda x: model(pixel_values=x))
    assert budget.widen(data[0], 2, data[2]) == 20

    class OnCuda:
        device = torch.device("cuda", 0)

    monkeypatch.setattr(model, "parameters", lambda: iter([OnCuda]))
    assert budget.widen(data[0], 2, data[2]) == memory.CUDA_MOST_IMAGES == 8
    assert budget.widen(data[0], 2, data[2][:5]) == 5


@pytest.mark.parametrize(("room", "expected"), [(0, 2), (11, 2), (20, 4), (47, 6), (82, 8), (400, 8)])
def test_on_cuda_most_of_the_room_is_for_graphs(room, expected):
    """24, 40, 80 and 139 GiB for Depth Anything V2-Large: a replay costs more there than launches do."""
    chosen = memory.micro_batch_for(room, 2, 55, on_cuda=True)
    assert chosen == expected
    assert room >= 55 or 2 * (chosen - 2) <= room / 4


def test_one_image_where_two_do_not_fit():
    data = group(5, torch.float32)
    step = GroupStep(narrow(1, "forward"), micro_batch_size="auto")
    assert step.choose_micro_batch_size(GroupInputs(*data)) == 1
    assert step.accumulate(*data).num_pairs > 0 and step.micro_batch_size == 1


def test_not_even_one():
    step = GroupStep(narrow(0, "forward"), micro_batch_size="auto")
    with pytest.raises(torch.OutOfMemoryError, match="not even one image"):
        step.choose_micro_batch_size(GroupInputs(*group(5, torch.float32)))


# ---- the machine ----


def cgroup(folder, **files):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)


def rooms(tmp_path, lines):
    (tmp_path / "cgroup").write_text(lines)
    return sorted(memory._cgroup_rooms(tmp_path / "cgroup", tmp_path / "fs"))


def test_cgroup_v2_limits_of_the_group_and_those_above(tmp_path):
    root = tmp_path / "fs"
    cgroup(root, memory__stat="anon 1")
    stat = f"anon 5\ninactive_file {GIB}\nactive_file 7"
    cgroup(root / "job", memory__max=f"{8 * GIB}\n", memory__current=f"{6 * GIB}\n", memory__stat=stat)
    cgroup(root / "job/step", memory__max="max\n", memory__current=f"{5 * GIB}", memory__stat=stat)
    cgroup(root / "job/step/task", memory__max=f"{4 * GIB}", memory__current=f"{2 * GIB}", memory__stat="")
    assert rooms(tmp_path, "0::/job/step/task\n") == [2 * GIB, 3 * GIB]


def test_cgroup_v1_and_the_hosts_path_in_a_container(tmp_path):
    memory = tmp_path / "fs/memory"
    stat = f"cache 5\ntotal_inactive_file {GIB}"
    cgroup(memory, memory__limit_in_bytes=f"{4 * GIB}", memory__usage_in_bytes=f"{3 * GIB}", memory__stat=stat)
    lines = "12:cpu,cpuacct:/docker/abc\n5:memory:/docker/abc\n1:name=systemd:/\n0::/\n"
    assert rooms(tmp_path, lines) == [2 * GIB]


def test_no_cgroups(tmp_path):
    assert list(memory._cgroup_rooms(tmp_path / "nothing", tmp_path)) == []
    assert rooms(tmp_path, "0::/\n") == []


def test_a_cgroup_limits_what_is_available(monkeypatch):
    monkeypatch.setattr(memory, "_cgroup_rooms", lambda: iter([GIB // 4, GIB]))
    assert available_memory() == GIB // 4
    monkeypatch.setattr(memory, "_cgroup_rooms", lambda: iter([-5]))
    assert available_memory() == 0


def test_processes_of_a_machine_share_its_memory(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: GIB)
    model, (pixels, *_) = toy(), group(2, torch.float32)
    assert str(GraphBudget(model)) == "retain auto: nothing measured yet"
    sizes = []
    for processes in (1, 2):
        budget = GraphBudget(model, processes)
        budget.measure(pixels, lambda x: model(pixel_values=x))
        sizes.append(budget.bytes)
        assert f"up to {budget.bytes / 2**20:.0f} MiB" in str(budget)
    assert sizes[0] - sizes[1] == int(GIB * memory.CPU_SHARE / 2)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    assert memory.local_processes(16) == 4


def test_room_is_left_for_gradients_and_adam(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: GIB)
    small, large = nn.Conv2d(3, 1, 1), nn.Sequential(nn.Conv2d(3, 1, 1), nn.Linear(1000, 1000))
    difference = GraphBudget(small)._free() - GraphBudget(large)._free()
    assert difference == 4 * sum(p.nbytes for p in large[1].parameters())
