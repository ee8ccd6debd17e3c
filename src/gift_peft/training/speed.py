"""The same step, faster or in less memory: one optimizer kernel, compiled or recomputed blocks, channels-last heads.

Recomputing gives the same bits, compiling and channels-last do not: compiling is for those who ask.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial

import torch
from peft import PeftModel
from peft.tuners.lora import LoraLayer
from peft.utils.other import ModulesToSaveWrapper
from torch import nn
from torch.utils.checkpoint import checkpoint
from transformers.modeling_layers import GradientCheckpointingLayer

VARIANTS = 32  # of one block's forward that torch.compile may keep; past its limit it would fail
LAYOUT_DEVICES = ("cpu", "cuda")  # where channels-last convolutions are known to be faster
NO_HEAD = "channels_last is for a head that is trained in full (head: full)"
FUSED_DEVICES = ("cpu", "cuda", "mps", "xpu")  # where PyTorch's Adam has one kernel for all weights


def make_adam(weights: Iterable[nn.Parameter], learning_rate: float, **options) -> torch.optim.Adam:
    """Adam, fused where the weights' device has that; `options` as PyTorch's."""
    weights = list(weights)
    return torch.optim.Adam(weights, lr=learning_rate, fused=weights[0].device.type in FUSED_DEVICES, **options)


def encoder_blocks(model: PeftModel) -> list[GradientCheckpointingLayer]:
    """The transformer blocks that hold LoRA; ValueError if the architecture's blocks are not marked as such."""
    blocks = [
        module
        for module in model.modules()
        if isinstance(module, GradientCheckpointingLayer)
        and any(isinstance(part, LoraLayer) for part in module.modules())
    ]
    if not blocks:
        raise ValueError(
            f"{type(model.get_base_model()).__name__} has no block that is a transformers GradientCheckpointingLayer, "
            "which compile and gradient_checkpointing need"
        )
    return blocks


def compile_blocks(model: PeftModel) -> None:
    """`torch.compile` the forward of each encoder block as one graph, in place; names do not change.

    Equal blocks share what is compiled, once for each kind of use: with and without gradient, autocast and float32, a
    batch of one and of any other number.
    """
    torch._dynamo.config.recompile_limit = max(VARIANTS, torch._dynamo.config.recompile_limit)
    for block in encoder_blocks(model):
        block.forward = torch.compile(block.forward, fullgraph=True)
        block.register_forward_pre_hook(_DynamicBatch())


class _DynamicBatch:
    """Before a compiled block: its batch may have any size; and, once, what would break its graph is taken out.

    That is transformers' hook for `output_attentions`, which nobody reads here. It comes with the first forward.
    """

    def __init__(self) -> None:
        self.done = False

    def __call__(self, block: nn.Module, args: tuple) -> None:
        if not self.done:
            self.done = True
            for part in block.modules():
                for number, hook in list(part._forward_hooks.items()):
                    if part is not block and getattr(hook, "__name__", "") == "output_capturing_hook":
                        del part._forward_hooks[number]
        for value in args:
            if isinstance(value, torch.Tensor) and value.ndim:
                torch._dynamo.maybe_mark_dynamic(value, 0)


def checkpoint_blocks(model: PeftModel) -> None:
    """Keep only the inputs of each encoder block and run it again in the backward.

    Not reentrant: that would drop the gradients of blocks whose input needs none. transformers checkpoints in training
    mode only, so that flag is set, on the blocks alone: what is inside stays in eval mode.
    """
    for block in encoder_blocks(model):
        block.gradient_checkpointing = True
        block._gradient_checkpointing_func = partial(checkpoint, use_reentrant=False)
        block.training = True


def tuned_for(device: torch.device, channels_last: bool | None, head: str) -> bool:
    """Whether the head's convolutions train in channels-last layout: as asked, else where that is known to be faster.

    On CUDA bf16 convolutions want it, and cuDNN tries its algorithms out from now on; a run has images of one or two
    sizes. On a CPU an update of the embedded base takes about three quarters of the time with it, one of a
    large model the same. Raises ValueError where it is asked for a head that is not trained in full.
    """
    if channels_last and head != "full":
        raise ValueError(NO_HEAD)
    if device.type == "cuda":
        torch.backends.cudnn.benchmark = True
    return device.type in LAYOUT_DEVICES and head == "full" if channels_last is None else channels_last


@contextmanager
def channels_last_head(model: PeftModel, wanted: bool = True) -> Iterator[None]:
    """While this lasts, each convolution of the trained head is handed its input in channels-last layout.

    What comes after follows. The inputs and not the weights, so that gradients, optimizer and files keep their layout;
    and only for a while, so that a prediction outside of training has the same bits as in any other program. The
    teacher's frozen head keeps its bits. Raises ValueError for a head that is not trained in full.
    """
    handles = []
    if wanted:
        heads = [module for module in model.modules() if isinstance(module, ModulesToSaveWrapper)]
        if not heads:
            raise ValueError(NO_HEAD)
        for wrapper in heads:
            for module in wrapper.modules_to_save.modules():
                if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                    handles.append(module.register_forward_pre_hook(_channels_last_input))
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def _channels_last_input(module: nn.Module, args: tuple) -> tuple:
    return args[0].contiguous(memory_format=torch.channels_last), *args[1:]
