"""Bases of other packages: through stand-ins of their interfaces, and through the packages where installed."""

import pickle
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.booster_tree import write_root
from helpers.environments import environment_beside_us, install
from PIL import Image
from torch import nn
from transformers import DPTConfig, DPTForDepthEstimation, DPTImageProcessorPil

from gift_peft import evaluate_booster
from gift_peft.evaluation.verb import run_evaluation
from gift_peft.models.external import INSTALL_DA3
from gift_peft.models.loading import DepthModel
from gift_peft.predict import predict_images
from gift_peft.reports.report import run_report
from gift_peft.rules import UNKNOWN

RAMP = torch.linspace(1, 2, 98)


class StandInNet(nn.Module):
    """DepthAnything3Net's interface: (B,N,3,H,W) views of B scenes to {"depth": (B,N,H,W)}."""

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(2.0))

    def forward(self, x):
        assert x.ndim == 5 and x.shape[1] == 1 and x.dtype == torch.float32  # one view a scene, no half precision
        assert not torch.is_autocast_enabled("cpu")
        return {"depth": self.gain * x.mean(2) + RAMP}


class StandInMoGe(nn.Module):
    """MoGeModel's interface; `metric` has the second version's scale head."""

    def __init__(self, metric: bool):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(3.0))
        if metric:
            self.scale_head = nn.Identity()

    def infer(self, image, apply_mask=True, use_fp16=True):
        assert not use_fp16
        depth = self.gain * image.mean(1) + RAMP
        return {"depth": torch.where(depth < 2, torch.inf, depth) if apply_mask else depth, "mask": depth > 2}


@pytest.fixture
def packages(monkeypatch):
    """`depth_anything_3` and `moge` as far as they are used; the weights are called known, old and known-nested."""

    def module(name, **members):
        made = ModuleType(name)
        vars(made).update(members)
        monkeypatch.setitem(sys.modules, name, made)
        return made

    def da3(name):
        if name == "nowhere":
            raise OSError(f"no such repository: {name}\nand more lines")
        return SimpleNamespace(model=StandInNet(), model_name=name)

    def moge2(name):
        if name == "old":
            raise TypeError("__init__() missing 1 required positional argument: 'neck'")
        if name == "broken":
            raise KeyError("model_config")
        if name == "text":
            raise pickle.UnpicklingError("Weights only load failed.\nmore lines")
        if name == "letter":
            raise KeyError(101)
        return StandInMoGe(metric=True)

    def model_class(load):
        return type("Model", (), {"from_pretrained": staticmethod(load)})

    module("depth_anything_3")
    module("depth_anything_3.api", DepthAnything3=model_class(da3))
    versions = {
        "v1": module("moge.model.v1", MoGeModel=model_class(lambda name: StandInMoGe(metric=False))),
        "v2": module("moge.model.v2", MoGeModel=model_class(moge2)),
    }
    module("moge")
    module("moge.model", **versions)


def test_da3_is_called_view_by_view_in_float32(packages):
    loaded = DepthModel.from_pretrained("da3:known", size="70x98")
    assert (loaded.size, loaded.kind, loaded.millimeters_per_unit) == ((70, 98), "depth", 1)
    pixels = torch.rand(3, 3, 70, 98)
    depth = loaded.predict(pixels)
    torch.testing.assert_close(depth, 2 * pixels.mean(1) + RAMP)
    assert DepthModel.from_pretrained("da3:known-nested", size="70x98").millimeters_per_unit == 1000
    assert DepthModel.from_pretrained("da3:known").size == (476, 644)
    picture = Image.new("RGB", (50, 40), (124, 116, 104))  # ImageNet's mean colour
    assert loaded.inputs([picture]).abs().max() < 0.02


@pytest.mark.parametrize(("name", "unit"), [("known", 1000), ("old", 1)])
def test_moge_is_asked_without_its_mask(packages, name, unit):
    loaded = DepthModel.from_pretrained(f"moge:{name}", size="70x98")
    assert loaded.kind == "depth" and loaded.millimeters_per_unit == unit
    pixels = torch.rand(3, 3, 70, 98)
    torch.testing.assert_close(loaded.predict(pixels), 3 * pixels.mean(1) + RAMP)
    depth = 3 * pixels.mean(1) + RAMP  # against proxies, what its own mask leaves out does not count
    torch.testing.assert_close(loaded.predict_proxies(pixels), depth.masked_fill(depth <= 2, UNKNOWN))
    white = loaded.inputs([Image.new("RGB", (50, 40), "white")])
    assert (white == 1).all()  # colours from 0 to 1: it normalises them itself


