"""Mitsuba (variant scalar_rgb) behind four calls: shading, coverage, what a mirror sees, what glass shows.

Pictures are sums of noise-free parts in linear radiance: `direct` (one point light, shadows) and `albedo`
(times an ambient term), from four and two samples a pixel. A flat target is composed exactly: its soft coverage comes
from the albedo of a white against a black target, its reflection from a second camera mirrored in its plane. Only
solid glass is path-traced, in a crop around it.
"""

import dataclasses

import cv2
import drjit
import mitsuba as mi
import numpy as np
from rooms import FIELD_OF_VIEW, Camera, Scene
from shapes import Item

mi.set_variant("scalar_rgb")
drjit.set_thread_count(1)  # the scripts run one process a core

WIDTH, HEIGHT = 175, 140
DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}  # a point light is never hit by chance


def _material(item: Item, override) -> dict:
    if override is not None:
        return override
    texture = np.ascontiguousarray(item.texture, dtype=np.float32)
    if texture.ndim == 1:
        reflectance = {"type": "rgb", "value": [float(v) for v in texture]}
    else:
        scale = mi.ScalarTransform4f().scale([item.repeat[0], item.repeat[1], 1])
        reflectance = {"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True, "to_uv": scale}
    if item.gloss is None:
        inner = {"type": "diffuse", "reflectance": reflectance}
    else:
        inner = {"type": "roughplastic", "diffuse_reflectance": reflectance, "alpha": item.gloss}
    return {"type": "twosided", "inner": inner}


def _shape(item: Item, override=None):
    material = _material(item, override)
    if item.shape["type"] != "mesh":
        matrix = mi.ScalarTransform4f(item.shape["to_world"])
        return {"type": item.shape["type"], "to_world": matrix, "bsdf": material}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(material)
    vertices, faces = item.shape["vertices"], item.shape["faces"]
    mesh = mi.Mesh(
        "turned", len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=True, props=properties
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["vertex_normals"] = item.shape["normals"].astype(np.float32).ravel()
    parameters["vertex_texcoords"] = item.shape["uv"].astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def _scene(scene: Scene, items: list[Item], integrator: dict, camera: Camera, samples: int, overrides=None, crop=None):
    overrides = overrides or {}
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    if crop is not None:
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        film |= dict(zip(names, (int(v) for v in crop), strict=True))
    to_world = mi.ScalarTransform4f().look_at(
        origin=list(camera.origin), target=list(camera.origin + camera.forward), up=list(camera.up)
    )
    description = {
        "type": "scene",
        "integrator": integrator,
        "sensor": {
            "type": "perspective",
            "fov": FIELD_OF_VIEW,
            "fov_axis": "x",
            "near_clip": 0.01,
            "to_world": to_world,
            "film": film,
            "sampler": {"type": "independent" if samples == 2 else "stratified", "sample_count": samples},
        },
        "light": {"type": "point", "position": list(scene.light), "intensity": {"type": "rgb", "value": 1.0}},
    }
    for index, item in enumerate(items):
        if item.role != "hollow" or "hollow" in overrides:
            description[f"item{index}"] = _shape(item, overrides.get(item.role))
    return mi.load_dict(description)


def _render(loaded, samples: int, seed: int) -> np.ndarray:
    return np.array(mi.render(loaded, spp=samples, seed=seed), dtype=np.float32)


def shade(scene: Scene, items=None, camera=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`direct` (H, W, 3) for a unit light, `albedo` (H, W, 3) and `position` (H, W, 3) of the first hits."""
    items, camera = scene.items if items is None else items, camera or scene.camera
    direct = _render(_scene(scene, items, DIRECT, camera, 4), 4, 1)
    out = first_hits(scene, items, camera, samples=2)  # several times slower a sample
    return direct[..., :3], out[..., :3], out[..., 3:]


def first_hits(scene: Scene, items: list[Item], camera=None, overrides=None, samples=1) -> np.ndarray:
    """Albedo and position (H, W, 6)."""
    integrator = {"type": "aov", "aovs": "al:albedo,pp:position"}
    loaded = _scene(scene, items, integrator, camera or scene.camera, samples, overrides)
    return _render(loaded, samples, 1)[..., -6:]


def coverage(scene: Scene, items: list[Item], samples=4) -> np.ndarray:
    """(H, W) share of each pixel's samples that hit a target: it alone is white."""
    black, white = ({"type": "diffuse", "reflectance": {"type": "rgb", "value": value}} for value in (0.0, 1.0))
    paints = {"": black, "target": {"type": "twosided", "inner": white}}
    return np.clip(first_hits(scene, items, overrides=paints, samples=samples)[..., 0], 0, 1)


def z_depth(scene: Scene, items: list[Item]) -> np.ndarray:
    """(H, W) metres along the optical axis, of one sample a pixel (no blending across edges)."""
    position = first_hits(scene, items)[..., 3:]
    return (position - scene.camera.origin) @ scene.camera.forward


def rays(camera: Camera) -> np.ndarray:
    """(H, W, 3) unit directions through the pixel centres."""
    focal = WIDTH / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / focal
    y = (HEIGHT / 2 - np.arange(HEIGHT) - 0.5) / focal
    right, up, forward = camera.axes
    direction = x[None, :, None] * right + y[:, None, None] * up + forward
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def mirrored_camera(camera: Camera, point: np.ndarray, normal: np.ndarray) -> Camera:
    reflect = np.eye(3) - 2 * np.outer(normal, normal)
    return Camera(point + reflect @ (camera.origin - point), reflect @ camera.forward, reflect @ camera.up)


def reflection(scene: Scene, items: list[Item], point, normal) -> tuple[np.ndarray, np.ndarray]:
    """`direct` and `albedo` of what the plane through `point` reflects; targets and what is behind it are left out."""
    behind = [np.all((item.points - point) @ normal < 0.03) for item in items]
    front = [item for item, hidden in zip(items, behind, strict=True) if not (hidden or item.role)]
    direct, albedo, _ = shade(scene, front, mirrored_camera(scene.camera, point, normal))
    return direct[:, ::-1], albedo[:, ::-1]


def through_glass(scene: Scene, items: list[Item], crop, samples=256) -> np.ndarray:
    """(h, w, 3) path-traced radiance for a unit light of a crop x, y, w, h, targets made of glass, hollows of air."""
    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    air = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}
    integrator = {"type": "path", "max_depth": 9, "rr_depth": 12}
    # the lamp hangs just below the ceiling; its hot spot there would reach the diffuse bounces as fireflies
    low = dataclasses.replace(scene, light=scene.light - np.array([0, 0, 0.6]))
    loaded = _scene(low, items, integrator, scene.camera, samples, {"target": glass, "hollow": air}, crop)
    out = _render(loaded, samples, 1)
    return np.minimum(out, 1.5 * cv2.medianBlur(out, 3) + 0.02 * out.mean())


def light_up(rng, direct: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Radiance under a random mix of the lamp and the ambient light."""
    lamp, ambient = rng.uniform(6, 16), rng.uniform(0.12, 0.45)
    tint = 1 + rng.uniform(-0.06, 0.06, 3).astype(np.float32)
    return (lamp * direct + ambient * albedo) * tint


def develop(radiance: np.ndarray, exposure: float) -> np.ndarray:
    """Linear radiance to 8-bit sRGB."""
    linear = np.clip(radiance * exposure, 0, 1)
    srgb = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055)
    return (srgb * 255 + 0.5).astype(np.uint8)


def auto_exposure(radiance: np.ndarray, level=0.22) -> float:
    """The factor that brings the mean luminance to `level`, with a gentle shoulder for very bright pictures."""
    return float(level / max(np.minimum(radiance, np.percentile(radiance, 98)).mean(), 1e-4))
