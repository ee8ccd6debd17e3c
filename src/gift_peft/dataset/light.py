"""A photo as if taken in other light: its brightness, contrast and colors changed by a draw that can be repeated.

Where something is does not depend on the light, so the photo keeps its targets.
"""

import numpy as np
import torch

from gift_peft.models.pixels import pixel_settings


def epoch_light(num_images: int, amount: float, seed: int, epoch: int) -> np.ndarray:
    """(num_images, 5): the factors of `in_light` for an epoch, uniform in 1 - amount to 1 + amount.

    They depend on the arguments alone.
    """
    return np.random.default_rng((seed, epoch, 1)).uniform(1 - amount, 1 + amount, (num_images, 5))


def in_light(pixel_values: torch.Tensor, factors: np.ndarray, processor) -> torch.Tensor:
    """Photos as the network takes them, with their colors changed.

    Args:
        pixel_values: (N, 3, h, w) float32, as `processor` makes them.
        factors: (N, 5), of the brightness, of the contrast around the photo's mean, and of red, green and blue, of
            which a third counts. What leaves the range of colors is cut off.
    """
    settings = pixel_settings(processor)
    white = 255 * (settings["rescale_factor"] or 1)
    mean, std = (
        torch.tensor(settings[name] or [neutral], dtype=torch.float32)[:, None, None]
        for name, neutral in (("image_mean", 0.0), ("image_std", 1.0))
    )
    brightness, contrast, colors = torch.as_tensor(factors, dtype=torch.float32)[..., None, None].split((1, 1, 3), 1)
    changed = (pixel_values * std + mean) * brightness * (1 + (colors - 1) / 3)
    middle = changed.mean((1, 2, 3), keepdim=True)
    return ((middle + (changed - middle) * contrast).clamp(0, white) - mean) / std
