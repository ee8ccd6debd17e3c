"""Rooms whose depth can be read from one picture: fixed field of view, eye at 1.2 to 1.5 m, things stand on things.

A scene is a list of `Item`s (a Mitsuba shape, a texture, a place) and a camera. x points right, y into the room,
z up, in metres; the camera stands above the origin. Nothing here knows about glass or mirrors: `targets.py` adds the
panel, pane or solid object of a group, and the pre-training scenes hold its opaque twin in the same places.
"""

from dataclasses import dataclass, field

import numpy as np
import textures
from shapes import Item, ball, box, profile, quad, turned

FIELD_OF_VIEW = 60.0  # degrees, horizontal, the same in every picture


@dataclass
class Camera:
    origin: np.ndarray
    forward: np.ndarray
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    @property
    def axes(self) -> np.ndarray:
        """Rows: right, up and forward unit vectors."""
        right = np.cross(self.forward, self.up)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, self.forward), self.forward])


@dataclass
class Scene:
    items: list[Item]
    camera: Camera
    light: np.ndarray
    room: tuple[float, float, float, float, float]  # left, right, rear, far, height
    taken: list[tuple[float, float, float]]  # circles on the floor: x, y, radius


def _wall(items, origin, along, length, height, texture, repeat, opening=None):
    """Wall rectangles from `origin` along a unit vector; the interior is on the left of `along` x up."""
    along, up = np.asarray(along, float), np.array([0.0, 0.0, 1.0])
    spans = [(0, length, 0, height)]
    if opening is not None:
        s0, s1, t0, t1 = opening
        spans = [(0, s0, 0, height), (s1, length, 0, height), (s0, s1, t1, height), (s0, s1, 0, t0)]
    for s0, s1, t0, t1 in spans:
        if s1 - s0 < 1e-3 or t1 - t0 < 1e-3:
            continue
        centre = np.asarray(origin, float) + along * (s0 + s1) / 2 + up * (t0 + t1) / 2
        u, v = along * (s1 - s0) / 2, up * (t1 - t0) / 2
        items.append(quad(centre, u, v, texture, ((s1 - s0) / repeat, (t1 - t0) / repeat)))


def _trim(items, origin, along, opening, texture):
    """A door or window case around an opening."""
    along, up = np.asarray(along, float), np.array([0.0, 0.0, 1.0])
    yaw = np.arctan2(along[1], along[0])
    s0, s1, t0, t1 = opening
    parts = [
        (s0, (t0 + t1) / 2, 0.07, t1 - t0),
        (s1, (t0 + t1) / 2, 0.07, t1 - t0),
        ((s0 + s1) / 2, t1, s1 - s0, 0.07),
    ]
    if t0 > 0:
        parts.append(((s0 + s1) / 2, t0, s1 - s0, 0.07))
    for s, t, width, height in parts:
        centre = np.asarray(origin, float) + along * s + up * t
        items.append(box(centre, (width, 0.14, height), texture, yaw))


def _further_room(rng, items, origin, along, opening, outward):
    """A box room beyond an opening, with something in it."""
    along, outward, up = np.asarray(along, float), np.asarray(outward, float), np.array([0.0, 0.0, 1.0])
    s0, s1, _, t1 = opening
    left, right = s0 - rng.uniform(0.4, 1.2), s1 + rng.uniform(0.4, 1.2)
    depth, height = rng.uniform(1.2, 3.5), max(2.4, t1 + 0.3)
    start = np.asarray(origin, float) + outward * 0.02
    centre = start + along * (left + right) / 2 + outward * depth / 2
    w, d = along * (right - left) / 2, outward * depth / 2
    ground, scale = textures.floor(rng)
    items.append(quad(centre, w, d, ground, ((right - left) / scale, depth / scale)))
    items.append(quad(centre + up * height, w, -d, textures.mottled(rng, textures.paint(rng, 0.6, 0.9), 0.03)))
    paper, scale = textures.wall(rng)
    for mid, half, length in (
        (centre + outward * depth / 2, w, right - left),
        (centre - along * (right - left) / 2, d, depth),
        (centre + along * (right - left) / 2, d, depth),
    ):
        items.append(quad(mid + up * height / 2, half, up * height / 2, paper, (length / scale, height / scale)))
    for _ in range(rng.integers(1, 4)):
        size = rng.uniform((0.3, 0.3, 0.3), (0.9, 0.6, 1.6))
        spot = start + along * rng.uniform(left + 0.3, right - 0.3) + outward * rng.uniform(0.6, max(0.7, depth - 0.3))
        items.append(box(spot + up * size[2] / 2, size, textures.surface(rng), rng.uniform(-0.3, 0.3)))


