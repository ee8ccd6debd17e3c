"""A GIFT run from arguments to adapter (paper section 4, implementation details): the loop, top to bottom.

Frozen model -> proxies -> adapter with the paper's trainable parts -> one Adam update per group of images, the groups
shuffled once per epoch -> validation after every epoch (from `eval_delay` on) -> the adapter with the smallest
validation GCE.
"""

import hashlib
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace

import torch
from accelerate import Accelerator
from accelerate.utils import broadcast_object_list, set_seed

from gift_peft.adapters.folder import save_adapter
from gift_peft.adapters.recipes import GiftRecipe, get_gift_model, get_recipe
from gift_peft.dataset.cache import default_cache_dir
from gift_peft.dataset.gift_i import dataset_fingerprint, gift_i_splits, load_gift_i, proxies_command
from gift_peft.dataset.loader import PreparedGroups, epoch_order
from gift_peft.dataset.tensors import Group
from gift_peft.evaluation.booster_scenes import find_booster
from gift_peft.evaluation.table_formats import number
from gift_peft.evaluation.tables import relative_change
from gift_peft.files import jsonable, whole_folder
from gift_peft.group_step import GroupStep
from gift_peft.models.identity import teacher_revision
from gift_peft.models.loading import load_base
from gift_peft.models.pixels import resolve_size
from gift_peft.reports.model_card import model_card
from gift_peft.training import checkpoints, upload, validation
from gift_peft.training.arguments import FREE_TO_CHANGE, LENGTH, GiftTrainingArguments
from gift_peft.training.checkpoints import State, write_metrics
from gift_peft.training.profiling import profile_updates
from gift_peft.training.progress import Progress
from gift_peft.training.speed import checkpoint_blocks, compile_blocks, make_adam, use_channels_last
from gift_peft.training.start import (
    Interrupted,
    check_run,
    claim_folder,
    make_accelerator,
    stop_signals,
    tell_lost_processes,
)
from gift_peft.training.teacher import make_proxies


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


def train(args: GiftTrainingArguments) -> TrainResult:
    """Run, or go on with, a training; see `GiftTrainingArguments`.

    Raises ValueError, FileNotFoundError or OSError with one line that names the argument, file or group. A NaN stops
    the run with the group's name, a process that has died with ConnectionError in the others; the last checkpoint
    stays good.
    """
    accelerator = make_accelerator(args)
    with tell_lost_processes(accelerator, Path(args.output_dir)):
        return _train(args, accelerator)


def _train(args: GiftTrainingArguments, accelerator: Accelerator) -> TrainResult:
    output, checkpoint = check_run(args, accelerator)
    run = Run(args, output, accelerator)
    if args.profile:
        accelerator.print(profile_updates(run, args.profile))
        return TrainResult(output, 0, [], None)
    state = run.restore(checkpoint) if checkpoint else State()
    claim_folder(args, accelerator, fresh=checkpoint is None)
    if args.report_to != "none":
        accelerator.init_trackers("gift-peft", {k: str(v) for k, v in asdict(args).items()})
    progress = Progress(run.total_steps, state.step, accelerator.is_main_process)
    progress.say(run.describe(state, checkpoint))
    feed = run.groups_from(state.step)
    first = state.step + 1
    try:
        with stop_signals() as stop:
            while not (signum := run.agree(stop.signum)):
                if run.row_is_due(state):
                    try:
                        run.finish_epoch(state, stop)
                    except Interrupted:  # a resumed run begins with this row
                        continue
                    progress.row(state.rows[-1], run.total_steps / run.epoch_steps)
                if state.step >= run.total_steps:
                    break
                progress.step(*run.update(next(feed), state))
                if state.step == first and run.group_step.budget is not None:
                    progress.say(str(run.group_step.budget))
            if signum:
                run.save_checkpoint(state)
    finally:
        feed.close()
        progress.close()
    if signum:
        progress.say(_how_to_resume(output, state.step))
    else:
        run.finish(state)
    accelerator.end_training()
    return TrainResult(output, state.step, state.rows, state.best_step, signum or None)


