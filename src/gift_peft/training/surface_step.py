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

from gift_peft.losses import masked_l1, require_finite, self_distillation_loss

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
        micro_batch_size: images per forward; bounds the memory, not the gradient. One process alone halves it when it
            runs out of memory. Several could not: they would wait for each other's gradients.
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
        self.model = model
        self.lambda_c = lambda_c
        self.lambda_d = lambda_d
        self.micro_batch_size = micro_batch_size
        self.accelerator: Any = accelerator
        self._world = accelerator.num_processes if accelerator else 1

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
            except torch.OutOfMemoryError:
                if self.micro_batch_size == 1 or self._world > 1:
                    raise
            # Outside of `except` the error is gone, and with it the frames whose tensors still took memory.
            self.micro_batch_size = max(1, min(self.micro_batch_size, len(mask)) // 2)
            logger.warning("out of memory: at most %d images per forward from now on", self.micro_batch_size)
            if torch.cuda.is_available():
                torch.cuda.empty_cache()

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
        device = parameters[0].device
        means = torch.zeros(3, dtype=torch.float64, device=device)  # the two terms, and whether something is wrong
        problem, loss = None, torch.zeros(())
        for start in range(0, len(mask), self.micro_batch_size):
            batch, is_last = slice(start, start + self.micro_batch_size), start + self.micro_batch_size >= len(mask)
            parts = [None if part is None else part[batch].to(device) for part in (pixel_values, mask, target, valid)]
            with nullcontext() if is_last else self._without_exchange():
                try:
                    terms = self._terms(*parts, None if names is None else names[batch])
                except ValueError as error:
                    problem = error
                    break
                means[:2] += weight * terms.detach()
                # DDP divides the sum over the processes by their number.
                loss = self._world * weight * (self.lambda_c * terms[0] + self.lambda_d * terms[1])
                if not is_last:
                    self._backward(loss)
        self._raise_everywhere(problem, means)
        self._backward(loss)
        gradients = [p.grad for p in parameters if p.grad is not None]
        if not torch.nn.utils.get_total_norm(gradients, math.inf).isfinite():
            raise ValueError("the gradient of this update has NaN or infinite values")
        consistency, distillation, _ = means.tolist()
        total = self.lambda_c * consistency + self.lambda_d * distillation
        return SurfaceStepOutput(total, consistency, distillation)

    def _terms(
        self,
        pixel_values: Tensor,
        mask: Tensor,
        target: Tensor,
        valid: Tensor | None,
        names: Sequence[str] | None,
    ) -> Tensor:
        """(2,): the sums over a micro-batch of the distance to the surface target and of the distillation."""
        prediction = self.model(pixel_values)
        if prediction.shape != mask.shape:
            made, sizes = "x".join(map(str, prediction.shape[1:])), "x".join(map(str, mask.shape[1:]))
            raise ValueError(f"the prediction is {made} but mask and target are {sizes}: resize them to its size")
        require_finite(prediction.detach(), "the prediction", names)
        require_finite(target, "the surface target", names)
        near = _without_rounding(prediction, target)
        regions = mask if valid is None else mask & valid
        terms = []
        for index, region in enumerate(regions):
            one = slice(index, index + 1)
            other = self_distillation_loss(near[one], target[one], mask[one], None if valid is None else valid[one])
            inside = masked_l1(prediction[index], target[index], region) if region.any() else torch.zeros_like(other)
            terms.append(torch.stack([inside, other]))
        return torch.stack(terms).sum(0)

    def _raise_everywhere(self, problem: ValueError | None, means: Tensor) -> None:
        """Sum `means` over the processes, in place; where one has a problem, or their loss is not finite, all raise.

        Before the last backward, in which they would wait for each other.
        """
        means[2] = float(problem is not None)
        if self._world > 1:
            means.copy_(self.accelerator.reduce(means, "sum"))
            if means[2]:
                problem = next(each for each in gather_object([problem]) if each is not None)
        if problem is not None:
            raise problem
        if not means.isfinite().all():  # differences of finite predictions overflow
            raise ValueError("the loss of this update is NaN or infinite")

    def _backward(self, loss: Tensor) -> None:
        if self.accelerator is None:
            loss.backward()
        else:
            self.accelerator.backward(loss)

    def _without_exchange(self) -> AbstractContextManager:
        """DDP sums the gradients of an update once, with its last micro-batch."""
        return nullcontext() if self.accelerator is None else self.accelerator.no_sync(self.model)


def _without_rounding(prediction: Tensor, target: Tensor) -> Tensor:
    """The prediction (n,H,W), but the target itself where they differ by what another cut into batches changes.

    The sign of such a difference is noise, and an adapter at its start would get a whole gradient of it outside of
    the mask. Up to 2^-18 of the image's largest |target| count as none; in float64 2^-46.
    """
    limit = target.abs().amax((1, 2), keepdim=True) * 2.0 ** (-46 if prediction.dtype == torch.float64 else -18)
    return torch.where((prediction - target).abs() <= limit, target.to(prediction.dtype), prediction)
