"""What an update takes and does: a group pulled to what it agrees on (the paper), or images pulled to their targets.

Both offer the loop the same: `settle`, what "auto" comes to; `optimizer`, `epoch_steps`, `feed(step)` with what each
update takes, `accumulate` of that, which puts a gradient into `.grad`, and `first_look`, the base's own losses.
"""

import math
import statistics
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from functools import partial
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np
import torch
from accelerate import Accelerator
from tqdm import tqdm

from gift_peft.dataset.light import epoch_light
from gift_peft.dataset.loader import PreparedGroups, PreparedImages, epoch_flips, epoch_order, read_ahead
from gift_peft.dataset.shares import failing_together, in_order, own_share
from gift_peft.dataset.tensors import Group
from gift_peft.group_inputs import GroupInputs
from gift_peft.group_step import GroupStep
from gift_peft.losses import gift_terms, masked_l1
from gift_peft.training.arguments import GiftTrainingArguments
from gift_peft.training.mask_checks import check_surroundings, warn_of_masks
from gift_peft.training.schedule import updates_after
from gift_peft.training.speed import channels_last_head, checkpoint_blocks
from gift_peft.training.surface_step import PredictedDepth, SurfaceStep


class Losses(NamedTuple):
    """Of one group, or the means over `count` images; the terms before their lambdas."""

    total: float
    consistency: float
    distillation: float
    num_pairs: int
    count: int = 1


class Loaded(NamedTuple):
    """A group as an update takes it."""

    group_id: str
    inputs: GroupInputs


class Consensus:
    """The paper's objective (Eq. 6): an update is a group.

    No DDP: GroupStep sums the gradients of a group over the processes itself, and autocasts itself, so that
    validation and the proxies stay in float32.
    """

    unit, term = "group", "GCE"

    def __init__(
        self,
        args: GiftTrainingArguments,
        groups: PreparedGroups,
        model: Any,
        optimizer: torch.optim.Optimizer,
        accelerator: Accelerator,
    ) -> None:
        self.args, self.groups, self.optimizer, self.accelerator = args, groups, optimizer, accelerator
        self.step = GroupStep(model, args.lambda_c, args.lambda_d, args.micro_batch_size, args.retain, accelerator)
        self.epoch_steps = len(groups)

    def settle(self, before: dict) -> dict[str, Any]:
        """Arguments of this run that "auto" left open, chosen by memory; `before` the identity that it goes on with.

        A model of which not even one image fits has its blocks recomputed in the backward, which gives the same bits.
        Raises torch.OutOfMemoryError, on all processes, where that does not help.
        """
        if self.args.micro_batch_size != "auto":
            return {}

        def choose() -> int:
            sizes = [len(names) for names in self.groups.image_names]
            return self.step.choose_micro_batch_size(self._read(0).inputs, max(sizes), round(statistics.median(sizes)))

        settled = settle_micro_batch(choose, before, self.step.model, self.args, self.accelerator)
        self.step.micro_batch_size = settled["micro_batch_size"]
        return settled

    def feed(self, step: int) -> Iterator[Loaded]:
        """The groups of all updates after `step`, without end."""
        count, seed = len(self.groups), self.args.seed
        order = updates_after(step, count, lambda epoch: epoch_order(count, seed, epoch))
        return read_ahead(self._read, order, self.groups.num_threads)

    def _read(self, index: int) -> Loaded:
        """A group, checked and with its pairs found, in a thread that loads it."""
        group = self.groups[index]
        inputs = GroupInputs(group.pixel_values, group.mask, group.target, group.valid, group.names)
        return Loaded(group.group_id, inputs.pin_memory() if self.groups.pin else inputs)

    def accumulate(self, group: Loaded) -> Losses:
        with channels_last_head(self.step.model, bool(self.args.channels_last)):
            output = self.step.accumulate(*group.inputs.arguments())
        return Losses(float(output.total), float(output.consistency), float(output.distillation), output.num_pairs)

    def named(self, group: Loaded) -> str:
        """What an update takes, for messages."""
        return f"group {group.group_id}"

    def first_look(self, quiet: bool) -> list[Losses]:
        """The base's on each group of an epoch; ValueError for masks that leave nothing to distill from.

        That needs no forward: the base's predictions are the proxies, its distillation is 0.
        """

        def look(group: Loaded) -> list[Losses]:
            inputs = group.inputs
            check_surroundings(group.group_id, inputs.mask, inputs.valid)
            warn_of_masks(group.group_id, inputs)
            tensors = (inputs.target, inputs.target, inputs.mask, inputs.pairs)
            with torch.no_grad():
                loss = gift_terms(*tensors, self.args.lambda_c, self.args.lambda_d, inputs.valid)
            return [Losses(float(loss.total), float(loss.consistency), 0.0, loss.num_pairs)]

        return look_at_all(self.groups, self._read, look, self.accelerator, quiet)

    def first_note(self, fresh: bool) -> str:
        """What the first update has taught: of memory and, in a `fresh` run, of rounding; empty where nothing."""
        notes = [] if self.step.budget is None else [str(self.step.budget)]
        share = float(self.step.first_share or 0)
        if fresh and share > 0:
            notes.append(
                f"Rounding ({self.step.mixed_precision}) is {share:.0%} of the first update's pull, as distillation "
                "from proxies in float32; it shrinks once the predictions have moved"
            )
        return "\n".join(notes)


