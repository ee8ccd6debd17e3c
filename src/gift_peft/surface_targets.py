"""Where the surface is, computed once from frozen predictions (beyond the paper).

What is seen through a pane lies behind it, so of several predictions of one target the nearer ones are right more
often: the median of a group (the minimum of Eq. 3) is too far. In inverse depth, where nearer is larger and planes
stay planes under any scale and shift, the surface is an upper quantile per pixel, or a plane fitted so that it lies
above most predictions. Predictions of fills (the photo with its target painted in one color) count as observations.

Everything here is a pure function, computed in float64: numpy in, numpy out; torch in, torch out.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch

    Array = np.ndarray | torch.Tensor

RULE = "surface 1"  # changes with whatever changes a target or a fill: stored targets of another rule are refused
MODELS = ("auto", "plane", "quantile")
KINDS = ("depth", "inverse_depth")
SURFACES = (None, "mirror", "transparent")
MIN_PIXELS = 16  # of a component that some observation holds, for a plane; three parameters from fewer say nothing
MIN_COMMON = 64  # pixels outside every mask, for a scale and a shift
OUTLIER = 5  # times the median distance from the group: something else is there, for the alignment
SMOOTHING = 1e-4  # of the component's spread: residuals below it count as none
CONVERGED = 1e-6  # of the component's spread: a plane that moves less has been found
MAX_ROUNDS = 200
SAMPLE = 2**14  # pixels that a fit begins with
EDGE = 0.01  # of the shorter side: where paint fades in
GREY, TINT = 0.6, 0.3  # a fill's grey and what each channel adds to it, at most, of full brightness
PLANE_RATIO = 1.0  # "auto" takes the plane where it misses the nearer observations by less than this disagreement


@dataclass(frozen=True)
class SurfaceTarget:
    """What a group says about its surfaces.

    Args:
        depth (`Array`): (N,H,W) in each observation's own native units: the surface inside its mask, its own
            prediction everywhere else.
        model (`list[str]`): "plane" or "quantile" for each connected component of the masks' union, in reading order.
        residual (`list[float]`): per component, the median distance of the plane from the upper quantile of the
            observations, divided by the P95-P5 of the group's aligned inverse depth; NaN where no plane was fitted.
        disagreement (`list[float]`): per component, the median over its pixels of the distance between the upper
            quantile and the lower one (1 - quantile), divided likewise; NaN where no pixel is in two observations.
    """

    depth: Any
    model: list[str]
    residual: list[float]
    disagreement: list[float]


def quantile_surface(inverse_depth: Array, mask: Array, q: float) -> Array:
    """The q-quantile of every pixel over the observations whose mask holds it, linear as in numpy.

    Args:
        inverse_depth: (N,H,W), large is near. mask: (N,H,W) bool. q: 0 to 1.

    Returns:
        (H,W) float64, NaN where no mask is set.

    Raises:
        ValueError: shapes that differ, a mask that is not bool, a q outside of 0 to 1, NaN or infinity inside a mask.
    """
    values, inside, restore = _arrays(inverse_depth, mask)
    _check_share("q", q, closed=True)
    return restore(_quantile(values, inside, q))


def plane_surface(
    inverse_depth: Array, mask: Array, tau: float = 0.7, *, quantile: float | None = None, positive: bool = False
) -> Array:
    """One plane a + b u + c v for each connected component of the masks' union, by the pinball loss of level tau.

    Minimises sum rho_tau(y - a - b u - c v) over all pixels of all observations inside their masks, by iteratively
    reweighted least squares: weights (tau above the plane, 1 - tau below) / max(|r|, 1e-4 (P95-P5)), until the plane
    moves by less than 1e-6 (P95-P5). A component that is too small, thin or flat for a plane, or whose plane leaves
    the range of its observations by more than half of it, gets the per-pixel quantile instead.

    Args:
        inverse_depth: (N,H,W), large is near. mask: (N,H,W) bool. tau: between 0 and 1.
        quantile: of the components that get no plane; default tau.
        positive: refuse planes that are not positive everywhere (inverse depth of a model that predicts depth).

    Returns:
        (H,W) float64, NaN where no mask is set.

    Raises:
        ValueError: as `quantile_surface`.
    """
    values, inside, restore = _arrays(inverse_depth, mask)
    _check_share("tau", tau)
    if quantile is not None:
        _check_share("quantile", quantile, closed=True)
    surface = _quantile(values, inside, tau if quantile is None else quantile)
    for window, component in _components(inside.any(0)):
        plane = _plane(values[:, *window], inside[:, *window] & component, component, tau, positive)
        if plane is not None:
            surface[window][component] = plane
    return restore(surface)


def align_observations(inverse_depth: Array, mask: Array, valid: Array | None = None) -> tuple[Array, Array, Array]:
    """Scale and shift of every observation to the group, on the pixels that are outside of all masks.

    Relative models predict each image up to a scale and a shift of its own. Both are fitted robustly (least absolute
    deviations) to the per-pixel median of the observations, each first brought to median 0 and spread 1, and the
    result has the median scale and position of the group. Fewer than 64 common pixels, or a flat or inverted fit:
    scale 1 and shift 0.

    Args:
        inverse_depth: (N,H,W). mask: (N,H,W) bool, the target. valid: (N,H,W) bool, pixels that exist; default all.

    Returns:
        (aligned (N,H,W), scale (N,), shift (N,)), float64: aligned = scale * inverse_depth + shift.

    Raises:
        ValueError: as `quantile_surface`, of any pixel that is valid.
    """
    values, inside, restore = _arrays(inverse_depth, mask, everywhere=True, valid=valid)
    there = np.ones_like(inside) if valid is None else _numpy(valid)
    scale, shift = _scale_and_shift(values, (~inside & there).all(0))
    return restore(values * scale[:, None, None] + shift[:, None, None]), restore(scale), restore(shift)


def surface_target(
    depth: Array,
    mask: Array,
    surface: str | None = None,
    fills: Array | None = None,
    kind: str = "inverse_depth",
    valid: Array | None = None,
    model: str = "auto",
    quantile: float = 0.8,
    tau: float = 0.7,
) -> SurfaceTarget:
    """The surface of every observation in its own scale, from the group's frozen predictions and its fills'.

    Args:
        depth: (N,H,W) predictions in native units; one observation is a group too.
        mask: (N,H,W) bool, the target.
        surface: "mirror", "transparent" or None. Both kinds have the same defaults today.
        fills: (N,F,H,W) predictions of each photo with its target painted; F may be 0.
        kind: "inverse_depth", whose observations are aligned first, or "depth", which goes through 1/depth and back;
            there a value of 0 or less says nothing and is left out.
        valid: (N,H,W) bool, pixels that exist; default all.
        model: "plane", "quantile", or "auto": for each connected component of the masks' union the plane, where it
            misses the upper quantile of the observations by less than they disagree, else the quantile.
        quantile, tau: levels of the two models; higher is nearer.

    Raises:
        ValueError: shapes that differ, NaN or infinity in a valid pixel, every mask empty, an unknown kind, model or
            surface.
    """
    for name, value, known in (("kind", kind, KINDS), ("model", model, MODELS), ("surface", surface, SURFACES)):
        if value not in known:
            raise ValueError(f"{name} {value!r}: it is one of {', '.join(map(str, known))}")
    _check_share("quantile", quantile, closed=True)
    _check_share("tau", tau)
    values, inside, restore = _arrays(depth, mask, everywhere=True, valid=valid)
    there = np.ones_like(inside) if valid is None else _numpy(valid).copy()
    if not (inside & there).any():
        raise ValueError("every mask is empty: there is no target")
    stack, inside_stack, there_stack = _with_fills(values, inside, there, fills)
    if kind == "depth":
        there_stack &= stack > 0
        stack = 1 / np.where(there_stack, stack, 1.0)
        scale, shift = np.ones(len(stack)), np.zeros(len(stack))
    else:
        scale, shift = _scale_and_shift(stack, (~inside_stack & there_stack).all(0))
        stack = stack * scale[:, None, None] + shift[:, None, None]
    seen = inside_stack & there_stack
    spread = _spread(stack[there_stack])
    upper, lower = _quantile(stack, seen, quantile), _quantile(stack, seen, 1 - quantile)
    gap = np.where(seen.sum(0) > 1, np.abs(upper - lower), np.nan)
    found, models, residuals, disagreements = upper.copy(), [], [], []
    for window, component in _components(inside.any(0)):
        plane = None
        if model != "quantile":
            plane = _plane(stack[:, *window], seen[:, *window] & component, component, tau, kind == "depth")
        disagreement = _median(gap[window][component])
        residual = np.nan if plane is None else _median(np.abs(plane - upper[window][component]))
        takes_plane = plane is not None and (model == "plane" or residual < PLANE_RATIO * disagreement)
        if takes_plane:
            found[window][component] = plane
        models.append("plane" if takes_plane else "quantile")
        residuals.append(float(residual / spread) if spread else np.nan)
        disagreements.append(float(disagreement / spread) if spread else np.nan)
    own = (found - shift[: len(values), None, None]) / scale[: len(values), None, None]
    if kind == "depth":
        own = 1 / own
    target = np.where(inside & np.isfinite(own), own, values)
    return SurfaceTarget(restore(target), models, residuals, disagreements)


# ---- fills ----


def paint_fills(image: np.ndarray, mask: np.ndarray, count: int, seed: int = 0) -> Iterator[np.ndarray]:
    """The photo with its target painted in one plain, mostly grey color: `count` copies in other colors.

    The colors depend on the seed and the photo alone. Paint fades in over 1 % of the shorter side inwards, so that no
    hard edge stands where the mask may be a pixel off; outside of the mask every byte stays.

    Args:
        image: (H,W,3) uint8. mask: (H,W) bool.

    Raises:
        ValueError: another shape or type, a negative count.
    """
    import cv2

    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"the photo is {image.dtype} {image.shape}; it is uint8 (H,W,3)")
    if mask.dtype != bool or mask.shape != image.shape[:2]:
        raise ValueError(f"the mask is {mask.dtype} {mask.shape}; it is bool {image.shape[:2]}")
    if count < 0:
        raise ValueError(f"fills: at least 0, got {count}")
    content = hashlib.blake2b(np.ascontiguousarray(image), digest_size=8).digest()
    colors = np.random.default_rng((seed, int.from_bytes(content, "little")))
    edge = max(1.0, EDGE * min(mask.shape))
    depth_inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    paint = np.clip(depth_inside / (edge + 1), 0, 1)[..., None] * mask[..., None]
    for _ in range(count):
        color = 255 * np.clip(colors.uniform(0, GREY) + colors.uniform(0, TINT, 3), 0, 1)
        painted = np.round(image * (1 - paint) + color * paint).astype(np.uint8)
        yield np.where(mask[..., None], painted, image)


# ---- the models ----


def _quantile(values: np.ndarray, inside: np.ndarray, q: float) -> np.ndarray:
    """(H,W): of the values that are inside, per pixel; NaN where none is."""
    count = inside.sum(0)
    ordered = np.sort(np.where(inside, values, np.inf), axis=0)
    position = q * np.maximum(count - 1, 0)
    low = np.floor(position).astype(int)
    high = np.minimum(low + 1, np.maximum(count - 1, 0))
    below, above = (np.take_along_axis(ordered, index[None], 0)[0] for index in (low, high))
    with np.errstate(invalid="ignore"):  # inf - inf where nothing is inside
        return np.where(count > 0, below + (above - below) * (position - low), np.nan)


def _plane(
    values: np.ndarray, inside: np.ndarray, component: np.ndarray, tau: float, positive: bool
) -> np.ndarray | None:
    """The plane at the pixels of the component, or None where none can be trusted."""
    index, rows, columns = np.nonzero(inside)
    y = values[index, rows, columns]
    spread = _spread(y)
    if np.count_nonzero(inside.any(0)) < MIN_PIXELS or not spread:
        return None
    # Centered and scaled, so that the normal equations are as good as they can be.
    center, size = (rows.mean(), columns.mean()), max(np.ptp(rows), np.ptp(columns)) / 2
    u, v = (columns - center[1]) / size, (rows - center[0]) / size
    if np.linalg.eigvalsh(np.cov(u, v))[0] < 1e-6:
        return None  # a line of pixels carries any plane
    base = np.median(y)
    solution = _pinball(np.stack([np.ones_like(u), u, v]), (y - base) / spread, tau)
    rows, columns = np.nonzero(component)
    design = (np.ones(len(rows)), (columns - center[1]) / size, (rows - center[0]) / size)
    plane = base + spread * sum(weight * column for weight, column in zip(solution, design, strict=True))
    room = np.ptp(y) / 2
    if not np.isfinite(plane).all() or plane.min() < y.min() - room or plane.max() > y.max() + room:
        return None
    return None if positive and plane.min() <= 0 else plane


def _pinball(design: np.ndarray, y: np.ndarray, tau: float) -> np.ndarray:
    """(K,) weights of the K rows of `design` that minimise sum rho_tau(y - weights @ design); y has spread 1."""
    solution, weights, step = np.zeros(len(design)), np.ones_like(y), len(y) // SAMPLE
    if step > 1:  # begin where every `step`-th pixel leads: few rounds are left for all of them
        solution = _pinball(design[:, ::step], y[::step], tau)
    for number in range(MAX_ROUNDS):
        if number or step > 1:
            residual = y - solution @ design
            weights = np.where(residual > 0, tau, 1 - tau) / np.maximum(np.abs(residual), SMOOTHING)
        weighted = design * weights
        new = np.linalg.lstsq(weighted @ design.T, weighted @ y, rcond=None)[0]
        moved = np.abs(new - solution).sum()  # bounds the change at every pixel: the design is at most about 1
        solution = new
        if moved < CONVERGED:
            break
    return solution


def _scale_and_shift(values: np.ndarray, common: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) each: what brings every observation to the group on the common pixels."""
    scale, shift, pixels = np.ones(len(values)), np.zeros(len(values)), values[:, common]
    if len(values) < 2 or pixels.shape[1] < MIN_COMMON:
        return scale, shift
    pixels = pixels[:, :: max(1, pixels.shape[1] // SAMPLE)]  # so many say a scale and a shift as well as all
    middle = np.median(pixels, axis=1)
    size = np.median(np.abs(pixels - middle[:, None]), axis=1)
    if not (size > 0).all():
        return scale, shift
    brought = (pixels - middle[:, None]) / size[:, None] * np.median(size) + np.median(middle)
    reference = np.median(brought, axis=0)
    for number, (own, rough) in enumerate(zip(pixels, brought, strict=True)):
        # Least absolute deviations forgive what is wrong in y, not what lies far out in x: that is left out first.
        away = np.abs(rough - reference)
        kept = away <= OUTLIER * np.median(away)
        a, b = _least_absolute(own[kept], reference[kept])
        if a > 0 and np.isfinite([a, b]).all():
            scale[number], shift[number] = a, b
    return scale, shift


def _least_absolute(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """a, b that minimise sum |y - a x - b|."""
    spread, middle, size = _spread(y), np.median(x), _spread(x)
    if not spread or not size:
        return 1.0, 0.0
    offset, slope = _pinball(np.stack([np.ones_like(x), (x - middle) / size]), y / spread, 0.5)
    slope *= spread / size
    return float(slope), float(offset * spread - slope * middle)


def _components(union: np.ndarray) -> list[tuple[tuple[slice, slice], np.ndarray]]:
    """The connected parts (8 neighbors) of a (H,W) bool region, in reading order: (window, which pixels of it)."""
    import cv2

    count, labels, boxes, _ = cv2.connectedComponentsWithStats(union.astype(np.uint8), connectivity=8)
    windows = [(slice(top, top + rows), slice(left, left + columns)) for left, top, columns, rows, _ in boxes]
    return [(windows[number], labels[windows[number]] == number) for number in range(1, count)]


# ---- arrays ----


def _with_fills(
    values: np.ndarray, inside: np.ndarray, there: np.ndarray, fills: Array | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observations first, then every fill with the mask and the pixels of its photo."""
    if fills is None:
        return values, inside, there
    painted = _numpy(fills).astype(np.float64)
    if painted.ndim != 4 or painted.shape[0] != len(values) or painted.shape[2:] != values.shape[1:]:
        raise ValueError(f"fills {painted.shape}: (N,F,H,W) of the observations {values.shape}")
    count = painted.shape[1]
    painted = painted.reshape(-1, *values.shape[1:])
    more = [np.repeat(array, count, axis=0) for array in (inside, there)]
    if not np.isfinite(painted[more[1]]).all():
        raise ValueError("NaN or infinite values in the predictions of the fills")
    pairs = ((values, painted), (inside, more[0]), (there, more[1]))
    return tuple(np.concatenate(pair) for pair in pairs)


def _arrays(
    values: Array, mask: Array, everywhere: bool = False, valid: Array | None = None
) -> tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], Any]]:
    """(values float64, mask, what turns a result into the caller's kind of array), checked."""
    inside = _numpy(mask)
    array = _numpy(values).astype(np.float64)
    checked = [("mask", inside), *([] if valid is None else [("valid", _numpy(valid))])]
    for name, region in checked:
        if region.dtype != bool:
            raise ValueError(f"{name} is {region.dtype}; it is bool")
        if array.ndim != 3 or not array.size or region.shape != array.shape:
            raise ValueError(f"predictions {array.shape} and {name} {region.shape}: both are (N,H,W), none empty")
    region = checked[-1][1] if valid is not None else (np.ones_like(inside) if everywhere else inside)
    for number, (own, there) in enumerate(zip(array, region, strict=True)):
        if not np.isfinite(own[there]).all():
            raise ValueError(f"NaN or infinite values in the prediction of observation {number}")
    if isinstance(values, np.ndarray):
        return array, inside, lambda result: result
    import torch

    return array, inside, lambda result: torch.from_numpy(np.ascontiguousarray(result)).to(values.device)


def _numpy(array: Array) -> np.ndarray:
    if isinstance(array, np.ndarray):
        return array
    array = array.detach().cpu()
    return (array.double() if array.is_floating_point() else array).numpy()  # numpy has no bfloat16


def _spread(values: np.ndarray) -> float:
    """P95 - P5; 0 for nothing."""
    return float(np.subtract(*np.percentile(values, (95, 5)))) if values.size else 0.0


def _median(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else np.nan


def _check_share(name: str, value: float, closed: bool = False) -> None:
    if not (0 <= value <= 1 if closed else 0 < value < 1):
        raise ValueError(f"{name} {value}: it lies {'from 0 to 1' if closed else 'between 0 and 1'}")
