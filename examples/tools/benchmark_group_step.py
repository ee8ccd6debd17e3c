"""How fast one epoch of GIFT is: pair traversal, the paper's snapshot-and-replay, the full graph, and this package.

    OMP_NUM_THREADS=2 python examples/tools/benchmark_group_step.py --compile --out docs

measures, side by side on one machine, with one loader, loss and optimizer (paper, supplement B):
  (a) pairs    naive pair traversal: an update per pair of a group
  (b) replay   the paper's schedule: every image forwarded twice, micro-batches of 2 (retain=0)
  (c) full     one graph over the whole group, no micro-batches, where it fits
  (d) default  what `gift-peft train` does: micro-batches and retained graphs by memory
The groups follow GIFT-I: 353 groups of 2 to 55 images, 3,268 images, 20,339 pairs. A stratified sample of them is
timed and an epoch is extrapolated from it; all four are run in turn within each stratum and repeat, so that whatever
else the machine does hits them alike. On CPU the embedded tiny model and Depth Anything V2-Small's configuration (12
blocks) run at 112x140; with a CUDA device also Depth Anything V2-Large, VGGT-1B and Metric3D V2 in bf16 at 476x644.
Weights are random or do not matter, and pictures are noise: only time and memory are looked at.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from benchmark.epoch import GROUP_SIZES, Stratum, Timing, make_strata
from benchmark.inputs import write_base, write_groups
from benchmark.models import CONFIGS, PAPER_MINUTES
from benchmark.report import METHODS, TITLE, machine, replace_section, to_markdown

from gift_peft.adapters.recipes import get_gift_model
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.loader import PreparedGroups
from gift_peft.dataset.tensors import Group
from gift_peft.group_inputs import GroupInputs
from gift_peft.group_step import GroupStep, GroupStepOutput
from gift_peft.models.loading import load_base
from gift_peft.training import profiling
from gift_peft.training.profiling import PHASES, Phases
from gift_peft.training.speed import channels_last_head, checkpoint_blocks, compile_blocks, make_adam
from gift_peft.training.teacher import make_proxies

# ---- what is timed ----


class Bench:
    """One model with its adapter, optimizer, groups and the four ways to make an epoch of updates."""

    def __init__(self, name: str, folder: Path, sizes: list[int]) -> None:
        config = CONFIGS[name]
        self.name = name
        AcceleratorState._reset_state(reset_partial_state=True)  # the model before may have had another device
        self.accelerator = Accelerator(
            cpu=config.device == "cpu", mixed_precision="bf16" if config.device == "cuda" else "no"
        )
        self.device = self.accelerator.device
        self.base = base = folder / "base"
        with self.accelerator.main_process_first():
            if not base.exists():
                torch.manual_seed(0)
                write_base(config, base)
                write_groups(folder / "raw", sizes)
        make_proxies(base, folder / "raw", size=config.size, accelerator=self.accelerator)
        model, processor = load_base(base)
        torch.manual_seed(0)
        self.model = get_gift_model(model).to(self.device).eval()
        self.optimizer = make_adam([p for p in self.model.parameters() if p.requires_grad], 2e-5)
        rows = load_gift_i(folder / "raw", "train", teacher=base, size=config.size)
        self.index = {len(names): i for i, names in enumerate(rows["image_names"])}
        self.groups = PreparedGroups(rows, processor, config.size, cache_dir=folder / "cache")
        self.step = GroupStep(self.model, micro_batch_size="auto", accelerator=self.accelerator)
        self.step.choose_micro_batch_size(inputs_of(self.groups[0]), largest=max(GROUP_SIZES))  # as `train` does
        self.replay = GroupStep(self.model, retain=0, accelerator=self.accelerator)
        self.pair = GroupStep(self.model, retain=2, accelerator=self.accelerator)

    def step_of(self, method: str, num_images: int) -> GroupStep:
        """Of (a) for a pair, else for a group."""
        if method == "c":
            return GroupStep(self.model, micro_batch_size=num_images, retain=num_images, accelerator=self.accelerator)
        return {"a": self.pair, "b": self.replay, "d": self.step}[method]

    def update(self, step: GroupStep, feed: Iterator[Group], phases: Phases) -> GroupStepOutput:
        return profiling.timed_update(step, self.optimizer, lambda: inputs_of(next(feed)), phases)

    def time(self, method: str, size: int, max_pairs: int) -> Timing:
        """The updates of one group by one method; of (a) at most `max_pairs`, spread over the group."""
        phases = Phases(self.device)
        feed = self.groups.take([self.index[size]])
        started = time.perf_counter()
        if method != "a":
            output = self.update(self.step_of(method, size), feed, phases)
            return Timing(time.perf_counter() - started, phases.seconds, output.forwards, 1)
        with phases("load"):
            group = next(feed)
        pairs = list(combinations(range(size), 2))
        pairs = pairs[:: max(1, len(pairs) // max_pairs)][:max_pairs]
        loading = dict(phases.seconds)
        for pair in pairs:
            self.update(self.pair, iter([pick(group, list(pair))]), phases)
        phases.seconds["load"] = loading["load"]  # picking two images is not loading
        return Timing(time.perf_counter() - started, phases.seconds, 2 * len(pairs), len(pairs))


def inputs_of(group: Group) -> GroupInputs:
    """Checked, as the loader's threads do it."""
    return GroupInputs(group.pixel_values, group.mask, group.target, group.valid, group.names)


