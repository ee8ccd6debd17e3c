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

SAMPLE = (64, 64)  # points of a picture, as in the package
NEAREST, FARTHEST, CANDIDATES = 1e-3, 1e3, 96  # of the smallest z + shift, in mean |z|
NEWTON_STEPS = 8


def view_plane(height: int, width: int, device: torch.device) -> Tensor:
    """(H,W,2) float64: pixel centers as u, v over half the diagonal of a picture, the center is 0."""
    diagonal = (height**2 + width**2) ** 0.5  # not math.hypot, at which an exporter fixes the size
    v, u = (torch.arange(side, device=device, dtype=torch.float64) * 2 + 1 - side for side in (height, width))
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1) / diagonal


def recover_shift(points: Tensor, valid: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """(focal, shift), each (B,) float64: focal over half the diagonal, shift in the unit of z.

    Gradients flow into the shift as the implicit function theorem has it. Without two valid points the shift is 0 and
    the focal length 1.

    Args: `points` (B,H,W,3) float; `valid` (B,H,W) bool, the points that count, default all.
    """
    height, width = points.shape[1:3]
    sampled = _sample(points).double()  # (B,K,3)
    uv = _sample(view_plane(height, width, points.device)[None])  # (1,K,2)
    weight = torch.ones_like(sampled[..., 0]) if valid is None else _sample(valid[..., None])[..., 0].double()
    xy, z = sampled[..., :2], torch.where(weight > 0, sampled[..., 2], 1.0)
    # With r = 1 / (z + shift), what f explains is N^2 / D, of N = sum(along r) and D = sum(square r^2).
    along, square = weight * (xy * uv).sum(-1), weight * xy.square().sum(-1)
    fixed = z.detach(), along.detach(), square.detach()
    shift, low, high, inside = _search(*fixed, weight)
    for _ in range(NEWTON_STEPS):
        slope, curvature, _ = _stationarity(*fixed, shift)
        step = torch.where(curvature != 0, slope / torch.where(curvature != 0, curvature, 1.0), 0.0)
        shift = torch.minimum(torch.maximum(shift - step, low), high)
    slope, curvature, focal = _stationarity(z, along, square, shift)
    # The value is the shift; its derivative is that of one more Newton step, which at the solution is exact.
    curvature = torch.where(inside & (curvature != 0), curvature.detach(), torch.inf)
    shift = shift - (slope - slope.detach()) / curvature
    enough = weight.sum(1) >= 2
    return torch.where(enough, focal.detach(), 1.0), torch.where(enough, shift, 0.0)


def _sample(values: Tensor) -> Tensor:
    """(B,K,C) of (B,H,W,C): the pixels that nearest interpolation takes; by index, which runtimes do in any type."""
    height, width = values.shape[1:3]
    rows, columns = (
        (torch.arange(count, dtype=torch.float32, device=values.device) * (side / count)).long().clamp(max=side - 1)
        for count, side in zip(SAMPLE, (height, width), strict=True)
    )
    return values[:, rows][:, :, columns].flatten(1, 2)


def _search(z: Tensor, along: Tensor, square: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(B,) best shift on a logarithmic grid that keeps all points in front, its neighbors, and whether both exist."""
    scale = (weight * z.abs()).sum(1) / weight.sum(1).clamp(min=1)
    nearest = torch.where(weight > 0, z, torch.inf).amin(1)
    nearest = torch.where(nearest.isfinite(), nearest, 0.0)
    grid = torch.linspace(math.log(NEAREST), math.log(FARTHEST), CANDIDATES, dtype=z.dtype, device=z.device).exp()
    shifts = scale.clamp(min=torch.finfo(torch.float32).tiny)[:, None] * grid - nearest[:, None]  # (B,C)
    inverse = _inverse(z[:, None] + shifts[..., None])
    # N^2 / D less what it is for points all at one distance, from what moves them off it: far away little does.
    n, d = along.sum(1, keepdim=True), square.sum(1, keepdim=True)
    safe = torch.where(d > 0, d, 1.0)
    plane = n / safe
    middle = (square[:, None] * inverse).sum(-1, keepdim=True) / safe[..., None]
    apart = inverse / torch.where(middle > 0, middle, 1.0) - 1
    tilt, bend = ((along - plane * square)[:, None] * apart).sum(-1), (square[:, None] * apart.square()).sum(-1)
    gain = (2 * n * tilt + tilt.square() - plane * n * bend) / torch.where(d > 0, d + bend, 1.0)
    best = gain.argmax(1, keepdim=True)
    around = [shifts.gather(1, (best + turn).clamp(0, CANDIDATES - 1))[:, 0] for turn in (0, -1, 1)]
    return around[0], around[1], around[2], ((best > 0) & (best < CANDIDATES - 1))[:, 0]


def _inverse(depth: Tensor) -> Tensor:
    return 1 / torch.where(depth == 0, 1.0, depth)


def _stationarity(z: Tensor, along: Tensor, square: Tensor, shift: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(B,) what is 0 where N^2 / D is extremal over the shift, its derivative, and N / D, the focal length.

    The first is (N D' - 2 N' D) / 2 D, and all are sums of what is small at each point, because products of the sums
    are nearly equal and in a runtime without float64 their differences would have no digits.
    """
    r = _inverse(z + shift[:, None])
    n, d = (along * r).sum(1), (square * r**2).sum(1)
    safe = torch.where(d > 0, d, 1.0)
    focal, middle = torch.where(d > 0, n / safe, 1.0), (square * r**3).sum(1) / safe
    left = along - focal[:, None] * square * r  # of a point by f
    left = left - ((left * r).sum(1) / safe)[:, None] * square * r  # and by what rounding took from f
    apart = r - middle[:, None]
    slope = (left * r * apart).sum(1)
    curvature = focal * (square * r**2 * apart**2).sum(1) - 2 * (left * r * apart**2).sum(1) - 3 * middle * slope
    return slope, curvature, focal