Shown = tuple[int, bool, np.ndarray | None]  # an image, whether it is flipped, and its light


class Share(NamedTuple):
    """Of an update: this process's images, and how many images it has in all; `idle` if they only stand in."""

    images: list[Group]
    count: int
    idle: bool


class Surface:
    """Beyond the paper: an update is so many images of any groups, each pulled to its surface target.

    What a process takes of an update depends on nothing but its number, so two processes with batches of 2 make the
    updates of one with a batch of 4.
    """

    unit, term = "update", "surface"

    def __init__(
        self,
        args: GiftTrainingArguments,
        groups: PreparedGroups,
        model: Any,
        optimizer: torch.optim.Optimizer,
        accelerator: Accelerator,
    ) -> None:
        self.args, self.groups, self.images, self.accelerator = args, groups, PreparedImages(groups), accelerator
        self.network = model
        prepared, self.optimizer = accelerator.prepare(PredictedDepth(model), optimizer)
        options = (args.lambda_c, args.lambda_d, args.per_device_train_batch_size, accelerator)
        self.step = SurfaceStep(prepared, *options)
        self.batch = args.per_device_train_batch_size * args.gradient_accumulation_steps * accelerator.num_processes
        self.epoch_steps = math.ceil(len(self.images) / self.batch)

    def settle(self, before: dict) -> dict[str, Any]:
        """As in `Consensus`. A forward has at most `per_device_train_batch_size` images, which may differ later on."""
        chosen, settled = self.args.micro_batch_size, {}
        if chosen == "auto":

            def choose() -> int:
                return self.step.choose_micro_batch_size(self.images.read(0).pixel_values, self.step.micro_batch_size)

            settled = settle_micro_batch(choose, before, self.network, self.args, self.accelerator)
            chosen = settled["micro_batch_size"]
        self.step.micro_batch_size = min(int(chosen), self.args.per_device_train_batch_size)
        return settled

    def epoch_updates(self, epoch: int) -> list[list[Shown]]:
        """What each update of an epoch shows, over all processes; the last may have fewer."""
        order = epoch_order(len(self.images), self.args.seed, epoch)
        count, seed, jitter = len(order), self.args.seed, self.args.color_jitter
        flips = epoch_flips(count, seed, epoch) if self.args.flip else repeat(False)
        lights = epoch_light(count, jitter, seed, epoch) if jitter else repeat(None)
        items = list(zip(order, flips, lights, strict=False))
        return [items[start : start + self.batch] for start in range(0, len(items), self.batch)]

    def feed(self, step: int) -> Iterator[Share]:
        """This process's share of all updates after `step`, without end."""

        def shares() -> Iterator[tuple[list[Shown], int, bool]]:
            for items in updates_after(step, self.epoch_steps, self.epoch_updates):
                mine = items[self.accelerator.process_index :: self.accelerator.num_processes]
                yield mine or items[:1], len(items), not mine

        with closing(self.images.take(item for mine, _, _ in shares() for item in mine)) as images:
            for mine, count, idle in shares():
                yield Share([next(images) for _ in mine], count, idle)

    def accumulate(self, share: Share) -> Losses:
        images = share.images

        def on_device(parts: Iterable[torch.Tensor]) -> torch.Tensor:
            """One after the other, since what is put together on the host would no longer be pinned."""
            return torch.cat([part.to(self.accelerator.device, non_blocking=True) for part in parts])

        valid = None
        if any(image.valid is not None for image in images):
            everything = (torch.ones_like(image.mask) if image.valid is None else image.valid for image in images)
            valid = on_device(everything)
        tensors = [
            on_device(getattr(image, name) for image in images) for name in ("pixel_values", "mask", "surface_target")
        ]
        names = [name for image in images for name in image.names]
        with channels_last_head(self.network, bool(self.args.channels_last)):
            output = self.step.accumulate(*tensors, valid, names, 0.0 if share.idle else 1 / share.count)
        return Losses(*output, num_pairs=0, count=share.count)

    def named(self, share: Share) -> str:
        """What an update takes of this process, for messages."""
        return f"images {', '.join(name for image in share.images for name in image.names)}"

    def first_look(self, quiet: bool) -> list[Losses]:
        """The base's on each image, from the proxies as in `Consensus`; a fixed target holds without surroundings."""

        def look(group: Group) -> list[Losses]:
            regions = group.mask if group.valid is None else group.mask & group.valid
            losses = []
            for proxy, target, region in zip(group.target, group.surface_target, regions, strict=True):
                distance = float(masked_l1(proxy, target, region)) if region.any() else 0.0
                losses.append(Losses(self.step.lambda_c * distance, distance, 0.0, 0))
            return losses

        return look_at_all(self.groups, self.groups.__getitem__, look, self.accelerator, quiet)

    def first_note(self, fresh: bool) -> str:
        """Nothing: what fits was measured."""
        return ""