def pick(group: Group, indices: list[int]) -> Group:
    """Some images of a group."""
    valid = None if group.valid is None else group.valid[indices]
    names = [group.names[i] for i in indices]
    return Group(group.group_id, names, group.pixel_values[indices], group.mask[indices], valid, group.target[indices])


# ---- measurements ----


def measure_epochs(bench: Bench, strata: list[Stratum], repeats: int, max_pairs: int) -> dict[str, list[Timing]]:
    """An epoch by each method, extrapolated from one group per stratum, `repeats` times; (c) only where it fits."""
    epochs: dict[str, list[Timing]] = {method: [] for method in METHODS}
    for repeat in range(-1, repeats):  # the first warms up
        parts: dict[str, list[Timing]] = {method: [] for method in epochs}
        for number, stratum in enumerate(strata if repeat >= 0 else strata[:1]):
            order = list(epochs)
            shift = (repeat + number) % len(order)
            for method in order[shift:] + order[:shift]:
                try:
                    timing = bench.time(method, stratum.sample, max_pairs)
                except torch.OutOfMemoryError:
                    if method != "c":
                        raise
                    del epochs["c"]
                    torch.cuda.empty_cache()
                    print(f"  (c) does not fit: out of memory with {stratum.sample} images", flush=True)
                    continue
                parts[method].append(timing.in_epoch(stratum, method))
        if repeat >= 0:
            for method in epochs:
                epochs[method].append(sum(parts[method][1:], parts[method][0]))
            seconds = "  ".join(f"({m}) {timings[-1].seconds:.1f} s" for m, timings in epochs.items())
            print(f"  repeat {repeat + 1}: an epoch takes {seconds}", flush=True)
    return epochs


def check_gradients(bench: Bench, size: int) -> dict[str, float]:
    """With a perturbed adapter: (d) against (c), relative L2 norm, and against (b) with the micro-batches of (b)."""
    group = bench.groups[bench.index[size]]
    weights = [p for p in bench.model.parameters() if p.requires_grad]
    before = [p.detach().clone() for p in weights]
    generator = torch.Generator().manual_seed(0)
    gradients = {}
    with torch.no_grad():
        for p in weights:
            p += 0.02 * torch.randn(p.shape, generator=generator).to(p)
    same_cut = GroupStep(bench.model, micro_batch_size=2, accelerator=bench.accelerator)
    for method, step in {**{m: bench.step_of(m, size) for m in "bcd"}, "d as b": same_cut}.items():
        bench.model.zero_grad(set_to_none=True)
        step.accumulate(group.pixel_values, group.mask, group.target)
        gradients[method] = torch.cat([p.grad.flatten() for p in weights if p.grad is not None])
    bench.model.zero_grad(set_to_none=True)
    with torch.no_grad():
        for p, value in zip(weights, before, strict=True):
            p.copy_(value)
    b, c, d, same = (gradients[method] for method in ("b", "c", "d", "d as b"))
    return {
        "d_minus_b_max": (same - b).abs().max().item(),
        "d_to_c_relative_l2": ((d - c).norm() / c.norm()).item(),
    }


def measure_loader(bench: Bench, seconds: float) -> float:
    """Images per second that the prefetching loader delivers from its cache."""
    order = list(bench.index.values())
    sum(len(group.names) for group in bench.groups.take(order))  # fills the cache and the page cache
    images, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        images += sum(len(group.names) for group in bench.groups.take(order))
    return images / (time.perf_counter() - started)


