"""The matrices that stand for `interpolate` in exported graphs, against torch's own."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional as F

from gift_peft.deploy.resampling import resample, resampled_by_matrices

SIDES = st.integers(2, 40)  # torch's antialiased resize of pictures one pixel wide is wrong: it repeats the first row
WAYS = [
    {"mode": "nearest"},
    {"mode": "bilinear", "align_corners": False},
    {"mode": "bilinear", "align_corners": True},
    {"mode": "bilinear", "align_corners": False, "antialias": True},
    {"mode": "bicubic", "align_corners": False},
    {"mode": "bicubic", "align_corners": True},
    {"mode": "bicubic", "align_corners": False, "antialias": True},
]


@pytest.mark.parametrize("way", WAYS, ids=lambda way: "-".join(str(value) for value in way.values()))
@settings(max_examples=40, deadline=None)
@given(height=SIDES, width=SIDES, to=st.tuples(SIDES, SIDES), seed=st.integers(0, 99))
def test_it_is_interpolate_to_a_size(way, height, width, to, seed):
    x = torch.randn(2, 3, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    expected = F.interpolate(x, to, **way)
    assert torch.allclose(resample(x, to, **way), expected, rtol=0, atol=1e-9 * 40)


@pytest.mark.parametrize("way", WAYS[:3] + WAYS[4:6], ids=lambda way: "-".join(str(value) for value in way.values()))
@pytest.mark.parametrize("factor", [2, 3.5, 1.75, 0.5, (8.1 / 4, 10.1 / 4)])
@pytest.mark.parametrize("sides", [(4, 4), (7, 10), (16, 5)])
def test_it_is_interpolate_by_a_factor(way, factor, sides):
    """The factor, not the size it leads to, says where samples lie: 8.1 / 4 is not 8 / 4 (Metric3D's positions)."""
    if way["mode"] == "nearest" and isinstance(factor, tuple):
        factor = 2.25  # where the size comes out doubled, torch's nearest takes 2 for any factor
    x = torch.randn(2, 3, *sides, generator=torch.Generator().manual_seed(0))
    expected = F.interpolate(x, scale_factor=factor, **way)
    assert torch.allclose(resample(x, scale_factor=factor, **way), expected, rtol=0, atol=2e-5)


def test_a_mode_without_a_form_is_refused():
    with pytest.raises(NotImplementedError, match="nearest-exact"):
        resample(torch.rand(1, 1, 4, 4), (8, 8), mode="nearest-exact")


def test_models_take_it_only_inside_the_block():
    upsample, x = nn.Upsample(scale_factor=2, mode="bilinear"), torch.rand(1, 1, 3, 5)
    original = F.interpolate
    with resampled_by_matrices():
        assert F.interpolate is not original
        inside = upsample(x)
        volume = F.interpolate(torch.rand(1, 1, 2, 3, 5), scale_factor=2)  # not of pictures: torch's own
    assert F.interpolate is original and volume.shape == (1, 1, 4, 6, 10)
    assert torch.allclose(inside, upsample(x), atol=1e-6)
