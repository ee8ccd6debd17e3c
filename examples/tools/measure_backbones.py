"""Seconds and peak memory of a full-size backbone with random weights: one forward and one group step of a few images.

    python examples/tools/measure_backbones.py vggt --precision bf16
    python examples/tools/measure_backbones.py metric3d-large --precision no

One configuration per process, because a peak belongs to a process. Prints JSON: seconds of the forward of all images
(without gradients, in micro-batches, which makes the proxies), of the group step (snapshots, replays, Adam), and the
peak after each: on CPU the resident set, weights and libraries included, on CUDA what PyTorch has allocated. Small
micro-batches and `--gradient_checkpointing` fit a step of VGGT-1B into 18 GiB in float32, 14 GiB under bf16.
"""

import argparse
import json
import platform
import sys
import time
from importlib.metadata import version

import torch
from accelerate import Accelerator

from gift_peft import (
    GroupStep,
    Metric3DConfig,
    Metric3DForDepthEstimation,
    MogeConfig,
    MogeForDepthEstimation,
    VggtConfig,
    VggtForDepthEstimation,
    get_gift_model,
)
from gift_peft.training.profiling import peak_memory

BACKBONES = {
    "vggt": lambda: VggtForDepthEstimation(VggtConfig()),
    "metric3d-small": lambda: Metric3DForDepthEstimation(Metric3DConfig(variant="small")),
    "metric3d-large": lambda: Metric3DForDepthEstimation(Metric3DConfig(variant="large")),
    "metric3d-giant2": lambda: Metric3DForDepthEstimation(Metric3DConfig(variant="giant2")),
    "moge-2-large": lambda: MogeForDepthEstimation(MogeConfig(num_tokens=1564)),  # those of 476x644
    "moge-2-large-3600": lambda: MogeForDepthEstimation(MogeConfig(num_tokens=3600)),  # as released
}


def peak_gib(device: torch.device) -> float:
    return round(peak_memory(device) / 2**30, 2)


def timed(function, device: torch.device) -> tuple[float, object]:
    """(seconds, result) of one call, the device's work included."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    start = time.perf_counter()
    result = function()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return round(time.perf_counter() - start, 2), result


def measure(args: argparse.Namespace) -> dict:
    accelerator = Accelerator(mixed_precision=args.precision)
    device = accelerator.device
    torch.manual_seed(0)
    base = BACKBONES[args.backbone]()
    parameters = sum(p.numel() for p in base.parameters())
    model = get_gift_model(base, head=args.head).to(device).eval()
    if args.gradient_checkpointing:
        base.activation_checkpointing_enable()
    trainable = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(trainable, lr=2e-5)
    step = GroupStep(model, micro_batch_size=args.micro_batch_size, retain=args.retain, accelerator=accelerator)
    pixels = torch.rand(args.images, 3, *args.size)
    mask = torch.zeros(args.images, *args.size, dtype=torch.bool)
    mask[:, args.size[0] // 4 : -(args.size[0] // 4), args.size[1] // 4 : -(args.size[1] // 4)] = True
    report = {
        "backbone": args.backbone,
        "parameters": parameters,
        "trained_parameters": sum(p.numel() for p in trainable),
        "images": args.images,
        "size": f"{args.size[0]}x{args.size[1]}",
        "precision": args.precision,
        "micro_batch_size": args.micro_batch_size,
        "retain": args.retain,
        "gradient_checkpointing": args.gradient_checkpointing,
        "peak_gib_after_loading": peak_gib(device),
    }

    @torch.no_grad()
    def forward():
        with accelerator.autocast():
            batches = pixels.split(args.micro_batch_size)
            return torch.cat([model(pixel_values=batch.to(device)).predicted_depth.float() for batch in batches])

    print(f"{args.backbone} built; forward of {args.images} images ...", file=sys.stderr)
    report["forward_seconds"], proxies = timed(forward, device)
    report["peak_gib_after_forward"] = peak_gib(device)

    def update():
        output = step.accumulate(pixels, mask, proxies)
        optimizer.step()
        optimizer.zero_grad()
        return output

    print(f"forward: {report['forward_seconds']} s; group step ...", file=sys.stderr)
    report["group_step_seconds"], output = timed(update, device)
    report["peak_gib_after_group_step"] = peak_gib(device)
    report["image_forwards"] = output.forwards
    report["loss"] = float(output.total)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.machine()
    packages = ("torch", "transformers", "peft", "accelerate")
    versions = {package: version(package) for package in packages}
    return report | {"device": str(device), "name": name, "threads": torch.get_num_threads(), "versions": versions}


def size(text: str) -> tuple[int, int]:
    height, width = text.split("x")
    return int(height), int(width)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("backbone", choices=BACKBONES)
    parser.add_argument("--precision", choices=["no", "bf16"], default="no", help="bf16: autocast, weights in float32")
    parser.add_argument("--images", type=int, default=3)
    parser.add_argument("--size", type=size, default=(476, 644), help="HxW")
    parser.add_argument("--head", choices=["full", "lora", "none"], default="full")
    parser.add_argument("--micro_batch_size", type=int, default=1)
    parser.add_argument("--retain", type=int, default=0, help="images whose graphs are kept instead of replayed")
    parser.add_argument("--gradient_checkpointing", action="store_true")
    print(json.dumps(measure(parser.parse_args()), indent=1))


if __name__ == "__main__":
    main()
