"""How fast an epoch is with surface targets, beside the paper's schedule and the package's own default for groups.

    OMP_NUM_THREADS=2 python examples/tools/benchmark_surface.py --out docs

The same images of the embedded dataset in one run, in turn within each repeat: (b) the paper's schedule, `--retain 0`
with micro-batches of 2, the head in PyTorch's own layout; (c) the same, the head channels-last; (d) what `gift-peft
train` does; (e) `--target surface`, batches of 4 images of any groups. (d) and (e) have their defaults: the head
channels-last and as many images per forward as memory allows.
Then what the targets cost once, with and without fills, in epochs of (e), and the memory of one update.
"""

import argparse
import ctypes
import gc
import os
import statistics
import tempfile
import time
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from benchmark.report import machine, measured_with, replace_section
from tqdm import tqdm

from gift_peft import GroupStep, get_gift_model, load_gift_i
from gift_peft.dataset.proxies import SurfaceSettings
from gift_peft.dataset.rows import parsed
from gift_peft.dataset.writer import write_gift_i
from gift_peft.group_inputs import GroupInputs
from gift_peft.models.loading import DepthModel, load_base
from gift_peft.training import profiling
from gift_peft.training.speed import channels_last_head, make_adam
from gift_peft.training.surface_step import PredictedDepth, SurfaceStep
from gift_peft.training.teacher import make_proxies

SIZE, BATCH = (112, 140), 4
TITLE = "Surface targets beside groups"
NAMES = {
    "b": "paper's schedule",
    "c": "paper's schedule, channels-last",
    "d": "gift-peft default, consensus",
    "e": "surface targets",
}


class Epochs:
    """The ways to go once through the same images."""

    def __init__(self, base: Path, groups: list) -> None:
        network, processor = load_base(base)
        torch.manual_seed(0)
        self.network = get_gift_model(network).eval()
        self.optimizer = make_adam([p for p in self.network.parameters() if p.requires_grad], 2e-5)
        model = DepthModel(self.network, processor, SIZE)
        self.groups = []
        for group in groups:
            pixels = model.inputs(group.images)
            self.groups.append((pixels, torch.from_numpy(np.stack(group.masks)), model.predict_base(pixels)))
        self.images = [torch.cat(parts) for parts in zip(*self.groups, strict=True)]
        self.steps = {
            "b": GroupStep(self.network, retain=0),
            "c": GroupStep(self.network, retain=0),
            "d": GroupStep(self.network, micro_batch_size="auto"),
            "e": SurfaceStep(PredictedDepth(self.network)),
        }
        largest = max(len(pixels) for pixels, *_ in self.groups)
        self.steps["d"].choose_micro_batch_size(GroupInputs(*self.groups[0]), largest)
        self.steps["e"].choose_micro_batch_size(self.images[0][:1], BATCH)

    def __call__(self, method: str) -> float:
        """Seconds of one epoch."""
        started = time.perf_counter()
        for update in self.groups if method != "e" else zip(*(part.split(BATCH) for part in self.images), strict=True):
            self.optimizer.zero_grad(set_to_none=True)
            with channels_last_head(self.network, method != "b"):
                self.steps[method].accumulate(*update)
            self.optimizer.step()
        return time.perf_counter() - started

    def memory(self, count: int) -> dict[str, int]:
        """Peak bytes of one update of a group of `count` images, above what lay there before."""
        several = [part[:1].expand(count, *part.shape[1:]).contiguous() for part in self.images]
        peaks = {}
        for method, step in self.steps.items():
            update = several if method != "e" else [part[:BATCH] for part in several]
            self.optimizer.zero_grad(set_to_none=True)
            give_back()
            before = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            profiling.reset_peak_memory(torch.device("cpu"))
            with channels_last_head(self.network, method != "b"):
                step.accumulate(*update)
            peaks[method] = profiling.peak_memory(torch.device("cpu")) - before
        return peaks


def give_back() -> None:
    """To the system, what earlier updates left with the C library: it would hide what the next one takes."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc has it
    if trim:
        trim(0)


def seconds_of_targets(base: Path, groups: list, fills: int | None) -> float:
    """What the proxies of these groups take, with surface targets unless `fills` is None."""
    with tempfile.TemporaryDirectory() as folder:
        records = [
            {"split": "train", "group_id": g.group_id, "surface": g.surface, "images": g.images}
            | {"masks": [mask.astype(np.uint8) * 255 for mask in g.masks]}
            for g in groups
        ]
        write_gift_i(records, folder, license="apache-2.0")
        started = time.perf_counter()
        make_proxies(base, folder, size=SIZE, surface=None if fills is None else SurfaceSettings(fills=fills))
        return time.perf_counter() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--groups", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="folder of benchmark.md, which gets the tables; default: print only")
    args = parser.parse_args()
    lines = [f"{measured_with(machine())}", ""]
    demo = Path(str(files("gift_peft.demo")))
    rows = parsed(load_gift_i(demo / "gift-i", "train"))
    groups = [rows[index] for index in range(0, len(rows), max(1, len(rows) // args.groups))][: args.groups]
    epochs = Epochs(demo / "base", groups)
    lines += [
        f"The embedded base on {len(groups)} of the embedded groups, {len(epochs.images[0])} images at 112x140, "
        f"{args.repeats} repeats: medians with the smallest and largest, ratios within a repeat.",
        "",
        "| | s per epoch | faster than (b) |",
        "|---|---:|---:|",
    ]
    seconds = measure_epochs(epochs, args.repeats)
    for method, taken in seconds.items():
        ratios = sorted(b / own for b, own in zip(seconds["b"], taken, strict=True))
        lines.append(
            f"| ({method}) {NAMES[method]} | {statistics.median(taken):.2f} ({min(taken):.2f}-{max(taken):.2f}) "
            f"| {statistics.median(ratios):.2f} ({ratios[0]:.2f}-{ratios[-1]:.2f}) |"
        )
    epoch = statistics.median(seconds["e"])
    lines += ["", "| once, before the training | s | epochs of (e) |", "|---|---:|---:|"]
    for name, fills in {"proxies alone": None, "surface targets, no fills": 0, "surface targets, 6 fills": 6}.items():
        once = seconds_of_targets(demo / "base", groups, fills)
        lines.append(f"| {name} | {once:.1f} | {once / epoch:.1f} |")
    lines += ["", "| peak memory of an update (MiB) | 4 images | 9 images | 55 images |", "|---|---:|---:|---:|"]
    epochs.memory(4)  # allocations that stay
    peaks = {count: epochs.memory(count) for count in (4, 9, 55)}
    for method, name in NAMES.items():
        cells = " | ".join(f"{peaks[count][method] / 2**20:.0f}" for count in peaks)
        lines.append(f"| ({method}) {name} | {cells} |")
    text = "\n".join(lines)
    print(text)
    if args.out:
        replace_section(args.out / "benchmark.md", TITLE, text)


def measure_epochs(epochs: Epochs, repeats: int) -> dict[str, list[float]]:
    """Seconds per epoch, in turn."""
    seconds: dict[str, list[float]] = {method: [] for method in epochs.steps}
    for repeat in tqdm(range(repeats + 1), "epochs", unit="repeat"):
        order = list(seconds)
        for method in order[repeat % len(order) :] + order[: repeat % len(order)]:
            taken = epochs(method)
            if repeat:  # the first warms up
                seconds[method].append(taken)
    return seconds


if __name__ == "__main__":
    main()
