"""Where the time of an update goes, against what the device can do (`gift-peft train --profile N`).

Phases are timed from outside of the step; arithmetic is counted by PyTorch on one micro-batch and compared with the
rate of a large matrix multiplication, measured at the same place.
"""

import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import psutil
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from gift_peft.dataset.loader import PreparedGroups
from gift_peft.group_inputs import GroupInputs
from gift_peft.group_step import GroupStep, GroupStepOutput

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
    step: GroupStep, optimizer: torch.optim.Optimizer, load: Callable[[], GroupInputs], phases: Phases
) -> GroupStepOutput:
    """One update, from asking for the group to the changed weights."""
    with phases("load"):
        group = load()
    step.phase = phases
    output = step.accumulate(*group.arguments())
    with phases("optimizer"):
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    return output


def count_flops(model: nn.Module, pixel_values: torch.Tensor) -> Flops:
    """Of a micro-batch (B,3,h,w): matrix products, convolutions and attention.

    Counted on tensors without content: nothing is computed, no memory is taken, and `.grad` stays as it was.
    """
    stored = {**dict(model.named_parameters()), **dict(model.named_buffers())}
    meta = {name: torch.empty_like(tensor, device="meta") for name, tensor in stored.items()}
    for name, tensor in meta.items():
        tensor.requires_grad_(stored[name].requires_grad)
    pixels = torch.empty_like(pixel_values, device="meta")
    with torch.enable_grad(), FlopCounterMode(display=False) as forward:
        output = torch.func.functional_call(model, meta, kwargs={"pixel_values": pixels})
    with FlopCounterMode(display=False) as backward:
        getattr(output, "predicted_depth", output).sum().backward()
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
    """Bytes: of tensors on CUDA, else of the whole process (its largest resident set; of now, where none is kept)."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    with suppress(OSError, StopIteration):  # the one that `reset_peak_memory` starts anew
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024
    try:
        import resource  # not on Windows
    except ImportError:
        memory = psutil.Process().memory_info()
        return getattr(memory, "peak_wset", memory.rss)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def profile_updates(
    num_updates: int,
    step: GroupStep,
    optimizer: torch.optim.Optimizer,
    groups: PreparedGroups,
    feed: Iterator[GroupInputs],
) -> str:
    """Time `num_updates` updates on what `feed` gives, after one to warm up, as a table; `groups` are an epoch's.

    Nothing is written; weights change. `step` is one with an accelerator.
    """
    device, processes = step.accelerator.device, step.accelerator.num_processes
    timed_update(step, optimizer, lambda: next(feed), Phases(device))
    reset_peak_memory(device)
    phases = Phases(device)
    sizes = []

    def load() -> GroupInputs:
        group = next(feed)
        sizes.append(len(group))
        return group

    started = time.perf_counter()
    forwards = sum(timed_update(step, optimizer, load, phases).forwards for _ in range(num_updates))
    seconds = time.perf_counter() - started
    images = sum(sizes)
    peak = peak_memory(device)
    flops = count_flops(step.model, groups[0].pixel_values[:1])
    dtype = torch.bfloat16 if step.mixed_precision == "bf16" else torch.float32
    rate = (forwards * flops.forward + images * flops.backward) / seconds / processes
    epoch_images = sum(map(len, groups.dataset["image_names"]))
    shares = {**phases.seconds, "rest": max(0.0, seconds - sum(phases.seconds.values()))}  # checks, copies
    lines = [
        f"{num_updates} updates, {images} images, {forwards} image forwards ({forwards / images:.2f} per image) "
        f"in {seconds:.2f} s on {processes} x {device.type}",
        f"{images / seconds:.2f} images/s; an epoch of {len(groups)} groups, {epoch_images} images: "
        f"{epoch_images * seconds / images:.1f} s (extrapolated)",
        ", ".join(f"{name} {value / seconds:.1%}" for name, value in shares.items()),
        f"{rate / 1e12:.3g} TFLOP/s, {rate / matmul_rate(device, dtype):.0%} of a large {dtype} matrix product",
        f"peak memory {peak / 2**20:.0f} MiB" + ("" if device.type == "cuda" else " (the whole process)"),
    ]
    if step.budget is not None:
        lines.append(str(step.budget))
    return "\n".join(lines)
