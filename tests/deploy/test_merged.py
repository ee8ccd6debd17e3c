"""`gift-peft deploy --to transformers`: the plain folder is the adapter, and what cannot be one is refused."""

import json
import shutil

import numpy as np
import pytest
import torch
from helpers.adapted import trained
from helpers.backbones import tiny_metric3d, tiny_vggt
from helpers.demo_folder import write_demo
from helpers.tiny import tiny_model
from PIL import Image
from transformers import AutoModelForDepthEstimation, pipeline

from gift_peft import DepthModel, get_gift_model, save_adapter
from gift_peft.cli import main
from gift_peft.deploy import merged as merging
from gift_peft.deploy.merged import deploy_transformers
from gift_peft.models.metric3d import Metric3DImageProcessorPil
from gift_peft.models.vggt import VggtImageProcessorPil

pytestmark = pytest.mark.filterwarnings(
    "ignore:.is_gradient_checkpointing. is deprecated:FutureWarning", "ignore:the base is the local folder"
)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    with pytest.warns(UserWarning, match="local folder"):
        return write_demo(tmp_path_factory.mktemp("demo"))


@pytest.fixture
def run(capsys):
    def run(*argv):
        with pytest.raises(SystemExit) as end:
            main(["deploy", *map(str, argv)])
        return end.value.code, capsys.readouterr()

    return run


@pytest.fixture(scope="module")
def photo(tmp_path_factory):
    path = tmp_path_factory.mktemp("photo") / "photo.png"
    pixels = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    Image.fromarray(pixels).resize((90, 61)).save(path)
    return path


def relative(ours, theirs):
    return np.abs(ours - theirs).max() / np.abs(theirs).mean()


@pytest.mark.parametrize("scale", [1.0, 0.3, 0.0])
def test_the_folder_is_the_adapter_at_that_scale(demo, photo, tmp_path, scale):
    out = deploy_transformers(demo / "adapter", tmp_path / "out", adapter_scale=scale)
    expected = DepthModel.from_pretrained(demo / "base", demo / "adapter", scale).depth_at(photo)
    assert relative(DepthModel.from_pretrained(out).depth_at(photo), expected) < 1e-5
    by_pipeline = pipeline("depth-estimation", model=str(out))(str(photo))["predicted_depth"].numpy()
    assert relative(by_pipeline.squeeze(), expected) < 1e-5
    assert not any("lora" in key for key in AutoModelForDepthEstimation.from_pretrained(out).state_dict())


def test_a_scale_between_is_neither_end(demo, photo, tmp_path):
    depths = [
        DepthModel.from_pretrained(
            deploy_transformers(demo / "adapter", tmp_path / str(scale), adapter_scale=scale)
        ).depth_at(photo)
        for scale in (0.0, 0.5, 1.0)
    ]
    assert relative(depths[1], depths[0]) > 1e-3 and relative(depths[1], depths[2]) > 1e-3


@pytest.mark.parametrize(
    ("make", "processor"), [(tiny_vggt, VggtImageProcessorPil), (tiny_metric3d, Metric3DImageProcessorPil)]
)
@pytest.mark.parametrize("head", ["full", "lora"])
def test_the_other_backbones(make, processor, head, photo, tmp_path):
    base = make()
    base.save_pretrained(tmp_path / "base")
    processor().save_pretrained(tmp_path / "base")
    model = trained(get_gift_model(base, head=head))
    save_adapter(model, tmp_path / "adapter", str(tmp_path / "base"), processor=processor(), size=(56, 84))
    out = deploy_transformers(tmp_path / "adapter", tmp_path / "out")
    expected = DepthModel.from_pretrained(tmp_path / "base", tmp_path / "adapter").depth_at(photo)
    assert relative(DepthModel.from_pretrained(out).depth_at(photo), expected) < 1e-5


def test_the_card_names_no_place_of_this_machine(demo, tmp_path):
    out = deploy_transformers(demo / "adapter", tmp_path / "out")
    for name in ("README.md", "config.json", "preprocessor_config.json"):
        assert str(demo) not in (out / name).read_text() and str(tmp_path) not in (out / name).read_text()
    card = (out / "README.md").read_text()
    assert "library_name: transformers" in card and "inverse depth" in card and "56x70" in card
    assert json.loads((out / "preprocessor_config.json").read_text())["size"] == {"height": 56, "width": 70}


# ---- what is refused, in one line, and leaves nothing ----


def test_bad_arguments(run, demo, tmp_path):
    for scale in ("-0.1", "1.5", "nan"):
        code, said = run(demo / "adapter", tmp_path / "out", "--to", "transformers", f"--adapter-scale={scale}")
        assert code == 1 and "from 0 (the base) to 1 (the adapter)" in said.err.splitlines()[-1]
    code, said = run(demo / "adapter", tmp_path / "out", "--to", "transformers", "--dial")
    assert code == 2 and "--dial" in said.err
    code, said = run(tmp_path / "none", tmp_path / "out", "--to", "transformers")
    assert code == 1 and str(tmp_path / "none") in said.err
    assert not (tmp_path / "out").exists()


def test_a_base_that_is_gone(run, demo, tmp_path):
    shutil.copytree(demo, tmp_path / "moved")
    config = tmp_path / "moved" / "adapter" / "adapter_config.json"
    stated = json.loads(config.read_text())
    config.write_text(json.dumps(stated | {"base_model_name_or_path": "/nowhere/other"}))
    code, said = run(tmp_path / "moved" / "adapter", tmp_path / "out", "--to", "transformers")
    assert code == 1 and "/nowhere/other" in said.err.splitlines()[-1]
    code, _ = run(
        tmp_path / "moved" / "adapter", tmp_path / "out", "--to", "transformers", "--base", tmp_path / "moved" / "base"
    )
    assert code == 0 and (tmp_path / "out" / "model.safetensors").is_file()


def test_a_folder_with_other_files_is_kept(run, demo, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "diary.txt").write_text("mine")
    code, said = run(demo / "adapter", tmp_path / "out", "--to", "transformers")
    assert code == 1 and "diary.txt" in said.err and [path.name for path in tmp_path.iterdir()] == ["out"]
    (tmp_path / "out" / "diary.txt").unlink()
    assert run(demo / "adapter", tmp_path / "out", "--to", "transformers")[0] == 0
    assert run(demo / "adapter", tmp_path / "out", "--to", "transformers")[0] == 0  # its own folder, again


def test_what_is_not_exact_is_refused(demo, tmp_path, monkeypatch):
    model = DepthModel(get_gift_model(tiny_model()), DepthModel.from_pretrained(demo / "base").processor)
    merge = type(model.network.base_model).merge_and_unload

    def inexact(self, **options):
        plain = merge(self, **options)
        with torch.no_grad():
            plain.head.conv3.bias.add_(1e-3)
        return plain

    monkeypatch.setattr(type(model.network.base_model), "merge_and_unload", inexact)
    with pytest.raises(ValueError, match=r"differs from the adapter by .* of the output's mean"):
        merging.merged(model)
    half = DepthModel(get_gift_model(tiny_model()).to(torch.bfloat16), model.processor)
    with pytest.raises(ValueError, match="bfloat16"):
        merging.merged(half)
