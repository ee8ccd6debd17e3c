"""MoGe as a transformers model: the package's own forward, the camera's shift, checkpoints of another kind."""

import copy
import sys

import numpy as np
import pytest
import torch
from helpers.backbones import images
from helpers.moge import NETWORKS, pinhole, tiny_moge, tiny_network, tiny_vit
from hypothesis import given, settings
from hypothesis import strategies as st
from transformers import AutoImageProcessor, AutoModelForDepthEstimation, pipeline

from gift_peft import get_gift_model
from gift_peft.cli import main
from gift_peft.models.convert import convert_moge
from gift_peft.models.loading import DepthModel
from gift_peft.models.moge import MogeConfig, MogeForDepthEstimation, MogeImageProcessorPil
from gift_peft.models.moge.configuration_moge import VARIANTS
from gift_peft.models.moge.geometry_moge import recover_shift
from gift_peft.models.moge.package_moge import INSTALL
from gift_peft.training.speed import checkpoint_blocks, compile_blocks

__all__ = ["tiny_vit"]  # a fixture

SIZES = [(70, 98), (28, 28), (97, 55)]


# ---- the package's own forward ----


@pytest.mark.parametrize("name", NETWORKS)
def test_it_is_the_packages_own_forward(name, tiny_vit):
    network, model = tiny_network(name), tiny_moge(name=name)
    threshold = network.mask_threshold if name == "v1" else 0.5
    for size in SIZES:
        pixels = images(2, 3, *size)
        for tokens in (16, 40):
            with torch.no_grad():
                theirs, ours = network.forward(pixels, tokens), model(pixels, num_tokens=tokens)
            torch.testing.assert_close(ours.points, theirs["points"], rtol=1e-6, atol=1e-6)
            assert torch.equal(ours.valid_mask, (theirs["mask"] > threshold) & ours.valid_mask)
            assert ours.predicted_depth.shape == (2, *size) and ours.predicted_depth.isfinite().all()
            scale = theirs.get("metric_scale", torch.ones(2))
            depth = (theirs["points"][..., 2] + ours.shift[:, None, None]) * scale[:, None, None]
            torch.testing.assert_close(ours.predicted_depth, depth, rtol=1e-6, atol=1e-6)
            assert (ours.normals is None) == ("normal" not in theirs)
            if ours.normals is not None:
                torch.testing.assert_close(ours.normals, theirs["normal"], rtol=1e-6, atol=1e-6)
    with torch.no_grad():
        most = network.num_tokens_range[1]
        assert torch.equal(model(pixels).points, model(pixels, num_tokens=int(most)).points)


def test_a_grid_of_tokens_stands_for_their_number(tiny_vit):
    model, pixels = tiny_moge(), images(2, 3, 70, 98)
    with torch.no_grad():
        theirs, ours = model(pixels, num_tokens=24), model(pixels, token_grid=(4, 6))  # 24 / 1.4 and 24 * 1.4
        other = model(pixels, token_grid=(6, 4))
    assert torch.equal(ours.predicted_depth, theirs.predicted_depth)
    assert torch.equal(ours.metric_scale, theirs.metric_scale)
    assert not torch.allclose(other.predicted_depth, theirs.predicted_depth, rtol=1e-3)
    with pytest.raises(ValueError, match="token_grid must be positive"):
        model(pixels, token_grid=(0, 6))
    with pytest.raises(ValueError, match="token_grid: the first version"):
        tiny_moge(name="v1")(pixels, token_grid=(4, 6))


@pytest.mark.parametrize("name", ["v1", "v2"])
def test_depth_is_that_of_its_infer(name, tiny_vit, monkeypatch):
    import scipy.optimize

    solve = scipy.optimize.least_squares
    monkeypatch.setattr(
        scipy.optimize,
        "least_squares",
        lambda fn, x0, ftol, method: solve(fn, x0=x0, ftol=1e-15, xtol=1e-15, gtol=1e-15, method=method),
    )
    model = tiny_moge(name=name)
    points, _, _ = pinhole(3, 70, 98)
    output = {"points": points.float(), "mask": torch.rand(2, 70, 98)}
    if name != "v1":
        output["metric_scale"] = torch.tensor([0.7, 2.5])

    def forward(image, num_tokens):
        return {key: value.clone() for key, value in output.items()}

    model.network.forward = forward  # what the package's infer calls as well
    with torch.no_grad():
        ours = model(images(2, 3, 70, 98))
    theirs = model.network.infer(images(2, 3, 70, 98), apply_mask=False, use_fp16=False)
    torch.testing.assert_close(ours.predicted_depth, theirs["depth"], rtol=1e-5, atol=1e-5)
    assert torch.equal(ours.valid_mask, theirs["mask"])


