"""Photos in other light: against a straight-line oracle on their colors, and the draws."""

import numpy as np
import pytest
import torch
from helpers.tiny import tiny_processor
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from gift_peft.dataset.light import epoch_light, in_light
from gift_peft.models.metric3d.image_processing_metric3d import Metric3DImageProcessorPil
from gift_peft.models.pixels import to_pixel_values
from gift_peft.models.vggt.image_processing_vggt import VggtImageProcessorPil

SIZE = (28, 42)
PROCESSORS = [tiny_processor, VggtImageProcessorPil, Metric3DImageProcessorPil]


def photo(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*SIZE, 3), np.uint8)


def changed(colors: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """(H,W,3) of 0 to 255 in float64, from the words of the docstring."""
    brightness, contrast, *shares = factors
    result = np.empty(colors.shape)
    for channel, share in enumerate(shares):
        result[..., channel] = colors[..., channel] * brightness * (1 + (share - 1) / 3)
    return np.clip(result.mean() + (result - result.mean()) * contrast, 0, 255)


@pytest.mark.parametrize("make", PROCESSORS)
@given(seed=st.integers(0, 50), amount=st.floats(0, 0.9))
def test_colors_are_those_of_the_oracle(make, seed, amount):
    processor, factors = make(), epoch_light(2, amount, seed, 0)
    photos = [photo(seed), photo(seed + 100)]
    got = in_light(to_pixel_values([Image.fromarray(each) for each in photos], processor, SIZE), factors, processor)
    black, white = (to_pixel_values([Image.new("RGB", SIZE[::-1], (v,) * 3)], processor, SIZE) for v in (0, 255))
    colors = 255 * ((got - black) / (white - black)).permute(0, 2, 3, 1).double().numpy()
    for one, each, drawn in zip(colors, photos, factors, strict=True):
        np.testing.assert_allclose(one, changed(each.astype(np.float64), drawn), atol=2e-3)


def test_no_change_is_the_photo():
    pixels = to_pixel_values([Image.fromarray(photo(0))], tiny_processor(), SIZE)
    torch.testing.assert_close(in_light(pixels, np.ones((1, 5)), tiny_processor()), pixels, rtol=0, atol=1e-5)


def test_draws_depend_on_their_arguments_alone_and_fill_the_range():
    drawn = epoch_light(1000, 0.3, 0, 3)
    assert np.array_equal(drawn, epoch_light(1000, 0.3, 0, 3))
    assert not np.array_equal(drawn, epoch_light(1000, 0.3, 0, 4))
    assert drawn.shape == (1000, 5) and 0.7 <= drawn.min() < 0.71 and 1.29 < drawn.max() < 1.3
