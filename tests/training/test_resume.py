"""Killed, interrupted, spread over two processes: the adapter is the one of the uninterrupted run."""

import json
import operator
import os
import shutil
import signal
import subprocess
import sys

import pytest
import torch
from accelerate import debug_launcher
from accelerate.state import AcceleratorState
from helpers.runs import arguments, assert_same_run, run_in_child, tell, train_again, weights

from gift_peft import cli
from gift_peft.dataset.gift_i import dataset_fingerprint, load_gift_i
from gift_peft.dataset.writer import write_gift_i
from gift_peft.group_step import GroupStep
from gift_peft.models.identity import earlier_revision
from gift_peft.training import checkpoints, loop, progress, train, validation
from gift_peft.training.start import stop_signals


@pytest.fixture
def args(base_dir, tree, tmp_path):
    return arguments(base_dir, tree, tmp_path / "out")


def kill(*args, **kwargs):
    os.kill(os.getpid(), signal.SIGKILL)


def on_call(number, function, act):
    """`function`, but its `number`-th call (0: every call) does `act` first."""
    calls = []

    def wrapped(*args, **kwargs):
        calls.append(args)
        if number in (0, len(calls)):
            act(*args, **kwargs)
        return function(*args, **kwargs)

    return wrapped


def half_a_file(tensors, path):
    path.write_bytes(b"half")
    kill()


def renaming(source, target):
    """Kills when a folder of this name is about to get that one."""

    def act(*paths):
        if [os.path.basename(path) for path in paths] == [source, target]:
            kill()

    return act


