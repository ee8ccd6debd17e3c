"""What travels with an export, without torch: preprocessing to the bit, resizing back, words for bad input."""

import json
import os
import shutil
import subprocess
import sys
from importlib.metadata import version
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from helpers.exports import pixels
from helpers.tiny import tiny_processor
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from torch.nn import functional as F
from transformers import DPTImageProcessorPil

from gift_peft import DepthModel
from gift_peft.cli import main
from gift_peft.deploy import runtime
from gift_peft.deploy.bundle import _settings
from gift_peft.deploy.deployed import DeployedModel
from gift_peft.deploy.look_ahead import predict_ahead
from gift_peft.deploy.runtime import Predictor, normalized, read_picture, resized
from gift_peft.images import read_image
from gift_peft.models.metric3d import Metric3DImageProcessorPil
from gift_peft.models.vggt import VggtImageProcessorPil
from gift_peft.predict import predict_images

SIDES = st.integers(1, 60)
PROCESSORS = {
    "depth_anything": tiny_processor,
    "vggt": VggtImageProcessorPil,
    "metric3d": Metric3DImageProcessorPil,
    "lanczos": lambda: DPTImageProcessorPil(size={"height": 56, "width": 70}, resample=1, image_mean=[0.5] * 3),
}


def network(model_type="depth_anything", dial=False, focal=None):
    """Something to describe: its predictions are a mean of the channels."""
    config = SimpleNamespace(model_type=model_type, patch_size=14, depth_estimation_type="relative")
    net = torch.nn.Identity()
    net.config = config
    return net


@pytest.fixture
def folder(tmp_path):
    """A model that an onnx file of three nodes stands for: the mean of the channels, times (1 + scale) with a dial."""

    def make(processor=None, dial=False, name="out", model_id="a" * 32, stated_id="a" * 32):
        import onnx
        from onnx import helper

        model = DepthModel(network(), processor or tiny_processor(), (56, 70), "inverse_depth")
        out = tmp_path / name
        out.mkdir()
        facts = _settings(model, dial) | {"model_id": stated_id}
        (out / "preprocess.json").write_text(json.dumps(facts))
        value = helper.make_tensor_value_info
        inputs = [value("pixel_values", 1, ["b", 3, "h", "w"])]
        mean = helper.make_node("ReduceMean", ["pixel_values", "axes"], ["mean"], keepdims=0)
        nodes = [mean, helper.make_node("Identity", ["mean"], ["predicted_depth"])]
        if dial:
            inputs.append(value("adapter_scale", 1, [1]))
            nodes[1:] = [
                helper.make_node("Mul", ["mean", "adapter_scale"], ["more"]),
                helper.make_node("Add", ["mean", "more"], ["predicted_depth"]),
            ]
        axes = onnx.numpy_helper.from_array(np.array([1]), "axes")
        graph = helper.make_graph(nodes, "mean", inputs, [value("predicted_depth", 1, ["b", "h", "w"])], [axes])
        made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
        helper.set_model_props(made, {runtime.MODEL_ID: model_id})
        onnx.save(made, out / "model.onnx")
        return out

    return make


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.png"
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (45, 61, 3), dtype=np.uint8)).save(path)
    return path


# ---- before and after the network ----


@pytest.mark.parametrize("name", PROCESSORS)
def test_preprocessing_is_bit_equal(name, folder):
    """Through the JSON file: its decimal numbers are the processor's doubles."""
    processor = PROCESSORS[name]()
    model = DepthModel(network(), processor, (56, 70), "inverse_depth")
    predictor = Predictor(folder(processor))
    for seed, size in enumerate([(45, 61), (480, 640), (56, 70), (1, 300)]):
        picture = np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)
        image = Image.fromarray(picture)
        ours = predictor.prepare(image)
        assert ours.dtype == np.float32 and np.array_equal(ours, model.inputs([image]).numpy())


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
@settings(max_examples=60, deadline=None)
@given(size=st.tuples(SIDES, SIDES), to=st.tuples(SIDES, SIDES), seed=st.integers(0, 99))
def test_resizing_back_is_torchs(mode, size, to, seed):
    depth = np.random.default_rng(seed).normal(5, 1, size).astype(np.float32)
    expected = F.interpolate(torch.from_numpy(depth)[None, None], to, mode=mode, align_corners=False)[0, 0].numpy()
    ours = resized(depth, to, mode)
    assert ours.dtype == np.float32 and np.allclose(ours, expected, rtol=2e-5, atol=2e-5)


