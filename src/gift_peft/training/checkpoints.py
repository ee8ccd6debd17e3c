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
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from gift_peft.files import whole_folder, write_whole

BEST = "best"
CHECKSUMS = "checksums.json"
OPTIMIZER = "optimizer.safetensors"
RNG = "rng_state.safetensors"
STATE = "trainer_state.json"
NEEDED = {"adapter_model.safetensors", OPTIMIZER, RNG, STATE}
# Temporary names of a run: of what it replaces as a whole, of that inside a checkpoint, and of single files.
TEMPORARY = re.compile(
    r"\.+(adapter|adapter-last|checkpoint-\d+)(\.tmp)?\.(tmp|old)|\.(metrics\.jsonl|config\.yaml)\.\d+\.partial"
)


def write_checkpoint(
    output_dir: Path,
    step: int,
    save: Callable[[Path], None],
    model: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    state: dict,
    best: Path | None = None,
) -> Path:
    """`output_dir/checkpoint-<step>`, whole or not at all.

    `save(folder)` writes the adapter, `state` is JSON, `best` the best adapter's folder. OSError if writing fails.
    """
    target = output_dir / f"checkpoint-{step}"
    with disk_errors(target), whole_folder(target) as folder:
        save(folder)
        save_file(optimizer_tensors(model, optimizer), folder / OPTIMIZER)
        save_file(_rng_tensors(), folder / RNG)
        (folder / STATE).write_text(json.dumps(state, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        if best is not None:
            shutil.copytree(best, folder / BEST, copy_function=_link_weights)
        sums = {str(f.relative_to(folder)): _digest(f) for f in _files(folder)}
        (folder / CHECKSUMS).write_text(json.dumps(sums, indent=1) + "\n", encoding="utf-8")
    return target


def read_checkpoint(folder: Path, model: torch.nn.Module, optimizer: torch.optim.Optimizer) -> None:
    """Put adapter weights, optimizer state and RNG back as they were; the caller reads `read_state` itself."""
    from peft import set_peft_model_state_dict

    result = set_peft_model_state_dict(model, load_file(folder / "adapter_model.safetensors"))
    if result.unexpected_keys:
        raise ValueError(f"{folder}: the adapter does not fit this model, e.g. {result.unexpected_keys[0]}")
    load_optimizer_tensors(model, optimizer, load_file(folder / OPTIMIZER))
    rng = load_file(folder / RNG)
    torch.set_rng_state(rng["cpu"])
    if "cuda" in rng and torch.cuda.is_available():
        torch.cuda.set_rng_state(rng["cuda"])


def read_state(folder: Path) -> dict:
    return json.loads((folder / STATE).read_text(encoding="utf-8"))


def check_identity(before: dict, now: dict) -> None:
    """Raise ValueError naming the first argument of a run's identity that changed since the checkpoint."""
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
        return " ".join(str(error).split())
    return None


def prune_checkpoints(output_dir: Path, step: int, limit: int | None, keep: list[int]) -> None:
    """Delete all but the newest `limit` checkpoints up to `step`; those of the steps in `keep` neither count nor go.

    Nor do later ones, which a run has that was resumed before them: they may be damaged, and shall not push out the
    one that was just written.
    """
    found = [f for f in list_checkpoints(output_dir) if _step(f) <= step and _step(f) not in keep]
    for folder in found[: -limit if limit else 0]:
        # Renamed first: a half-deleted folder must not look like a damaged checkpoint.
        gone = folder.with_name(f".{folder.name}.tmp")
        os.replace(folder, gone)
        shutil.rmtree(gone)


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


def _rng_tensors() -> dict[str, torch.Tensor]:
    tensors = {"cpu": torch.get_rng_state()}
    if torch.cuda.is_available():
        tensors["cuda"] = torch.cuda.get_rng_state()
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


@dataclass
class State:
    """Where a run stands; all of it is in `trainer_state.json`. The sums are over the groups of this epoch so far."""

    step: int = 0
    rows: list[dict] = field(default_factory=list)
    best_step: int | None = None
    loss: float = 0.0
    consistency: float = 0.0
    distillation: float = 0.0
    gce: float = 0.0
    num_groups: int = 0
    num_groups_with_pair: int = 0

    def add(self, loss: float, consistency: float, distillation: float, num_pairs: int) -> None:
        """Count one group."""
        self.loss += loss
        self.consistency += consistency
        self.distillation += distillation
        self.num_groups += 1
        if num_pairs:  # GCE leaves out groups without a pair, the loss counts them as 0
            self.gce += consistency
            self.num_groups_with_pair += 1

    def close_epoch(self, epoch_steps: int) -> dict:
        """The means since the last row, as the first half of a row; the sums start again."""
        epoch = self.step / epoch_steps
        row: dict = {"step": self.step, "epoch": int(epoch) if epoch.is_integer() else epoch}
        for name in ("loss", "consistency", "distillation"):
            row[name] = getattr(self, name) / self.num_groups if self.num_groups else None
            setattr(self, name, 0.0)
        row["train_gce"] = self.gce / self.num_groups_with_pair if self.num_groups_with_pair else None
        self.gce, self.num_groups, self.num_groups_with_pair = 0.0, 0, 0
        return row

    def row_of(self, step: int | None) -> dict | None:
        """The row of metrics.jsonl with this step."""
        return next((row for row in self.rows if row["step"] == step), None)


def write_metrics(output: Path, rows: list[dict]) -> None:
    """metrics.jsonl, whole: a resumed run drops the rows after its checkpoint."""
    write_whole(output / "metrics.jsonl", "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows))
