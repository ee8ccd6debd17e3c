"""One group in, its summed gradient out, in the memory of one micro-batch (supplement B, "snapshot and replay").

Forward all images without grad (snapshots), differentiate the group's loss with respect to the snapshots alone, then
forward each micro-batch again with grad (replay) and push its slice of that gradient through the graph. Micro-batches
whose graphs fit into memory keep them from the snapshot and are not forwarded again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from gift_peft.losses import GiftLoss, gift_loss, require_finite
from gift_peft.memory import GraphBudget, cast_frozen_once, local_processes

if TYPE_CHECKING:
    from accelerate import Accelerator

Result = TypeVar("Result")


class GroupStepOutput(NamedTuple):
    """Detached values of one group, equal on all processes.

    `forwards` counts image forwards over all of them: 2N - retained, without what is repeated for want of memory.
    """

    total: Tensor
    consistency: Tensor
    distillation: Tensor
    num_pairs: int
    forwards: int


class GroupStep:
    """Adds the gradient of `gift_loss` on a whole group into `.grad`, micro-batch by micro-batch.

    Args:
        model: called as `model(pixel_values=x)`; returns (B,H,W) or an object with `.predicted_depth`. Its mode, dtype
            and device are left alone, and it must not be wrapped in DistributedDataParallel.
        lambda_c, lambda_d: weights of consistency and distillation (Eq. 6).
        micro_batch_size: images per forward; the group is cut once, in image order.
        retain: keep the graphs of the last whole micro-batches, at most this many images, instead of replaying them.
            0 is the paper's schedule; "auto" keeps as many as memory allows (see `budget`), and fewer after running
            out of it. On CPU the gradient does not depend on it, to the bit.
        accelerator: its processes share the micro-batches, and its mixed precision ("no" or "bf16") is used. Without
            one: this process alone, bf16 for a model on CUDA, else no. See the attribute `mixed_precision`.

    Attributes: `budget`, the `GraphBudget` of "auto", else None; `phase`, called with "snapshot", "loss", "replay" and
    "reduce" for a context around each part of a step, to time it.
    Raises ValueError for fp16, active dropout settings, a wrapped or sharded model and arguments out of range.
    """

    def __init__(
        self,
        model: nn.Module,
        lambda_c: float = 1.0,
        lambda_d: float = 1.0,
        micro_batch_size: int = 2,
        retain: int | str = "auto",
        accelerator: Accelerator | None = None,
    ) -> None:
        if isinstance(micro_batch_size, bool) or not isinstance(micro_batch_size, int) or micro_batch_size < 1:
            raise ValueError(f"micro_batch_size must be a positive integer, got {micro_batch_size!r}")
        if retain != "auto" and (isinstance(retain, bool) or not isinstance(retain, int) or retain < 0):
            raise ValueError(f'retain must be "auto" or a number of images >= 0, got {retain!r}')
        if isinstance(model, nn.parallel.DistributedDataParallel):
            raise ValueError("GroupStep sums gradients itself: pass the model without DistributedDataParallel")
        kind = str(getattr(accelerator, "distributed_type", "NO")).removeprefix("DistributedType.")
        if kind != "NO" and not kind.startswith("MULTI_"):  # FSDP, DeepSpeed, Megatron ... own weights and backward
            raise ValueError(f"GroupStep needs whole weights on every process: {kind} is not supported, use MULTI_GPU")
        self.model = model
        self.lambda_c = lambda_c
        self.lambda_d = lambda_d
        self.micro_batch_size = micro_batch_size
        self.retain = retain
        self.accelerator: Any = accelerator  # accelerate does not say that `reduce` of a tensor is a tensor
        self.mixed_precision = _mixed_precision(model, accelerator)
        self.phase: Callable[[str], AbstractContextManager] = nullcontext
        self._rank = accelerator.process_index if accelerator else 0
        self._world = accelerator.num_processes if accelerator else 1
        self.budget = GraphBudget(model, local_processes(self._world)) if retain == "auto" else None
        _check_replayable(model)

    def accumulate(
        self,
        pixel_values: Tensor,
        mask: Tensor,
        target: Tensor,
        valid: Tensor | None = None,
        names: Sequence[str] | None = None,
    ) -> GroupStepOutput:
        """Add one group's gradient into `.grad`; every process passes the whole group.

        Args: `pixel_values` (N,3,h,w) on any device, `mask` (N,H,W) bool, `target` (N,H,W) proxies in native units,
        `valid` (N,H,W) bool or None, with (H,W) the size of the prediction; `names` of the images, for messages.
        Raises ValueError, on all processes and with `.grad` as it was, for inconsistent shapes, non-finite
        predictions, proxies, loss or gradients, and a model that is not replayable (dropout, BatchNorm in training).
        """
        _check_replayable(self.model)
        parameters = [p for p in self.model.parameters() if p.requires_grad]
        if not parameters:
            raise ValueError("the model has no trainable parameter: load the adapter with is_trainable=True")
        if any(p.dtype == torch.float16 for p in parameters):
            raise ValueError("fp16 parameters cannot be trained: load the base in float32")
        _check_inputs(pixel_values, mask, target, valid, names)
        device = parameters[0].device
        mask, target = mask.to(device), target.to(device)
        valid = None if valid is None else valid.to(device)
        batches = [slice(i, i + self.micro_batch_size) for i in range(0, len(mask), self.micro_batch_size)]

        canvas = torch.zeros(mask.shape, dtype=torch.promote_types(parameters[0].dtype, torch.float32), device=device)
        graphs: dict[int, Tensor] = {}
        with cast_frozen_once(self.model) if self.mixed_precision == "bf16" else nullcontext():
            num_retained = self._snapshot(pixel_values, batches, canvas, graphs)
            require_finite(canvas, "the prediction", names)
            with self.phase("loss"):
                differentiate = partial(self._differentiate, canvas, target, mask, valid)
                loss, gradient = self._recovering(differentiate, pixel_values, graphs)
            if not loss.total.isfinite():  # differences of finite predictions overflow; their signs do not
                raise ValueError("the loss of this group is NaN or infinite")
            self._add_gradients(parameters, partial(self._replay, parameters, pixel_values, batches, gradient, graphs))
        return GroupStepOutput(*loss, forwards=2 * len(mask) - num_retained)

    def _snapshot(self, pixel_values: Tensor, batches: list[slice], canvas: Tensor, graphs: dict[int, Tensor]) -> int:
        """Fill `canvas` (N,H,W) with all predictions, and `graphs` with this process's that kept their graph.

        Returns how many images keep theirs, over all processes.
        """
        sizes = canvas.new_zeros(len(canvas), 2)  # travels with the canvas, so that all processes raise or none
        with self.phase("snapshot"):
            forward = partial(self._forward, pixel_values, batches, canvas, sizes, graphs)
            self._recovering(forward, pixel_values, graphs)
        num_retained = sum(map(len, graphs.values()))
        if self._world > 1:
            with self.phase("reduce"):
                # A sum of zeros and one prediction is that prediction to the bit, NaN included.
                parts = [canvas.new_tensor([num_retained]), sizes.flatten(), canvas.flatten()]
                summed = self.accelerator.reduce(torch.cat(parts), "sum").split([len(part) for part in parts])
            num_retained, sizes = int(summed[0]), summed[1].view_as(sizes)
            canvas.copy_(summed[2].view_as(canvas))
        for height, width in sizes.long().unique(dim=0).tolist():
            if (height, width) != tuple(canvas.shape[-2:]):
                raise ValueError(
                    f"the prediction is {height}x{width} but mask and target are {canvas.shape[1]}x{canvas.shape[2]}: "
                    "resize them to the prediction's size"
                )
        return num_retained

    def _forward(
        self,
        pixel_values: Tensor,
        batches: list[slice],
        canvas: Tensor,
        sizes: Tensor,
        graphs: dict[int, Tensor],
    ) -> None:
        """This process's share of the predictions and their sizes; `graphs` gets those that are retained."""

        def store(batch: slice, prediction: Tensor) -> None:
            sizes[batch] = sizes.new_tensor(prediction.shape[-2:])
            if prediction.shape == canvas[batch].shape:
                canvas[batch] = prediction.detach()

        mine = self._mine(batches)
        if self.budget is not None and mine and not self.budget.knows(pixel_values):
            with torch.enable_grad():
                graphs[mine[0]] = self.budget.measure(pixel_values[batches[mine[0]]], self._predict)
            store(batches[mine[0]], graphs[mine[0]])
        kept = self._retained(pixel_values, batches, canvas)
        done = list(graphs)
        if not kept or mine[0] != kept[0]:
            graphs.clear()
        with torch.no_grad():
            for index in mine:
                if index not in kept and index not in done:
                    store(batches[index], self._predict(pixel_values[batches[index]]))
        with torch.enable_grad():
            for index in kept:
                if index not in graphs:
                    graphs[index] = self._predict(pixel_values[batches[index]])
                    store(batches[index], graphs[index])

    def _retained(self, pixel_values: Tensor, batches: list[slice], canvas: Tensor) -> list[int]:
        """The last of this process's micro-batches that keep their graphs, whole ones only."""
        mine = self._mine(batches)
        if self.budget is None:  # so many images of the group
            candidates, room = range(len(batches)), int(self.retain)
        else:  # so many images of this process
            candidates, room = mine, self.budget.images(pixel_values, canvas) if mine else 0
        first = len(batches)
        for index in reversed(candidates):
            room -= len(canvas[batches[index]])
            if room < 0:
                break
            first = index
        return [index for index in mine if index >= first]

    def _differentiate(
        self, canvas: Tensor, target: Tensor, mask: Tensor, valid: Tensor | None
    ) -> tuple[GiftLoss, Tensor]:
        """The group's loss, detached, and its gradient with respect to the (N,H,W) snapshots."""
        with torch.enable_grad():
            leaf = canvas.requires_grad_()
            loss = gift_loss(leaf, target, mask, self.lambda_c, self.lambda_d, valid)
            (gradient,) = torch.autograd.grad(loss.total, leaf)
        terms = loss.total.detach(), loss.consistency.detach(), loss.distillation.detach()
        return GiftLoss(*terms, loss.num_pairs), gradient

    def _replay(
        self,
        parameters: list[nn.Parameter],
        pixel_values: Tensor,
        batches: list[slice],
        gradient: Tensor,
        graphs: dict[int, Tensor],
    ) -> None:
        """Backpropagate in micro-batch order, whatever was retained: sums of floats depend on their order."""

        def backward() -> None:
            for p in parameters:
                p.grad = None
            for index in self._mine(batches):
                prediction = graphs.pop(index) if index in graphs else self._predict(pixel_values[batches[index]])
                prediction.backward(gradient[batches[index]].to(prediction.dtype))
                del prediction  # before the next forward, not after

        with self.phase("replay"), torch.enable_grad():
            self._recovering(backward, pixel_values, graphs)

    def _recovering(self, attempt: Callable[[], Result], pixel_values: Tensor, graphs: dict[int, Tensor]) -> Result:
        """`attempt()`; when memory runs out while `graphs` are kept, drop them, halve the budget, and once more.

        Between exchanges with other processes, so each recovers on its own; the others wait for it.
        """
        while True:
            try:
                return attempt()
            except torch.OutOfMemoryError:
                num_images = sum(map(len, graphs.values()))
                if self.budget is None or not num_images:
                    raise
            # Outside of `except` the error is gone, and with it the frames whose tensors still took memory.
            graphs.clear()
            self.budget.halve(pixel_values, num_images)
            if torch.cuda.is_available():
                torch.cuda.empty_cache()

    def _add_gradients(self, parameters: list[nn.Parameter], backward: Callable[[], None]) -> None:
        """Run `backward` on empty gradients, sum them over the processes, and add them to what was there.

        Only this group's part is summed: what `.grad` already holds is equal on all processes.
        """
        previous = [p.grad for p in parameters]
        for p in parameters:
            p.grad = None
        try:
            backward()
            if self._world > 1:
                with self.phase("reduce"):
                    self._sum_over_processes(parameters)
            gradients = [p.grad for p in parameters if p.grad is not None]
            if not torch.nn.utils.get_total_norm(gradients, math.inf).isfinite():
                raise ValueError("the gradient of this group has NaN or infinite values")
        except BaseException:
            for p, old in zip(parameters, previous, strict=True):
                p.grad = old
            raise
        for p, old in zip(parameters, previous, strict=True):
            if old is not None:
                p.grad = old if p.grad is None else old.add_(p.grad)

    def _sum_over_processes(self, parameters: list[nn.Parameter]) -> None:
        """One reduce for all gradients; a parameter that no process has a gradient for keeps None."""
        has_gradient = parameters[0].new_tensor([p.grad is not None for p in parameters])
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([has_gradient, *(g.flatten() for g in gradients)])
        has_gradient, *gradients = self.accelerator.reduce(flat, "sum").split(
            [len(parameters), *(p.numel() for p in parameters)]
        )
        for p, gradient, present in zip(parameters, gradients, has_gradient.tolist(), strict=True):
            p.grad = gradient.view_as(p).to(p.dtype, copy=True) if present else None

    def _mine(self, batches: list[slice]) -> range:
        return range(self._rank, len(batches), self._world)

    def _predict(self, pixel_values: Tensor) -> Tensor:
        """(B,H,W) of one micro-batch, in a context of its own.

        Autocast's weight cache is off: a cast made under no_grad would be reused by the replay and lose its gradient.
        Inputs need no gradient, so that layers before the first trainable one keep nothing for the backward.
        """
        device = next(self.model.parameters()).device
        enabled = self.mixed_precision == "bf16"
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=enabled, cache_enabled=False):
            output = self.model(pixel_values=pixel_values.to(device, non_blocking=True))
        prediction = output if isinstance(output, Tensor) else output.predicted_depth
        if prediction.ndim != 3 or len(prediction) != len(pixel_values):
            raise ValueError(f"the model must predict ({len(pixel_values)},H,W), got {tuple(prediction.shape)}")
        return prediction


