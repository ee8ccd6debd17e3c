"""Mirrors, panes and glass objects for the groups that Blender renders, each with the room it stands in."""

from dataclasses import dataclass, field

import bpy
import numpy as np
from blender_rooms import Room, border, make_room
from blender_shapes import Look, ball, box, cone, lathe, look, place, sheet, upright
from mathutils import Vector


@dataclass
class Target:
    body: bpy.types.Object
    centre: np.ndarray
    normal: np.ndarray | None  # of a flat one, towards the camera
    clear: list[tuple[float, float]]  # nothing may stand before these
    spots: list = field(default_factory=list)  # places behind a see-through target: x, y and height of the ground
    reserve: list = field(default_factory=list)  # circles of `Room.taken` that only keep fixed furniture away


def clear_look(rng, kind: str):
    """Mirror, thin pane or glass."""
    made = Look()
    if kind == "mirror":
        tint = (*rng.uniform(0.82, 0.94) * np.array([0.98, 1.0, 0.99]), 1.0)
        return made.finish(made.add("ShaderNodeBsdfGlossy", {"Color": tint, "Roughness": 0.0}))
    tint = (*rng.uniform(0.84, 0.97) * np.array([0.96, 1.0, 0.98]), 1.0)
    clear = made.add("ShaderNodeBsdfTransparent", {"Color": tint})
    if kind == "pane":  # light is reflected by both faces of the sheet: 2 F / (1 + F)
        face = made.add("ShaderNodeFresnel", {"IOR": 1.5}).outputs[0]
        twice = made.add("ShaderNodeMath", {0: face, 1: 2.0}, operation="MULTIPLY").outputs[0]
        both = made.add("ShaderNodeMath", {0: face, 1: 1.0}).outputs[0]
        share = made.add("ShaderNodeMath", {0: twice, 1: both}, operation="DIVIDE").outputs[0]
        gloss = made.add("ShaderNodeBsdfGlossy", {"Color": (1, 1, 1, 1), "Roughness": 0.0})
        return made.finish(made.add("ShaderNodeMixShader", {0: share, 1: clear.outputs[0], 2: gloss.outputs[0]}))
    inputs = {"Color": (1, 1, 1, 1) if rng.random() < 0.6 else tint, "Roughness": 0.0, "IOR": rng.uniform(1.45, 1.5)}
    glass = made.add("ShaderNodeBsdfGlass", inputs)
    path = made.add("ShaderNodeLightPath").outputs  # light passes to what stands around: no caustics, soft shadows
    straight = made.add("ShaderNodeMath", {0: path["Is Shadow Ray"], 1: path["Is Diffuse Ray"]}, operation="MAXIMUM")
    inputs = {0: straight.outputs[0], 1: glass.outputs[0], 2: clear.outputs[0]}
    return made.finish(made.add("ShaderNodeMixShader", inputs))


def covered_look(rng, kind: str):
    """A sheet on the mirror is paper; a card or paint is seen behind the glass's own gloss."""
    rough = 0.9 if kind == "mirror" else 0.02
    return look(rng, "plain", "mottled", "stripes", "checker", "terrazzo", roughness=rough)


def matte_look():
    made = Look()
    return made.finish(made.add("ShaderNodeBsdfDiffuse", {"Color": (0.68, 0.68, 0.68, 1.0)}))


def flat(rng, kind: str, centre, yaw: float, tilt: float, width: float, height: float) -> Target:
    frame = upright(centre, yaw, tilt)
    body = sheet(width, height, None, frame)
    bar = rng.uniform(0.02, 0.07)
    if kind == "pane" or rng.random() < 0.65:
        bars = border(width, height, bar, rng.uniform(0.03, 0.05), look(rng, "wood", "plain", "metal", "mottled"))
        for each in bars:  # they are built upright in the plane y = 0, the sheet in the plane z = 0
            each.matrix_basis = frame @ upright((0, 0, 0), 0).inverted() @ each.matrix_basis
    ends = [np.array(frame @ Vector((s * width / 2, 0, 0))) for s in (-0.9, -0.4, 0.4, 0.9)]
    normal = np.array(frame.to_3x3() @ Vector((0, 0, 1)))
    return Target(body, np.array(centre), normal, [tuple(end[:2]) for end in (*ends, np.array(centre))])


