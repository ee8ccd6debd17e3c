"""How often an update waits for the device: counted on tensors without content, which stand for a GPU's.

Whatever reads a value of such a tensor, asks which of its entries are set, or copies without `non_blocking` between
it and the host is a wait. So that they do not creep back.
"""

from contextlib import nullcontext
from types import SimpleNamespace
from unittest.mock import patch

import pytest
import torch
from helpers.group_tools import Toy, group
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from gift_peft.group_inputs import GroupInputs
from gift_peft.group_step import GroupStep
from gift_peft.training.loop import _update
from gift_peft.training.objectives import Consensus, Loaded
from gift_peft.training.speed import make_adam
from gift_peft.training.start import agree
from gift_peft.training.surface_step import PredictedDepth, SurfaceStep

READS = ("_local_scalar_dense", "item", "nonzero", "_unique", "unique_", "masked_select", "equal", "is_nonzero")


class Waits(TorchDispatchMode):
    """Inside, `.seen` lists the operators that made the host wait for the meta device; reads give ones."""

    def __init__(self):
        super().__init__()
        self.seen = []
        self.patches = []

    def __enter__(self):
        """Also lists that become tensors of the device, which PyTorch copies without asking a dispatch mode."""

        def new_tensor(tensor, data, **options):
            self.seen += ["blocking copy"] * tensor.is_meta
            return real_new(tensor, data, **options)

        def tensor(data, **options):
            self.seen += ["blocking copy"] * (torch.device(options.get("device") or "cpu").type == "meta")
            return real(data, **options)

        real_new, real = torch.Tensor.new_tensor, torch.tensor
        self.patches = [patch.object(torch.Tensor, "new_tensor", new_tensor), patch.object(torch, "tensor", tensor)]
        for each in self.patches:
            each.start()
        return super().__enter__()

    def __exit__(self, *error):
        for each in self.patches:
            each.stop()
        return super().__exit__(*error)

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, torch.Tensor)]
        name, on_device = function.overloadpacket.__name__, any(tensor.is_meta for tensor in tensors)
        if on_device and any(name.startswith(read) for read in READS):
            self.seen.append(name)
            return args[0].new_empty(0, args[0].ndim) if name == "nonzero" else 1.0
        if name == "_to_copy" and on_device and kwargs.get("device", torch.device("meta")).type == "cpu":
            self.seen.append("to host")
            return torch.ones(args[0].shape, dtype=kwargs.get("dtype") or args[0].dtype)
        to_device = name == "_to_copy" and torch.device(kwargs.get("device") or "cpu").type == "meta"
        if to_device and not on_device and not kwargs.get("non_blocking"):
            self.seen.append("blocking copy")
        if name == "copy_" and len({tensor.device.type for tensor in tensors}) == 2 and not (args[2:] or [False])[0]:
            self.seen.append("blocking copy")
        return function(*args, **kwargs)


class Accelerator:
    """As much of accelerate's as an update asks for."""

    def __init__(self, num_processes):
        self.num_processes, self.process_index = num_processes, 0
        self.mixed_precision, self.distributed_type = "no", "MULTI_GPU" if num_processes > 1 else "NO"
        self.device = torch.device("meta")

    def reduce(self, tensor, reduction):
        return tensor.clone()

    def gather(self, tensor):
        return torch.cat([tensor] * self.num_processes)


class Objective(Consensus):
    def __init__(self, step, optimizer):
        self.step, self.optimizer, self.args = step, optimizer, SimpleNamespace(channels_last=False)


def waits_of_an_update(num_images, num_processes, valid, retain):
    model, accelerator = Toy().to("meta"), Accelerator(num_processes)
    objective = Objective(
        GroupStep(model, retain=retain, accelerator=accelerator), make_adam(model.parameters(), 1e-3)
    )
    pixels, mask, target, there = group(num_images, torch.float32)
    loaded = Loaded("one", GroupInputs(pixels, mask, target, there if valid else None))
    waits = Waits()
    # Autocast knows no meta device; switched off, as here, it does nothing.
    no_autocast = patch.object(torch, "autocast", lambda *args, **options: nullcontext())
    # Asked once in a run for each size of images, and ones would be no answer.
    known_size = patch.object(GroupStep, "_share_size", lambda step, shape, canvas: step._shared.add(shape))
    with no_autocast, known_size, waits:
        for _ in range(2):  # the first one of a run may learn more
            agree(0, accelerator)
            waits.seen.clear()
            agree(0, accelerator)
            losses = _update(objective, loaded, accelerator, 0.0)
    assert all(isinstance(value, float) for value in losses[:3])
    return waits.seen


@pytest.mark.parametrize("valid", [False, True])
@pytest.mark.parametrize("retain", [0, 100])
@pytest.mark.parametrize("num_images", [2, 9, 55])
def test_one_process_waits_twice(num_images, valid, retain):
    """For what the step has found, and for whether the weights are finite."""
    assert len(waits_of_an_update(num_images, 1, valid, retain)) == 2


@pytest.mark.parametrize("num_images", [2, 9, 55])
def test_several_processes_wait_three_times(num_images):
    """And for whether one of them was asked to stop."""
    assert len(waits_of_an_update(num_images, 2, True, 0)) == 3


@pytest.mark.parametrize("valid", [False, True])
@pytest.mark.parametrize("num_images", [1, 4, 9])
def test_surface_targets_wait_once(num_images, valid):
    """And once more for the weights, as every update."""
    pixels, mask, target, there = group(num_images, torch.float32)
    step = SurfaceStep(PredictedDepth(Toy().to("meta")), micro_batch_size=4)
    waits = Waits()
    with waits:
        arrived = [part.to("meta", non_blocking=True) for part in (pixels, mask, target)]
        output = step.accumulate(*arrived, there.to("meta", non_blocking=True) if valid else None)
    assert len(waits.seen) == 1 and all(isinstance(value, float) for value in output)


class OnlyFloat32(TorchDispatchMode):
    """Apple's GPUs: no operator may make a float64 tensor of the device."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        output = function(*args, **(kwargs or {}))
        for tensor in tree_flatten(output)[0]:
            if isinstance(tensor, torch.Tensor) and tensor.is_meta and tensor.dtype == torch.float64:
                raise TypeError(f"{function}: this device has no float64")
        return output


@pytest.mark.parametrize("target", ["consensus", "surface"])
def test_an_update_makes_no_float64_on_the_device(target):
    with OnlyFloat32():
        if target == "consensus":
            assert waits_of_an_update(9, 1, True, 4)
        else:
            test_surface_targets_wait_once(4, True)
        with pytest.raises(TypeError, match="no float64"):
            torch.ones(2, device="meta").double()


@pytest.mark.parametrize(
    "wait",
    [
        lambda x: x.sum().item(),
        lambda x: bool(x.any()),
        lambda x: x.nonzero(),
        lambda x: x.cpu(),
        lambda x: x.tolist(),
        lambda x: torch.ones(2).to("meta"),
        lambda x: x.copy_(torch.ones(3)),
        lambda x: x.new_tensor([1.0, 2.0]),
        lambda x: torch.tensor([1.0, 2.0], device="meta"),
    ],
)
def test_waits_are_seen(wait):
    waits = Waits()
    with waits:
        wait(torch.ones(3, device="meta"))
    assert waits.seen


def test_the_mode_sees_nothing_where_nobody_waits():
    waits = Waits()
    with waits:
        x = torch.ones(3, device="meta") * 2
        torch.ones(3).to("meta", non_blocking=True)
        torch.ones(3).sum().item()
    assert x.is_meta and not waits.seen
