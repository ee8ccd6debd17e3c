"""A GIFT run from arguments to adapter (paper section 4, implementation details), top to bottom.

Check -> load the frozen model -> data with its proxies -> the objective on the paper's trainable parts -> fit: one
Adam update per group of images, the groups shuffled once per epoch, a validation after every epoch (from `eval_delay`
on) -> finish: the adapter with the smallest validation GCE. With `target: surface` an update is a batch of images.
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import set_seed
from peft import PeftModel

from gift_peft.adapters.folder import save_adapter
from gift_peft.adapters.recipes import GiftRecipe, get_gift_model, get_recipe
from gift_peft.dataset.cache import default_cache_dir
from gift_peft.dataset.gift_i import gift_i_splits, load_gift_i
from gift_peft.dataset.loader import PreparedGroups
from gift_peft.dataset.proxies import proxies_command
from gift_peft.memory import is_out_of_memory
from gift_peft.models.identity import weights_revision
from gift_peft.models.loading import DepthModel, load_base
from gift_peft.models.pixels import resolve_size
from gift_peft.reports.model_card import model_card
from gift_peft.rules import check_pair
from gift_peft.training import checkpoints, upload, validation
from gift_peft.training.arguments import GiftTrainingArguments
from gift_peft.training.checkpoints import State, write_metrics
from gift_peft.training.objectives import OBJECTIVES, Consensus, Loaded, Losses, Share, Surface
from gift_peft.training.precision import exact_output
from gift_peft.training.profiling import profile_updates
from gift_peft.training.progress import Progress, how_to_resume, summary
from gift_peft.training.schedule import Schedule
from gift_peft.training.speed import channels_last_head, checkpoint_blocks, compile_blocks, make_adam, tuned_for
from gift_peft.training.start import (
    Interrupted,
    agree,
    check_run,
    claim_folder,
    make_accelerator,
    start_tracker,
    stop_signals,
    tell_lost_processes,
)
from gift_peft.training.teacher import make_proxies, told_of_surface


@dataclass
class TrainResult:
    """What `train` leaves behind.

    Args:
        output_dir (`Path`): holds `adapter/`, `adapter-last/`, `checkpoint-*/`, `metrics.jsonl`, `config.yaml`.
        step (`int`): updates made.
        metrics (`list[dict]`): the rows of metrics.jsonl.
        best_step (`int`, *optional*): the step of `adapter/`; None without validation GCE.
        signal (`int`, *optional*): the signal that stopped the run early (a checkpoint was written).
    """

    output_dir: Path
    step: int
    metrics: list[dict]
    best_step: int | None
    signal: int | None = None


def train(
    args: GiftTrainingArguments | None = None, *, resume_command: str | None = None, **arguments: Any
) -> TrainResult:
    """Run, or go on with, a training: `train(args)`, or `train(model_name_or_path=..., dataset_name=..., ...)`.

    Args:
        args: the arguments as one object.
        resume_command (*optional*): what is told to type where a signal stops the run; default: `gift-peft train`.
        **arguments: or one by one, under the names of `GiftTrainingArguments`.

    Raises:
        TypeError: both, or an argument that does not exist.
        ValueError, FileNotFoundError, OSError: one line that names the argument, file or group. A NaN stops the run
            with the group's name; the last checkpoint stays good.
        ConnectionError: another process of the run has died.
    """
    if args is None:
        args = GiftTrainingArguments(**arguments)
    elif arguments:
        raise TypeError(f"train takes GiftTrainingArguments or single arguments, not both: {', '.join(arguments)}")
    accelerator = make_accelerator(args)
    with tell_lost_processes(accelerator, Path(args.output_dir)):
        return _train(args, accelerator, resume_command)


def _train(args: GiftTrainingArguments, accelerator: Accelerator, resume_command: str | None) -> TrainResult:
    # check: what can be known to fail fails before a model is loaded
    output, checkpoint = check_run(args, accelerator)
    before = checkpoints.saved_identity(checkpoint) if checkpoint else {}
    layout = tuned_for(accelerator.device, args.channels_last, args.head)
    if args.channels_last is None and before:  # unless asked, a run keeps what it began with
        layout = before["channels_last"]
    args = replace(args, channels_last=layout)

    # load: float32 weights whatever the checkpoint's, bf16 is autocast's business (paper, implementation details)
    base, processor = load_base(args.model_name_or_path, args.model_revision)
    recipe, kind = find_recipe(args, base)
    size = resolve_size(args.size, recipe, processor, base.config)

    # data
    teacher = DepthModel(base.to(accelerator.device), processor, size, kind)
    groups = _groups(args, teacher, accelerator)
    train_groups, validation_groups = groups["train"], groups.get("validation")
    identity = checkpoints.run_identity(args, [part.dataset for part in groups.values()], size, accelerator)

    # objective
    network, optimizer = adapt(args, base, recipe, accelerator)
    objective = OBJECTIVES[args.target](args, train_groups, network, optimizer, accelerator)
    settled = objective.settle(before)
    args, identity = replace(args, **settled), identity | {k: v for k, v in settled.items() if k in identity}
    optimizer, schedule = objective.optimizer, Schedule(args, objective.epoch_steps)
    if args.profile:
        with closing(objective.feed(0)) as feed:
            inputs = (group.inputs for group in feed)
            with channels_last_head(network, bool(args.channels_last)):
                accelerator.print(profile_updates(args.profile, objective.step, optimizer, train_groups, inputs))
        return TrainResult(output, 0, [], None)

    # fit
    state = State()
    if checkpoint:
        state = checkpoints.restore(
            checkpoint, output, identity, schedule.total_steps, network, optimizer, accelerator
        )
    claim_folder(args, accelerator, fresh=checkpoint is None)
    start_tracker(args, accelerator)
    trained = sum(p.numel() for p in network.parameters() if p.requires_grad)
    accelerator.print(
        f"{len(train_groups)} train and {len(validation_groups or ())} validation groups at {size[0]}x{size[1]}, "
        f"{schedule.total_steps} updates of {trained / 1e6:.2f} M weights, autocast {accelerator.mixed_precision}"
    )
    if settled:
        accelerator.print(f"Micro-batches of {args.micro_batch_size} images, by memory (micro_batch_size: auto)")
    if validation_groups is None:
        accelerator.print("No validation split: adapter/ will be the last adapter, not the best of several.")
    if checkpoint:
        accelerator.print(f"Going on from {checkpoint} (step {state.step})")
    about = {
        "model_type": base.config.model_type,
        "kind": kind,
        "size": list(size),
        "num_groups": len(train_groups),
        "mixed_precision": accelerator.mixed_precision,
        "num_processes": accelerator.num_processes,
        "base_revision": identity["model_name_or_path"],
        "base_weights": weights_revision(args.model_name_or_path, args.model_revision),
        "dataset_fingerprint": identity["dataset_name"],
    }
    save = partial(_save_adapter, args, network, processor, about, schedule.epoch_steps)

    def save_checkpoint() -> None:
        """`checkpoint-<step>/`, then delete those that are too many."""
        if accelerator.is_main_process:
            save_files = partial(save, state=state, with_card=False)
            checkpoints.write_checkpoint(output, state, identity, save_files, network, optimizer)
            checkpoints.prune_checkpoints(output, state.step, args.checkpoints_total_limit, args.checkpoint_at_steps)
        accelerator.wait_for_everyone()

    model, metric = DepthModel(network, processor, size, kind), f"val_{args.metric_for_best_model}"
    measure = partial(validation.measure, model, validation_groups, args.booster_root, accelerator, metric)
    signum = _fit(state, schedule, objective, accelerator, measure, save, save_checkpoint, output)

    # finish
    if signum:
        accelerator.print(how_to_resume(output, state.step, resume_command))
    elif accelerator.is_main_process:
        _finish(args, output, state, save, validated=validation_groups is not None)
    accelerator.end_training()
    return TrainResult(output, state.step, state.rows, state.best_step, signum or None)


def find_recipe(args: GiftTrainingArguments, base: torch.nn.Module) -> tuple[GiftRecipe, str]:
    """(recipe, what the model predicts): the one the arguments spell out, else the one for the model's type."""
    spelled = None
    if args.target_modules:
        spelled = GiftRecipe(args.target_modules, args.modules_to_save, args.prediction_kind)
    try:
        recipe = get_recipe(base, spelled)
        return recipe, recipe.kind_for(base.config)
    except ValueError as error:
        names = "target_modules, modules_to_save and prediction_kind"
        raise ValueError(f"model_name_or_path: {error} (as arguments: {names})") from None


