"""The page of a model with a dial: a photo's depth by the base beside the adapter's, at any scale of the adapter.

    pip install -r requirements.txt
    python app.py

`gift-peft deploy --to space` copies this file beside the model as `app.py`. It needs gradio, numpy, Pillow and
onnxruntime; nothing is loaded from elsewhere.
"""

import json
import struct
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

HERE = Path(__file__).parent
# Viridis at 17 places: uniform to the eye, readable by color-blind people.
VIRIDIS = (
    *("440154", "48186a", "472d7b", "424086", "3b528b", "33638d", "2c728e", "26828e", "21918c"),
    *("1f9f88", "27ad81", "3dbc74", "5cc863", "81d34d", "aadc32", "d5e21a", "fde725"),
)
MESH_SIDE = 320  # points along the longer side of the scene
MAX_SIDE = 1280  # of a photo: larger ones are made smaller, a page needs no more
EDGE = 0.06  # neighbors whose distances differ by more than this share are not connected
NEAREST = 0.25  # of a model without a unit, where the farthest point is at 1


def colorize(depth: np.ndarray, low: float, high: float, near_is_large: bool) -> Image.Image:
    """(H,W) to a picture; near is bright, `low`..`high` spans the colors."""
    share = np.clip((depth - low) / max(high - low, 1e-12), 0, 1)
    table = np.array([[int(color[i : i + 2], 16) for i in (0, 2, 4)] for color in VIRIDIS], float)
    share = (share if near_is_large else 1 - share) * (len(table) - 1)
    below = np.minimum(share.astype(int), len(table) - 2)
    mixed = table[below] + (share - below)[..., None] * (table[below + 1] - table[below])
    return Image.fromarray(mixed.round().astype(np.uint8))


def distances(depth: np.ndarray, near_is_large: bool) -> np.ndarray:
    """(H,W) distances along the camera's axis. Inverse depth has no scale or shift: it is set from NEAREST to 1."""
    if not near_is_large:
        return depth
    low, high = np.percentile(depth, [0.5, 99.5])
    share = np.clip((depth - low) / max(high - low, 1e-12), 0, 1)
    return 1 / (1 + share * (1 / NEAREST - 1))


def write_scene(path: Path, picture: Image.Image, z: np.ndarray, field_of_view: float) -> None:
    """A colored surface (.glb) of distances (H,W), seen through a horizontal field of view in degrees.

    Where neighbors are far apart in depth there is a hole, not a wall.
    """
    step = max(1, -(-max(z.shape) // MESH_SIDE))
    z, shown = z[::step, ::step].astype(np.float32), np.asarray(picture)[::step, ::step] / 255
    light = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)  # glTF wants linear RGB
    height, width = z.shape
    focal = width / 2 / np.tan(np.radians(field_of_view) / 2)
    rows, columns = np.mgrid[:height, :width]
    x, y = (columns - (width - 1) / 2) / focal * z, (rows - (height - 1) / 2) / focal * z
    scale = 1 / max(float(np.median(z)), 1e-12)
    points = (np.stack([x, -y, -z], axis=-1) * scale + [0, 0, 1]).reshape(-1, 3).astype("<f4")
    index = np.arange(height * width).reshape(height, width)
    corners = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1)
    depths = z.reshape(-1)[corners]
    whole = (depths.max(-1) - depths.min(-1)) < EDGE * depths.min(-1)
    quads = corners[whole]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype("<u4")
    paint = np.round(255 * np.c_[light.reshape(-1, 3), np.ones(height * width)]).astype(np.uint8)
    path.write_bytes(_glb(points, paint, triangles))