def test_focal_length_is_the_processors(folder):
    processor = Metric3DImageProcessorPil(size={"height": 56, "width": 70})
    predictor, depth = Predictor(folder(processor)), pixels(1, 56, 70)[:, 0].numpy()
    output = SimpleNamespace(predicted_depth=torch.from_numpy(depth))
    processor.keep_aspect_ratio = False
    right = processor.post_process_depth_estimation(output, target_sizes=[(45, 61)], focal_lengths=[733.0])
    ours = predictor.finish(depth[0], (45, 61), focal_length=733.0)
    assert np.allclose(ours, right[0]["predicted_depth"].numpy(), rtol=2e-5, atol=1e-5)
    with pytest.raises(ValueError, match="takes none"):
        Predictor(folder(name="other")).finish(depth[0], (45, 61), focal_length=733.0)


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "RGBA", "LA", "1"])
def test_pictures_are_read_as_in_training(mode, tmp_path):
    pixels_ = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    Image.fromarray(pixels_).convert(mode).save(tmp_path / "a.png", exif=_turned())
    assert np.array_equal(read_picture(tmp_path / "a.png", "a"), read_image(tmp_path / "a.png"))


def _turned() -> Image.Exif:
    exif = Image.Exif()
    exif[Image.ExifTags.Base.Orientation] = 6
    return exif


def test_values_are_looked_up_for_each_channel():
    levels = np.stack([np.arange(256, dtype=np.uint8).reshape(16, 16)] * 3, axis=-1)
    plain = {"rescale_factor": None, "image_mean": None, "image_std": None}
    assert np.array_equal(normalized(levels, plain)[2].ravel(), np.arange(256))
    ends = normalized(levels, plain | {"rescale_factor": 1 / 255, "image_mean": [0, 0.5, 1], "image_std": [1, 0.5, 2]})
    assert ends[:, -1, -1].tolist() == [1, 1, 0] and ends[:, 0, 0].tolist() == [0, -1, -0.5]


# ---- a deployed folder in `gift-peft predict` ----


@pytest.mark.parametrize("backend", ["onnx", "openvino"])
def test_predict_takes_a_deployed_folder(backend, folder, photo, tmp_path):
    out = folder()
    (path,) = predict_images([photo], deployed=out, backend=backend, out=tmp_path / "depth")
    image = DepthModel(network(), tiny_processor(), (56, 70), "inverse_depth").inputs([read_image(photo)])
    right = F.interpolate(image.mean(1)[None], (45, 61), mode="bicubic", align_corners=False)[0, 0]
    assert np.allclose(np.load(path), right.numpy(), atol=1e-5)
    assert sorted(file.name for file in (tmp_path / "depth").iterdir()) == ["photo.npy", "photo.png"]


def test_a_dial_brings_the_base_along(folder, photo, tmp_path):
    out = folder(dial=True)
    predict_images([photo], deployed=out, adapter_scale=0.5, out=tmp_path / "depth")
    base, half = (np.load(tmp_path / "depth" / f"photo{end}.npy") for end in ("_base", ""))
    assert np.allclose(half, 1.5 * base, atol=1e-5) and np.abs(base).max() > 0.1
    full = DeployedModel(out).depth_at(photo)
    assert np.allclose(full, 2 * base, atol=1e-5)
    behind = DeployedModel(out, adapter_scale=-0.75).depth_at(photo)  # the layer dial goes on below the base
    assert np.allclose(behind, 0.25 * base, atol=1e-5)