def _groups(args: GiftTrainingArguments, teacher: DepthModel, accelerator: Accelerator) -> dict[str, PreparedGroups]:
    """`train` and, where there is one, `validation`, with their proxies, which `teacher` makes if missing."""
    size = teacher.size
    splits = gift_i_splits(args.dataset_name)
    if "train" not in splits:
        raise ValueError(f"dataset_name: {args.dataset_name} has no train split")
    places = {"proxies_dir": args.proxies_dir, "revision": args.model_revision, "size": size}
    surface = args.surface_settings() if args.target == "surface" else None
    try:
        make = partial(make_proxies, args.model_name_or_path, args.dataset_name, accelerator=accelerator, **places)
        make = partial(make, model=teacher)
        if surface is None:
            make(splits)
        else:  # with the surface targets of a split its proxies are made too
            if "validation" in splits:
                make(["validation"])
            surface_folder = make(["train"], surface=surface, kind=args.prediction_kind)
    except PermissionError as error:
        options = ("x".join(map(str, size)), args.proxies_dir, args.model_revision, surface)
        command = proxies_command(args.model_name_or_path, args.dataset_name, *options)
        raise PermissionError(f"proxies are missing and {error.filename} cannot be written: `{command}`") from None
    cache_dir = Path(args.group_cache_dir) if args.group_cache_dir else default_cache_dir()
    groups = {}
    for split in ("train", "validation"):
        if split in splits:
            asked = {"surface": surface if split == "train" else None, **places}
            rows = load_gift_i(args.dataset_name, split, teacher=args.model_name_or_path, **asked)
            if split == "train" and surface is None:
                for group_id, names in zip(rows["group_id"], rows["image_names"], strict=True):
                    check_pair(group_id, len(names))
            if split == "train" and surface is not None:
                told = told_of_surface(surface_folder, split, rows["group_id"])
                accelerator.print(
                    "\n".join(["Surface targets of the training groups", *(f"  {line}" for line in told)])
                )
            options = (args.dataloader_num_workers, cache_dir, accelerator.device.type == "cuda")
            groups[split] = PreparedGroups(rows, teacher.processor, size, *options)
    return groups


