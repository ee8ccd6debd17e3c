"""The adapter folder: what is in it, who can load it, and that it is replaced as a whole or not at all."""

import json
import os
import subprocess
import sys
import warnings

import pytest
import torch
from helpers.adapted import PIXELS, depth, load_base, trained
from helpers.tiny import tiny_model, tiny_processor
from huggingface_hub import ModelCard
from peft import PeftModel
from PIL import Image
from transformers import AutoImageProcessor, AutoModelForDepthEstimation

from gift_peft.adapters.folder import save_adapter
from gift_peft.adapters.recipes import HEADS, get_gift_model
from gift_peft.adapters.scale import set_adapter_scale

LOCAL_BASE = "ignore:the base is the local folder:UserWarning"


@pytest.fixture(scope="module")
def saved(base_dir, tmp_path_factory):
    """(adapter folder, the depth it must give, the base's depth) with everything in it."""
    folder = tmp_path_factory.mktemp("saved") / "adapter"
    base = load_base(base_dir)
    before = depth(base)
    torch.manual_seed(0)  # of the LoRA matrices: with some, merging in float32 rounds by more than 1e-5
    model = trained(get_gift_model(base))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the base is the local folder")
        save_adapter(
            model,
            folder,
            processor=tiny_processor(),
            size=(42, 70),
            gift={"recipe": "depth_anything", "metrics": {"gce": 0.25, "empty": float("nan")}},
            card="---\nlibrary_name: peft\ntags:\n- mirrors\n---\n\nThe card.\n",
        )
    return folder, depth(model), before


def test_folder(saved, base_dir):
    folder, _, _ = saved
    assert sorted(path.name for path in folder.iterdir()) == [
        "README.md",
        "adapter_config.json",
        "adapter_model.safetensors",
        "gift.json",
        "preprocessor_config.json",
    ]
    assert [path.name for path in folder.parent.iterdir()] == ["adapter"]  # nothing temporary is left
    config = json.loads((folder / "adapter_config.json").read_text())
    assert config["base_model_name_or_path"] == str(base_dir) and config["inference_mode"]
    gift = json.loads((folder / "gift.json").read_text())
    assert gift["metrics"] == {"gce": 0.25, "empty": None} and gift["size"] == [42, 70]
    assert gift["versions"]["torch"] == torch.__version__
    card = ModelCard.load(folder / "README.md")
    assert card.text.strip() == "The card." and card.data.tags == ["mirrors"]  # PEFT's own card came before
    processor = AutoImageProcessor.from_pretrained(folder, backend="pil")
    for size in ((100, 90), (30, 400), (70, 42)):
        assert processor(Image.new("RGB", size), return_tensors="pt")["pixel_values"].shape == (1, 3, 42, 70)


def test_folder_loads(saved, base_dir):
    folder, after, before = saved
    model = PeftModel.from_pretrained(load_base(base_dir), folder).eval()
    assert torch.equal(depth(model), after)
    with model.disable_adapter():
        assert torch.equal(depth(model), before)
    for scale, expected in ((0, before), (1, after), (0, before), (0.5, None), (1, after)):
        set_adapter_scale(model, scale)
        assert expected is None or torch.equal(depth(model), expected)
    torch.testing.assert_close(depth(model.merge_and_unload()), after, rtol=1e-5, atol=1e-5)


def test_folder_loads_in_transformers(saved):
    folder, after, before = saved
    model = AutoModelForDepthEstimation.from_pretrained(folder)
    assert torch.equal(depth(model), after)
    set_adapter_scale(model, 0)
    assert torch.equal(depth(model), before)
    set_adapter_scale(model, 1)
    assert torch.equal(depth(model), after)


WITHOUT_THIS_PACKAGE = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "gift_peft":
            raise ImportError("gift_peft is blocked")

sys.meta_path.insert(0, Blocker())
import torch
from peft import PeftModel
from transformers import AutoModelForDepthEstimation

torch.set_num_threads(1)
base_dir, folder, given, out = sys.argv[1:]
pixels = torch.load(given)
with torch.no_grad():
    base = AutoModelForDepthEstimation.from_pretrained(base_dir)
    model = PeftModel.from_pretrained(base, folder).eval()
    results = {"peft": model(pixel_values=pixels).predicted_depth}
    with model.disable_adapter():
        results["off"] = model(pixel_values=pixels).predicted_depth
    results["auto"] = AutoModelForDepthEstimation.from_pretrained(folder)(pixel_values=pixels).predicted_depth
    results["merged"] = model.merge_and_unload()(pixel_values=pixels).predicted_depth
assert "gift_peft" not in sys.modules
try:
    import gift_peft
except ImportError:
    torch.save(results, out)
