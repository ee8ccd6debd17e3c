"""MoGe through GIFT: what its own mask leaves out counts nowhere; trained on the embedded groups."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.adapted import depth, trained
from helpers.environments import environment_beside_us, install
from helpers.moge import tiny_moge, tiny_vit
from helpers.runs import arguments
from helpers.tiny import write_raw_tree
from peft import PeftModel
from transformers import AutoModelForDepthEstimation

from gift_peft import evaluate_gift_i, get_gift_model, gift_loss, load_gift_i, save_adapter
from gift_peft.dataset.loader import PreparedGroups, PreparedImages
from gift_peft.dataset.proxies import SurfaceSettings
from gift_peft.dataset.tensors import collate_group
from gift_peft.deploy.merged import deploy_transformers
from gift_peft.models.loading import DepthModel
from gift_peft.models.moge import MogeImageProcessorPil
from gift_peft.models.moge.package_moge import INSTALL
from gift_peft.rules import UNKNOWN
from gift_peft.training import train
from gift_peft.training.teacher import make_proxies

__all__ = ["tiny_vit"]  # a fixture

pytestmark = [
    pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning"),
    pytest.mark.filterwarnings("ignore:the base is the local folder"),
]
SIZE = (28, 56)
EMBEDDED = Path(__file__).parents[2] / "src" / "gift_peft" / "demo" / "gift-i"


def write_base(folder: Path, sky: bool = False) -> Path:
    tiny_moge(sky=sky).save_pretrained(folder)
    MogeImageProcessorPil().save_pretrained(folder)
    return folder


def test_what_the_mask_leaves_out_enters_neither_loss_nor_metrics(tiny_vit, tmp_path):
    base, tree = write_base(tmp_path / "base", sky=True), write_raw_tree(tmp_path / "raw")
    make_proxies(base, tree, size=SIZE, proxies_dir=tmp_path / "proxies")
    rows = load_gift_i(tree, "train", teacher=base, proxies_dir=tmp_path / "proxies")
    model = DepthModel.from_pretrained(base, size=SIZE)
    group = collate_group(rows[0], model.processor, SIZE)
    with torch.no_grad():
        output = model.network(group.pixel_values)
    assert 0.1 < output.valid_mask.float().mean() < 0.9
    assert torch.equal(group.valid, output.valid_mask) and (group.target[~group.valid] == 0).all()
    stored = torch.as_tensor(np.asarray(rows[0]["proxies"]))
    assert torch.equal(stored == UNKNOWN, ~output.valid_mask)
    assert torch.equal(stored[output.valid_mask], output.predicted_depth[output.valid_mask])
    depth = output.predicted_depth + 0.01 * group.pixel_values.mean(1)
    other = torch.where(output.valid_mask, depth, 1000 * depth)
    losses = [gift_loss(each, group.target, group.mask, valid=group.valid).total for each in (depth, other)]
    assert losses[0] == losses[1] > 0
    validation = load_gift_i(tree, "validation", teacher=base, proxies_dir=tmp_path / "proxies")
    stored_report = evaluate_gift_i(validation, model, progress=False)
    computed = evaluate_gift_i(load_gift_i(tree, "validation"), model, progress=False)
    assert stored_report.summary == computed.summary and stored_report.gce == computed.gce
    reference = model.predict_proxies(model.inputs([validation[0]["reference"]]))[0]
    for index, row in enumerate(stored_report.rows):
        own = collate_group(validation[0], model.processor, SIZE).valid[index]
        assert row["pixels"]["all"] == int((own & (reference != UNKNOWN)).sum()) < SIZE[0] * SIZE[1]
    plain = DepthModel.from_pretrained(write_base(tmp_path / "plain"), size=SIZE)
    pixels = group.pixel_values
    assert torch.equal(plain.predict_proxies(pixels), plain.predict_base(pixels))


@pytest.mark.parametrize(("name", "head"), [("v1", "full"), ("v2-normal", "full"), ("v2-normal", "lora")])
def test_an_adapter_is_deployed_as_a_plain_model(name, head, tiny_vit, tmp_path):
    tiny_moge(name=name).save_pretrained(tmp_path / "base")
    MogeImageProcessorPil().save_pretrained(tmp_path / "base")
    adapted = trained(get_gift_model(tiny_moge(name=name), rank=2, head=head))
    save_adapter(adapted, tmp_path / "adapter", str(tmp_path / "base"), processor=MogeImageProcessorPil(), size=SIZE)
    deploy_transformers(tmp_path / "adapter", tmp_path / "merged")
    merged = DepthModel.from_pretrained(tmp_path / "merged")
    unit = 1 if name == "v1" else 1000
    assert (merged.size, merged.kind, merged.millimeters_per_unit) == (SIZE, "depth", unit)
    for size in (SIZE, (97, 61)):
        pixels = torch.rand(2, 3, *size)
        torch.testing.assert_close(merged.predict(pixels), depth(adapted, pixels), rtol=1e-3, atol=1e-4)
        assert not torch.allclose(merged.predict(pixels), depth(tiny_moge(name=name), pixels), rtol=1e-2)


def test_a_surface_run_takes_it(tiny_vit, tmp_path):
    base, tree = write_base(tmp_path / "base", sky=True), write_raw_tree(tmp_path / "raw")
    options = {"size": "28x56", "target": "surface", "max_steps": 3, "proxies_dir": str(tmp_path / "proxies")}
    result = train(arguments(base, tree, tmp_path / "out", checkpointing_steps=None, **options))
    assert result.step == 3 and np.isfinite(result.metrics[-1]["loss"])
    # Its sky is left out as with the paper's objective, in the photo and in its mirror image.
    places = {"size": SIZE, "proxies_dir": tmp_path / "proxies"}
    rows = load_gift_i(tree, "train", teacher=base, surface=SurfaceSettings(), **places)
    model = DepthModel.from_pretrained(base, size=SIZE)
    images = PreparedImages(PreparedGroups(rows, model.processor, SIZE, num_threads=0))
    for index in range(len(images)):
        for flip in (False, True):
            image = images.read(index, flip)
            known = model.predict_proxies(image.pixel_values) != UNKNOWN
            assert 0.1 < known.float().mean() < 0.9 and image.surface_target.abs().max() < 1e6
            assert torch.equal(image.valid & ~image.mask, known & ~image.mask)
            assert (image.valid >= known).all(), "inside the target others may know"


@pytest.mark.slow
def test_trained_on_the_embedded_groups(tiny_vit, tmp_path):
    base, out = write_base(tmp_path / "base"), tmp_path / "out"
    files = {path.name: path.read_bytes() for path in base.iterdir()}
    options = {"size": "56x70", "learning_rate": 3e-4, "num_train_epochs": 3, "checkpointing_steps": None}
    options["lambda_d"] = 0.1  # twenty thousand random weights cannot tell a target from what is around it
    result = train(arguments(base, EMBEDDED, out, proxies_dir=str(tmp_path / "proxies"), **options))
    losses = [row["loss"] for row in result.metrics]
    assert result.metrics[0]["distillation"] == 0 and losses[-1] < 0.9 * losses[0], losses
    assert {path.name: path.read_bytes() for path in base.iterdir()} == files
    teacher = AutoModelForDepthEstimation.from_pretrained(base)
    adapted = PeftModel.from_pretrained(AutoModelForDepthEstimation.from_pretrained(base), out / "adapter-last").eval()
    again = PeftModel.from_pretrained(AutoModelForDepthEstimation.from_pretrained(base), out / "adapter-last").eval()
    with torch.no_grad():
        for size in ((56, 70), (84, 112), (97, 61)):
            pixels = torch.rand(2, 3, *size)
            depth = adapted(pixel_values=pixels).predicted_depth
            assert torch.equal(again(pixel_values=pixels).predicted_depth, depth)
            with adapted.disable_adapter():
                assert torch.equal(adapted(pixel_values=pixels).predicted_depth, teacher(pixels).predicted_depth)
        merged = again.merge_and_unload()
        merged.save_pretrained(tmp_path / "merged")
        exported = AutoModelForDepthEstimation.from_pretrained(tmp_path / "merged")
        for size in ((56, 70), (84, 112), (97, 61)):
            pixels = torch.rand(2, 3, *size)
            depth = adapted(pixel_values=pixels).predicted_depth
            torch.testing.assert_close(exported(pixels).predicted_depth, depth, rtol=1e-4, atol=1e-5)
    assert json.loads((out / "adapter-last" / "gift.json").read_text())["model_type"] == "gift_moge"


@pytest.mark.slow
def test_the_documented_command_is_enough(tmp_path):
    """In a fresh environment that sees what is installed here: the packages named, and nothing else of theirs."""
    import subprocess

    python, site = environment_beside_us(tmp_path / "env")
    words = INSTALL.split()
    assert words[:2] == ["pip", "install"] and "--no-deps" in words
    install(python, words[2:])
    code = (
        "import sys, torch, cv2; from gift_peft import MogeConfig, MogeForDepthEstimation;"
        "model = MogeForDepthEstimation(MogeConfig(variant='moge-2-vits-normal')).eval();"
        "depth = model(torch.rand(1, 3, 70, 98), num_tokens=24).predicted_depth; assert depth.shape == (1, 70, 98);"
        "assert not {'gradio', 'torchvision'} & set(sys.modules)"
    )
    done = subprocess.run([python, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    listed = subprocess.run([python, "-m", "pip", "list", "--path", site], capture_output=True, text=True).stdout
    assert "opencv-python " not in listed and "gradio" not in listed and "torchvision" not in listed
