"""Official weights to a transformers folder, and what the Auto classes make of it."""

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.backbones import metric3d_golden, vggt_golden
from PIL import Image
from safetensors.torch import load_file, save_file
from transformers import AutoConfig, AutoImageProcessor, AutoModelForDepthEstimation, pipeline

from gift_peft.models import convert
from gift_peft.models.convert import CONVERTERS
from gift_peft.models.metric3d import Metric3DConfig, Metric3DForDepthEstimation, Metric3DImageProcessorPil
from gift_peft.models.vggt import VggtConfig, VggtForDepthEstimation, VggtImageProcessorPil

CLASSES = {
    "vggt": (VggtConfig, VggtForDepthEstimation, VggtImageProcessorPil),
    "metric3d": (Metric3DConfig, Metric3DForDepthEstimation, Metric3DImageProcessorPil),
}
INSTALLED_WITH_TRANSFORMERS = {"torch", "numpy", "transformers", "safetensors", "huggingface_hub"}
OTHER = {"vggt": "metric3d", "metric3d": "vggt"}


def official(name):
    """(official weights, their config) of the public golden."""
    if name == "metric3d":
        return metric3d_golden()[1:]
    _, weights, sidecar = vggt_golden()
    return weights, VggtConfig(**sidecar["config"])


@pytest.fixture(scope="module", params=sorted(CLASSES))
def case(request, tmp_path_factory):
    """(name, official file, config, converted folder)."""
    weights, config = official(request.param)
    root = tmp_path_factory.mktemp(request.param)
    torch.save({"model_state_dict": {f"module.{key}": value for key, value in weights.items()}}, root / "official.pth")
    folder = CONVERTERS[request.param](root / "official.pth", root / "new" / "folder", config)
    return request.param, root / "official.pth", config, folder


def test_the_folder_is_a_transformers_model(case):
    name, source, config, folder = case
    model_class, processor_class = CLASSES[name][1:]
    expected = model_class.from_official(source, config)
    assert type(AutoConfig.from_pretrained(folder)) is type(config)
    model = AutoModelForDepthEstimation.from_pretrained(folder)
    assert type(model) is model_class and not model.training
    processor = AutoImageProcessor.from_pretrained(folder, backend="pil")
    assert type(processor) is processor_class and dict(processor.size) == {"height": 476, "width": 644}
    assert set(load_file(folder / "model.safetensors")) == set(expected.state_dict())
    pixels = torch.rand(1, 3, 28, 42)
    with torch.no_grad():
        assert torch.equal(model(pixels).predicted_depth, expected(pixels).predicted_depth)
    assert sorted(path.name for path in folder.parent.iterdir()) == ["folder"]  # nothing temporary beside it


def test_pipeline_gives_depth_at_the_pictures_size(case, capsys):
    processor = AutoImageProcessor.from_pretrained(case[3], backend="pil", size={"height": 56, "width": 84})
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8))
    estimate = pipeline("depth-estimation", model=str(case[3]), image_processor=processor)
    assert "custom code" not in capsys.readouterr().out  # it does not ask before running what is registered
    results = estimate([picture, picture.resize((50, 90))], batch_size=2)
    assert [tuple(result["predicted_depth"].shape) for result in results] == [(60, 80), (90, 50)]
    assert all(torch.isfinite(result["predicted_depth"]).all() for result in results)
    assert results[0]["depth"].size == (80, 60)


def test_sizes_can_come_from_a_file(case, tmp_path):
    name, source, _, folder = case
    again = CONVERTERS[name](source, tmp_path / "again", folder / "config.json")
    for file in ("model.safetensors", "preprocessor_config.json"):
        assert (again / file).read_bytes() == (folder / file).read_bytes()


@pytest.mark.parametrize("text", ["{", "[1]", '{"embed_dim": "big"}', '{"num_heads": 0}'])
def test_bad_sizes_are_one_line(case, tmp_path, text):
    (tmp_path / "sizes.json").write_text(text)
    with pytest.raises(ValueError, match=r"sizes\.json: not the sizes") as caught:
        CONVERTERS[case[0]](case[1], tmp_path / "out", tmp_path / "sizes.json")
    assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()


def test_bad_sources_leave_nothing_behind(case, tmp_path):
    name, source, config, _ = case
    cut, other = tmp_path / "cut.pth", tmp_path / "other.safetensors"
    cut.write_bytes(source.read_bytes()[:50_000])
    weights = official(OTHER[name])[0]
    save_file({key: value for key, value in weights.items() if ".downsample.1." not in key}, other)
    # The Metric3D golden has no tensor of VGGT and the other way round.
    for bad, message in ((cut, "cut"), (other, next(iter(load_file(other))))):
        with pytest.raises(ValueError, match=message):
            CONVERTERS[name](bad, tmp_path / "out", config)
    with pytest.raises(ValueError, match="shape"):  # the released size's config does not fit
        CONVERTERS[name](source, tmp_path / "out")
    with pytest.raises(FileNotFoundError, match=r"none\.pth"):
        CONVERTERS[name](tmp_path / "none.pth", tmp_path / "out", config)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut.pth", "other.safetensors"]