def _mixed_precision(model: nn.Module, accelerator: Accelerator | None) -> str:
    if accelerator is not None:
        precision = accelerator.mixed_precision
    else:
        precision = "bf16" if next(model.parameters()).device.type == "cuda" else "no"
    if precision not in ("no", "bf16"):
        raise ValueError(
            f"mixed precision {precision} is not supported (a gradient scaler cannot follow a replay): use bf16 or no"
        )
    return precision


def dropout_rates(model: nn.Module) -> Iterator[tuple[str, nn.Module, str]]:
    """(module name, module, attribute) of every dropout or drop-path rate above 0, in whatever mode the model is."""
    for name, module in model.named_modules():
        keys = ["drop_prob", "dropout_prob", "attention_dropout"]
        if isinstance(module, nn.modules.dropout._DropoutNd):
            keys.append("p")
        for key in keys:
            rate = getattr(module, key, None)
            if isinstance(rate, (int, float)) and rate > 0:
                yield name or type(module).__name__, module, key


def _check_replayable(model: nn.Module) -> None:
    """A replay must repeat its snapshot: no dropout, no BatchNorm on batch statistics."""
    for name, module, key in dropout_rates(model):
        raise ValueError(f"dropout must be 0, but {name} has {key}={getattr(module, key)}")
    for name, module in model.named_modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm) and module.training:
            raise ValueError(f"BatchNorm layer {name} is in training mode: call model.eval() first")


def _check_inputs(
    pixel_values: Tensor, mask: Tensor, target: Tensor, valid: Tensor | None, names: Sequence[str] | None
) -> None:
    """What `gift_loss` would refuse after the forwards, refused before them."""
    if pixel_values.ndim != 4 or pixel_values.dtype == torch.float16:
        raise ValueError(
            f"pixel_values must be (N,3,h,w) and not fp16, got {tuple(pixel_values.shape)} {pixel_values.dtype}"
        )
    if len(pixel_values) == 0:
        raise ValueError("the group has no images")
    for what, tensor in (("mask", mask), ("target", target), ("valid", valid), ("names", names)):
        if tensor is not None and len(tensor) != len(pixel_values):
            raise ValueError(f"{what} has {len(tensor)} entries for {len(pixel_values)} images")
    require_finite(pixel_values, "pixel_values", names)
    require_finite(target, "the target (proxy)", names)
