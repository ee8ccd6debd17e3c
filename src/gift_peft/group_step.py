"""One group in, its summed gradient out, in the memory of one micro-batch (supplement B, "snapshot and replay").

Forward all images without grad (snapshots), differentiate the group's loss with respect to the snapshots alone, then
forward each micro-batch again with grad (replay) and push its slice of that gradient through the graph. Micro-batches
whose graphs fit into memory keep them from the snapshot and are not forwarded again.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from gift_peft.group_inputs import GroupInputs, check_lambdas
from gift_peft.losses import GiftLoss, Pairs, are_finite, gift_terms
from gift_peft.memory import FrozenCasts, GraphBudget, is_out_of_memory, local_processes, release_memory
from gift_peft.replayable import check_replayable, check_watched, mixed_precision_of, watched

if TYPE_CHECKING:
    from accelerate import Accelerator

Result = TypeVar("Result")


class GroupStepOutput(NamedTuple):
    """Values of one group, detached and on the CPU, equal on all processes.

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
        micro_batch_size: images per forward; the group is cut once, in image order. "auto": what memory allows, once
            and for all processes, when the first group has been seen or `choose_micro_batch_size` was asked.
        retain: keep the graphs of the last whole micro-batches, at most this many images, instead of replaying them.
            0 is the paper's schedule; "auto" keeps as many as memory allows (see `budget`), and fewer after running
            out of it. On CPU the gradient does not depend on it, to the bit.
        accelerator: its processes share the micro-batches, and its mixed precision ("no" or "bf16") is used. Without
            one: this process alone, bf16 for a model on CUDA, else no. See the attribute `mixed_precision`.

    Attributes: `budget`, the `GraphBudget` of "auto", else None; `first_share`, the distillation's part (0-dim, 0 to
    1) in the pull on the first group's predictions, which for a fresh adapter is all rounding; `phase`, called with
    "snapshot", "loss", "replay" and "reduce" for a context around each part of a step, to time it.
    Raises ValueError for fp16, active dropout settings, a wrapped or sharded model and arguments out of range.
    """

    def __init__(
        self,
        model: nn.Module,
        lambda_c: float = 1.0,
        lambda_d: float = 1.0,
        micro_batch_size: int | str = 2,
        retain: int | str = "auto",
        accelerator: Accelerator | None = None,
    ) -> None:
        check_lambdas(lambda_c=lambda_c, lambda_d=lambda_d)
        fixed = isinstance(micro_batch_size, int) and not isinstance(micro_batch_size, bool) and micro_batch_size >= 1
        if micro_batch_size != "auto" and not fixed:
            raise ValueError(f'micro_batch_size must be a positive integer or "auto", got {micro_batch_size!r}')
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
        self.mixed_precision = mixed_precision_of(model, accelerator)
        self.phase: Callable[[str], AbstractContextManager] = nullcontext
        self._rank = accelerator.process_index if accelerator else 0
        self._world = accelerator.num_processes if accelerator else 1
        self._casts = FrozenCasts(model) if self.mixed_precision == "bf16" else None
        budget = GraphBudget(model, local_processes(self._world), self._casts)
        self.budget = budget if retain == "auto" else None
        self._parameters = list(model.parameters())
        self.first_share: Tensor | None = None
        self._watched = None  # what must not change between a snapshot and its replay: found with the first group
        self._sizes: dict[tuple[int, ...], tuple[int, int]] = {}  # of predictions, by the shape of an image
        self._shared: set[tuple[int, ...]] = set()  # of those shapes the ones that all processes know the size of
        check_replayable(model)

    def accumulate(
        self,
        pixel_values: Tensor,
        mask: Tensor,
        target: Tensor,
        valid: Tensor | None = None,
        names: Sequence[str] | None = None,
        pairs: Pairs | None = None,
    ) -> GroupStepOutput:
        """Add one group's gradient into `.grad`; every process passes the whole group.

        Args: `pixel_values` (N,3,h,w) on any device, `mask` (N,H,W) bool, `target` (N,H,W) proxies in native units,
        `valid` (N,H,W) bool or None, with (H,W) the size of the prediction; `names` of the images, for messages;
        `pairs` of `GroupInputs`, which has checked the rest where the group was loaded. The host waits for the device
        once, after the last backward.
        Raises ValueError, on all processes and with `.grad` as it was, for inconsistent shapes, non-finite
        predictions, proxies, loss or gradients, and a model that is not replayable (dropout, BatchNorm in training).
        """
        group = GroupInputs(pixel_values, mask, target, valid, names, pairs)  # pyright: ignore[reportArgumentType]
        self._check_model()
        parameters = [p for p in self._parameters if p.requires_grad]
        if not parameters:
            raise ValueError("the model has no trainable parameter: load the adapter with is_trainable=True")
        if any(p.dtype == torch.float16 for p in parameters):
            raise ValueError("fp16 parameters cannot be trained: load the base in float32")
        self._check_size(group)
        if self.micro_batch_size == "auto":
            self.choose_micro_batch_size(group)
        device = parameters[0].device
        mask, target = (part.to(device, non_blocking=True) for part in (group.mask, group.target))
        valid = None if group.valid is None else group.valid.to(device, non_blocking=True)
        cut = int(self.micro_batch_size)
        batches = [slice(i, i + cut) for i in range(0, len(mask), cut)]

        canvas = self._canvas(group, device)
        graphs: dict[int, Tensor] = {}
        with self._casts or nullcontext():
            num_retained = self._snapshot(group, batches, canvas, graphs)
            with self.phase("loss"):
                differentiate = partial(self._differentiate, canvas, target, mask, valid, group)
                loss, gradient = self._recovering(differentiate, group, graphs)
            backward = partial(self._replay, parameters, group, batches, gradient, graphs)
            facts = [num_retained, loss.total, loss.consistency, loss.distillation, are_finite(canvas)]
            values = self._add_gradients(parameters, backward, facts, group)
        kept, *terms = values[:4]
        cpu = [torch.tensor(term, dtype=canvas.dtype) for term in terms]
        return GroupStepOutput(*cpu, num_pairs=loss.num_pairs, forwards=2 * len(mask) - int(kept))

    def choose_micro_batch_size(self, group: GroupInputs, largest: int | None = None, usual: int | None = None) -> int:
        """Set and return the images per forward that memory allows, the least of all processes; at most 8 on CUDA.

        The whole of the largest group, of `largest` images (default: this one), else an even number or 1. Several
        processes take so few that a group of `usual` images (default: this one) has work for all. Measured with one
        forward of two images, or of one where two are too many. Raises torch.OutOfMemoryError, on all processes,
        where not even one fits.
        """
        budget = self.budget or GraphBudget(self.model, local_processes(self._world), self._casts)
        with self._casts or nullcontext(), torch.enable_grad():
            count = budget.measure_few(group.pixel_values, self._predict)
        canvas = self._canvas(group, "meta")[:1].expand(largest or len(group), -1, -1)
        chosen = count if count < min(2, len(group)) else budget.widen(group.pixel_values, count, canvas)
        if self._world > 1:
            chosen = int(self.accelerator.gather(torch.tensor([chosen], device=self._parameters[0].device)).min())
            chosen = min(chosen, 2 * math.ceil((usual or len(group)) / (2 * self._world)))
        if chosen == 0:
            raise torch.OutOfMemoryError("not even one image fits into memory")
        budget.reserve(group.pixel_values, count, chosen, canvas)
        self.micro_batch_size = chosen
        return chosen

    def _check_model(self) -> None:
        """A replay must repeat its snapshot. The model is walked once, what was found is looked at for every group."""
        if self._watched is None:
            self._watched = list(watched(self.model))
        for part in self._watched:
            check_watched(*part)

    def _canvas(self, group: GroupInputs, device: torch.device | str) -> Tensor:
        """Zeros where the group's predictions belong, (N,H,W)."""
        dtype = torch.promote_types(self._parameters[0].dtype, torch.float32)
        return torch.zeros(group.mask.shape, dtype=dtype, device=device)

    def _check_size(self, group: GroupInputs) -> None:
        """Raise, on all processes, if the prediction's size, where it is known, is not that of mask and target."""
        size = self._sizes.get(tuple(group.pixel_values.shape[1:]))
        if size is not None and size != tuple(group.mask.shape[1:]):
            raise ValueError(
                f"the prediction is {size[0]}x{size[1]} but mask and target are {group.mask.shape[1]}x"
                f"{group.mask.shape[2]}: resize them to the prediction's size"
            )

    def _snapshot(self, group: GroupInputs, batches: list[slice], canvas: Tensor, graphs: dict[int, Tensor]) -> Tensor:
        """Fill `canvas` (N,H,W) with all predictions, and `graphs` with this process's that kept their graph.

        Returns how many images keep theirs, over all processes: (1,), on the device.
        """
        shape = tuple(group.pixel_values.shape[1:])
        with self.phase("snapshot"):
            self._recovering(partial(self._forward, group, batches, canvas, graphs), group, graphs)
        num_retained = canvas.new_full((1,), sum(map(len, graphs.values())))
        if self._world > 1:
            with self.phase("reduce"):
                # A sum of zeros and one prediction is that prediction to the bit, NaN included.
                parts = [num_retained, canvas.flatten()]
                summed = self.accelerator.reduce(torch.cat(parts), "sum").split([len(part) for part in parts])
                num_retained = summed[0]
                canvas.copy_(summed[1].view_as(canvas))
                if shape not in self._shared:
                    self._share_size(shape, canvas)
        self._check_size(group)
        return num_retained

    def _share_size(self, shape: tuple[int, ...], canvas: Tensor) -> None:
        """What the prediction's size is for images of a shape: a process without a micro-batch has seen none."""
        own = self._sizes.get(shape, (0, 0))
        height, width = self.accelerator.gather(torch.tensor([own], device=canvas.device)).amax(0).tolist()
        self._sizes[shape] = height, width
        self._shared.add(shape)

    def _forward(self, group: GroupInputs, batches: list[slice], canvas: Tensor, graphs: dict[int, Tensor]) -> None:
        """This process's share of the predictions; `graphs` gets those that are retained."""
        pixel_values = group.pixel_values

        def store(batch: slice, prediction: Tensor) -> None:
            self._sizes[tuple(pixel_values.shape[1:])] = prediction.shape[-2], prediction.shape[-1]
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
        self, canvas: Tensor, target: Tensor, mask: Tensor, valid: Tensor | None, group: GroupInputs
    ) -> tuple[GiftLoss, Tensor]:
        """The group's loss, detached, and its gradient with respect to the (N,H,W) snapshots."""
        with torch.enable_grad():
            leaf = canvas.detach().requires_grad_()
            loss = gift_terms(leaf, target, mask, group.pairs, self.lambda_c, self.lambda_d, valid)
            if self.first_share is None:
                terms = (self.lambda_c * loss.consistency, self.lambda_d * loss.distillation)
                pulls = [torch.autograd.grad(term, leaf, retain_graph=True)[0].abs().sum() for term in terms]
                self.first_share = pulls[1] / (pulls[0] + pulls[1]).clamp(min=torch.finfo(leaf.dtype).tiny)
            (gradient,) = torch.autograd.grad(loss.total, leaf)
        terms = loss.total.detach(), loss.consistency.detach(), loss.distillation.detach()
        return GiftLoss(*terms, loss.num_pairs), gradient

    def _replay(
        self,
        parameters: list[nn.Parameter],
        group: GroupInputs,
        batches: list[slice],
        gradient: Tensor,
        graphs: dict[int, Tensor],
    ) -> None:
        """Backpropagate in micro-batch order, whatever was retained: sums of floats depend on their order."""

        def backward() -> None:
            for p in parameters:
                p.grad = None
            for index in self._mine(batches):
                kept = index in graphs
                prediction = graphs.pop(index) if kept else self._predict(group.pixel_values[batches[index]])
                prediction.backward(gradient[batches[index]].to(prediction.dtype))
                del prediction  # before the next forward, not after

        with self.phase("replay"), torch.enable_grad():
            self._recovering(backward, group, graphs)

    def _recovering(self, attempt: Callable[[], Result], group: GroupInputs, graphs: dict[int, Tensor]) -> Result:
        """`attempt()`; when memory runs out while `graphs` are kept, drop them, halve the budget, and once more.

        Between exchanges with other processes, so each recovers on its own; the others wait for it.
        """
        while True:
            try:
                return attempt()
            except RuntimeError as error:
                num_images = sum(map(len, graphs.values()))
                if self.budget is None or not num_images or not is_out_of_memory(error):
                    raise
            # Outside of `except` the error is gone, and with it the frames whose tensors still took memory.
            graphs.clear()
            self.budget.halve(group.pixel_values, self._canvas(group, "meta"), num_images)
            release_memory(self._parameters[0].device)

    def _add_gradients(
        self, parameters: list[nn.Parameter], backward: Callable[[], None], facts: list[Tensor], group: GroupInputs
    ) -> list[float]:
        """Run `backward` on empty gradients, sum them over the processes, and add them to what was there.

        Only this group's part is summed: what `.grad` already holds is equal on all processes. Returns the `facts` as
        numbers, which this is the one place to wait for. ValueError, with `.grad` as it was, if they say that the
        predictions, the loss or the gradients are not finite.
        """
        previous = [p.grad for p in parameters]
        for p in parameters:
            p.grad = None
        try:
            backward()
            present = None
            if self._world > 1:
                with self.phase("reduce"):
                    present = self._sum_over_processes(parameters)
            gradients = [p.grad for p in parameters if p.grad is not None]
            norm = torch.nn.utils.get_total_norm(gradients, math.inf) if gradients else facts[0]
            everything = [*facts, norm] if present is None else [*facts, norm, present]
            values = torch.cat([fact.reshape(-1).to(facts[1].dtype) for fact in everything]).tolist()
            norm, has_gradient = values[4 + len(group)], values[5 + len(group) :]
            group.check_results(values[4 : 4 + len(group)], values[1], norm)
            for p, there in zip(parameters, has_gradient, strict=False):
                p.grad = p.grad if there else None
        except BaseException:
            for p, old in zip(parameters, previous, strict=True):
                p.grad = old
            raise
        for p, old in zip(parameters, previous, strict=True):
            if old is not None:
                p.grad = old if p.grad is None else old.add_(p.grad)
        return values

    def _sum_over_processes(self, parameters: list[nn.Parameter]) -> Tensor:
        """One reduce for all gradients; returns (P,) how many processes have one for each parameter."""
        flags = [float(p.grad is not None) for p in parameters]
        has_gradient = torch.tensor(flags, dtype=parameters[0].dtype).to(parameters[0].device, non_blocking=True)
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([has_gradient, *(g.flatten() for g in gradients)])
        has_gradient, *gradients = self.accelerator.reduce(flat, "sum").split(
            [len(parameters), *(p.numel() for p in parameters)]
        )
        for p, gradient in zip(parameters, gradients, strict=True):
            p.grad = gradient.view_as(p).to(p.dtype, copy=True)
        return has_gradient

    def _mine(self, batches: list[slice]) -> range:
        return range(self._rank, len(batches), self._world)

    def _predict(self, pixel_values: Tensor) -> Tensor:
        """(B,H,W) of one micro-batch, in a context of its own.

        Autocast's weight cache is off: a cast made under no_grad would be reused by the replay and lose its gradient.
        Inputs need no gradient, so that layers before the first trainable one keep nothing for the backward.
        """
        device, shape = self._parameters[0].device, tuple(pixel_values.shape[1:])
        enabled = self.mixed_precision == "bf16"
        try:
            with torch.autocast(device.type, dtype=torch.bfloat16, enabled=enabled, cache_enabled=False):
                output = self.model(pixel_values=pixel_values.to(device, non_blocking=True))
        except RuntimeError as error:
            # Smaller than a patch, not square ...: models say so in terms of their tensors.
            if shape in self._sizes or is_out_of_memory(error) or not re.search(r"\b(shape|size)s?\b", str(error)):
                raise
            sides, why = f"{shape[1]}x{shape[2]}", str(error).splitlines()[0]
            raise ValueError(f"the model does not take images of {sides} (height x width): {why}") from error
        prediction = output if isinstance(output, Tensor) else output.predicted_depth
        if prediction.ndim != 3 or len(prediction) != len(pixel_values):
            raise ValueError(f"the model must predict ({len(pixel_values)},H,W), got {tuple(prediction.shape)}")
        return prediction
