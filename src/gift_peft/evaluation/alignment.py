"""Affine alignment of a prediction to its reference, then inversion and clipping as the protocol says.

    (s*, t*) = argmin sum over valid pixels of (s d + t - y)^2        (GIFT paper, affine-aligned evaluation)

in float64. Disparity is fitted to 1/y, never to y, unless the protocol says so; then a warning tells.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from gift_peft.evaluation.fitting import fit, nearest_to_grid
from gift_peft.evaluation.protocols import Protocol, get_protocol
from gift_peft.rules import KINDS


@dataclass(frozen=True)
class Alignment:
    """A prediction in its reference's space.

    Args:
        aligned (`np.ndarray` or `torch.Tensor`): (H,W) or (B,H,W) float64, what came in decides the type.
        scale, shift (`float` or (B,) array): of the fit, so `scale * prediction + shift` is in the fitted space.
        num_clipped (`int` or (B,) array): pixels of the whole picture that the protocol's range changed.
        num_nonpositive (`int` or (B,) array): pixels of the whole picture that were <= 0 after scale and shift,
            before inversion and clipping (or had no inverse to be fitted).
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


def resize_prediction(prediction: Any, size: tuple[int, int]) -> np.ndarray:
    """(h,w) numpy or torch to the reference's (H,W) float64, by OpenCV's bilinear interpolation where they differ."""
    prediction = to_numpy(prediction, np.float64)
    if prediction.shape != tuple(size):
        prediction = cv2.resize(prediction, size[::-1], interpolation=cv2.INTER_LINEAR)
    return prediction


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


def align(
    prediction: Any, reference: Any, valid: Any, protocol: str | Protocol = "gift", kind: str = "depth"
) -> Alignment:
    """Brings predictions into the space of their references, image by image.

    Args:
        prediction (`np.ndarray` or `torch.Tensor`): (H,W) or (B,H,W) in the model's native units; finite everywhere.
        reference: same shape; depth, in mm where the protocol clips (its range is in mm); anything in `native`.
        valid: same shape, bool: the pixels of the fit. Those without a finite reference > 0 are left out.
        protocol (`str` or `Protocol`): see `PROTOCOLS`.
        kind (`str`): what the prediction is, `depth` or `inverse_depth`.

    Raises:
        ValueError: unknown protocol or kind, disagreeing shapes, a mask that is not bool, a non-finite prediction,
            inverse depth under a protocol that compares depth and fits nothing.
        DegenerateFitError: (a ValueError) fewer than two distinct predictions in the fit.
    """
    rules = get_protocol(protocol)
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}: choose one of {', '.join(KINDS)}")
    if rules.space == "depth" and not rules.fits_scale and kind == "inverse_depth":
        raise ValueError(f"protocol {rules.name} fits nothing, so it compares depth with depth; this is inverse depth")
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
    usable = valid & known(reference)
    inverts = rules.inverts(kind)
    # A depth of zero or less has no (finite) inverse: it stays out of the fit and ends up at the near end.
    positive = prediction > np.finfo(np.float64).tiny if inverts and kind == "depth" else None
    if positive is not None:
        usable &= positive
        prediction = np.divide(1, prediction, out=np.zeros(prediction.shape), where=positive)
    farthest = reference[usable].max() if rules.floor == "ref_max" and inverts and usable.any() else None
    scale, shift = 1.0, 0.0
    if rules.fits_scale:
        loss = rules.loss_for(kind)
        pixels = nearest_to_grid(usable) if loss == "l1_rel" else usable
        target = reference[pixels]
        if inverts:
            np.reciprocal(target, out=target)
        scale, shift = fit(prediction[pixels], target, loss)
    if rules.space == "depth":
        _tell_fit_to_depth(rules, kind, scale)
    aligned = scale * prediction + shift
    if positive is not None:
        aligned[~positive] = np.inf
    num_nonpositive = int(np.count_nonzero(aligned <= 0))
    num_clipped = 0
    if inverts:
        if positive is not None:
            num_nonpositive += int(np.count_nonzero(~positive))
        if farthest is not None:
            low = aligned < 1 / farthest
            num_clipped += int(np.count_nonzero(low))
            aligned[low] = 1 / farthest
        _invert(aligned, rules.nonpositive)
    if rules.clip is not None:
        inside = np.clip(aligned, *rules.clip)
        num_clipped += int(np.count_nonzero(inside != aligned))
        aligned = inside
    return aligned, scale, shift, num_clipped, num_nonpositive


def _invert(values: np.ndarray, nonpositive: str) -> None:
    """Inverse depth to depth, in place; zero is infinitely far, and what is below it is far or near."""
    below = values < 0
    with np.errstate(divide="ignore", over="ignore"):
        np.divide(1, np.abs(values, out=values), out=values)
    values[below] = np.inf if nonpositive == "far" else -np.inf


def _tell_fit_to_depth(rules: Protocol, kind: str, scale: float) -> None:
    """A fit of disparity to depth is what some protocols say, but never goes unsaid."""
    if kind == "inverse_depth":
        warnings.warn(f"protocol {rules.name} fits inverse depth straight to depth, not to its inverse", stacklevel=4)
    elif scale < 0:
        warnings.warn(
            f"protocol {rules.name}: the fitted scale is negative, as if the prediction were inverse depth",
            stacklevel=4,
        )


def known(reference: np.ndarray) -> np.ndarray:
    """Where a reference says something: finite and > 0 (0 is a sensor's "unknown" and a ReLU's "nothing")."""
    return np.isfinite(reference) & (reference > 0)
