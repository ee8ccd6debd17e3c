"""Proxies: made once, whole or absent, the same from any number of processes, refused when they no longer hold."""

import itertools
import multiprocessing
import os
import shutil
import signal

import datasets
import pytest
import torch
from accelerate import PartialState, debug_launcher
from helpers.tiny import SIZE, tiny_processor, write_raw_tree
from PIL import Image
from torch.utils.data import DataLoader

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.proxies import read_header
from gift_peft.dataset.tensors import collate_group
from gift_peft.dataset.writer import write_gift_i
from gift_peft.models.identity import teacher_id
from gift_peft.models.loading import DepthModel
from gift_peft.models.pixels import to_pixel_values
from gift_peft.training import teacher
from gift_peft.training.teacher import make_proxies

GROUPS = ["train/scene_0", "train/scene_1", "validation/scene_100"]

pytestmark = pytest.mark.usefixtures("fresh_cache")


def copy_base(base_dir, folder):
    return shutil.copytree(base_dir, folder)


def files(folder):
    """Contents of all proxies under a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*.safetensors"))}


def test_prediction_is_float32_in_batches_of_two(model):
    pixels = torch.randn(5, 3, *SIZE)
    calls = []
    model.register_forward_pre_hook(
        lambda _, args, kwargs: calls.append(len(kwargs["pixel_values"])), with_kwargs=True
    )
    with torch.autocast("cpu", torch.bfloat16):
        proxies = DepthModel(model).predict(pixels)
    assert calls == [2, 2, 1]
    assert proxies.dtype == torch.float32 and proxies.shape == (5, *SIZE) and not proxies.requires_grad
    with torch.no_grad():
        expected = torch.cat([model(pixel_values=pixels[i : i + 2]).predicted_depth for i in (0, 2, 4)])
    assert torch.equal(proxies, expected)
    bare = lambda_model(model)  # returns the tensor itself
    assert torch.equal(DepthModel(bare).predict(pixels), expected)


def lambda_model(model):
    class Bare(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.inner = model

        def forward(self, pixel_values):
            return self.inner(pixel_values=pixel_values).predicted_depth

    return Bare()


def test_proxies_are_the_models_predictions(raw_tree, base_dir, model):
    folder = make_proxies(base_dir, raw_tree, size=SIZE)
    assert folder == raw_tree / "proxies" / teacher_id(base_dir) / "56x70"
    assert list(files(folder)) == [f"{group}.safetensors" for group in GROUPS]
    for split in ("train", "validation"):
        for row in load_gift_i(raw_tree, split, teacher=base_dir, size=SIZE):
            pixels = to_pixel_values(row["images"], tiny_processor(), SIZE)
            assert torch.equal(row["proxies"], DepthModel(model).predict(pixels))
            if split == "train":
                assert row["reference_proxy"] is None
            else:
                pixels = to_pixel_values([row["reference"]], tiny_processor(), SIZE)
                assert torch.equal(row["reference_proxy"], DepthModel(model).predict(pixels)[0])
            group = collate_group(row, tiny_processor(), SIZE)
            assert group.target.shape == group.mask.shape and group.target.dtype == torch.float32
    header = read_header(folder / "validation/scene_100.safetensors")
    assert header["size"] == "56x70" and header["processor"]["resample"] == 3
    assert len(header["images"]) == 2 and len(header["reference"]) == 32


def test_first_distillation_is_exactly_zero(raw_tree, base_dir, model):
    from gift_peft.adapters.recipes import get_gift_model
    from gift_peft.group_step import GroupStep

    make_proxies(base_dir, raw_tree, splits=["train"], size=SIZE)
    step = GroupStep(get_gift_model(model).eval())
    for row in load_gift_i(raw_tree, "train", teacher=base_dir):
        group = collate_group(row, tiny_processor(), SIZE)
        output = step.accumulate(group.pixel_values, group.mask, group.target, group.valid, group.names)
        assert output.distillation.item() == 0 and output.consistency.item() > 0


def test_rows_with_proxies_behave_as_a_dataset(raw_tree, base_dir, tmp_path):
    make_proxies(base_dir, raw_tree, size=SIZE, proxies_dir=tmp_path / "elsewhere")
    rows = load_gift_i(raw_tree, "train", teacher=base_dir, proxies_dir=tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / teacher_id(base_dir) / "56x70/train/scene_1.safetensors").unlink()
    assert rows[0]["proxies"].shape == (2, *SIZE)  # only the rows that are accessed are read
    assert rows["group_id"][:] == ["scene_0", "scene_1"]
    with pytest.raises(FileNotFoundError, match="scene_1"):
        rows[1]
    loader = DataLoader(
        rows.shuffle(seed=1).filter(lambda i: i == "scene_0", input_columns="group_id"), None, num_workers=1
    )
    assert [row["proxies"].shape for row in map(dict, loader_rows(loader))] == [(2, *SIZE)]
    one = load_gift_i(raw_tree, "train[:1]", teacher=base_dir, proxies_dir=tmp_path / "elsewhere")
    assert one[0]["proxies"].equal(rows[0]["proxies"])


def loader_rows(loader):
    loader.collate_fn = dict
    return loader


def test_prepared_and_default_size(raw_tree, base_dir, tmp_path, monkeypatch):
    """The recipe's size is the paper's; a generic model takes the processor's."""
    from gift_peft.adapters import recipes

    group = load_gift_i(raw_tree, "validation")[0]
    record = {"split": "validation", **{key: group[key] for key in ("group_id", "images", "masks", "reference")}}
    folder = write_gift_i([record], tmp_path / "prepared", license="cc0-1.0")
    monkeypatch.setattr(recipes, "RECIPES", {})
    made = make_proxies(base_dir, folder)
    assert read_header(made / "validation/scene_100.safetensors")["size"] == "56x70"
    plain = datasets.load_dataset(str(folder))  # the proxies beside the groups change nothing for others
    assert len(plain["validation"]) == 1
    assert load_gift_i(folder, "validation", teacher=base_dir)[0]["proxies"].shape == (2, *SIZE)


