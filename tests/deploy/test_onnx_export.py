"""Exported graphs are right at every size and batch, in both runtimes; the naive route is the counter-example."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from helpers.backbones import tiny_metric3d, tiny_vggt
from helpers.exports import limit, nudged, pixels, relative, write_adapter
from helpers.tiny import tiny_model, tiny_processor
from PIL import Image
from torch import nn

import gift_peft
from gift_peft import DepthModel
from gift_peft.cli import main
from gift_peft.deploy import onnx_export
from gift_peft.deploy.bundle import prepare_bundle
from gift_peft.deploy.onnx_export import deploy_onnx, exported_program, failed_operation, quantize
from gift_peft.deploy.runtime import Predictor
from gift_peft.models.metric3d import Metric3DImageProcessorPil
from gift_peft.models.vggt import VggtImageProcessorPil

pytestmark = pytest.mark.filterwarnings(
    "ignore:.is_gradient_checkpointing. is deprecated:FutureWarning",
    "ignore:the base is the local folder",
    "ignore::DeprecationWarning",
)
SIZES = [(112, 140), (140, 112), (28, 28), (196, 252), (56, 42), (84, 112), (140, 140), (28, 266), (252, 322)]
BATCHES = (1, 2, 3)
DEMO_BASE = Path(gift_peft.__file__).parent / "demo" / "base"
LIMIT = 1e-5
BACKBONES = {
    "depth_anything": (tiny_model, tiny_processor),
    "vggt": (tiny_vggt, VggtImageProcessorPil),
    "metric3d": (tiny_metric3d, Metric3DImageProcessorPil),
}
slow = pytest.mark.slow


@pytest.fixture(
    scope="module", params=["depth_anything", *(pytest.param(name, marks=slow) for name in ("vggt", "metric3d"))]
)
def exported(request, tmp_path_factory):
    """(adapter, exported folder, torch's model)."""
    make, processor = BACKBONES[request.param]
    adapter = write_adapter(tmp_path_factory.mktemp(request.param), make(), processor(), (56, 84))
    out = deploy_onnx(adapter, adapter.parent / "onnx")
    return adapter, out, DepthModel.from_pretrained(adapter.parent / "base", adapter, device="cpu")


@pytest.mark.parametrize("backend", ["onnx", "openvino"])
def test_right_at_every_size_and_batch(exported, backend):
    _, out, model = exported
    predictor = Predictor(out, backend)
    errors = {}
    for index, size in enumerate(SIZES):
        batch = BATCHES[index % 3]
        x = pixels(batch, *size)
        errors[batch, *size] = relative(predictor.predict(x.numpy()), model.predict(x).numpy()) / limit(model, x)
    assert max(errors.values()) <= 1, errors


def test_the_graph_says_what_it_takes(exported):
    _, out, _ = exported
    graph = onnx.load(out / "model.onnx").graph
    (pixel_values,), (depth,) = graph.input, graph.output
    assert pixel_values.name == "pixel_values" and depth.name == "predicted_depth"
    sides = [side.dim_param or side.dim_value for side in pixel_values.type.tensor_type.shape.dim]
    assert sides == ["batch", 3, "height", "width"]
    assert len(depth.type.tensor_type.shape.dim) == 3
    types = {pixel_values.type.tensor_type.elem_type, depth.type.tensor_type.elem_type}
    assert types == {onnx.TensorProto.FLOAT}
    doubles = [weight.name for weight in graph.initializer if weight.data_type == onnx.TensorProto.DOUBLE]
    assert not doubles  # TensorRT has none


def test_eight_bits(exported, tmp_path):
    adapter, out, model = exported
    folder = shutil.copytree(out, tmp_path / "int8")
    bundle = prepare_bundle(adapter, tmp_path / "none", None, "int8")
    quantize(bundle, folder)
    predictor = Predictor(folder)
    # 0.5 % holds on the reference pictures, by which the parts were chosen; random networks lose more elsewhere.
    assert bundle.mean_error(bundle.outputs(folder, "onnx")) <= 0.005
    for size in SIZES[:4]:
        x = pixels(1, *size)
        right = model.predict(x).numpy()
        assert np.abs(predictor.predict(x.numpy()) - right).mean() <= 0.01 * np.abs(right).mean(), size
    assert (folder / "model.onnx").stat().st_size < (out / "model.onnx").stat().st_size


def test_checker_and_predictor_run_beside_the_model(exported, tmp_path):
    _, out, model = exported
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (45, 61, 3), dtype=np.uint8)).save(tmp_path / "a.png")
    done = subprocess.run([sys.executable, out / "check.py"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(": right, largest difference") == 3 and done.stdout.endswith("right\n")
    command = [sys.executable, out / "predictor.py", tmp_path / "a.png", "--out", tmp_path / "depth"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    depth = np.load(tmp_path / "depth" / "a_depth.npy")
    assert depth.dtype == np.float32 and relative(depth, model.depth_at(tmp_path / "a.png")) < 3 * LIMIT
    assert (tmp_path / "depth" / "a_depth.png").is_file()
    shutil.rmtree(out / "__pycache__", ignore_errors=True)


@slow
def test_a_trained_base_is_within_1e_5_everywhere(tmp_path):
    """The networks above are random and multiply rounding; this one is the demo's."""
    base = DepthModel.from_pretrained(DEMO_BASE, device="cpu")
    adapter = write_adapter(tmp_path, base.network, base.processor, (112, 140), move=nudged)
    bundle = prepare_bundle(adapter, tmp_path / "none", None, "int8")
    out = deploy_onnx(adapter, tmp_path / "onnx")
    model = DepthModel.from_pretrained(tmp_path / "base", adapter, device="cpu")
    for backend in ("onnx", "openvino"):
        predictor = Predictor(out, backend)
        for index, size in enumerate(SIZES):
            x = pixels(BATCHES[index % 3], *size)
            assert relative(predictor.predict(x.numpy()), model.predict(x).numpy()) <= LIMIT, (backend, size)
    quantize(bundle, out)
    assert bundle.mean_error(bundle.outputs(out, "onnx")) <= 0.005


# ---- OpenVINO's own format ----


@slow
def test_openvino(tmp_path):
    adapter = write_adapter(tmp_path, tiny_model(), tiny_processor(), (56, 84))
    with pytest.raises(SystemExit) as end:
        main(["deploy", str(adapter), str(tmp_path / "out"), "--to", "openvino"])
    assert end.value.code == 0
    assert {"model.xml", "model.bin"} <= {path.name for path in (tmp_path / "out").iterdir()}
    assert not (tmp_path / "out" / "model.onnx").exists()
    model, predictor = DepthModel.from_pretrained(tmp_path / "base", adapter), Predictor(tmp_path / "out")
    assert predictor.backend == "openvino"
    batches = [pixels(1 + index % 3, *size) for index, size in enumerate(SIZES)]
    side_by_side = predictor.predict_many([batch.numpy() for batch in batches])
    for batch, ours in zip(batches, side_by_side, strict=True):
        assert relative(ours, model.predict(batch).numpy()) <= limit(model, batch)
    with pytest.raises(ValueError, match=r"no model.onnx; take the backend openvino"):
        Predictor(tmp_path / "out", "onnx")


# ---- the dial ----


@slow
@pytest.mark.parametrize("head", ["full", "lora"])
@pytest.mark.parametrize("backbone", BACKBONES)
def test_the_dial_goes_from_base_to_adapter(backbone, head, tmp_path):
    make, processor = BACKBONES[backbone]
    adapter = write_adapter(tmp_path, make(), processor(), (56, 84), head)
    out = deploy_onnx(adapter, tmp_path / "out", dial=True)
    for backend in ("onnx", "openvino"):
        predictor = Predictor(out, backend)
        for scale in (-1.0, 0.0, 0.35, 1.0):
            model = DepthModel.from_pretrained(tmp_path / "base", adapter, scale)
            x = pixels(2, 84, 56)
            error = relative(predictor.predict(x.numpy(), scale), model.predict(x).numpy())
            assert error <= limit(model, x), (backend, scale)
        with pytest.raises(ValueError, match="from 0"):
            predictor.predict(pixels(1, 56, 56).numpy(), 1.5)


# ---- the fault that the route is for ----


@slow
def test_the_naive_route_is_silently_wrong(tmp_path):
    """Should this fail, the ordinary exporter has learned it, and our own way can go."""

    class Plain(nn.Module):
        def __init__(self):
            super().__init__()
            self.model = tiny_model()

        def forward(self, pixel_values):
            return self.model(pixel_values=pixel_values).predicted_depth

    network, traced = Plain().eval(), pixels(2, 112, 140)
    dynamic = {0: torch.export.Dim.DYNAMIC, 2: torch.export.Dim.DYNAMIC, 3: torch.export.Dim.DYNAMIC}
    program = torch.onnx.export(network, (traced,), dynamo=True, dynamic_shapes={"pixel_values": dynamic})
    program.save(tmp_path / "naive.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "naive.onnx")
    name = session.get_inputs()[0].name

    def error(x):
        with torch.no_grad():
            return relative(session.run(None, {name: x.numpy()})[0], network(x).numpy())

    assert error(traced) < 1e-4
    assert error(pixels(1, 140, 112)) > 1e-2
    ours = exported_program(network, 14, False, "tiny").module()
    for size in ((140, 112), (56, 84)):
        x = pixels(2, *size)
        with torch.no_grad():
            assert relative(ours(x).numpy(), network(x).numpy()) < LIMIT


def test_a_graph_that_keeps_a_size_is_not_written(tmp_path, monkeypatch):
    """Whatever an exporter does, the comparison at three sizes stands between it and the folder."""
    adapter = write_adapter(tmp_path, tiny_model(), tiny_processor(), (56, 84))

    def wrong(bundle, path):  # a graph that gives the same map at every size
        fixed = np.ones((1, 56, 84), np.float32)
        shape = onnx.helper.make_tensor_value_info("pixel_values", 1, ["b", 3, "h", "w"])
        depth = onnx.helper.make_tensor_value_info("predicted_depth", 1, ["b", "h", "w"])
        node = onnx.helper.make_node("Identity", ["map"], ["predicted_depth"])
        weights = [onnx.numpy_helper.from_array(fixed, "map")]
        graph = onnx.helper.make_graph([node], "wrong", [shape], [depth], weights)
        onnx.save(onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 20)], ir_version=10), path)

    monkeypatch.setattr(onnx_export, "write_onnx", wrong)
    with pytest.raises(ValueError, match="the exported graph is wrong for an input of"):
        deploy_onnx(adapter, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["adapter", "base"]


def test_an_operation_that_cannot_be_exported_is_named():
    class Sorts(nn.Module):
        def forward(self, pixel_values):
            if pixel_values.sum() > 0:  # a graph has one way
                return pixel_values.mean(1)
            return pixel_values.amax(1)

    with pytest.raises(ValueError, match=r"sorter cannot be exported for every size: .*if pixel_values.sum\(\) > 0"):
        exported_program(Sorts(), 14, False, "sorter")
    error = RuntimeError("No decomposition for aten.frobnicate.default\nmore")
    assert failed_operation(error).startswith("aten.frobnicate")
    try:  # as torch.onnx wraps what it could not translate
        raise RuntimeError("step 3/3. Next steps:\n- implement it\n## Exception summary\n") from KeyError("no round")
    except RuntimeError as wrapped:
        assert "no round" in failed_operation(wrapped) and "Next steps" not in failed_operation(wrapped)
