"""`gift-peft train --dry-run`: what a run would do, what is missing, and what it needs, before it takes a night.

Everything is checked that a run checks at its start, all of it and not only up to the first mistake. Then the largest
group is trained on once, without keeping anything: time and memory of the whole run are estimated from that.
"""

import math
import os
import re
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import datasets
import psutil
import torch
from accelerate import Accelerator

from gift_peft.adapters.recipes import GiftRecipe
from gift_peft.dataset.gift_i import gift_i_splits, load_gift_i
from gift_peft.dataset.proxies import default_proxies_dir
from gift_peft.dataset.rows import parsed
from gift_peft.dataset.tensors import Group, collate_group
from gift_peft.files import existing_folder
from gift_peft.group_step import GroupStep
from gift_peft.models.identity import teacher_id
from gift_peft.models.loading import DepthModel, load_base
from gift_peft.models.pixels import resolve_size
from gift_peft.rules import check_pair
from gift_peft.training.arguments import GiftTrainingArguments
from gift_peft.training.loop import adapt, find_recipe
from gift_peft.training.speed import channels_last_head, tuned_for
from gift_peft.training.start import check_run, make_accelerator
from gift_peft.training.surface_step import PredictedDepth, SurfaceStep

SHOWN = 5  # problems of one kind
PAPER = "The paper made 17,650 (353 groups, 50 epochs) at 2e-05"
FEW_UPDATES = 4000  # far below the paper's
SPARE = 1.2  # of the memory that one update took: groups differ, and fragments stay


def dry_run(args: GiftTrainingArguments) -> int:
    """Print the plan; 0 if a run would start, 1 if it would fail, with the reasons. Nothing is written."""
    accelerator, problems = make_accelerator(args), []

    def attempt(function: Callable[..., Any], *given: Any) -> Any:
        """The function's result; None if it fails, which is noted."""
        try:
            return function(*given)
        except (ValueError, OSError) as error:
            problems.append(" ".join(str(error).split()))
            return None

    attempt(check_run, args, accelerator, False)
    rows = {split: attempt(load_gift_i, args.dataset_name, split) for split in attempt(_splits, args) or ()}
    loaded = attempt(load_base, args.model_name_or_path, args.model_revision)
    fitted = None if loaded is None else attempt(_fit_base, args, *loaded)
    counts = {split: _counts(found) for split, found in rows.items() if found is not None}
    for split, images in counts.items():
        print(f"{split}: {len(images)} groups, {sum(images.values())} images, {_range(images.values())} a group")
    if args.target == "consensus":
        _check_pairs(counts.get("train", {}), problems)
    if "train" in counts and fitted is not None:
        (recipe, size), (base, processor) = fitted, loaded
        measured = attempt(_measure, args, rows["train"], counts["train"], base, processor, recipe, size, accelerator)
        if measured is not None:
            problems += _tell(args, counts, size, measured)
    for problem in problems:
        print(f"A run would fail: {problem}")
    print("Nothing was written." if problems else "A run would start. Nothing was written.")
    return 1 if problems else 0


def _splits(args: GiftTrainingArguments) -> list[str]:
    splits = gift_i_splits(args.dataset_name)
    if "train" not in splits:
        raise ValueError(f"dataset_name: {args.dataset_name} has no train split")
    return splits


def _fit_base(args: GiftTrainingArguments, base: Any, processor: Any) -> tuple[GiftRecipe, tuple[int, int]]:
    recipe, _ = find_recipe(args, base)
    return recipe, resolve_size(args.size, recipe, processor, base.config)


def _counts(rows: datasets.Dataset) -> dict[str, int]:
    """{group: number of images}, without decoding any."""
    names = rows.select_columns(["group_id", "image_names"])
    return {row["group_id"]: len(row["image_names"]) for row in names}


