"""Killed at any moment, again and again: resumed, the run is the uninterrupted one to the bit."""

import multiprocessing
import random
import shutil
import signal
import time

import pytest
from helpers.runs import arguments, assert_same_run
from helpers.tiny import write_raw_tree

from gift_peft.training import train
from gift_peft.training.arguments import GiftTrainingArguments

TRIALS = 30


def start(args: GiftTrainingArguments):
    process = multiprocessing.get_context("fork").Process(target=train, args=(args,))
    process.start()
    return process


def kill_at(args: GiftTrainingArguments, moment: float) -> bool:
    """Whether SIGKILL after `moment` seconds came before the run had ended by itself."""
    process = start(args)
    process.join(moment)
    process.kill()
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode != 0


@pytest.mark.slow
def test_thirty_kills_at_random_moments(base_dir, tmp_path, capfd):
    tree = write_raw_tree(tmp_path / "raw")
    whole = tmp_path / "whole"
    train(arguments(base_dir, tree, whole))
    began = time.perf_counter()
    again = start(arguments(base_dir, tree, tmp_path / "again"))
    again.join()
    duration = time.perf_counter() - began
    assert again.exitcode == 0
    assert_same_run(tmp_path / "again", whole)
    generator = random.Random(0)
    states = set()
    for trial in range(TRIALS):
        out = tmp_path / f"trial-{trial}"
        args = arguments(base_dir, tree, out, resume_from_checkpoint="latest")
        kills = 0
        while kills < (2 if trial % 3 == 0 else 1):  # what goes on is killed as well in every third trial
            if kill_at(args, generator.uniform(0, duration)):
                kills += 1
                states.add(frozenset(path.name for path in out.iterdir()) if out.exists() else None)
            else:  # it had ended by itself: once more from the start
                shutil.rmtree(out)
                kills = 0
        final = start(args)
        final.join()
        assert final.exitcode == 0
        assert_same_run(out, whole)
    with capfd.disabled():
        print(f"\n{TRIALS} of {TRIALS} equal; killed in {len(states)} different states of the folder")
