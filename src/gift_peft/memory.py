"""The memory of a group step: how many images' graphs it keeps (`retain="auto"`), and frozen weights cast once.

Graphs: the first micro-batch shows what the graph of one image takes, the memory that is then free how many fit. On
CUDA all that is free less a margin, halved whenever it proves too much; on CPU half of what is available, because
there a process that takes too much is killed, not told.

Casts: autocast casts every weight again in each forward, and a graph that is retained keeps its casts: of Depth
Anything V2-Large, 0.6 GB for each micro-batch. Its own cache holds weights that are trained only. `FrozenCasts`
gives frozen layers one cast for the whole group, with the bits of autocast's casts.
"""

import logging
import math
import os
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import torch
from torch import Tensor, nn

logger = logging.getLogger(__name__)

CUDA_MARGIN = 0.1  # of the device's memory: fragments, and what libraries take for themselves
CPU_SHARE = 0.5  # of what is available
GROUP_TENSORS = 6  # of the size of the group's predictions live beside the graphs: snapshots, gradient and its parts
CUDA_MOST_IMAGES = 8  # per forward: enough that the device, and not the host that launches its kernels, sets the pace
PATIENCE = 50  # groups until a budget that proved too much is measured anew; after each next time twice as many

# What libraries say who ask the system for memory themselves; PyTorch's own allocator raises OutOfMemoryError.
OUT_OF_MEMORY = ("out of memory", "alloc_failed", "can't allocate memory", "not enough memory", "cudnn_status_")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out: of PyTorch, cuBLAS, cuDNN, NCCL, the driver or the system."""
    if isinstance(error, torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(text in str(error).lower() for text in OUT_OF_MEMORY)


def release_memory(device: torch.device) -> None:
    """Hand back what PyTorch keeps of a CUDA device's memory for later."""
    if device.type == "cuda":
        torch.cuda.empty_cache()


