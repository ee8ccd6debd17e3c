"""Metric3D V2 as a transformers model: saved and loaded, checkpointed, compiled, from official files; its config."""

import copy
import math

import pytest
import torch
from helpers.backbones import METRIC3D, metric3d_golden, saved_forms, tiny_metric3d
from safetensors.torch import load_file, save_file

from gift_peft.models.metric3d import Metric3DConfig, Metric3DForDepthEstimation

DEPTH, CONFIDENCE, NORMAL = 2e-3, 5e-5, 1e-4


@pytest.fixture(scope="module")
def weights():
    """(official weights, config) of the giant2-style golden; not to be changed."""
    return metric3d_golden()[1:]


def images(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def close(actual, expected, tolerance):
    assert actual.shape == expected.shape
    assert (actual - expected).abs().max() <= tolerance


# ---- as a transformers model ----


@pytest.mark.parametrize("train", [False, True])
def test_saved_and_loaded_model_is_equal_to_the_bit(tmp_path, train, weights):
    model = Metric3DForDepthEstimation.from_official(*weights).train(train)
    model.save_pretrained(tmp_path)
    loaded = Metric3DForDepthEstimation.from_pretrained(tmp_path).train(train)
    assert loaded.config.to_diff_dict() == model.config.to_diff_dict()
    assert set(load_file(tmp_path / "model.safetensors")) == set(model.state_dict())
    assert not any(".downsample.1." in key for key in model.state_dict())
    for one, other in (
        (model.state_dict(), loaded.state_dict()),
        (dict(model.named_buffers()), dict(loaded.named_buffers())),
    ):
        assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)
    with torch.no_grad():
        one, other = model(images(1, 3, 42, 56)), loaded(images(1, 3, 42, 56))
    assert one.keys() == other.keys()
    for key in ("predicted_depth", "confidence", "normals"):
        assert torch.equal(one[key], other[key])


def test_new_models_are_finite():
    torch.manual_seed(0)
    model = Metric3DForDepthEstimation(Metric3DConfig(**METRIC3D))
    output = model(images(1, 3, 28, 28))
    output.predicted_depth.sum().backward()
    assert all(torch.isfinite(p).all() for p in model.parameters())
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)
    assert torch.isfinite(output.predicted_depth).all()


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (torch.zeros(0, 3, 28, 28), "empty"),
        (torch.zeros(1, 1, 28, 28), r"\(B, 3, H, W\)"),
        (torch.zeros(3, 28, 28), r"\(B, 3, H, W\)"),
        (torch.zeros(1, 3, 28, 28, dtype=torch.uint8), "uint8"),
        (torch.zeros(1, 3, 13, 28), "13x28"),
    ],
)
def test_wrong_inputs_are_named(pixels, message):
    with pytest.raises(ValueError, match=message):
        tiny_metric3d()(pixels)


def test_labels_are_refused_and_tuples_returned():
    model = tiny_metric3d()
    with pytest.raises(NotImplementedError, match="labels"):
        model(images(1, 3, 28, 28), labels=torch.zeros(1, 28, 28))
    depth, confidence, normals = model(images(1, 3, 28, 28), return_dict=False)
    assert depth.shape == confidence.shape == (1, 28, 28) and normals.shape == (1, 4, 28, 28)


def test_activation_checkpointing_changes_no_gradient():
    plain = tiny_metric3d().train()
    checkpointed = copy.deepcopy(plain)
    checkpointed.activation_checkpointing_enable()
    flagged = [m for m in checkpointed.modules() if getattr(m, "gradient_checkpointing", False)]
    assert len(flagged) == METRIC3D["depth"] + 1  # encoder blocks and the recurrent update
    for model in (plain, checkpointed):
        model(images(2, 3, 28, 42)).predicted_depth.mean().backward()
    for one, other in zip(plain.parameters(), checkpointed.parameters(), strict=True):
        assert (one.grad is None) == (other.grad is None)
        if one.grad is not None:
            close(other.grad, one.grad, 1e-5 * one.grad.abs().max() + 1e-12)


def test_attention_is_sdpa(monkeypatch):
    calls = []
    original = torch.nn.functional.scaled_dot_product_attention
    monkeypatch.setattr(
        torch.nn.functional,
        "scaled_dot_product_attention",
        lambda *args, **kwargs: calls.append(args[0].shape) or original(*args, **kwargs),
    )
    model = tiny_metric3d()
    model(images(1, 3, 28, 28))
    assert model.config._attn_implementation == "sdpa"
    assert calls == [(1, 2, 1 + 1 + 4, 12)] * METRIC3D["depth"]


