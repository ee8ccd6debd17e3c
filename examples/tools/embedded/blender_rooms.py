"""Closed, furnished rooms for the groups that Blender renders.

x points right, y into the room, z up, in metres; the camera stands above the origin. All light comes from glowing
meshes (windows and lamps), so what shines has a depth too.
"""

from dataclasses import dataclass, field
from math import hypot, pi

import numpy as np
from blender_shapes import ball, box, colour, cone, glow, lathe, look, monkey, place, ring, sheet, upright

WALLS = "far", "right", "left", "rear"


@dataclass
class Room:
    left: float
    right: float
    rear: float
    far: float
    height: float
    lights: list = field(default_factory=list)  # colour socket, strength socket, usual strength, "lamp" or "window"
    taken: list = field(default_factory=list)  # circles on the floor: x, y, radius
    hung: dict = field(default_factory=lambda: {wall: [] for wall in WALLS})  # spans along each wall in use

    def on(self, wall: str, s: float, z: float, gap=0.0):
        """Centre and yaw of something flat that hangs `gap` off a wall, `s` being x or y there."""
        return {
            "far": ((s, self.far - gap, z), 0.0),
            "rear": ((s, self.rear + gap, z), pi),
            "right": ((self.right - gap, s, z), -pi / 2),
            "left": ((self.left + gap, s, z), pi / 2),
        }[wall]

    def reach(self, wall: str) -> tuple[float, float]:
        return (self.left, self.right) if wall in ("far", "rear") else (self.rear, self.far)

    def span(self, rng, wall: str, width: float) -> float | None:
        """A free place along a wall."""
        low, high = self.reach(wall)
        for _ in range(8):
            if high - low < width + 0.3:
                return None
            s = rng.uniform(low + width / 2 + 0.12, high - width / 2 - 0.12)
            if all(abs(s - other) > (width + size) / 2 + 0.06 for other, size in self.hung[wall]):
                self.hung[wall].append((s, width))
                return s
        return None

    def spot(self, rng, radius: float, x_range, y_range, keep_clear=()) -> tuple[float, float] | None:
        """A place for a footprint that meets nothing and hides none of the points in `keep_clear`."""
        for _ in range(25):
            if x_range[0] > x_range[1] or y_range[0] > y_range[1]:
                return None
            x, y = rng.uniform(*x_range), rng.uniform(*y_range)
            if hypot(x, y) < radius + 0.6 or any(hypot(x - a, y - b) < radius + r for a, b, r in self.taken):
                continue
            if any(_between(x, y, radius, *point) for point in keep_clear):
                continue
            self.taken.append((x, y, radius))
            return x, y
        return None


def _between(x, y, radius, px, py) -> bool:
    """Does a disc at (x, y) cover the line of sight from the camera to (px, py)?"""
    length = hypot(px, py)
    along = (x * px + y * py) / length
    return 0 < along < length + 0.1 and abs(x * py - y * px) / length < radius + 0.05


def make_room(rng, far: float, rear=(2.2, 4.0)) -> Room:
    """Floor, ceiling and walls with skirting, some with a beam or a pillar; lamps, windows and pictures come later."""
    room = Room(-rng.uniform(1.5, 3.0), rng.uniform(1.5, 3.0), -rng.uniform(*rear), far, rng.uniform(2.3, 3.1))
    width, depth = room.right - room.left, room.far - room.rear
    middle = (room.left + room.right) / 2, (room.far + room.rear) / 2
    gloss = rng.uniform(0.08, 0.3) if rng.random() < 0.4 else rng.uniform(0.4, 0.9)
    floor = look(rng, "planks", "planks", "tiles", "terrazzo", "checker", "mottled", roughness=gloss)
    box((width, depth, 0.1), floor, (*middle, -0.05), bevel=0)
    white = look(rng, "plain", "mottled", tone=colour(rng, 0.6, 0.9, 0.15))
    box((width, depth, 0.1), white, (*middle, room.height + 0.05), bevel=0)
    paper = look(
        rng, "plain", "mottled", "mottled", "brick", "stripes", tone=colour(rng, 0.3, 0.85, 0.4), roughness=0.9
    )
    accent = look(rng, "plain", "brick", "tiles", "mottled", "wood", roughness=0.8)
    skirting = look(rng, "plain", "wood", tone=colour(rng, 0.2, 0.9, 0.2))
    special = rng.choice([*WALLS, "none", "none", "none"])
    for wall in WALLS:
        low, high = room.reach(wall)
        centre, yaw = room.on(wall, (low + high) / 2, room.height / 2)
        sheet(high - low, room.height, accent if wall == special else paper, upright(centre, yaw))
        centre, _ = room.on(wall, (low + high) / 2, 0.045, 0.009)
        box((high - low, 0.018, 0.09), skirting, centre, (0, 0, yaw), bevel=0.003)
    if rng.random() < 0.3:
        beam = look(rng, "wood")
        for y in np.arange(room.rear + 0.4, room.far - 0.1, rng.uniform(0.7, 1.3)):
            box((width, 0.14, 0.18), beam, (middle[0], y, room.height - 0.09))
    if rng.random() < 0.3:
        size, x = rng.uniform(0.25, 0.5), rng.choice([room.left, room.right])
        box((2 * size, size, room.height), paper, (x, room.far - size / 2, room.height / 2), bevel=0)
        room.taken.append((x, room.far - size / 2, 1.1 * size))
    return room


