"""Render groups with another renderer, Blender's Cycles: does what the Mitsuba rooms taught hold elsewhere?

    python examples/tools/embedded/blender_groups.py --out renders --set blender --count 48 --first_seed 40000000

Needs Blender as a Python module, in an environment of its own with Python 3.11: `pip install bpy==5.0.1 pillow tqdm`.
A group takes about 9 s on one core. Finished groups are skipped.

A third of the groups each show a mirror, a framed pane and a glass object, three observations a group, in the form
that `render_groups.py` leaves: `images/*.jpg` (140x112, quality 95), `masks/*.png`, `depths/*.png` (z-depth in mm,
the target counting as opaque), `reference.jpg` (the same scene, the target matt light grey) and `group.json`. Rooms,
furniture, materials and targets are made by `blender_rooms.py`, `blender_targets.py` and `blender_shapes.py`; nothing
is shared with the Mitsuba scenes, and nothing was tuned to the results of a model. What the set keeps is the
horizontal field of view of 60 degrees, as the base knows no other, and an eye 1.1 to 1.6 m high.

Within a group the camera, the target and all that the camera sees around it stay. Things behind the camera move,
things come and go behind a pane or glass object (only where they are seen through it alone), and lamps and daylight
change. The glass is clean: of its surface only reflections show. But in a quarter of the groups one observation is
covered (a sheet on the mirror, a card behind the pane, paint inside the glass): `surface_seen`. Pictures are
path-traced at twice the size, 4 samples a pixel there, and denoised (OpenImageDenoise, with albedo and normals), then
made plain sRGB (Blender's view transform "Standard") by an automatic exposure that errs a little. Masks and depths
are the same in every run; Blender's pictures may differ a little.
"""

import argparse
import os
import tempfile
from contextlib import contextmanager
from math import hypot, radians, tan
from pathlib import Path

import bpy
import numpy as np
from blender_rooms import furnish, furniture, light, ornament
from blender_shapes import Look, place, points
from blender_targets import MAKERS, clear_look, covered_look, matte_look
from group_files import ATTEMPTS, KEPT, KINDS, first_group, write_group
from mathutils import Vector
from PIL import Image, ImageFilter
from tqdm import tqdm

WIDTH, HEIGHT = KEPT
FIELD_OF_VIEW = radians(60)  # horizontal
FOCAL = WIDTH / 2 / tan(FIELD_OF_VIEW / 2)
OBSERVATIONS, COVERED = 3, 0.25
SAMPLES, ENLARGED = 4, 2


