"""The objective against a straight-line reading of the paper's equations, pixel by pixel in float64."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gift_peft import losses
from gift_peft.losses import (
    GeometryConsistencyError,
    geometry_consistency_error,
    gift_loss,
    group_consistency_loss,
    masked_l1,
    prediction_spread,
    require_finite,
    self_distillation_loss,
)

# ---- the oracle: plain loops over the equations, differentiable by autograd ----


def ell(a, b, region):
    return (a[region] - b[region]).abs().sum() / region.sum()


def consistency(depth, region):
    pairs = [(i, j) for i, j in itertools.combinations(range(len(depth)), 2) if (region[i] & region[j]).any()]
    if not pairs:
        return depth.sum() * 0, 0
    return sum(ell(depth[i], depth[j], region[i] & region[j]) for i, j in pairs) / len(pairs), len(pairs)


def distillation(depth, target, region):
    images = [i for i in range(len(depth)) if region[i].any()]
    if not images:
        return depth.sum() * 0
    return 2 * sum(ell(depth[i], target[i], region[i]) for i in images) / len(images)


def random_group(count, seed, density, dtype=torch.float64, with_valid=False, size=(5, 7)):
    generator = torch.Generator().manual_seed(seed)
    shape = (count, *size)
    depth = torch.randn(shape, generator=generator, dtype=torch.float64) * 3
    target = torch.randn(shape, generator=generator, dtype=torch.float64)
    mask = torch.rand(shape, generator=generator) < density
    valid = torch.rand(shape, generator=generator) < 0.7 if with_valid else None
    return depth.to(dtype), target.to(dtype), mask, valid


groups = {
    "count": st.integers(1, 7),
    "seed": st.integers(0, 10_000),
    "density": st.sampled_from([0.0, 0.02, 0.1, 0.5, 0.97, 1.0]),
    "with_valid": st.booleans(),
}


@settings(deadline=None, max_examples=150)
@given(**groups, lambdas=st.tuples(st.floats(0, 3), st.floats(0, 3)))
def test_values_and_gradients(count, seed, density, with_valid, lambdas):
    depth, target, mask, valid = random_group(count, seed, density, with_valid=with_valid)
    seen = torch.ones_like(mask) if valid is None else valid
    expected_c, expected_pairs = consistency(depth.requires_grad_(), mask & seen)
    expected_d = distillation(depth, target, ~mask & seen)
    expected = lambdas[0] * expected_c + lambdas[1] * expected_d
    (expected_gradient,) = torch.autograd.grad(expected, depth)

    loss = gift_loss(depth, target, mask, *lambdas, valid=valid)
    (gradient,) = torch.autograd.grad(loss.total, depth)
    assert isinstance(loss.num_pairs, int) and loss.num_pairs == expected_pairs
    for value, want in zip(loss[:3], (expected, expected_c, expected_d), strict=True):
        assert value.shape == () and value.dtype == torch.float64
        torch.testing.assert_close(value, want, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(group_consistency_loss(depth, mask, valid), loss.consistency, rtol=0, atol=0)
    torch.testing.assert_close(self_distillation_loss(depth, target, mask, valid), loss.distillation, rtol=0, atol=0)


@settings(deadline=None, max_examples=50)
@given(**groups)
def test_order_of_images_and_float32(count, seed, density, with_valid):
    depth, target, mask, valid = random_group(count, seed, density, torch.float32, with_valid)
    loss = gift_loss(depth, target, mask, valid=valid)
    assert loss.total.dtype == torch.float32
    double = gift_loss(depth.double(), target.double(), mask, valid=valid)
    torch.testing.assert_close(loss.total.double(), double.total, rtol=1e-5, atol=1e-6)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    shuffled = gift_loss(depth[order], target[order], mask[order], valid=None if valid is None else valid[order])
    torch.testing.assert_close(shuffled.total, loss.total, rtol=1e-5, atol=1e-6)


def test_worked_example():
    """Three images of 1x4: pairs 01 (pixels 0, 1), 02 (pixel 1), 12 (pixels 1, 2)."""
    depth = torch.tensor([[[1.0, 2, 3, 4]], [[2.0, 4, 6, 8]], [[0.0, 0, 0, 0]]])
    mask = torch.tensor([[[True, True, False, False]], [[True, True, True, False]], [[False, True, True, False]]])
    target = torch.zeros_like(depth)
    loss = gift_loss(depth, target, mask, lambda_c=10, lambda_d=1)
    assert loss.num_pairs == 3
    assert loss.consistency.item() == pytest.approx(((1 + 2) / 2 + 2 / 1 + (4 + 6) / 2) / 3)
    assert loss.distillation.item() == pytest.approx(2 * ((3 + 4) / 2 + 8 / 1 + 0) / 3)
    assert loss.total.item() == pytest.approx(10 * loss.consistency.item() + loss.distillation.item())


def test_gradcheck():
    depth, target, mask, valid = random_group(4, 3, 0.6, with_valid=True, size=(2, 3))
    assert torch.autograd.gradcheck(
        lambda d: gift_loss(d, target, mask, 0.7, 1.3, valid).total, depth.requires_grad_()
    )


def test_ties_have_no_gradient():
    depth = torch.ones(3, 2, 2, requires_grad=True)
    loss = gift_loss(depth, torch.ones(3, 2, 2), torch.tensor([[True, False], [True, False]]).expand(3, 2, 2))
    loss.total.backward()
    assert loss.total == 0 and not depth.grad.any()


@pytest.mark.parametrize("region", ["no target", "disjoint targets", "one image", "nothing valid"])
def test_no_pair_is_zero_and_backpropagates_zeros(region):
    depth, _, mask, valid = random_group(1 if region == "one image" else 4, 0, 0.5)
    if region == "no target":
        mask = torch.zeros_like(mask)
    if region == "disjoint targets":
        mask = torch.zeros_like(mask)
        mask[torch.arange(4), torch.arange(4)] = True
    if region == "nothing valid":
        valid = torch.zeros_like(mask)
    depth.requires_grad_()
    loss = gift_loss(depth, depth.detach() + 1, mask, valid=valid)
    assert loss.num_pairs == 0 and loss.consistency == 0
    loss.consistency.backward()
    assert torch.equal(depth.grad, torch.zeros_like(depth))


@pytest.mark.parametrize("everything_by", ["mask", "valid"])
def test_no_other_region_is_zero_and_backpropagates_zeros(everything_by):
    depth, target, mask, valid = random_group(3, 0, 0.5)
    if everything_by == "mask":
        mask = torch.ones_like(mask)
    else:
        valid = mask.clone()
    depth.requires_grad_()
    loss = self_distillation_loss(depth, target, mask, valid)
    loss.backward()
    assert loss == 0 and torch.equal(depth.grad, torch.zeros_like(depth))


def test_images_without_other_region_do_not_count():
    depth, target, mask, _ = random_group(4, 1, 0.5)
    mask[1] = True
    rest = [0, 2, 3]
    expected = self_distillation_loss(depth[rest], target[rest], mask[rest])
    torch.testing.assert_close(self_distillation_loss(depth, target, mask), expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype):
    depth, target, mask, _ = random_group(3, 2, 0.5, dtype)
    depth.requires_grad_()
    loss = gift_loss(depth, target, mask)
    expected = gift_loss(depth.detach().float(), target.float(), mask)
    assert loss.total.dtype == torch.float32 and torch.equal(loss.total, expected.total)
    loss.total.backward()
    assert depth.grad.dtype == dtype


def test_float64_target_is_not_rounded():
    depth, target, mask, _ = random_group(2, 2, 0.3)
    loss = gift_loss(depth.float(), target, mask)
    assert loss.total.dtype == torch.float64
    torch.testing.assert_close(loss.total, gift_loss(depth.float().double(), target, mask).total, rtol=0, atol=0)


def test_target_gets_no_gradient():
    depth, target, mask, _ = random_group(2, 0, 0.5)
    gift_loss(depth.requires_grad_(), target.requires_grad_(), mask).total.backward()
    assert depth.grad is not None and target.grad is None


def test_pair_sums_keep_no_graph_per_pair():
    """What the consistency term saves for backward grows with N, not with N(N-1)/2."""
    saved = []
    depth, _, mask, _ = random_group(12, 0, 0.5)
    with torch.autograd.graph.saved_tensors_hooks(lambda t: saved.append(t.numel()) or t, lambda t: t):
        group_consistency_loss(depth.requires_grad_(), mask)
    assert sum(saved) < 4 * depth.numel()


@pytest.mark.parametrize("same_masks", [True, False])
def test_blocks_of_pixels_add_up(same_masks, monkeypatch):
    depth, _, mask, _ = random_group(6, 1, 0.6, size=(9, 11))
    if same_masks:
        mask = mask[:1].expand_as(mask)
    expected, _ = consistency(depth.requires_grad_(), mask)
    (expected_gradient,) = torch.autograd.grad(expected, depth)
    for elements in (1, 6, 45, 10_000):
        monkeypatch.setattr(losses, "BLOCK_ELEMENTS", elements)
        value = group_consistency_loss(depth, mask)
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=0)
        torch.testing.assert_close(torch.autograd.grad(value, depth)[0], expected_gradient, rtol=1e-12, atol=1e-15)


class Allocations(TorchDispatchMode):
    """`.sizes`: bytes of every tensor that an operation makes."""

    def __init__(self):
        super().__init__()
        self.sizes = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        given = {t.untyped_storage().data_ptr() for t in tree_leaves(args) if isinstance(t, torch.Tensor)}
        for tensor in tree_leaves(result):
            if isinstance(tensor, torch.Tensor) and tensor.untyped_storage().data_ptr() not in given:
                self.sizes.append(tensor.untyped_storage().nbytes())
        return result


def test_temporary_memory_is_bounded_at_55_images(monkeypatch):
    """Nothing larger than an image or a block, besides the gradients of the two terms, their scaled one and sum."""
    depth, target, mask, _ = random_group(55, 0, 0.7, torch.float32, size=(40, 50))
    monkeypatch.setattr(losses, "BLOCK_ELEMENTS", 2000)
    with Allocations() as seen:
        loss = gift_loss(depth.requires_grad_(), target, mask)
        torch.autograd.grad(loss.total, depth)
    whole, image = 55 * 2000 * 4, 2000 * 8
    weights = 55 * 55 * 8
    large = [size for size in seen.sizes if size > max(image, weights)]
    assert sum(size == whole for size in large) <= 4
    assert all(size == whole or size <= whole // 4 for size in large)  # those of bool: finite, the other region


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_the_first_image_with_a_bad_value_is_named(dtype, bad):
    values = torch.randn(4, 3, 2, 5).to(dtype)
    require_finite(values, "x")
    values[2, 1, 1, 4] = values[3, 0, 0, 0] = bad
    with pytest.raises(ValueError, match=r"x of c \(image 2\) has NaN"):
        require_finite(values, "x", ["a", "b", "c", "d"])


def test_huge_differences_outside_the_mask_do_no_harm():
    depth = torch.full((2, 1, 2), 3e38)
    depth[1] *= -1
    depth[:, :, 0] = 1
    mask = torch.tensor([[[True, False]]]).expand(2, 1, 2)
    assert gift_loss(depth, depth, mask).total == 0


# ---- rounding, and devices without float64 ----


@pytest.mark.parametrize(("dtype", "bits"), [(torch.float32, 18), (torch.float64, 46)])
def test_differences_of_rounding_to_a_proxy_count_as_none(dtype, bits):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(3, 5, 7, generator=generator, dtype=dtype) + 1
    limit = target.amax((1, 2), keepdim=True) * 2.0**-bits
    noise = torch.rand(3, 5, 7, generator=generator, dtype=dtype) * 2 - 1
    mask = torch.zeros(3, 5, 7, dtype=torch.bool)
    for factor, expected in ((0.9, 0), (4, 1)):
        depth = (target + noise.sign() * limit * factor).requires_grad_()
        loss = self_distillation_loss(depth, target, mask)
        (gradient,) = torch.autograd.grad(loss, depth)
        assert bool(loss) == bool(gradient.any()) == bool(expected)
        assert expected == 0 or torch.equal(gradient.sign(), noise.sign())
    beyond = target.clone()
    beyond[1, 2, 3] += 1  # one pixel counts in full beside those of rounding
    loss = self_distillation_loss((beyond + noise * limit * 0.5).to(dtype), target, mask)
    assert loss.item() == pytest.approx(2 / 3 / 35, rel=1e-4)


class NoFloat64(TorchDispatchMode):
    """Apple's GPUs: no operator may make a float64 tensor."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        output = function(*args, **(kwargs or {}))
        for tensor in tree_leaves(output):
            if isinstance(tensor, torch.Tensor) and tensor.dtype == torch.float64:
                raise TypeError(f"{function}: MPS has no float64")
        return output


