"""Some images in, the gradient of their mean loss out: surface targets, beyond the paper (surface_targets.py).

The loss of an image, `lambda_c * masked_l1(prediction, surface target, target region) + lambda_d * distillation`, asks
for no other image: micro-batches need no replay, batches mix groups, and the processes of a run need nothing but the
mean of their gradients, which DistributedDataParallel takes.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from accelerate.utils import gather_object
from torch import Tensor, nn

from gift_peft.group_inputs import check_lambdas
from gift_peft.losses import are_finite, image_terms, name_infinite
from gift_peft.memory import GraphBudget, is_out_of_memory, local_processes, micro_batch_for, release_memory

if TYPE_CHECKING:
    from accelerate import Accelerator

logger = logging.getLogger(__name__)


class SurfaceStepOutput(NamedTuple):
    """Means over the images of an update, on all processes: the terms before their lambdas, Eq. 5's factor 2 included.

    `consistency` is the distance to the surface target: what takes the place of Eq. 3.
    """

    total: float
    consistency: float
    distillation: float


class PredictedDepth(nn.Module):
    """The tensor that a model predicts, as a module of its own.

    This is what accelerate prepares: it wraps `forward` in autocast for good, and the model inside shall validate in
    float32.
    """

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixel_values: Tensor) -> Tensor:
        output = self.model(pixel_values=pixel_values)
        return output if isinstance(output, Tensor) else output.predicted_depth


class SurfaceStep:
    """Puts the gradient of the mean loss of some images into `.grad`, micro-batch by micro-batch.

    Args:
        model: `PredictedDepth`, as it is or as `accelerator.prepare` gives it; modes and dtypes are left alone.
        lambda_c, lambda_d: weights of the distance to the surface target and of the distillation.
        micro_batch_size: images per forward; bounds the memory, not the gradient. `choose_micro_batch_size` measures
            it. One process alone halves it when it still runs out of memory. Several could not: they would wait for
            each other's gradients.
        accelerator: its processes share each update. Without one, this process alone.
    """

    def __init__(
        self,
        model: nn.Module,
        lambda_c: float = 1.5,
        lambda_d: float = 1.0,
        micro_batch_size: int = 4,
        accelerator: Accelerator | None = None,
    ) -> None:
        check_lambdas(lambda_c=lambda_c, lambda_d=lambda_d)
        self.model = model
        self.lambda_c = lambda_c
        self.lambda_d = lambda_d
        self.micro_batch_size = micro_batch_size
        self.accelerator: Any = accelerator
        self._world = accelerator.num_processes if accelerator else 1

    def choose_micro_batch_size(self, pixel_values: Tensor, largest: int) -> int:
        """Set and return the images per forward that memory allows, the least of all processes; at most `largest`.

        Measured with one forward of two images like `pixel_values` (1,3,h,w), or of one where two are too many.
        Raises torch.OutOfMemoryError, on all processes, where not even one fits.
        """
        device = next(self.model.parameters()).device
        pixels = pixel_values.expand(min(2, largest), -1, -1, -1).to(device)
        budget = GraphBudget(self.model, local_processes(self._world))
        with torch.enable_grad(), self._without_exchange():
            count = budget.measure_few(pixels, self.model)
        canvas = torch.zeros(1, device="meta").expand(largest, *pixels.shape[-2:])
        # As on a CPU also elsewhere: no graph is kept from one forward to the next, so all of the room may go into it.
        chosen = count and min(largest, micro_batch_for(budget.images(pixels, canvas), count, largest, on_cuda=False))
        if self._world > 1:
            chosen = int(self.accelerator.gather(torch.tensor([chosen], device=device)).min())
        if chosen == 0:
            raise torch.OutOfMemoryError("not even one image fits into memory")
        self.micro_batch_size = chosen
        return chosen

    def accumulate(
        self,
        pixel_values: Tensor,
        mask: Tensor,
        target: Tensor,
        valid: Tensor | None = None,
        names: Sequence[str] | None = None,
        weight: float | None = None,
    ) -> SurfaceStepOutput:
        """Put an update's gradient into `.grad`, whatever was there; every process passes images of its own.

        Args: `pixel_values` (n,3,h,w), `mask` (n,H,W) bool, `target` (n,H,W) surface targets, which outside of the
        mask are the proxies, `valid` (n,H,W) bool or None, with (H,W) the size of the prediction; `names` of the
        images, for messages; `weight` of an image in the mean: default 1/n, for processes that share an update 1 over
        the number of all its images, and 0 for a process without a share, which takes part because the others wait.
        Raises ValueError, on all processes, for shapes that differ, non-finite predictions, targets, loss or
        gradients, and a model that trains nothing.
        """
        weight = 1 / len(mask) if weight is None else weight
        while True:
            try:
                return self._accumulate(pixel_values, mask, target, valid, names, weight)
            except RuntimeError as error:
                if self.micro_batch_size == 1 or self._world > 1 or not is_out_of_memory(error):
                    raise
            # Outside of `except` the error is gone, and with it the frames whose tensors still took memory.
            self.micro_batch_size = max(1, min(self.micro_batch_size, len(mask)) // 2)
            logger.warning("out of memory: at most %d images per forward from now on", self.micro_batch_size)
            release_memory(next(self.model.parameters()).device)

    def _accumulate(
        self,
        pixel_values: Tensor,
        mask: Tensor,
        target: Tensor,
        valid: Tensor | None,
        names: Sequence[str] | None,
        weight: float,
    ) -> SurfaceStepOutput:
        parameters = [p for p in self.model.parameters() if p.requires_grad]
        if not parameters:
            raise ValueError("the model has no trainable parameter: load the adapter with is_trainable=True")
        for p in parameters:
            p.grad = None
        device, start, finite = parameters[0].device, 0, []
        # The two terms, and whether something is wrong.
        means = torch.zeros(3, dtype=torch.promote_types(parameters[0].dtype, torch.float32), device=device)
        problem, loss = None, torch.zeros(())
        while start < len(mask):
            batch = slice(start, start + self.micro_batch_size)
            start += self.micro_batch_size
            parts = [
                None if part is None else part[batch].to(device, non_blocking=True)
                for part in (pixel_values, mask, target, valid)
            ]
            with nullcontext() if start >= len(mask) else self._without_exchange():
                try:
                    terms, flags = self._terms(*parts)
                except ValueError as error:
                    problem = error
                    break
                finite.append(flags)
                means[:2] += weight * terms.detach()
                # DDP divides the sum over the processes by their number.
                loss = self._world * weight * (self.lambda_c * terms[0] + self.lambda_d * terms[1])
                if start < len(mask):
                    self._backward(loss)
        if self._world > 1:
            self._agree(problem, means, finite, names)
        elif problem is not None:
            raise problem
        self._backward(loss)
        gradients = [p.grad for p in parameters if p.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients, math.inf)
        facts = torch.cat([means, norm.to(means)[None], *self._flat(finite)])
        # Here the host waits for the device: the only time, where no other process has to agree.
        consistency, distillation, _, norm, *flags = facts.tolist()
        self._check_finite(flags, names)
        total = self.lambda_c * consistency + self.lambda_d * distillation
        if not math.isfinite(total):  # differences of finite predictions overflow
            raise ValueError("the loss of this update is NaN or infinite")
        if not math.isfinite(norm):
            raise ValueError("the gradient of this update has NaN or infinite values")
        return SurfaceStepOutput(total, consistency, distillation)

    def _terms(
        self, pixel_values: Tensor, mask: Tensor, target: Tensor, valid: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Of a micro-batch: (2,), the sums of the distance to the surface target and of the distillation; and (2,n),
        which predictions, and which targets, are finite.
        """
        prediction = self.model(pixel_values)
        if prediction.shape != mask.shape:
            made, sizes = "x".join(map(str, prediction.shape[1:])), "x".join(map(str, mask.shape[1:]))
            raise ValueError(f"the prediction is {made} but mask and target are {sizes}: resize them to its size")
        flags = torch.stack([are_finite(prediction), are_finite(target)])
        return image_terms(prediction, target, mask, valid).sum(0), flags

    def _agree(
        self, problem: ValueError | None, means: Tensor, finite: list[Tensor], names: Sequence[str] | None
    ) -> None:
        """Sum `means` over the processes, in place; where one has a problem, all raise it.

        Before the last backward, in which they would wait for each other.
        """
        flags = self._flat(finite)
        wrong = problem is not None or (torch.cat(flags) == 0).any()
        means[2] = wrong
        means.copy_(self.accelerator.reduce(means, "sum"))
        if not means[2]:
            return
        if problem is None:
            try:
                self._check_finite(torch.cat(flags).tolist() if flags else [], names)
            except ValueError as error:
                problem = error
        raise next(each for each in gather_object([problem]) if each is not None)

    @staticmethod
    def _flat(finite: list[Tensor]) -> list[Tensor]:
        """The flags of all micro-batches, as numbers: first of the predictions, then of the targets."""
        return [flags[row].float() for row in range(2) for flags in finite]

    @staticmethod
    def _check_finite(flags: list[float], names: Sequence[str] | None) -> None:
        half = len(flags) // 2
        name_infinite(flags[:half], "the prediction", names)
        name_infinite(flags[half:], "the surface target", names)

    def _backward(self, loss: Tensor) -> None:
        if self.accelerator is None:
            loss.backward()
        else:
            self.accelerator.backward(loss)

    def _without_exchange(self) -> AbstractContextManager:
        """DDP sums the gradients of an update once, with its last micro-batch."""
        return nullcontext() if self.accelerator is None else self.accelerator.no_sync(self.model)