class GraphBudget:
    """The memory that graphs may take in this process: `bytes`, None until the first micro-batch was measured.

    Args:
        model: on the device whose memory counts; room for the gradients and Adam's state of its trainable weights is
            set aside.
        num_local_processes: how many processes share the CPU's memory.
    """

    def __init__(self, model: nn.Module, num_local_processes: int = 1, casts: "FrozenCasts | None" = None) -> None:
        self.bytes: int | None = None
        self._model = model
        self._num_local_processes = num_local_processes
        self._casts = casts
        self._image_bytes: dict[tuple[int, ...], int] = {}  # by the shape of an image
        self._patience = PATIENCE
        self._until_anew = 0  # groups; 0 where nothing proved too much

    def knows(self, pixel_values: Tensor) -> bool:
        """Whether the graph of an image like these (N,3,h,w) was measured; asked once per group.

        Not after a while in which less was kept than once fitted: what took the memory may be gone.
        """
        if self._until_anew:
            self._until_anew -= 1
            if not self._until_anew:
                self.bytes = None
                self._image_bytes.clear()
        return tuple(pixel_values.shape[1:]) in self._image_bytes

    def measure(self, pixel_values: Tensor, forward: Callable[[Tensor], Tensor]) -> Tensor:
        """`forward` of a micro-batch (B,3,h,w), which keeps its graph; what that takes is the measure."""
        casts = self._casts.tensors if self._casts else lambda: []
        prediction, size = graph_bytes(self._model, lambda: forward(pixel_values), pixel_values, shared=casts)
        self._image_bytes[tuple(pixel_values.shape[1:])] = max(1, math.ceil(size / len(pixel_values)))
        if self.bytes is None:
            # This graph is already taken from what is free; a replay needs as much, and its backward once more.
            self.bytes = max(0, self._free() - size)
            logger.info("%s", self)
        return prediction

    def measure_few(self, pixel_values: Tensor, forward: Callable[[Tensor], Tensor]) -> int:
        """`measure` with two images, or one where two are too many; returns how many these were, 0 if not one fits."""
        for count in range(min(2, len(pixel_values)), 0, -1):
            try:
                self.measure(pixel_values[:count], forward)
                return count
            except RuntimeError as error:
                if not is_out_of_memory(error):
                    raise
            release_memory(next(self._model.parameters()).device)
        return 0

    def images(self, pixel_values: Tensor, canvas: Tensor) -> int:
        """How many of these images' graphs may be kept, beside their predictions `canvas` (N,H,W)."""
        room = (self.bytes or 0) - GROUP_TENSORS * canvas.nbytes
        return max(0, room // self._image_bytes[tuple(pixel_values.shape[1:])])

    def widen(self, pixel_values: Tensor, measured: int, canvas: Tensor) -> int:
        """The micro-batch that memory allows: the whole of the largest group, else an even number or 1; on CUDA <= 8.

        `measured` images had the micro-batch whose graph was measured. Larger ones, where they are replayed, need more
        beside the graphs that are kept: `reserve` takes that off. `canvas` as in `images`, of the largest group.
        """
        on_cuda = next(self._model.parameters()).device.type == "cuda"
        return micro_batch_for(self.images(pixel_values, canvas), measured, len(canvas), on_cuda)

    def reserve(self, pixel_values: Tensor, measured: int, count: int, canvas: Tensor) -> None:
        """Set aside what micro-batches of `count` images take where groups are too large to be kept whole."""
        if count < len(canvas):
            more = 2 * max(0, count - measured) * self._image_bytes[tuple(pixel_values.shape[1:])]
            self.bytes = max(0, (self.bytes or 0) - more)

    def halve(self, pixel_values: Tensor, canvas: Tensor, num_images: int) -> None:
        """The graphs of so many images were too much: at most half as many for a while."""
        room = self._image_bytes[tuple(pixel_values.shape[1:])] * (num_images // 2) + GROUP_TENSORS * canvas.nbytes
        self.bytes = min(self.bytes or room, room) if num_images > 1 else 0
        self._until_anew, self._patience = self._patience, 2 * self._patience
        logger.warning(
            "out of memory with the graphs of %d images; keeping at most %d for the next %d groups",
            num_images,
            num_images // 2,
            self._until_anew,
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


def micro_batch_for(room: int, measured: int, largest: int, on_cuda: bool) -> int:
    """Images per forward where `room` graphs may be kept beside a micro-batch of `measured` images.

    What a replay of more takes, its graph and as much for the backward, is not there for graphs to keep. On a CPU all
    of the room may go into that; on CUDA a quarter, because there larger batches save launches only.
    """
    if largest > room:
        more = room // (8 if on_cuda else 2)
        largest = (measured + more) // 2 * 2 or 1
    return min(largest, CUDA_MOST_IMAGES) if on_cuda else largest


def graph_bytes(
    model: nn.Module,
    forward: Callable[[], Tensor],
    *alive: Tensor,
    shared: Callable[[], list[Tensor]] = lambda: [],
) -> tuple[Tensor, int]:
    """(prediction, bytes its graph keeps alive beside the model's weights and `alive`) of a forward with grad.

    `shared` gives, afterwards, what the forward has made that the graphs of other images share.
    """
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
    for tensor in (*model.parameters(), *model.buffers(), *alive, *shared()):
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


class FrozenCasts:
    """Frozen float32 layers that share one cast of their weight over all forwards and backwards of a group.

    `with casts:` around what runs under autocast; outside of it nothing changes, and nothing is kept. A layer has the
    cast during its own forward only: what runs outside of autocast, and code that asks for the type of its weight,
    find it unchanged. Compiled blocks are left alone. The model is walked once; its hooks go with this object.
    """

    def __init__(self, model: nn.Module, dtype: torch.dtype = torch.bfloat16) -> None:
        self._hooks = hooks = _CastHooks(dtype)
        handles = []
        for module in _uncompiled_modules(model):
            if type(module) in LAYERS and module.weight.dtype == torch.float32 and not module.weight.requires_grad:
                handles.append(module.register_forward_pre_hook(hooks.lend))
                handles.append(module.register_forward_hook(hooks.take_back, always_call=True))  # also after an error
        weakref.finalize(self, _remove, handles)

    def __enter__(self) -> "FrozenCasts":
        self._hooks.active = True
        return self

    def __exit__(self, *_) -> None:
        self._hooks.active = False
        self._hooks.casts.clear()

    def tensors(self) -> list[Tensor]:
        """The casts that there are now."""
        return list(self._hooks.casts.values())


class _CastHooks:
    """What the layers call; apart from `FrozenCasts`, so that a model with hooks does not keep that alive."""

    def __init__(self, dtype: torch.dtype) -> None:
        self.dtype, self.active = dtype, False
        self.casts: dict[nn.Module, Tensor] = {}
        self._weights: dict[nn.Module, nn.Parameter] = {}

    def lend(self, module: Any, args: tuple) -> None:
        weight = module.weight
        if self.active and torch.is_autocast_enabled(weight.device.type):
            if module not in self.casts:
                self.casts[module] = weight.detach().to(self.dtype)
            self._weights[module] = weight
            module._parameters["weight"] = self.casts[module]

    def take_back(self, module: Any, args: tuple, output: object) -> None:
        if module in self._weights:
            module._parameters["weight"] = self._weights.pop(module)


def _remove(handles: list) -> None:
    for handle in handles:
        handle.remove()


def _uncompiled_modules(module: nn.Module) -> Iterator[nn.Module]:
    if not is_compiled(module):
        yield module
        for child in module.children():
            yield from _uncompiled_modules(child)


def is_compiled(module: nn.Module) -> bool:
    """Whether `torch.compile` stands before the module or its forward."""
    return module._compiled_call_impl is not None or hasattr(module.forward, "_torchdynamo_orig_callable")