@pytest.mark.parametrize("with_valid", [False, True])
def test_float32_losses_make_no_float64(with_valid):
    depth, target, mask, valid = random_group(4, 0, 0.5, with_valid=True)
    depth = depth.float().requires_grad_()
    with NoFloat64():
        loss = gift_loss(depth, target.float(), mask, valid=valid if with_valid else None)
        loss.total.backward()
    assert depth.grad.any()


# ---- masked_l1 ----


def test_masked_l1():
    a, b = torch.tensor([1.0, 5.0, 9.0]), torch.tensor([2.0, 2.0, 2.0])
    assert masked_l1(a, b, torch.tensor([True, True, False])) == 2
    with pytest.raises(ValueError, match="empty"):
        masked_l1(a, b, torch.zeros(3, dtype=torch.bool))
    with pytest.raises(ValueError, match="bool"):
        masked_l1(a, b, torch.ones(3))
    with pytest.raises(ValueError, match="NaN"):
        masked_l1(a, b * math.nan, torch.ones(3, dtype=torch.bool))
    with pytest.raises(ValueError, match="shape"):
        masked_l1(a, b[:2], torch.ones(3, dtype=torch.bool))


# ---- what is refused ----


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g: g.update(mask=g["mask"].float()), "mask must be a bool tensor, got torch.float32"),
        (lambda g: g.update(mask=g["mask"].byte()), "mask must be a bool tensor, got torch.uint8"),
        (lambda g: g.update(mask=g["mask"][:, :2]), r"mask has shape \(3, 2, 7\) but depth has \(3, 5, 7\)"),
        (lambda g: g.update(mask=g["mask"][0]), r"mask has shape \(5, 7\)"),
        (lambda g: g.update(valid=torch.ones(3, 5, 7)), "valid must be a bool tensor"),
        (lambda g: g.update(valid=g["mask"][:2]), "valid has shape"),
        (lambda g: g.update(depth=g["depth"].long()), "floating point"),
        (lambda g: g.update(depth=g["depth"][0], mask=g["mask"][0]), r"depth must be \(N,H,W\)"),
        (lambda g: g.update(depth=g["depth"][:0], mask=g["mask"][:0]), "at least one image"),
        (lambda g: g.update(target=g["target"][..., :3]), "target has shape"),
        (lambda g: g.update(target=g["target"].int()), "floating point"),
        (lambda g: g["depth"][2].fill_(math.nan), "depth of image 2 has NaN"),
        (lambda g: g["depth"][1, 0, 0].fill_(math.inf), "depth of image 1 has NaN or infinite"),
        (lambda g: g["target"][0, 1, 1].fill_(-math.inf), "target of image 0 has NaN or infinite"),
        (lambda g: g.update(target=np.zeros((3, 5, 7))), "floating point tensors, got ndarray"),
    ],
)
def test_refused(change, message):
    group = dict(zip(("depth", "target", "mask", "valid"), random_group(3, 0, 0.5), strict=True))
    change(group)
    with pytest.raises(ValueError, match=message) as error:
        gift_loss(group["depth"], group["target"], group["mask"], valid=group["valid"])
    assert "\n" not in str(error.value)


