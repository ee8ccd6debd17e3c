"""The memory of a group step: how many images' graphs it keeps (`retain="auto"`), and frozen weights cast once.

Graphs: the first micro-batch shows what the graph of one image takes, the memory that is then free how many fit. On
CUDA all that is free less a margin, halved whenever it proves too much; on CPU half of what is available, because
there a process that takes too much is killed, not told.

Casts: autocast casts every weight again in each forward, and a graph that is retained keeps its casts: of Depth
Anything V2-Large, 0.6 GB for each micro-batch. Its own cache holds weights that are trained only. `cast_frozen_once`
gives frozen layers one cast for the whole group, with the bits of autocast's casts.
"""

import logging
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import torch
from torch import Tensor, nn

logger = logging.getLogger(__name__)

CUDA_MARGIN = 0.1  # of the device's memory: fragments, and what libraries take for themselves
CPU_SHARE = 0.5  # of what is available
GROUP_TENSORS = 6  # of the size of the group's predictions live beside the graphs: snapshots, gradient and its parts


class GraphBudget:
    """The memory that graphs may take in this process: `bytes`, None until the first micro-batch was measured.

    Args:
        model: on the device whose memory counts; room for the gradients and Adam's state of its trainable weights is
            set aside.
        num_local_processes: how many processes share the CPU's memory.
    """

    def __init__(self, model: nn.Module, num_local_processes: int = 1) -> None:
        self.bytes: int | None = None
        self._model = model
        self._num_local_processes = num_local_processes
        self._image_bytes: dict[tuple[int, ...], int] = {}  # by the shape of an image

    def knows(self, pixel_values: Tensor) -> bool:
        """Whether the graph of an image like these (N,3,h,w) was measured."""
        return tuple(pixel_values.shape[1:]) in self._image_bytes

    def measure(self, pixel_values: Tensor, forward: Callable[[Tensor], Tensor]) -> Tensor:
        """`forward` of a micro-batch (B,3,h,w), which keeps its graph; what that takes is the measure."""
        prediction, size = graph_bytes(self._model, lambda: forward(pixel_values), pixel_values)
        self._image_bytes[tuple(pixel_values.shape[1:])] = max(1, math.ceil(size / len(pixel_values)))
        if self.bytes is None:
            # This graph is already taken from what is free; a replay needs as much, and its backward once more.
            self.bytes = max(0, self._free() - size)
            logger.info("%s", self)
        return prediction

    def images(self, pixel_values: Tensor, canvas: Tensor) -> int:
        """How many of these images' graphs may be kept, beside their predictions `canvas` (N,H,W)."""
        room = (self.bytes or 0) - GROUP_TENSORS * canvas.nbytes
        return max(0, room // self._image_bytes[tuple(pixel_values.shape[1:])])

    def halve(self, pixel_values: Tensor, num_images: int) -> None:
        """The graphs of so many images were too much: at most half as many from now on."""
        self.bytes = self._image_bytes[tuple(pixel_values.shape[1:])] * num_images // 2
        logger.warning(
            "out of memory with the graphs of %d images; keeping at most %d from now on", num_images, num_images // 2
        )

    def __str__(self) -> str:
        if self.bytes is None:  # a group smaller than the number of processes leaves some without an image
            return "retain auto: nothing measured yet"
        sizes = "/".join(f"{size / 2**20:.1f}" for size in self._image_bytes.values())
        return f"retain auto: up to {self.bytes / 2**20:.0f} MiB of graphs, {sizes} MiB per image"

    def _free(self) -> int:
        """Bytes that may be planned with, now."""
        weights = [p for p in self._model.parameters() if p.requires_grad]
        device = weights[0].device
        reserved = 4 * sum(p.nbytes for p in weights)  # gradients, their sum over processes, Adam's two moments
        if device.type == "cuda":
            free, total = torch.cuda.mem_get_info(device)
            cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
            return int(free + cached - CUDA_MARGIN * total) - reserved
        if device.type == "cpu":
            return int(CPU_SHARE * available_memory() / self._num_local_processes) - reserved
        return 0  # elsewhere nobody tells how much is free


def graph_bytes(model: nn.Module, forward: Callable[[], Tensor], *alive: Tensor) -> tuple[Tensor, int]:
    """(prediction, bytes its graph keeps alive beside the model's weights and `alive`) of a forward with grad."""
    device = next(model.parameters()).device
    if device.type == "cuda":
        with torch.no_grad():
            forward()  # what is made once and stays (workspaces, half-precision weights) is not the graph's
        before = torch.cuda.memory_allocated(device)
        prediction = forward()
        return prediction, torch.cuda.memory_allocated(device) - before
    sizes: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        sizes[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        prediction = forward()
    for tensor in (*model.parameters(), *model.buffers(), *alive):
        sizes.pop(tensor.untyped_storage().data_ptr(), None)
    return prediction, sum(sizes.values()) + prediction.nbytes


def available_memory() -> int:
    """Bytes that can still be taken on this machine: by the system's account, or by that of a cgroup around us."""
    return max(0, min([psutil.virtual_memory().available, *_cgroup_rooms()]))


def _cgroup_rooms(membership: Path = Path("/proc/self/cgroup"), mount: Path = Path("/sys/fs/cgroup")) -> Iterator[int]:
    """What each limit (cgroup v1 and v2, of this process's group and those above) leaves, in bytes.

    File pages that nobody used lately count as free. In a container the path may be the host's: only those parts of
    it are looked at that exist here.
    """
    try:
        lines = membership.read_text().splitlines()
    except OSError:
        return  # not Linux
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            names = ("memory.max", "memory.current", "inactive_file")
            roots = [mount, mount / "unified"]
        elif "memory" in controllers.split(","):
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
            roots = [mount / "memory"]
        else:
            continue
        inside = Path(path.lstrip("/"))
        for folder in {root / part for root in roots for part in (inside, *inside.parents)}:
            try:
                limit = (folder / names[0]).read_text().strip()
                used = int((folder / names[1]).read_text())
                stat = dict(entry.split() for entry in (folder / "memory.stat").read_text().splitlines())
            except OSError:
                continue
            if limit != "max":
                yield int(limit) - used + int(stat.get(names[2], 0))


def local_processes(num_processes: int) -> int:
    """How many of a job's processes run on this machine; launchers say so."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", num_processes))


LAYERS = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)  # what autocast runs in half precision, and these models have


@contextmanager
def cast_frozen_once(model: nn.Module, dtype: torch.dtype = torch.bfloat16) -> Iterator[None]:
    """Inside, frozen float32 layers share one cast of their weight over all forwards and backwards under autocast.

    A layer has the cast during its own forward only: what runs outside of autocast, and code that asks for the type of
    its weight, find it unchanged. Compiled blocks are left alone.
    """
    casts: dict[nn.Module, Tensor] = {}
    weights: dict[nn.Module, nn.Parameter] = {}

    def lend(module: Any, args: tuple) -> None:
        weight = module.weight
        if torch.is_autocast_enabled(weight.device.type):
            if module not in casts:
                casts[module] = weight.detach().to(dtype)
            weights[module] = weight
            module._parameters["weight"] = casts[module]

    def take_back(module: Any, args: tuple, output: object) -> None:
        if module in weights:
            module._parameters["weight"] = weights.pop(module)

    handles = []
    for module in _uncompiled_modules(model):
        if type(module) in LAYERS and module.weight.dtype == torch.float32 and not module.weight.requires_grad:
            handles.append(module.register_forward_pre_hook(lend))
            handles.append(module.register_forward_hook(take_back, always_call=True))  # also after an error
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def _uncompiled_modules(module: nn.Module) -> Iterator[nn.Module]:
    if module._compiled_call_impl is None:
        yield module
        for child in module.children():
            yield from _uncompiled_modules(child)
