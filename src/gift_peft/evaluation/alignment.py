"""Affine alignment of a prediction to its reference, then inversion and clipping as the protocol says.

    (s*, t*) = argmin sum over valid pixels of (s d + t - y)^2        (GIFT paper, affine-aligned evaluation)

in closed form: float64, centred data. Disparity is fitted to 1/y where the protocol's space is `auto`, never to y.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from gift_peft.evaluation.protocols import KINDS, Protocol, get_protocol


class DegenerateFitError(ValueError):
    """Fewer than two distinct values to fit: no scale and shift exist."""


@dataclass(frozen=True)
class Alignment:
    """A prediction in its reference's space.

    Args:
        aligned (`np.ndarray` or `torch.Tensor`): (H,W) or (B,H,W) float64, what came in decides the type.
        scale, shift (`float` or (B,) array): of the fit, so `scale * prediction + shift` is in the fitted space.
        num_clipped (`int` or (B,) array): pixels of the whole picture that the protocol's range changed.
        num_nonpositive (`int` or (B,) array): pixels of the whole picture that were <= 0 after scale and shift,
            before inversion and clipping.
    """

    aligned: Any
    scale: Any
    shift: Any
    num_clipped: Any
    num_nonpositive: Any


def to_numpy(value: Any, dtype: type) -> np.ndarray:
    """An array of `dtype` from numpy or torch, on any device and in any precision (numpy knows no bfloat16)."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu()
        value = (value.double() if value.is_floating_point() else value).numpy()
    return np.asarray(value).astype(dtype, copy=False)


def like(value: np.ndarray, example: Any) -> Any:
    """`value` as the type (and on the device) of `example`."""
    return torch.from_numpy(value).to(example.device) if isinstance(example, torch.Tensor) else value


def check_shapes(**arrays: np.ndarray) -> None:
    """All (H,W), or all (B,H,W), of one size; ValueError names the arguments."""
    shapes = {name: array.shape for name, array in arrays.items()}
    if len(set(shapes.values())) > 1 or len(next(iter(shapes.values()))) not in (2, 3):
        listed = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(f"shapes must agree and be (H,W) or (B,H,W): {listed}")


def check_mask(name: str, mask: Any) -> np.ndarray:
    """A boolean array; ValueError for any other type, because 0/255 masks index silently wrong."""
    dtype = getattr(mask, "dtype", type(mask).__name__)
    if str(dtype).removeprefix("torch.") != "bool":
        raise ValueError(f"{name} must be boolean, got {dtype}")
    return to_numpy(mask, bool)


def fit_scale_shift(prediction: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """Least-squares scale and shift of two flat float64 arrays.

    Raises:
        DegenerateFitError: fewer than two distinct predictions.
    """
    spread = float(np.ptp(prediction)) if prediction.size else 0.0
    if spread < np.finfo(np.float64).tiny / np.finfo(np.float64).eps:  # equal up to subnormal noise
        raise DegenerateFitError(
            f"cannot fit scale and shift: the prediction has fewer than two distinct values "
            f"in the {prediction.size} pixels of the fit"
        )
    # Centred and divided by the spread, so that the normal equations lose no digits to a large offset or tiny units.
    mean, target_mean = prediction.mean(), target.mean()
    centred = (prediction - mean) / spread
    scale = float(centred @ (target - target_mean) / (centred @ centred)) / spread
    return scale, float(target_mean - scale * mean)


def align(
    prediction: Any, reference: Any, valid: Any, protocol: str | Protocol = "gift", kind: str = "depth"
) -> Alignment:
    """Brings predictions into the space of their references, image by image.

    Args:
        prediction (`np.ndarray` or `torch.Tensor`): (H,W) or (B,H,W) in the model's native units; finite everywhere.
        reference: same shape; depth, in mm for `gift` (whose clip range is in mm); anything in `native`.
        valid: same shape, bool: the pixels of the fit. Those without a finite reference > 0 are left out.
        protocol (`str` or `Protocol`): see `PROTOCOLS`.
        kind (`str`): what the prediction is, `depth` or `inverse_depth`.

    Raises:
        ValueError: unknown protocol or kind, disagreeing shapes, a mask that is not bool, a non-finite prediction.
        DegenerateFitError: (a ValueError) fewer than two distinct predictions in the fit.
    """
    rules = get_protocol(protocol)
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}: choose one of {', '.join(KINDS)}")
    predictions, references = to_numpy(prediction, np.float64), to_numpy(reference, np.float64)
    valids = check_mask("valid", valid)
    check_shapes(prediction=predictions, reference=references, valid=valids)
    bad = np.count_nonzero(~np.isfinite(predictions))
    if bad:
        raise ValueError(f"prediction has {bad} NaN or infinite values")
    if predictions.ndim == 2:
        aligned, *numbers = _align_image(predictions, references, valids, rules, kind)
        return Alignment(like(aligned, prediction), *numbers)
    if not len(predictions):
        raise ValueError("prediction holds no images")
    results = [_align_image(*image, rules, kind) for image in zip(predictions, references, valids, strict=True)]
    return Alignment(*(like(np.stack(column), prediction) for column in zip(*results, strict=True)))


def _align_image(
    prediction, reference, valid, rules: Protocol, kind: str
) -> tuple[np.ndarray, float, float, int, int]:
    fit = valid & known(reference)
    invert = rules.space == "auto" and kind == "inverse_depth"
    target = 1 / reference[fit] if invert else reference[fit]
    scale, shift = fit_scale_shift(prediction[fit], target)
    aligned = scale * prediction + shift
    num_nonpositive = int(np.count_nonzero(aligned <= 0))
    if invert:
        # A disparity of zero or less is beyond infinity: far, not a negative depth.
        with np.errstate(divide="ignore", over="ignore"):
            aligned = np.where(aligned > 0, 1 / aligned, np.inf)
    num_clipped = 0
    if rules.clip is not None:
        inside = np.clip(aligned, *rules.clip)
        num_clipped = int(np.count_nonzero(inside != aligned))
        aligned = inside
    return aligned, scale, shift, num_clipped, num_nonpositive


def known(reference: np.ndarray) -> np.ndarray:
    """Where a reference says something: finite and > 0 (0 is a sensor's "unknown" and a ReLU's "nothing")."""
    return np.isfinite(reference) & (reference > 0)