def test_the_released_sizes_without_weights(tiny_vit):
    published = dict(zip(VARIANTS, (314, 326, 331, 104, 35), strict=True))  # millions
    for name in VARIANTS:
        with torch.device("meta"):
            model = MogeForDepthEstimation(MogeConfig(variant=name))
        assert abs(sum(weight.numel() for weight in model.parameters()) / 1e6 - published[name]) < 1, name
        keys = set(model.state_dict())
        prefix = "network.backbone." if name == "moge-vitl" else "network.encoder.backbone."
        assert {f"{prefix}pos_embed", f"{prefix}blocks.11.attn.qkv.weight"} <= keys
        assert any(key.startswith("network.normal_head.") for key in keys) == name.endswith("normal")
        assert model.config.depth_estimation_type == ("affine" if name == "moge-vitl" else "metric")


# ---- the shift ----


def test_the_shift_of_a_pinhole_camera():
    points, focal, shift = pinhole(0)
    found = recover_shift(points)
    np.testing.assert_allclose(found[0], focal, rtol=1e-9)
    np.testing.assert_allclose(found[1], shift, rtol=1e-9, atol=1e-9)
    mask = torch.zeros(points.shape[:3], dtype=torch.bool)
    mask[:, 10:30, 5:40] = True
    np.testing.assert_allclose(recover_shift(points, mask)[1], shift, rtol=1e-7, atol=1e-7)
    damaged = torch.where(mask[..., None], points, 50 * torch.randn_like(points))
    np.testing.assert_allclose(recover_shift(damaged, mask)[1], shift, rtol=1e-7, atol=1e-7)
    nothing = recover_shift(points, torch.zeros_like(mask))
    assert nothing[0].tolist() == [1, 1] and nothing[1].tolist() == [0, 0]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(-1, 3), st.floats(0.05, 20))
def test_the_shift_follows_a_move_along_z_and_a_scale(seed, move, scale):
    points, _, _ = pinhole(seed, count=1)
    points = points + 0.02 * torch.from_numpy(np.random.default_rng(seed).normal(size=points.shape))
    shift = recover_shift(points)[1]
    moved = points.clone()
    moved[..., 2] -= move
    torch.testing.assert_close(recover_shift(moved)[1], shift + move, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(recover_shift(points * scale)[1], shift * scale, rtol=1e-7, atol=1e-9)


def test_gradients_flow_through_the_shift():
    points = pinhole(5, 6, 8, 1)[0]
    points = (points + 0.05 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))).requires_grad_()
    mask = torch.rand(1, 6, 8, generator=torch.Generator().manual_seed(1)) < 0.8
    assert torch.autograd.gradcheck(lambda p: recover_shift(p, mask)[1], points, rtol=1e-3, atol=1e-4)


# ---- as a model of transformers ----


def test_saved_and_loaded_it_is_the_same(tiny_vit, tmp_path):
    model = tiny_moge(num_tokens=24)
    model.save_pretrained(tmp_path)
    MogeImageProcessorPil().save_pretrained(tmp_path)
    loaded = AutoModelForDepthEstimation.from_pretrained(tmp_path)
    assert type(loaded) is MogeForDepthEstimation and loaded.config.num_tokens == 24
    assert loaded.state_dict().keys() == model.state_dict().keys()
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in model.state_dict().items())
    pixels = images(1, 3, 60, 80)
    with torch.no_grad():
        assert torch.equal(loaded(pixels).predicted_depth, model(pixels, num_tokens=24).predicted_depth)
    processor = AutoImageProcessor.from_pretrained(tmp_path, backend="pil")
    assert type(processor) is MogeImageProcessorPil and not processor.do_normalize
    estimate = pipeline("depth-estimation", model=str(tmp_path), image_processor=processor)
    from PIL import Image

    picture = Image.fromarray((255 * pixels[0].permute(1, 2, 0)).byte().numpy())
    assert estimate(picture)["predicted_depth"].shape == (60, 80)
    depth_model = DepthModel.from_pretrained(tmp_path)
    assert (depth_model.size, depth_model.kind, depth_model.millimeters_per_unit) == ((476, 644), "depth", 1000)
    assert DepthModel(tiny_moge(name="v1"), processor).millimeters_per_unit == 1
    np.testing.assert_allclose(depth_model.depth_at(picture), estimate(picture)["predicted_depth"], rtol=1e-5)


