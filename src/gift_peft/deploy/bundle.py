"""What stands beside every exported graph: the preprocessing as numbers, reference pairs, and code without torch.

An exported network is only as good as what is known about its input, so a folder brings all of it, and a checker that
tells on the target machine whether the runtime there computes what torch computed.
"""

import hashlib
import inspect
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from jinja2 import Environment
from PIL import Image
from torch import nn

from gift_peft.adapters.folder import versions
from gift_peft.adapters.scale import set_adapter_scale
from gift_peft.deploy import check, runtime
from gift_peft.deploy.dial import INPUT, DialedNetwork, PlainNetwork
from gift_peft.deploy.merged import (
    TEMPLATES,
    license_of,
    load_for_deployment,
    merged,
    unit_of,
)
from gift_peft.files import check_replaceable, portable_name
from gift_peft.models.adapter_base import find_base
from gift_peft.models.loading import RESIZED_HERE, DepthModel
from gift_peft.models.pixels import pixel_settings, size_multiple

OWN = (
    *("model.onnx", "model.onnx.data", "model.xml", "model.bin"),
    *("preprocess.json", "reference.npz", "predictor.py", "check.py", "README.md", "__pycache__/*"),
)
DIALED_SCALES = (1.0, 0.0, 0.5)  # of the reference pairs
ALARM = 1e-4  # a graph that is farther from torch than rounding could bring it is not written
CANONICAL_FOCAL_LENGTH = 1000.0  # Metric3D's camera, in pixels at the network


@dataclass
class Bundle:
    """An adapter on its way out of torch.

    Args:
        out: the folder to be written.
        form (`str`): onnx, openvino, int8 or space.
        name (`str`): of the base, for messages.
        network: a function of tensors: pixel values, and the scale where there is a dial.
        multiple (`int`): of the input's sides.
        dial (`bool`): whether the scale is an input.
        settings (`dict`): what preprocess.json says.
        reference (`dict`): what reference.npz holds: `input_<n>`, `output_<n>`, `adapter_scale_<n>` with a dial.
        license (`str`): a Hub license id, or `other`.
        base: folder or hub id of the base.
    """

    out: Path
    form: str
    name: str
    network: nn.Module
    multiple: int
    dial: bool
    settings: dict[str, Any]
    reference: dict[str, np.ndarray]
    license: str
    base: str | Path

    def write_settings(self, folder: Path) -> None:
        """preprocess.json, which a `Predictor` reads."""
        text = json.dumps(self.settings, indent=2, allow_nan=False)
        (folder / runtime.SETTINGS).write_text(text + "\n", encoding="utf-8")

    def outputs(self, folder: Path, backend: str) -> list[np.ndarray]:
        """What the model in a folder makes of the reference's inputs."""
        predictor = runtime.Predictor(folder, backend)
        count = sum(name.startswith("output_") for name in self.reference)
        scales = [self.reference.get(f"{INPUT}_{index}") for index in range(count)]
        return [
            predictor.predict(self.reference[f"input_{index}"], None if scale is None else float(scale[0]))
            for index, scale in enumerate(scales)
        ]

    def mean_error(self, outputs: Sequence[np.ndarray]) -> float:
        """The largest mean error of a pair, relative to the mean of its reference."""
        pairs = [(self.reference[f"output_{index}"], output) for index, output in enumerate(outputs)]
        return max(
            float(np.abs(output - right).mean() / np.abs(right).mean()) if output.shape == right.shape else np.inf
            for right, output in pairs
        )


def prepare_bundle(
    adapter: str | Path,
    out: str | Path,
    base: str | Path | None,
    form: str,
    *,
    own: tuple[str, ...] = OWN,
    dial: bool = False,
    adapter_scale: float = 1.0,
    **options: Any,
) -> Bundle:
    """Load, describe and merge (or dial).

    `own` are the files of `out` that may be replaced. Raises as `load_for_deployment` and `merged` do, and ValueError
    where `out` holds other files.
    """
    out = Path(out)
    check_replaceable(out, own)
    base, options["revision"] = find_base(base, adapter, options.get("revision"))
    model = load_for_deployment(adapter, base, adapter_scale, **options)
    settings = _settings(model, dial)
    multiple = settings["multiple_of"]
    reference = _reference(model, multiple, dial)
    network = DialedNetwork(model.network) if dial else PlainNetwork(merged(model).network)
    settings["model_id"] = _digest(network, [form, json.dumps(settings, sort_keys=True)])
    settings["made_from"] = {
        "base": portable_name(base),
        "adapter": portable_name(adapter),
        "adapter_scale": None if dial else adapter_scale,
        "form": form,
        "versions": versions(),
    }
    return Bundle(
        out=out,
        form=form,
        name=portable_name(base),
        network=network.eval(),
        multiple=multiple,
        dial=dial,
        settings=settings,
        reference=reference,
        license=license_of(adapter, base),
        base=base,
    )


def write_bundle(bundle: Bundle, folder: Path, backend: str) -> None:
    """Compare the model in a folder with torch, then write all that belongs beside it.

    Raises ValueError if the model is not right: it does not follow the size, or differs more than rounding explains.
    """
    bundle.write_settings(folder)
    (folder / "predictor.py").write_text(Path(runtime.__file__).read_text(encoding="utf-8"), encoding="utf-8")
    (folder / "check.py").write_text(Path(check.__file__).read_text(encoding="utf-8"), encoding="utf-8")
    outputs = bundle.outputs(folder, backend)
    found = check.differences(bundle.reference, outputs)
    worst = max(value for value, _ in found)
    if bundle.form != "int8":
        for index, (value, text) in enumerate(found):
            if not value <= ALARM:
                shape = "x".join(map(str, bundle.reference[f"input_{index}"].shape))
                raise ValueError(f"{bundle.name}: the exported graph is wrong for an input of {shape}: {text}")
    tolerance = check.TOLERANCE if worst <= check.TOLERANCE else 2 * worst
    facts = {"model_id": np.array(bundle.settings["model_id"]), "tolerance": np.array(tolerance)}
    np.savez_compressed(folder / "reference.npz", **bundle.reference, **facts)
    text = _readme(bundle, backend, worst, bundle.mean_error(outputs))
    (folder / "README.md").write_text(text, encoding="utf-8")


