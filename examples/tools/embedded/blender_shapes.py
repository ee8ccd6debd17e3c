"""Looks (procedural materials) and shapes for the scenes that Blender renders; metres, z up.

Every material is built of nodes and every shape of a few numbers: no files, nothing shared with the Mitsuba rooms.
"""

from colorsys import hsv_to_rgb
from itertools import pairwise
from math import cos, pi, sin

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector

BSDF = "ShaderNodeBsdfPrincipled"


class Look:
    """A Blender material that is built node by node."""

    def __init__(self):
        self.material = bpy.data.materials.new("look")
        self.material.node_tree.nodes.clear()

    def add(self, kind: str, inputs=None, **settings):
        """A node; an input is a value or another node's output."""
        node = self.material.node_tree.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        for name, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.material.node_tree.links.new(value, node.inputs[name])
            else:
                node.inputs[name].default_value = value
        return node

    def finish(self, shader):
        self.add("ShaderNodeOutputMaterial", {"Surface": shader.outputs[0]})
        return self.material

    def ramp(self, factor, colours, constant=False):
        node = self.add("ShaderNodeValToRGB", {0: factor})
        node.color_ramp.interpolation = "CONSTANT" if constant else "LINEAR"
        for index, colour in enumerate(colours):
            stops = node.color_ramp.elements
            stop = stops[index] if index < 2 else stops.new(1.0)
            stop.position, stop.color = index / (len(colours) if constant else len(colours) - 1), colour
        return node.outputs[0]


def colour(rng, low=0.08, high=0.85, saturation=0.75):
    """RGBA, linear."""
    return (*hsv_to_rgb(rng.random(), saturation * rng.random() ** 1.5, rng.uniform(low, high)), 1.0)


def shade_of(colour, factor: float):
    return (*(min(0.92, value * factor) for value in colour[:3]), 1.0)


def look(rng, *kinds, tone=None, roughness=None):
    """A material of one of `kinds`, or of any that suits furniture; its pattern is fixed to the object, in metres."""
    kind = rng.choice(kinds or ["plain", "mottled", "wood", "wood", "checker", "stripes", "terrazzo", "metal"])
    made, first = Look(), tone or colour(rng)
    second = shade_of(first, rng.uniform(0.4, 0.75)) if rng.random() < 0.6 else colour(rng)
    place = made.add("ShaderNodeTexCoord").outputs["Object"]
    base, metallic = first, 0.0
    if kind == "mottled":
        noise = made.add("ShaderNodeTexNoise", {"Vector": place, "Scale": rng.uniform(2, 14), "Detail": 4.0})
        base = made.ramp(noise.outputs[0], (shade_of(first, rng.uniform(0.5, 0.85)), first))
    elif kind == "wood":
        first = (*hsv_to_rgb(rng.uniform(0.04, 0.11), rng.uniform(0.45, 0.8), rng.uniform(0.12, 0.6)), 1.0)
        stretch = made.add("ShaderNodeMapping", {"Vector": place, "Scale": Vector(rng.permutation([1.0, 1.0, 0.15]))})
        wave = made.add(
            "ShaderNodeTexWave",
            {"Vector": stretch.outputs[0], "Scale": rng.uniform(3, 9), "Distortion": rng.uniform(3, 9), "Detail": 3.0},
        )
        base = made.ramp(wave.outputs[0], (shade_of(first, 0.5), first))
    elif kind == "checker":
        inputs = {"Vector": place, "Color1": first, "Color2": second, "Scale": rng.uniform(2.5, 12)}
        base = made.add("ShaderNodeTexChecker", inputs).outputs[0]
    elif kind == "stripes":
        wave = made.add("ShaderNodeTexWave", {"Vector": place, "Scale": rng.uniform(1, 6)})
        wave.bands_direction = rng.choice(["X", "Y", "DIAGONAL"])
        base = made.ramp(wave.outputs[0], (first, second, colour(rng))[: rng.integers(2, 4)], constant=True)
    elif kind == "terrazzo":
        cells = made.add("ShaderNodeTexVoronoi", {"Vector": place, "Scale": rng.uniform(8, 40)})
        base = made.ramp(cells.outputs["Color"], (first, second, colour(rng), first), constant=True)
    elif kind in ("brick", "tiles", "planks"):
        width, height = {"brick": (0.25, 0.08), "tiles": (0.3, 0.3), "planks": (1.3, 0.14)}[kind]
        if kind == "planks":
            first = (*hsv_to_rgb(rng.uniform(0.05, 0.1), rng.uniform(0.4, 0.7), rng.uniform(0.15, 0.55)), 1.0)
        inputs = {"Vector": place, "Color1": first, "Color2": shade_of(first, rng.uniform(0.55, 0.9))}
        inputs |= {"Mortar": shade_of(first, 0.3) if kind == "planks" else colour(rng, 0.3, 0.8, 0.2), "Scale": 1.0}
        grow = rng.uniform(0.8, 1.6)
        inputs |= {"Brick Width": width * grow, "Row Height": height * grow, "Mortar Size": 0.004 * grow}
        offset = 0.0 if kind == "tiles" else 0.5
        base = made.add("ShaderNodeTexBrick", inputs, offset=offset).outputs[0]
    elif kind == "metal":
        metallic = 1.0
        base = shade_of(first, 0.6 / max(first[:3]))
    rough = roughness or (rng.uniform(0.25, 0.5) if kind == "metal" else rng.uniform(0.2, 0.95))
    return made.finish(made.add(BSDF, {"Base Color": base, "Roughness": rough, "Metallic": metallic}))