def test_what_it_does_not_take(tiny_vit):
    model = tiny_moge()
    for pixels, match in (
        (torch.rand(3, 28, 28), r"must be \(B, 3, H, W\)"),
        (torch.zeros(1, 3, 28, 28, dtype=torch.uint8), "floats from 0 to 1"),
    ):
        with pytest.raises(ValueError, match=match):
            model(pixels)
    with pytest.raises(ValueError, match="num_tokens must be positive"):
        model(torch.rand(1, 3, 28, 28), num_tokens=-4)
    with pytest.raises(NotImplementedError, match="leave labels out"):
        model(torch.rand(1, 3, 28, 28), labels=torch.rand(1, 28, 28))
    with pytest.raises(ValueError, match="variant must be one of moge-vitl"):
        MogeConfig(variant="moge-9")
    with pytest.raises(ValueError, match="it names no encoder"):
        MogeConfig(network={"neck": {}})


@pytest.mark.parametrize(("name", "saved"), [("v1", {"head"}), ("v2-normal", {"neck", "points_head", "scale_head"})])
def test_the_recipe_leaves_mask_and_normals_frozen(name, saved, tiny_vit):
    model = get_gift_model(tiny_moge(name=name))
    trained = {key.split("network.")[1] for key, weight in model.named_parameters() if weight.requires_grad}
    blocks = {key for key in trained if "lora_" in key}
    assert len(blocks) == 3 * 2 * 2 and all(".attn.qkv." in key or ".attn.proj." in key for key in blocks)
    heads = {key.split(".modules_to_save.")[0] for key in trained - blocks}
    projections = {"encoder.output_projections.0", "encoder.output_projections.1"} if name != "v1" else set()
    assert heads == saved | projections
    pixels = images(1, 3, 42, 56)
    with torch.no_grad():
        base = tiny_moge(name=name)(pixels)
        assert torch.equal(model(pixels).predicted_depth, base.predicted_depth)
        with model.disable_adapter():
            assert torch.equal(model(pixels).predicted_depth, base.predicted_depth)


@pytest.mark.parametrize("name", ["v1", "v2-normal"])
def test_its_blocks_are_computed_again_or_compiled(name, tiny_vit, monkeypatch):
    pixels = images(2, 3, 42, 56)

    def step(change):
        torch.manual_seed(0)
        model = get_gift_model(tiny_moge(name=name), rank=2)
        change(model)
        kept = []
        with torch.autograd.graph.saved_tensors_hooks(lambda x: kept.append(x.numel()) or x, lambda x: x):
            depth = model(pixel_values=pixels).predicted_depth
        depth.mean().backward()
        return depth, {key: own.grad for key, own in model.named_parameters() if own.grad is not None}, sum(kept)

    depth, gradients, kept = step(lambda model: None)
    assert any(gradient.any() for key, gradient in gradients.items() if "lora_" in key)
    again, others, fewer = step(checkpoint_blocks)
    assert torch.equal(again, depth) and others.keys() == gradients.keys() and fewer < kept
    assert all(torch.equal(others[key], own) for key, own in gradients.items())
    assert tiny_moge(name=name).supports_gradient_checkpointing
    real = torch.compile
    monkeypatch.setattr(torch, "compile", lambda function, **options: real(function, backend="eager", **options))
    torch.testing.assert_close(step(compile_blocks)[0], depth)


# ---- official checkpoints ----


def checkpoint(name="v2-normal"):
    return {"model_config": copy.deepcopy(NETWORKS[name]), "model": tiny_network(name).state_dict()}


