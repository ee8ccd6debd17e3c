"""Metric3D V2 against tensors that the original computed (tests/fixtures/metric3d), and as a transformers model."""

import ast
import copy
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from transformers.modeling_outputs import DepthEstimatorOutput

import gift_peft.models.metric3d as metric3d_package
from gift_peft.data.preprocess import to_pixel_values
from gift_peft.models.metric3d import Metric3DConfig, Metric3DForDepthEstimation, Metric3DImageProcessorPil

FIXTURES = Path(__file__).parent / "fixtures" / "metric3d"
FILES = ["golden_public", "golden_vitl_style"]
DEPTH, CONFIDENCE, NORMAL, INTERMEDIATE, GRADIENT = 2e-3, 5e-5, 1e-4, 1e-4, 1e-3
TINY = {
    "variant": "small",
    "embed_dim": 24,
    "depth": 2,
    "num_heads": 2,
    "num_register_tokens": 1,
    "pos_image_size": 56,
    "feature_channels": [8, 12, 24, 24],
    "decoder_channels": [4, 8, 12, 24, 24],
    "hidden_channels": [6, 10, 6, 6],
    "iters": 2,
}


def load_golden(name):
    tensors = load_file(FIXTURES / f"{name}.safetensors")
    config = json.loads((FIXTURES / f"{name}.json").read_text())["config"]
    config.pop("seed")
    weights = {key.removeprefix("weights/"): value for key, value in tensors.items() if key.startswith("weights/")}
    return tensors, weights, Metric3DConfig(**config)


@pytest.fixture(scope="module", params=FILES)
def golden(request):
    """(all tensors of the file, the model with its weights); the model is left in eval mode."""
    tensors, weights, config = load_golden(request.param)
    return tensors, Metric3DForDepthEstimation.from_official(weights, config)


@pytest.fixture(scope="module")
def weights():
    """(official weights, config) of the giant2-style golden; not to be changed."""
    return load_golden("golden_public")[1:]


