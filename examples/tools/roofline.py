"""How long an epoch would take on a GPU that nobody has here: arithmetic and traffic counted, rates put in.

    python examples/tools/roofline.py --out docs
    python examples/tools/roofline.py --gpu rtx-4090 --models depth-anything-v2-large --micro_batch_size 2

Estimates, not measurements. A forward and a backward of one image run on tensors without content; each matrix product,
convolution and attention is counted as arithmetic, every other operator as memory that is read and written (bf16, as
if nothing were fused) and as one kernel that the host launches. The rates of a GPU are what such kernels reach in
practice, not its data sheet. The epoch is GIFT-I's: 353 groups, 3,268 images.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

import torch
from benchmark.epoch import GROUP_SIZES
from benchmark.models import CONFIGS
from benchmark.report import replace_section
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from gift_peft.adapters.recipes import get_gift_model
from gift_peft.memory import CUDA_MARGIN, micro_batch_for

TITLE = "Estimates for GPUs"
BACKBONES = ("depth-anything-v2-large", "vggt-1b", "metric3d-v2-giant2")
HALF = 0.5  # counted in float32, computed in bf16


@dataclass
class Gpu:
    """What kernels reach: FLOP/s of matrix products, convolutions and attention, bytes/s, bytes of memory."""

    matrix: float
    convolution: float
    attention: float
    bandwidth: float
    memory: float


GPUS = {
    "h200": Gpu(560e12, 300e12, 350e12, 3.6e12, 139 * 2**30),
    "rtx-4090": Gpu(120e12, 80e12, 75e12, 0.8e12, 23.6 * 2**30),
}


class Work(NamedTuple):
    """Of one image: FLOPs by kind, bytes of traffic (float32), kernels."""

    matrix: float
    convolution: float
    attention: float
    traffic: float
    kernels: int

    def seconds(self, gpu: Gpu) -> float:
        """On the device, which either computes or moves."""
        compute = self.matrix / gpu.matrix + self.convolution / gpu.convolution + self.attention / gpu.attention
        return compute + HALF * self.traffic / gpu.bandwidth

    def flops(self) -> float:
        return self.matrix + self.convolution + self.attention


class Attention(torch.autograd.Function):
    """In place of a fused attention: shapes only. Its FLOPs are counted by `Counter`."""

    @staticmethod
    def forward(ctx, query: Tensor, key: Tensor, value: Tensor, count: Callable[[float], None]) -> Tensor:
        ctx.save_for_backward(query, key, value)
        ctx.count = count
        count(2.0)
        return query.new_empty(*query.shape[:-1], value.shape[-1])

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        ctx.count(5.0)  # scores again, and four products
        return *(torch.empty_like(tensor) for tensor in ctx.saved_tensors), None


class Counter(TorchDispatchMode):
    """Inside, every operator is work."""

    def __init__(self) -> None:
        super().__init__()
        self.flops = {"matrix": 0.0, "convolution": 0.0, "attention": 0.0}
        self.traffic, self.kernels = 0.0, 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        output = function(*args, **(kwargs or {}))
        packet = function.overloadpacket
        if packet in flop_registry:
            kind = "convolution" if "convolution" in packet.__name__ else "matrix"
            self.flops[kind] += flop_registry[packet](*args, **(kwargs or {}), out_val=output)
            self.kernels += 1
        elif not function.is_view:
            moved = [leaf for leaf in (*tree_leaves(args), *tree_leaves(output)) if isinstance(leaf, Tensor)]
            self.traffic += sum(tensor.numel() * tensor.element_size() for tensor in moved)
            self.kernels += 1
        return output

    def work(self) -> Work:
        return Work(**self.flops, traffic=self.traffic, kernels=self.kernels)


class FusedAttention(TorchFunctionMode):
    """Inside, scaled_dot_product_attention is one kernel, whichever device it would run on."""

    def __init__(self, counter: Callable[[], Counter]) -> None:
        super().__init__()
        self.counter = counter

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function is not nn.functional.scaled_dot_product_attention:
            return function(*args, **(kwargs or {}))
        query, key, value = args[:3]

        def count(products: float) -> None:
            pairs = query.numel() // query.shape[-1] * key.shape[-2]
            self.counter().flops["attention"] += products * pairs * (query.shape[-1] + value.shape[-1])
            self.counter().kernels += 1

        return Attention.apply(query, key, value, count)


class Counted(NamedTuple):
    """Of one image, and of the weights: the work of both passes, bytes of a graph (bf16), of weights and training."""

    forward: Work
    backward: Work
    graph: float
    weights: float


def count(model: nn.Module, size: tuple[int, int]) -> Counted:
    """One image through a model on the meta device."""
    counters = [Counter(), Counter()]
    saved: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        saved[tensor.untyped_storage()._cdata] = tensor.untyped_storage().nbytes()
        return tensor

    now = counters[:1]
    pixels = torch.empty(1, 3, *size, device="meta")
    with FusedAttention(lambda: now[0]):
        with counters[0], torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
            depth = model(pixel_values=pixels)
        now[0] = counters[1]
        with counters[1]:
            getattr(depth, "predicted_depth", depth).sum().backward()
    for tensor in (*model.parameters(), *model.buffers()):
        saved.pop(tensor.untyped_storage()._cdata, None)
    trained = sum(p.nbytes for p in model.parameters() if p.requires_grad)
    every = sum(p.nbytes for p in model.parameters())
    # Weights in float32 and a cast in bf16; of the trained ones gradients, their sum and Adam's two averages.
    return Counted(counters[0].work(), counters[1].work(), HALF * sum(saved.values()), 1.5 * every + 4 * trained)


def epoch_seconds(counted: Counted, gpu: Gpu, launch: float, micro_batch: int | None = None) -> dict[str, float]:
    """Device and host seconds of an epoch, the share of images whose graph is kept, and the micro-batch (auto's)."""
    room = gpu.memory * (1 - CUDA_MARGIN) - counted.weights
    fit = max(0, int(room // counted.graph) - 4)  # of two images a replay and its backward
    micro_batch = micro_batch or micro_batch_for(fit, 2, max(GROUP_SIZES), on_cuda=True)
    fit = max(0, fit - 2 * (micro_batch - 2)) if fit < max(GROUP_SIZES) else fit
    device = host = kept = images = 0.0
    for count, groups in GROUP_SIZES.items():
        retained = min(count, fit // micro_batch * micro_batch) if fit < count else count
        replayed = count - retained
        seconds = (count + replayed) * counted.forward.seconds(gpu) + count * counted.backward.seconds(gpu)
        launches = ceil(count / micro_batch) * (counted.forward.kernels + counted.backward.kernels)
        launches += ceil(replayed / micro_batch) * counted.forward.kernels
        device, host = device + groups * seconds, host + groups * launches * launch
        kept, images = kept + groups * retained, images + groups * count
    return {
        "device": device,
        "host": host,
        "epoch": max(device, host),
        "kept": kept / images,
        "micro_batch": micro_batch,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gpu", choices=list(GPUS), nargs="+", default=list(GPUS))
    parser.add_argument("--models", choices=list(CONFIGS), nargs="+", default=list(BACKBONES))
    parser.add_argument("--micro_batch_size", type=int, help="default: what auto takes")
    parser.add_argument("--launch_microseconds", type=float, default=10.0, help="host time per kernel")
    parser.add_argument("--out", type=Path, help="folder of benchmark.md, which gets the table; default: print only")
    args = parser.parse_args()
    lines = [
        "**Nothing here was measured.** `python examples/tools/roofline.py` counts the arithmetic, the memory traffic "
        "and the kernels of one image on tensors without content, and divides by what such kernels reach on a GPU. "
        f"Host: what launching the kernels takes at {args.launch_microseconds:g} microseconds each. The epoch is "
        "GIFT-I's, 3,268 images.",
        "",
        "| model | GPU | TFLOP per image, forward / backward | kernels | GiB a graph | batch | kept | s per epoch |",
        "|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name in args.models:
        with torch.device("meta"):
            model = get_gift_model(CONFIGS[name].build()).eval()
        counted = count(model, CONFIGS[name].size)
        for gpu in args.gpu:
            result = epoch_seconds(counted, GPUS[gpu], args.launch_microseconds * 1e-6, args.micro_batch_size)
            lines.append(
                f"| {name} | {gpu} | {counted.forward.flops() / 1e12:.2f} / {counted.backward.flops() / 1e12:.2f} | "
                f"{counted.forward.kernels} + {counted.backward.kernels} | {counted.graph / 2**30:.2f} | "
                f"{result['micro_batch']} | {result['kept']:.0%} | "
                f"{result['device']:.0f} (host {result['host']:.0f}) |"
            )
    text = "\n".join(lines)
    print(text)
    if args.out:
        replace_section(args.out / "benchmark.md", TITLE, text)


if __name__ == "__main__":
    main()