def mirror(rng) -> tuple[Room, Target]:
    """On a wall, leaning on feet, or the door of a wardrobe."""
    style = rng.choice(["wall", "wardrobe", "easel"])
    width, height = rng.uniform(0.5, 1.2), rng.uniform(0.6, 1.4)
    if style == "wall":
        wall = rng.choice(["far", "far", "left", "right"])
        room = make_room(rng, rng.uniform(1.4, 2.7) if wall == "far" else rng.uniform(2.6, 4.0))
        s = rng.uniform(-0.7, 0.7) if wall == "far" else rng.uniform(1.2, min(2.2, room.far - width / 2 - 0.1))
        room.hung[wall].append((s, width + 0.2))
        centre, yaw = room.on(wall, s, max(rng.uniform(1.0, 1.6), height / 2 + 0.2), 0.025)
        target = flat(rng, "mirror", centre, yaw, 0.0, width, height)
        back, _ = room.on(wall, s, centre[2], 0.011)
        box((width, 0.02, height), look(rng, "wood", "plain"), back, (0, 0, yaw))
        return room, target
    room = make_room(rng, rng.uniform(2.4, 4.5))
    x, y, yaw = rng.uniform(-0.8, 0.8), rng.uniform(1.2, min(2.4, room.far - 0.6)), rng.uniform(-0.5, 0.5)
    away = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    if style == "wardrobe":
        height, deep = rng.uniform(1.2, 1.7), rng.uniform(0.35, 0.5)
        middle = np.array([x, y, height / 2 + 0.1]) + away * (deep / 2 + 0.006)
        box((width + 0.12, deep, height + 0.2), look(rng, "wood", "plain"), middle, (0, 0, yaw))
        target = flat(rng, "mirror", (x, y, height / 2 + 0.1), yaw, 0.0, width, height)
        room.taken.append((*middle[:2], width / 2 + 0.1))
        return room, target
    tilt, lift = rng.uniform(0.02, 0.14), rng.uniform(0.04, 0.3)
    centre = np.array([x, y, lift + height / 2])
    target = flat(rng, "mirror", centre, yaw, tilt, width, height)
    metal = look(rng, "metal", "wood")
    box((width, 0.016, height), metal, centre - target.normal * 0.012, (-tilt, 0, yaw))
    for s in (-0.4, 0.4):  # easel legs
        foot = np.array([x, y, 0.0]) + s * width * np.array([np.cos(yaw), np.sin(yaw), 0]) + away * 0.05
        cone(0.02, 0.02, lift + height / 2, metal, foot)
        box((0.05, 0.4, 0.03), metal, foot + np.array([0, 0, 0.015]), (0, 0, yaw))
    room.taken.append((x, y, width / 2 + 0.05))
    return room, target


def pane(rng) -> tuple[Room, Target]:
    """A framed sheet of glass on feet, with room behind it."""
    width, height, lift = rng.uniform(0.6, 1.2), rng.uniform(0.8, 1.4), rng.uniform(0.05, 0.3)
    x, y, yaw = rng.uniform(-0.6, 0.6), rng.uniform(1.2, 2.2), rng.uniform(-0.45, 0.45)
    room = make_room(rng, y + rng.uniform(1.5, 3.0))
    target = flat(rng, "pane", (x, y, lift + height / 2), yaw, 0.0, width, height)
    metal = look(rng, "metal", "wood", "plain")
    for s in (-0.42, 0.42):
        foot = np.array([x, y, 0.0]) + s * width * np.array([np.cos(yaw), np.sin(yaw), 0])
        box((0.06, 0.4, 0.03), metal, foot + np.array([0, 0, 0.015]), (0, 0, yaw))
        box((0.05, 0.04, lift), metal, foot + np.array([0, 0, lift / 2]), (0, 0, yaw))
    for _ in range(30):  # on the floor, around the line of sight through the pane
        far = rng.uniform(0.35, room.far - y - 0.3)
        side = rng.uniform(-0.5, 0.5) * width
        target.spots.append((x * (1 + far / y) + side, y + far, 0.0))
    target.reserve = [(x, y, width / 2 + 0.05), (x * (1 + 0.8 / y), y + 0.8, 0.4)]
    room.taken += target.reserve
    return room, target


