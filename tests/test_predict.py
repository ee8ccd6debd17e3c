"""`gift-peft predict` and the loader: files written, values against transformers, and every way it can go wrong."""

import errno
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tiny import SIZE, tiny_model, tiny_processor, write_base
from PIL import Image
from transformers import DepthAnythingForDepthEstimation

from gift_peft.adapters.folder import save_adapter
from gift_peft.adapters.recipes import RECIPES, get_gift_model
from gift_peft.colormap import GREY, color_range, colorize
from gift_peft.models.identity import teacher_revision
from gift_peft.models.loading import DepthModel
from gift_peft.predict import PicturesWithoutDepth, predict_images, run


@pytest.fixture(scope="module")
def adapter_dir(tmp_path_factory, base_dir):
    """A random adapter of the tiny base, as training would leave it."""
    torch.manual_seed(0)
    model = get_gift_model(DepthModel.from_pretrained(base_dir, size=SIZE, device="cpu").network, rank=2)
    with torch.no_grad():
        for weight in model.parameters():
            if weight.requires_grad:
                weight += 0.02 * torch.randn_like(weight)
    folder = tmp_path_factory.mktemp("adapter") / "adapter"
    with pytest.warns(UserWarning, match="local"):
        save_adapter(
            model,
            folder,
            str(base_dir),
            processor=tiny_processor(),
            size=SIZE,
            gift={"base_revision": teacher_revision(base_dir), "kind": "inverse_depth"},
        )
    return folder


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.png"
    pixels = np.random.default_rng(0).integers(0, 255, (45, 61, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    return path


def test_values_are_those_of_transformers(base_dir, photo, tmp_path):
    (path,) = predict_images([photo], base_dir, out=tmp_path / "out", size=SIZE)
    processor, image = tiny_processor(), Image.open(photo)
    with torch.no_grad():
        outputs = tiny_model()(**processor(image, return_tensors="pt"))
    expected = processor.post_process_depth_estimation(outputs, [(45, 61)])[0]["predicted_depth"]
    found = np.load(path)
    assert found.shape == (45, 61) and found.dtype == np.float32
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-5)
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["photo.npy", "photo.png"]


def test_the_base_stands_beside_the_adapter(base_dir, adapter_dir, photo, tmp_path):
    out = tmp_path / "out"
    predict_images([photo], base_dir, adapter_dir, out=out)
    assert sorted(file.name for file in out.iterdir()) == [
        "photo.npy",
        "photo.png",
        "photo_base.npy",
        "photo_base.png",
    ]
    predict_images([photo], base_dir, out=tmp_path / "plain", size=SIZE)
    adapted, base = np.load(out / "photo.npy"), np.load(out / "photo_base.npy")
    np.testing.assert_array_equal(base, np.load(tmp_path / "plain" / "photo.npy"))
    assert not np.array_equal(adapted, base)
    low, high = color_range(adapted, base)
    for name, depth in (("photo", adapted), ("photo_base", base)):
        drawn = np.asarray(Image.open(out / f"{name}.png"))
        np.testing.assert_array_equal(drawn, colorize(depth, low, high, "inverse_depth"))


def test_scale_zero_is_the_base_and_one_the_adapter(base_dir, adapter_dir, photo, tmp_path):
    depths = {}
    for scale in (None, 0, 0.5, 1):
        predict_images([photo], base_dir, adapter_dir, scale, out=tmp_path / str(scale))
        depths[scale] = np.load(tmp_path / str(scale) / "photo.npy")
    np.testing.assert_array_equal(depths[0], np.load(tmp_path / "0" / "photo_base.npy"))
    np.testing.assert_array_equal(depths[1], depths[None])
    assert not np.array_equal(depths[0.5], depths[0]) and not np.array_equal(depths[0.5], depths[1])
    with pytest.raises(ValueError, match="adapter_scale needs an adapter"):
        predict_images([photo], base_dir, None, 0.5, out=tmp_path / "x", size=SIZE)


def test_loader_takes_size_and_kind_from_where_they_are_stated(base_dir, adapter_dir, tmp_path):
    loaded = DepthModel.from_pretrained(base_dir, adapter_dir)
    assert loaded.size == SIZE and loaded.kind == "inverse_depth" and not loaded.network.training
    assert DepthModel.from_pretrained(base_dir, adapter_dir, size="28x42").size == (28, 42)
    assert DepthModel.from_pretrained(base_dir).size == (476, 644)
    metric = write_base(tmp_path / "metric", depth_estimation_type="metric", max_depth=10)
    assert DepthModel.from_pretrained(metric, size=SIZE).kind == "depth"


def test_folders_duplicates_and_natural_order(base_dir, photo, tmp_path):
    for name in ("b/10.png", "b/9.png", "c/9.png", "d/9.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.open(photo).save(tmp_path / name)
    (tmp_path / "b" / "notes.txt").write_text("no picture")
    paths = predict_images(
        [tmp_path / "b", tmp_path / "c" / "9.png", tmp_path / "d"], base_dir, out=tmp_path / "out", size=SIZE
    )
    assert [path.name for path in paths] == ["9.npy", "10.npy", "9-2.npy", "9-3.npy"]
    assert all(path.is_file() and path.with_suffix(".png").is_file() for path in paths)


def test_a_picture_called_like_a_base_file_is_not_overwritten(base_dir, adapter_dir, photo, tmp_path):
    other = tmp_path / "photo_base.png"
    Image.open(photo).rotate(180).save(other)
    paths = predict_images([photo, other], base_dir, adapter_dir, out=tmp_path / "out")
    assert [path.name for path in paths] == ["photo.npy", "photo_base-2.npy"]
    assert len(list((tmp_path / "out").iterdir())) == 8


def test_exif_orientation_decides_the_size(base_dir, photo, tmp_path):
    exif = Image.Exif()
    exif[Image.ExifTags.Base.Orientation] = 6
    turned = tmp_path / "turned.png"
    Image.open(photo).save(turned, exif=exif)
    (path,) = predict_images([turned], base_dir, out=tmp_path / "out", size=SIZE)
    assert np.load(path).shape == (61, 45)


# ---- what is the user's stays ----


def pictures(folder, source, *names):
    folder.mkdir(exist_ok=True)
    for name in names:
        Image.open(source).save(folder / name)
    return folder


@pytest.mark.parametrize("way", ["folder", "link", "case"])
def test_a_photo_is_never_replaced(way, base_dir, photo, tmp_path, monkeypatch):
    folder = pictures(tmp_path / "photos", photo, "Hall.PNG" if way == "case" else "hall.png", "bath.jpg")
    (tmp_path / "link").symlink_to(folder)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    monkeypatch.setattr(DepthModel, "from_pretrained", lambda *given: pytest.fail("told before a model is loaded"))
    with pytest.raises(ValueError, match=r"(?i)all\.png would replace the input .*/hall\.png"):
        predict_images([folder], base_dir, out=tmp_path / "link" if way == "link" else folder, size=SIZE)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_only_what_predict_wrote_is_replaced(base_dir, photo, tmp_path):
    out = pictures(tmp_path / "out", photo, "photo.png")
    for name, size in (("photo.png", (45, 61)), ("photo.npy", (45, 61))):
        if name.endswith("npy"):
            (out / "photo.png").unlink()
            np.save(out / name, np.zeros(size, np.float32))
        before = (out / name).read_bytes()
        with pytest.raises(ValueError, match=rf"{name} was not written by gift-peft predict and is kept"):
            predict_images([photo], base_dir, out=out, size=SIZE)
        assert (out / name).read_bytes() == before
    (out / "photo.npy").unlink()
    (path,) = predict_images([photo], base_dir, out=out, size=SIZE)
    first = path.read_bytes()
    path.unlink()  # as a run that was killed between the two
    assert predict_images([photo], base_dir, out=out, size=SIZE)[0].read_bytes() == first
    assert predict_images([photo], base_dir, out=out, size=SIZE)[0].read_bytes() == first


# ---- bad input ----


def test_one_bad_picture_does_not_end_a_batch(base_dir, photo, tmp_path, capsys):
    folder = pictures(tmp_path / "photos", photo, "a.png", "b.png", "d.png")
    (folder / "b.png").write_bytes(b"<html>")
    (folder / "c.jpg").write_bytes(photo.read_bytes()[:300])
    argv = [str(folder), "--base", str(base_dir), "--out", str(tmp_path / "out"), "--size", "56x70"]
    assert run(argv) == 1
    printed = capsys.readouterr()
    assert printed.out == f"Depth maps written to {tmp_path / 'out'}: 2\n"
    *lines, last = [line for line in printed.err.splitlines() if line.startswith("gift-peft: ")]
    assert len(lines) == 2 and f"{folder}/b.png: " in lines[0] and f"{folder}/c.jpg: " in lines[1]
    assert last == "gift-peft: 2 of 4 pictures have no depth"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.npy", "a.png", "d.npy", "d.png"]
    with pytest.raises(PicturesWithoutDepth, match=r"2 of 4 pictures have no depth: .*b\.png.*c\.jpg") as error:
        predict_images([folder], base_dir, out=tmp_path / "out", size=SIZE)
    assert [path.name for path in error.value.paths] == ["a.npy", "d.npy"]


def test_missing_things_are_named(base_dir, adapter_dir, photo, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(FileNotFoundError, match=r"no such image: .*gone\.png \(and 1 more\)"):
        predict_images([photo, "gone.png", "too.png"], base_dir, out=out)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"no images in .*empty"):
        predict_images([tmp_path / "empty"], base_dir, out=out)
    with pytest.raises(FileNotFoundError, match=r"base model .*nowhere: no such folder"):
        predict_images([photo], tmp_path / "nowhere", out=out)
    with pytest.raises(FileNotFoundError, match=r"empty: the folder has no adapter_config\.json"):
        predict_images([photo], base_dir, tmp_path / "empty", out=out)
    with pytest.raises(FileNotFoundError, match="adapter no/such: "):
        predict_images([photo], base_dir, "no/such", out=out)
    assert not out.exists()


def test_unreadable_pictures_are_named(base_dir, photo, tmp_path):
    broken = tmp_path / "broken.png"
    broken.write_bytes(photo.read_bytes()[:500])
    with pytest.raises(ValueError, match=r"broken\.png"):
        predict_images([broken], base_dir, out=tmp_path / "out", size=SIZE)


def test_an_adapter_for_other_weights_is_refused(adapter_dir, base_dir, tmp_path):
    other = write_base(tmp_path / "other", seed=1)
    with pytest.raises(ValueError, match=r"adapter .* was trained on .*, whose weights are not those of base .*other"):
        DepthModel.from_pretrained(other, adapter_dir)
    plain = shutil.copytree(adapter_dir, tmp_path / "plain")
    (plain / "gift.json").unlink()  # as PEFT alone saves: the folder it names still tells
    with pytest.raises(ValueError, match=r"whose weights are not those of base .*other"):
        DepthModel.from_pretrained(other, plain)
    assert DepthModel.from_pretrained(base_dir, plain).size == SIZE
    moved = shutil.copytree(base_dir, tmp_path / "moved")
    assert DepthModel.from_pretrained(moved, adapter_dir).size == SIZE


def test_an_adapter_for_other_shapes_or_layers_is_refused(adapter_dir, base_dir, tmp_path):
    silent = shutil.copytree(adapter_dir, tmp_path / "silent")
    (silent / "gift.json").unlink()
    config = (silent / "adapter_config.json").read_text()
    (silent / "adapter_config.json").write_text(config.replace(str(base_dir), "a/folder/elsewhere"))
    wide = shutil.copytree(base_dir, tmp_path / "wide")
    config = tiny_model().config
    config.fusion_hidden_size = 8
    DepthAnythingForDepthEstimation(config).save_pretrained(wide)
    with pytest.raises(ValueError, match=r"adapter .*silent does not fit base .*wide: it was trained on") as error:
        DepthModel.from_pretrained(wide, silent)
    assert "\n" not in str(error.value)
    config = json.loads((silent / "adapter_config.json").read_text())
    (silent / "adapter_config.json").write_text(json.dumps(config | {"target_modules": r".*\.(fc1|fc2)"}))
    with pytest.raises(ValueError, match=r"does not fit base .*missing adapter keys"):
        DepthModel.from_pretrained(base_dir, silent)


def test_an_adapter_of_another_hub_id_is_refused(adapter_dir, base_dir, tmp_path, monkeypatch):
    from gift_peft.models import adapter_base

    hub = shutil.copytree(adapter_dir, tmp_path / "hub")
    config = json.loads((hub / "adapter_config.json").read_text())
    (hub / "adapter_config.json").write_text(json.dumps(config | {"base_model_name_or_path": "org/model-a"}))
    (hub / "gift.json").write_text(json.dumps({"base_revision": "0123abc"}))
    monkeypatch.setattr(adapter_base, "teacher_revision", lambda base, revision: "4567def")
    with pytest.raises(ValueError, match=r"trained on org/model-a, whose .* base org/model-b: it is another model on"):
        adapter_base.check_base("org/model-b", None, hub, "org/model-a", accept=False)
    adapter_base.check_base("org/model-a", None, hub, "org/model-a", accept=False)
    monkeypatch.undo()
    assert DepthModel.from_pretrained(base_dir, hub).size == SIZE  # a local copy of the hub's model


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("adapter_model.safetensors", cut, "damaged adapter_model.safetensors"),
        ("adapter_model.safetensors", Path.unlink, "the folder has no adapter_model.safetensors"),
        ("adapter_config.json", cut, "damaged adapter_config.json"),
        ("gift.json", cut, "damaged gift.json"),
        ("preprocessor_config.json", cut, "damaged preprocessor_config.json"),
    ],
)
def test_a_damaged_adapter_names_the_file(name, damage, message, adapter_dir, base_dir, tmp_path):
    broken = shutil.copytree(adapter_dir, tmp_path / "broken")
    damage(broken / name)
    with pytest.raises((ValueError, FileNotFoundError), match=rf"^adapter .*broken: {message}[^\n]*$"):
        DepthModel.from_pretrained(base_dir, broken)