def test_convert_writes_a_folder_of_a_checkpoint(tiny_vit, tmp_path, capsys):
    torch.save(checkpoint(), tmp_path / "model.pt")
    with pytest.raises(SystemExit, match="0"):
        main(["convert", "moge", str(tmp_path / "model.pt"), str(tmp_path / "new"), "--num-tokens", "20"])
    assert "Model: " in capsys.readouterr().out
    pixels = images(1, 3, 42, 56)
    with torch.no_grad():
        expected = tiny_moge()(pixels, num_tokens=20).predicted_depth
        assert torch.equal(
            AutoModelForDepthEstimation.from_pretrained(tmp_path / "new")(pixels).predicted_depth, expected
        )
    with pytest.raises(SystemExit, match="2"):
        main(["convert", "vggt", "x", str(tmp_path / "other"), "--num-tokens", "20"])


def test_other_files_are_named(tiny_vit, tmp_path):
    def refused(content, match, error=ValueError):
        torch.save(content, tmp_path / "model.pt")
        with pytest.raises(error, match=match):
            convert_moge(tmp_path / "model.pt", tmp_path / "new")
        assert not (tmp_path / "new").exists()

    whole = checkpoint()
    refused(whole | {"model": checkpoint("v1")["model"]}, r"model\.pt: .* is missing; .*another version than v2\?")
    refused(whole | {"model_config": NETWORKS["v1"]}, r"is missing; .*another version than v1\?")
    wider = whole["model"] | {"neck.input_blocks.0.weight": torch.zeros(2, 2, 1, 1)}
    refused(whole | {"model": wider}, r"neck\.input_blocks\.0\.weight has shape \(2, 2, 1, 1\), the network has")
    broken = {key: value.clone() for key, value in whole["model"].items()}
    broken["scale_head.0.bias"][0] = torch.nan
    refused(whole | {"model": broken}, r"scale_head\.0\.bias holds NaN")
    refused({"state_dict": {}}, "has no weights under `model`")
    refused({"model": whole["model"]}, "states no sizes under `model_config`")
    refused([1, 2], "holds a list")
    refused(whole | {"model_config": whole["model_config"] | {"neck": {}}}, "no MoGe v2 network has these sizes")
    (tmp_path / "model.pt").write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(ValueError, match="truncated, or not a torch file"):
        convert_moge(tmp_path / "model.pt", tmp_path / "new")
    with pytest.raises(FileNotFoundError, match="no such"):
        convert_moge(tmp_path / "none.pt", tmp_path / "new")
    with pytest.warns(UserWarning, match="1 tensors have no place in the network"):
        MogeForDepthEstimation.from_official(whole | {"model": whole["model"] | {"extra": torch.zeros(1)}})


def test_a_missing_package_is_one_line_with_its_command(monkeypatch, tmp_path):
    MogeConfig(variant="moge-2-vits-normal").save_pretrained(tmp_path)
    for name in ("moge.model.v2", "moge.model", "moge"):
        monkeypatch.setitem(sys.modules, name, None)  # as if it were not installed
    with pytest.raises(ValueError, match="in another package, which is missing") as error:
        MogeForDepthEstimation(MogeConfig())
    assert INSTALL in str(error.value) and "\n" not in str(error.value)
    (tmp_path / "model.safetensors").write_bytes(b"")
    with pytest.raises(ValueError, match="dlr-moge"):
        DepthModel.from_pretrained(tmp_path)
    with pytest.raises(ValueError, match="dlr-moge"):
        convert_moge("Ruicheng/moge-2-vitl-normal", tmp_path / "new")


@pytest.mark.parametrize("name", ["v1", "v2-normal"])
def test_it_exports_to_onnx(name, tiny_vit, tmp_path):
    pytest.importorskip("onnxscript", reason="onnxscript is not installed")
    runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    model = tiny_moge(name=name)

    class Depth(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.model = model

        def forward(self, pixel_values):
            return self.model(pixel_values=pixel_values).predicted_depth

    for size in ((42, 56), (70, 98)):
        pixels = images(1, 3, *size)
        path = tmp_path / f"{size[0]}.onnx"
        torch.onnx.export(
            Depth().eval(), (pixels,), str(path), input_names=["pixel_values"], dynamo=True, verbose=False
        )
        session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        other = images(1, 3, *size, seed=5)
        with torch.no_grad():
            expected = model(other).predicted_depth
        found = session.run(None, {"pixel_values": other.numpy()})[0]
        np.testing.assert_allclose(found, expected.numpy(), rtol=2e-4, atol=2e-4)
