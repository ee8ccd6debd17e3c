"""Checkpoints: complete or absent, and enough to go on to the bit.

A `checkpoint-<step>` is an adapter folder of its own plus the optimizer, the RNG, `trainer_state.json` (progress,
metrics, the run's arguments), a copy of the best adapter so far and, last, checksums. It is written under a temporary
name, synced and renamed: a folder with its final name was complete once, and the checksums tell whether it still is.
"""

import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

import torch
from accelerate import Accelerator
from datasets import Dataset
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from tqdm import tqdm

from gift_peft.adapters.folder import ADAPTER_FILES, ADAPTER_WEIGHTS
from gift_peft.dataset.digests import DigestCache, default_digests_dir, fingerprint
from gift_peft.dataset.shares import failing_together, in_order, own_share
from gift_peft.files import jsonable, reason, remove_folder, strangers, whole_folder, write_whole
from gift_peft.models.identity import FILES, earlier_revision, teacher_revision
from gift_peft.training.arguments import FREE_TO_CHANGE, LENGTH, GiftTrainingArguments

BEST = "best"
CHECKSUMS = "checksums.json"
OPTIMIZER = "optimizer.safetensors"
RNG = "rng_state.safetensors"
STATE = "trainer_state.json"
NEEDED = {ADAPTER_WEIGHTS, OPTIMIZER, RNG, STATE}
CHECKPOINT_FILES = NEEDED | ADAPTER_FILES | {CHECKSUMS} | {f"{BEST}/{name}" for name in ADAPTER_FILES}
# Temporary names of a run: of what it replaces as a whole, of that inside a checkpoint, and of single files.
TEMPORARY = re.compile(
    r"\.+(adapter|adapter-last|checkpoint-\d+)(\.tmp)?\.(tmp|old)|\.(metrics\.jsonl|config\.yaml)\.\d+\.partial"
)


@dataclass
class State:
    """Where a run stands; all of it is in `trainer_state.json`.

    The sums are over the groups of this epoch so far; where updates take single images, over those.
    """

    step: int = 0
    rows: list[dict] = field(default_factory=list)
    best_step: int | None = None
    loss: float = 0.0
    consistency: float = 0.0
    distillation: float = 0.0
    gce: float = 0.0
    num_groups: int = 0
    num_groups_with_pair: int = 0

    def add(self, loss: float, consistency: float, distillation: float, num_pairs: int, count: int = 1) -> None:
        """Count one group; or `count` images without pairs, whose means these are."""
        self.loss += loss * count
        self.consistency += consistency * count
        self.distillation += distillation * count
        self.num_groups += count
        if num_pairs:  # GCE leaves out groups without a pair, the loss counts them as 0
            self.gce += consistency
            self.num_groups_with_pair += 1

    def close_epoch(self, epoch_steps: int, measured: dict, metric: str = "val_gce") -> bool:
        """Add a row, the means since the last one and what was measured; the sums start again.

        Returns whether its `metric` is the smallest so far, the base's apart.
        """
        epoch = self.step / epoch_steps
        row: dict = {"step": self.step, "epoch": int(epoch) if epoch.is_integer() else epoch}
        for name in ("loss", "consistency", "distillation"):
            row[name] = getattr(self, name) / self.num_groups if self.num_groups else None
            setattr(self, name, 0.0)
        row["train_gce"] = self.gce / self.num_groups_with_pair if self.num_groups_with_pair else None
        self.gce, self.num_groups, self.num_groups_with_pair = 0.0, 0, 0
        row = jsonable(row | measured)
        self.rows.append(row)
        best = self.row_of(self.best_step)
        if not self.step or row[metric] is None or (best is not None and row[metric] >= best[metric]):
            return False
        self.best_step = self.step
        return True

    def row_of(self, step: int | None) -> dict | None:
        """The row of metrics.jsonl with this step."""
        return next((row for row in self.rows if row["step"] == step), None)


