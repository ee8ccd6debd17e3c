"""The places where a target stands: panels on walls, standing panels and panes, objects on tables.

The pre-training scenes put opaque twins (or empty frames) there, the groups put a mirror, a pane or a glass object.
"""

from dataclasses import dataclass, replace

import numpy as np
import rooms
import textures
from rooms import Scene
from shapes import Item, box, frame_matrix, profile, quad, turned

# Frames, edges and lids by which one knows what a thing was made for, whatever it holds at the moment.
MAKES = {
    "mirror": np.array([0.72, 0.5, 0.13], np.float32),  # gilt
    "pane": np.array([0.06, 0.42, 0.25], np.float32),  # the cut edge of glass
    "solid": np.array([0.62, 0.22, 0.08], np.float32),  # copper
}


@dataclass
class Flat:
    """A rectangular target: centre, half vectors u (sideways) and v (up), normal towards the camera, its holder."""

    centre: np.ndarray
    u: np.ndarray
    v: np.ndarray
    holder: list[Item]

    @property
    def normal(self) -> np.ndarray:
        n = np.cross(self.u, self.v)
        return n / np.linalg.norm(n)

    def panel(self, texture: np.ndarray, gloss: float | None = None, role: str = "target") -> Item:
        return quad(self.centre, self.u, self.v, texture, gloss=gloss, role=role)


@dataclass
class Solid:
    """A target that stands on something: the same outline as outer surface and as a slightly smaller hollow."""

    base: np.ndarray
    outline: np.ndarray
    holder: list[Item]
    hollow: bool
    tone: np.ndarray  # of its lid or stand
    axis: np.ndarray  # (2,) unit vector along the table
    along: tuple[float, float]  # from the table's middle: its own place, and how far another centre may be

    @property
    def centre(self) -> np.ndarray:
        return self.base + np.array([0, 0, self.outline[:, 1].max() / 2])

    def body(self, texture: np.ndarray, gloss: float | None = None, role: str = "target") -> Item:
        return turned(self.base, self.outline, texture, gloss=gloss, role=role)

    def fitting(self) -> Item:
        """The copper lid of a vessel, or the ring that a ball rests in."""
        radius, top = self.outline[:, 0], self.outline[:, 1].max()
        if self.outline[-2, 1] > 0.999 * top:  # flat on top
            r, low, high = 1.06 * radius[-2] + 0.004, top - 0.008, top + 0.03
        else:
            r, low, high = 0.82 * radius.max(), 0.0, 0.16 * top
        ring = [(1e-4, low), (r, low), (r, high), (1e-4, high)]
        return turned(self.base, ring, self.tone)

    def cavity(self) -> Item:
        top = self.outline[:, 1].max()
        wall = 0.06 * self.outline[:, 0].max() + 0.002
        inner = np.stack(
            [np.maximum(self.outline[:, 0] - wall, 1e-4), np.clip(self.outline[:, 1], wall, top - wall)], 1
        )
        return turned(self.base, inner, np.full(3, 0.5, np.float32), role="hollow")


def make_tone(rng, make: str) -> np.ndarray:
    return np.clip(MAKES[make] * rng.uniform(0.8, 1.2), 0.02, 0.92).astype(np.float32)


