"""The table of `benchmark_group_step.py`: what was measured, on what machine, and what was not."""

import os
import platform
import re
import shlex
import sys
from importlib.metadata import version
from pathlib import Path

import torch

from gift_peft.training.profiling import PHASES

TITLE = "Speed of the group step"
METHODS = {
    "a": "naive pair traversal",
    "b": "snapshot and replay (paper)",
    "c": "full graph",
    "d": "gift-peft default",
}


def machine() -> dict:
    cpu = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            cpu = line.split(":", 1)[1].strip()
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load_at_start": os.getloadavg()[0],
        "command": shlex.join(["python", f"examples/tools/{Path(sys.argv[0]).name}", *sys.argv[1:]]),
        "python": platform.python_version(),
        **{name: version(name) for name in ("gift-peft", "torch", "transformers", "peft", "accelerate")},
    }


def replace_section(page: Path, title: str, text: str) -> None:
    """Put `text` under the heading `# title` of a page, in place of what stood there; other sections stay."""
    old = page.read_text(encoding="utf-8") if page.exists() else ""
    sections = [part for part in re.split(r"(?m)^(?=# )", old) if part.strip()]
    new = f"# {title}\n\n{text.rstrip()}\n\n"
    at = [index for index, part in enumerate(sections) if part.startswith(f"# {title}\n")]
    if at:
        sections[at[0]] = new
    else:
        sections.append(new)
    page.write_text("\n\n".join(part.strip() for part in sections) + "\n", encoding="utf-8")


def measured_with(facts: dict) -> str:
    """How a table came to be, in a sentence of what `machine` tells."""
    return (
        f"`OMP_NUM_THREADS={facts['threads']} {facts['command']}` on "
        f"{facts['cores']} cores ({facts['cpu']}), {facts['threads']} threads, load {facts['load_at_start']:.1f} "
        f"when it started. Python {facts['python']}, "
        + ", ".join(f"{n} {facts[n]}" for n in ("torch", "transformers", "peft", "accelerate"))
        + f", gift-peft {facts['gift-peft']}."
    )


def to_markdown(results: dict) -> str:
    lines = [
        measured_with(results["machine"]),
        "",
        "An epoch is GIFT-I's: 353 groups of 2 to 55 images, 3,268 images, 20,339 pairs (the list of sizes is in the",
        "script). **It is extrapolated**: one group per stratum of sizes is timed, and of (a) some of its pairs; the",
        "others are taken to need as long per image, or per pair. Times are medians with the smallest and largest of",
        "the repeats; ratios are taken within a repeat, in which all methods run in turn.",
    ]
    if not results["cuda"]:
        lines += ["", "No CUDA device: Depth Anything V2-Large, VGGT-1B and Metric3D V2 at 476x644 were not run."]
    for name, result in results["models"].items():
        lines += ["", *model_table(name, result)]
    return "\n".join(lines) + "\n"


def model_table(name: str, result: dict) -> list[str]:
    height, width = result["size"]
    spread = lambda values, form: f"{values[0]:{form}} ({values[1]:{form}}-{values[2]:{form}})"  # noqa: E731
    lines = [
        f"## {name}: {result['parameters'] / 1e6:.1f} M weights ({result['trainable'] / 1e6:.2f} M trained), "
        f"{height}x{width}, {result['device']}, autocast {result['mixed_precision']}",
        "",
        f"Groups of {', '.join(map(str, result['sampled_group_sizes']))} images, {result['repeats']} repeats.",
        "",
        "| | updates | image forwards | s per epoch | faster than (a) | than (b) | than (c) | images/s | TFLOP/s "
        "| of matmul |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for method, row in result["methods"].items():
        lines.append(
            f"| ({method}) {METHODS[method]} | {row['updates']:,} | {row['image_forwards']:,} | "
            f"{spread(row['seconds_per_epoch'], '.1f')} | {spread(row['faster_than_a'], '.2f')} | "
            f"{spread(row['faster_than_b'], '.2f')} | "
            f"{spread(row['faster_than_c'], '.2f') if 'faster_than_c' in row else 'does not fit'} | "
            f"{row['images_per_second']:.1f} | "
            f"{row['tflops_per_second']:.3g} | {row['share_of_matmul']:.0%} |"
        )
    lines += ["", "| share of time | " + " | ".join([*PHASES, "rest"]) + " |", "|---|" + "---:|" * (len(PHASES) + 1)]
    for method, row in result["methods"].items():
        lines.append(f"| ({method}) | " + " | ".join(f"{row['phases'][p]:.1%}" for p in [*PHASES, "rest"]) + " |")
    if "paper_minutes_per_epoch" in result:
        minutes = result["methods"]["d"]["seconds_per_epoch"][0] / 60
        lines += [
            "",
            f"(d) {minutes:.2f} minutes an epoch; the paper has {result['paper_minutes_per_epoch']} (RTX 4090).",
        ]
    retained = 2 - result["methods"]["d"]["image_forwards"] / 3268
    lines += [
        "",
        f"* (d) took micro-batches of {result['micro_batch_size']} images and retained {retained:.0%} of the images. "
        f"With the micro-batches of (b) its gradient is that of (b) up to {result['gradients']['d_minus_b_max']:g} "
        f"(largest difference), as it is that of (c) up to {result['gradients']['d_to_c_relative_l2']:.1e} (relative "
        "L2 norm).",
        f"* The loader delivers {result['loader_images_per_second']:.0f} images/s from its cache, "
        f"{result['loader_to_step']:.1f} times what (d) consumes.",
    ]
    options = result["options_seconds"]
    compared = ", ".join(f"{n} {s:.2f} s" for n, s in options.items())
    lines.append(f"* One group's gradient (median): {compared}.")
    if "scaling" in result:
        seconds = result["scaling"]["seconds_per_update"]
        lines.append(
            f"* Two processes of one thread: {seconds[2]:.2f} s for an update that takes one such process "
            f"{seconds[1]:.2f} s, {result['scaling']['speedup']:.2f} times faster."
        )
    if "memory" in result:
        lines += ["", *memory_table(result["memory"])]
    return lines


def memory_table(memory: dict) -> list[str]:
    """Peaks above what lay in memory before the update, and how they grow with the group."""
    table = {m: {int(n): value / 2**20 for n, value in peaks.items()} for m, peaks in memory["peaks"].items()}
    sizes = sorted({size for peaks in table.values() for size in peaks})
    growing = len(sizes) > 1
    lines = [
        "| peak memory of an update (MiB) | " + " | ".join(f"{n} images" for n in sizes) + " |" + " growth |" * growing
    ]
    lines.append("|---|" + "---:|" * (len(sizes) + growing))
    for method, peaks in table.items():
        cells = [f"{peaks[n]:.1f}" if n in peaks else "does not fit" for n in sizes]
        if growing:
            fits = {sizes[0], sizes[-1]} <= peaks.keys()
            cells.append(f"{peaks[sizes[-1]] - peaks[sizes[0]]:.1f}" if fits else "")
        lines.append(f"| ({method}) | " + " | ".join(cells) + " |")
    if growing:
        added = memory["tensors_of_added_images"]
        lines.append(f"| the group's own tensors ({added:,} bytes) |" + " |" * len(sizes) + f" {added / 2**20:.1f} |")
    return lines