def free_spot(rng, scene: Scene, radius, x_range, y_range, keep_clear=()) -> tuple[float, float] | None:
    """A place for a footprint of `radius` that meets nothing and hides none of the points in `keep_clear`."""
    for _ in range(25):
        x, y = rng.uniform(*x_range), rng.uniform(*y_range)
        if x * x + y * y < (radius + 0.55) ** 2:
            continue
        if any((x - a) ** 2 + (y - b) ** 2 < (radius + r) ** 2 for a, b, r in scene.taken):
            continue
        if any(between(x, y, radius, px, py) for px, py in keep_clear):
            continue
        scene.taken.append((x, y, radius))
        return x, y
    return None


def between(x, y, radius, px, py) -> bool:
    """Does a disc at (x, y) cover the line of sight from the camera to (px, py)?"""
    length = np.hypot(px, py)
    along = (x * px + y * py) / length
    return 0 < along < length + radius and abs(x * py - y * px) / length < radius + 0.1


def table(rng, x, y, width, depth, height, yaw=0.0) -> list[Item]:
    tone = textures.surface(rng)
    items = [box((x, y, height - 0.025), (width, depth, 0.05), tone, yaw)]
    c, s = np.cos(yaw), np.sin(yaw)
    for a in (-1, 1):
        for b in (-1, 1):
            dx, dy = a * (width / 2 - 0.06), b * (depth / 2 - 0.06)
            spot = (x + c * dx - s * dy, y + s * dx + c * dy, (height - 0.05) / 2)
            items.append(box(spot, (0.06, 0.06, height - 0.05), tone, yaw))
    return items


def small_thing(rng, x, y, z, scale=1.0) -> list[Item]:
    """Something opaque that stands on a table: ball, bottle, vase, mug, jar, books, carton."""
    kind = rng.choice(
        ["ball", "bottle", "vase", "tumbler", "jar", "books", "carton"], p=[0.2, 0.2, 0.15, 0.1, 0.1, 0.1, 0.15]
    )
    gloss = float(rng.uniform(0.05, 0.3)) if rng.random() < 0.4 else None
    look = twin_texture(rng)
    if kind == "ball":
        r = scale * rng.uniform(0.06, 0.17)
        return [ball((x, y, z + r), r, look, gloss=gloss)]
    if kind == "books":
        items, top = [], z
        for _ in range(rng.integers(1, 5)):
            thick = rng.uniform(0.02, 0.06)
            items.append(
                box((x, y, top + thick / 2), (0.24, 0.17, thick), textures.surface(rng), rng.uniform(-0.5, 0.5))
            )
            top += thick
        return items
    if kind == "carton":
        size = scale * rng.uniform((0.08, 0.08, 0.1), (0.25, 0.25, 0.35))
        return [box((x, y, z + size[2] / 2), size, look, rng.uniform(0, 1.5), gloss=gloss)]
    height, width = scale * rng.uniform(0.15, 0.4), scale * rng.uniform(0.08, 0.2)
    return [turned((x, y, z), profile(rng, kind, height, width), look, gloss=gloss)]


def twin_texture(rng) -> np.ndarray:
    """What an opaque twin may wear: matte spray, one colour, print."""
    kind = rng.integers(4)
    if kind == 0:
        return textures.mottled(rng, textures.paint(rng, 0.5, 0.9), 0.06)
    if kind == 1:
        return textures.mottled(rng, textures.colour(rng), 0.05)
    if kind == 2:
        return textures.card(rng)
    return textures.surface(rng)