def light(rng, room: Room) -> None:
    """One or two ceiling lamps and up to two windows, each with curtains or without."""
    for _ in range(rng.integers(1, 3)):
        tint, power = (1.0, rng.uniform(0.7, 0.95), rng.uniform(0.5, 0.9), 1.0), rng.uniform(30, 70)
        x, y = rng.uniform(0.6 * room.left, 0.6 * room.right), rng.uniform(0.6 * room.rear, 0.6 * room.far)
        drop = rng.choice([0.0, rng.uniform(0.3, 0.6)])
        radius = rng.uniform(0.09, 0.18)
        strength = power / (pi * 4 * pi * radius**2)
        material, *sockets = glow(tint, strength)
        if drop:
            ball(radius, material, (x, y, room.height - drop), fine=8)
            cone(0.01, 0.01, drop, look(rng, "plain"), (x, y, room.height - drop))
        else:
            cone(1.4 * radius, 1.4 * radius, 0.05, material, (x, y, room.height - 0.06))
        room.lights.append((*sockets, strength, "lamp"))
    frame = look(rng, "plain", "wood", tone=colour(rng, 0.1, 0.9, 0.2))
    for wall in rng.permutation(["right", "left", "rear", "rear", "far"])[: rng.integers(1, 4)]:
        width, height = rng.uniform(0.7, 1.5), rng.uniform(0.8, 1.3)
        s = room.span(rng, wall, width + 0.5)
        if s is None:
            continue
        z = max(1.0 + height / 2, rng.uniform(1.3, 1.6))
        strength = rng.uniform(8, 30) / (pi * width * height)
        material, *sockets = glow((0.85, 0.93, 1.0, 1.0), strength, sky=True)
        centre, yaw = room.on(wall, s, z, 0.012)
        sheet(width, height, material, upright(centre, yaw))
        room.lights.append((*sockets, strength, "window"))
        bars = border(width, height, 0.06, 0.05, frame)
        bars += [box((0.035, 0.03, height), frame, (0, 0, 0)), box((width, 0.03, 0.035), frame, (0, 0, 0.15 * height))]
        bars.append(box((width + 0.2, 0.16, 0.03), frame, (0, -0.07, -height / 2 - 0.04)))
        place(bars, *centre, yaw)
        if rng.random() < 0.5:
            cloth = look(rng, "plain", "stripes", "mottled", roughness=0.9)
            folds = [
                cone(0.035, 0.04, height + 0.4, cloth, (side * (width / 2 + 0.06 * k), -0.05, -height / 2 - 0.3))
                for side in (-1, 1)
                for k in range(4)
            ]
            place(folds, *centre, yaw)


def border(width, height, bar, depth, material) -> list:
    """Four bevelled bars around an upright rectangle in the plane y = 0."""
    side = [box((bar, depth, height + 2 * bar), material, (s * (width + bar) / 2, 0, 0)) for s in (-1, 1)]
    return side + [box((width + 2 * bar, depth, bar), material, (0, 0, s * (height + bar) / 2)) for s in (-1, 1)]


def picture(rng, room: Room, wall: str) -> list:
    """A framed print, a shelf with books, or a clock; nothing where the wall is full."""
    width, height = rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.8)
    s = room.span(rng, wall, width)
    if s is None:
        return []
    centre, yaw = room.on(wall, s, rng.uniform(1.2, 1.75), 0.02)
    kind = rng.choice(["print", "print", "shelf", "clock"])
    if kind == "print":
        made = [box((width, 0.03, height), look(rng, "stripes", "checker", "mottled", "terrazzo", "plain"), (0, 0, 0))]
        made += border(width, height, rng.uniform(0.02, 0.06), 0.04, look(rng, "wood", "plain", "metal"))
    elif kind == "clock":
        made = [cone(0.16, 0.16, 0.04, look(rng, "plain"), (0, 0.02, 0), (pi / 2, 0, 0))]
        made.append(ring(0.16, 0.02, look(rng, "metal", "wood"), (0, 0, 0), (pi / 2, 0, 0)))
    else:
        made = [box((width, 0.2, 0.03), look(rng, "wood", "plain"), (0, -0.1, 0)), *books(rng, width - 0.05, 0.015)]
        for each in made[1:]:
            each.location.y -= 0.1
    return place(made, *centre, yaw)


