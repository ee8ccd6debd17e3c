"""One backbone's rows of `first_gpu_run.sh`: what nobody can know without a GPU. Random weights, one group of noise.

python examples/tools/first_gpu_run.py --model depth-anything-v2-large
python examples/tools/first_gpu_run.py --model tiny --device cpu      (only to see that it runs)
"""

import argparse
import statistics
import time
import warnings

import torch
from accelerate import Accelerator
from benchmark.models import CONFIGS

from gift_peft.adapters.recipes import get_gift_model
from gift_peft.group_inputs import GroupInputs
from gift_peft.group_step import GroupStep
from gift_peft.training.precision import choose_precision, exact_output
from gift_peft.training.profiling import peak_memory, reset_peak_memory, synchronize
from gift_peft.training.speed import channels_last_head, make_adam, tuned_for


def noise(images: int, size: tuple[int, int], pin: bool) -> GroupInputs:
    generator = torch.Generator().manual_seed(0)
    pixels = torch.randn(images, 3, *size, generator=generator)
    mask = torch.zeros(images, *size, dtype=torch.bool)
    mask[:, size[0] // 4 : -(size[0] // 4), size[1] // 4 : -(size[1] // 4)] = True
    group = GroupInputs(pixels, mask, torch.rand(images, *size, generator=generator))
    return group.pin_memory() if pin else group


def same_bits(step: GroupStep, pixels: torch.Tensor) -> str:
    """Whether a forward without gradient, a snapshot, has the bits of one with, a replay."""
    with torch.no_grad():
        snapshot = step._predict(pixels).float()
    with torch.enable_grad():
        replay = step._predict(pixels).detach().float()
    if torch.equal(snapshot, replay):
        return "equal"
    return f"differ by up to {((snapshot - replay).abs().max() / replay.abs().max()).item():.1e} of the maximum"


def update(step: GroupStep, optimizer: torch.optim.Optimizer, group: GroupInputs) -> None:
    step.accumulate(*group.arguments())
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)


def count_waits(step: GroupStep, optimizer: torch.optim.Optimizer, group: GroupInputs) -> int:
    """What PyTorch warns of in an update, the loop's own check of the weights apart."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            update(step, optimizer, group)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchroniz" in str(warning.message) for warning in caught)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", choices=list(CONFIGS), required=True)
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument("--images", type=int, default=9, help="in the group; GIFT-I's groups have 9.3 on average")
    parser.add_argument("--updates", type=int, default=5)
    args = parser.parse_args()
    cuda, size = args.device == "cuda", CONFIGS[args.model].size
    device = torch.device(args.device, 0) if cuda else torch.device("cpu")
    accelerator = Accelerator(cpu=not cuda, mixed_precision=choose_precision(None, device))
    torch.manual_seed(0)
    model = get_gift_model(CONFIGS[args.model].build()).to(device).eval()
    exact_output(model)
    with channels_last_head(model, tuned_for(device, None, "full")):
        step = GroupStep(model, micro_batch_size="auto", accelerator=accelerator)
        optimizer = make_adam([p for p in model.parameters() if p.requires_grad], 2e-5)
        group = noise(args.images, size, pin=cuda)
        reset_peak_memory(device)
        update(step, optimizer, group)  # measures memory, tries cuDNN's algorithms out
        update(step, optimizer, group)
        seconds = []
        for _ in range(args.updates):
            synchronize(device)
            started = time.perf_counter()
            update(step, optimizer, group)
            synchronize(device)
            seconds.append(time.perf_counter() - started)
        peak = peak_memory(device)
        total = torch.cuda.get_device_properties(device).total_memory if cuda else 0
        replay = GroupStep(model, micro_batch_size=step.micro_batch_size, retain=0, accelerator=accelerator)
        middle = statistics.median(seconds)
        rows = {
            "device, precision": f"{torch.cuda.get_device_name(device) if cuda else 'CPU'}, {step.mixed_precision}",
            "snapshot and replay": same_bits(replay, group.pixel_values[: step.micro_batch_size]),
            "micro-batch": str(step.micro_batch_size),
            "budget": str(step.budget),
            "peak": f"{peak / 2**30:.2f} GiB" + (f" of {total / 2**30:.2f}" if cuda else " (the whole process)"),
            "waits per update": str(count_waits(step, optimizer, group)) if cuda else "not counted",
            "seconds per update": f"{middle:.3f} ({min(seconds):.3f} to {max(seconds):.3f})",
            "epoch of 3,268 images": f"{3268 / args.images * middle:.0f} s (extrapolated)",
        }
    print(f"\n| {args.model}, {args.images} images of {size[0]}x{size[1]} | |\n|---|---|")
    print("\n".join(f"| {name} | {value} |" for name, value in rows.items()), flush=True)


if __name__ == "__main__":
    main()