# ---- what stands in the files ----


def _settings(model: DepthModel, dial: bool) -> dict[str, Any]:
    pixels = pixel_settings(model.processor)
    filters = {int(value): value.name.lower() for value in Image.Resampling}
    takes_focal = "focal_lengths" in inspect.signature(model.processor.post_process_depth_estimation).parameters
    kind = model.known_kind()
    return {
        "format": 1,
        "input": {"name": "pixel_values", "dtype": "float32", "shape": "batch, 3 (red, green, blue), height, width"},
        "output": {"name": "predicted_depth", "dtype": "float32", "shape": "batch, height, width"},
        "dial": {"name": INPUT, "dtype": "float32", "shape": "1", "base": 0, "adapter": 1} if dial else None,
        "size": {"height": model.size[0], "width": model.size[1]},
        "multiple_of": size_multiple(model.processor, model.network.config),
        "resize": {"filter": filters[pixels["resample"]], "pillow_filter": pixels["resample"], "on": "8-bit RGB"},
        "rescale_factor": pixels["rescale_factor"],
        "image_mean": pixels["image_mean"],
        "image_std": pixels["image_std"],
        "postprocess": {
            "resize": _resize_after(model),
            "align_corners": False,
            "cubic_coefficient": -0.75,
            "canonical_focal_length": CANONICAL_FOCAL_LENGTH if takes_focal else None,
        },
        "kind": kind,
        "near": "large" if kind == "inverse_depth" else "small",
        "unit": unit_of(model),
        "millimeters_per_unit": model.millimeters_per_unit if model.millimeters_per_unit != 1 else None,
    }


def _resize_after(model: DepthModel) -> str:
    """How a prediction comes to its picture's size; ValueError where that is more than a resize."""
    if getattr(model.network.config, "model_type", None) in RESIZED_HERE:
        return "bicubic"
    depth = torch.rand(1, 28, 42, generator=torch.Generator().manual_seed(0)) + 1
    output, size = SimpleNamespace(predicted_depth=depth), (37, 53)
    result = model.processor.post_process_depth_estimation(output, target_sizes=[size])[0]["predicted_depth"]
    for mode in ("bicubic", "bilinear"):
        ours = runtime.resized(depth[0].numpy(), size, mode)
        if result.shape == ours.shape and np.allclose(result.numpy(), ours, rtol=1e-4, atol=0):
            return mode
    raise ValueError(
        f"{type(model.processor).__name__} does more to a prediction than resizing it: such a model is not exported"
    )


def _reference(model: DepthModel, multiple: int, dial: bool) -> dict[str, np.ndarray]:
    """Three pairs: one picture at the model's size, two at about half of it, one upright at three quarters."""
    height, width = model.size

    def near(side: float) -> int:
        return max(2, round(side / multiple)) * multiple

    sizes = [(1, height, width), (2, near(height / 2), near(width / 2)), (1, near(width * 0.75), near(height * 0.75))]
    pairs: dict[str, np.ndarray] = {}
    for index, (count, *size) in enumerate(sizes):
        at_size = DepthModel(model.network, model.processor, tuple(size), model.kind)
        pixels = at_size.inputs([_picture(10 * index + picture) for picture in range(count)])
        if dial:
            set_adapter_scale(model.network, DIALED_SCALES[index])
            pairs[f"{INPUT}_{index}"] = np.array([DIALED_SCALES[index]], np.float32)
        pairs[f"input_{index}"] = pixels.numpy()
        pairs[f"output_{index}"] = model.predict(pixels).numpy()
    if dial:
        set_adapter_scale(model.network, 1)
    return pairs


def _picture(seed: int) -> Image.Image:
    """Smooth colored shapes with some grain: neither flat nor noise, so that every part of the network has work."""
    rng = np.random.default_rng(seed)
    picture = np.zeros((360, 480, 3))
    for cells, weight in ((3, 0.5), (8, 0.3), (30, 0.2)):
        coarse = Image.fromarray(rng.integers(0, 256, (cells, cells + 1, 3), dtype=np.uint8))
        picture += weight * np.asarray(coarse.resize((480, 360), Image.Resampling.BICUBIC))
    return Image.fromarray(picture.clip(0, 255).astype(np.uint8))


def _digest(network: nn.Module, facts: Sequence[str]) -> str:
    """32 hex digits of all weights and of what else makes an export another one."""
    digest = hashlib.blake2b(digest_size=16)
    for fact in facts:
        digest.update(fact.encode())
    for name, value in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _readme(bundle: Bundle, backend: str, worst: float, mean: float) -> str:
    environment = Environment(keep_trailing_newline=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((TEMPLATES / "export.md").read_text(encoding="utf-8"))
    size, multiple = bundle.settings["size"], bundle.multiple
    return template.render(
        **bundle.settings,
        name=bundle.name,
        license=bundle.license,
        form=bundle.form,
        backend=backend,
        height=size["height"],
        width=size["width"],
        least=2 * multiple,
        dial_name=INPUT,
        has_dial=bundle.dial,
        worst=f"{worst:.1e}",
        mean=f"{100 * mean:.2g} %",
        pairs=[
            {"index": index, "shape": "x".join(map(str, bundle.reference[f"input_{index}"].shape))}
            for index in range(3)
        ],
    )
