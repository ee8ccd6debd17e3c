"""The shift that makes an affine point map a camera's, differentiable and exportable.

MoGe predicts points up to a shift along z. A pinhole camera of focal length f sees a point (x, y, z + shift) at
f (x, y) / (z + shift); the shift is what brings the points of a picture closest to the pixels that they are of:

    min over f and shift of  sum |f (x, y) / (z + shift) - (u, v)|^2

on 64x64 points, as the package's `recover_focal_shift` does with scipy, which stops at a relative change of 1e-3.
Here f is eliminated, the shift is searched on a grid and polished by Newton's method to its end, all in tensors.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

SAMPLE = (64, 64)  # points of a picture, as in the package
NEAREST, FARTHEST, CANDIDATES = 1e-3, 1e3, 96  # of the smallest z + shift, in mean |z|
NEWTON_STEPS = 8


def view_plane(height: int, width: int, device: torch.device) -> Tensor:
    """(H,W,2) float64: pixel centers as u, v over half the diagonal of a picture, the center is 0."""
    diagonal = math.hypot(height, width)
    v, u = (torch.arange(side, device=device, dtype=torch.float64) * 2 + 1 - side for side in (height, width))
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1) / diagonal


def recover_shift(points: Tensor, valid: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """(focal, shift), each (B,) float64: focal over half the diagonal, shift in the unit of z.

    Gradients flow into the shift as the implicit function theorem has it. Without two valid points the shift is 0 and
    the focal length 1.

    Args: `points` (B,H,W,3) float; `valid` (B,H,W) bool, the points that count, default all.
    """
    height, width = points.shape[1:3]
    sampled = F.interpolate(points.permute(0, 3, 1, 2), SAMPLE, mode="nearest").flatten(2).double()
    plane = view_plane(height, width, points.device).permute(2, 0, 1)[None]
    uv = F.interpolate(plane, SAMPLE, mode="nearest").flatten(2)  # (1,2,K)
    if valid is None:
        weight = torch.ones_like(sampled[:, 0])
    else:
        weight = F.interpolate(valid[:, None].double(), SAMPLE, mode="nearest").flatten(1)
    xy, z = sampled[:, :2], sampled[:, 2]
    start, low, high, inside = _search(xy.detach(), z.detach(), uv, weight)
    shift = start
    for _ in range(NEWTON_STEPS):
        slope, curvature, _ = _stationarity(xy.detach(), z.detach(), uv, weight, shift)
        step = torch.where(curvature != 0, slope / curvature, torch.zeros_like(slope))
        shift = torch.minimum(torch.maximum(shift - step, low), high)
    slope, curvature, focal = _stationarity(xy, z, uv, weight, shift)
    # The value is the shift; its derivative is that of one more Newton step, which at the solution is exact.
    curvature = torch.where(inside & (curvature != 0), curvature.detach(), torch.full_like(curvature, torch.inf))
    shift = shift - (slope - slope.detach()) / curvature
    enough = weight.sum(1) >= 2
    return torch.where(enough, focal.detach(), 1.0), torch.where(enough, shift, 0.0)


def _search(xy: Tensor, z: Tensor, uv: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(B,) best shift on a logarithmic grid that keeps all points in front, its neighbors, and whether both exist."""
    scale = (weight * z.abs()).sum(1) / weight.sum(1).clamp(min=1)
    nearest = torch.where(weight > 0, z, torch.inf).amin(1)
    nearest = torch.where(nearest.isfinite(), nearest, 0.0)
    grid = torch.linspace(math.log(NEAREST), math.log(FARTHEST), CANDIDATES, dtype=z.dtype, device=z.device).exp()
    shifts = scale.clamp(min=torch.finfo(torch.float32).tiny)[:, None] * grid - nearest[:, None]  # (B,C)
    fits = torch.stack([_fit(xy, z, uv, weight, shifts[:, index]) for index in range(CANDIDATES)], dim=1)
    best = fits.argmax(1, keepdim=True)
    around = [shifts.gather(1, (best + turn).clamp(0, CANDIDATES - 1))[:, 0] for turn in (0, -1, 1)]
    return *around, ((best > 0) & (best < CANDIDATES - 1))[:, 0]


def _sums(xy: Tensor, z: Tensor, uv: Tensor, weight: Tensor, shift: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """1 / (z + shift), and per point the weighted q.u and q.q of its projection q."""
    depth = z + shift[:, None]
    inverse = torch.where(weight > 0, 1 / torch.where(depth == 0, torch.ones_like(depth), depth), 0.0)
    projected = xy * inverse[:, None]
    return inverse, weight * (projected * uv).sum(1), weight * projected.square().sum(1)


def _fit(xy: Tensor, z: Tensor, uv: Tensor, weight: Tensor, shift: Tensor) -> Tensor:
    """(B,) what a shift explains of the picture: the squared error is a constant minus this."""
    _, along, square = _sums(xy, z, uv, weight, shift)
    total = square.sum(1)
    return torch.where(total > 0, along.sum(1).square() / total.clamp(min=torch.finfo(total.dtype).tiny), 0.0)


def _stationarity(xy: Tensor, z: Tensor, uv: Tensor, weight: Tensor, shift: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(B,) of N^2 / D, with N = sum q.u and D = sum q.q: what is 0 at its extremum, the derivative of that, N / D."""
    inverse, along, square = _sums(xy, z, uv, weight, shift)
    n, d = along.sum(1), square.sum(1)
    n1, n2 = -(along * inverse).sum(1), 2 * (along * inverse.square()).sum(1)
    d1, d2 = -2 * (square * inverse).sum(1), 6 * (square * inverse.square()).sum(1)
    slope, curvature = 2 * n1 * d - n * d1, 2 * n2 * d + n1 * d1 - n * d2
    return slope, curvature, torch.where(d > 0, n / d.clamp(min=torch.finfo(d.dtype).tiny), 1.0)