# ---- resuming and several processes ----


def test_finished_groups_are_kept(raw_tree, base_dir, monkeypatch):
    folder = make_proxies(base_dir, raw_tree, size=SIZE)
    before, times = files(folder), {path: path.stat().st_mtime_ns for path in folder.rglob("*.safetensors")}
    lost = folder / f"{GROUPS[1]}.safetensors"
    lost.unlink()
    asked = []
    predict = teacher._predict_row
    monkeypatch.setattr(teacher, "_predict_row", lambda *args: asked.append(args[1].group_id) or predict(*args))
    make_proxies(base_dir, raw_tree, size=SIZE)
    assert asked == ["scene_1"] and files(folder) == before
    assert all(path.stat().st_mtime_ns == time for path, time in times.items() if path != lost)
    make_proxies(base_dir, raw_tree, size=SIZE, overwrite=True)
    assert len(asked) == 4 and files(folder) == before


@pytest.mark.parametrize("moment", ["while writing", "before the rename"])
def test_kill_leaves_no_broken_file(raw_tree, base_dir, tmp_path, moment):
    whole = files(make_proxies(base_dir, raw_tree, size=SIZE, proxies_dir=tmp_path / "whole"))

    def killed():
        """Writes the first group's file, and dies with the second's half or wholly on disk."""
        calls = itertools.count()

        def fsync(descriptor):
            if next(calls) == 1:
                if moment == "while writing":
                    os.ftruncate(descriptor, 1000)
                os.kill(os.getpid(), signal.SIGKILL)

        os.fsync = fsync
        PartialState._reset_state()
        make_proxies(base_dir, raw_tree, size=SIZE)

    process = multiprocessing.get_context("fork").Process(target=killed)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    folder = raw_tree / "proxies" / teacher_id(base_dir) / "56x70"
    left = files(folder)
    assert len(left) == 1 and left.items() <= whole.items()
    assert len(list(folder.rglob(".*.partial"))) == 1
    make_proxies(base_dir, raw_tree, size=SIZE)
    assert files(folder) == whole and not list(folder.rglob(".*.partial"))


def _make_in_two(base, raw, proxies):
    PartialState._reset_state()
    PartialState(cpu=True)
    make_proxies(base, raw, size=SIZE, proxies_dir=proxies)


def _fail_in_two(base, raw, proxies, seen):
    try:
        _make_in_two(base, raw, proxies)
    except ValueError as error:
        (seen / str(PartialState().process_index)).write_text(str(error))


def test_two_processes_make_the_same_files(base_dir, tmp_path):
    raw = write_raw_tree(tmp_path / "raw", train=(2, 3, 5), validation=(1, 2))
    alone = make_proxies(base_dir, raw, size=SIZE, proxies_dir=tmp_path / "one")
    debug_launcher(_make_in_two, (base_dir, raw, tmp_path / "two"), num_processes=2)
    assert files(tmp_path / "two" / teacher_id(base_dir) / "56x70") == files(alone) and len(files(alone)) == 5
    # What one process stumbles over, all report, and none is left waiting.
    stale = tmp_path / "two" / teacher_id(base_dir) / "56x70" / "train" / "scene_1.safetensors"
    Image.new("RGB", (80, 60)).save(raw / "train/scene_1/0.png")
    (tmp_path / "seen").mkdir()
    debug_launcher(_fail_in_two, (base_dir, raw, tmp_path / "two", tmp_path / "seen"), num_processes=2)
    messages = {path.read_text() for path in (tmp_path / "seen").iterdir()}
    assert len(list((tmp_path / "seen").iterdir())) == 2 and len(messages) == 1
    assert f"stale proxy {stale}: image 0.png has changed since" in messages.pop()