def test_what_fails_while_writing_leaves_nothing_behind(case, tmp_path, monkeypatch):
    name, source, config, _ = case
    processor_class = CLASSES[name][2]

    def full(*args, **kwargs):
        raise OSError("No space left on device")

    monkeypatch.setattr(processor_class, "save_pretrained", full)
    with pytest.raises(OSError, match="No space left"):
        CONVERTERS[name](source, tmp_path / "out", config)
    assert list(tmp_path.iterdir()) == []


def test_existing_folders_are_kept(case, tmp_path):
    name, source, config, _ = case
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"holds files .*mine\.txt.* kept"):
        CONVERTERS[name](source, tmp_path / "out", config)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.txt"]
    (tmp_path / "empty").mkdir()
    assert (CONVERTERS[name](source, tmp_path / "empty", config) / "config.json").is_file()


@pytest.mark.parametrize(
    ("name", "source", "repo", "file"),
    [
        ("vggt", "facebook/VGGT-1B", "facebook/VGGT-1B", "model.safetensors"),
        ("metric3d", "JUGGHM/Metric3D", "JUGGHM/Metric3D", "metric_depth_vit_giant2_800k.pth"),
        (
            "metric3d",
            "JUGGHM/Metric3D/metric_depth_vit_large_800k.pth",
            "JUGGHM/Metric3D",
            "metric_depth_vit_large_800k.pth",
        ),
    ],
)
def test_hub_ids(name, source, repo, file, tmp_path, monkeypatch):
    weights, config = official(name)
    torch.save(weights, tmp_path / "downloaded")
    asked = []

    def download(*args):
        asked.append(args)
        return str(tmp_path / "downloaded")

    monkeypatch.setattr("huggingface_hub.hf_hub_download", download)
    CONVERTERS[name](source, tmp_path / "out", config)
    assert asked == [(repo, file)]


def test_an_unreachable_hub_is_one_line(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no such file, and model\.safetensors of nobody/nothing") as caught:
        convert.convert_vggt("nobody/nothing", tmp_path / "out")  # HF_HUB_OFFLINE is set
    assert "\n" not in str(caught.value) and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", sorted(CLASSES))
def test_the_files_work_on_their_own(name):
    """Saved folders carry them: each imports only siblings and packages of a transformers installation."""
    folder = Path(inspect.getfile(CLASSES[name][1])).parent
    files = sorted(folder.glob(f"*_{name}.py"))
    assert len(files) > 3
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level:
                assert node.level == 1 and folder / f"{node.module}.py" in files
            elif isinstance(node, (ast.Import, ast.ImportFrom)):
                names = [node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
                tops = {name.split(".")[0] for name in names}
                assert tops <= INSTALLED_WITH_TRANSFORMERS | sys.stdlib_module_names, f"{file.name} imports {names}"


PROBE = """
import sys, numpy as np, torch
sys.modules["gift_peft"] = None  # as if it were not installed
from PIL import Image
from transformers import AutoConfig, AutoImageProcessor, AutoModelForDepthEstimation, pipeline
folder, pixels, out = sys.argv[1:]
model = AutoModelForDepthEstimation.from_pretrained(folder, trust_remote_code=True)
processor = AutoImageProcessor.from_pretrained(folder, trust_remote_code=True)
assert "transformers_modules" in type(model).__module__ and "transformers_modules" in type(processor).__module__
with torch.no_grad():
    depth = model(torch.load(pixels)).predicted_depth
processor.size = {"height": 56, "width": 84}
estimate = pipeline("depth-estimation", model=folder, image_processor=processor, trust_remote_code=True)
picture = Image.fromarray(np.zeros((60, 80, 3), np.uint8))
assert estimate(picture)["predicted_depth"].shape == (60, 80)
torch.save(depth, out)
"""


@pytest.mark.slow
def test_the_folder_works_without_this_package(case, tmp_path, monkeypatch):
    _, _, _, folder = case
    pixels = torch.rand(1, 3, 28, 42)
    torch.save(pixels, tmp_path / "pixels.pt")
    monkeypatch.setenv("HF_MODULES_CACHE", str(tmp_path / "modules"))
    command = [sys.executable, "-c", PROBE, str(folder), str(tmp_path / "pixels.pt"), str(tmp_path / "depth.pt")]
    subprocess.run(command, check=True, cwd=tmp_path, stdin=subprocess.DEVNULL)
    with torch.no_grad():
        expected = AutoModelForDepthEstimation.from_pretrained(folder)(pixels).predicted_depth
    assert torch.equal(torch.load(tmp_path / "depth.pt"), expected)
