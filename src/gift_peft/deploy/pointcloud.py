"""A depth map as colored points (`--pointcloud ply|glb`), without the veils that edges would draw between surfaces."""

import importlib.util
import io

import numpy as np

from gift_peft.deploy.intrinsics import Intrinsics

EDGE = 0.04  # relative step to a neighbor, beyond what a plane does, at which a pixel lies on an edge


def cut_edges(depth: np.ndarray, edge: float = EDGE) -> np.ndarray:
    """(H,W) bool: the pixels that lie on a surface.

    A prediction is smooth where surfaces meet, which would be points in the air. On a plane inverse depth is linear,
    so what is measured is its second difference, relative to itself: slanted planes stay whole.

    Args:
        depth (`np.ndarray`): (H,W), > 0 where known; what is not finite or not positive is never kept.
        edge (`float`): largest second difference that is kept.
    """
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0.0)
    kept = known.copy()
    for axis in (0, 1):
        ahead, behind = (np.roll(inverse, shift, axis) for shift in (-1, 1))
        bend = np.abs(ahead + behind - 2 * inverse)
        first, last = (np.s_[:1], np.s_[-1:]) if axis == 0 else (np.s_[:, :1], np.s_[:, -1:])
        bend[first], bend[last] = 0, 0  # a border pixel has one neighbor only
        kept &= bend <= edge * inverse
    return kept


def to_points(
    depth: np.ndarray, picture: np.ndarray, camera: Intrinsics, edge: float = EDGE
) -> tuple[np.ndarray, np.ndarray]:
    """Points (K,3) float32 in the depth's unit, x right, y down, z away from the camera, and colors (K,3) uint8.

    `depth` (H,W) is z-depth, `picture` (H,W,3) uint8.
    """
    kept = cut_edges(depth, edge)
    points = camera.rays()[kept] * depth[kept][:, None]
    return points.astype(np.float32), picture[kept]


def encode_points(points: np.ndarray, colors: np.ndarray, form: str) -> bytes:
    """A file of points: `ply` with the axes of a camera (x right, y down, z away), `glb` with those of glTF (y up).

    The colors of a ply are those of the picture; glTF wants them as amounts of light (linear RGB).
    """
    import trimesh

    if form == "glb":
        points = points * np.float32([1, -1, -1])
        share = colors / 255
        light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)  # sRGB, IEC 61966-2-1
        colors = np.round(255 * light).astype(np.uint8)
    cloud = trimesh.PointCloud(points, np.c_[colors, np.full(len(colors), 255, np.uint8)])
    content = io.BytesIO()
    cloud.export(content, file_type=form)
    return content.getvalue()


def check_trimesh() -> None:
    """ValueError, with the command to type, where trimesh is not installed."""
    if importlib.util.find_spec("trimesh") is None:
        raise ValueError('point clouds need trimesh: pip install "gift-peft[pointcloud]"')
