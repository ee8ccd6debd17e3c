"""What pins a model: its tensors and what its config states, not the files they are in."""

import json
import pickle
import shutil

import pytest
import torch
from helpers.adapted import trained
from helpers.tiny import SIZE, tiny_model, tiny_processor, write_base
from safetensors.torch import load_file, save_file
from transformers import AutoModelForDepthEstimation

from gift_peft.adapters.folder import save_adapter
from gift_peft.adapters.recipes import get_gift_model
from gift_peft.models.identity import earlier_revision, teacher_revision, weights_difference, weights_revision
from gift_peft.models.loading import DepthModel

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning")


def edit(path, change):
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def resave(folder, **options):
    model = AutoModelForDepthEstimation.from_pretrained(folder)
    (folder / "model.safetensors").unlink()
    model.save_pretrained(folder, **options)


def as_pickle(folder):
    torch.save(load_file(folder / "model.safetensors"), folder / "pytorch_model.bin")


def change_weights(folder, change):
    tensors = load_file(folder / "model.safetensors")
    change(tensors)
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})


SAME = {
    "windows line ends": lambda folder: (folder / "config.json").write_bytes(
        (folder / "config.json").read_bytes().replace(b"\n", b"\r\n")
    ),
    "an extra bin": as_pickle,
    "saved again": resave,
    "sharded": lambda folder: resave(folder, max_shard_size="40KB"),
    "a reordered config": lambda folder: edit(folder / "config.json", lambda c: dict(sorted(c.items(), reverse=True))),
    "of another version": lambda folder: edit(folder / "config.json", lambda c: {**c, "transformers_version": "4.1"}),
    "a default left out": lambda folder: edit(
        folder / "config.json", lambda c: {key: value for key, value in c.items() if key != "initializer_range"}
    ),
    "a readme and other files": lambda folder: (
        (folder / "README.md").write_text("hello"),
        (folder / "optimizer.bin").write_bytes(b"0"),
    ),
    "no image processor": lambda folder: (folder / "preprocessor_config.json").unlink(),
}
OTHER = {
    "one value": (
        lambda folder: change_weights(folder, lambda t: t["head.conv3.bias"].add_(2**-20)),
        "its tensors have other values",
    ),
    "a name": (
        lambda folder: change_weights(folder, lambda t: t.update(other=t.pop("head.conv3.bias"))),
        "its tensors have other names or shapes",
    ),
    "a tensor more": (
        lambda folder: change_weights(folder, lambda t: t.update(other=torch.zeros(3))),
        "it has 144 tensors, not 143",
    ),
    "the config": (
        lambda folder: edit(folder / "config.json", lambda c: {**c, "max_depth": 77}),
        "its config.json says otherwise",
    ),
}


@pytest.fixture
def folder(base_dir, tmp_path):
    return shutil.copytree(base_dir, tmp_path / "copy")


@pytest.fixture(scope="module")
def adapter(base_dir, tmp_path_factory):
    place = tmp_path_factory.mktemp("adapter") / "adapter"
    gift = {"base_revision": weights_revision(base_dir), "kind": "inverse_depth"}
    with pytest.warns(UserWarning, match="local folder"):
        save_adapter(
            trained(get_gift_model(tiny_model())),
            place,
            str(base_dir),
            processor=tiny_processor(),
            size=SIZE,
            gift=gift,
        )
    return place


@pytest.mark.parametrize("name", SAME)
def test_the_same_weights_in_other_files_are_the_same_base(name, folder, base_dir, adapter):
    SAME[name](folder)
    assert weights_revision(folder) == teacher_revision(folder) == weights_revision(base_dir)
    assert DepthModel.from_pretrained(folder, adapter).adapted


@pytest.mark.parametrize("name", OTHER)
def test_another_base_is_told_apart_and_how(name, folder, base_dir, adapter):
    change, said = OTHER[name]
    change(folder)
    assert weights_difference(weights_revision(base_dir), weights_revision(folder)) == said
    with pytest.raises(ValueError, match=rf"whose weights are not those of base {folder}: {said}; --accept-base"):
        DepthModel.from_pretrained(folder, adapter)
    if name != "a name":  # else the model itself does not load as it was
        with pytest.warns(UserWarning, match=said):
            assert DepthModel.from_pretrained(folder, adapter, accept_base=True).adapted


def test_half_precision_is_compared_as_it_is_loaded(folder, tmp_path):
    half = AutoModelForDepthEstimation.from_pretrained(folder, dtype=torch.bfloat16)
    half.save_pretrained(tmp_path / "half")
    half.float().save_pretrained(tmp_path / "full")
    revisions = [weights_revision(place) for place in (tmp_path / "half", tmp_path / "full", folder)]
    assert revisions[0] == revisions[1] != revisions[2]