def measure_options(bench: Bench, size: int, repeats: int, compiled: bool) -> dict[str, float]:
    """Median seconds for the gradient of one group, by default and under what is off by default."""
    variants = {
        "PyTorch's layout": (None, "auto", False),
        "replay (retain=0)": (None, 0, False),
        "all retained, blocks checkpointed": (checkpoint_blocks, size, False),
        "channels-last head": (None, "auto", True),
    }
    if compiled:
        variants["compiled blocks"] = (compile_blocks, "auto", False)
    group = bench.groups[bench.index[size]]
    medians = {}
    # One model at a time beside the bench's: they are large.
    for name, (change, retain, channels_last) in variants.items():
        model = get_gift_model(load_base(bench.base)[0]).to(bench.device).eval()
        if change:
            change(model)
        step = GroupStep(model, retain=retain, accelerator=bench.accelerator)
        seconds = []
        for _ in range(repeats + 1):
            started = time.perf_counter()
            with channels_last_head(model, channels_last):
                step.accumulate(group.pixel_values, group.mask, group.target)  # waits for the device at its end
            seconds.append(time.perf_counter() - started)
            model.zero_grad(set_to_none=True)
        medians[name] = statistics.median(seconds[1:])
        del model, step
    return medians


def measure_memory(bench: Bench) -> dict:
    """Peak memory in bytes of one update, above what lay there before its group was loaded, per method and size."""
    steps = {
        "b": bench.replay,
        "d, at most 4 images retained": GroupStep(bench.model, retain=4, accelerator=bench.accelerator),
        "d": bench.step,
    }
    peaks: dict = {name: {} for name in [*steps, "c"]}
    sizes = CONFIGS[bench.name].memory_sizes
    for size in (2, *sizes):  # with 2 gradients and the optimizer's state come to be
        for name in peaks:
            step = steps.get(name) or bench.step_of("c", size)
            before = current_memory(bench.device)
            profiling.reset_peak_memory(bench.device)
            feed = bench.groups.take([bench.index[size]])
            try:
                bench.update(step, feed, Phases(bench.device))
            except torch.OutOfMemoryError:
                continue
            peaks[name][size] = profiling.peak_memory(bench.device) - before
    height, width = CONFIGS[bench.name].size
    # Inputs (3 float32), mask (1 byte), target, snapshot and one gradient buffer (float32 each) of the added images.
    tensors = (sizes[-1] - sizes[0]) * height * width * (3 * 4 + 1 + 3 * 4)
    for values in peaks.values():
        values.pop(2, None)
    return {"peaks": peaks, "tensors_of_added_images": tensors}


def current_memory(device: torch.device) -> int:
    if device.type == "cuda":
        return torch.cuda.memory_allocated(device)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def measure_scaling(bench: Bench, size: int, repeats: int) -> float:
    """Median seconds per update of one group, shared by the processes of this job."""
    feed = bench.groups.take([bench.index[size]] * (repeats + 1))
    seconds = []
    for _ in range(repeats + 1):
        bench.accelerator.wait_for_everyone()
        started = time.perf_counter()
        bench.update(bench.step, feed, Phases(bench.device))
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds[1:])


def run_worker(what: str, name: str, folder: Path, processes: int = 1, **environment: str):
    """A measurement in processes of its own; they print one line of JSON."""
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={processes}"]
    command = [sys.executable, *(launcher if processes > 1 else [])]
    command += [__file__, "--worker", what, "--models", name, "--folder", str(folder)]
    result = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment)
    lines = [line for line in result.stdout.splitlines() if line.startswith('{"worker"')]
    if result.returncode or not lines:
        raise RuntimeError(f"{what}: {result.stderr[-2000:]}")
    return json.loads(lines[0])["worker"]


# ---- one model, and the report ----


