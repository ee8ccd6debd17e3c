"""What the rooms are built of: rectangles, boxes, balls and solids of revolution, each an `Item` with its texture."""

from dataclasses import dataclass

import numpy as np


@dataclass
class Item:
    """One shape. `shape` is a Mitsuba dictionary without material; `points` (K, 3) bound it."""

    shape: dict
    texture: np.ndarray
    points: np.ndarray
    repeat: tuple[float, float] = (1.0, 1.0)
    gloss: float | None = None  # roughness of a varnish; None is matte
    role: str = ""  # "target", or "hollow" for the air inside a glass target


def frame_matrix(u, v, n, centre) -> np.ndarray:
    """Columns u, v, n (already scaled) and the centre."""
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = u, v, n, centre
    return matrix


def quad(centre, u, v, texture, repeat=(1.0, 1.0), **kwargs) -> Item:
    """A rectangle spanned by the half vectors u and v, seen from the side of u x v."""
    centre, u, v = (np.asarray(a, float) for a in (centre, u, v))
    normal = np.cross(u, v)
    matrix = frame_matrix(u, v, normal / np.linalg.norm(normal), centre)
    points = np.array([centre + a * u + b * v for a in (-1, 1) for b in (-1, 1)])
    return Item({"type": "rectangle", "to_world": matrix}, texture, points, repeat, **kwargs)


def box(centre, size, texture, yaw=0.0, **kwargs) -> Item:
    """A box of full side lengths `size`, turned by `yaw` radians about the vertical."""
    centre, half = np.asarray(centre, float), np.asarray(size, float) / 2
    c, s = np.cos(yaw), np.sin(yaw)
    u, v, n = np.array([c, s, 0]) * half[0], np.array([-s, c, 0]) * half[1], np.array([0, 0, half[2]])
    points = np.array([centre + a * u + b * v + d * n for a in (-1, 1) for b in (-1, 1) for d in (-1, 1)])
    return Item({"type": "cube", "to_world": frame_matrix(u, v, n, centre)}, texture, points, **kwargs)


def ball(centre, radius, texture, **kwargs) -> Item:
    centre = np.asarray(centre, float)
    axis = np.eye(3) * radius
    points = np.concatenate([centre + axis, centre - axis])
    shape = {"type": "sphere", "to_world": frame_matrix(*axis, centre)}
    return Item(shape, texture, points, **kwargs)


def turned(base, outline, texture, segments=32, **kwargs) -> Item:
    """A solid of revolution standing at `base`; `outline` (K, 2) lists (radius, height) from the bottom up.

    Normals are smooth along the outline except where it bends by more than 40 degrees.
    """
    outline, base = np.asarray(outline, float), np.asarray(base, float)
    edge = np.diff(outline, axis=0)
    edge /= np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    outward = np.stack([edge[:, 1], -edge[:, 0]], 1)
    rows, normals, links = [], [], []
    for k, point in enumerate(outline):
        before, after = outward[max(k - 1, 0)], outward[min(k, len(outward) - 1)]
        if before @ after > np.cos(np.radians(40)):
            rows.append(point)
            normals.append((before + after) / np.linalg.norm(before + after))
        else:
            rows += [point, point]
            normals += [before, after]
        if k + 1 < len(outline):
            links.append(len(rows) - 1)
    rows, normals, links = np.array(rows), np.array(normals), np.array(links)
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)

    def sweep(pairs):
        flat = pairs[:, None, :1] * ring[None]
        return np.concatenate([flat, np.broadcast_to(pairs[:, None, 1:], (*flat.shape[:2], 1))], -1).reshape(-1, 3)

    vertices = sweep(rows) + base
    uv = np.stack(np.broadcast_arrays(angle[None] / (2 * np.pi), np.linspace(0, 1, len(rows))[:, None]), -1)
    a = (links[:, None] * (segments + 1) + np.arange(segments)[None]).ravel()
    faces = [np.stack([a, a + 1, a + segments + 2], 1), np.stack([a, a + segments + 2, a + segments + 1], 1)]
    shape = {"type": "mesh", "vertices": vertices, "normals": sweep(normals), "uv": uv.reshape(-1, 2)}
    return Item(shape | {"faces": np.concatenate(faces)}, texture, vertices, **kwargs)


def profile(rng, kind: str, height: float, width: float) -> np.ndarray:
    """Outline of a bottle, vase, tumbler, jar or ball, closed at both ends."""
    r = width / 2
    if kind == "bottle":
        neck = r * rng.uniform(0.3, 0.45)
        shoulder = rng.uniform(0.5, 0.65)
        outline = [(r, 0), (r, shoulder), (neck, shoulder + 0.18), (neck, 1)]
    elif kind == "vase":
        waist = rng.uniform(0.5, 0.75)
        outline = [(r * 0.6, 0), (r, 0.35), (r * waist, 0.8), (r * 0.8, 1)]
    elif kind == "jar":
        outline = [(r * 0.85, 0), (r, 0.1), (r, 0.8), (r * 0.75, 0.92), (r * 0.75, 1)]
    else:
        outline = [(r * rng.uniform(0.75, 1.0), 0), (r, 1)]
    control = np.array(outline, float)
    t = np.linspace(0, 1, 24)
    radius = np.interp(t, control[:, 1], control[:, 0])
    if kind in ("bottle", "vase"):  # rounded shoulders
        radius = np.convolve(np.pad(radius, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    side = np.stack([radius, t * height], 1)
    return np.concatenate([[(1e-4, 0)], side, [(1e-4, height)]])
