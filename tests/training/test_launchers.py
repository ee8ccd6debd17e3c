"""What a launcher announces and what is there; trackers that start and that do not."""

import os
import subprocess
import sys

import pytest
from helpers.runs import arguments

from gift_peft.training import start, train

ACCELERATE = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500", "ACCELERATE_MIXED_PRECISION": "no"}


@pytest.fixture
def told(monkeypatch, capsys):
    """What `tell_missing_processes` prints to a process with this environment and command line."""

    def told(environment, argv, there=1, asked=2):
        for name in (*start.WORLD_SIZES, *ACCELERATE, "ACCELERATE_USE_CPU"):
            monkeypatch.delenv(name, raising=False)
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr(sys, "argv", argv)
        monkeypatch.setattr(start, "_asked_of_accelerate", lambda: asked)
        start.tell_missing_processes(there)
        return capsys.readouterr().err

    return told


@pytest.mark.parametrize(
    ("environment", "asked", "count", "number"),
    [
        (ACCELERATE | {"ACCELERATE_USE_CPU": "True"}, 2, "2 processes", "2"),
        (ACCELERATE, float("inf"), "several processes", "N"),  # of `accelerate config`: nobody tells how many
        ({"OMPI_COMM_WORLD_SIZE": "4"}, 1, "4 processes", "4"),
        ({"SLURM_STEP_NUM_TASKS": "8"}, 1, "8 processes", "8"),
    ],
)
def test_missing_processes_are_told_in_one_line_with_the_command(told, environment, asked, count, number):
    line = told(environment, ["/lib/gift_peft/training/__main__.py", "--config", "my run.yaml"], asked=asked)
    assert line.count("\n") == 1 and f"announces {count}, and 1 is at work" in line
    assert f"torchrun --nproc_per_node {number} -m gift_peft.training --config 'my run.yaml'\n" in line
    assert ("ACCELERATE_USE_CPU=true torchrun" in line) is ("ACCELERATE_USE_CPU" in environment)


@pytest.mark.parametrize(
    ("environment", "there"),
    [
        ({}, 1),
        ({"ACCELERATE_MIXED_PRECISION": "no"}, 1),  # `accelerate launch` with one process
        (ACCELERATE | {"WORLD_SIZE": "2"}, 2),
        ({"WORLD_SIZE": "1", "MASTER_ADDR": "10.0.0.1", "ACCELERATE_MIXED_PRECISION": "no"}, 1),  # torchrun
        ({"SLURM_STEP_NUM_TASKS": "1"}, 1),
        ({"PMI_SIZE": "what"}, 1),
    ],
)
def test_nothing_is_said_where_all_are_there(told, environment, there):
    assert told(environment, ["gift-peft", "train"], there) == ""


def test_the_command_is_of_the_program_that_was_started(told):
    assert " -m gift_peft.training --base b\n" in told(ACCELERATE, ["/bin/gift-peft", "train", "--base", "b"])
    assert " examples/train_gift.py --base b\n" in told(ACCELERATE, ["examples/train_gift.py", "--base", "b"])


@pytest.mark.slow
def test_accelerate_without_mpi(tmp_path):
    """The launcher itself: it starts one process of the two."""
    unset = {"RANK", "WORLD_SIZE", "LOCAL_RANK", *start.WORLD_SIZES}
    env = {name: value for name, value in os.environ.items() if name not in unset} | {"HF_HUB_OFFLINE": "1"}
    launch = [sys.executable, "-m", "accelerate.commands.launch", "--cpu", "--num_processes", "2"]
    run = ["-m", "gift_peft.training", "--base", f"{tmp_path}/b", "--dataset", "d", "--out", f"{tmp_path}/o"]
    done = subprocess.run([*launch, *run], capture_output=True, text=True, env=env)
    lines = [line for line in done.stderr.splitlines() if "announces 2 processes" in line]
    assert done.returncode == 1 and len(lines) == 1
    assert "torchrun --nproc_per_node 2 -m gift_peft.training --base" in lines[0]


def test_wandb_records_offline(base_dir, tree, tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="wandb, an extra, is not installed")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    train(arguments(base_dir, tree, tmp_path / "out", max_steps=1, report_to="wandb"))
    assert list((tmp_path / "out/logs/wandb").glob("offline-run-*/*.wandb")) and not (tmp_path / "wandb").exists()


def test_a_tracker_that_does_not_start_ends_in_one_line(base_dir, tree, tmp_path, monkeypatch):
    def refuse(self, *args):
        raise RuntimeError("no API key\nuse login")

    monkeypatch.setattr(start, "find_spec", lambda name: True)
    monkeypatch.setattr(start.Accelerator, "init_trackers", refuse)
    with pytest.raises(
        ValueError, match=r"report_to: wandb did not start \(no API key\); WANDB_MODE=offline"
    ) as caught:
        train(arguments(base_dir, tree, tmp_path / "out", max_steps=1, report_to="wandb"))
    assert "\n" not in str(caught.value)