# What is replaced, its name, the call at which the process dies (0: any), how, and what must lie there then.
MOMENTS = {
    "before the first checkpoint": (GroupStep, "accumulate", 1, kill, {"adapter": False, "checkpoint-1": False}),
    "in the second step": (GroupStep, "accumulate", 2, kill, {"checkpoint-1": True, "checkpoint-2": False}),
    "in the middle of writing checkpoint-3": (
        checkpoints,
        "save_file",
        5,
        half_a_file,
        {"checkpoint-2": True, f".checkpoint-3.tmp/{checkpoints.OPTIMIZER}": True, "checkpoint-3": False},
    ),
    "before checkpoint-3 gets its name": (
        os,
        "replace",
        0,
        renaming(".checkpoint-3.tmp", "checkpoint-3"),
        {"checkpoint-2": True, f".checkpoint-3.tmp/{checkpoints.CHECKSUMS}": True, "checkpoint-3": False},
    ),
    "between best adapter and metrics": (loop, "write_metrics", 2, kill, {"adapter": True, "checkpoint-2": False}),
    "while old checkpoints are deleted": (
        os,
        "replace",
        0,
        renaming("checkpoint-1", ".checkpoint-1.tmp"),
        {"checkpoint-1": True, "checkpoint-3": True},
    ),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_kill_and_resume_is_the_uninterrupted_run(moment, args, whole, tmp_path):
    owner, name, number, act, left = MOMENTS[moment]

    def run_and_die():
        setattr(owner, name, on_call(number, getattr(owner, name), act))
        train(args)

    assert run_in_child(run_and_die) == -signal.SIGKILL
    assert {name: (tmp_path / "out" / name).exists() for name in left} == left
    train_again(args)
    assert_same_run(tmp_path / "out", whole)


def test_interrupted_twice_the_last_checkpoint_is_the_same_to_the_byte(args, whole, tmp_path, monkeypatch):
    for steps in (1, 3):
        with monkeypatch.context() as patch:
            done = on_call(steps - steps // 2, GroupStep.accumulate, lambda *a: os.kill(os.getpid(), signal.SIGINT))
            patch.setattr(GroupStep, "accumulate", done)
            result = train(args)
        assert (result.signal, result.step) == (signal.SIGINT, steps)
        args.resume_from_checkpoint = "latest"
    train(args)
    assert_same_run(tmp_path / "out", whole)
    for name in (checkpoints.OPTIMIZER, checkpoints.RNG, checkpoints.STATE):
        assert (tmp_path / "out/checkpoint-4" / name).read_bytes() == (whole / "checkpoint-4" / name).read_bytes()


def test_a_checkpoint_that_pins_the_files_of_its_base_goes_on(args, whole, base_dir, tmp_path):
    """As 0.1.0 wrote them."""
    out = shutil.copytree(whole, tmp_path / "out", ignore=shutil.ignore_patterns("checkpoint-4", "adapter-last"))
    assert (out / "checkpoint-3").is_dir()

    tell(out / "checkpoint-3", model_name_or_path="sha256:" + "0" * 32)
    with pytest.raises(ValueError, match="the base model's weights have changed"):
        train_again(args)
    tell(out / "checkpoint-3", model_name_or_path=earlier_revision(base_dir))
    train_again(args)
    assert_same_run(out, whole)


def test_a_closed_terminal_stops_no_run_started_with_nohup():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_signals() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.signum
            os.kill(os.getpid(), signal.SIGUSR1)
            assert stop.signum == signal.SIGUSR1
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(
    ("signum", "code"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGUSR1, 138), (signal.SIGHUP, 129)],
)
def test_signals_checkpoint_after_the_group_and_say_how_to_go_on(
    signum, code, args, whole, tmp_path, monkeypatch, capsys
):
    config = tmp_path / "c.yaml"
    config.write_text(args.to_yaml())
    signal.signal(signum, before := signal.default_int_handler if signum == signal.SIGINT else signal.SIG_DFL)
    with monkeypatch.context() as patch:
        stop = on_call(3, GroupStep.accumulate, lambda *a: os.kill(os.getpid(), signum))
        patch.setattr(GroupStep, "accumulate", stop)
        with pytest.raises(SystemExit) as exit:
            cli.main(["train", "--config", str(config)])
    assert exit.value.code == code
    assert signal.getsignal(signum) == before
    command = capsys.readouterr().out.strip().splitlines()[-1].split()
    assert command[:2] == ["gift-peft", "train"]
    assert checkpoints.checkpoint_fault(tmp_path / "out/checkpoint-3") is None
    with pytest.raises(SystemExit) as exit:
        cli.main(command[1:])
    assert exit.value.code == 0
    assert_same_run(tmp_path / "out", whole)


@pytest.mark.parametrize("number", [1, 2, 3])  # of the base, after each epoch
def test_a_signal_in_the_middle_of_a_validation_stops_it(number, args, whole, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        # A validation reads two groups: a signal at the first stops it before the second.
        stop = on_call(2 * number - 1, operator.getitem, lambda *a: os.kill(os.getpid(), signal.SIGTERM))
        until = validation.UntilStopped
        patch.setattr(validation, "UntilStopped", lambda groups, *signals: until(Stopping(groups, stop), *signals))
        result = train(args)
    assert (result.signal, result.step, len(result.metrics)) == (signal.SIGTERM, 2 * (number - 1), number - 1)
    assert checkpoints.checkpoint_fault(tmp_path / f"out/checkpoint-{result.step}") is None
    train_again(args)
    assert_same_run(tmp_path / "out", whole)


class Stopping:
    """Groups, read by `get(groups, index)`; twice as many, so that one is left to stop before."""

    def __init__(self, groups, get):
        self.groups, self.get = groups, get

    def __len__(self):
        return 2 * len(self.groups)

    def __getitem__(self, index):
        return self.get(self.groups, index % len(self.groups))


def test_a_broken_newest_checkpoint_is_skipped(args, whole, tmp_path, capsys):
    shutil.copytree(whole, tmp_path / "out")
    shutil.rmtree(tmp_path / "out/adapter-last")
    state = tmp_path / "out/checkpoint-4" / checkpoints.OPTIMIZER
    state.write_bytes(state.read_bytes()[:-1])
    (tmp_path / "out/checkpoint-9").mkdir()
    train_again(args)
    said = capsys.readouterr().out
    assert "checkpoint-9, which is not complete: checksums.json is missing" in said
    assert "checkpoint-4, which is not complete: optimizer.safetensors is damaged" in said
    assert "Going on from" in said and "(step 3)" in said
    assert_same_run(tmp_path / "out", whole)


def test_the_only_good_checkpoint_is_not_pushed_out_by_a_broken_later_one(args, whole, tmp_path):
    shutil.copytree(whole, tmp_path / "out")
    (tmp_path / "out/checkpoint-4" / checkpoints.RNG).unlink()
    checkpoints.prune_checkpoints(tmp_path / "out", 3, 1, [])
    assert [folder.name for folder in checkpoints.list_checkpoints(tmp_path / "out")] == [
        "checkpoint-3",
        "checkpoint-4",
    ]
    train_again(args, checkpoints_total_limit=1)
    assert_same_run(tmp_path / "out", whole)
    assert [folder.name for folder in checkpoints.list_checkpoints(tmp_path / "out")] == ["checkpoint-4"]


def test_only_broken_checkpoints_are_an_error(args, tmp_path):
    (tmp_path / "out/checkpoint-2").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"no complete checkpoint in .*out"):
        train_again(args)
    with pytest.raises(ValueError, match=r"checkpoint-2 is not a complete checkpoint"):
        train_again(args, resume_from_checkpoint=str(tmp_path / "out/checkpoint-2"))
    with pytest.raises(FileNotFoundError, match="no such folder: nowhere"):
        train_again(args, resume_from_checkpoint="nowhere")


def test_a_checkpoint_carries_its_run_to_another_folder(args, whole, tmp_path):
    """With the best adapter and the metrics; rows after the checkpoint are written anew."""
    train_again(args, resume_from_checkpoint=str(whole / "checkpoint-3"))
    assert_same_run(tmp_path / "out", whole)


def test_a_longer_run_has_the_shorter_as_its_beginning(args, base_dir, tree, whole, tmp_path):
    shutil.copytree(whole, tmp_path / "out")
    train_again(args, num_train_epochs=3)
    longer = tmp_path / "longer"
    train(arguments(base_dir, tree, longer, num_train_epochs=3))
    assert_same_run(tmp_path / "out", longer)
    assert len((longer / "metrics.jsonl").read_text().splitlines()) == 4


def test_with_eval_delay_the_length_is_part_of_the_run(args, tree, tmp_path, base_dir):
    """The shorter run's end was validated, which in a longer one comes too early to be chosen."""
    train(arguments(base_dir, tree, tmp_path / "out", max_steps=2, eval_delay=9))
    with pytest.raises(ValueError, match=r"resume_from_checkpoint: max_steps: 2 became 4, it has changed"):
        train_again(args, max_steps=4, eval_delay=9)


@pytest.mark.parametrize(("name", "value"), [("learning_rate", 1e-3), ("seed", 5), ("head", "lora")])
def test_other_arguments_are_refused_by_name_and_nothing_is_written(name, value, args, whole, tmp_path):
    shutil.copytree(whole, tmp_path / "out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=rf"resume_from_checkpoint: {name}: .*changed since the checkpoint"):
        train_again(args, **{name: value})
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()} == before


def test_a_changed_dataset_is_refused(args, whole, tree, tmp_path):
    shutil.copytree(whole, tmp_path / "out")
    shutil.copytree(tree, tmp_path / "raw")
    mask = tmp_path / "raw/train/scene_0/masks/0.png"
    shutil.copy(tmp_path / "raw/train/scene_1/masks/0.png", mask)
    with pytest.raises(ValueError, match="resume_from_checkpoint: dataset_name: its images, masks or groups"):
        train_again(args, dataset_name=str(tmp_path / "raw"))


def test_another_order_of_the_groups_is_refused(args, whole, tree, tmp_path):
    """The same content, so the same fingerprint, but other updates."""
    groups = []
    for split in ("validation", "train"):
        rows = load_gift_i(tree, split)
        for index in reversed(range(len(rows))):
            keys = ("group_id", "image_names", "images", "masks", "reference")
            groups.append({"split": split, **{key: rows[index][key] for key in keys}})
    folder = write_gift_i(groups, tmp_path / "prepared", license="cc0-1.0")
    assert dataset_fingerprint(load_gift_i(folder, "train")) == dataset_fingerprint(load_gift_i(tree, "train"))
    shutil.copytree(whole, tmp_path / "out")
    with pytest.raises(ValueError, match="resume_from_checkpoint: group_order: the order of the training groups has"):
        train_again(args, dataset_name=str(folder), proxies_dir=str(tree / "proxies"))


def test_a_moved_dataset_is_not_a_changed_one(args, whole, tree, tmp_path):
    shutil.copytree(whole, tmp_path / "out")
    shutil.copytree(tree, tmp_path / "elsewhere")
    train_again(args, dataset_name=str(tmp_path / "elsewhere"), proxies_dir=str(tree / "proxies"))
    assert_same_run(tmp_path / "out", whole)


def test_a_run_that_ended_without_checkpoints_is_not_started_again(args, whole, tmp_path):
    shutil.copytree(whole, tmp_path / "out", ignore=shutil.ignore_patterns("checkpoint-*"))
    with pytest.raises(ValueError, match="has ended and its checkpoints are gone"):
        train_again(args)


def train_on_two(args):
    AcceleratorState._reset_state(reset_partial_state=True)  # the parent's, inherited by the fork
    train(args)


def test_two_processes_give_the_adapter_of_one(base_dir, tree, whole, tmp_path):
    args = arguments(base_dir, tree, tmp_path / "out", learning_rate=2e-5, proxies_dir=str(tmp_path / "proxies"))
    debug_launcher(train_on_two, (args,), num_processes=2)
    args = arguments(base_dir, tree, tmp_path / "one", learning_rate=2e-5)
    train(args)
    two, one = weights(tmp_path / "out/adapter-last"), weights(tmp_path / "one/adapter-last")
    assert two.keys() == one.keys()
    for key in one:
        torch.testing.assert_close(two[key], one[key], rtol=0, atol=1e-5)
    rows = [json.loads(line) for line in (tmp_path / "out/metrics.jsonl").read_text().splitlines()]
    expected = [json.loads(line) for line in (tmp_path / "one/metrics.jsonl").read_text().splitlines()]
    assert rows[0] == expected[0]
    assert rows[-1]["val_gce"] == pytest.approx(expected[-1]["val_gce"], rel=1e-3)
    assert json.loads((tmp_path / "out/adapter/gift.json").read_text())["num_processes"] == 2


def test_leftovers_give_a_replaced_folder_its_name_back(tmp_path):
    for name in (".checkpoint-2.old", ".checkpoint-3.old", "checkpoint-3", ".checkpoint-4.tmp"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "from").write_text(name)
    checkpoints.remove_leftovers(tmp_path)
    assert {path.name: (path / "from").read_text() for path in tmp_path.iterdir()} == {
        "checkpoint-2": ".checkpoint-2.old",
        "checkpoint-3": "checkpoint-3",
    }


def test_leftovers_are_a_runs_own(tmp_path):
    for name in (".env.old", ".cache.tmp", ".metrics.jsonl.bak", ".adapter-mine.tmp"):
        (tmp_path / name).mkdir()
    for name in (".metrics.jsonl.123.partial", ".config.yaml.9.partial"):
        (tmp_path / name).write_text("half")
    for name in ("..checkpoint-3.tmp.tmp", "..checkpoint-3.tmp.old", ".adapter.tmp", ".adapter-last.old"):
        (tmp_path / name).mkdir()
    checkpoints.remove_leftovers(tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {".env.old", ".cache.tmp", ".metrics.jsonl.bak", ".adapter-mine.tmp", "adapter-last"}


def test_the_command_to_go_on_survives_a_space(tmp_path):
    text = progress.how_to_resume(tmp_path / "my run", 3)
    assert f"--config '{tmp_path}/my run/config.yaml' --resume" in text


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["torchrun", "accelerate"])
def test_documented_launch_lines(launcher, base_dir, tree, tmp_path):
    """The lines of docs/several-gpus.md, on CPUs."""
    lines = {
        "torchrun": [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"],
        "accelerate": ["accelerate", "launch", "--multi_gpu", "--num_processes=2", "--main_process_port=0"],
    }
    options = {"size": "56x70", "max_steps": 2, "proxies_dir": tmp_path / "proxies", "output_dir": tmp_path / "out"}
    options |= {"model_name_or_path": base_dir, "dataset_name": tree}
    command = [*lines[launcher], "-m", "gift_peft.training", *(f"--{key}={value}" for key, value in options.items())]
    environment = os.environ | {"ACCELERATE_USE_CPU": "true", "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr[-2000:]
    assert json.loads((tmp_path / "out/adapter/gift.json").read_text())["num_processes"] == 2


def test_a_falling_learning_rate_goes_on_where_it_was(base_dir, tree, tmp_path, monkeypatch):
    """Linear to 0 over the run, an interruption does not show, and the length is part of what the run is."""
    rates, step = [], torch.optim.Adam.step

    def recorded(self, *args, **kwargs):
        rates.append(self.param_groups[0]["lr"])
        return step(self, *args, **kwargs)

    monkeypatch.setattr(torch.optim.Adam, "step", recorded)
    falling = {"lr_scheduler_type": "linear", "learning_rate": 4e-4}
    train(arguments(base_dir, tree, tmp_path / "whole", **falling))
    assert rates == pytest.approx([4e-4, 3e-4, 2e-4, 1e-4])

    args = arguments(base_dir, tree, tmp_path / "out", **falling)
    with monkeypatch.context() as patch:
        stop = on_call(3, GroupStep.accumulate, lambda *a: os.kill(os.getpid(), signal.SIGINT))
        patch.setattr(GroupStep, "accumulate", stop)
        train(args)
    train_again(args)
    assert_same_run(tmp_path / "out", tmp_path / "whole")
    with pytest.raises(ValueError, match=r"resume_from_checkpoint: num_train_epochs: .*changed since the checkpoint"):
        train_again(args, num_train_epochs=3)
