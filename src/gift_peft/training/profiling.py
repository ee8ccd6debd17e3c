"""Where the time of an update goes, against what the device can do (`gift-peft train --profile N`).

Phases are timed from outside of the step; arithmetic is counted by PyTorch on one micro-batch and compared with the
rate of a large matrix multiplication, measured at the same place.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

if TYPE_CHECKING:
    from gift_peft.dataset.tensors import Group
    from gift_peft.group_step import GroupStep, GroupStepOutput
    from gift_peft.training.loop import Run

PHASES = ("load", "snapshot", "loss", "replay", "reduce", "optimizer")


class Phases:
    """Seconds per phase, added up: `with phases("load"): ...`. On CUDA each phase waits for the device."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds = dict.fromkeys(PHASES, 0.0)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        synchronize(self.device)
        started = time.perf_counter()
        yield
        synchronize(self.device)
        self.seconds[name] += time.perf_counter() - started


class Flops(NamedTuple):
    """Floating-point operations per image, a multiplication and an addition counted as two."""

    forward: float
    backward: float


def timed_update(
    step: GroupStep, optimizer: torch.optim.Optimizer, load: Callable[[], Group], phases: Phases
) -> GroupStepOutput:
    """One update, from asking for the group to the changed weights."""
    with phases("load"):
        group = load()
    step.phase = phases
    output = step.accumulate(group.pixel_values, group.mask, group.target, group.valid, group.names)
    with phases("optimizer"):
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    return output


def count_flops(model: nn.Module, pixel_values: torch.Tensor) -> Flops:
    """Of a micro-batch (B,3,h,w): matrix products, convolutions and attention. Leaves gradients as they were."""
    gradients = [(p, p.grad) for p in model.parameters()]
    for p, _ in gradients:
        p.grad = None
    with torch.enable_grad(), FlopCounterMode(display=False) as forward:
        output = model(pixel_values=pixel_values.to(next(model.parameters()).device))
    with FlopCounterMode(display=False) as backward:
        getattr(output, "predicted_depth", output).sum().backward()
    for p, gradient in gradients:
        p.grad = gradient
    return Flops(*(counter.get_total_flops() / len(pixel_values) for counter in (forward, backward)))


def matmul_rate(device: torch.device, dtype: torch.dtype) -> float:
    """Floating-point operations per second of a large matrix product: what the device does in practice."""
    side = 8192 if device.type == "cuda" else 1024
    a, b = (torch.rand(side, side, dtype=dtype, device=device) for _ in range(2))
    seconds = []
    for _ in range(6):  # the first is for warming up
        synchronize(device)
        started = time.perf_counter()
        a @ b
        synchronize(device)
        seconds.append(time.perf_counter() - started)
    return 2 * side**3 / statistics.median(seconds[1:])


def synchronize(device: torch.device) -> None:
    """Wait until the device has done what it was given; CPUs have."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def reset_peak_memory(device: torch.device) -> None:
    """Start the measurement of `peak_memory` anew; on CPU only Linux can."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory(device: torch.device) -> int:
    """Bytes: of tensors on CUDA, of the whole process on CPU (its largest resident set)."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def profile_updates(run: Run, num_updates: int) -> str:
    """Time `num_updates` updates of a run after one to warm up, as a table. Nothing is written; weights change."""
    device = run.accelerator.device
    feed = run.groups_from(0)
    images, forwards = 0, 0
    try:
        timed_update(run.group_step, run.optimizer, lambda: next(feed), Phases(device))
        reset_peak_memory(device)
        phases = Phases(device)
        started = time.perf_counter()
        for _ in range(num_updates):
            sizes: list[int] = []

            def load(sizes=sizes) -> Group:
                group = next(feed)
                sizes.append(len(group.names))
                return group

            forwards += timed_update(run.group_step, run.optimizer, load, phases).forwards
            images += sizes[0]
        seconds = time.perf_counter() - started
    finally:
        feed.close()
    peak = peak_memory(device)
    flops = count_flops(run.model, run.train_groups[0].pixel_values[: run.args.micro_batch_size])
    dtype = torch.bfloat16 if run.accelerator.mixed_precision == "bf16" else torch.float32
    rate = (forwards * flops.forward + images * flops.backward) / seconds / run.accelerator.num_processes
    epoch_images = sum(map(len, run.train_groups.dataset["image_names"]))
    lines = [
        f"{num_updates} updates, {images} images, {forwards} image forwards ({forwards / images:.2f} per image) "
        f"in {seconds:.2f} s on {run.accelerator.num_processes} x {device.type}",
        f"{images / seconds:.2f} images/s; an epoch of {run.epoch_steps} groups, {epoch_images} images: "
        f"{epoch_images * seconds / images:.1f} s (extrapolated)",
        phase_line(phases.seconds, seconds),
        f"{rate / 1e12:.3g} TFLOP/s, {rate / matmul_rate(device, dtype):.0%} of a large {dtype} matrix product",
        f"peak memory {peak / 2**20:.0f} MiB" + ("" if device.type == "cuda" else " (the whole process)"),
    ]
    if run.group_step.budget is not None:
        lines.append(str(run.group_step.budget))
    return "\n".join(lines)


def phase_line(phases: dict[str, float], seconds: float) -> str:
    """Shares of the time, and what is in no phase (checks, copies)."""
    shares: Iterable[tuple[str, float]] = {**phases, "rest": max(0.0, seconds - sum(phases.values()))}.items()
    return ", ".join(f"{name} {value / seconds:.1%}" for name, value in shares)