def glow(tint, strength: float, sky=False):
    """A shining material and its emission node, whose colour and strength an observation changes."""
    made = Look()
    shader = made.add("ShaderNodeEmission", {"Color": tint, "Strength": strength})
    if sky:  # brighter above, trees below
        place = made.add("ShaderNodeTexCoord").outputs["Generated"]
        height = made.add("ShaderNodeSeparateXYZ", {0: place}).outputs[1]
        noise = made.add("ShaderNodeTexNoise", {"Vector": place, "Scale": 7.0}).outputs[0]
        level = made.add("ShaderNodeMath", {0: height, 1: noise}).outputs[0]
        sky_tints = made.ramp(level, ((0.1, 0.2, 0.06, 1), (0.25, 0.35, 0.15, 1), (0.8, 0.9, 1, 1), (1, 1, 1, 1)))
        mix = made.add("ShaderNodeMixRGB", {0: 1.0, 1: sky_tints, 2: tint}, blend_type="MULTIPLY")
        made.material.node_tree.links.new(mix.outputs[0], shader.inputs["Color"])
        return made.finish(shader), mix.inputs[2], shader.inputs["Strength"]
    return made.finish(shader), shader.inputs["Color"], shader.inputs["Strength"]


def thing(build, material, at=(0, 0, 0), turn=(0, 0, 0)):
    """An object from a function that fills a bmesh: smooth, but sharp where faces meet at more than 40 degrees."""
    work, mesh = bmesh.new(), bpy.data.meshes.new("thing")
    build(work)
    work.to_mesh(mesh)
    work.free()
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=0.7)
    mesh.materials.append(material)
    made = bpy.data.objects.new("thing", mesh)
    made.matrix_basis = Matrix.Translation(at) @ _euler(turn)
    bpy.context.scene.collection.objects.link(made)
    return made


def _euler(turn) -> Matrix:
    return Matrix.Rotation(turn[2], 4, "Z") @ Matrix.Rotation(turn[1], 4, "Y") @ Matrix.Rotation(turn[0], 4, "X")


def box(size, material, at, turn=(0, 0, 0), bevel=0.006):
    def build(work):
        bmesh.ops.create_cube(work, size=1.0)
        bmesh.ops.scale(work, vec=Vector(size), verts=work.verts)
        if bevel and min(size) > 3 * bevel:
            bmesh.ops.bevel(work, geom=work.edges[:], offset=bevel, segments=2, profile=0.5, affect="EDGES")

    return thing(build, material, at, turn)


def cone(low, high, height, material, at, turn=(0, 0, 0)):
    """A cylinder or cone whose foot is at `at`."""

    def build(work):
        bmesh.ops.create_cone(
            work,
            cap_ends=True,
            segments=32,
            radius1=low,
            radius2=high,
            depth=height,
            matrix=Matrix.Translation((0, 0, height / 2)),
        )

    return thing(build, material, at, turn)


def ball(radius, material, at, squash=1.0, fine=32):
    def build(work):
        bmesh.ops.create_uvsphere(work, u_segments=2 * fine, v_segments=fine, radius=radius)
        bmesh.ops.scale(work, vec=Vector((1, 1, squash)), verts=work.verts)

    return thing(build, material, at)


def monkey(size, material, at, turn):
    def build(work):
        bmesh.ops.create_monkey(work)
        bmesh.ops.scale(work, vec=Vector((size,) * 3), verts=work.verts)

    return thing(build, material, at, turn)


def lathe(outline, material, at, steps=48):
    """A body turned about the z axis from (radius, height) points; ends on the axis are closed."""

    def build(work):
        rings = []
        for radius, height in outline:
            angles = np.arange(steps) * 2 * pi / steps if radius > 1e-6 else [0.0]
            rings.append([work.verts.new((radius * cos(a), radius * sin(a), height)) for a in angles])
        for low, high in pairwise(rings):
            for i in range(steps):
                corners = [low[i % len(low)], low[(i + 1) % len(low)], high[(i + 1) % len(high)], high[i % len(high)]]
                work.faces.new(list(dict.fromkeys(corners)))

    return thing(build, material, at)


def ring(radius, tube, material, at, turn=(0, 0, 0)):
    angles = np.linspace(0, 2 * pi, 17)
    made = lathe([(radius + tube * cos(a), tube * sin(a)) for a in angles], material, at)
    made.matrix_basis = made.matrix_basis @ _euler(turn)
    return made


def upright(centre, yaw, tilt=0.0) -> Matrix:
    """The frame of a standing sheet: local x sideways, y up, z its normal, which is -y turned by `yaw`, tilted up."""
    return Matrix.Translation(centre) @ Matrix.Rotation(yaw, 4, "Z") @ Matrix.Rotation(pi / 2 - tilt, 4, "X")


def sheet(width, height, material, frame: Matrix):
    def build(work):
        bmesh.ops.create_grid(work, x_segments=1, y_segments=1, size=0.5)
        bmesh.ops.scale(work, vec=Vector((width, height, 1)), verts=work.verts)

    made = thing(build, material)
    made.matrix_basis = frame
    return made


def points(made) -> np.ndarray:
    """(N, 3) vertices in the world."""
    flat = np.empty(3 * len(made.data.vertices), np.float32)
    made.data.vertices.foreach_get("co", flat)
    matrix = np.array(made.matrix_basis)
    return flat.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def place(things, x, y, z=0.0, yaw=0.0):
    """Carry things that were built around the origin to a spot."""
    move = Matrix.Translation((x, y, z)) @ Matrix.Rotation(yaw, 4, "Z")
    for made in things:
        made.matrix_basis = move @ made.matrix_basis
    return things