@pytest.mark.parametrize("dial", [True, False])
def test_a_clip_through_a_deployed_folder(dial, folder, tmp_path, capsys):
    frames = [np.full((64, 96, 3), shade, np.uint8) for shade in (60, 120, 200)]
    writer = cv2.VideoWriter(str(tmp_path / "in.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 12.0, (96, 64))
    for frame in frames:
        writer.write(frame)
    writer.release()
    argv = ["predict", f"--video={tmp_path / 'in.mp4'}", f"--deployed={folder(dial=dial)}", "--batch-size=2"]
    with pytest.raises(SystemExit) as end:
        main([*argv, f"--out={tmp_path / 'out'}", *(["--adapter-scale=0.5"] if dial else [])])
    assert not end.value.code, capsys.readouterr().err
    capture = cv2.VideoCapture(str(tmp_path / "out" / "in_depth.mp4"))
    there, frame = capture.read()
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert there and frame.shape == (64, (3 if dial else 2) * 96, 3)


def test_several_pictures_of_a_deployed_model_go_through_it_at_once(folder, tmp_path):
    files = [tmp_path / f"{index}.png" for index in range(3)]
    for index, file in enumerate(files):
        size = (45 + index, 61, 3)
        Image.fromarray(np.random.default_rng(index).integers(0, 256, size, dtype=np.uint8)).save(file)
    model = DeployedModel(folder(dial=True))
    batches, run = [], model.predictor.predict
    model.predictor.predict = lambda pixels, scale: batches.append((len(pixels), scale)) or run(pixels, scale)
    results = list(predict_ahead(model, files, base_too=True, batch_size=2))
    assert batches == [(2, None), (2, 0.0), (1, None), (1, 0.0)]
    for file, result in zip(files, results, strict=True):
        assert np.array_equal(result["own"], model.depth_at(file))
        assert np.array_equal(result["base"], model.depth_at(file, base=True))


def test_no_torch_is_imported(folder, photo, tmp_path):
    lines = (
        "import sys; from gift_peft.deploy.deployed import DeployedModel; "
        f"DeployedModel({str(folder())!r}).depth_at({str(photo)!r}); print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


@pytest.mark.slow
def test_a_small_environment_is_enough(folder, photo, tmp_path):
    """Without torch, under 250 MB, from the registry; its preprocessing has the same bits."""
    out = folder()
    shutil.copy(runtime.__file__, out / "predictor.py")
    venv = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", venv], check=True)
    packages = [f"{name}=={version(name)}" for name in ("numpy", "pillow", "onnxruntime")]
    subprocess.run([venv / "bin" / "pip", "install", "-q", *packages], check=True)
    (site,) = venv.glob("lib/python*/site-packages")
    tools = {path for name in ("pip", "setuptools") for path in site.glob(f"{name}*")}
    files = [path for path in site.rglob("*") if path.is_file() and not tools & set(path.parents)]
    assert sum(path.stat().st_size for path in files) < 250e6
    lines = (
        "import sys, numpy; from predictor import Predictor, read_picture; p = Predictor('.'); "
        f"numpy.save('x.npy', p.prepare(read_picture({str(photo)!r}, 'photo'))); assert 'torch' not in sys.modules"
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    python = venv / "bin" / "python"
    subprocess.run([python, "-c", lines], cwd=out, check=True, env=environment)
    right = DepthModel(network(), tiny_processor(), (56, 70), "inverse_depth").inputs([read_image(photo)])
    assert np.array_equal(np.load(out / "x.npy"), right.numpy())
    done = subprocess.run([python, out / "predictor.py", photo, "--out", tmp_path / "depth"], env=environment)
    assert done.returncode == 0 and (tmp_path / "depth" / "photo_depth.npy").is_file()


# ---- bad input ----


def test_bad_folders(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such folder"):
        DeployedModel(tmp_path / "none")
    with pytest.raises(FileNotFoundError, match=r"preprocess.json there; is it a folder that"):
        Predictor(tmp_path)
    with pytest.raises(ValueError, match=r"another export than preprocess.json"):
        Predictor(folder(name="mixed", model_id="b" * 32))
    out = folder()
    (out / "model.onnx").write_bytes(b"no graph")
    for backend in ("onnx", "openvino"):
        with pytest.raises(ValueError, match=r"model.onnx: .* does not read it"):
            Predictor(out, backend)
    (out / "model.onnx").unlink()
    with pytest.raises(FileNotFoundError, match=r"neither model.onnx nor model.xml"):
        Predictor(out)
    (out / "preprocess.json").write_text("{}")
    with pytest.raises(ValueError, match=r"damaged \(model_id"):
        Predictor(out)
    (out / "preprocess.json").write_text("{")
    with pytest.raises(ValueError, match="damaged"):
        Predictor(out)


@pytest.mark.parametrize(("backend", "package"), [("onnx", "onnxruntime"), ("openvino", "openvino")])
def test_a_runtime_that_is_not_installed(backend, package, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ValueError, match=f"not installed: pip install {package}"):
        Predictor(folder(), backend)


def test_bad_scales_and_sizes(folder, photo):
    plain, dialed = folder(name="plain"), folder(name="dialed", dial=True)
    with pytest.raises(ValueError, match="its adapter scale is fixed"):
        DeployedModel(plain, adapter_scale=0.5)
    for scale in (-1.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match="from 0"):
            DeployedModel(dialed, adapter_scale=scale)
    with pytest.raises(ValueError, match="multiples of 14"):
        Predictor(plain).predict(np.zeros((1, 3, 56, 71), np.float32))
    with pytest.raises(ValueError, match=r"\(batch, 3, height, width\)"):
        Predictor(plain).predict(np.zeros((3, 56, 70), np.float32))
    with pytest.raises(ValueError, match="NaN or infinite"):
        Predictor(plain).finish(np.full((4, 4), np.nan, np.float32), (8, 8), "a.jpg")


def test_the_command_goes_on_after_a_bad_photo(folder, photo, tmp_path, capsys, monkeypatch):
    out = folder()
    monkeypatch.setattr(runtime, "__file__", str(out / "predictor.py"))
    (tmp_path / "bad.jpg").write_bytes(b"\xff\xd8 cut")
    code = runtime.main([str(tmp_path / "bad.jpg"), str(photo), "--out", str(tmp_path / "depth")])
    said = capsys.readouterr()
    assert code == 1 and said.err.count("\n") == 1 and "bad.jpg" in said.err
    assert sorted(path.name for path in (tmp_path / "depth").iterdir()) == ["photo_depth.npy", "photo_depth.png"]