def furniture(rng, x, y) -> list[Item]:
    """One piece of free-standing furniture with its centre at (x, y); it fits in a circle of radius 0.5."""
    kind = rng.choice(["table", "chair", "box", "ball", "plant", "lamp", "stool", "jar"])
    yaw = rng.uniform(-0.8, 0.8)
    if kind == "table":
        height = rng.uniform(0.45, 0.78)
        items = table(rng, x, y, rng.uniform(0.5, 0.75), rng.uniform(0.4, 0.6), height, yaw)
        for _ in range(rng.integers(0, 4)):
            items += small_thing(rng, x + rng.uniform(-0.18, 0.18), y + rng.uniform(-0.15, 0.15), height)
        return items
    if kind == "chair":
        tone, seat = textures.surface(rng), rng.uniform(0.4, 0.48)
        items = table(rng, x, y, 0.42, 0.42, seat, yaw)
        back = np.array([x - np.sin(yaw) * 0.19, y + np.cos(yaw) * 0.19, seat + 0.24])
        return [*items, box(back, (0.42, 0.04, 0.48), tone, yaw)]
    if kind == "box":
        size = rng.uniform((0.25, 0.25, 0.2), (0.65, 0.6, 1.1))
        return [box((x, y, size[2] / 2), size, textures.surface(rng), yaw)]
    if kind == "ball":
        r = rng.uniform(0.1, 0.35)
        return [ball((x, y, r), r, twin_texture(rng))]
    if kind == "plant":
        pot, crown = rng.uniform(0.2, 0.4), rng.uniform(0.15, 0.35)
        green = textures.mottled(rng, np.array([0.12, 0.3, 0.08], np.float32) * rng.uniform(0.6, 1.6), 0.4)
        items = [turned((x, y, 0), profile(rng, "vase", pot, 0.3), textures.surface(rng))]
        return [*items, ball((x, y, pot + crown * 0.8), crown, green)]
    if kind == "lamp":
        height, shade = rng.uniform(1.0, 1.6), textures.mottled(rng, textures.paint(rng, 0.6, 0.92), 0.05)
        pole = turned(
            (x, y, 0),
            [(1e-4, 0), (0.14, 0), (0.14, 0.02), (0.02, 0.03), (0.02, height), (1e-4, height)],
            textures.wood(rng),
        )
        return [pole, turned((x, y, height), [(1e-4, 0), (0.2, 0), (0.12, 0.28), (1e-4, 0.28)], shade)]
    height = rng.uniform(0.35, 0.9)
    if kind == "stool":
        return [turned((x, y, 0), profile(rng, "tumbler", height, rng.uniform(0.3, 0.45)), textures.surface(rng))]
    return [
        turned(
            (x, y, 0),
            profile(rng, rng.choice(["vase", "jar", "bottle"]), height, rng.uniform(0.22, 0.4)),
            twin_texture(rng),
        )
    ]


def wall_furniture(rng, scene: Scene) -> list[Item]:
    """A cabinet, shelf, sofa or bed with its back to a side wall or the far wall."""
    left, right, rear, far, _ = scene.room
    depth, width, height = rng.uniform(0.3, 0.75), rng.uniform(0.6, 1.4), rng.uniform(0.4, 2.0)
    side = rng.integers(3)
    radius = min(width, depth) / 2 + 0.15
    if side == 2:
        spot = free_spot(rng, scene, radius, (left + width / 2, right - width / 2), (far - depth / 2 - 0.02,) * 2)
        size = (width, depth, height)
    else:
        x = left + depth / 2 + 0.02 if side == 0 else right - depth / 2 - 0.02
        spot = free_spot(rng, scene, radius, (x, x), (rear + width, far - width / 2 - 0.1))
        size = (depth, width, height)
    if spot is None:
        return []
    tone = textures.surface(rng)
    items = [box((*spot, height / 2), size, tone)]
    if height < 1.1:
        for _ in range(rng.integers(0, 3)):
            offset = rng.uniform(-0.3, 0.3, 2) * np.array(size[:2])
            items += small_thing(rng, spot[0] + offset[0], spot[1] + offset[1], height)
    else:
        for shelf in np.arange(0.35, height, 0.4):
            items.append(box((*spot, shelf), (size[0] + 0.02, size[1] + 0.02, 0.03), textures.wood(rng)))
    return items