class Run:
    """The parts of one run: data with proxies, the model with its adapter, optimizer, group step."""

    def __init__(self, args: GiftTrainingArguments, output: Path, accelerator: Accelerator) -> None:
        self.args, self.output, self.accelerator = args, output, accelerator
        if args.booster_root is not None:
            find_booster(args.booster_root)  # what is wrong with it is said before the proxies are made
        # Float32 weights whatever the checkpoint's: bf16 is autocast's business (paper, implementation details).
        base, self.processor = load_base(args.model_name_or_path, args.model_revision)
        self.recipe, self.kind = _recipe(args, base)
        self.model_type = base.config.model_type
        self.size = resolve_size(args.size, self.recipe, self.processor, base.config)
        self.train_groups, self.validation_groups = self._data()
        self.epoch_steps = len(self.train_groups)
        self.total_steps = args.max_steps if args.max_steps > 0 else args.num_train_epochs * self.epoch_steps
        self.identity = self._identity()

        set_seed(args.seed)  # the same on every process, so that the adapters start equal
        model = get_gift_model(base, rank=args.lora_rank, head=args.head, recipe=self.recipe)
        # No DDP: GroupStep sums the gradients of a group over the processes itself, and autocasts itself, so that
        # validation and the proxies stay in float32. Eval mode: a replay must repeat its snapshot.
        self.model = model.to(accelerator.device).eval()
        if args.gradient_checkpointing:
            checkpoint_blocks(model)
        if args.channels_last:
            use_channels_last(model)
        if args.compile:
            compile_blocks(model)
        self.optimizer = make_adam(
            [p for p in model.parameters() if p.requires_grad],
            args.learning_rate,
            betas=(args.adam_beta1, args.adam_beta2),
            eps=args.adam_epsilon,
            weight_decay=args.weight_decay,
        )
        self.group_step = GroupStep(
            self.model,
            args.lambda_c,
            args.lambda_d,
            args.micro_batch_size,
            args.retain,
            accelerator,
            args.snapshot_micro_batch_size,
        )

    def _data(self) -> tuple[PreparedGroups, PreparedGroups | None]:
        """Train and, where there is one, validation groups with their proxies, which are made if missing."""
        args = self.args
        splits = gift_i_splits(args.dataset_name)
        if "train" not in splits:
            raise ValueError(f"dataset_name: {args.dataset_name} has no train split")
        places = {"proxies_dir": args.proxies_dir, "revision": args.model_revision, "size": self.size}
        try:
            make_proxies(args.model_name_or_path, args.dataset_name, accelerator=self.accelerator, **places)
        except PermissionError as error:
            size = "x".join(map(str, self.size))
            options = (size, args.proxies_dir, args.model_revision)
            command = proxies_command(args.model_name_or_path, args.dataset_name, *options)
            raise PermissionError(f"proxies are missing and {error.filename} cannot be written: `{command}`") from None
        cache_dir = Path(args.group_cache_dir) if args.group_cache_dir else default_cache_dir()
        groups = {}
        for split in ("train", "validation"):
            if split in splits:
                rows = load_gift_i(args.dataset_name, split, teacher=args.model_name_or_path, **places)
                threads = args.dataloader_num_workers
                groups[split] = PreparedGroups(rows, self.processor, self.size, threads, cache_dir)
        return groups["train"], groups.get("validation")

    def _identity(self) -> dict:
        """What must be the same for a resumed run, under the names of the arguments."""
        args = self.args
        fixed_length = args.lr_scheduler_type == "linear" or args.eval_delay
        free = FREE_TO_CHANGE - (LENGTH if fixed_length else set())
        identity = {k: v for k, v in asdict(args).items() if k not in free}
        parts = [groups for groups in (self.train_groups, self.validation_groups) if groups]
        fingerprint = [None]
        if self.accelerator.is_main_process:
            fingerprint = ["-".join(dataset_fingerprint(groups.dataset) for groups in parts)]
        if args.snapshot_micro_batch_size:
            identity["retain"] = args.retain  # decides which snapshots come from larger forwards
        return identity | {
            "model_name_or_path": teacher_revision(args.model_name_or_path, args.model_revision),
            "dataset_name": broadcast_object_list(fingerprint)[0],
            # The fingerprint does not depend on it, the order of the updates does.
            "group_order": hashlib.sha256("\n".join(self.train_groups.dataset["group_id"]).encode()).hexdigest()[:32],
            "size": "x".join(map(str, self.size)),
            "mixed_precision": self.accelerator.mixed_precision,
        }

    def describe(self, state: State, checkpoint: Path | None) -> str:
        """The first line of a run."""
        trained = sum(p.numel() for p in self.model.parameters() if p.requires_grad)
        validation = len(self.validation_groups) if self.validation_groups else 0
        text = (
            f"{self.epoch_steps} train and {validation} validation groups at {self.size[0]}x{self.size[1]}, "
            f"{self.total_steps} updates of {trained / 1e6:.2f} M weights, autocast {self.accelerator.mixed_precision}"
        )
        if not validation:
            text += "\nNo validation split: adapter/ will be the last adapter, chosen by nothing."
        return text + (f"\nGoing on from {checkpoint} (step {state.step})" if checkpoint else "")

    def groups_from(self, step: int) -> Iterator[Group]:
        """The groups of all updates after `step`, prepared ahead across epochs."""

        def order() -> Iterator[int]:
            epoch, done = divmod(step, self.epoch_steps)
            while True:
                yield from epoch_order(self.epoch_steps, self.args.seed, epoch)[done:]
                epoch, done = epoch + 1, 0

        return self.train_groups.take(order())

    def agree(self, signum: int) -> int:
        """The signal to stop by, if any process has received one, on all of them."""
        if self.accelerator.num_processes == 1:
            return signum
        received = self.accelerator.gather(torch.tensor([signum], device=self.accelerator.device))
        return int(received.max())

    def update(self, group: Group, state: State) -> tuple[float, float]:
        """One Adam step on one group (Eq. 6); returns (loss, consistency)."""
        try:
            output = self.group_step.accumulate(group.pixel_values, group.mask, group.target, group.valid, group.names)
            if self.args.lr_scheduler_type == "linear":
                # from the step alone: a resumed run needs no state of a scheduler
                self.optimizer.param_groups[0]["lr"] = self.args.learning_rate * (1 - state.step / self.total_steps)
            self.optimizer.step()
            weights = [p.detach() for p in self.optimizer.param_groups[0]["params"]]
            if not torch.nn.utils.get_total_norm(weights, torch.inf).isfinite():
                raise ValueError("the update made weights NaN or infinite")
        except (ValueError, torch.OutOfMemoryError) as error:
            found = checkpoints.list_checkpoints(self.output)
            last = f"the last checkpoint is {found[-1]}" if found else "no checkpoint had been written yet"
            raise ValueError(f"step {state.step + 1}, group {group.group_id}: {error}; {last}") from error
        self.optimizer.zero_grad(set_to_none=True)
        state.step += 1
        loss, consistency, distillation = (float(value) for value in output[:3])
        state.add(loss, consistency, distillation, output.num_pairs)
        self.accelerator.log({"loss": loss, "consistency": consistency, "distillation": distillation}, step=state.step)
        if self._checkpoint_is_due(state.step) and not self.row_is_due(state):
            self.save_checkpoint(state)
        return loss, consistency

    def row_is_due(self, state: State) -> bool:
        """At the start, after every epoch and at the end, unless it was written before an interruption."""
        at = state.step % self.epoch_steps == 0 or state.step == self.total_steps
        return at and (not state.rows or state.rows[-1]["step"] != state.step)

    def finish_epoch(self, state: State, stop: SimpleNamespace) -> None:
        """Validate, write the row, keep the adapter if it is the best so far, write the checkpoint, each if it is due.

        Raises Interrupted, with `state` as it was, if a signal comes meanwhile.
        """
        measured = validation.measure(self, state, stop)
        if state.step == 0:
            validation.measure_base(self, state)
        row = state.close_epoch(self.epoch_steps) | measured
        row = {key: jsonable(value) for key, value in row.items()}
        state.rows.append(row)
        best = state.row_of(state.best_step)
        if state.step and row["val_gce"] is not None and (best is None or row["val_gce"] < best["val_gce"]):
            state.best_step = state.step
            self._save_adapter(self.output / "adapter", state)
        if self.accelerator.is_main_process:
            write_metrics(self.output, state.rows)
        self.accelerator.log(
            {k: v for k, v in row.items() if v is not None and k.startswith(("val", "train"))}, state.step
        )
        if state.step and self._checkpoint_is_due(state.step):
            self.save_checkpoint(state)

    def _checkpoint_is_due(self, step: int) -> bool:
        every = self.args.checkpointing_steps or self.epoch_steps
        return step % every == 0 or step in self.args.checkpoint_at_steps or step == self.total_steps

    def save_checkpoint(self, state: State) -> None:
        """`checkpoint-<step>/`, then delete those that are too many."""
        if self.accelerator.is_main_process:
            checkpoints.write_checkpoint(
                self.output,
                state.step,
                lambda folder: self._save_adapter(folder, state, with_card=False),
                self.model,
                self.optimizer,
                {"identity": self.identity, **asdict(state)},
                best=self.output / "adapter" if state.best_step else None,
            )
            limit, keep = self.args.checkpoints_total_limit, self.args.checkpoint_at_steps
            checkpoints.prune_checkpoints(self.output, state.step, limit, keep)
        self.accelerator.wait_for_everyone()

    def restore(self, checkpoint: Path) -> State:
        """Weights, optimizer, RNG, progress, metrics.jsonl and the best adapter as they were at a checkpoint."""
        saved = checkpoints.read_state(checkpoint)
        try:
            before, state = saved.pop("identity"), State(**saved)
        except (KeyError, TypeError, AttributeError):
            raise ValueError(f"resume_from_checkpoint: {checkpoint} is of another version of gift-peft") from None
        checkpoints.check_identity(before, self.identity)
        if state.step > self.total_steps:
            raise ValueError(f"resume_from_checkpoint: {checkpoint} is past the {self.total_steps} steps of this run")
        checkpoints.read_checkpoint(checkpoint, self.model, self.optimizer)
        if self.accelerator.is_main_process:
            write_metrics(self.output, state.rows)
            best = self.output / "adapter"
            if state.best_step:
                with whole_folder(best) as folder:
                    shutil.copytree(checkpoint / checkpoints.BEST, folder, dirs_exist_ok=True)
            else:
                shutil.rmtree(best, ignore_errors=True)
        self.accelerator.wait_for_everyone()
        return state

    def finish(self, state: State) -> None:
        """`adapter-last/`, `adapter/` where nothing could choose it, and the upload."""
        self._save_adapter(self.output / "adapter-last", state)
        if state.best_step is None:
            self._save_adapter(self.output / "adapter", state)
        if not self.accelerator.is_main_process:
            return
        adapter, row = self.output / "adapter", state.row_of(state.best_step or state.step)
        print(f"Adapter: {adapter} (step {row['step']})")
        if self.validation_groups and state.best_step is None:
            print("  In no validation group two target masks meet: it is the last adapter, chosen by nothing")
        for title, key in (
            ("validation GCE", "val_gce"),
            ("ToM RMSE", "val_tom_rmse"),
            ("Other RMSE", "val_other_rmse"),
        ):
            if row[key] is not None:
                base = state.rows[0][key]
                print(f"  {title:15}{number(base)} -> {number(row[key])} ({relative_change(base, row[key]):+.1f} %)")
        if self.args.push_to_hub:
            print(f"Uploaded: https://huggingface.co/{upload.push(adapter, self.args)}")

    def _save_adapter(self, folder: Path, state: State, with_card: bool = True) -> None:
        """The adapter as it is now, with the last row as its metrics. Only the main process writes."""
        if not self.accelerator.is_main_process:
            return
        record = upload.run_record(
            self.args,
            step=state.step,
            epoch=state.step / self.epoch_steps,
            model_type=self.model_type,
            kind=self.kind,
            size=list(self.size),
            num_groups=self.epoch_steps,
            mixed_precision=self.accelerator.mixed_precision,
            num_processes=self.accelerator.num_processes,
            base_revision=self.identity["model_name_or_path"],
            dataset_fingerprint=self.identity["dataset_name"],
            metrics={"base": state.row_of(0), "adapter": state.row_of(state.step)},
        )
        with checkpoints.disk_errors(folder):
            save_adapter(
                self.model,
                folder,
                self.args.model_name_or_path,
                self.args.model_revision,
                processor=self.processor,
                size=self.size,
                gift=record,
                card=model_card(asdict(self.args), record) if with_card else None,
            )


def _recipe(args: GiftTrainingArguments, base: torch.nn.Module) -> tuple[GiftRecipe, str]:
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


def _how_to_resume(output: Path, step: int) -> str:
    config = output / "config.yaml"
    return (
        f"Stopped after step {step}; {output}/checkpoint-{step} is complete. Go on with\n"
        f"  gift-peft train --config {shlex.quote(str(config))} --resume_from_checkpoint latest"
    )