def _check_pairs(counts: dict[str, int], problems: list[str]) -> None:
    alone = [group_id for group_id, count in counts.items() if count < 2]
    for group_id in alone[:SHOWN]:
        try:
            check_pair(group_id, counts[group_id])
        except ValueError as error:
            problems.append(str(error))
    if len(alone) > SHOWN:
        problems.append(f"{len(alone) - SHOWN} more groups of one image")


class Measured:
    """Of one group: seconds per image of a forward and of an update, bytes, the weights that are trained."""

    def __init__(self, forward: float, update: float, memory: int, trained: int, group: Group) -> None:
        self.forward, self.update, self.memory, self.trained, self.group = forward, update, memory, trained, group


def _measure(
    args: GiftTrainingArguments,
    rows: datasets.Dataset,
    counts: dict[str, int],
    base: Any,
    processor: Any,
    recipe: GiftRecipe,
    size: tuple[int, int],
    accelerator: Accelerator,
) -> Measured:
    """The largest group, trained on twice; the second time counts. Raises ValueError if that is too much."""
    index = max(range(len(counts)), key=list(counts.values()).__getitem__)
    print(f"Measuring group {list(counts)[index]} ...", flush=True)
    group = collate_group(parsed(rows)[index], processor, size)
    channels_last = tuned_for(accelerator.device, args.channels_last, args.head)
    try:
        network, optimizer = adapt(args, base, recipe, accelerator)
        model = DepthModel(network, processor, size)
        start = time.monotonic()
        proxies = model.predict_base(group.pixel_values)
        forward = (time.monotonic() - start) / len(proxies)
        if tuple(proxies.shape[1:]) != tuple(size):
            raise ValueError(f"the model predicts {tuple(proxies.shape[1:])} for images of {size}; they must be equal")
        step, count = _step(args, network, accelerator), len(group.names)
        if args.target == "surface":
            count = min(count, args.per_device_train_batch_size)
        tensors = [part[:count] for part in (group.pixel_values, group.mask, proxies)]
        valid = None if group.valid is None else group.valid[:count]
        for _ in range(2):
            start = time.monotonic()
            with channels_last_head(network, channels_last):
                step.accumulate(*tensors, valid, group.names[:count])
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
            update = (time.monotonic() - start) / count
    except torch.OutOfMemoryError:
        raise ValueError(
            f"out of memory with the {len(group.names)} images of group {group.group_id} at {size[0]}x{size[1]}; a "
            "smaller micro_batch_size, gradient_checkpointing, head: lora or a smaller size takes less"
        ) from None
    return Measured(
        forward,
        update,
        _peak_memory(accelerator.device),
        sum(p.numel() for p in network.parameters() if p.requires_grad),
        group,
    )