def benchmark(name: str, args: argparse.Namespace, folder: Path) -> dict:
    config = CONFIGS[name]
    strata = make_strata(config.strata)
    sizes = sorted({stratum.sample for stratum in strata} | {2, args.option_size, *config.memory_sizes})
    print(f"{name}: preparing {sum(sizes)} pictures", flush=True)
    bench = Bench(name, folder, sizes)
    result: dict = {
        "size": list(config.size),
        "device": torch.cuda.get_device_name() if config.device == "cuda" else "cpu",
        "mixed_precision": bench.accelerator.mixed_precision,
        "parameters": sum(p.numel() for p in bench.model.parameters()),
        "trainable": sum(p.numel() for p in bench.model.parameters() if p.requires_grad),
        "sampled_group_sizes": [stratum.sample for stratum in strata],
        "repeats": args.repeats,
    }
    result["gradients"] = check_gradients(bench, strata[0].sample)
    epochs = measure_epochs(bench, strata, args.repeats, args.pairs)
    flops = profiling.count_flops(bench.model, bench.groups[0].pixel_values[:2])
    dtype = torch.bfloat16 if config.device == "cuda" else torch.float32
    rate = profiling.matmul_rate(bench.device, dtype)
    result["flops_per_image"] = flops._asdict()
    result["matmul_flops_per_second"] = rate
    images = sum(stratum.images for stratum in strata)
    result["methods"] = {
        method: summarize(timings, epochs, 2 * sum(s.pairs for s in strata) if method == "a" else images, flops, rate)
        for method, timings in epochs.items()
    }
    result["loader_images_per_second"] = measure_loader(bench, seconds=2)
    result["loader_to_step"] = result["loader_images_per_second"] / (images / median(epochs["d"]))
    result["micro_batch_size"] = bench.step.micro_batch_size
    compiled = args.compile and name != "tiny"  # whose blocks are too small to gain anything
    result["options_seconds"] = measure_options(bench, args.option_size, min(3, args.repeats), compiled)
    if config.device == "cuda":
        result["memory"] = measure_memory(bench)
    else:
        # Large tensors come from and go back to the system at once, so that the resident set shows what lives.
        result["memory"] = run_worker("memory", name, folder, MALLOC_MMAP_THRESHOLD_="65536")
    if name == "tiny":
        scaling = {}
        for processes in (1, 2, 1, 2):  # the better of two, because other work on the machine only ever slows down
            seconds = run_worker("scaling", name, folder, processes, OMP_NUM_THREADS="1", ACCELERATE_USE_CPU="true")
            scaling[processes] = min(seconds, scaling.get(processes, seconds))
        result["scaling"] = {"seconds_per_update": scaling, "speedup": scaling[1] / scaling[2]}
    if name in PAPER_MINUTES:
        result["paper_minutes_per_epoch"] = PAPER_MINUTES[name]
    return result


def median(timings: list[Timing]) -> float:
    return statistics.median(timing.seconds for timing in timings)


def summarize(timings: list[Timing], epochs: dict, backwards: int, flops, rate: float) -> dict:
    """What the table says of one method; ratios are medians over the repeats, each of times taken side by side."""
    seconds = [timing.seconds for timing in timings]
    middle = statistics.median(seconds)
    done = timings[0].forwards * flops.forward + backwards * flops.backward
    total = sum(seconds)
    phases = {name: sum(timing.phases[name] for timing in timings) / total for name in PHASES}
    ratios = {}
    for other in [other for other in "abc" if other in epochs]:
        values = sorted(theirs.seconds / ours.seconds for theirs, ours in zip(epochs[other], timings, strict=True))
        ratios[f"faster_than_{other}"] = [statistics.median(values), values[0], values[-1]]
    return {
        "updates": timings[0].updates,
        "image_forwards": timings[0].forwards,
        "seconds_per_epoch": [middle, min(seconds), max(seconds)],
        "images_per_second": 3268 / middle,
        **ratios,
        "phases": {**phases, "rest": max(0.0, 1 - sum(phases.values()))},
        "tflops_per_second": done / middle / 1e12,
        "share_of_matmul": done / middle / rate,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", choices=list(CONFIGS), default=list(CONFIGS))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--pairs", type=int, default=6, help="pairs of each sampled group that (a) is timed on")
    parser.add_argument("--option_size", type=int, default=9, help="group size for comparing options")
    parser.add_argument("--compile", action="store_true", help="also compiled blocks, which takes a C++ compiler")
    parser.add_argument("--out", type=Path, help="folder for benchmark.json and benchmark.md; default: print only")
    parser.add_argument("--worker", choices=["memory", "scaling"], help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        bench = Bench(args.models[0], args.folder, [])
        value = measure_memory(bench) if args.worker == "memory" else measure_scaling(bench, args.option_size, 3)
        bench.accelerator.print(json.dumps({"worker": value}), flush=True)
        return
    cuda = torch.cuda.is_available()
    results: dict = {"machine": machine(), "cuda": cuda, "models": {}}
    for name in args.models:
        if CONFIGS[name].device == "cuda" and not cuda:
            print(f"{name}: skipped, there is no CUDA device")
            continue
        with tempfile.TemporaryDirectory() as folder:
            results["models"][name] = benchmark(name, args, Path(folder))
    text = to_markdown(results)
    print(text)
    if args.out:
        (args.out / "benchmark.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        replace_section(args.out / "benchmark.md", TITLE, text)


if __name__ == "__main__":
    main()
