"""Depth of photos by an exported model, with numpy, Pillow and onnxruntime (or OpenVINO) alone.

    python predictor.py photo.jpg

`gift-peft deploy` copies this file beside the model as `predictor.py`, and `gift-peft predict --deployed` uses it too.
What happens to a picture before and after the network stands in `preprocess.json`, as numbers.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

SETTINGS = "preprocess.json"
MODELS = {"onnx": "model.onnx", "openvino": "model.xml"}
NEEDED = ("model_id", "size", "multiple_of", "dial", "input", "resize", "postprocess", "kind", "unit")
MODEL_ID = "gift_peft_model_id"  # ties model, settings and reference of one export together


class Predictor:
    """An exported folder, ready to predict.

    Args:
        folder: what `gift-peft deploy --to onnx`, `openvino` or `int8` wrote.
        backend (`str`, *optional*): `onnx` (onnxruntime) or `openvino`, which reads both files; default what the
            folder was made for.

    Attributes:
        settings (`dict`): of preprocess.json.
        size (`tuple[int, int]`): (height, width) that pictures are resized to.
        has_dial (`bool`): whether the adapter's scale is an input.

    Raises:
        FileNotFoundError: a file of the folder is missing. ValueError: the backend is not installed, does not read
            the model, or the model is of another export than preprocess.json.
    """

    def __init__(self, folder: str | Path, backend: str | None = None) -> None:
        self.folder = Path(folder)
        self.settings = read_settings(self.folder)
        self.size = self.settings["size"]["height"], self.settings["size"]["width"]
        self.has_dial = self.settings["dial"] is not None
        there = [name for name, file in MODELS.items() if (self.folder / file).is_file()]
        if not there:
            raise FileNotFoundError(f"{self.folder}: neither {' nor '.join(MODELS.values())} is there")
        backend = backend or there[0]
        if backend not in MODELS:
            raise ValueError(f"backend {backend!r}: choose one of {', '.join(MODELS)}")
        if backend == "onnx" and "onnx" not in there:
            raise ValueError(f"{self.folder}: there is no model.onnx; take the backend openvino")
        path = self.folder / MODELS[backend if backend in there else "onnx"]
        self.backend = backend
        self._session = _OnnxRuntime(path) if backend == "onnx" else _OpenVino(path)
        if self._session.model_id not in (None, self.settings["model_id"]):
            raise ValueError(f"{path} is of another export than {SETTINGS} beside it: put the files of one together")

    def prepare(self, image: Image.Image) -> np.ndarray:
        """An upright RGB picture to pixel values (1,3,h,w) float32, to the bit as in training."""
        settings = self.settings
        height, width = self.size
        image = image.resize((width, height), Image.Resampling(settings["resize"]["pillow_filter"]))
        return normalized(np.asarray(image), settings)[None]

    def predict(self, pixel_values: np.ndarray, scale: float | None = None) -> np.ndarray:
        """Pixel values (B,3,h,w) float32 to predictions (B,h,w) float32, in the model's units.

        Any batch, and sides that are multiples of `multiple_of` in preprocess.json. `scale`, where the model has a
        dial: 0 is the base, 1 (default) the adapter, down to -1 it is turned the other way. Raises ValueError.
        """
        return self._session.run(self.inputs(pixel_values, scale))

    def predict_many(self, batches: Sequence[np.ndarray], scale: float | None = None) -> list[np.ndarray]:
        """`predict` of several arrays; with OpenVINO they are computed side by side."""
        return self._session.run_many([self.inputs(batch, scale) for batch in batches])

    def depth_at(
        self, image: str | Path | Image.Image, focal_length: float | None = None, scale: float | None = None
    ) -> np.ndarray:
        """Depth of a picture at its own size, (H,W) float32, in the model's units.

        `focal_length` in pixels of the picture, where the model takes one. Raises FileNotFoundError and ValueError.
        """
        name = str(image) if isinstance(image, (str, Path)) else "the picture"
        picture = read_picture(image, name)
        return self.finish(
            self.predict(self.prepare(picture), scale)[0], (picture.height, picture.width), name, focal_length
        )

    def finish(
        self,
        prediction: np.ndarray,
        size: tuple[int, int],
        name: str = "the picture",
        focal_length: float | None = None,
    ) -> np.ndarray:
        """A prediction (h,w) at the size (height, width) of its picture, in metres of a camera where one is given."""
        if not np.isfinite(prediction).all():
            raise ValueError(f"{name}: the prediction has NaN or infinite values")
        after = self.settings["postprocess"]
        depth = resized(prediction, size, after["resize"])
        if focal_length is None:
            return depth
        canonical = after["canonical_focal_length"]
        if canonical is None:
            raise ValueError("focal_length: this model takes none")
        if not 0 < focal_length < float("inf"):
            raise ValueError(f"focal_length: a positive number of pixels, not {focal_length!r}")
        return (depth * np.float32(focal_length * self.size[1] / size[1] / canonical)).astype(np.float32)

    def inputs(self, pixel_values: np.ndarray, scale: float | None = None) -> dict[str, np.ndarray]:
        """What a runtime is fed, by name."""
        values = np.ascontiguousarray(pixel_values, np.float32)
        multiple = self.settings["multiple_of"]
        if values.ndim != 4 or values.shape[1] != 3 or not values.size:
            raise ValueError(f"pixel values must be (batch, 3, height, width), not {values.shape}")
        if values.shape[2] % multiple or values.shape[3] % multiple:
            raise ValueError(f"size {values.shape[2]}x{values.shape[3]}: both sides must be multiples of {multiple}")
        feeds = {self.settings["input"]["name"]: values}
        if self.has_dial:
            scale = 1.0 if scale is None else scale
            check_scale(scale)
            feeds[self.settings["dial"]["name"]] = np.array([scale], np.float32)
        elif scale is not None:
            raise ValueError("this model was exported without a dial: its adapter scale is fixed")
        return feeds


def check_scale(scale: float) -> None:
    """Raise ValueError for a scale to which no dial goes."""
    if not -1 <= scale <= 1:
        ends = "0 (the base) to 1 (the adapter), or down to -1"
        raise ValueError(f"adapter scale {scale:g}: it goes from {ends}")


def read_settings(folder: Path) -> dict:
    """preprocess.json of a folder; FileNotFoundError or ValueError, in one line."""
    path = folder / SETTINGS
    if not path.is_file():
        raise FileNotFoundError(f"{folder}: no {SETTINGS} there; is it a folder that `gift-peft deploy` wrote?")
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
        missing = [
            key for key in ("model_id", "size", "dial", "input", "postprocess", "resize") if key not in settings
        ]
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: damaged ({error})") from None
    if missing:
        raise ValueError(f"{path}: damaged ({', '.join(missing)} missing)")
    return settings


# ---- runtimes ----


class _OnnxRuntime:
    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise ValueError("onnxruntime is not installed: pip install onnxruntime") from None
        available = onnxruntime.get_available_providers()
        wanted = [name for name in ("CUDAExecutionProvider", "CPUExecutionProvider") if name in available]
        try:
            self.session = onnxruntime.InferenceSession(str(path), providers=wanted)
        except Exception as error:  # its errors have no common class
            raise ValueError(f"{path}: onnxruntime does not read it ({_line(error)})") from None
        self.model_id = self.session.get_modelmeta().custom_metadata_map.get(MODEL_ID)

    def run(self, feeds: dict[str, np.ndarray]) -> np.ndarray:
        return self.session.run(None, feeds)[0]

    def run_many(self, feeds: Sequence[dict[str, np.ndarray]]) -> list[np.ndarray]:
        return [self.run(feed) for feed in feeds]  # one call already uses all cores


class _OpenVino:
    def __init__(self, path: Path) -> None:
        try:
            import openvino
        except ImportError:
            raise ValueError("OpenVINO is not installed: pip install openvino") from None
        self.openvino = openvino
        try:
            model = openvino.Core().read_model(path)
            self.model_id = str(model.get_rt_info(MODEL_ID).value) if model.has_rt_info(MODEL_ID) else None
            # Without the hint a CPU may take bfloat16, half a percent off.
            options = {"INFERENCE_PRECISION_HINT": "f32"}
            self.model = openvino.Core().compile_model(model, "CPU", options)
        except RuntimeError as error:
            raise ValueError(f"{path}: OpenVINO does not read it ({_line(error)})") from None

    def run(self, feeds: dict[str, np.ndarray]) -> np.ndarray:
        return self.model(feeds)[0].copy()

    def run_many(self, feeds: Sequence[dict[str, np.ndarray]]) -> list[np.ndarray]:
        results: list[np.ndarray] = [np.empty(0)] * len(feeds)
        queue = self.openvino.AsyncInferQueue(self.model)

        def keep(request, index: int) -> None:
            results[index] = request.get_output_tensor(0).data.copy()

        queue.set_callback(keep)
        for index, feed in enumerate(feeds):
            queue.start_async(feed, index)
        queue.wait_all()
        return results


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


# ---- pictures ----


def read_picture(source: str | Path | Image.Image, name: str) -> Image.Image:
    """An upright 8-bit RGB picture; ValueError or FileNotFoundError, in one line, for anything else."""
    try:
        image = source if isinstance(source, Image.Image) else Image.open(source)
        image.load()
        image = ImageOps.exif_transpose(image)
    except FileNotFoundError:
        raise FileNotFoundError(f"{name}: no such file") from None
    except Exception as error:  # Pillow's decoders raise what they like
        raise ValueError(f"{name}: not a readable image, or truncated ({_line(error)})") from None
    if image.mode not in ("RGB", "RGBA", "1", "L", "LA", "P"):
        raise ValueError(f"{name}: mode {image.mode}; save it as 8-bit RGB")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        if np.asarray(image.getchannel("A")).min() < 255:
            raise ValueError(f"{name}: the image has transparent pixels; save it as RGB")
    return image.convert("RGB")


def normalized(pixels: np.ndarray, settings: dict) -> np.ndarray:
    """(h,w,3) uint8 to (3,h,w) float32: rescaled in float64, rounded to float32, less the mean, over the deviation."""
    levels = np.arange(256, dtype=np.uint8)
    if settings["rescale_factor"] is not None:
        levels = levels.astype(np.float64) * settings["rescale_factor"]
    table = np.repeat(levels.astype(np.float32)[None], 3, axis=0)
    if settings["image_mean"] is not None:
        mean, std = (np.asarray(settings[key], np.float32)[:, None] for key in ("image_mean", "image_std"))
        table = (table - mean) / std
    return np.stack([table[channel][pixels[..., channel]] for channel in range(3)])


def resized(depth: np.ndarray, size: tuple[int, int], mode: str) -> np.ndarray:
    """(h,w) float32 to (H,W) as torch's `interpolate(align_corners=False)`, without antialiasing.

    `mode` is bilinear or bicubic (coefficient -0.75); pixels beyond the edge repeat it.
    """
    result = depth.astype(np.float32)
    for axis, count in enumerate(size):
        indices, weights = _taps(depth.shape[axis], count, mode)
        shape = (-1, 1) if axis == 0 else (1, -1)
        parts = [result.take(i, axis=axis) * w.reshape(shape) for i, w in zip(indices, weights, strict=True)]
        result = np.sum(parts, axis=0, dtype=np.float32)
    return result


def _taps(length: int, count: int, mode: str) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Per neighbor: its index for each output pixel, and its weight."""
    source = (np.arange(count) + 0.5) * (length / count) - 0.5
    if mode == "bilinear":
        source = np.clip(source, 0, length - 1)
    first = np.floor(source).astype(np.int64)
    x = source - first
    if mode == "bilinear":
        offsets, weights = (0, 1), (1 - x, x)
    else:
        a = -0.75

        def near(t: np.ndarray) -> np.ndarray:
            return ((a + 2) * t - (a + 3)) * t * t + 1

        def far(t: np.ndarray) -> np.ndarray:
            return ((a * t - 5 * a) * t + 8 * a) * t - 4 * a

        offsets, weights = (-1, 0, 1, 2), (far(1 + x), near(x), near(1 - x), far(2 - x))
    return [np.clip(first + o, 0, length - 1) for o in offsets], [w.astype(np.float32) for w in weights]