def make_room(rng, far_range=(2.4, 6.0), rear_range=(1.2, 2.4), openings=1.0) -> Scene:
    """An empty room with its walls, openings and further rooms, a light and a camera; furnish it afterwards.

    `openings` scales the chance of a doorway or window in the walls before the camera.
    """
    left, right = -rng.uniform(1.3, 2.6), rng.uniform(1.3, 2.6)
    rear, far, height = -rng.uniform(*rear_range), rng.uniform(*far_range), rng.uniform(2.4, 2.9)
    items: list[Item] = []
    ground, scale = textures.floor(rng)
    centre, w, d = np.array([(left + right) / 2, (rear + far) / 2, 0]), (right - left) / 2, (far - rear) / 2
    items.append(quad(centre, (w, 0, 0), (0, d, 0), ground, (2 * w / scale, 2 * d / scale)))
    items.append(
        quad(
            centre + np.array([0, 0, height]),
            (w, 0, 0),
            (0, -d, 0),
            textures.mottled(rng, textures.paint(rng, 0.6, 0.92), 0.03),
        )
    )
    paper, scale = textures.wall(rng)
    other = textures.wall(rng) if rng.random() < 0.3 else (paper, scale)
    case = textures.mottled(rng, textures.paint(rng, 0.3, 0.92), 0.03)
    walls = [  # origin, along, length, outward, chance of an opening
        ((left, far, 0), (1, 0, 0), right - left, (0, 1, 0), 0.45 * openings, other),
        ((left, rear, 0), (0, 1, 0), far - rear, (-1, 0, 0), 0.25 * openings, (paper, scale)),
        ((right, rear, 0), (0, 1, 0), far - rear, (1, 0, 0), 0.25 * openings, (paper, scale)),
        ((left, rear, 0), (1, 0, 0), right - left, (0, -1, 0), 0.5, (paper, scale)),
    ]
    for origin, along, length, outward, chance, (look, step) in walls:
        opening = None
        if rng.random() < chance:
            width = rng.uniform(0.75, 1.3)
            start = rng.uniform(0.3, max(0.31, length - width - 0.3))
            bottom = 0.0 if rng.random() < 0.6 else rng.uniform(0.8, 1.0)
            opening = (start, min(start + width, length - 0.2), bottom, rng.uniform(1.95, 2.1))
            _trim(items, origin, along, opening, case)
            _further_room(rng, items, origin, along, opening, outward)
        _wall(items, origin, along, length, height, look, step, opening)
    yaw, pitch = rng.uniform(-0.22, 0.22), rng.uniform(-0.3, -0.02)
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    camera = Camera(np.array([0.0, 0.0, rng.uniform(1.2, 1.5)]), forward)
    light = np.array([rng.uniform(left, right) * 0.5, rng.uniform(-0.6, far * 0.5), height - 0.12])
    return Scene(items, camera, light, (left, right, rear, far, height), [])


def furnish(rng, scene: Scene, count=None, keep_clear=(), pictures=True) -> None:
    """Fill the room: pieces along the walls, free ones in view, a few behind the camera, pictures on the walls."""
    left, right, rear, far, _ = scene.room
    for _ in range(rng.integers(0, 4)):
        scene.items += wall_furniture(rng, scene)
    for _ in range(rng.integers(2, 8) if count is None else count):
        spot = free_spot(rng, scene, 0.42, (left + 0.4, right - 0.4), (0.9, far - 0.4), keep_clear)
        if spot is not None:
            scene.items += furniture(rng, *spot)
    for _ in range(rng.integers(2, 5)):
        spot = free_spot(rng, scene, 0.4, (left + 0.4, right - 0.4), (rear + 0.3, -0.3))
        if spot is not None:
            scene.items += furniture(rng, *spot)
    for _ in range(rng.integers(0, 4) if pictures else 0):
        hang_picture(rng, scene)


def hang_picture(rng, scene: Scene) -> None:
    """A poster on the far or a side wall, mostly thin; openings may be covered by chance, as by a board."""
    left, right, _, far, _ = scene.room
    width, height, z = rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.9), rng.uniform(1.3, 1.8)
    look = textures.picture(rng)
    side = rng.integers(3)
    if side == 0:
        scene.items.append(box((rng.uniform(left + 0.5, right - 0.5), far - 0.02, z), (width, 0.03, height), look))
    else:
        x = left + 0.02 if side == 1 else right - 0.02
        scene.items.append(box((x, rng.uniform(0.8, far - 0.5), z), (0.03, width, height), look))
