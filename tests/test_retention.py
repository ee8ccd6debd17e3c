"""How much memory graphs may take: what is measured, what limits count, and what happens when it proves too much."""

import logging

import pytest
import torch
from helpers.group_tools import Toy, gradients, group, largest_error, toy
from torch import nn

from gift_peft import memory
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
        first = len(caplog.records)
        assert first and "out of memory" in caplog.text
        got = gradients(model)
        assert all(torch.equal(got[name], torch.ones_like(want[name]).add_(want[name])) for name in want)
        budget = step.budget.bytes
        for _ in range(3):
            step.accumulate(*data)
    assert step.budget.bytes <= budget and step.budget.images(data[0], data[1].float()) <= room
    assert len(caplog.records) <= first + 1  # it has learned
    assert model.alive == 0


def test_a_single_micro_batch_that_does_not_fit_is_an_error():
    model, data = narrow(1, "forward"), group(4, torch.float32)
    with pytest.raises(torch.OutOfMemoryError):
        GroupStep(model).accumulate(*data)
    assert all(p.grad is None for p in model.parameters())


def test_a_fixed_number_is_taken_at_its_word():
    with pytest.raises(torch.OutOfMemoryError):
        GroupStep(narrow(2, "forward"), retain=6).accumulate(*group(6, torch.float32))


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
