"""Render the groups of the mini GIFT-I: one camera, one geometry, and a target whose content changes.

    python examples/tools/embedded/render_groups.py --out renders/groups --processes 2
    python examples/tools/embedded/render_groups.py --out renders --set fresh_1 --first_seed 20000000 --count 24
    python examples/tools/embedded/render_groups.py --out renders --set singles --first_seed 30000000 --count 1000 \
        --photos

Without `--set` it renders the shipped dataset. `--set NAME` renders `--count` more groups, a third of each kind, from
scene seeds that nothing else has; `--photos` only one photo a scene, in which the surface itself cannot be seen.

A mirror reflects a room that is rearranged behind the camera, or has a sheet hung before it; a pane stands before
things that are moved, or has a card touching its back; a glass object shows what is behind it, or is filled or lined.
In two thirds or more of the observations the surface itself can be seen. Per group, rendered at 140x175 and kept at
112x140: `images/*.jpg` (quality 95), `masks/*.png` (the target's visible pixels), `depths/*.png` (exact z-depth in mm,
the target's surface included), `reference.jpg` (the same scene with a matte target) and `group.json`. Finished groups
are skipped.
"""

import argparse
import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import rooms
import shapes
import targets
import textures
from group_files import ATTEMPTS, KEPT, KINDS, first_group, write_group
from tqdm import tqdm

SPLITS = {"train": {"mirror": 106, "pane": 106, "solid": 106}, "validation": {"mirror": 8, "pane": 8, "solid": 8}}
DUST = 0.12, 0.3  # share of light that the film on a mirror or glass scatters
REAR = 2.0, 4.0  # metres of the room behind the camera, for a mirror to show
OPENINGS = 0.3  # doors are mostly closed when a group is taken: this share of the usual doorways and windows
FIRST_SEED = {"train": 0, "validation": 4_000_000}


def clutter(rng, count, x_range, y_range) -> list[shapes.Item]:
    """Things that somebody carries into the room for one observation."""
    items = []
    for _ in range(count):
        x, y = rng.uniform(*x_range), rng.uniform(*y_range)
        if rng.random() < 0.4:
            size = rng.uniform((0.2, 0.15, 0.4), (0.7, 0.5, 1.8))
            items.append(shapes.box((x, y, size[2] / 2), size, rooms.twin_texture(rng), rng.uniform(-0.8, 0.8)))
        else:
            items += rooms.furniture(rng, x, y)
    return items


def printed(rng) -> np.ndarray:
    """What covers or fills a target: mostly plain."""
    return textures.card(rng) if rng.random() < 0.3 else textures.mottled(rng, textures.colour(rng, 0.1, 0.9), 0.05)


def sheet(rng, flat: targets.Flat, offset: float) -> tuple[list[shapes.Item], bool]:
    """Paper or card on the target's plane, `offset` metres towards the camera; mostly over all of it: whether."""
    u, v, centre = flat.u, flat.v, flat.centre + flat.normal * offset
    partial = rng.random() < 0.1
    if partial:
        share = rng.uniform(0.6, 0.9)
        centre = centre + rng.choice([-1, 1]) * (1 - share) * u
        u = u * share
    return [shapes.quad(centre, u, v, printed(rng))], not partial