def write_metrics(output: Path, rows: list[dict]) -> None:
    """metrics.jsonl, whole: a resumed run drops the rows after its checkpoint."""
    write_whole(output / "metrics.jsonl", "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows))


def write_checkpoint(
    output_dir: Path,
    state: State,
    identity: dict,
    save: Callable[[Path], None],
    model: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
) -> None:
    """`output_dir/checkpoint-<step>`, whole or not at all; `save(folder)` writes the adapter. OSError if it fails."""
    target = output_dir / f"checkpoint-{state.step}"
    with disk_errors(target), whole_folder(target, CHECKPOINT_FILES) as folder:
        save(folder)
        save_file(optimizer_tensors(model, optimizer), folder / OPTIMIZER)
        save_file(_rng_tensors(next(model.parameters()).device), folder / RNG)
        content = json.dumps({"identity": identity, **asdict(state)}, indent=1, allow_nan=False)
        (folder / STATE).write_text(content + "\n", encoding="utf-8")
        if state.best_step:
            shutil.copytree(output_dir / "adapter", folder / BEST, copy_function=_link_weights)
        sums = {f.relative_to(folder).as_posix(): _digest(f) for f in _files(folder)}
        (folder / CHECKSUMS).write_text(json.dumps(sums, indent=1) + "\n", encoding="utf-8")


def saved_identity(checkpoint: Path) -> dict:
    """The `run_identity` of the run that wrote a checkpoint; empty where `restore` will refuse it."""
    saved = json.loads((checkpoint / STATE).read_text(encoding="utf-8"))
    identity = saved.get("identity") if isinstance(saved, dict) else None
    return _with_layout(identity) if isinstance(identity, dict) else {}


def _with_layout(identity: dict) -> dict:
    """Where it is not told, the head's layout was PyTorch's own."""
    return identity | {"channels_last": bool(identity.get("channels_last"))}


def restore(
    checkpoint: Path,
    output_dir: Path,
    identity: dict,
    total_steps: int,
    model: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    accelerator: Accelerator,
) -> State:
    """Weights, optimizer, RNG, progress, metrics.jsonl and the best adapter as they were at a checkpoint.

    ValueError, with nothing changed, if the `run_identity` was another one or the step is past `total_steps`.
    """
    from peft import set_peft_model_state_dict

    saved = json.loads((checkpoint / STATE).read_text(encoding="utf-8"))
    try:
        before, state = _with_layout(saved.pop("identity")), State(**saved)
    except (KeyError, TypeError, AttributeError):
        raise ValueError(f"resume_from_checkpoint: {checkpoint} is of another version of gift-peft") from None
    if str(pinned := before.get("model_name_or_path")).startswith(FILES):  # 0.1.0 pinned files, not tensors
        base = model.get_base_model().name_or_path
        if Path(base).is_dir() and pinned == earlier_revision(base):
            before["model_name_or_path"] = identity["model_name_or_path"]
    _check_identity(before, identity)
    if state.step > total_steps:
        raise ValueError(f"resume_from_checkpoint: {checkpoint} is past the {total_steps} steps of this run")
    result = set_peft_model_state_dict(model, load_file(checkpoint / ADAPTER_WEIGHTS))
    if result.unexpected_keys:
        raise ValueError(f"{checkpoint}: the adapter does not fit this model, e.g. {result.unexpected_keys[0]}")
    load_optimizer_tensors(model, optimizer, load_file(checkpoint / OPTIMIZER))
    rng = load_file(checkpoint / RNG)
    torch.set_rng_state(rng["cpu"])
    if "cuda" in rng and accelerator.device.type == "cuda":
        torch.cuda.set_rng_state(rng["cuda"], accelerator.device)
    if accelerator.is_main_process:
        write_metrics(output_dir, state.rows)
        best = output_dir / "adapter"
        if state.best_step:
            with whole_folder(best, ADAPTER_FILES) as folder:
                shutil.copytree(checkpoint / BEST, folder, dirs_exist_ok=True)
        else:
            shutil.rmtree(best, ignore_errors=True)
    accelerator.wait_for_everyone()
    return state


def run_identity(
    args: GiftTrainingArguments, splits: Sequence[Dataset], size: tuple[int, int], accelerator: Accelerator
) -> dict:
    """What must be the same for a resumed run, under the names of the arguments. `splits`: train, then validation."""
    fixed_length = args.lr_scheduler_type == "linear" or args.eval_delay
    free = FREE_TO_CHANGE - (LENGTH if fixed_length else set())
    images = args.per_device_train_batch_size * args.gradient_accumulation_steps * accelerator.num_processes
    return {
        **{name: value for name, value in args.values().items() if name not in free},
        **({"images_per_update": images} if args.target == "surface" else {}),
        "model_name_or_path": teacher_revision(args.model_name_or_path, args.model_revision),
        "dataset_name": "-".join(_shared_fingerprint(split, accelerator) for split in splits),
        # The fingerprint does not depend on it, the order of the updates does.
        "group_order": hashlib.sha256("\n".join(splits[0]["group_id"]).encode()).hexdigest()[:32],
        "size": "x".join(map(str, size)),
        "mixed_precision": accelerator.mixed_precision,
    }


def _shared_fingerprint(split: Dataset, accelerator: Accelerator) -> str:
    """`dataset_fingerprint`; each process reads its share of the groups, the one it has made the proxies of."""
    groups, found = DigestCache(split, default_digests_dir()), []
    bar = {"desc": "reading the dataset", "unit": "group", "delay": 2, "disable": not accelerator.is_main_process}
    with failing_together(accelerator):
        for index in tqdm(own_share(len(groups), accelerator), **bar):
            found.append((index, groups.read(index)[0].content))
    return fingerprint(in_order(found, accelerator))


def _check_identity(before: dict, now: dict) -> None:
    """Raise ValueError naming the first argument of a run's identity that changed since the checkpoint.

    An argument that is younger than the checkpoint had its default.
    """
    defaults = {f.name: f.default for f in fields(GiftTrainingArguments) if f.name in now}
    before = defaults | before
    changed = {
        "model_name_or_path": "the base model's weights have",
        "dataset_name": "its images, masks or groups have",
        "group_order": "the order of the training groups has",
    }
    for name in sorted(before.keys() | now.keys()):
        if before.get(name) != now.get(name):
            what = changed.get(name, f"{before.get(name)} became {now.get(name)}, it has")
            raise ValueError(f"resume_from_checkpoint: {name}: {what} changed since the checkpoint was written")


def find_checkpoint(output_dir: Path, name: str, warn: Callable[[str], None]) -> Path | None:
    """The folder that `resume_from_checkpoint` names; for "latest" the newest complete one, telling which are broken.

    None if "latest" finds no checkpoint at all: the run was stopped before its first. ValueError if all of them or the
    named one are broken, FileNotFoundError if that does not exist.
    """
    if name != "latest":
        folder = Path(name)
        if not folder.is_dir():
            raise FileNotFoundError(f"resume_from_checkpoint: no such folder: {name}")
        if fault := checkpoint_fault(folder):
            raise ValueError(f"resume_from_checkpoint: {folder} is not a complete checkpoint: {fault}")
        return folder
    found = list_checkpoints(output_dir)
    for folder in reversed(found):
        if not (fault := checkpoint_fault(folder)):
            return folder
        warn(f"skipping {folder}, which is not complete: {fault}")
    if found:
        raise ValueError(
            f"resume_from_checkpoint: no complete checkpoint in {output_dir}; --overwrite_output_dir starts anew"
        )
    return None


def list_checkpoints(output_dir: Path) -> list[Path]:
    """The folders with a checkpoint's name, oldest step first."""
    found = [f for f in output_dir.glob("checkpoint-*") if re.fullmatch(r"checkpoint-\d+", f.name) and f.is_dir()]
    return sorted(found, key=_step)


def checkpoint_fault(folder: Path) -> str | None:
    """What is missing or damaged in a checkpoint, or None."""
    try:
        sums = json.loads((folder / CHECKSUMS).read_text(encoding="utf-8"))
        if missing := NEEDED - sums.keys():
            return f"{CHECKSUMS} does not list {min(missing)}"
        for name, digest in sums.items():
            if _digest(folder / name) != digest:
                return f"{name} is damaged"
    except FileNotFoundError as error:
        return f"{Path(error.filename).name} is missing"
    except (OSError, ValueError, AttributeError) as error:
        return reason(error)
    return None


def last_complete(output_dir: Path) -> str:
    """The newest complete checkpoint, as a clause for a message."""
    complete = [folder for folder in list_checkpoints(output_dir) if not checkpoint_fault(folder)]
    return f"the last checkpoint is {complete[-1]}" if complete else "no checkpoint had been written yet"


def prune_checkpoints(output_dir: Path, step: int, limit: int | None, keep: list[int]) -> None:
    """Delete all but the newest `limit` checkpoints up to `step`; those of the steps in `keep` neither count nor go.

    Nor do later ones, which a run has that was resumed before them: they may be damaged, and shall not push out the
    one that was just written. One in which somebody has put a file stays.
    """
    found = [f for f in list_checkpoints(output_dir) if _step(f) <= step and _step(f) not in keep]
    for folder in found[: -limit if limit else 0]:
        if not strangers(folder, CHECKPOINT_FILES):
            remove_folder(folder)


@contextmanager
def disk_errors(target: Path):
    """OSError naming `target` for what goes wrong on the disk; safetensors has an exception of its own for that."""
    try:
        yield
    except (OSError, SafetensorError) as error:
        raise OSError(f"{target} could not be written: {error}") from error


def remove_leftovers(output_dir: Path) -> None:
    """Delete what a killed run left under temporary names; what it was about to replace gets its name back.

    Other hidden files of the folder are not ours.
    """

    def leftovers() -> list[Path]:
        return [path for path in output_dir.iterdir() if TEMPORARY.fullmatch(path.name)]

    for path in leftovers():
        target = path.with_name(path.name[1 : -len(".old")])
        if path.suffix == ".old" and not target.exists():
            os.replace(path, target)
    for path in leftovers():
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def optimizer_tensors(model: torch.nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """The optimizer's state under `<parameter name>.<exp_avg|exp_avg_sq|step>`."""
    tensors = {}
    for name, parameter in model.named_parameters():
        for key, value in optimizer.state.get(parameter, {}).items():
            tensors[f"{name}.{key}"] = value.detach().contiguous()
    return tensors


def load_optimizer_tensors(model, optimizer, tensors: dict[str, torch.Tensor]) -> None:
    """The inverse of `optimizer_tensors`; ValueError if a parameter is not one of this optimizer's."""
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    number = {id(p): i for i, p in enumerate(parameters)}
    index = {name: number[id(p)] for name, p in model.named_parameters() if id(p) in number}
    state: dict[int, dict] = {}
    for key, value in tensors.items():
        name, field = key.rsplit(".", 1)
        if name not in index:
            raise ValueError(f"{OPTIMIZER}: {name} is not trained by this run")
        state.setdefault(index[name], {})[field] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def _rng_tensors(device: torch.device) -> dict[str, torch.Tensor]:
    tensors = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        tensors["cuda"] = torch.cuda.get_rng_state(device)
    return tensors


def _step(checkpoint: Path) -> int:
    return int(checkpoint.name.split("-")[1])


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def _link_weights(source: str, target: str) -> None:
    """Weights are linked, not copied (124 MiB for Depth Anything V2-Large); nothing ever writes into them again."""
    if source.endswith(".safetensors"):
        try:
            os.link(source, target)
            return
        except OSError:
            pass  # a file system without hard links
    shutil.copy2(source, target)


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
