"""A run takes its device from accelerate and asks no other, whatever else the machine has; devices are mocked."""

import pytest
import torch
from accelerate import PartialState
from accelerate.state import AcceleratorState
from helpers.runs import arguments
from helpers.tiny import SIZE, tiny_processor, write_raw_tree

from gift_peft.adapters.folder import read_gift
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.loader import PreparedGroups, PreparedImages
from gift_peft.dataset.proxies import SurfaceSettings
from gift_peft.training import checkpoints, start, train, upload
from gift_peft.training.arguments import GiftTrainingArguments
from gift_peft.training.objectives import Consensus
from gift_peft.training.teacher import make_proxies

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.*deprecated.*:FutureWarning")


def refuse(*args, **options):
    raise AssertionError("this is neither the CPU's business nor anybody's")


def test_a_run_on_the_cpu_of_a_machine_with_a_gpu(base_dir, tmp_path, monkeypatch):
    tree, out = write_raw_tree(tmp_path / "raw", validation=()), tmp_path / "out"
    make = start.make_accelerator
    monkeypatch.setattr("gift_peft.training.loop.make_accelerator", lambda args: with_a_gpu(make(args), monkeypatch))
    monkeypatch.setattr("gift_peft.losses.prediction_spread", refuse)  # nobody reads it of a first look
    train(arguments(base_dir, tree, out, max_steps=1))
    assert read_gift(out / "adapter-last")["device"].endswith(" CPU")


def with_a_gpu(accelerator, monkeypatch):
    """From now on there seems to be one, and whoever asks it for anything fails."""
    assert accelerator.device.type == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for name in ("get_device_name", "get_rng_state", "set_rng_state", "mem_get_info", "empty_cache", "synchronize"):
        monkeypatch.setattr(torch.cuda, name, refuse)
    monkeypatch.setattr(torch.Tensor, "pin_memory", refuse)
    return accelerator


def test_on_cuda_the_record_names_the_gpu_and_the_rng_is_its(monkeypatch):
    device = torch.device("cuda", 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device=None: f"GPU {device.index}")
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda device=None: torch.tensor([device.index]))
    assert upload.run_record(GiftTrainingArguments("a/b", "c/d", "out"), device)["device"] == "GPU 1"
    assert checkpoints._rng_tensors(device)["cuda"].tolist() == [1]
    assert checkpoints._rng_tensors(torch.device("cpu")).keys() == {"cpu"}


def test_everything_that_an_update_takes_is_pinned_for_cuda(base_dir, raw_tree, monkeypatch):
    pinned = []
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor: pinned.append(id(tensor)) or tensor)
    make_proxies(base_dir, raw_tree, splits=["train"], size=SIZE)
    rows = load_gift_i(raw_tree, "train", teacher=base_dir, size=SIZE)
    objective = Consensus.__new__(Consensus)
    objective.groups = PreparedGroups(rows, tiny_processor(), SIZE, pin=False)
    objective._read(0)
    assert not pinned
    objective.groups = PreparedGroups(rows, tiny_processor(), SIZE, pin=True)
    inputs = objective._read(0).inputs
    tensors = [inputs.pixel_values, inputs.mask, inputs.target, *inputs.pairs]
    assert all(id(tensor) in pinned for tensor in tensors)


@pytest.mark.parametrize("flip", [False, True])
def test_single_images_are_pinned_as_they_are_shown(base_dir, raw_tree, monkeypatch, flip):
    surface = SurfaceSettings(fills=0)
    make_proxies(base_dir, raw_tree, splits=["train"], size=SIZE, surface=surface)
    rows = load_gift_i(raw_tree, "train", teacher=base_dir, size=SIZE, surface=surface)
    pinned = []
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor: pinned.append(id(tensor)) or tensor)
    image = PreparedImages(PreparedGroups(rows, tiny_processor(), SIZE, pin=True)).read(0, flip)
    assert all(id(tensor) in pinned for tensor in (image.pixel_values, image.mask, image.surface_target))


def test_processes_wait_longer_for_each_other_than_a_watchdog(tmp_path, monkeypatch):
    """One decodes a large dataset while the others wait; NCCL would give up after ten minutes."""
    given = []
    AcceleratorState._reset_state(reset_partial_state=True)
    real = PartialState.__init__

    def init(self, *args, **options):
        given.append(options.pop("timeout", None))
        real(self, *args, **options)

    monkeypatch.setattr(PartialState, "__init__", init)
    start.make_accelerator(GiftTrainingArguments("a/b", "c/d", str(tmp_path)))
    assert given[0].total_seconds() >= 3600
    AcceleratorState._reset_state(reset_partial_state=True)