def test_bf16_autocast_keeps_depth_in_float32():
    model = tiny_metric3d()
    pixels = images(2, 3, 42, 56)
    with torch.no_grad():
        exact = model(pixels).predicted_depth
        with torch.autocast("cpu", torch.bfloat16):
            output = model(pixels)
    assert output.predicted_depth.dtype == torch.float32 and output.normals.dtype == torch.float32
    error = (output.predicted_depth - exact).abs().mean()
    assert 0 < error < 0.2 * exact.std()
    model(pixels.requires_grad_())
    with torch.autocast("cpu", torch.bfloat16):
        model.train()(pixels).predicted_depth.mean().backward()
    assert all(
        p.grad.dtype == torch.float32 and p.grad.isfinite().all() for p in model.parameters() if p.grad is not None
    )


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_other_dtypes(dtype):
    model = tiny_metric3d().to(dtype)
    with torch.no_grad():
        depth = model(images(1, 3, 30, 42).to(dtype)).predicted_depth
    assert depth.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    assert torch.isfinite(depth).all()


def test_encoder_blocks_compile_without_graph_breaks():
    model = tiny_metric3d()
    pixels = images(1, 3, 28, 42)
    with torch.no_grad():
        expected = model(pixels).predicted_depth
        for block in model.depth_model.encoder.blocks[0]:
            block.compile(fullgraph=True, backend="eager")
        close(model(pixels).predicted_depth, expected, DEPTH)


def test_export_leaves_the_batch_free():
    model = tiny_metric3d(iters=1)
    batch = torch.export.Dim("batch", min=1, max=8)
    with torch.no_grad():
        program = torch.export.export(model, (images(2, 3, 28, 28),), dynamic_shapes=({0: batch},))
        assert program.module()(images(3, 3, 28, 28)).predicted_depth.shape == (3, 28, 28)


# ---- configuration ----


def test_config_takes_sizes_beside_a_variant():
    config = Metric3DConfig(
        variant="large",
        embed_dim=1536,
        **{key: METRIC3D[key] for key in ("iters",)},
        num_heads=24,
        feature_channels=[8, 12, 1536, 1536],
        decoder_channels=[4, 8, 12, 1536, 1536],
    )
    assert (config.depth, config.iters, config.swiglu_hidden) == (24, 2, None)
    assert Metric3DConfig.from_dict(config.to_dict()).to_dict() == config.to_dict()
    assert Metric3DConfig().swiglu_hidden == 4096 and Metric3DConfig(variant="small").iters == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"variant": "huge"}, "variant must be one of small, large, giant2"),
        ({"num_heads": 5}, "num_heads"),
        ({"feature_channels": [8, 12, 20, 24]}, r"feature_channels\[2\] and embed_dim"),
        ({"hidden_channels": [6, 10, 7, 6]}, r"hidden_channels\[0\]"),
        ({"decoder_channels": [4, 8]}, "5 entries"),
        ({"n_gru_layers": 2}, "n_gru_layers must be 3"),
        ({"variant": "giant2", "depth": 6}, "quarter"),
        ({"depth_min": 0.0}, "depth_min"),
    ],
)
def test_impossible_sizes_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Metric3DConfig(**{**METRIC3D, **change})


# ---- official checkpoints ----


def test_official_forms_are_one_model(tmp_path, weights):
    state, config = weights
    expected = Metric3DForDepthEstimation.from_official(state, config)
    lean = {key: value for key, value in state.items() if "mask_token" not in key and "encoder.norm." not in key}
    once = {key: value for key, value in state.items() if ".norm3." not in key}  # only under the second name
    torch.save(
        {"model_state_dict": {f"module.{key}": value for key, value in state.items()}, "epoch": 3}, tmp_path / "a.pth"
    )
    torch.save(lean, tmp_path / "b.pt", _use_new_zipfile_serialization=False)
    save_file(once, tmp_path / "c.safetensors")
    for source in (
        tmp_path / "a.pth",
        str(tmp_path / "b.pt"),
        tmp_path / "c.safetensors",
        {"state_dict": state},
        lean,
    ):
        model = Metric3DForDepthEstimation.from_official(source, config)
        assert not model.training and next(model.parameters()).dtype == torch.float32
        for name, value in expected.depth_model.decoder.named_parameters():
            assert torch.equal(model.depth_model.decoder.get_parameter(name), value)
        with torch.no_grad():
            assert torch.equal(
                model(images(1, 3, 28, 28)).predicted_depth, expected(images(1, 3, 28, 28)).predicted_depth
            )
    assert not any(p.is_meta for p in model.parameters())
    model.depth_model.encoder.cls_token.data.add_(1)  # a copy: the caller's tensors stay as they are
    assert torch.equal(expected.depth_model.encoder.cls_token, state["depth_model.encoder.cls_token"])


class Payload:
    def __reduce__(self):
        return print, ("executed",)