def test_they_stand_in_the_table_and_predict(packages, tmp_path, capsys):
    write_root(tmp_path)
    options = {"size": "70x98", "progress": False}
    report = run_evaluation("moge:known", booster=tmp_path, out=tmp_path / "out", **options)
    assert report.about["base"] == "moge:known" and not report.adapted and "Booster" in capsys.readouterr().out
    loaded = DepthModel.from_pretrained("moge:known", size="70x98")
    options = {"processor": loaded.processor, "size": loaded.size, "progress": False}

    def plain(pixels):
        return 3 * pixels.mean(1) + RAMP

    expected = evaluate_booster(tmp_path, plain, kind="depth", **options)
    assert report.summary["tom"] == pytest.approx(expected.summary["tom"], rel=1e-6)
    # The kind comes with the model, and what is metric is in metres.
    metric = evaluate_booster(tmp_path, loaded, protocol="metric", progress=False)
    expected = evaluate_booster(tmp_path, plain, kind="depth", protocol="metric", prediction_scale=1000, **options)
    assert metric.summary["all"] == pytest.approx(expected.summary["all"], rel=1e-6)
    assert 0 < metric.summary["all"]["mae"] < 4000
    picture = tmp_path / "train/balanced/Scene0/camera_00/im0.png"
    predict_images([picture], "da3:known", out=tmp_path / "predicted", size="70x98", progress=False)
    assert np.load(tmp_path / "predicted" / "im0.npy").shape == (60, 84)


def test_they_are_evaluated_on_gift_i(packages, raw_tree, tmp_path, capsys):
    report = run_evaluation("da3:known", raw_tree, out=tmp_path / "out", size="70x98", progress=False)
    assert report.counts["scored"] == 2 and report.base == report.summary and report.gce["adapted"] is None
    assert report.gce["base"] > 0 and report.about["base"] == "da3:known"
    assert "GIFT-I validation" in capsys.readouterr().out