# ---- GCE ----


def test_geometry_consistency_error():
    first, second, third = (random_group(n, n, d, with_valid=True) for n, d in ((2, 0.5), (5, 0.4), (3, 0.0)))
    samples = [(first[0], first[2]), (second[0], second[2], second[3]), (third[0], third[2])]
    expected = [consistency(first[0], first[2])[0], consistency(second[0], second[2] & second[3])[0]]
    assert geometry_consistency_error(iter(samples)) == pytest.approx(float(sum(expected)) / 2, rel=1e-12)

    error = GeometryConsistencyError()
    values = [error.update(*sample) for sample in samples]
    assert values[0] == pytest.approx(expected[0].item()) and math.isnan(values[2])
    assert (error.num_groups, error.num_skipped) == (2, 1)
    assert error.compute() == geometry_consistency_error(samples)
    spreads = [np.subtract(*np.percentile(d, (95, 5))) for d in (first[0], second[0][second[3]])]
    normalized = sum(float(e) / s for e, s in zip(expected, spreads, strict=True)) / 2
    assert error.compute_normalized() == pytest.approx(normalized, rel=1e-12)


def test_normalized_gce_ignores_the_scale_of_the_output():
    depth, _, mask, _ = random_group(4, 0, 0.5)
    plain, shrunk = GeometryConsistencyError(), GeometryConsistencyError()
    plain.update(depth, mask)
    shrunk.update(depth * 0.01 + 5, mask)
    assert shrunk.compute() == pytest.approx(plain.compute() / 100)
    assert shrunk.compute_normalized() == pytest.approx(plain.compute_normalized())


def test_gce_edges():
    assert math.isnan(geometry_consistency_error([]))
    error = GeometryConsistencyError()
    error.update(torch.ones(2, 3, 3), torch.ones(2, 3, 3, dtype=torch.bool))
    assert error.compute() == 0 and error.compute_normalized() == math.inf
    with pytest.raises(ValueError, match="NaN"):
        error.update(torch.full((2, 3, 3), math.nan), torch.ones(2, 3, 3, dtype=torch.bool))
    assert error.num_groups == 1
    assert math.isnan(prediction_spread(torch.ones(2, 2), torch.zeros(2, 2, dtype=torch.bool)))