"""


def test_folder_loads_without_this_package(saved, base_dir, tmp_path):
    folder, after, before = saved
    torch.save(PIXELS, tmp_path / "pixels.pt")
    command = [
        sys.executable,
        "-c",
        WITHOUT_THIS_PACKAGE,
        base_dir,
        folder,
        tmp_path / "pixels.pt",
        tmp_path / "out.pt",
    ]
    run = subprocess.run(
        command, capture_output=True, text=True, check=False, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    assert run.returncode == 0, run.stderr
    results = torch.load(tmp_path / "out.pt")
    assert torch.equal(results["peft"], after) and torch.equal(results["auto"], after)
    assert torch.equal(results["off"], before)
    torch.testing.assert_close(results["merged"], after, rtol=1e-5, atol=1e-5)


@pytest.mark.filterwarnings(LOCAL_BASE)
def test_base_name_and_card(base_dir, tmp_path):
    model = get_gift_model(load_base(base_dir), head="none")
    with pytest.warns(UserWarning, match="the base is the local folder"):
        save_adapter(model, tmp_path / "local")
    text = (tmp_path / "local" / "README.md").read_text()
    assert str(base_dir) not in text and "base_model" not in text
    with pytest.raises(ValueError, match="the card names the local base path"):
        save_adapter(model, tmp_path / "leak", card=f"base_model: {base_dir}")
    assert not (tmp_path / "leak").exists()

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save_adapter(model, tmp_path / "hub", "depth-anything/Depth-Anything-V2-Large-hf", "main")
    config = json.loads((tmp_path / "hub" / "adapter_config.json").read_text())
    assert (config["base_model_name_or_path"], config["revision"]) == (
        "depth-anything/Depth-Anything-V2-Large-hf",
        "main",
    )
    assert (
        ModelCard.load(tmp_path / "hub" / "README.md").data.base_model == "depth-anything/Depth-Anything-V2-Large-hf"
    )

    with pytest.warns(UserWarning, match="names no base model"):
        save_adapter(get_gift_model(tiny_model()), tmp_path / "nameless")


def test_saving_replaces_the_whole_folder(model, tmp_path):
    folder = tmp_path / "adapter"
    model = get_gift_model(model)
    save_adapter(model, folder, "someone/base", processor=tiny_processor(), size=(28, 28))
    first = depth(trained(model))
    save_adapter(model, folder, "someone/base")
    assert not (folder / "preprocessor_config.json").exists()
    assert torch.equal(depth(PeftModel.from_pretrained(tiny_model(), folder).eval()), first)

    (folder / "photo.jpg").touch()
    with pytest.raises(ValueError, match=r"holds files that were not written by this command \(photo.jpg\)"):
        save_adapter(model, folder, "someone/base")
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="file"):
        save_adapter(model, tmp_path / "file", "someone/base")


def test_an_adapter_is_on_the_disk_before_it_has_its_name(model, tmp_path, monkeypatch):
    """Or a power cut leaves a folder of empty files."""
    events, fsync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: events.append(os.fstat(fd).st_ino) or fsync(fd))
    monkeypatch.setattr(os, "replace", lambda source, target: events.append(str(target)) or replace(source, target))
    save_adapter(get_gift_model(model), tmp_path / "adapter", "someone/base")
    named = events.index(str(tmp_path / "adapter"))
    files = {path.stat().st_ino for path in (tmp_path / "adapter").rglob("*")}
    assert files and files <= set(events[:named]) and tmp_path.stat().st_ino in events[named:]


def test_failed_save_keeps_the_old_folder(model, tmp_path):
    model = get_gift_model(model)
    save_adapter(model, tmp_path / "adapter", "someone/base")
    before = {path.name: path.read_bytes() for path in (tmp_path / "adapter").iterdir()}
    trained(model)
    with pytest.raises(TypeError):
        save_adapter(model, tmp_path / "adapter", "someone/base", card=3.5)
    assert {path.name: path.read_bytes() for path in (tmp_path / "adapter").iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["adapter"]


@pytest.mark.parametrize("head", HEADS)
def test_scaled_adapter_is_not_saved(head, tmp_path):
    model = trained(get_gift_model(tiny_model(), head=head))
    set_adapter_scale(model, 0.5)
    with pytest.raises(ValueError, match=r"call set_adapter_scale\(model, 1\) first"):
        save_adapter(model, tmp_path / "adapter", "someone/base")
    set_adapter_scale(model, 1)
    save_adapter(model, tmp_path / "adapter", "someone/base")
    with pytest.raises(ValueError, match="needs a PeftModel"):
        save_adapter(tiny_model(), tmp_path / "plain", "someone/base")