def test_the_papers_unadapted_rows_stand_in_one_table(packages, tmp_path, capsys):
    write_root(tmp_path / "booster")
    options = {"booster": tmp_path / "booster", "size": "70x98", "progress": False}
    folders = [tmp_path / name for name in ("da3", "moge")]
    reports = [run_evaluation(f"{folder.name}:known", out=folder, **options) for folder in folders]
    run_report(folders, tmp_path / "report", panels=0)
    table = (tmp_path / "report" / "tables" / "booster.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in table[1:]] == ["da3:known", "moge:known"]
    for line, report in zip(table[1:], reports, strict=True):
        assert float(line.split(",")[3]) == pytest.approx(report.summary["tom"]["rmse"], rel=1e-9)


def test_what_is_missing_or_wrong_is_one_line(packages, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"^base da3:nowhere: no such repository: nowhere$"):
        DepthModel.from_pretrained("da3:nowhere")
    with pytest.raises(ValueError, match=r"^base moge:broken: 'model_config'$"):
        DepthModel.from_pretrained("moge:broken")
    with pytest.raises(ValueError, match=r"^base moge:text: Weights only load failed\.$"):
        DepthModel.from_pretrained("moge:text")
    with pytest.raises(ValueError, match=r"^base moge:letter: not a file of weights \(101\)$"):
        DepthModel.from_pretrained("moge:letter")
    with pytest.raises(ValueError, match="base moge:known: an adapter needs a model of transformers"):
        DepthModel.from_pretrained("moge:known", adapter="somewhere")
    with pytest.raises(ValueError, match=r"size 71x98: both sides must be positive multiples of the patch size 14"):
        DepthModel.from_pretrained("moge:known", size="71x98")
    for package, name in (("depth_anything_3.api", "da3"), ("moge.model", "moge")):
        monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
        with pytest.raises(ValueError, match=rf"^base {name}:known: .*pip install"):
            DepthModel.from_pretrained(f"{name}:known")


def test_the_docs_say_how_to_install_depth_anything_3():
    text = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text()
    assert all(f"  {line}\n" in text for line in INSTALL_DA3)


# ---- architectures of transformers without a recipe ----


def write_dpt(base):
    """A tiny random DPT as a transformers folder."""
    config = DPTConfig(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, intermediate_size=32, image_size=64, patch_size=16,
        backbone_out_indices=[0, 1, 2, 3], neck_hidden_sizes=[8, 8, 8, 8], fusion_hidden_size=8, is_hybrid=False,
    )  # fmt: skip
    torch.manual_seed(0)
    DPTForDepthEstimation(config).save_pretrained(base)
    DPTImageProcessorPil(size={"height": 64, "width": 96}).save_pretrained(base)


def test_any_depth_model_of_transformers_is_a_base(tmp_path):
    base = tmp_path / "dpt"
    write_dpt(base)
    write_root(tmp_path)
    options = {"out": tmp_path / "out", "progress": False, "size": "64x64"}
    with pytest.raises(ValueError, match='no recipe says what dpt predicts: kind="depth"'):
        run_evaluation(base, booster=tmp_path, **options)
    report = run_evaluation(base, booster=tmp_path, kind="inverse_depth", **options)
    assert report.counts["scored"] == 4 and report.about["kind"] == "inverse_depth"


@pytest.mark.parametrize("size", ["64x96", "96x64", "112x80"])
def test_sides_that_an_architecture_does_not_take_are_one_line(tmp_path, size):
    """DPT's own encoder takes squares only, whatever its patch size divides."""
    base = tmp_path / "dpt"
    write_dpt(base)
    Image.new("RGB", (40, 30)).save(tmp_path / "photo.png")
    model = DepthModel.from_pretrained(base, kind="inverse_depth", size=size)
    with pytest.raises(ValueError, match=rf"does not take images of {size} \(height x width\).*--size 64x64") as told:
        model.depth_at(tmp_path / "photo.png")
    assert "\n" not in str(told.value)
    assert DepthModel.from_pretrained(base, size="64x64").depth_at(tmp_path / "photo.png").shape == (30, 40)


# ---- the packages themselves ----


def test_the_real_moge(tmp_path):
    v2 = pytest.importorskip("moge.model.v2", reason="MoGe (dlr-moge) is not installed")
    blocks = {"dim_res_blocks": [8] * 5, "resamplers": ["bilinear"] * 4, "res_block_hidden_norm": "layer_norm"}
    config = {
        "encoder": {"backbone": "dinov2_vits14", "intermediate_layers": 2, "dim_out": 16},
        "neck": {"dim_in": [18, 2, 2, 2, 2], "dim_out": [8] * 5, **blocks},
        "points_head": {"dim_in": [8] * 5, "dim_out": [None] * 4 + [3], **blocks},
        "mask_head": {"dim_in": [8] * 5, "dim_out": [None] * 4 + [1], **blocks},
        "scale_head": {"dims": [384, 8, 1]},
        "remap_output": "exp",
        "num_tokens_range": [16, 32],
    }
    torch.manual_seed(0)
    network = v2.MoGeModel(**config).eval()
    torch.save({"model_config": config, "model": network.state_dict()}, tmp_path / "tiny.pt")
    loaded = DepthModel.from_pretrained(f"moge:{tmp_path / 'tiny.pt'}", size="70x98")
    pixels = torch.rand(2, 3, 70, 98)
    expected = network.infer(pixels, apply_mask=False, use_fp16=False)["depth"]
    torch.testing.assert_close(loaded.predict(pixels), expected)
    assert loaded.millimeters_per_unit == 1000


def test_the_real_depth_anything_3(tmp_path):
    api = pytest.importorskip("depth_anything_3.api", reason="depth-anything-3 is not installed")
    torch.manual_seed(0)
    network = api.DepthAnything3(model_name="da3-small").eval()
    network.save_pretrained(tmp_path)
    loaded = DepthModel.from_pretrained(f"da3:{tmp_path}", size="70x98")
    pixels = torch.rand(2, 3, 70, 98)
    with torch.no_grad():
        expected = torch.stack([network.model(image[None, None])["depth"][0, 0] for image in pixels])
    torch.testing.assert_close(loaded.predict(pixels), expected)


DA3_BESIDE_US = """
import sys, types, importlib.machinery
import numpy, torch
from transformers import DPTImageProcessorPil
from gift_peft.models.loading import DepthModel
import gift_peft.adapters.folder
try:
    import torchvision.transforms
except (ImportError, RuntimeError):  # its wheel is of another torch; the package takes it for reading pictures alone
    for name in [name for name in sys.modules if name.startswith("torchvision")]:
        del sys.modules[name]
    for name in ("torchvision", "torchvision.transforms"):
        sys.modules[name] = types.ModuleType(name)
        sys.modules[name].__spec__ = importlib.machinery.ModuleSpec(name, None)
    made = sys.modules["torchvision"].transforms = sys.modules["torchvision.transforms"]
    made.Compose = made.Normalize = made.ToTensor = lambda *args, **options: None
from depth_anything_3.api import DepthAnything3
torch.manual_seed(0)
network = DepthAnything3(model_name="da3-small").eval()
network.save_pretrained(sys.argv[1])
loaded = DepthModel.from_pretrained(f"da3:{sys.argv[1]}", size="70x98")
pixels = torch.rand(2, 3, 70, 98)
with torch.no_grad():
    expected = torch.stack([network.model(image[None, None])["depth"][0, 0] for image in pixels])
torch.testing.assert_close(loaded.predict(pixels), expected)
assert int(numpy.__version__.split(".")[0]) >= 2 and loaded.kind == "depth"
"""


@pytest.mark.slow
def test_depth_anything_3_runs_beside_us_as_documented(tmp_path):
    """In a fresh environment that sees what is installed here; torchvision's wheel may be for another torch."""
    python, _ = environment_beside_us(tmp_path / "env")
    for line in INSTALL_DA3:
        program, verb, *words = line.split()
        assert (program, verb) == ("pip", "install")
        install(python, [word for word in words if word != "torchvision"])  # with it pip would bring another torch
    done = subprocess.run([python, "-c", DA3_BESIDE_US, str(tmp_path / "da3")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