def _glb(points: np.ndarray, colors: np.ndarray, triangles: np.ndarray) -> bytes:
    """Binary glTF 2.0: positions (N,3) float32, colors (N,4) uint8, triangles (T,3) uint32."""
    blocks = [points.tobytes(), colors.tobytes(), triangles.tobytes()]  # each a multiple of four bytes
    offsets = [0, len(blocks[0]), len(blocks[0]) + len(blocks[1])]
    views = [{"buffer": 0, "byteOffset": o, "byteLength": len(b)} for o, b in zip(offsets, blocks, strict=True)]
    low, high = points.min(0).tolist(), points.max(0).tolist()
    accessors: list[dict[str, Any]] = [
        {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3", "min": low, "max": high},
        {"bufferView": 1, "componentType": 5121, "count": len(colors), "type": "VEC4", "normalized": True},
        {"bufferView": 2, "componentType": 5125, "count": triangles.size, "type": "SCALAR"},
    ]
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    scene = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}],
        "extensionsUsed": ["KHR_materials_unlit"],
        "buffers": [{"byteLength": sum(map(len, blocks))}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(blocks)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


class Page:
    """What the page's buttons call; one model for all visitors."""

    def __init__(self, folder: Path = HERE) -> None:
        from predictor import Predictor, read_picture  # beside this file

        self.predictor, self.read = Predictor(folder), read_picture
        self.near_is_large = self.predictor.settings["kind"] == "inverse_depth"

    def compare(self, photo: str | None, scale: float, field_of_view: float) -> tuple[Any, Any, Any, str]:
        """(base and adapted picture, scene, array to download, a line of text) of an uploaded file."""
        if photo is None:
            return None, None, None, "Upload a photo, or take one of the examples."
        try:
            picture = self.read(photo, Path(photo).name)
        except (ValueError, OSError) as error:
            return None, None, None, f"**{error}**"
        if max(picture.size) > MAX_SIDE:
            picture.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.LANCZOS)
        base, adapted = (self.predictor.depth_at(picture, scale=value) for value in (0.0, float(scale)))
        low, high = np.percentile(np.concatenate([base.ravel(), adapted.ravel()]), [1, 99])
        pictures = tuple(colorize(depth, low, high, self.near_is_large) for depth in (base, adapted))
        folder = Path(tempfile.mkdtemp())
        write_scene(folder / "scene.glb", picture, distances(adapted, self.near_is_large), field_of_view)
        np.save(folder / "depth.npy", adapted)
        change = np.abs(adapted - base).mean() / max(float(np.abs(base).mean()), 1e-12)
        text = (
            f"{picture.width}x{picture.height}, adapter at {scale:.2f}: on average {100 * change:.1f} % from the base"
        )
        return pictures, str(folder / "scene.glb"), str(folder / "depth.npy"), text


def build(folder: Path = HERE) -> Any:
    """The gradio page of a folder."""
    import gradio as gr

    page = Page(folder)
    about = json.loads((folder / "about.json").read_text(encoding="utf-8"))
    examples = sorted(str(path) for path in (folder / "examples").glob("*") if not path.name.startswith("."))
    with gr.Blocks(title=about["title"], analytics_enabled=False) as blocks:
        gr.Markdown(f"# {about['title']}\n\n{about['text']}")
        with gr.Row():
            with gr.Column():
                photo = gr.Image(type="filepath", label="Photo", elem_id="photo", height=360)
                scale = gr.Slider(0, 1, 1, step=0.05, label="Adapter scale: 0 is the base", elem_id="scale")
                view = gr.Slider(30, 110, 60, step=1, label="Field of view of the camera, degrees (for the scene)")
                if examples:
                    gr.Examples([[path] for path in examples], inputs=[photo], elem_id="examples")
            with gr.Column():
                slider = gr.ImageSlider(label="Base (left), adapted (right): near is bright", elem_id="depths")
                said = gr.Markdown("Upload a photo, or take one of the examples.", elem_id="said")
                scene = gr.Model3D(label="Scene, from the adapted depth", elem_id="scene", height=360)
                array = gr.File(label=f"Depth (float32 .npy): {about['unit']}", elem_id="array")
        for change in (photo.change, scale.release, view.release):
            change(page.compare, [photo, scale, view], [slider, scene, array, said], concurrency_limit=1)
    return blocks


if __name__ == "__main__":
    import gradio

    fonts = {"font": ["system-ui", "sans-serif"], "font_mono": ["monospace"]}  # those of the computer: no network
    build().launch(theme=gradio.themes.Default(**fonts))