def settle_micro_batch(
    choose: Callable[[], int], before: dict, model: Any, args: GiftTrainingArguments, accelerator: Accelerator
) -> dict[str, Any]:
    """What "auto" comes to: that of the run that wrote `before`, with which this one goes on, else what `choose` says.

    A model of which not even one image fits has its blocks recomputed in the backward, which gives the same bits.
    """
    if before:
        return {"micro_batch_size": before.get("micro_batch_size")}
    layout = partial(channels_last_head, model, bool(args.channels_last))
    try:
        with layout():
            return {"micro_batch_size": choose()}
    except torch.OutOfMemoryError:
        if args.gradient_checkpointing:
            raise
    accelerator.print(
        "The graph of one image does not fit into memory: its blocks are recomputed in the backward "
        "(gradient_checkpointing)"
    )
    checkpoint_blocks(model)
    with layout():
        return {"gradient_checkpointing": True, "micro_batch_size": choose()}


def look_at_all(
    groups: PreparedGroups,
    read: Callable[[int], Any],
    look: Callable[[Any], list[Losses]],
    accelerator: Accelerator,
    quiet: bool,
) -> list[Losses]:
    """`look` of every group once, in their order, shared by the processes; the first ValueError is raised in all."""
    mine, found = own_share(len(groups), accelerator), []
    bar = {"total": len(mine), "desc": "first look", "unit": "group", "delay": 2, "disable": quiet}
    with failing_together(accelerator):
        for index, item in zip(mine, tqdm(read_ahead(read, mine, groups.num_threads), **bar), strict=True):
            found.append((index, look(item)))
    return [losses for several in in_order(found, accelerator) for losses in several]


OBJECTIVES = {"consensus": Consensus, "surface": Surface}
