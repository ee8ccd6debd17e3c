"""The backbones through the whole of GIFT alike: proxies, training, adapter, merging, evaluation, prediction."""

import json

import pytest
import torch
from helpers.backbones import randomize, tiny_metric3d, tiny_vggt
from helpers.moge import tiny_moge, tiny_vit
from helpers.runs import arguments, weights
from helpers.tiny import tiny_model, tiny_processor, write_raw_tree
from peft import PeftModel, get_peft_model_state_dict
from transformers import AutoImageProcessor, AutoModelForDepthEstimation

from gift_peft import get_gift_model, set_adapter_scale
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.evaluation.evaluate import evaluate_gift_i
from gift_peft.models.metric3d import Metric3DImageProcessorPil
from gift_peft.models.moge import MogeImageProcessorPil
from gift_peft.models.pixels import to_pixel_values
from gift_peft.models.vggt import VggtImageProcessorPil
from gift_peft.training import loop, train

pytestmark = [
    # transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
    pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning"),
    pytest.mark.filterwarnings("ignore:the base is the local folder"),
]

__all__ = ["tiny_vit"]  # a fixture
SIZE = (28, 56)


def lively_vggt():
    """The tiny VGGT with larger weights: its own outputs hardly differ from image to image."""
    return randomize(tiny_vggt(), gain=1.4)


BACKBONES = {
    "depth_anything": (tiny_model, tiny_processor),
    "vggt": (lively_vggt, VggtImageProcessorPil),
    "metric3d": (tiny_metric3d, Metric3DImageProcessorPil),
    "moge": (tiny_moge, MogeImageProcessorPil),
}


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return write_raw_tree(tmp_path_factory.mktemp("tree") / "raw", train=(3, 2), validation=(2,))


@pytest.mark.parametrize("head", ["full", "lora"])
@pytest.mark.parametrize("name", BACKBONES)
def test_from_pictures_to_an_evaluated_adapter(name, head, tree, tmp_path, monkeypatch, request):
    if name == "moge":
        request.getfixturevalue("tiny_vit")  # skips where its package is not installed
    make_model, make_processor = BACKBONES[name]
    base, out = tmp_path / "base", tmp_path / "out"
    make_model().save_pretrained(base)
    make_processor().save_pretrained(base)
    files = {path.name: path.read_bytes() for path in base.iterdir()}
    models = []

    def keep(*args, **options):
        models.append(get_gift_model(*args, **options))
        return models[-1]

    monkeypatch.setattr(loop, "get_gift_model", keep)
    args = arguments(
        base,
        tree,
        out,
        size=f"{SIZE[0]}x{SIZE[1]}",
        head=head,
        learning_rate=1e-4,
        lambda_d=0.1,  # random weights know no regions: inside and outside of the target move together
        num_train_epochs=3,
        checkpointing_steps=None,
        proxies_dir=str(tmp_path / "proxies"),
    )
    result = train(args)
    assert result.step == 6
    assert result.metrics[0]["distillation"] == 0
    assert result.metrics[-1]["loss"] < result.metrics[0]["loss"]

    trained = models[0]
    teacher = AutoModelForDepthEstimation.from_pretrained(base)
    processor = AutoImageProcessor.from_pretrained(base, backend="pil")
    rows = load_gift_i(tree, "train")
    pixels = to_pixel_values(rows[0]["images"], processor, SIZE)
    reloaded = PeftModel.from_pretrained(AutoModelForDepthEstimation.from_pretrained(base), out / "adapter-last")
    with torch.no_grad():
        before = teacher(pixel_values=pixels).predicted_depth
        after = trained(pixel_values=pixels).predicted_depth
        assert before.shape == (len(pixels), *SIZE) and not torch.equal(before, after)
        assert torch.equal(reloaded(pixel_values=pixels).predicted_depth, after)
        for model in (trained, reloaded):
            with model.disable_adapter():
                assert torch.equal(model(pixel_values=pixels).predicted_depth, before)
            set_adapter_scale(model, 0)
            assert torch.equal(model(pixel_values=pixels).predicted_depth, before)
            set_adapter_scale(model, 1)
            assert torch.equal(model(pixel_values=pixels).predicted_depth, after)
    assert {path.name: path.read_bytes() for path in base.iterdir()} == files
    ours, theirs = get_peft_model_state_dict(trained), weights(out / "adapter-last")
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)

    gift = json.loads((out / "adapter-last/gift.json").read_text())
    assert gift["model_type"] == teacher.config.model_type and gift["size"] == list(SIZE)
    validation = load_gift_i(tree, "validation", teacher=base, proxies_dir=tmp_path / "proxies")
    report = evaluate_gift_i(validation, reloaded, processor=processor, progress=False)
    assert report.summary["all"]["rmse"] == pytest.approx(result.metrics[-1]["val_all_rmse"], rel=1e-5)
    with torch.no_grad():
        merged = reloaded.merge_and_unload()
        torch.testing.assert_close(merged(pixel_values=pixels).predicted_depth, after, rtol=1e-3, atol=1e-4)