# ---- the command ----


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Depth of photos by the model beside this file.")
    parser.add_argument("images", nargs="+", metavar="PHOTO")
    parser.add_argument("--out", default=".", metavar="DIR", help="folder for PHOTO_depth.npy and .png")
    parser.add_argument("--backend", choices=[*MODELS], help="default: what the folder was made for")
    parser.add_argument("--adapter-scale", type=float, metavar="S", help="0 is the base, 1 the adapter, with a dial")
    text = "of the camera, in pixels of the photo, where the model takes one"
    parser.add_argument("--focal-length", type=float, metavar="PIXELS", help=text)
    args = parser.parse_args(argv)
    failed = 0
    try:
        predictor = Predictor(Path(__file__).parent, args.backend)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    out = Path(args.out)
    for photo in map(Path, args.images):
        try:
            depth = predictor.depth_at(photo, args.focal_length, args.adapter_scale)
        except (ValueError, OSError) as error:  # the other photos are still wanted
            print(f"error: {error}", file=sys.stderr)
            failed = 1
            continue
        out.mkdir(parents=True, exist_ok=True)
        np.save(out / f"{photo.stem}_depth.npy", depth)
        low, high = float(depth.min()), float(depth.max())
        gray = (depth - low) / max(high - low, 1e-12) * 255
        if predictor.settings["kind"] == "depth":  # near is bright, whatever the numbers are
            gray = 255 - gray
        Image.fromarray(gray.round().astype(np.uint8)).save(out / f"{photo.stem}_depth.png")
        print(
            f"{out / (photo.stem + '_depth.npy')}: {depth.shape[0]}x{depth.shape[1]}, {low:.4g} to {high:.4g}, "
            f"{predictor.settings['unit']}"
        )
    return failed


if __name__ == "__main__":
    sys.exit(main())
