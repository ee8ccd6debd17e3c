"""Surface targets against numpy, against planes that are known, and under changes of scale, shift and order."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.surface_targets import align_observations, paint_fills, plane_surface, quantile_surface, surface_target

H, W = 24, 32
ROWS, COLUMNS = np.mgrid[:H, :W]
SEEDS = st.integers(0, 2**32 - 1)
SCALES = st.sampled_from([1e-3, 0.1, 1.0, 30.0, 1e3])


def box(top=3, bottom=20, left=4, right=27):
    mask = np.zeros((H, W), bool)
    mask[top:bottom, left:right] = True
    return mask


def spread(values):
    return np.subtract(*np.percentile(values, (95, 5)))


def a_plane(rng):
    b, c = rng.uniform(-1, 1, 2) / W
    return 3 + b * COLUMNS + c * ROWS


def behind(plane, count, rng, share):
    """Observations of a plane through which a share of the pixels see something farther away."""
    values = np.repeat(plane[None], count, 0)
    farther = rng.random(values.shape) < share
    values[farther] -= rng.uniform(0.05, 1.5, np.count_nonzero(farther))
    return values


# ---- quantile ----


@settings(deadline=None)
@given(SEEDS, st.integers(1, 6), st.floats(0, 1))
def test_quantile_is_numpys_over_the_observations_that_hold_the_pixel(seed, count, q):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(count, 5, 6))
    mask = rng.random(values.shape) < 0.6
    found = quantile_surface(values, mask, q)
    for row in range(5):
        for column in range(6):
            own = values[:, row, column][mask[:, row, column]]
            expected = np.quantile(own, q) if own.size else np.nan
            np.testing.assert_allclose(found[row, column], expected, rtol=1e-12, atol=1e-12)


# ---- plane ----


@settings(deadline=None, max_examples=40)
@given(SEEDS, st.integers(2, 6), SCALES, st.floats(-5, 5))
def test_a_plane_behind_which_two_fifths_of_the_pixels_lie_is_recovered(seed, count, scale, shift):
    rng = np.random.default_rng(seed)
    plane = a_plane(rng)
    values = behind(plane, count, rng, share=0.4)
    mask = np.repeat(box()[None], count, 0)
    found = plane_surface(scale * values + scale * shift, mask, tau=0.7)
    assert np.array_equal(np.isfinite(found), box())
    error = np.abs(found / scale - shift - plane)[box()].max()
    assert error < 1e-3 * spread(values[mask])


@settings(deadline=None, max_examples=25)
@given(SEEDS, SCALES, st.floats(-3, 3))
def test_models_follow_scale_and_shift_of_the_prediction(seed, scale, shift):
    rng = np.random.default_rng(seed)
    values = behind(a_plane(rng), 3, rng, share=0.4) + 0.02 * rng.normal(size=(3, H, W))
    mask = np.repeat(box()[None], 3, 0)
    for compute in (lambda v: plane_surface(v, mask), lambda v: quantile_surface(v, mask, 0.8)):
        plain, moved = compute(values), compute(scale * values + scale * shift)
        assert np.nanmax(np.abs(moved / scale - shift - plain)) < 2e-4 * spread(values[mask])


def test_each_component_has_a_plane_of_its_own():
    rng = np.random.default_rng(0)
    left, right = box(right=12), box(left=18)
    planes = a_plane(rng), 1 + 0.05 * ROWS
    truth = np.where(left, planes[0], planes[1])
    values = behind(truth, 4, rng, share=0.3)
    found = plane_surface(values, np.repeat((left | right)[None], 4, 0))
    assert np.abs(found - truth)[left | right].max() < 1e-3


def test_hundreds_of_components_are_those_of_each_alone():
    rng = np.random.default_rng(2)
    union = np.kron(rng.random((6, 8)) < 0.5, np.ones((4, 4), bool))  # blocks that touch at corners too
    union[::2, ::2] |= rng.random((H // 2, W // 2)) < 0.2
    values, mask = 1 / (1 + rng.random((3, H, W)) + 0.1 * ROWS), np.repeat(union[None], 3, 0)
    target = surface_target(values, mask, kind="depth", model="plane")
    count, labels = cv2.connectedComponents(union.astype(np.uint8))
    assert len(target.model) == count - 1 > 10 and {"plane", "quantile"} == set(target.model)
    for number, model in enumerate(target.model, 1):
        alone = surface_target(values, np.repeat((labels == number)[None], 3, 0), kind="depth", model="plane")
        assert alone.model == [model]
        np.testing.assert_allclose(target.depth[:, labels == number], alone.depth[:, labels == number], rtol=1e-9)


@pytest.mark.parametrize("kind", ["depth", "inverse_depth"])
@pytest.mark.parametrize("pixels", [0, 1, 2, 15])
def test_a_target_of_which_few_pixels_are_known_gets_the_quantile(pixels, kind):
    """The mask is large, but pixels do not exist, or a depth of 0 says nothing."""
    rng = np.random.default_rng(pixels)
    values, mask = np.repeat(1 + rng.random((1, H, W)), 2, 0), np.repeat(box()[None], 2, 0)
    values[mask] += rng.random(np.count_nonzero(mask))
    known = ~mask
    known[:, 10, 5 : 5 + pixels] = True
    valid = None if kind == "depth" else known
    values = np.where(known, values, 0) if kind == "depth" else values
    if kind == "inverse_depth" and not pixels:
        with pytest.raises(ValueError, match="every mask is empty"):
            surface_target(values, mask, valid=valid)
        return
    target = surface_target(values, mask, kind=kind, valid=valid, model="plane", quantile=1)
    assert target.model == ["quantile"] and np.isfinite(target.depth).all()
    nearest, held = values.min(0) if kind == "depth" else values.max(0), known[0] & box()
    for observation in target.depth:
        np.testing.assert_allclose(observation[held], nearest[held], rtol=1e-6)


@pytest.mark.parametrize("pixels", [1, 2, 3, 4, 5])
def test_a_target_of_a_few_pixels_gets_the_quantile(pixels):
    rng = np.random.default_rng(pixels)
    values = rng.normal(size=(3, H, W))
    mask = np.zeros((3, H, W), bool)
    mask[:, 10, 10 : 10 + pixels] = True
    np.testing.assert_array_equal(plane_surface(values, mask, 0.7), quantile_surface(values, mask, 0.7))
    target = surface_target(values, mask, model="plane")
    assert target.model == ["quantile"] and np.isnan(target.residual).all()


def test_a_line_of_pixels_a_constant_and_a_plane_that_runs_away_get_the_quantile():
    rng = np.random.default_rng(1)
    line = np.zeros((2, H, W), bool)
    line[:, 10, :] = True
    constant, values = np.ones((2, H, W)), rng.normal(size=(2, H, W))
    mask = np.repeat(box()[None], 2, 0)
    np.testing.assert_array_equal(plane_surface(values, line), quantile_surface(values, line, 0.7))
    np.testing.assert_array_equal(plane_surface(constant, mask)[box()], 1)
    # A steep part that few pixels hold, far from where the rest of the component lies
    steep = np.where(COLUMNS < 8, COLUMNS, 0.0)[None]
    thin = np.zeros((1, H, W), bool)
    thin[:, 4:20, 1:7] = True
    thin[:, 11, 1:31] = True
    values = np.where(COLUMNS < 7, steep, 3.0)
    found = plane_surface(values, thin)
    assert np.nanmax(found) <= values[thin].max() + np.ptp(values[thin]) / 2


def test_a_plane_through_zero_is_refused_where_values_must_be_positive():
    plane = np.maximum(0.01, 0.3 - 0.02 * COLUMNS + 0 * ROWS)[None]
    mask = box(left=0, right=32)[None]
    steep = plane_surface(plane, mask, 0.5)
    assert np.nanmin(plane_surface(plane, mask, 0.5, positive=True)) > 0
    assert np.isfinite(steep[mask[0]]).all()


# ---- alignment ----


@settings(deadline=None, max_examples=25)
@given(SEEDS, st.integers(2, 5))
def test_observations_of_other_scale_and_shift_are_brought_together(seed, count):
    rng = np.random.default_rng(seed)
    scene = 2 + rng.random((H, W))
    mask = np.repeat(box()[None], count, 0)
    scale, shift = rng.uniform(0.5, 2, count), rng.uniform(-1, 1, count)
    seen = np.repeat(scene[None], count, 0)
    seen[mask] -= rng.uniform(0, 5, np.count_nonzero(mask))  # what is inside the masks has no say
    values = seen * scale[:, None, None] + shift[:, None, None]
    aligned, found, moved = align_observations(values, mask)
    np.testing.assert_allclose(aligned, values * found[:, None, None] + moved[:, None, None])
    outside = aligned[:, ~box()]
    assert np.abs(outside - outside[0]).max() < 1e-3 * spread(outside)


def test_one_moving_object_outside_does_not_move_the_alignment():
    rng = np.random.default_rng(3)
    values = np.repeat((2 + rng.random((H, W)))[None], 3, 0)
    values[1] = 3 * values[1] - 1
    values[1, :3, :8] += 40
    aligned, _, _ = align_observations(values, np.repeat(box()[None], 3, 0))
    rest = ~box()
    rest[:3, :8] = False
    assert np.abs(aligned[1] - aligned[0])[rest].max() < 1e-2


def test_too_little_in_common_leaves_observations_as_they_are():
    rng = np.random.default_rng(4)
    values = rng.random((2, H, W)) * [[[1.0]], [[9.0]]]
    everywhere = np.ones((2, H, W), bool)
    for mask, valid in ((everywhere, None), (~everywhere, ~everywhere), (np.repeat(box()[None], 2, 0), None)):
        aligned, scale, shift = align_observations(values, mask, valid)
        if valid is not None or mask.all():
            np.testing.assert_array_equal(aligned, values)
            assert (scale == 1).all() and (shift == 0).all()


# ---- the whole target ----


def test_the_target_of_a_group_is_in_each_observations_own_scale():
    rng = np.random.default_rng(5)
    plane = a_plane(rng)
    scene = np.where(box(), plane, 2 + rng.random((H, W)))
    seen = np.repeat(scene[None], 4, 0)
    seen[:, box()] = behind(plane, 4, rng, share=0.35)[:, box()]
    scale, shift = np.array([1.0, 2.0, 0.5, 3.0]), np.array([0.0, 1.0, -0.2, 0.4])
    values = seen * scale[:, None, None] + shift[:, None, None]
    target = surface_target(values, np.repeat(box()[None], 4, 0))
    assert target.model == ["plane"] and target.residual[0] < target.disagreement[0]
    np.testing.assert_array_equal(target.depth[:, ~box()], values[:, ~box()])
    for number in range(4):
        own = (target.depth[number] - shift[number]) / scale[number]
        assert np.abs(own - plane)[box()].max() < 5e-3


def test_depth_goes_through_inverse_depth_and_back():
    rng = np.random.default_rng(6)
    plane = 0.4 + 0.005 * COLUMNS + 0.002 * ROWS
    scene = np.where(box(), plane, 0.5)
    inverse = np.repeat(scene[None], 5, 0)
    inverse[:, box()] = np.maximum(behind(plane, 5, rng, share=0.35) * 1.0, 0.05)[:, box()]
    depth = 1 / inverse
    depth[0, 0, 0] = 0.0  # says nothing, and is no error
    target = surface_target(depth, np.repeat(box()[None], 5, 0), kind="depth")
    np.testing.assert_allclose(target.depth[2][box()], 1 / plane[box()], rtol=5e-3)
    assert target.depth[0, 0, 0] == 0


def test_a_single_photo_and_its_fills():
    rng = np.random.default_rng(7)
    plane = a_plane(rng)
    photo = np.where(box(), plane - rng.uniform(0.3, 1.2, (H, W)), 2 + rng.random((H, W)))[None]
    fills = np.repeat(photo[:, None], 6, 1)
    fills[:, :, box()] = plane[box()] + 0.003 * rng.normal(size=(6, np.count_nonzero(box())))
    mask = box()[None]
    target = surface_target(photo, mask, fills=fills)
    assert np.abs(target.depth[0] - plane)[box()].max() < 0.02
    alone = surface_target(photo, mask, fills=fills[:, :0])
    np.testing.assert_allclose(alone.depth, photo)  # one look alone says nothing new
    np.testing.assert_array_equal(surface_target(photo, mask).depth, alone.depth)
    assert alone.model == ["quantile"]


def test_masks_without_overlap_and_pixels_that_do_not_exist():
    rng = np.random.default_rng(8)
    values = rng.random((2, H, W)) + 1
    mask = np.stack([box(right=12), box(left=18)])
    target = surface_target(values, mask, model="quantile")
    np.testing.assert_allclose(target.depth, values)
    assert np.isnan(target.disagreement).all()
    mask = np.repeat(box()[None], 2, 0)
    valid = np.ones_like(mask)
    valid[0] = False
    values[0] = np.nan  # where nothing exists, nothing is looked at
    target = surface_target(values, mask, valid=valid, model="quantile")
    np.testing.assert_allclose(target.depth[1], values[1])


def test_a_mask_over_the_whole_photo():
    rng = np.random.default_rng(9)
    values = behind(a_plane(rng), 4, rng, share=0.4)
    target = surface_target(values, np.ones((4, H, W), bool))
    assert target.model == ["plane"] and np.isfinite(target.depth).all()


@settings(deadline=None, max_examples=20)
@given(SEEDS, st.permutations(range(4)))
def test_the_order_of_the_observations_does_not_matter(seed, order):
    rng = np.random.default_rng(seed)
    values = behind(a_plane(rng), 4, rng, share=0.4)
    mask = np.repeat(box()[None], 4, 0)
    order = list(order)
    first, second = surface_target(values, mask), surface_target(values[order], mask)
    np.testing.assert_allclose(second.depth, first.depth[order], atol=2e-4)


@pytest.mark.parametrize("quantile", [0.2, 0.8])
def test_disagreement_is_a_distance(quantile):
    values = np.random.default_rng(13).random((3, H, W))
    target = surface_target(values, np.repeat(box()[None], 3, 0), quantile=quantile)
    assert target.disagreement[0] > 0


def test_half_precision_comes_in():
    rng = np.random.default_rng(14)
    values, mask = torch.from_numpy(behind(a_plane(rng), 3, rng, share=0.4)), torch.from_numpy(box()).repeat(3, 1, 1)
    for dtype in (torch.bfloat16, torch.float16):
        found = surface_target(values.to(dtype), mask).depth
        assert found.dtype == torch.float64
        assert torch.equal(found, surface_target(values.to(dtype).double(), mask).depth)


def test_torch_comes_back_as_torch():
    rng = np.random.default_rng(10)
    values = torch.from_numpy(behind(a_plane(rng), 3, rng, share=0.4)).float()
    mask = torch.from_numpy(np.repeat(box()[None], 3, 0))
    for result in (
        quantile_surface(values, mask, 0.8),
        plane_surface(values, mask),
        surface_target(values, mask).depth,
        *align_observations(values, mask),
    ):
        assert isinstance(result, torch.Tensor) and result.dtype == torch.float64
    expected = surface_target(values.double().numpy(), mask.numpy()).depth
    np.testing.assert_allclose(surface_target(values, mask).depth.numpy(), expected)


def test_what_is_refused():
    values, mask = np.ones((2, H, W)), np.repeat(box()[None], 2, 0)
    broken = values.copy()
    broken[1, 10, 10] = np.nan
    for arguments, message in (
        ((broken, mask), "observation 1"),
        ((values, mask.astype(float)), "mask is float64"),
        ((values[0], mask[0]), r"\(N,H,W\)"),
        ((values, mask[:1]), r"\(N,H,W\)"),
        ((values[:0], mask[:0]), "none empty"),
    ):
        for function in (surface_target, plane_surface, align_observations):
            with pytest.raises(ValueError, match=message):
                function(*arguments)
    for options, message in (
        ({"kind": "disparity"}, "kind 'disparity'"),
        ({"model": "sphere"}, "model 'sphere'"),
        ({"surface": "wood"}, "surface 'wood'"),
        ({"tau": 1.0}, "tau 1.0"),
        ({"quantile": 1.5}, "quantile 1.5"),
        ({"fills": values}, r"fills \(2, 24, 32\)"),
        ({"fills": np.full((2, 1, H, W), np.inf)}, "predictions of the fills"),
    ):
        with pytest.raises(ValueError, match=message):
            surface_target(values, mask, **options)
    with pytest.raises(ValueError, match="every mask is empty"):
        surface_target(values, ~(mask | True))
    with pytest.raises(ValueError, match="none empty"):
        quantile_surface(values[:0], mask[:0], 0.8)


# ---- fills ----


def test_fills_are_plain_inside_and_the_photo_outside():
    rng = np.random.default_rng(11)
    photo = rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)
    mask = np.zeros((60, 80), bool)
    mask[10:50, 20:70] = True
    fills = list(paint_fills(photo, mask, 5, seed=3))
    inner = np.zeros_like(mask)
    inner[13:47, 23:67] = True
    for fill in fills:
        assert fill.dtype == np.uint8
        np.testing.assert_array_equal(fill[~mask], photo[~mask])
        assert len(np.unique(fill[inner].reshape(-1, 3), axis=0)) == 1
        color = fill[30, 40].astype(int)
        assert np.ptp(color) <= 77 and color.max() <= 230  # mostly grey
        edge = np.abs(fill[10, 20:70].astype(int) - photo[10, 20:70]).max(0)
        assert (edge < np.abs(color - photo[10, 20:70].astype(int)).max(0)).all()  # fades in
    assert len({fill[30, 40].tobytes() for fill in fills}) == 5


def test_fills_depend_on_seed_and_photo_alone():
    rng = np.random.default_rng(12)
    photo = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    mask = np.zeros((20, 30), bool)
    mask[5:15, 5:25] = True
    first = list(paint_fills(photo, mask, 3, seed=0))
    for again, once in zip(paint_fills(photo.copy(), mask, 2, seed=0), first, strict=False):
        np.testing.assert_array_equal(again, once)
    assert not np.array_equal(next(paint_fills(photo, mask, 1, seed=1))[10, 15], first[0][10, 15])
    other = photo.copy()
    other[0, 0] ^= 255
    assert not np.array_equal(next(paint_fills(other, mask, 1))[10, 15], first[0][10, 15])
    assert not list(paint_fills(photo, mask, 0))


def test_fills_that_are_refused():
    photo, mask = np.zeros((4, 5, 3), np.uint8), np.zeros((4, 5), bool)
    for arguments, message in (
        ((photo[..., 0], mask, 1), r"uint8 \(4, 5\)"),
        ((photo.astype(float), mask, 1), "float64"),
        ((photo, mask.astype(int), 1), "int64"),
        ((photo, mask[1:], 1), r"\(3, 5\)"),
        ((photo, mask, -1), "at least 0"),
    ):
        with pytest.raises(ValueError, match=message):
            list(paint_fills(*arguments))