def adapt(
    args: GiftTrainingArguments, base: torch.nn.Module, recipe: GiftRecipe, accelerator: Accelerator
) -> tuple[PeftModel, torch.optim.Adam]:
    """The base with a fresh adapter, and its optimizer."""
    set_seed(args.seed)  # the same on every process, so that the adapters start equal
    model = get_gift_model(base, rank=args.lora_rank, head=args.head, recipe=recipe)
    model = model.to(accelerator.device).eval()  # eval mode: a replay must repeat its snapshot
    exact_output(model)
    if args.gradient_checkpointing:
        checkpoint_blocks(model)
    if args.compile:
        compile_blocks(model)
    optimizer = make_adam(
        [p for p in model.parameters() if p.requires_grad],
        args.learning_rate,
        betas=(args.adam_beta1, args.adam_beta2),
        eps=args.adam_epsilon,
        weight_decay=args.weight_decay,
    )
    return model, optimizer


def _fit(
    state: State,
    schedule: Schedule,
    objective: Consensus | Surface,
    accelerator: Accelerator,
    measure: Callable[[bool, Callable[[], int]], dict],
    save: Callable[[Path, State], None],
    save_checkpoint: Callable[[], None],
    output: Path,
) -> int:
    """Update after update up to the last one or a signal, which is returned (else 0); `state` moves along."""
    first, is_main = state.step + 1, accelerator.is_main_process
    with (
        closing(Progress(schedule.total_steps, state.step, is_main, objective.unit, objective.term)) as progress,
        closing(objective.feed(state.step)) as feed,
        stop_signals() as stop,
    ):
        while not (signum := agree(stop.signum, accelerator)):
            if schedule.row_is_due(state):
                if state.step == 0 and not state.num_groups:  # before a validation: masks that cannot teach are told
                    for losses in objective.first_look(not is_main):
                        state.add(*losses)
                try:
                    measured = measure(schedule.validation_is_due(state.step), lambda: stop.signum)
                except Interrupted:  # a resumed run begins with this row
                    continue
                metric = f"val_{schedule.args.metric_for_best_model}"
                is_best = state.close_epoch(schedule.epoch_steps, measured, metric)
                if is_main:
                    if is_best:
                        save(output / "adapter", state)
                    write_metrics(output, state.rows)
                logged = {k: v for k, v in state.rows[-1].items() if v is not None and k.startswith(("val", "train"))}
                accelerator.log(logged, state.step)
                if schedule.checkpoint_is_due(state.step):
                    save_checkpoint()
                progress.row(state.rows[-1], schedule.total_steps / schedule.epoch_steps)
            if state.step >= schedule.total_steps:
                break
            objective.optimizer.param_groups[0]["lr"] = schedule.learning_rate(state.step)
            item = next(feed)
            try:
                losses = _update(objective, item, accelerator, schedule.args.max_grad_norm)
            except (ValueError, RuntimeError) as error:
                if not isinstance(error, ValueError) and not is_out_of_memory(error):
                    raise
                last = checkpoints.last_complete(output)
                raise ValueError(f"step {state.step + 1}, {objective.named(item)}: {error}; {last}") from error
            state.step += 1
            state.add(*losses)
            logged = {"loss": losses.total, "consistency": losses.consistency, "distillation": losses.distillation}
            accelerator.log(logged, step=state.step)
            if schedule.checkpoint_is_due(state.step) and not schedule.row_is_due(state):
                save_checkpoint()
            progress.step(losses.total, losses.consistency)
            if state.step == first and (note := objective.first_note(fresh=first == 1)):
                progress.say(note)
        if signum:
            save_checkpoint()
    return signum