def test_an_adapter_of_an_earlier_version_is_still_compared(base_dir, adapter, folder, tmp_path):
    old = shutil.copytree(adapter, tmp_path / "old")
    edit(old / "gift.json", lambda gift: {**gift, "base_revision": earlier_revision(base_dir)})
    resave(folder)
    assert DepthModel.from_pretrained(base_dir, old).adapted
    assert DepthModel.from_pretrained(folder, old).adapted  # the folder that it names is still there
    edit(old / "adapter_config.json", lambda config: {**config, "base_model_name_or_path": "/gone/base"})
    assert DepthModel.from_pretrained(base_dir, old).adapted
    (folder / "pytorch_model.bin").write_bytes(b"0")
    with pytest.raises(ValueError, match=r"does not say what was in them; --accept-base"):
        DepthModel.from_pretrained(folder, old)


def test_a_copy_of_a_hub_model_is_compared_by_its_tensors(base_dir, adapter, folder, tmp_path):
    hub = shutil.copytree(adapter, tmp_path / "hub")
    edit(hub / "adapter_config.json", lambda config: {**config, "base_model_name_or_path": "owner/net"})
    edit(hub / "gift.json", lambda gift: {"base_revision": "a" * 40, "base_weights": weights_revision(base_dir)})
    assert DepthModel.from_pretrained(folder, hub).adapted
    OTHER["one value"][0](folder)
    with pytest.raises(ValueError, match=r"trained on owner/net, .*its tensors have other values"):
        DepthModel.from_pretrained(folder, hub)


def test_weights_that_cannot_be_read_are_one_line(folder):
    (folder / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"^base model .*copy: its weights cannot be read \([^\n]+$"):
        weights_revision(folder)
    (folder / "model.safetensors").unlink()
    (folder / "pytorch_model.bin").write_bytes(pickle.dumps(print))
    with pytest.raises(ValueError, match=r"^base model .*copy: [^\n]+$"):
        weights_revision(folder)
    (folder / "pytorch_model.bin").unlink()
    (folder / "model.safetensors.index.json").write_text('{"weight_map": {"a": "gone.safetensors"}}')
    with pytest.raises(FileNotFoundError, match=r"gone\.safetensors"):
        weights_revision(folder)
    (folder / "config.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"the folder has no config\.json"):
        weights_revision(folder)


# ---- where the base is ----


@pytest.fixture
def place(base_dir, tmp_path, monkeypatch):
    """`demo/base` and `demo/adapter`, which names its base by the path demo/base; from another folder."""
    shutil.copytree(base_dir, tmp_path / "work/demo/base")
    gift = {"base_revision": weights_revision(base_dir), "kind": "inverse_depth"}
    monkeypatch.chdir(tmp_path / "work")
    with pytest.warns(UserWarning, match="local folder"):
        save_adapter(
            trained(get_gift_model(tiny_model())),
            "demo/adapter",
            "demo/base",
            processor=tiny_processor(),
            size=SIZE,
            gift=gift,
        )
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return tmp_path / "work/demo"


def test_the_base_is_taken_from_the_adapter_wherever_one_stands(place, monkeypatch, recwarn):
    for base in (None, "demo/base"):
        with pytest.warns(UserWarning, match=rf"base model demo/base: taken from {place}/base"):
            assert DepthModel.from_pretrained(base, place / "adapter").adapted
    monkeypatch.chdir(place.parent)
    recwarn.clear()
    assert DepthModel.from_pretrained(adapter="demo/adapter").adapted
    assert not [warning for warning in recwarn if "taken from" in str(warning.message)]


def test_a_renamed_run_finds_its_base_and_no_wrong_one(place):
    moved = place.rename(place.parent / "kept run")
    with pytest.warns(UserWarning, match="taken from .*kept run/base"):
        assert DepthModel.from_pretrained(adapter=moved / "adapter").adapted
    shutil.rmtree(moved / "base")
    write_base(moved / "base", seed=3)
    with pytest.warns(UserWarning, match="taken from"), pytest.raises(ValueError, match="other values"):
        DepthModel.from_pretrained(adapter=moved / "adapter")
    shutil.rmtree(moved / "base")
    with pytest.raises(FileNotFoundError, match="base model demo/base"):
        DepthModel.from_pretrained(adapter=moved / "adapter")
    with pytest.raises(ValueError, match="a base model or an adapter is needed"):
        DepthModel.from_pretrained()


def test_a_run_or_a_file_in_the_place_of_an_adapter_is_told(place):
    with pytest.raises(FileNotFoundError, match=rf"this is a run, whose adapter is {place}/adapter"):
        DepthModel.from_pretrained(place / "base", place)
    with pytest.raises(FileNotFoundError, match=rf"name the folder, {place}/adapter, not a file in it"):
        DepthModel.from_pretrained(place / "base", place / "adapter/adapter_model.safetensors")


def test_an_adapter_in_the_place_of_a_base_says_what_to_do(place):
    for folder in (place / "adapter", shutil.copytree(place / "base", place / "both")):
        if folder.name == "both":
            shutil.copytree(place / "adapter", folder, dirs_exist_ok=True)
            edit(folder / "adapter_config.json", lambda c: {**c, "base_model_name_or_path": str(place / "base")})
        with pytest.raises(ValueError, match=r"this is an adapter\. .*merge_and_unload") as error:
            DepthModel.from_pretrained(folder)
        assert "\n" not in str(error.value)