def _peak_memory(device: torch.device) -> int:
    """Bytes that this process has taken at most."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if os.name == "nt":
        return psutil.Process().memory_info().peak_wset
    import resource  # not on Windows

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _step(args: GiftTrainingArguments, network: Any, accelerator: Accelerator) -> GroupStep | SurfaceStep:
    if args.target == "surface":
        largest = args.per_device_train_batch_size
        cut = largest if args.micro_batch_size == "auto" else min(largest, int(args.micro_batch_size))
        return SurfaceStep(PredictedDepth(network), args.lambda_c, args.lambda_d, cut)
    return GroupStep(network, args.lambda_c, args.lambda_d, args.micro_batch_size, args.retain, accelerator)


# ---- what is told ----


def _tell(
    args: GiftTrainingArguments, counts: dict[str, dict[str, int]], size: tuple[int, int], measured: Measured
) -> list[str]:
    """Print the plan and its costs; returns what would make the run fail."""
    train, images = counts["train"], sum(counts["train"].values())
    validation = sum(counts.get("validation", {}).values())
    per_epoch = len(train)
    if args.target == "surface":
        per_epoch = math.ceil(images / (args.per_device_train_batch_size * args.gradient_accumulation_steps))
    updates = args.max_steps if args.max_steps > 0 else args.num_train_epochs * per_epoch
    epochs = updates / per_epoch
    missing = _missing_proxies(args, counts, size)
    copies = 2 * (1 + args.fills) if args.target == "surface" else 1
    times = {
        "the teacher's predictions": missing * copies * measured.forward,
        "updates": epochs * images * measured.update,
        "validations": max(1, epochs + 1 - args.eval_delay) * validation * measured.forward,
    }
    kept = 2 + 3 * ((args.checkpoints_total_limit or math.ceil(epochs)) + len(args.checkpoint_at_steps) + 1)
    disk = 4 * (missing * size[0] * size[1] * (3 if args.target == "surface" else 1) + kept * measured.trained)
    where = "GPU memory" if torch.cuda.is_available() else "memory"
    print(
        f"Size {size[0]}x{size[1]}, target {args.target}, {updates:,} updates over {epochs:.3g} epochs, "
        f"{measured.trained / 1e6:.2f} M weights trained (head: {args.head})"
    )
    print(f"Missing predictions of the teacher: {missing} of {images + validation} images; a run makes them first")
    parts = ", ".join(f"{what} {_duration(seconds)}" for what, seconds in times.items())
    print(f"Time on this machine as busy as it is now: {_duration(sum(times.values()))} ({parts})")
    print(f"Needed: about {SPARE * measured.memory / 2**30:.1f} GiB of {where}, {disk / 2**30:.2f} GiB of disk")
    for line in advice(args, len(train), updates, "validation" in counts):
        print(line)
    free = shutil.disk_usage(existing_folder(Path(args.output_dir))).free
    return [f"output_dir: {free / 2**30:.2f} GiB of disk are free"] if free < disk else []


def advice(args: GiftTrainingArguments, num_groups: int, updates: int, validated: bool) -> list[str]:
    """Which settings fit so many groups, and why; nothing where the given ones do."""
    lines = []
    if updates < FEW_UPDATES and args.learning_rate < 1e-4:
        epochs = math.ceil(FEW_UPDATES / max(1, updates / max(1, args.num_train_epochs)))
        lines.append(
            f"Settings: {updates:,} updates at learning rate {args.learning_rate:g} move little. {PAPER}; the demo "
            "makes 1,272 at 2e-4, falling to 0. Take --learning-rate 2e-4 --lr-scheduler-type linear "
            f"--eval-delay {args.num_train_epochs}, or --num-train-epochs {epochs}."
        )
    if num_groups < 30 and args.head == "full":
        lines.append(
            f"Settings: {num_groups} groups are few for a whole head; --head lora trains less (not measured)."
        )
    if not validated:
        lines.append("No validation groups: nothing will be measured. About one group in ten should have a reference.")
    return lines


def _missing_proxies(args: GiftTrainingArguments, counts: dict[str, dict[str, int]], size: tuple[int, int]) -> int:
    """Images of groups without a file of predictions at this size; whether those that are there hold, a run checks."""
    identity = teacher_id(args.model_name_or_path, args.model_revision)
    folder = Path(args.proxies_dir or default_proxies_dir(args.dataset_name, identity)) / identity
    suffix = ".surface" if args.target == "surface" else ""
    there = set()
    for path in folder.rglob("*.safetensors"):
        sizes = [part for part in path.relative_to(folder).parts[:-1] if re.fullmatch(r"\d+x\d+", part)]
        if sizes in ([], [f"{size[0]}x{size[1]}"]):
            there.add((path.parent.name, path.name.removesuffix(".safetensors")))
    return sum(
        count
        for split, groups in counts.items()
        for group_id, count in groups.items()
        if (split, group_id + (suffix if split == "train" else "")) not in there
    )


def _range(values) -> str:
    low, high = min(values, default=0), max(values, default=0)
    return f"{low}" if low == high else f"{low} to {high}"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
