"""Runs that are refused or stop: one line names the argument, file or group, and the last checkpoint stays good."""

import shutil

import pytest
import torch
from helpers.runs import arguments, rows_of, train_again
from helpers.tiny import write_group, write_raw_tree
from safetensors import SafetensorError

from gift_peft.group_step import GroupStep
from gift_peft.training import checkpoints, loop, start, train

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning")


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return write_raw_tree(tmp_path_factory.mktemp("tree") / "raw", train=(2, 3, 2))


def test_accelerates_fp16_is_refused(base_dir, tree, tmp_path, monkeypatch):
    monkeypatch.setenv("ACCELERATE_MIXED_PRECISION", "fp16")
    with pytest.raises(ValueError, match="mixed_precision: fp16"):
        train(arguments(base_dir, tree, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_folder_with_a_run_is_refused_and_left_alone(base_dir, tree, tmp_path):
    out = tmp_path / "out"
    args = arguments(base_dir, tree, out, max_steps=1)
    train(args)
    (out / "notes.txt").write_text("mine")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=r"output_dir: .*already holds a run"):
        train(args)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    args.overwrite_output_dir = True
    args.max_steps = 2
    train(args)
    assert len(rows_of(out)) == 2
    assert (out / "notes.txt").read_text() == "mine"


def test_nan_stops_with_the_groups_name_and_leaves_the_last_checkpoint(base_dir, tree, tmp_path, monkeypatch):
    out = tmp_path / "out"
    args = arguments(base_dir, tree, out)

    def explode(step, *values):
        output = accumulate(step, *values)
        if (out / "checkpoint-1").exists():
            next(p for p in step.model.parameters() if p.requires_grad).data.fill_(float("nan"))
            return accumulate(step, *values)
        return output

    accumulate = GroupStep.accumulate
    with monkeypatch.context() as patch:
        patch.setattr(GroupStep, "accumulate", explode)
        with pytest.raises(ValueError, match=r"step 2, group scene_\d: .*(NaN|non-finite).*checkpoint-1") as error:
            train(args)
    assert "\n" not in str(error.value)
    assert [folder.name for folder in out.glob("checkpoint-*")] == ["checkpoint-1"]
    assert not list(out.glob(".*"))
    assert train_again(args).step == 6


@pytest.mark.parametrize("error", ["weights", "memory"])
def test_bad_weights_and_too_little_memory_name_step_and_group(error, base_dir, tree, tmp_path, monkeypatch):
    def fail(optimizer, *args, **kwargs):
        if error == "memory":
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
        optimizer.param_groups[0]["params"][-1].data.view(-1)[0] = float("inf")

    monkeypatch.setattr(torch.optim.Adam, "step", fail)
    message = {"weights": "the update made weights NaN or infinite", "memory": "CUDA out of memory"}[error]
    with pytest.raises(ValueError, match=rf"step 1, group scene_\d: {message}.*no checkpoint"):
        train(arguments(base_dir, tree, tmp_path / "out"))
    assert not list((tmp_path / "out").glob("adapter*"))


def one_conv(conv):
    """(B,3,h,w) as `pixel_values` to (B,h,w)."""

    class Model(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.conv = conv

        def forward(self, pixel_values):
            return self.conv(pixel_values)[:, 0]

    return Model()


def test_a_loss_that_overflows_is_an_error():
    """The gradient of an L1 is a sign: it stays finite."""
    model = torch.nn.Conv2d(3, 1, 1, bias=False)
    torch.nn.init.constant_(model.weight, 3e38)
    step = GroupStep(one_conv(model))
    pixels = torch.zeros(2, 3, 4, 4)
    pixels[0, 0], pixels[1, 0] = 1, -1
    with pytest.raises(ValueError, match="loss of this group is NaN or infinite"):
        step.accumulate(pixels, torch.ones(2, 4, 4, dtype=torch.bool), torch.zeros(2, 4, 4))
    assert model.weight.grad is None


def test_validation_groups_that_choose_nothing_are_told(base_dir, tree, tmp_path, capsys):
    shutil.copytree(tree / "train", tmp_path / "raw/train")
    write_group(tmp_path / "raw/validation/alone", 1, 7, reference=True)
    result = train(arguments(base_dir, tmp_path / "raw", tmp_path / "out", max_steps=1))
    assert (result.best_step, result.metrics[-1]["val_gce"]) == (None, None)
    assert result.metrics[-1]["val_tom_rmse"] is not None
    assert "simply the last one, not the best of several" in capsys.readouterr().out


def test_a_diverging_run_names_the_group(base_dir, tree, tmp_path):
    with pytest.raises(ValueError, match=r"group scene_\d"):
        train(arguments(base_dir, tree, tmp_path / "out", learning_rate=1e30))


def test_missing_proxies_and_a_folder_that_cannot_be_written(base_dir, tree, tmp_path, monkeypatch):
    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied", "/read/only/proxies")

    monkeypatch.setattr(loop, "make_proxies", refuse)
    command = r"gift-peft proxies --base .* --size 56x70 --revision v2"
    with pytest.raises(PermissionError, match=rf"/read/only/proxies.*{command}"):
        train(arguments(base_dir, tree, tmp_path / "out", model_revision="v2"))


def test_a_dataset_without_train_groups(base_dir, tmp_path):
    write_group(tmp_path / "raw/validation/scene", 2, 0, reference=True)
    with pytest.raises(ValueError, match=r"dataset_name: .*no train split"):
        train(arguments(base_dir, tmp_path / "raw", tmp_path / "out"))
    assert not (tmp_path / "raw/proxies").exists()  # said before anything is predicted
    assert not list((tmp_path / "out").iterdir())


def test_a_model_without_a_recipe_is_told_how_to_spell_one(base_dir, tree, tmp_path, monkeypatch):
    monkeypatch.setattr("gift_peft.adapters.recipes.RECIPES", {})
    with pytest.raises(ValueError, match=r"model_name_or_path: no recipe .*target_modules, modules_to_save and pred"):
        train(arguments(base_dir, tree, tmp_path / "out"))


def test_a_disk_that_is_full_names_the_checkpoint(base_dir, tree, tmp_path, monkeypatch):
    def full(tensors, path):
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    args = arguments(base_dir, tree, tmp_path / "out", max_steps=2)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "save_file", full)
        with pytest.raises(OSError, match=r"out/checkpoint-1 could not be written: .*No space left"):
            train(args)
    assert not list((tmp_path / "out").glob("*checkpoint*"))
    assert train_again(args).step == 2


def test_a_tracker_that_is_not_installed(base_dir, tree, tmp_path, monkeypatch):
    monkeypatch.setattr(start, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"report_to: trackio is not installed; pip install gift-peft\[trackio\]"):
        train(arguments(base_dir, tree, tmp_path / "out", report_to="trackio"))