def test_an_adapter_says_what_a_model_without_a_recipe_predicts(adapter_dir, base_dir, monkeypatch):
    monkeypatch.delitem(RECIPES, "depth_anything")
    assert DepthModel.from_pretrained(base_dir, size=SIZE).kind is None
    assert json.loads((adapter_dir / "gift.json").read_text())["kind"] == "inverse_depth"
    assert DepthModel.from_pretrained(base_dir, adapter_dir).kind == "inverse_depth"


def test_a_model_without_a_recipe_must_be_told_its_kind(model, monkeypatch):
    assert DepthModel(model).known_kind() == "inverse_depth"
    monkeypatch.delitem(RECIPES, "depth_anything")
    with pytest.raises(ValueError, match="no recipe says what depth_anything predicts: kind="):
        DepthModel(model).known_kind()


def test_a_full_disk_names_the_file_and_leaves_nothing(base_dir, photo, tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("gift_peft.files.os.fsync", full)
    with pytest.raises(OSError, match=r"No space left.*photo\.png"):
        predict_images([photo], base_dir, out=tmp_path / "out", size=SIZE)
    assert list((tmp_path / "out").iterdir()) == []


def test_nan_predictions_are_errors_that_name_the_picture(base_dir, photo, tmp_path):
    base = shutil.copytree(base_dir, tmp_path / "nan")
    model = tiny_model()
    with torch.no_grad():
        model.head.conv3.bias.fill_(torch.nan)
    model.save_pretrained(base)
    with pytest.raises(ValueError, match=r"photo\.png: the prediction has NaN"):
        predict_images([photo], base, out=tmp_path / "out", size=SIZE)


# ---- small pieces ----


def test_predict_takes_modules_and_functions_and_leaves_no_graph(model):
    pixels = torch.randn(3, 3, *SIZE, generator=torch.Generator().manual_seed(0))
    found = DepthModel(model).predict(pixels)
    assert found.shape == (3, *SIZE) and not found.requires_grad
    with torch.no_grad():
        np.testing.assert_array_equal(found[2].numpy(), model(pixel_values=pixels[2:]).predicted_depth[0].numpy())
    assert torch.equal(DepthModel(lambda x: x[:, 0]).predict(pixels), pixels[:, 0])
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(DepthModel(model).predict(pixels), found)


def test_colours_near_is_bright_and_unknown_is_grey():
    depth = np.array([[1.0, 2.0, 4.0, np.nan]])
    as_depth, as_disparity = (colorize(depth, 1, 4, kind)[0].astype(int) for kind in ("depth", "inverse_depth"))
    assert as_depth[0].sum() > as_depth[1].sum() > as_depth[2].sum()
    assert as_disparity[0].sum() < as_disparity[1].sum() < as_disparity[2].sum()
    assert tuple(as_depth[3]) == tuple(as_disparity[3]) == GREY
    assert (colorize(np.ones((2, 2)), 1, 1, "depth") == colorize(np.ones((2, 2)), 1, 2, "depth")).all()
    # Lightness rises along the whole map: readable without colour.
    ramp = colorize(np.linspace(0, 1, 256)[None], 0, 1, "inverse_depth")[0] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(ramp) > -0.5).all() and ramp[-1] > 4 * ramp[0]


def test_a_truncated_base_is_one_line(base_dir, tmp_path):
    base = tmp_path / "cut"
    shutil.copytree(base_dir, base)
    weights = (base / "model.safetensors").read_bytes()
    (base / "model.safetensors").write_bytes(weights[: len(weights) // 2])
    with pytest.raises(ValueError, match=r"^base model .*cut: [^\n]+$"):
        DepthModel.from_pretrained(base)