def test_bad_checkpoints_end_in_one_clear_error(tmp_path, weights, capsys):
    state, config = weights
    large = metric3d_golden("golden_vitl_style")[2]
    good = tmp_path / "good.safetensors"
    save_file({key: value for key, value in state.items() if ".downsample.1." not in key}, good)
    torch.save(state, tmp_path / "good.pth")
    files = {
        "cut.safetensors": (good.read_bytes()[:100_000], "cut.safetensors: truncated"),
        "cut.pth": ((tmp_path / "good.pth").read_bytes()[:100_000], "cut.pth: truncated"),
        "empty.pth": (b"", "empty.pth: truncated"),
        "page.pth": (b"<!DOCTYPE html><html>404</html>", "page.pth: truncated, or neither"),
    }
    for name, (content, message) in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=message) as caught:
            Metric3DForDepthEstimation.from_official(tmp_path / name, config)
        assert "\n" not in str(caught.value)
    torch.save({"depth_model": Payload()}, tmp_path / "code.pth")
    with pytest.raises(ValueError, match=r"code\.pth: refused"):
        Metric3DForDepthEstimation.from_official(tmp_path / "code.pth", config)
    assert "executed" not in capsys.readouterr().out
    with pytest.raises(FileNotFoundError, match=r"nothing\.pth: no such checkpoint"):
        Metric3DForDepthEstimation.from_official(tmp_path / "nothing.pth", config)
    with pytest.raises(ValueError, match="is a folder"):
        Metric3DForDepthEstimation.from_official(tmp_path, config)
    token, bias = "depth_model.encoder.cls_token", "depth_model.decoder.update_block.mask.2.bias"
    twice = next(key for key in state if ".downsample.1." in key)
    cases = [
        ({"conv1.weight": torch.zeros(2)}, config, "not a Metric3D V2 .* first entry is 'conv1.weight'"),
        ({}, config, "not a Metric3D V2"),
        (state, large, rf"{token} has shape \(1, 1, 40\), the config asks for \(1, 1, 32\); .* variant than large"),
        (state, None, rf"{token} has shape \(1, 1, 40\), which is none of small, large, giant2"),
        ({key: value for key, value in state.items() if key != bias}, config, f"{bias} is missing"),
        ({**state, "depth_model.more": torch.zeros(1)}, config, "depth_model.more has no place"),
        ({**state, bias: state[bias].int()}, config, f"{bias} holds torch.int32"),
        ({**state, token: torch.tensor(1.0)}, None, "which is none of small, large, giant2"),
        ({**state, bias: 3.0}, config, f"{bias} is a float"),
        ({**state, twice: state[twice] + 1}, config, f"{twice} and .* different values"),
    ]
    for tensors, sizes, message in cases:
        with pytest.raises(ValueError, match=message):
            Metric3DForDepthEstimation.from_official(tensors, sizes)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_weights_that_are_not_finite_are_refused(weights, tmp_path, value):
    state, config = weights
    name = "depth_model.decoder.update_block.mask.2.bias"
    bias = state[name].double()
    bias[-1] = value
    once = {key: tensor for key, tensor in state.items() if ".downsample.1." not in key}
    for where, source in saved_forms(once | {name: bias}, tmp_path).items():
        with pytest.raises(ValueError) as error:
            Metric3DForDepthEstimation.from_official(source, config)
        assert str(error.value) == f"{where}: {name} holds NaN or infinite values (in float32)"


def test_nan_in_a_parameter_that_is_stored_twice_is_no_difference(weights):
    state, config = weights
    twice = next(key for key in state if ".downsample.1." in key)
    broken = torch.full_like(state[twice], math.nan)
    with pytest.raises(ValueError, match=rf"the given dict: {twice} holds NaN"):
        Metric3DForDepthEstimation.from_official(
            state | {twice: broken, twice.replace("downsample.1", "norm3"): broken}, config
        )


def test_a_tensor_with_and_without_the_prefix_is_refused(weights, tmp_path):
    state, config = weights
    name = "depth_model.decoder.update_block.mask.2.bias"
    once = {key: tensor for key, tensor in state.items() if ".downsample.1." not in key}
    for where, source in saved_forms(once | {f"module.{name}": state[name] + 1}, tmp_path).items():
        with pytest.raises(ValueError, match=rf"(module\.)?{name} and (module\.)?{name} are two tensors") as error:
            Metric3DForDepthEstimation.from_official(source, config)
        assert str(error.value).startswith(f"{where}: ") and "\n" not in str(error.value)


@pytest.mark.parametrize("value", ["text", [1], None, 3], ids=repr)
def test_an_entry_that_is_no_tensor_is_named(weights, value):
    state, config = weights
    kind, twice = type(value).__name__, next(key for key in state if ".downsample.1." in key)
    unused = [f"depth_model.encoder.{name}" for name in ("mask_token", "norm.bias", "cls_token")]
    for name in (*unused, twice, twice.replace("downsample.1", "norm3"), "depth_model.more", "model"):
        broken = state | {name: value}
        prefixed = {f"module.{key}": entry for key, entry in broken.items()}
        for source, key in (
            (broken, name),
            (dict(reversed(broken.items())), name),  # the twin comes before or after it
            (prefixed, f"module.{name}"),
            ({"model": prefixed}, f"module.{name}"),
        ):
            with pytest.raises(ValueError) as error:
                Metric3DForDepthEstimation.from_official(source, config)
            assert str(error.value) == f"the given dict: {key} is a {kind}, not a tensor"
    for key in ("model_state_dict", "state_dict", "model"):
        with pytest.raises(ValueError) as error:
            Metric3DForDepthEstimation.from_official({"epoch": 3, key: value}, config)
        assert str(error.value) == f"the given dict: {key} is a {kind}, not tensors by name"
