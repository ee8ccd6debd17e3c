"""Exported models: how fast torch, onnxruntime, OpenVINO and 8 bits are, and what an export takes.

    OMP_NUM_THREADS=2 python examples/tools/benchmark_deploy.py --out docs

Depth Anything V2-Small, random weights, an adapter whose weights have moved, 518x518: the four run in turn in every
repeat, so that whatever else the machine does hits them alike. Then V2-Small, -Base and -Large are exported, each in a
process of its own: seconds, peak memory, size. Only time, memory and the difference to torch are looked at. Writes the
section "Speed of exported models" of benchmark.md.
"""

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from benchmark.models import depth_anything
from benchmark.report import machine, replace_section
from transformers import AutoModelForDepthEstimation, DPTImageProcessorPil

from gift_peft import DepthModel, get_gift_model, save_adapter
from gift_peft.deploy.bundle import prepare_bundle, write_bundle
from gift_peft.deploy.onnx_export import quantize, write_onnx
from gift_peft.deploy.runtime import Predictor

TITLE = "Speed of exported models"
SIZE = (518, 518)
# Arguments of `depth_anything`: the released configurations.
SIZES = {
    "small": (384, 12, 6, [3, 6, 9, 12], [48, 96, 192, 384], 64),
    "base": (768, 12, 12, [3, 6, 9, 12], [96, 192, 384, 768], 128),
    "large": (1024, 24, 16, [5, 12, 18, 24], [256, 512, 1024, 1024], 256),
}


def write_adapter(folder: Path, size: str) -> Path:
    """`base/` and `adapter/`, whose trainable weights have all moved; returns the adapter."""
    torch.manual_seed(0)
    base = depth_anything(*SIZES[size]).eval()
    processor = DPTImageProcessorPil(
        size={"height": 518, "width": 518},
        ensure_multiple_of=14,
        keep_aspect_ratio=False,
        resample=3,
        image_mean=[0.485, 0.456, 0.406],
        image_std=[0.229, 0.224, 0.225],
    )
    base.save_pretrained(folder / "base")
    processor.save_pretrained(folder / "base")
    model = get_gift_model(base)
    with torch.no_grad():
        for weight in filter(lambda weight: weight.requires_grad, model.parameters()):
            weight += 0.01 * weight.abs().mean().clamp(min=1e-3) * torch.randn_like(weight)
    save_adapter(model, folder / "adapter", str(folder / "base"), processor=processor, size=SIZE)
    return folder / "adapter"


def export(adapter: Path, out: Path) -> tuple[float, float]:
    """Write model.onnx and what belongs to it; (seconds, largest difference to torch over the mean)."""
    start = time.perf_counter()
    bundle = prepare_bundle(adapter, out, None, "onnx")
    out.mkdir()
    write_onnx(bundle, out / "model.onnx")
    write_bundle(bundle, out, "onnx")
    seconds = time.perf_counter() - start
    outputs = bundle.outputs(out, "onnx")
    pairs = [(bundle.reference[f"output_{index}"], output) for index, output in enumerate(outputs)]
    return seconds, max(float(np.abs(ours - right).max() / right.mean()) for right, ours in pairs)


def speed(folder: Path, repeats: int) -> list[str]:
    """Lines of the table of images a second."""
    adapter = write_adapter(folder, "small")
    export(adapter, folder / "onnx")
    shutil.copytree(folder / "onnx", folder / "int8")
    bundle = prepare_bundle(adapter, folder / "none", None, "int8")
    quantize(bundle, folder / "int8")
    torch_model = DepthModel(bundle.network.network, DepthModel.from_pretrained(folder / "base").processor, SIZE)
    onnx, openvino, int8 = (
        Predictor(folder / name, backend)
        for name, backend in (("onnx", "onnx"), ("onnx", "openvino"), ("int8", "onnx"))
    )
    x = torch.from_numpy(bundle.reference["input_0"])
    ways = {
        "torch": lambda: torch_model.predict(x).numpy(),
        "onnxruntime": lambda: onnx.predict(x.numpy()),
        "OpenVINO (float32)": lambda: openvino.predict(x.numpy()),
        "onnxruntime, int8": lambda: int8.predict(x.numpy()),
    }
    right = ways["torch"]()
    errors = {name: np.abs(way() - right) / right.mean() for name, way in ways.items()}  # warms them up as well
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, way in ways.items():
            start = time.perf_counter()
            way()
            times[name].append(time.perf_counter() - start)
    lines = ["| | images/s | faster than torch | largest difference | mean difference |", "|---|---:|---:|---:|---:|"]
    for name, seconds in times.items():
        gains = [plain / own for plain, own in zip(times["torch"], seconds, strict=True)]
        rate = [1 / value for value in seconds]
        lines.append(
            f"| {name} | {statistics.median(rate):.2f} ({min(rate):.2f}-{max(rate):.2f}) | "
            f"{statistics.median(gains):.2f} ({min(gains):.2f}-{max(gains):.2f}) | {errors[name].max():.1e} | "
            f"{errors[name].mean():.1e} |"
        )
    return lines


def export_row(size: str) -> str:
    """Run in a process of its own: a line of the table of exports."""
    with tempfile.TemporaryDirectory() as scratch:
        adapter = write_adapter(Path(scratch), size)
        weights = sum(
            weight.numel()
            for weight in AutoModelForDepthEstimation.from_pretrained(Path(scratch) / "base").parameters()
        )
        seconds, worst = export(adapter, Path(scratch) / "out")
        disk = sum(path.stat().st_size for path in (Path(scratch) / "out").glob("model.onnx*")) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return (
        f"| V2-{size.capitalize()} | {weights / 1e6:.1f} M | {seconds:.0f} | {peak:.1f} | {disk:.0f} | {worst:.1e} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder of benchmark.md; default: print only")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--exports", nargs="*", choices=[*SIZES], default=[*SIZES], help="sizes to export")
    parser.add_argument("--export-row", choices=[*SIZES], help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.export_row:
        print(export_row(args.export_row))
        return
    facts = machine()
    lines = [
        f"`OMP_NUM_THREADS={facts['threads']} python examples/tools/benchmark_deploy.py` on {facts['cores']} cores "
        f"({facts['cpu']}), {facts['threads']} threads, load {facts['load_at_start']:.1f} when it started. "
        f"torch {facts['torch']}, transformers {facts['transformers']}, gift-peft {facts['gift-peft']}.",
        "",
        f"Depth Anything V2-Small with random weights at 518x518, one picture at a time, {args.repeats} repeats in "
        "which all run in turn; median (smallest-largest). Differences are to torch, over the output's mean.",
        "",
    ]
    with tempfile.TemporaryDirectory() as scratch:
        lines += speed(Path(scratch), args.repeats)
    if args.exports:
        lines += ["", "| export to ONNX | weights | seconds | peak GiB | MiB on disk | largest difference |"]
        lines += ["|---|---:|---:|---:|---:|---:|"]
    for size in args.exports:
        command = [sys.executable, __file__, "--export-row", size]
        lines.append(
            subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ).stdout.strip()
        )
    text = "\n".join(lines) + "\n"
    print(text)
    if args.out:
        replace_section(args.out / "benchmark.md", TITLE, text)


if __name__ == "__main__":
    main()