def randomize(model, seed=0):
    """Weights of fan-in scale, so that outputs depend on everything."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, value in model.named_parameters():
            scale = 1.4 / value[0].numel() ** 0.5 if value.ndim > 1 else 0.1
            value.copy_(torch.randn(value.shape, generator=generator) * scale)
            if "gamma" in name or ("norm" in name and name.endswith("weight") and value.ndim == 1):
                value.add_(1)
    return model


def tiny(**sizes):
    return randomize(Metric3DForDepthEstimation(Metric3DConfig(**{**TINY, **sizes})).eval())


def images(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def close(actual, expected, tolerance):
    assert actual.shape == expected.shape
    assert (actual - expected).abs().max() <= tolerance


# ---- the original's numbers ----


def test_outputs_equal_the_originals(golden):
    tensors, model = golden
    cases = sorted({key.split("/")[0] for key in tensors if key.endswith("/prediction")})
    assert "A" in cases and len(cases) >= 2
    for case in cases:
        with torch.no_grad():
            output = model(pixel_values=tensors[f"{case}/input"])
        assert isinstance(output, DepthEstimatorOutput)
        close(output.predicted_depth, tensors[f"{case}/prediction"].squeeze(1), DEPTH)
        close(output.confidence, tensors[f"{case}/confidence"].squeeze(1), CONFIDENCE)
        close(output.normals, tensors[f"{case}/prediction_normal"], NORMAL)
        assert output.predictions_list is None and output.low_resolution_init is None


def test_iterations_equal_the_originals_in_eval_mode(golden):
    tensors, model = golden
    with torch.no_grad():
        output = model(tensors["A/input"], output_iterations=True)
    lists = {"predictions_list": DEPTH, "confidence_list": CONFIDENCE, "normal_out_list": NORMAL}
    for name, tolerance in lists.items():
        assert len(output[name]) == model.config.iters
        stored = [key for key in tensors if key.startswith(f"A/{name}/")]
        assert stored
        for key in stored:
            close(output[name][int(key.rsplit("/", 1)[1])], tensors[key], tolerance)
    assert output.low_resolution_init == ()
    assert torch.equal(output.predictions_list[-1].squeeze(1), output.predicted_depth)


def test_train_mode_adds_the_initial_state(golden):
    tensors, model = golden
    with torch.no_grad():
        evaluated = model(tensors["A/input"], output_iterations=True)
        output = model.train()(tensors["A/input"])
        short = model(tensors["A/input"], output_iterations=False)
    model.eval()
    assert short.predictions_list is None and torch.equal(short.predicted_depth, output.predicted_depth)
    for name, tolerance in (("predictions_list", DEPTH), ("confidence_list", CONFIDENCE), ("normal_out_list", NORMAL)):
        assert len(output[name]) == model.config.iters + 1
        close(output[name][0], tensors[f"A/train/{name}/0"], tolerance)
        assert all(torch.equal(*pair) for pair in zip(output[name][1:], evaluated[name], strict=True))
    for index, tolerance in enumerate((DEPTH, CONFIDENCE, NORMAL)):
        close(output.low_resolution_init[index], tensors[f"A/train/low_resolution_init/{index}"], tolerance)


def test_intermediates_equal_the_originals(golden):
    tensors, model = golden
    seen, handles = {}, []

    def record(name, where=None):
        def hook(module, inputs, output):
            seen.setdefault(name, output)

        handles.append(model.get_submodule(f"depth_model.{where or name}").register_forward_hook(hook))

    record("encoder")
    for index in range(4):
        record(f"token2feature/read_{index}", f"decoder.token2feature.read_{index}")
    record("decoder_mono", "decoder.decoder_mono")
    record("depth_logits_sample0", "decoder.depth_regressor")
    record("normal_raw", "decoder.normal_predictor")
    for scale, name in (("x4", "outputs04"), ("x8", "outputs08"), ("x16", "outputs16")):
        record(f"context_output/{scale}/hidden", f"decoder.context_feature_encoder.{name}.0")
        record(f"context_output/{scale}/context", f"decoder.context_feature_encoder.{name}.1")
    record("update", "decoder.update_block")
    record("up_mask", "decoder.update_block.mask")
    contexts = {}
    for scale, name in (("x4", "outputs04"), ("x8", "outputs08"), ("x16", "outputs16")):
        module = model.get_submodule(f"depth_model.decoder.context_feature_encoder.{name}.0")
        handles.append(
            module.register_forward_pre_hook(lambda _, args, scale=scale: contexts.setdefault(scale, args[0]))
        )
    flows = []
    update = model.get_submodule("depth_model.decoder.update_block")
    handles.append(update.register_forward_pre_hook(lambda _, args: flows.append(args[2])))
    try:
        with torch.no_grad():
            model(tensors["A/input"], output_iterations=True)
    finally:
        for handle in handles:
            handle.remove()
    states, delta = seen.pop("update")
    seen |= {f"encoder_features/{index}": value for index, value in enumerate(seen.pop("encoder"))}
    seen |= {f"iter0/net/{index}": value for index, value in enumerate(states)}
    seen |= {f"context_input/{scale}": value for scale, value in contexts.items()}
    seen |= {"iter0/delta_flow": delta, "flow_init": flows[0]}
    seen["iter0/up_mask_sample0"] = 0.25 * seen.pop("up_mask")[:1]
    seen["depth_logits_sample0"] = seen["depth_logits_sample0"][:1]
    stored = {key.removeprefix("A/intermediate/") for key in tensors if key.startswith("A/intermediate/")}
    assert stored - set(seen) <= {"context_input/x32"}  # which nothing reads
    for name in stored & set(seen):
        close(seen[name], tensors[f"A/intermediate/{name}"], INTERMEDIATE)


def test_gradients_equal_the_originals(golden):
    tensors, model = golden
    pixels = tensors["A/input"].clone().requires_grad_()
    output = model.train()(pixels)
    count = len(output.predictions_list)
    loss = 0
    for index in range(count):
        terms = (
            (output.predictions_list[index] * tensors["A/grad_weight/depth"]).mean() / 10,
            (output.confidence_list[index] * tensors["A/grad_weight/confidence"]).mean(),
            (output.normal_out_list[index] * tensors["A/grad_weight/normal"]).mean(),
        )
        loss = loss + 0.9 ** (count - 1 - index) * sum(terms)
    loss.backward()
    model.eval()
    gradients = {f"A/grad/{name}": value.grad for name, value in model.named_parameters()}
    model.zero_grad()
    without = {name for name, value in gradients.items() if value is None}
    unused = {"mask_token"} | ({"norm.weight", "norm.bias"} if model.config.variant == "giant2" else set())
    assert without == {f"A/grad/depth_model.encoder.{name}" for name in unused}
    assert abs(loss.item() - tensors["A/grad_loss"].item()) < 1e-4
    gradients["A/grad/input"] = pixels.grad
    stored = [key for key in tensors if key.startswith("A/grad/")]
    assert len(stored) > 20
    for key in stored:
        close(gradients[key], tensors[key], GRADIENT * tensors[key].abs().max())


# ---- sizes ----


@pytest.mark.parametrize(
    ("variant", "encoder", "decoder"),
    [
        ("giant2", 1_136_486_912, 241_188_187),
        ("large", 304_372_736, 107_569_179),
        ("small", 22_058_112, 15_436_939),
    ],
)
def test_released_sizes(variant, encoder, decoder):
    with torch.device("meta"):
        model = Metric3DForDepthEstimation(Metric3DConfig(variant=variant))
    counts = [
        sum(p.numel() for p in part.parameters()) for part in (model.depth_model.encoder, model.depth_model.decoder)
    ]
    assert counts == [encoder, decoder]
    if variant == "giant2":
        official = json.loads((FIXTURES / "state_dict_shapes_giant2.json").read_text())
        official = {key: shape for key, shape in official.items() if ".downsample.1." not in key}
        assert {key: list(value.shape) for key, value in model.state_dict().items()} == official
        assert len(official) == 742
        assert Metric3DForDepthEstimation.config_class().variant == "giant2"


def test_full_size_forward_reads_no_tensor_value():
    """On the meta device any .item() or int(tensor), a device sync elsewhere, is an error."""
    with torch.device("meta"):
        model = Metric3DForDepthEstimation(Metric3DConfig(variant="small")).train()
        output = model(torch.empty(2, 3, 476, 644))
    assert output.predicted_depth.shape == (2, 476, 644) and output.normals.shape == (2, 4, 476, 644)
    assert len(output.predictions_list) == 5 and output.predictions_list[0].shape == (2, 1, 476, 644)
    assert list(model.named_buffers()) == []


@pytest.mark.parametrize("size", [(14, 14), (15, 100), (28, 42), (45, 100), (56, 56), (57, 70), (70, 57)])
def test_any_size_from_a_patch_on(size):
    model = tiny(iters=1)
    with torch.no_grad():
        output = model(images(1, 3, *size))
    expected = tuple(4 * math.floor(3.5 * math.ceil(side / 14)) for side in size)
    assert output.predicted_depth.shape == (1, *expected) == output.confidence.shape
    assert output.normals.shape == (1, 4, *expected)
    assert all(torch.isfinite(value).all() for value in output.values())


@pytest.mark.parametrize("registers", [0, 1, 3])
def test_register_counts(registers):
    model = tiny(num_register_tokens=registers)
    features = model.depth_model.encoder(images(2, 3, 28, 42))
    assert [feature.shape for feature in features] == [(2, 1 + registers + 6, 24)] * 4
    assert model(images(2, 3, 28, 42)).predicted_depth.shape == (2, 28, 40)


def test_images_of_a_batch_do_not_meet():
    model = tiny()
    pixels = images(5, 3, 42, 57)
    with torch.no_grad():
        together = model(pixels)
        for index in range(5):
            alone = model(pixels[index : index + 1])
            close(alone.predicted_depth[0], together.predicted_depth[index], DEPTH)
            close(alone.normals[0], together.normals[index], NORMAL)
    assert together.predicted_depth.std(dim=0).mean() > 0.5  # metres: the images do differ


def test_depth_stays_in_its_range():
    model = tiny(depth_min=2.0, depth_max=50.0)
    with torch.no_grad():
        for change, limit in ((-100.0, 2.0), (100.0, 50.0)):
            model.depth_model.decoder.update_block.flow_head.conv2d.bias[0] = change
            assert (model(images(1, 3, 42, 42)).predicted_depth == limit).all()


def test_fast_schedule_can_be_off():
    slow, plain = tiny(), tiny(slow_fast_gru=False)
    pixels = images(1, 3, 28, 28)
    with torch.no_grad():
        assert not torch.equal(slow(pixels).predicted_depth, plain(pixels).predicted_depth)


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
    model = Metric3DForDepthEstimation(Metric3DConfig(**TINY))
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
        tiny()(pixels)


def test_labels_are_refused_and_tuples_returned():
    model = tiny()
    with pytest.raises(NotImplementedError, match="labels"):
        model(images(1, 3, 28, 28), labels=torch.zeros(1, 28, 28))
    depth, confidence, normals = model(images(1, 3, 28, 28), return_dict=False)
    assert depth.shape == confidence.shape == (1, 28, 28) and normals.shape == (1, 4, 28, 28)


def test_activation_checkpointing_changes_no_gradient():
    plain = tiny().train()
    checkpointed = copy.deepcopy(plain)
    checkpointed.activation_checkpointing_enable()
    flagged = [m for m in checkpointed.modules() if getattr(m, "gradient_checkpointing", False)]
    assert len(flagged) == TINY["depth"] + 1  # encoder blocks and the recurrent update
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
    model = tiny()
    model(images(1, 3, 28, 28))
    assert model.config._attn_implementation == "sdpa"
    assert calls == [(1, 2, 1 + 1 + 4, 12)] * TINY["depth"]


def test_bf16_autocast_keeps_depth_in_float32():
    model = tiny()
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
    model = tiny().to(dtype)
    with torch.no_grad():
        depth = model(images(1, 3, 30, 42).to(dtype)).predicted_depth
    assert depth.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    assert torch.isfinite(depth).all()


def test_encoder_blocks_compile_without_graph_breaks():
    model = tiny()
    pixels = images(1, 3, 28, 42)
    with torch.no_grad():
        expected = model(pixels).predicted_depth
        for block in model.depth_model.encoder.blocks[0]:
            block.compile(fullgraph=True, backend="eager")
        close(model(pixels).predicted_depth, expected, DEPTH)


def test_the_files_work_on_their_own():
    """Saved folders carry them: each imports only packages of a transformers installation and its siblings."""
    folder = Path(metric3d_package.__file__).parent
    allowed = {"torch", "numpy", "transformers", "safetensors"}
    for file in folder.glob("*_metric3d.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level:
                assert node.level == 1 and (folder / f"{node.module}.py").is_file()
            elif isinstance(node, (ast.Import, ast.ImportFrom)):
                for name in [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]:
                    top = name.split(".")[0]
                    assert top in allowed or top in {"ast", "math", "pickle", "re", "zipfile", "collections"} | {
                        "dataclasses",
                        "pathlib",
                        "typing",
                    }, f"{file.name} imports {name}"


# ---- configuration ----


def test_config_takes_sizes_beside_a_variant():
    config = Metric3DConfig(
        variant="large",
        embed_dim=1536,
        **{key: TINY[key] for key in ("iters",)},
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
        Metric3DConfig(**{**TINY, **change})


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
    large = load_golden("golden_vitl_style")[2]
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
        ({**state, bias: 3.0}, config, f"{bias} is a float"),
        ({**state, twice: state[twice] + 1}, config, f"{twice} and .* different values"),
    ]
    for tensors, sizes, message in cases:
        with pytest.raises(ValueError, match=message):
            Metric3DForDepthEstimation.from_official(tensors, sizes)


# ---- image processor ----


def picture(height=60, width=80, seed=0):
    return Image.fromarray(np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8))


def test_processor_stretches_to_the_papers_size():
    processor = Metric3DImageProcessorPil()
    pixels = processor([picture(), picture(90, 50)], return_tensors="pt").pixel_values
    assert pixels.shape == (2, 3, 476, 644) and pixels.dtype == torch.float32
    expected = np.asarray(picture().resize((644, 476), Image.Resampling.BICUBIC), np.float32)
    expected = (expected - [123.675, 116.28, 103.53]) / [58.395, 57.12, 57.375]
    close(pixels[0], torch.from_numpy(expected).permute(2, 0, 1).float(), 1e-5)
    assert torch.equal(pixels[:1], to_pixel_values([picture()], processor, (476, 644)))


def test_processor_keeps_the_aspect_on_request(tmp_path):
    processor = Metric3DImageProcessorPil(keep_aspect_ratio=True, size={"height": 616, "width": 1064})
    processor.save_pretrained(tmp_path)
    processor = Metric3DImageProcessorPil.from_pretrained(tmp_path)
    wide = picture(100, 400)  # scaled by 2.66 to 266x1064, 175 rows above and below
    pixels = processor(wide, return_tensors="pt").pixel_values[0]
    assert pixels.shape == (3, 616, 1064)
    border = torch.cat([pixels[:, :175], pixels[:, 441:]], dim=1)
    assert border.abs().max() < 0.01  # the mean colour, rounded to 8 bits
    assert pixels[:, 175:441].abs().mean() > 0.3
    plain = torch.from_numpy(np.array(wide)).permute(2, 0, 1)[None].float()
    plain = torch.nn.functional.interpolate(plain, size=(266, 1064), mode="bilinear").round()
    mean, std = (torch.tensor(value).view(3, 1, 1) for value in (processor.image_mean, processor.image_std))
    close(pixels[:, 175:441], (plain[0] - mean) / std, 1e-5)
    # Depth that grows downwards over the canvas: without the padding it starts where the picture does.
    depth = torch.arange(616.0)[:, None].expand(616, 1064)[None]
    result = processor.post_process_depth_estimation(DepthEstimatorOutput(predicted_depth=depth), [(266, 1064)])
    assert torch.equal(result[0]["predicted_depth"][:, 0], torch.arange(175.0, 441.0))


def test_focal_lengths_make_depth_metric():
    processor = Metric3DImageProcessorPil()
    output = DepthEstimatorOutput(predicted_depth=torch.full((2, 476, 644), 10.0))
    sizes = [(480, 640), (240, 1288)]
    canonical = processor.post_process_depth_estimation(output, sizes)
    assert [tuple(item["predicted_depth"].shape) for item in canonical] == sizes
    assert all((item["predicted_depth"] == 10).all() for item in canonical)
    metric = processor.post_process_depth_estimation(output, sizes, focal_lengths=[518.86, (1000.0, 500.0)])
    close(metric[0]["predicted_depth"], torch.full(sizes[0], 10 * 518.86 * 644 / 640 / 1000), 1e-4)
    close(metric[1]["predicted_depth"], torch.full(sizes[1], 10 * (500 + 500 * 476 / 240) / 2 / 1000), 1e-4)
    kept = Metric3DImageProcessorPil(keep_aspect_ratio=True)
    metric = kept.post_process_depth_estimation(output, sizes, focal_lengths=[518.86, 1000])
    close(metric[0]["predicted_depth"], torch.full(sizes[0], 10 * 518.86 * 476 / 480 / 1000), 1e-4)
    close(metric[1]["predicted_depth"], torch.full(sizes[1], 5.0), 1e-4)
    unresized = processor.post_process_depth_estimation(output)
    assert torch.equal(unresized[0]["predicted_depth"], output.predicted_depth[0])


def test_processor_errors():
    processor = Metric3DImageProcessorPil()
    output = DepthEstimatorOutput(predicted_depth=torch.ones(1, 28, 28))
    bad = np.full((3, 30, 40), 7.0, np.float32)
    bad[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        processor(bad, return_tensors="pt")
    with pytest.raises(ValueError, match="multiply by 255"):
        processor(torch.rand(3, 30, 40), return_tensors="pt")
    with pytest.raises(ValueError, match="different sizes"):
        Metric3DImageProcessorPil(do_resize=False)([picture(), picture(30, 30)], return_tensors="pt")
    for sizes, focal, message in (
        ([(1, 1)] * 2, None, "2 target sizes for 1"),
        (None, [500], "need target_sizes"),
        ([(30, 40)], [0], "positive"),
        ([(30, 40)], [float("nan")], "positive"),
        ([(30, 40)], [1, 2], "2 focal lengths for 1"),
    ):
        with pytest.raises(ValueError, match=message):
            processor.post_process_depth_estimation(output, sizes, focal)
