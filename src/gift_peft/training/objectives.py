"""What an update takes and does: a group pulled to what it agrees on (the paper), or images pulled to their targets.

Both offer the loop the same: `epoch_steps`, `feed(step)` with what each update takes, `accumulate` of that, which puts
a gradient into `.grad`, and `first_look`, the base's own losses.
"""

import math
from collections.abc import Iterator
from contextlib import closing
from itertools import repeat
from typing import Any, NamedTuple

import torch
from accelerate import Accelerator
from tqdm import tqdm

from gift_peft.dataset.loader import PreparedGroups, PreparedImages, epoch_flips, epoch_order
from gift_peft.dataset.tensors import Group
from gift_peft.group_step import GroupStep
from gift_peft.losses import GeometryConsistencyError, masked_l1
from gift_peft.training.arguments import GiftTrainingArguments
from gift_peft.training.schedule import updates_after
from gift_peft.training.surface_step import PredictedDepth, SurfaceStep


class Losses(NamedTuple):
    """Of one group, or the means over `count` images; the terms before their lambdas."""

    total: float
    consistency: float
    distillation: float
    num_pairs: int
    count: int = 1


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
        self.groups, self.optimizer, self.seed = groups, optimizer, args.seed
        self.step = GroupStep(model, args.lambda_c, args.lambda_d, args.micro_batch_size, args.retain, accelerator)
        self.epoch_steps = len(groups)

    def feed(self, step: int) -> Iterator[Group]:
        """The groups of all updates after `step`, without end."""
        order = updates_after(step, len(self.groups), lambda epoch: epoch_order(len(self.groups), self.seed, epoch))
        return self.groups.take(order)

    def accumulate(self, group: Group) -> Losses:
        output = self.step.accumulate(group.pixel_values, group.mask, group.target, group.valid, group.names)
        return Losses(float(output.total), float(output.consistency), float(output.distillation), output.num_pairs)

    def named(self, group: Group) -> str:
        """What an update takes, for messages."""
        return f"group {group.group_id}"

    def first_look(self, quiet: bool) -> Iterator[Losses]:
        """The base's on each group of an epoch.

        That needs no forward: the base's predictions are the proxies, its distillation is 0.
        """
        for group in first_groups(self.groups, quiet):
            error = GeometryConsistencyError()
            consistency = error.update(group.target, group.mask, group.valid)
            consistency = consistency if error.num_groups else 0.0
            yield Losses(self.step.lambda_c * consistency, consistency, 0.0, error.num_groups)

    def __str__(self) -> str:
        """What the first update has taught about memory."""
        return "" if self.step.budget is None else str(self.step.budget)


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
        prepared, self.optimizer = accelerator.prepare(PredictedDepth(model), optimizer)
        options = (args.lambda_c, args.lambda_d, args.per_device_train_batch_size, accelerator)
        self.step = SurfaceStep(prepared, *options)
        self.batch = args.per_device_train_batch_size * args.gradient_accumulation_steps * accelerator.num_processes
        self.epoch_steps = math.ceil(len(self.images) / self.batch)

    def epoch_updates(self, epoch: int) -> list[list[tuple[int, bool]]]:
        """(image, whether it is flipped) of each update of an epoch, over all processes; the last may have fewer."""
        order = epoch_order(len(self.images), self.args.seed, epoch)
        flips = epoch_flips(len(order), self.args.seed, epoch) if self.args.flip else repeat(False)
        items = list(zip(order, flips, strict=False))
        return [items[start : start + self.batch] for start in range(0, len(items), self.batch)]

    def feed(self, step: int) -> Iterator[Share]:
        """This process's share of all updates after `step`, without end."""

        def shares() -> Iterator[tuple[list[tuple[int, bool]], int, bool]]:
            for items in updates_after(step, self.epoch_steps, self.epoch_updates):
                mine = items[self.accelerator.process_index :: self.accelerator.num_processes]
                yield mine or items[:1], len(items), not mine

        with closing(self.images.take(item for mine, _, _ in shares() for item in mine)) as images:
            for mine, count, idle in shares():
                yield Share([next(images) for _ in mine], count, idle)

    def accumulate(self, share: Share) -> Losses:
        images = share.images
        valid = None
        if any(image.valid is not None for image in images):
            everything = (torch.ones_like(image.mask) if image.valid is None else image.valid for image in images)
            valid = torch.cat(list(everything))
        tensors = [
            torch.cat([getattr(image, name) for image in images])
            for name in ("pixel_values", "mask", "surface_target")
        ]
        names = [name for image in images for name in image.names]
        output = self.step.accumulate(*tensors, valid, names, 0.0 if share.idle else 1 / share.count)
        return Losses(*output, num_pairs=0, count=share.count)

    def named(self, share: Share) -> str:
        """What an update takes of this process, for messages."""
        return f"images {', '.join(name for image in share.images for name in image.names)}"

    def first_look(self, quiet: bool) -> Iterator[Losses]:
        """The base's on each image, from the proxies as in `Consensus`."""
        for group in first_groups(self.groups, quiet):
            regions = group.mask if group.valid is None else group.mask & group.valid
            for proxy, target, region in zip(group.target, group.surface_target, regions, strict=True):
                distance = float(masked_l1(proxy, target, region)) if region.any() else 0.0
                yield Losses(self.step.lambda_c * distance, distance, 0.0, 0)

    def __str__(self) -> str:
        return ""


def first_groups(groups: PreparedGroups, quiet: bool) -> Iterator[Group]:
    """Every group once, with a bar that says so."""
    return tqdm(groups.take(range(len(groups))), "first look", len(groups), unit="group", delay=2, disable=quiet)


OBJECTIVES = {"consensus": Consensus, "surface": Surface}
