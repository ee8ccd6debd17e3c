"""Metric3D V2 against tensors that the original computed (tests/fixtures/metric3d); its input sizes."""

import json
import math

import pytest
import torch
from helpers.backbones import FIXTURES, metric3d_golden, tiny_metric3d
from transformers.modeling_outputs import DepthEstimatorOutput

from gift_peft.models.metric3d import Metric3DConfig, Metric3DForDepthEstimation

FILES = ["golden_public", "golden_vitl_style"]
DEPTH, CONFIDENCE, NORMAL, INTERMEDIATE, GRADIENT = 2e-3, 5e-5, 1e-4, 1e-4, 1e-3


@pytest.fixture(scope="module", params=FILES)
def golden(request):
    """(all tensors of the file, the model with its weights); the model is left in eval mode."""
    tensors, weights, config = metric3d_golden(request.param)
    return tensors, Metric3DForDepthEstimation.from_official(weights, config)


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
        official = json.loads((FIXTURES / "metric3d/state_dict_shapes_giant2.json").read_text())
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
    model = tiny_metric3d(iters=1)
    with torch.no_grad():
        output = model(images(1, 3, *size))
    expected = tuple(4 * math.floor(3.5 * math.ceil(side / 14)) for side in size)
    assert output.predicted_depth.shape == (1, *expected) == output.confidence.shape
    assert output.normals.shape == (1, 4, *expected)
    assert all(torch.isfinite(value).all() for value in output.values())


@pytest.mark.parametrize("registers", [0, 1, 3])
def test_register_counts(registers):
    model = tiny_metric3d(num_register_tokens=registers)
    features = model.depth_model.encoder(images(2, 3, 28, 42))
    assert [feature.shape for feature in features] == [(2, 1 + registers + 6, 24)] * 4
    assert model(images(2, 3, 28, 42)).predicted_depth.shape == (2, 28, 40)


def test_images_of_a_batch_do_not_meet():
    model = tiny_metric3d()
    pixels = images(5, 3, 42, 57)
    with torch.no_grad():
        together = model(pixels)
        for index in range(5):
            alone = model(pixels[index : index + 1])
            close(alone.predicted_depth[0], together.predicted_depth[index], DEPTH)
            close(alone.normals[0], together.normals[index], NORMAL)
    assert together.predicted_depth.std(dim=0).mean() > 0.5  # metres: the images do differ


def test_depth_stays_in_its_range():
    model = tiny_metric3d(depth_min=2.0, depth_max=50.0)
    with torch.no_grad():
        for change, limit in ((-100.0, 2.0), (100.0, 50.0)):
            model.depth_model.decoder.update_block.flow_head.conv2d.bias[0] = change
            assert (model(images(1, 3, 42, 42)).predicted_depth == limit).all()


def test_fast_schedule_can_be_off():
    slow, plain = tiny_metric3d(), tiny_metric3d(slow_fast_gru=False)
    pixels = images(1, 3, 28, 28)
    with torch.no_grad():
        assert not torch.equal(slow(pixels).predicted_depth, plain(pixels).predicted_depth)