def smudges(rng, scene, flat: targets.Flat) -> np.ndarray:
    """(H, W) dust and wiping marks in the plane of a mirror or pane, about 1 on average."""
    import tracer

    direction = tracer.rays(scene.camera)
    distance = ((flat.centre - scene.camera.origin) @ flat.normal) / (direction @ flat.normal)
    point = scene.camera.origin + direction * distance[..., None] - flat.centre
    s = (point @ flat.u / (flat.u @ flat.u) + 1) / 2
    t = (point @ flat.v / (flat.v @ flat.v) + 1) / 2
    side = textures.SIDE - 1
    place = (s * side).astype(np.float32), (t * side).astype(np.float32)
    return cv2.remap(textures.smears(rng), *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def film(level: float, marks, matte) -> tuple[np.ndarray, np.ndarray]:
    """A thin layer of dust: (H, W, 1) opacity, and the radiance it scatters, being lit as the matte surface is."""
    opacity = np.clip(level * marks, 0, 0.8)[..., None]
    return opacity, opacity * matte


def fresnel(scene, flat: targets.Flat) -> np.ndarray:
    """(H, W) reflectance of both faces of a pane of index 1.5 (Schlick)."""
    import tracer

    cosine = np.abs(tracer.rays(scene.camera) @ flat.normal)
    face = 0.04 + 0.96 * (1 - cosine) ** 5
    return 2 * face / (1 + face)


def plan(rng, kind: str, openings: float, empty: float = 0.0):
    """A furnished room around one target and opaque siblings of it, the camera turned to them.

    `openings` scales how often a doorway or window can be seen; `empty` is the share of the flat siblings
    that are frames without a panel.
    """
    if kind == "mirror" and rng.random() < 0.3:
        scene = rooms.make_room(rng, (2.0, 3.2), REAR, openings)
        target = targets.wall_panel(rng, scene, kind)
    elif kind == "mirror":
        scene = rooms.make_room(rng, (2.6, 5.0), REAR, openings)
        target = targets.standing_panel(rng, scene, False, 2.3, kind)
    elif kind == "pane":
        scene = rooms.make_room(rng, (4.2, 7.0), openings=openings)
        target = targets.standing_panel(rng, scene, True, 2.3, kind)
    else:
        scene = rooms.make_room(rng, (2.8, 5.5), openings=openings)
        target = targets.table_object(rng, scene)
    if target is None:
        return None
    if kind != "solid" and (target.centre - scene.camera.origin) @ target.normal > -0.5:
        return None  # edge on, or seen from behind
    if kind == "solid":
        row = [target, *targets.solid_siblings(rng, target, int(rng.integers(2, 5)))]
    else:
        row = [target, *targets.flat_siblings(rng, scene, target, int(rng.integers(2, 5)))]
    for thing in row:
        scene.items += thing.holder
    target = row.pop(rng.integers(len(row)))  # nothing but what it is made of tells it from its siblings
    surely_filled = kind == "solid" or empty == 0  # then nothing is drawn: groups do not depend on `empty`
    scene.items += [opaque(rng, twin) for twin in row if surely_filled or rng.random() >= empty]
    nearest = sorted(row, key=lambda twin: np.linalg.norm(twin.centre - target.centre))[:2]
    targets.aim(rng, scene, np.mean([target.centre, *(twin.centre for twin in nearest)], axis=0))
    clear = [thing.centre[:2] for thing in (target, *row)]
    if kind != "solid":
        clear += [(flat.centre + sign * flat.u)[:2] for flat in (target, *row) for sign in (-0.8, 0.8)]
    rooms.furnish(rng, scene, keep_clear=[tuple(c) for c in clear])
    return scene, target


def opaque(rng, twin) -> shapes.Item:
    """The surface of an opaque sibling: sprayed, one colour or printed."""
    kind = rng.choice(["treated", "printed", "twin"], p=[0.35, 0.4, 0.25])
    look = {"treated": targets.treated, "printed": printed, "twin": rooms.twin_texture}[kind](rng)
    if isinstance(twin, targets.Flat):
        return twin.panel(look, role="")
    return twin.body(look, float(rng.uniform(0.04, 0.3)) if rng.random() < 0.6 else None, role="")


def decoys(rng, scene, target) -> None:
    """Opaque twins of the targets elsewhere in the room, as real rooms have boards, pictures, bottles and balls.

    Like the siblings they lie outside the mask: without them nothing would keep an adapted model from pushing every
    panel away.
    """
    for kind in rng.permutation(["wall", "standing", "table", "standing", "table"])[: rng.integers(2, 4)]:
        if kind == "table":
            twin = targets.table_object(rng, scene)
            if twin is None or rooms.between(*twin.base[:2], 0.45, *target.centre[:2]):
                continue
            scene.items += [*twin.holder, opaque(rng, twin)]
            continue
        twin = targets.wall_panel(rng, scene) if kind == "wall" else targets.standing_panel(rng, scene, True)
        apart = 0.0 if twin is None else np.linalg.norm(twin.centre - target.centre)
        if apart > 0.9 and not rooms.between(*twin.centre[:2], np.linalg.norm(twin.u), *target.centre[:2]):
            scene.items += [*twin.holder, opaque(rng, twin)]


def observe(rng, kind: str, scene, target, alpha, shown: bool, light, matte):
    """One observation: linear radiance (H, W, 3) and z-depth (H, W) in metres.

    `matte` is `direct` and `albedo` of the scene with the treated target: its dust is lit as its surface is.
    """
    import tracer

    items, (lamp, ambient) = scene.items, light
    left, right, rear, _, _ = scene.room

    def lit(direct, albedo):
        return lamp * direct + ambient * albedo

    if kind == "mirror":
        black = target.panel(np.zeros(3, np.float32))
        moved = clutter(rng, rng.integers(1, 5), (left + 0.4, right - 0.4), (rear + 0.3, -0.1))
        cover, whole = sheet(rng, target, 0.003) if shown else ([], False)
        direct, albedo, _ = tracer.shade(scene, [*items, *cover, black])
        open_part = alpha
        if shown:
            open_part = np.zeros_like(alpha) if whole else tracer.coverage(scene, [*items, *cover, black])
        radiance = lit(direct, albedo)
        if open_part.max() > 0:
            seen = lit(*tracer.reflection(scene, [*items, *moved], target.centre, target.normal))
            opacity, dust = film(rng.uniform(*DUST), smudges(rng, scene, target), lit(*matte))
            tint = rng.uniform(0.76, 0.88) * np.array([0.96, 1.0, 0.99])
            radiance = radiance + open_part[..., None] * ((1 - opacity) * tint * seen + dust)
        return radiance, tracer.z_depth(scene, [*items, black])

    if kind == "pane":
        room_behind = (scene.room[3] - 0.6 - target.centre[1]) / max(-target.normal[1], 0.5)
        x, y = target.centre[:2] - target.normal[:2] * rng.uniform(0.7, max(0.8, min(2.4, room_behind)))
        moved = clutter(rng, rng.integers(1, 3), (x - 0.35, x + 0.35), (y, y + 0.5))
        card = sheet(rng, target, -0.003)[0] if shown else []
        direct, albedo, _ = tracer.shade(scene, [*items, *moved, *card])
        carried = clutter(rng, rng.integers(0, 3), (left + 0.4, right - 0.4), (rear + 0.3, -0.1))
        mirrored = lit(*tracer.reflection(scene, [*items, *carried], target.centre, target.normal))
        share = (alpha * fresnel(scene, target))[..., None]
        tint = 1 - alpha[..., None] * (1 - rng.uniform(0.78, 0.9) * np.array([0.93, 1.0, 0.96]))
        through = lit(direct, albedo)
        opacity, dust = film(rng.uniform(*DUST), smudges(rng, scene, target), lit(*matte))
        radiance = through * tint * (1 - share) + share * mirrored
        radiance = radiance * (1 - alpha[..., None] * opacity) + alpha[..., None] * dust
        return radiance, tracer.z_depth(scene, [*items, *moved, target.panel(textures.paint(rng))])

    x, y, z = target.base
    ahead = np.array([x, y]) / np.hypot(x, y)
    moved = []
    if rng.random() < 0.4:
        aside = np.array([-ahead[1], ahead[0]]) * rng.uniform(-0.3, 0.3)
        spot = np.array([x, y]) + ahead * rng.uniform(0.32, 0.6) + aside
        moved += rooms.small_thing(rng, *spot, z, scale=0.9)
    far = max(0.9, min(2.2, scene.room[3] - 0.6 - y))
    (a, b) = np.array([x, y]) + ahead * rng.uniform(0.8, far)
    moved += clutter(rng, rng.integers(0, 3), (a - 0.5, a + 0.5), (b, b + 0.3))
    if shown:
        look = printed(rng)
        body = target.body(look, float(rng.uniform(0.04, 0.15)))
        direct, albedo, _ = tracer.shade(scene, [*items, *moved, body])
        return lit(direct, albedo), tracer.z_depth(scene, [*items, *moved, body])
    body = target.body(np.zeros(3, np.float32))
    with_shadow, without = tracer.shade(scene, [*items, *moved, body]), tracer.shade(scene, [*items, *moved])
    clear = 1 - alpha[..., None]
    direct, albedo = (0.5 * a + 0.5 * clear * b for a, b in zip(with_shadow[:2], without[:2], strict=True))
    rows, columns = np.nonzero(alpha > 0)
    crop = columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1
    inner = [target.cavity()] if target.hollow else []
    glass = tracer.through_glass(scene, [*items, *moved, body, *inner], crop)
    gain = lamp + ambient * without[1].mean() / max(without[0].mean(), 1e-6)
    radiance = lit(direct, albedo)
    window = (slice(crop[1], crop[1] + crop[3]), slice(crop[0], crop[0] + crop[2]))
    marks = 2 * textures.mottled(rng, np.full(3, 0.5, np.float32), 0.5)[..., 0]
    marks = cv2.resize(marks, (crop[2], crop[3]), interpolation=cv2.INTER_AREA)
    opacity, dust = film(rng.uniform(*DUST), marks, lit(*matte)[window])
    seen = (1 - opacity) * glass * gain * rng.uniform(0.65, 0.85)
    radiance[window] += alpha[window][..., None] * (seen + dust)
    return radiance, tracer.z_depth(scene, [*items, *moved, body])


def smaller(picture: np.ndarray) -> np.ndarray:
    return cv2.resize(picture, KEPT, interpolation=cv2.INTER_AREA)


def make_group(seed: int, kind: str, single: bool = False):
    """Images, mask, depths and reference of one group, or None where the plan turns out badly.

    `single`: one observation, which shows nothing of the surface but its dust.
    """
    import tracer

    rng = np.random.default_rng([20260102, seed])
    planned = plan(rng, kind, OPENINGS)
    if planned is None:
        return None
    scene, target = planned
    decoys(rng, scene, target)
    matte = target.body(targets.treated(rng)) if kind == "solid" else target.panel(targets.treated(rng))
    if kind == "mirror":  # the virtual camera must stay inside the room, or a wall would stand before it
        virtual = tracer.mirrored_camera(scene.camera, target.centre, target.normal).origin
        left, right, _, _, height = scene.room
        if not (left < virtual[0] < right and 0.1 < virtual[2] < height) and abs(target.normal[1]) > 0.5:
            return None
    alpha = tracer.coverage(scene, [*scene.items, matte])
    mask = alpha >= 0.5
    least, most = (0.05, 0.3) if kind == "solid" else (0.08, 0.42)
    unhidden = tracer.coverage(scene, [matte]) >= 0.5
    edge = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()
    if not least < mask.mean() < most or edge > 0.08 or mask.sum() < 0.8 * unhidden.sum():
        return None
    depth = tracer.z_depth(scene, [*scene.items, matte])
    if depth.min() < 0.25 or depth.max() > 30:
        return None
    lamp, ambient = rng.uniform(7, 13), rng.uniform(0.15, 0.4)
    direct, albedo, _ = tracer.shade(scene, [*scene.items, matte])
    reference = lamp * direct + ambient * albedo
    exposure = tracer.auto_exposure(reference)
    count = int(rng.choice([3, 4, 5, 6, 7, 8, 9], p=[0.7, 0.2, 0.06, 0.01, 0.01, 0.01, 0.01]))
    if single:
        count = 1
    hidden = max(1, count // 3)
    shown = rng.permutation([True] * (count - hidden) + [False] * hidden)
    images, depths = [], []
    for surface_seen in shown:
        spread = 0.12 if surface_seen else 0.25  # dim and bright
        light = (lamp * rng.uniform(1 - spread, 1 + spread), ambient * rng.uniform(1 - spread, 1 + spread))
        radiance, depth = observe(rng, kind, scene, target, alpha, bool(surface_seen), light, (direct, albedo))
        if not np.isfinite(radiance).all() or depth.min() < 0.25 or depth.max() > 30:
            return None
        images.append(smaller(tracer.develop(radiance, exposure * rng.uniform(1 - spread, 1 + spread))))
        # nearest, for no blending across edges; exact, or it would lie half a pixel off the picture
        millimetres = np.round(depth * 1000).astype(np.uint16)
        depths.append(cv2.resize(millimetres, KEPT, interpolation=cv2.INTER_NEAREST_EXACT))
    return {
        "images": images,
        "mask": smaller(alpha) >= 0.5,
        "depths": depths,
        "reference": smaller(tracer.develop(reference, exposure)),
        "shown": [bool(s) for s in shown],
    }


def work(task) -> str:
    folder, kind, first_seed, single = task
    group, seed = first_group(lambda seed: make_group(seed, kind, single), first_seed, folder.name)
    temporary = folder.with_name(folder.name + ".part")
    shutil.rmtree(temporary, ignore_errors=True)
    write_group(group, kind, seed, temporary, folder)
    return folder.name


def shipped(out: Path) -> list[tuple]:
    """The tasks of the dataset that the package ships."""
    tasks = []
    for split, kinds in SPLITS.items():
        for number, (kind, count) in enumerate(kinds.items()):
            for index in range(count):
                seed = FIRST_SEED[split] + (number * 1000 + index) * ATTEMPTS
                tasks.append((out / split / f"{kind}_{index:03d}", kind, seed, False))
    return sorted(
        tasks, key=lambda task: (task[0].parent.name, task[0].name.rsplit("_")[1])
    )  # all kinds from the start


def more(out: Path, first_seed: int, count: int, single: bool) -> list[tuple]:
    """The tasks of a set of its own: the kinds in turn, so that any first part of it is balanced."""
    kinds = list(KINDS)
    return [
        (out / f"{kinds[index % 3]}_{index:04d}", kinds[index % 3], first_seed + index * ATTEMPTS, single)
        for index in range(count)
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("renders/groups"))
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--set", help="name of a set of its own below --out")
    parser.add_argument(
        "--first_seed", type=int, help=f"of --set: its scenes take seeds from here on, {ATTEMPTS} a group"
    )
    parser.add_argument("--count", type=int, default=24, help="of --set: groups")
    parser.add_argument("--photos", action="store_true", help="of --set: one see-through or mirroring photo a scene")
    args = parser.parse_args()
    if args.set is None:
        tasks = shipped(args.out)
    elif args.first_seed is None:
        parser.error("--set needs --first_seed, and seeds that no other set has")
    else:
        tasks = more(args.out / args.set, args.first_seed, args.count, args.photos)
    tasks = [task for task in tasks if not task[0].exists()]
    for folder in {task[0].parent for task in tasks}:
        folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(args.processes) as pool:
        list(tqdm(pool.map(work, tasks), total=len(tasks), unit="group"))


if __name__ == "__main__":
    main()