def books(rng, width, z) -> list:
    made, x = [], -width / 2
    while x < width / 2 - 0.06:
        thick, tall = rng.uniform(0.015, 0.05), rng.uniform(0.14, 0.27)
        if rng.random() < 0.85:
            made.append(box((thick, 0.15, tall), look(rng, "plain"), (x + thick / 2, 0, z + tall / 2), bevel=0.002))
        x += thick + 0.002
    return made


def ornament(rng, size: float) -> list:
    """Something small that stands at the origin, about `size` high."""
    kind = rng.choice(["ball", "monkey", "ring", "cone", "vase", "carton", "cup", "stack"])
    material, half = look(rng), size / 2
    if kind == "ball":
        return [ball(half, material, (0, 0, half))]
    if kind == "monkey":
        return [monkey(half, material, (0, 0, half), (0, 0, rng.uniform(-0.8, 0.8)))]
    if kind == "ring":
        tube = 0.25 * half
        return [ring(half - tube, tube, material, (0, 0, half), (pi / 2, 0, 0))]
    if kind == "cone":
        return [cone(half * 0.7, rng.choice([0.0, 0.3 * half]), size, material, (0, 0, 0))]
    if kind == "carton":
        return [box(size * rng.uniform(0.5, 0.9, 3), material, (0, 0, 0.4 * size), (0, 0, rng.uniform(0, 1)))]
    if kind == "stack":
        tops = size / 4 * np.arange(4)
        yaw = rng.uniform(-0.6, 0.6, 4)
        return [
            box((size, 0.7 * size, size / 4), look(rng), (0, 0, t + size / 8), (0, 0, w))
            for t, w in zip(tops, yaw, strict=True)
        ]
    if kind == "cup":
        outline = [(0, 0), (0.3, 0), (0.42, 1), (0.38, 1), (0.27, 0.06), (0, 0.06)]
    else:
        outline = [
            (0, 0),
            (0.2, 0),
            (0.36, 0.25),
            (0.34, 0.5),
            (0.14, 0.75),
            (0.16, 0.9),
            (0.22, 1),
            (0.1, 0.8),
            (0, 0.7),
        ]
    return [lathe([(r * size, z * size) for r, z in outline], material, (0, 0, 0))]


