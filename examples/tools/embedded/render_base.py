"""Render the pictures that the embedded base model is pre-trained on: rooms WITHOUT any mirror or glass.

    pip install -e ".[render]"
    python examples/tools/embedded/render_base.py --out renders/base --count 5400 --processes 2
    python examples/tools/embedded/render_base.py --out renders/bare --count 5400 --without_twins

Opaque twins of every kind of target stand where the groups have their mirrors, panes and glass objects, as do empty
frames and doorways one really can look through; `--without_twins` leaves the twins away (into an `--out` of its own).
One .npz per scene (two views each): `image` (2, 140, 175, 3) uint8 and `depth` (2, 140, 175) uint16, z-depth in
millimetres. Finished scenes are skipped, so it may be interrupted.
"""

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from tqdm import tqdm

EMPTY = 0.45  # share of the frames in a near scene's row that hold no panel: what is seen in them is really there
FIRST_NEAR = 2004  # the seeds below it are rooms at large


def opaque_scene(rng):
    """A furnished room with twins at the targets' places."""
    import rooms
    import targets

    scene = rooms.make_room(rng)
    focus = []
    kind = rng.choice(["wall", "standing", "table", "none"], p=[0.25, 0.3, 0.3, 0.15])
    if kind == "wall":
        flat = targets.wall_panel(rng, scene)
        scene.items += [*flat.holder, flat.panel(rooms.twin_texture(rng))]
        focus.append(flat.centre)
    elif kind == "standing":
        flat = targets.standing_panel(rng, scene, see_through=bool(rng.random() < 0.7))
        if flat is not None:
            scene.items += flat.holder
            if rng.random() < 0.65:  # else an empty frame: what is seen in it is really there
                scene.items.append(flat.panel(rooms.twin_texture(rng)))
            focus.append(flat.centre)
    elif kind == "table":
        solid = targets.table_object(rng, scene)
        if solid is not None:
            look = targets.treated(rng) if rng.random() < 0.35 else rooms.twin_texture(rng)
            gloss = float(rng.uniform(0.05, 0.3)) if rng.random() < 0.5 else None
            scene.items += [*solid.holder, solid.body(look, gloss)]
            for _ in range(rng.integers(0, 3)):
                dx, dy = rng.uniform(-0.28, 0.28), rng.uniform(0.0, 0.25)
                if abs(dx) > 0.16 and solid.base[2] > 0:
                    spot = (solid.base[0] + dx, solid.base[1] + dy, solid.base[2])
                    scene.items += rooms.small_thing(rng, *spot, scale=0.7)
            focus.append(solid.centre)
    if focus and rng.random() < 0.8:
        targets.aim(rng, scene, focus[0])
    rooms.furnish(rng, scene, keep_clear=[tuple(c[:2]) for c in focus] if rng.random() < 0.8 else ())
    if rng.random() < 0.3:  # a board or carton close behind or beside things, as in the groups
        scene.items += rooms.small_thing(rng, rng.uniform(-0.6, 0.6), rng.uniform(1.2, 2.2), 0.0, scale=2.0)
    return scene


def near_scene(rng):
    """A room as planned for a group, with an opaque twin, or an empty frame, in the target's place; its centre."""
    import render_groups

    kind = rng.choice(["mirror", "pane", "solid"], p=[0.25, 0.25, 0.5])
    planned = None
    while planned is None:
        planned = render_groups.plan(rng, kind, 1.0, EMPTY)
    scene, target = planned
    if kind == "solid" or rng.random() >= EMPTY:
        scene.items.append(render_groups.opaque(rng, target))
    if rng.random() < 0.5:
        render_groups.decoys(rng, scene, target)
    return scene, target.centre


def bare_scene(rng):
    """A furnished room without any target's twin, picture or round thing (balls, vessels, lamps, plants, stools).

    Chairs, tables, boxes, cartons, books, cabinets, doorways and empty frames are left.
    """
    import rooms
    import targets

    scene = rooms.make_room(rng)
    frame = targets.standing_panel(rng, scene, see_through=True) if rng.random() < 0.4 else None
    if frame is not None:
        scene.items += frame.holder
        if rng.random() < 0.8:
            targets.aim(rng, scene, frame.centre)
    rooms.furnish(rng, scene, keep_clear=[] if frame is None else [tuple(frame.centre[:2])], pictures=False)
    scene.items = [item for item in scene.items if item.shape["type"] not in ("sphere", "mesh")]
    return scene


def views(seed: int, twins: bool = True):
    """Two pictures and z-depths of one scene, each with its own light: the planned view and one turned away.

    From `FIRST_NEAR` on the scenes are near ones, and the second view only shifts the target within the picture.
    Without `twins` every scene is a bare one, with views as of a room at large.
    """
    import targets
    import tracer

    rng = np.random.default_rng([20260101, seed])
    if twins and seed >= FIRST_NEAR:
        scene, centre = near_scene(rng)
    else:
        scene, centre = opaque_scene(rng) if twins else bare_scene(rng), None
    images, depths = [], []
    for view in range(2):
        if view and centre is not None:
            scene.camera.origin = np.array([0.0, 0.0, rng.uniform(1.2, 1.5)])
            targets.aim(rng, scene, centre)
        elif view:
            yaw, pitch = rng.uniform(-0.5, 0.5), rng.uniform(-0.4, -0.02)
            direction = [np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)]
            scene.camera.forward = np.array(direction)
            scene.camera.origin = np.array([0.0, 0.0, rng.uniform(1.2, 1.5)])
        direct, albedo, position = tracer.shade(scene)
        depth = (position - scene.camera.origin) @ scene.camera.forward
        if depth.min() < 0.25 or depth.max() > 30:  # the eye is inside something, or looks through a gap
            return None
        radiance = tracer.light_up(rng, direct, albedo)
        images.append(tracer.develop(radiance, tracer.auto_exposure(radiance) * rng.uniform(0.7, 1.35)))
        depths.append(np.round(depth * 1000).astype(np.uint16))
    return np.stack(images), np.stack(depths)


def work(task) -> int:
    seed, path, twins = task
    rendered = views(seed, twins)
    temporary = path.with_suffix(".part.npz")
    if rendered is None:
        np.savez(temporary, image=np.zeros((0, 140, 175, 3), np.uint8), depth=np.zeros((0, 140, 175), np.uint16))
    else:
        np.savez_compressed(temporary, image=rendered[0], depth=rendered[1])
    os.replace(temporary, path)
    return 0 if rendered is None else 2


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("renders/base"))
    parser.add_argument("--count", type=int, default=5400, help="pictures, two per scene")
    parser.add_argument("--first", type=int, default=0, help=f"seed to begin with; near scenes from {FIRST_NEAR} on")
    parser.add_argument("--without_twins", action="store_true", help="no twin of a target, no picture, nothing round")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    seeds = range(args.first, args.first + args.count // 2)
    paths = [(seed, args.out / f"{seed:05d}.npz", not args.without_twins) for seed in seeds]
    tasks = [task for task in paths if not task[1].exists()]
    with ProcessPoolExecutor(args.processes) as pool:
        list(tqdm(pool.map(work, tasks), total=len(tasks), unit="scene"))


if __name__ == "__main__":
    main()
