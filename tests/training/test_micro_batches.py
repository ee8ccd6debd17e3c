"""Micro-batches by memory in a run: chosen once, written down, taken from there by a resumed run; and what if not."""

import json

import pytest
import torch
import yaml
from helpers.runs import arguments, assert_same_run, train_again

from gift_peft.group_step import GroupStep
from gift_peft.training import loop, objectives, train
from gift_peft.training.arguments import GiftTrainingArguments
from gift_peft.training.surface_step import PredictedDepth, SurfaceStep

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.*deprecated.*:FutureWarning")


def identity_of(checkpoint):
    return json.loads((checkpoint / "trainer_state.json").read_text())["identity"]


def test_the_choice_is_written_down_and_a_resumed_run_takes_it(base_dir, tree, tmp_path, monkeypatch):
    out = tmp_path / "out"
    asked = []

    def choose(step, group, largest=None, usual=None):
        asked.append(largest)
        return 1

    monkeypatch.setattr(GroupStep, "choose_micro_batch_size", choose)
    args = arguments(base_dir, tree, out, checkpoints_total_limit=None)
    assert args.micro_batch_size == "auto"
    result = train(args)
    assert asked == [3] and args.micro_batch_size == "auto"
    assert yaml.safe_load((out / "config.yaml").read_text())["micro_batch_size"] == 1
    checkpoints = sorted(out.glob("checkpoint-*"))
    assert {identity_of(checkpoint)["micro_batch_size"] for checkpoint in checkpoints} == {1}

    fixed = tmp_path / "fixed"
    train(arguments(base_dir, tree, fixed, micro_batch_size=1))
    assert_same_run(out, fixed)

    again = GiftTrainingArguments(**{**vars(args), "output_dir": str(tmp_path / "again")})
    again.resume_from_checkpoint = str(out / f"checkpoint-{result.step - 1}")
    train(again)
    assert asked == [3]  # not chosen anew
    assert_same_run(tmp_path / "again", out)
    with pytest.raises(ValueError, match="micro_batch_size: 1 became 2"):
        train_again(args, micro_batch_size=2)


def test_a_group_that_fits_is_one_micro_batch(base_dir, tree, tmp_path, capsys):
    train(arguments(base_dir, tree, tmp_path / "auto", max_steps=2))
    assert "Micro-batches of 3 images, by memory" in capsys.readouterr().out
    train(arguments(base_dir, tree, tmp_path / "whole", max_steps=2, micro_batch_size=3, retain=3))
    assert_same_run(tmp_path / "auto", tmp_path / "whole")


def test_blocks_are_recomputed_where_not_even_one_image_fits(base_dir, tree, tmp_path, monkeypatch, capsys):
    out, tried, checkpointed = tmp_path / "out", [], []

    def choose(step, group, largest=None, usual=None):
        tried.append(bool(checkpointed))
        if not checkpointed:
            raise torch.OutOfMemoryError("not even one image fits into memory")
        return 2

    monkeypatch.setattr(GroupStep, "choose_micro_batch_size", choose)
    real = objectives.checkpoint_blocks
    monkeypatch.setattr(objectives, "checkpoint_blocks", lambda model: checkpointed.append(real(model) or True))
    train(arguments(base_dir, tree, out, max_steps=1))
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert (config["micro_batch_size"], config["gradient_checkpointing"]) == (2, True)
    said = [line for line in capsys.readouterr().out.splitlines() if "gradient_checkpointing" in line]
    assert tried == [False, True] and len(said) == 1


def test_surface_targets_take_fewer_images_at_once_where_memory_asks_for_it(
    base_dir, tree, tmp_path, monkeypatch, capsys
):
    sizes, out = [], tmp_path / "out"

    def choose(step, pixel_values, largest):
        assert len(pixel_values) == 1
        sizes.append(largest)
        return 2

    monkeypatch.setattr(SurfaceStep, "choose_micro_batch_size", choose)
    real = PredictedDepth.forward
    forwards = []
    monkeypatch.setattr(
        PredictedDepth, "forward", lambda self, pixels: forwards.append(len(pixels)) or real(self, pixels)
    )
    options = {"target": "surface", "fills": 0, "per_device_train_batch_size": 3, "checkpoints_total_limit": None}
    args = arguments(base_dir, tree, out, **options)
    result = train(args)
    assert "Micro-batches of 2 images, by memory" in capsys.readouterr().out
    assert sizes == [3] and set(forwards) == {1, 2}
    assert yaml.safe_load((out / "config.yaml").read_text())["micro_batch_size"] == 2
    assert identity_of(out / f"checkpoint-{result.step}")["micro_batch_size"] == 2

    again = GiftTrainingArguments(**{**vars(args), "output_dir": str(tmp_path / "again")})
    again.resume_from_checkpoint = str(out / f"checkpoint-{result.step - 1}")
    train(again)
    assert sizes == [3]  # not chosen anew
    assert_same_run(tmp_path / "again", out)

    train(arguments(base_dir, tree, tmp_path / "fixed", **options, micro_batch_size=2))
    assert_same_run(tmp_path / "fixed", out)
    forwards.clear()
    train(arguments(base_dir, tree, tmp_path / "whole", **options, micro_batch_size=100))
    assert max(forwards) == 3  # no more than what an update takes


def test_the_base_is_loaded_once(base_dir, tree, tmp_path, monkeypatch):
    loads = []
    real = loop.load_base
    for module in ("gift_peft.training.loop.load_base", "gift_peft.models.loading.load_base"):
        monkeypatch.setattr(module, lambda *args, **options: loads.append(args) or real(*args, **options))
    train(arguments(base_dir, tree, tmp_path / "out", max_steps=1, proxies_dir=str(tmp_path / "proxies")))
    assert len(loads) == 1


@pytest.mark.parametrize("value", ["automatic", "0", "-2", "1.5"])
def test_no_number_of_images(value):
    with pytest.raises(ValueError, match="micro_batch_size"):
        GiftTrainingArguments("base", "data", "out", micro_batch_size=value)