def furniture(rng) -> list:
    """One piece around the origin, within a circle of radius 0.45."""
    kind = rng.choice(["desk", "stool", "armchair", "shelf", "plinth", "plant", "lamp", "crates", "barrel", "ladder"])
    first, second = look(rng), look(rng)
    if kind == "desk":
        high, w, d = rng.uniform(0.45, 0.8), rng.uniform(0.5, 0.7), rng.uniform(0.4, 0.5)
        corners = [(a * (w / 2 - 0.04), b * (d / 2 - 0.04), 0) for a in (-1, 1) for b in (-1, 1)]
        made = [box((w, d, 0.03), first, (0, 0, high - 0.015))]
        made += [cone(0.015, 0.025, high - 0.03, second, at) for at in corners]
        return made + place(ornament(rng, rng.uniform(0.12, 0.35)), rng.uniform(-0.12, 0.12), 0, high)
    if kind == "stool":
        high = rng.uniform(0.4, 0.7)
        made = [cone(0.18, 0.19, 0.06, first, (0, 0, high)), cone(0.03, 0.03, high, second, (0, 0, 0))]
        return [*made, cone(0.2, 0.15, 0.03, second, (0, 0, 0))]
    if kind == "armchair":
        made = [
            box((0.66, 0.6, 0.3), first, (0, 0, 0.25), bevel=0.05),
            box((0.66, 0.16, 0.5), first, (0, 0.24, 0.6), bevel=0.05),
        ]
        return made + [box((0.13, 0.56, 0.24), second, (a, 0, 0.5), bevel=0.04) for a in (-0.29, 0.29)]
    if kind == "shelf":
        high = rng.uniform(0.8, 1.9)
        made = [box((0.03, 0.28, high), first, (a, 0, high / 2)) for a in (-0.36, 0.36)]
        made.append(box((0.7, 0.015, high), second, (0, 0.13, high / 2)))
        for z in np.linspace(0.05, high - 0.02, max(3, int(high / 0.38))):
            made += [
                box((0.7, 0.27, 0.025), first, (0, 0, z)),
                *(books(rng, 0.62, z + 0.013) if z < high - 0.1 else []),
            ]
        return made
    if kind == "plinth":
        high, side = rng.uniform(0.4, 1.0), rng.uniform(0.25, 0.4)
        return [
            box((side, side, high), first, (0, 0, high / 2)),
            *place(ornament(rng, rng.uniform(0.25, 0.45)), 0, 0, high),
        ]
    if kind == "plant":
        high, green = rng.uniform(0.2, 0.4), look(rng, "mottled", tone=(0.06, rng.uniform(0.15, 0.4), 0.04, 1))
        made = [cone(0.13, 0.19, high, first, (0, 0, 0))]
        for _ in range(14):
            x, y, z = rng.uniform((-0.2, -0.2, 0.1), (0.2, 0.2, 0.6))
            made.append(ball(rng.uniform(0.07, 0.14), green, (x, y, high + z), rng.uniform(0.5, 1.0), fine=8))
        return made
    if kind == "lamp":
        high = rng.uniform(1.0, 1.6)
        made = [cone(0.16, 0.14, 0.03, first, (0, 0, 0)), cone(0.012, 0.012, high, first, (0, 0, 0))]
        return [*made, cone(0.22, 0.14, 0.3, second, (0, 0, high))]
    if kind == "crates":
        made, z = [], 0.0
        for size in sorted(rng.uniform(0.2, 0.6, rng.integers(1, 4)), reverse=True):
            made.append(
                box((size, 0.8 * size, 0.7 * size), look(rng), (0, 0, z + 0.35 * size), (0, 0, rng.uniform(-0.5, 0.5)))
            )
            z += 0.7 * size
        return made
    if kind == "ladder":
        made = [box((0.05, 0.03, 1.6), first, (a, 0, 0.78), (-0.15, 0, 0)) for a in (-0.2, 0.2)]
        return made + [box((0.36, 0.05, 0.03), first, (0, 0.15 * (z - 0.78), z)) for z in np.arange(0.2, 1.5, 0.28)]
    wide, high = rng.uniform(0.18, 0.3), rng.uniform(0.4, 0.9)
    outline = [(0, 0), (0.75, 0), (0.95, 0.3), (1, 0.5), (0.95, 0.7), (0.75, 1), (0, 1)]
    return [lathe([(r * wide, z * high) for r, z in outline], first, (0, 0, 0))]


def furnish(rng, room: Room, keep_clear) -> None:
    """Pieces before and behind the camera, a long piece along a wall, a rug, pictures."""
    sides = room.left + 0.5, room.right - 0.5
    if rng.random() < 0.6:  # a sofa or sideboard
        side, length, high = rng.choice([-1, 1]), rng.uniform(0.9, 1.4), rng.uniform(0.4, 0.9)
        x = room.left + 0.3 if side < 0 else room.right - 0.3
        spot = room.spot(rng, 0.6, (x, x), (room.rear + length / 2, room.far - length / 2 - 0.1), keep_clear)
        if spot is not None:
            box((0.45, length, high), look(rng), (*spot, high / 2), bevel=0.03)
            for y in rng.uniform(-0.4, 0.4, rng.integers(0, 3)) * length:
                place(ornament(rng, rng.uniform(0.15, 0.35)), spot[0], spot[1] + y, high)
    for _ in range(rng.integers(2, 6)):
        spot = room.spot(rng, 0.45, sides, (0.9, room.far - 0.5), keep_clear)
        if spot is not None:
            place(furniture(rng), *spot, yaw=rng.uniform(-0.7, 0.7))
    for _ in range(rng.integers(1, 3)):
        spot = room.spot(rng, 0.45, sides, (room.rear + 0.5, -0.7))
        if spot is not None:
            place(furniture(rng), *spot, yaw=rng.uniform(2.4, 3.9))
    if rng.random() < 0.4:
        size = rng.uniform(1.0, 1.8, 2)
        at = rng.uniform(-0.3, 0.3), rng.uniform(0.5, max(0.6, room.far - 1)), 0.006
        box((*size, 0.012), look(rng, "checker", "stripes", "mottled"), at, (0, 0, rng.uniform(-0.3, 0.3)), bevel=0)
    for wall in rng.choice(WALLS, rng.integers(2, 6)):
        picture(rng, room, wall)