def solid(rng) -> tuple[Room, Target]:
    """A glass ball, jar, bottle or vase on a table or on the floor."""
    room = make_room(rng, rng.uniform(2.6, 4.5))
    kind = rng.choice(["ball", "bottle", "vase", "jar"])
    low = rng.random() < 0.2
    x, y, z, back = rng.uniform(-0.4, 0.4), rng.uniform(1.2, 1.6), 0.0, 0.9
    if not low:
        z, w, d = rng.uniform(0.55, 0.9), rng.uniform(0.8, 1.5), rng.uniform(0.55, 0.9)
        top, legs = look(rng, "wood", "plain", "checker", "terrazzo", "mottled"), look(rng, "wood", "metal", "plain")
        made = [box((w, d, 0.04), top, (0, 0, z - 0.02), bevel=0.01)]
        made += [
            cone(0.02, 0.03, z - 0.04, legs, (a * (w / 2 - 0.06), b * (d / 2 - 0.06), 0))
            for a in (-1, 1)
            for b in (-1, 1)
        ]
        place(made, x + rng.uniform(-0.2, 0.2), y + d / 2 - 0.25, 0, rng.uniform(-0.1, 0.1))
        back = d - 0.35
        room.taken.append((x, y + d / 2 - 0.25, max(w, d) / 2))
    scale = 1.5 if low else 1.0
    tall, wide = scale * rng.uniform(0.36, 0.6), scale * rng.uniform(0.12, 0.18)
    if kind == "ball":
        radius = scale * rng.uniform(0.15, 0.23)
        body, tall = ball(radius, None, (x, y, z + radius + 0.004)), 2 * radius
        cone(0.5 * radius, 0.42 * radius, 0.13 * radius, look(rng, "wood", "metal", "plain"), (x, y, z))
    else:
        shapes = {
            "bottle": [(0.8, 0), (1, 0.04), (1, 0.5), (0.85, 0.63), (0.36, 0.76), (0.32, 0.97), (0.38, 1)],
            "vase": [(0.55, 0), (0.6, 0.05), (0.95, 0.35), (1, 0.5), (0.7, 0.75), (0.55, 0.87), (0.75, 1)],
            "jar": [(0.92, 0), (1, 0.03), (1.02, 0.4), (1, 0.78), (0.85, 0.86), (0.8, 1)],
        }
        heights = np.linspace(0, 1, 40)
        keys = np.array(shapes[kind])
        slope = np.gradient(keys[:, 0], keys[:, 1])
        radius = hermite(heights, keys[:, 1], keys[:, 0], slope) * wide
        wall = rng.uniform(0.006, 0.012)
        outer = [(0.0, 0.0), *zip(radius, heights * tall, strict=True)]
        keep = heights * tall > 2 * wall  # the inside, from the rim down; a thick bottom
        inner = [*zip(radius[keep][::-1] - wall, heights[keep][::-1] * tall, strict=True), (0.0, 2 * wall)]
        body = lathe([*outer, *inner], None, (x, y, z))
        if kind != "vase" and rng.random() < 0.7:
            rim, lid = radius[-1], look(rng, "wood", "metal", "plain")
            cone(rim + 0.006, rim + 0.004, 0.05 * scale, lid, (x, y, z + tall - 0.012))
    reach = max(wide, tall / 4)
    clear = [(x + s * reach, y) for s in (-1, 0, 1)]
    target = Target(body, np.array([x, y, z + tall / 2]), None, clear)
    for _ in range(20 if back > reach + 0.1 else 0):
        far = rng.uniform(reach + 0.1, back)
        target.spots.append((x * (1 + far / y) + rng.uniform(-0.5, 0.5) * reach, y + far, z))
    return room, target


def hermite(at, x, y, slope):
    """Cubic interpolation of y(x) with given slopes."""
    index = np.clip(np.searchsorted(x, at) - 1, 0, len(x) - 2)
    step = x[index + 1] - x[index]
    t = (at - x[index]) / step
    a, b = y[index], y[index + 1]
    return (
        (2 * t**3 - 3 * t**2 + 1) * a
        + (t**3 - 2 * t**2 + t) * step * slope[index]
        + (3 * t**2 - 2 * t**3) * b
        + (t**3 - t**2) * step * slope[index + 1]
    )


MAKERS = {"mirror": mirror, "pane": pane, "solid": solid}
