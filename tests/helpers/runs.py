"""Short training runs on the tiny tree, and what they leave on disk."""

import json
import multiprocessing
import os
import socket
from pathlib import Path

import torch
from accelerate.state import AcceleratorState
from safetensors.torch import load_file

from gift_peft.training import TrainResult, checkpoints, train
from gift_peft.training.arguments import GiftTrainingArguments


def arguments(base: Path, tree: Path, out: Path, **changes) -> GiftTrainingArguments:
    """Two epochs with a checkpoint after every update."""
    values = {"size": "56x70", "num_train_epochs": 2, "learning_rate": 2e-4, "checkpointing_steps": 1} | changes
    return GiftTrainingArguments(str(base), str(tree), str(out), **values)


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(folder / "adapter_model.safetensors")


def assert_same_run(out: Path, expected: Path) -> None:
    """Adapters, best and last, and metrics to the bit; nothing under a temporary name."""
    for name in ("adapter", "adapter-last"):
        ours, theirs = weights(out / name), weights(expected / name)
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
    assert (out / "metrics.jsonl").read_text() == (expected / "metrics.jsonl").read_text()
    assert not list(out.glob(".*"))


def run_in_child(function, *args) -> int:
    """Exit code of `function(*args)` in a forked process (no new imports); negative for a signal."""
    process = multiprocessing.get_context("fork").Process(target=function, args=args)
    process.start()
    process.join()
    return process.exitcode


def run_in_processes(function, count: int = 2) -> list[int]:
    """Exit codes of `function(rank)` in forked processes that train together; negative for a signal."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def work(rank):
        setting = {"WORLD_SIZE": count, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "ACCELERATE_USE_CPU": "true"}
        os.environ.update({key: str(value) for key, value in (setting | {"RANK": rank, "LOCAL_RANK": rank}).items()})
        AcceleratorState._reset_state(reset_partial_state=True)  # the parent's, inherited by the fork
        function(rank)

    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=work, args=(rank,)) for rank in range(count)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    return [process.exitcode for process in processes]


def train_again(args: GiftTrainingArguments, **changes) -> TrainResult:
    """Resume from the newest checkpoint."""
    return train(GiftTrainingArguments(**{**vars(args), "resume_from_checkpoint": "latest", **changes}))


def rows_of(out):
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def tell(folder: Path, **identity) -> None:
    """Change what a checkpoint says of its run; None takes it out."""
    state = json.loads((folder / checkpoints.STATE).read_text())
    said = state["identity"] | identity
    state["identity"] = {name: value for name, value in said.items() if name not in identity or value is not None}
    (folder / checkpoints.STATE).write_text(json.dumps(state))
    sums = json.loads((folder / checkpoints.CHECKSUMS).read_text())
    sums[checkpoints.STATE] = checkpoints._digest(folder / checkpoints.STATE)
    (folder / checkpoints.CHECKSUMS).write_text(json.dumps(sums))