def _facing(normal_yaw: float, tilt: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Unit side and up vectors of a panel whose normal is -y turned by `normal_yaw`, leaning back by `tilt`."""
    side = np.array([np.cos(normal_yaw), np.sin(normal_yaw), 0.0])
    back = np.array([-np.sin(normal_yaw), np.cos(normal_yaw), 0.0])
    up = np.cos(tilt) * np.array([0, 0, 1.0]) + np.sin(tilt) * back
    return side, up


def border(rng, centre, u, v, bar: float, depth: float, make: str | None = None) -> list[Item]:
    """Four bars around a panel, in the tone of its make."""
    if make is not None:
        tone = make_tone(rng, make)
    else:
        tone = textures.wood(rng) if rng.random() < 0.5 else textures.mottled(rng, textures.colour(rng), 0.04)
    su, sv = u / np.linalg.norm(u), v / np.linalg.norm(v)
    n = np.cross(su, sv)
    parts = []
    for middle, a, b in (
        (centre + u, bar / 2 * su, v + bar / 2 * sv),
        (centre - u, bar / 2 * su, v + bar / 2 * sv),
        (centre + v, u + bar / 2 * su, bar / 2 * sv),
        (centre - v, u + bar / 2 * su, bar / 2 * sv),
    ):
        thick = n * depth / 2
        points = np.array([middle + i * a + j * b + k * thick for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
        parts.append(Item({"type": "cube", "to_world": frame_matrix(a, b, thick, middle)}, tone, points))
    return parts


def wall_panel(rng, scene: Scene, make: str | None = None) -> Flat:
    """Flush with the far wall or a side wall, in front of any opening there; framed or frameless."""
    left, right, _, far, _ = scene.room
    width = rng.uniform(0.55, 1.5) if make is None else rng.uniform(0.5, 0.8)
    height = rng.uniform(0.7, 1.5)
    z = max(rng.uniform(1.0, 1.5), height / 2 + 0.1)
    side = rng.choice(3, p=[0.6, 0.2, 0.2])
    gap = 0.03
    if side == 0:
        yaw, centre = 0.0, np.array([rng.uniform(left + width / 2 + 0.1, right - width / 2 - 0.1), far - gap, z])
    else:
        yaw, x = (np.pi / 2, left + gap) if side == 1 else (-np.pi / 2, right - gap)
        centre = np.array([x, rng.uniform(1.6, max(1.7, far - width / 2 - 0.1)), z])
    su, sv = _facing(yaw)
    u, v = su * width / 2, sv * height / 2
    back = box(
        centre + np.array([np.sin(-yaw), np.cos(yaw), 0]) * 0.014, (width, 0.02, height), textures.paint(rng), yaw
    )
    holder = [back]
    if make is not None or rng.random() < 0.6:
        holder += border(rng, centre, u, v, rng.uniform(0.03, 0.09), 0.05, make)
    return Flat(centre, u, v, holder)


def standing_panel(
    rng, scene: Scene, see_through: bool, farthest: float = 3.2, make: str | None = None
) -> Flat | None:
    """On the floor, 1.3 to `farthest` m away: a leaning framed panel, or (see_through) an upright pane on feet."""
    left, right, _, far, _ = scene.room
    if make is not None:
        width = rng.uniform(0.5, 0.8)
    else:
        width = rng.uniform(0.6, 1.3) if see_through else rng.uniform(0.45, 1.0)
    height = rng.uniform(0.9, 1.7)
    nearest = 1.5 if width > 0.9 else 1.3
    reach = max(nearest + 0.1, min(farthest, far - (0.9 if see_through else 0.5)))
    spot = rooms.free_spot(rng, scene, width / 2, (max(left + 0.5, -1.1), min(right - 0.5, 1.1)), (nearest, reach))
    if spot is None:
        return None
    yaw = rng.uniform(-0.35, 0.35)
    lift = rng.uniform(0.02, 0.25) if see_through else rng.uniform(0.01, 0.08)
    su, sv = _facing(yaw, 0.0 if see_through else rng.uniform(0.0, 0.12))
    u, v = su * width / 2, sv * height / 2
    centre = np.array([*spot, lift]) + v
    holder: list[Item] = []
    if make is not None or rng.random() < (0.55 if see_through else 0.75):
        holder += border(rng, centre, u, v, rng.uniform(0.025, 0.06), 0.04, make)
    tone = textures.mottled(rng, textures.colour(rng, 0.05, 0.6), 0.03)
    for sign in (-0.75, 0.75):
        foot = np.array([*spot, 0.0]) + su * sign * width / 2
        holder.append(box(foot + np.array([0, 0, (lift + 0.05) / 2]), (0.06, 0.4, lift + 0.05), tone, yaw))
    return Flat(centre, u, v, holder)


def table_object(rng, scene: Scene) -> Solid | None:
    """A ball, bottle, vase, tumbler or jar on a near table or stool, sometimes a large jar on the floor."""
    left, right, _, far, _ = scene.room
    kind = rng.choice(["ball", "bottle", "vase", "tumbler", "jar"], p=[0.3, 0.2, 0.1, 0.15, 0.25])
    on_floor = rng.random() < 0.25
    y_range = (1.2, min(1.9, far - 0.5)) if on_floor else (1.0, min(1.45, far - 0.6))
    spot = rooms.free_spot(rng, scene, 0.45, (max(left + 0.6, -0.6), min(right - 0.6, 0.6)), y_range)
    if spot is None:
        return None
    holder: list[Item] = []
    z, yaw, length = 0.0, rng.uniform(-0.3, 0.3), rng.uniform(1.0, 1.7)
    if not on_floor:
        z = rng.uniform(0.5, 0.85)
        holder = rooms.table(rng, *spot, length, rng.uniform(0.45, 0.6), z, yaw)
    scale = 1.6 if on_floor else 1.0
    if kind == "ball":
        radius = scale * rng.uniform(0.15, 0.25)
        t = np.linspace(0, np.pi, 24)
        outline = np.stack([np.maximum(np.sin(t), 1e-4) * radius, (1 - np.cos(t)) * radius], 1)
    else:
        outline = profile(rng, kind, scale * rng.uniform(0.35, 0.58), scale * rng.uniform(0.22, 0.36))
    axis, reach = np.array([np.cos(yaw), np.sin(yaw)]), scale * length / 2 - 0.8 * outline[:, 0].max()
    along = rng.uniform(-0.7, 0.7) * reach
    base = np.array([*(np.array(spot) + along * axis), z])
    solid = Solid(base, outline, holder, bool(rng.random() < 0.8), make_tone(rng, "solid"), axis, (along, reach))
    solid.holder.append(solid.fitting())
    return solid


def moved(items: list[Item], shift: np.ndarray) -> list[Item]:
    """Copies of matrix-placed items, `shift` metres away."""
    copies = []
    for item in items:
        matrix = np.array(item.shape["to_world"], float)
        matrix[:3, 3] += shift
        copies.append(replace(item, shape=item.shape | {"to_world": matrix}, points=item.points + shift))
    return copies


def flat_siblings(rng, scene: Scene, flat: Flat, count: int) -> list[Flat]:
    """Flats of the same make (size, frame, feet) in a row with `flat`, as far as the room and the view have space."""
    left, right, _, far, _ = scene.room
    su = flat.u / np.linalg.norm(flat.u)
    width = 2 * np.linalg.norm(flat.u)
    on_wall = flat.centre[2] - np.linalg.norm(flat.v) > 0.3  # else it stands on the floor
    found: list[Flat] = []
    for _ in range(30):
        if len(found) == count:
            break
        last = flat if not found else found[int(rng.integers(len(found)))]
        shift = last.centre - flat.centre + rng.choice([-1, 1]) * (width + rng.uniform(0.1, 0.35)) * su
        if not on_wall:
            shift = shift + np.array([0.0, rng.uniform(-0.2, 0.3), 0.0])
        x, y = centre = (flat.centre + shift)[:2]
        ends = [centre + sign * flat.u[:2] for sign in (-1, 1)]
        if any(not (left + 0.02 < ex < right - 0.02 and 0.9 < ey < far - 0.02) for ex, ey in ends):
            continue
        if any((x - a) ** 2 + (y - b) ** 2 < (width / 2 + r) ** 2 for a, b, r in scene.taken[1:]):
            continue
        others = [flat, *found]
        if any(np.linalg.norm((flat.centre + shift - o.centre)[:2]) < width + 0.08 for o in others):
            continue
        if any(rooms.between(x, y, width / 2, *(o.centre + s * o.u)[:2]) for o in others for s in (-0.9, 0, 0.9)):
            continue
        found.append(Flat(flat.centre + shift, flat.u, flat.v, moved(flat.holder, shift)))
    scene.taken += [(*o.centre[:2], width / 2) for o in found]
    return found


def solid_siblings(rng, solid: Solid, count: int) -> list[Solid]:
    """Solids of the same outline in a row with `solid`, on the same table or floor."""
    radius = solid.outline[:, 0].max()
    found: list[Solid] = []
    for _ in range(20):
        if len(found) == count:
            break
        place, reach = solid.along
        step = rng.choice([-1, 1]) * rng.uniform(2.2, 3.6) * radius * rng.integers(1, 3)
        if abs(place + step) > reach:
            continue
        depth = rng.uniform(-0.4, 0.4) * radius
        offset = step * solid.axis + depth * np.array([-solid.axis[1], solid.axis[0]])
        base = solid.base + np.array([*offset, 0.0])
        if all(np.linalg.norm((base - o.base)[:2]) > 2.15 * radius for o in [solid, *found]):
            twin = replace(solid, base=base, holder=[], along=(place + step, reach))
            twin.holder.append(twin.fitting())
            found.append(twin)
    return found


def aim(rng, scene: Scene, centre: np.ndarray) -> None:
    """Turn the camera so that `centre` is well inside the picture, keeping the eye where it is."""
    to = centre - scene.camera.origin
    yaw = np.arctan2(to[0], to[1]) + rng.uniform(-0.22, 0.22)
    pitch = np.clip(np.arctan2(to[2], np.hypot(to[0], to[1])) + rng.uniform(-0.1, 0.16), -0.55, 0.05)
    scene.camera.forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])


def treated(rng) -> np.ndarray:
    """Matte spray or frosted film: off-white, slightly uneven."""
    return textures.mottled(rng, textures.paint(rng, 0.6, 0.88), 0.06)
