"""Adapters whose every weight has moved, as folders, and exports of them."""

import copy
from pathlib import Path

import numpy as np
import torch
from helpers.adapted import trained

from gift_peft import DepthModel, get_gift_model, save_adapter


def write_adapter(folder: Path, base, processor, size, head="full", move=trained) -> Path:
    """`base/` and `adapter/` of a network with a recipe, its weights moved; returns the adapter's folder."""
    base.save_pretrained(folder / "base")
    processor.save_pretrained(folder / "base")
    model = move(get_gift_model(base, head=head))
    save_adapter(model, folder / "adapter", str(folder / "base"), processor=processor, size=size)
    return folder / "adapter"


def nudged(model):
    """Move every trainable weight by a tenth of its size (0.02 where it is 0), as a short training would."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight in filter(lambda weight: weight.requires_grad, model.parameters()):
            size = 0.1 * float(weight.square().mean().sqrt()) or 0.02
            weight += size * torch.randn(weight.shape, generator=generator)
    return model


def relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    """The largest difference over the mean of the right values; infinite for another shape."""
    return float(np.abs(ours - theirs).max() / np.abs(theirs).mean()) if ours.shape == theirs.shape else np.inf


def pixels(batch: int, height: int, width: int) -> torch.Tensor:
    """(B,3,h,w): smooth shapes with grain, in the range of normalised photos."""
    generator = torch.Generator().manual_seed(height * 1000 + width)
    coarse = torch.rand(batch, 3, 5, 6, generator=generator)
    smooth = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic", align_corners=False)
    return 3 * (smooth + 0.1 * torch.randn(batch, 3, height, width, generator=generator)) - 1.5


def limit(model: DepthModel, x: torch.Tensor) -> float:
    """How far from torch a right graph may be: 2e-5, or what torch itself is from float64, three times.

    Most processors stay below 1e-5; others sum in another order.

    The tiny random networks multiply rounding, Metric3D's recurrence most; a trained one does not.
    """
    single = model.predict(x).numpy()
    with torch.no_grad():
        double = copy.deepcopy(model.network).double()(pixel_values=x.double()).predicted_depth.numpy()
    return max(2e-5, 3 * relative(single, double))
