"""A group as the step takes it: what is refused before the first forward, and what a pair is."""

import math
from itertools import combinations

import numpy as np
import pytest
import torch
from helpers.group_tools import gift_model, group, toy
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.group_step import GroupStep
from gift_peft.losses import Pairs


@given(st.integers(1, 6), st.integers(1, 5), st.integers(1, 7), st.integers(0, 2**31), st.booleans())
@settings(max_examples=60, deadline=None)
def test_pairs_are_those_counted_one_by_one(count, height, width, seed, with_valid):
    rng = np.random.default_rng(seed)
    mask, valid = (torch.from_numpy(rng.random((count, height, width)) < p) for p in (rng.random(), 0.8))
    region = (mask & valid) if with_valid else mask
    pairs = Pairs.of(mask, valid if with_valid else None)
    for i, j in combinations(range(count), 2):
        assert pairs.count[i, j] == pairs.count[j, i] == (region[i] & region[j]).sum()
    assert pairs.num_pairs == sum(bool((region[i] & region[j]).any()) for i, j in combinations(range(count), 2))
    assert pairs.sizes.tolist() == region.flatten(1).sum(1).tolist()
    shared = region.flatten(1).sum(0) >= 2
    assert pairs.columns.tolist() == shared.nonzero()[:, 0].tolist()
    assert torch.equal(pairs.mask, region.flatten(1)[:, shared])


def change(index, value):
    def apply(data):
        data[index] = value(data[index]) if callable(value) else value

    return apply


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (change(0, None), "pixel_values must be a tensor, got NoneType"),
        (change(0, lambda x: x.numpy()), "pixel_values must be a tensor, got ndarray"),
        (change(0, lambda x: (x * 50).byte()), "floating point and not fp16, got .* torch.uint8"),
        (change(1, lambda x: x.numpy()), "mask must be a tensor, got ndarray"),
        (change(1, lambda x: x.byte()), "mask must be a bool tensor, got torch.uint8"),
        (change(1, lambda x: x[:, :5]), "mask is 5x28 but target is 28x28"),
        (change(2, None), "target must be a tensor, got NoneType"),
        (change(2, lambda x: x.long()), "target must be a floating point tensor, got torch.int64"),
        (change(2, lambda x: x[:, 0]), r"target must be \(N,H,W\)"),
        (change(3, lambda x: x.float()), "valid must be a bool tensor, got torch.float32"),
        (change(3, lambda x: x[:, :, :5]), "valid is 28x5 but target is 28x28"),
    ],
)
def test_refused_before_any_forward(changed, message):
    data = list(group(3, torch.float32))
    changed(data)
    model = toy()
    with pytest.raises(ValueError, match=message) as error:
        GroupStep(model).accumulate(*data)
    assert "\n" not in str(error.value) and not model.seen and all(p.grad is None for p in model.parameters())


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.5, True, "1", None])
@pytest.mark.parametrize("name", ["lambda_c", "lambda_d"])
def test_weights_of_the_loss_that_are_no_weights(name, value):
    with pytest.raises(ValueError, match=f"{name} must be a finite number, 0 or more"):
        GroupStep(toy(), **{name: value})


def test_an_image_smaller_than_a_patch_is_told():
    model = gift_model(torch.float32)
    data = group(2, torch.float32, size=(5, 6))
    with pytest.raises(ValueError, match=r"the model does not take images of 5x6 \(height x width\)") as error:
        GroupStep(model).accumulate(*data)
    assert "\n" not in str(error.value)