def _update(
    objective: Consensus | Surface, item: Loaded | Share, accelerator: Accelerator, max_grad_norm: float
) -> Losses:
    """One Adam step on what an update takes."""
    optimizer = objective.optimizer
    losses = objective.accumulate(item)
    weights = optimizer.param_groups[0]["params"]
    if max_grad_norm:
        accelerator.clip_grad_norm_(weights, max_grad_norm)
    optimizer.step()
    if not torch.nn.utils.get_total_norm([p.detach() for p in weights], torch.inf).isfinite():
        raise ValueError("the update made weights NaN or infinite")
    optimizer.zero_grad(set_to_none=True)
    return losses


def _save_adapter(
    args: GiftTrainingArguments,
    model: PeftModel,
    processor: Any,
    about: dict,
    epoch_steps: int,
    folder: Path,
    state: State,
    with_card: bool = True,
) -> None:
    """The adapter as it is now, with the last row as its metrics."""
    record = upload.run_record(
        args,
        next(model.parameters()).device,
        step=state.step,
        epoch=state.step / epoch_steps,
        **about,
        metrics={"base": state.row_of(0), "adapter": state.row_of(state.step)},
    )
    with checkpoints.disk_errors(folder):
        save_adapter(
            model,
            folder,
            args.model_name_or_path,
            args.model_revision,
            processor=processor,
            size=tuple(about["size"]),
            gift=record,
            card=model_card(args.values(), record) if with_card else None,
        )


def _finish(
    args: GiftTrainingArguments, output: Path, state: State, save: Callable[[Path, State], None], validated: bool
) -> None:
    """`adapter-last/`, `adapter/` where nothing could choose it, the figures before and after, and the upload."""
    adapter = output / "adapter"
    save(output / "adapter-last", state)
    if state.best_step is None:
        save(adapter, state)
    print(summary(adapter, state.rows, state.best_step, validated, args.metric_for_best_model))
    if args.push_to_hub:
        print(f"Uploaded: https://huggingface.co/{upload.push(adapter, args)}")