class Camera:
    """The camera of a group and where it sees things."""

    def __init__(self, rng, centre):
        self.eye = np.array([0.0, 0.0, rng.uniform(1.1, 1.6)])
        to = centre - self.eye
        yaw = np.arctan2(to[0], to[1]) + rng.uniform(-0.2, 0.2)
        pitch = np.clip(np.arctan2(to[2], hypot(to[0], to[1])) + rng.uniform(-0.12, 0.14), -0.65, 0.06)
        self.forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
        data = bpy.data.cameras.new("camera")
        data.sensor_fit, data.angle, data.clip_start = "HORIZONTAL", FIELD_OF_VIEW, 0.05
        made = bpy.data.objects.new("camera", data)
        turn = Vector(self.forward).to_track_quat("-Z", "Y").to_matrix()
        made.matrix_basis = turn.to_4x4()
        made.location = self.eye
        self.axes = np.array(turn).T * [[1], [-1], [-1]]  # right, down, forward
        bpy.context.scene.collection.objects.link(made)
        bpy.context.scene.camera = made

    def project(self, where) -> np.ndarray:
        """(N, 3) points to (N, 3): column and row in pixels, z-depth."""
        x, y, z = self.axes @ (np.asarray(where) - self.eye).T
        return np.stack([FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2, z], 1)

    def within(self, where, mask) -> np.ndarray:
        """(N,) which points are seen in the mask, if at all."""
        column, row, z = self.project(where).T
        inside = (z > 0) & (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
        hit = np.zeros(len(inside), bool)
        hit[inside] = mask[row[inside].astype(int), column[inside].astype(int)]
        return hit


def behind(camera, things) -> bool:
    """Out of the camera's direct view for sure."""
    return all(camera.project(points(each))[:, 2].max() < -0.1 for each in things)


def discard(things) -> None:
    for each in things:
        bpy.data.meshes.remove(each.data)  # and the object with it


def reflected(camera, target, mask, xy) -> np.ndarray:
    """(N,) which places of (N, 2) behind the camera a mirror or pane shows, at the height of furniture."""
    chest = np.column_stack([xy, np.full(len(xy), 0.6)])
    image = chest - 2 * ((chest - target.centre) @ target.normal)[:, None] * target.normal
    return camera.within(image, mask) & (camera.project(chest)[:, 2] < -0.5)


def carry_in(rng, room, camera, target, mask) -> list:
    """Furniture for one observation behind the camera; before a mirror first where the mirror shows it."""
    xy = rng.uniform((room.left + 0.5, room.rear + 0.5), (room.right - 0.5, -0.4), (80, 2))
    if target.normal is not None:
        xy = xy[np.argsort(~reflected(camera, target, mask, xy), kind="stable")]
    kept, taken, count = [], list(room.taken), rng.integers(2, 5)
    for x, y in xy:
        if len(taken) - len(room.taken) == count:
            break
        if hypot(x, y) < 1.0 or any(hypot(x - a, y - b) < 0.45 + r for a, b, r in taken):
            continue
        if camera.project([(x, y, 0.0)])[0, 2] > -0.5:
            continue
        made = place(furniture(rng), x, y, yaw=rng.uniform(-3, 3))
        if behind(camera, made):
            kept += made
            taken.append((x, y, 0.45))
        else:
            discard(made)
    return kept


def set_behind(rng, room, camera, target, mask) -> list:
    """Things behind a pane or glass object that the camera sees through it alone."""
    inner = np.asarray(Image.fromarray(mask).filter(ImageFilter.MinFilter(3)))
    kept, taken, count = [], list(room.taken) if target.normal is not None else [], rng.integers(1, 3)
    start = len(taken)
    for x, y, z in rng.permutation(target.spots):
        if len(taken) - start == count:
            break
        if target.normal is None:
            radius, made = 0.1, ornament(rng, rng.uniform(0.08, 0.28))
        elif rng.random() < 0.5:
            radius, made = 0.4, furniture(rng)
        else:
            radius, made = 0.3, ornament(rng, rng.uniform(0.3, 0.6))
        place(made, x, y, z, rng.uniform(-0.8, 0.8))
        corners = np.concatenate([points(each) for each in made])
        clear = target.normal is None or ((corners - target.centre) @ target.normal).max() < -0.04
        free = all(hypot(x - a, y - b) > radius + r for a, b, r in taken)
        if clear and free and y + radius < room.far and camera.within(corners, inner).all():
            kept += made
            taken.append((x, y, radius))
        else:
            discard(made)
    return kept


def change_light(rng, room) -> None:
    """Other lamps and other daylight."""
    level = {"lamp": rng.uniform(0.4, 1.6), "window": rng.choice([rng.uniform(0.4, 1.8), 0.05], p=[0.85, 0.15])}
    for tint, strength, usual, kind in room.lights:
        strength.default_value = usual * level[kind] * rng.uniform(0.8, 1.25)
        warm = rng.uniform(0.5, 1.0)
        tint.default_value = (
            (1.0, 0.6 + 0.4 * warm, warm, 1.0) if kind == "lamp" else (0.7 + 0.3 * warm, 0.95, 1.0, 1.0)
        )


def set_up() -> None:
    """An empty scene for Cycles: one thread, so that several sets can be rendered side by side."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    render, cycles = scene.render, scene.cycles
    render.engine, cycles.device = "CYCLES", "CPU"
    render.threads_mode, render.threads = "FIXED", 1
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    cycles.use_adaptive_sampling = cycles.use_light_tree = False
    cycles.denoiser, cycles.denoising_input_passes = "OPENIMAGEDENOISE", "RGB_ALBEDO_NORMAL"
    cycles.denoising_prefilter = "FAST"
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.diffuse_bounces, cycles.glossy_bounces, cycles.transmission_bounces = 2, 4, 8
    cycles.sample_clamp_indirect = 5.0


@contextmanager
def silence():
    """Blender reports every picture on the standard output."""
    kept, nothing = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nothing)


def shoot(folder: Path, enlarged: int) -> np.ndarray:
    """The scene as it stands: (H, W, 3) linear values, rows from the top."""
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = WIDTH * enlarged, HEIGHT * enlarged
    scene.render.filepath = str(folder / "shot.exr")
    with silence():
        bpy.ops.render.render(write_still=True)
    picture = bpy.data.images.load(scene.render.filepath)
    values = np.empty(WIDTH * HEIGHT * enlarged**2 * 4, np.float32)
    picture.pixels.foreach_get(values)
    bpy.data.images.remove(picture)
    return values.reshape(HEIGHT * enlarged, WIDTH * enlarged, 4)[::-1, :, :3]


def photo(folder: Path, seed: int, error: float = 1.0) -> np.ndarray:
    """(H, W, 3) 8-bit sRGB of a path-traced picture; `error` of the automatic exposure."""
    scene = bpy.context.scene
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.seed = SAMPLES, True, seed
    scene.cycles.max_bounces, scene.cycles.pixel_filter_type = 10, "BLACKMAN_HARRIS"
    scene.cycles.filter_width = 1.5
    linear = shoot(folder, ENLARGED)
    level = np.minimum(linear, np.percentile(linear, 97)).mean()
    linear = np.clip(linear * error * 0.22 / max(level, 1e-6), 0, 1)
    linear = linear.reshape(HEIGHT, ENLARGED, WIDTH, ENLARGED, 3).mean((1, 3))
    srgb = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055)
    return (srgb * 255 + 0.5).astype(np.uint8)


def geometry(folder: Path, override) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) z-depth in metres and target mask of the first surface at each pixel's centre."""
    scene, layer = bpy.context.scene, bpy.context.view_layer
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.max_bounces = 1, False, 0
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
    layer.material_override = override
    values = shoot(folder, 1)
    layer.material_override = None
    return values[..., 0], values[..., 1] > 0.5


def measuring_look():
    """Every surface shines with its distance along the optical axis (red) and its object index (green)."""
    made = Look()
    depth = made.add("ShaderNodeCameraData").outputs["View Z Depth"]
    index = made.add("ShaderNodeObjectInfo").outputs["Object Index"]
    pair = made.add("ShaderNodeCombineColor", {0: depth, 1: index})
    made.material.cycles.emission_sampling = "NONE"
    return made.finish(made.add("ShaderNodeEmission", {"Color": pair.outputs[0]}))


def make_group(seed: int, kind: str, folder: Path):
    """Images, mask, depth and reference of one group, or None where the plan turns out badly."""
    rng = np.random.default_rng([20260601, seed])
    set_up()
    room, target = MAKERS[kind](rng)
    camera = Camera(rng, target.centre)
    to_eye = camera.eye - target.centre
    away = np.linalg.norm(to_eye)
    if not 1.1 < away < 3.2 or (target.normal is not None and to_eye @ target.normal < 0.35 * away):
        return None
    light(rng, room)
    furnish(rng, room, target.clear)
    room.taken = [circle for circle in room.taken if circle not in target.reserve]
    body, measuring = target.body, measuring_look()
    body.pass_index = 1
    others = [each for each in bpy.data.objects if each.type == "MESH" and each != body]
    for each in others:
        each.hide_render = True
    _, alone = geometry(folder, measuring)
    for each in others:
        each.hide_render = False
    depth, mask = geometry(folder, measuring)
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    if not 0.04 < mask.mean() < 0.45 or mask.sum() < 0.8 * alone.sum() or border.mean() > 0.08:
        return None
    if depth.min() < 0.3 or depth.max() > 20:
        return None
    if kind == "mirror":  # it must be able to show what is moved
        grid = np.meshgrid(np.linspace(room.left, room.right, 14)[2:-2], np.linspace(room.rear, 0, 14)[2:])
        if reflected(camera, target, mask, np.column_stack([each.ravel() for each in grid])).sum() < 4:
            return None
    wear(body, matte_look())
    reference = photo(folder, 0)
    clear, covered = clear_look(rng, kind), covered_look(rng, kind)
    shown = [False] * OBSERVATIONS
    if rng.random() < COVERED:
        shown[rng.integers(OBSERVATIONS)] = True
    images = []
    for number, surface_seen in enumerate(shown):
        wear(body, covered if surface_seen else clear)
        change_light(rng, room)
        things = carry_in(rng, room, camera, target, mask)
        if kind != "mirror":
            things += set_behind(rng, room, camera, target, mask)
        again, same = geometry(folder, measuring)
        if (same != mask).any() or np.abs(again - depth).max() > 0.001:
            return None
        images.append(photo(folder, number + 1, rng.uniform(0.8, 1.3)))
        discard(things)
    depths = [np.round(depth * 1000).astype(np.uint16)] * OBSERVATIONS
    return {"images": images, "mask": mask, "depths": depths, "reference": reference, "shown": shown}


def wear(body, material) -> None:
    body.data.materials.clear()
    body.data.materials.append(material)


def work(folder: Path, kind: str, first_seed: int, temporary: Path) -> None:
    """Render a group into `temporary` and move it to its place when it is complete."""
    group, seed = first_group(lambda seed: make_group(seed, kind, temporary), first_seed, folder.name)
    (temporary / "shot.exr").unlink()
    write_group(group, kind, seed, temporary, folder)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("renders"))
    parser.add_argument("--set", default="blender", help="name of the set below --out")
    parser.add_argument(
        "--first_seed", type=int, default=40_000_000, help=f"scenes take seeds from here on, {ATTEMPTS} a group"
    )
    parser.add_argument("--count", type=int, default=48, help="groups, the kinds in turn")
    args = parser.parse_args()
    root, kinds = args.out / args.set, list(KINDS)
    root.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=args.out, prefix=f"{args.set}.part.") as parts:
        for index in tqdm(range(args.count), unit="group"):
            kind = kinds[index % 3]
            folder, temporary = root / f"{kind}_{index:04d}", Path(parts) / f"{index:04d}"
            if not folder.exists():
                temporary.mkdir()
                work(folder, kind, args.first_seed + index * ATTEMPTS, temporary)


if __name__ == "__main__":
    main()
