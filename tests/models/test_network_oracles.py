"""Both networks at sizes that no stored result has, against straight-line arithmetic in float64."""

import pytest
import torch
from helpers.backbones import randomize
from helpers.network_oracles import metric3d, vggt
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.models.metric3d import Metric3DConfig, Metric3DForDepthEstimation
from gift_peft.models.vggt import VggtConfig, VggtForDepthEstimation

QUICK = settings(max_examples=12, deadline=None, derandomize=True)


def official(model_class, config, seed):
    """(the model in float64, made from official tensors; those tensors)."""
    state = randomize(model_class(config), seed).state_dict()
    model = model_class.from_official(state, config).double()
    return model, {name: value.double() for name, value in state.items()}


def pixels(shape, seed):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@st.composite
def vggt_cases(draw):
    heads, patch = draw(st.integers(1, 3)), draw(st.sampled_from([14, 14, 7]))
    depth = draw(st.integers(1, 3))
    config = VggtConfig(
        img_size=patch * draw(st.integers(1, 5)),
        patch_size=patch,
        embed_dim=heads * 4 * draw(st.integers(1, 3)),
        num_heads=heads,
        mlp_ratio=draw(st.sampled_from([1, 2.5, 4.0])),
        num_register_tokens=draw(st.sampled_from([0, 1, 3, 8])),
        vit_depth=draw(st.integers(0, 2)),
        depth=depth,
        intermediate_layer_idx=draw(st.lists(st.integers(0, depth - 1), min_size=4, max_size=4)),
        rope_freq=draw(st.sampled_from([100, 33.5])),
        qk_norm=draw(st.booleans()),
        features=8 * draw(st.integers(1, 2)),
        out_channels=[4 * draw(st.integers(1, 4)) for _ in range(4)],
        head_features_2=draw(st.integers(1, 6)),
    )
    shape = (draw(st.integers(1, 2)), draw(st.integers(1, 3)), 3, *(patch * draw(st.integers(1, 5)) for _ in range(2)))
    return config, shape, draw(st.integers(0, 99))


@QUICK
@given(vggt_cases())
def test_vggt(case):
    config, shape, seed = case
    model, tensors = official(VggtForDepthEstimation, config, seed)
    images = pixels(shape, seed)
    depth, confidence = vggt(tensors, config, images)
    with torch.no_grad():
        output = model(images)
        torch.testing.assert_close(output.predicted_depth, depth, rtol=1e-9, atol=0)
        torch.testing.assert_close(output.confidence, confidence, rtol=1e-9, atol=0)
        if shape[1] == 1:
            torch.testing.assert_close(model(images[:, 0]).predicted_depth, depth[:, 0], rtol=1e-9, atol=0)


@st.composite
def metric3d_cases(draw):
    variant = draw(st.sampled_from(["giant2", "giant2", "large", "small"]))
    heads = draw(st.integers(1, 3))
    width = heads * draw(st.integers(2, 8))
    seventh, hidden = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    low = draw(st.sampled_from([0.1, 0.2, 2.0]))
    config = Metric3DConfig(
        variant=variant,
        embed_dim=width,
        depth=4 * draw(st.integers(1, 2)) if variant == "giant2" else draw(st.integers(1, 3)),
        num_heads=heads,
        num_register_tokens=draw(st.sampled_from([0, 1, 2, 8])),
        pos_image_size=14 * draw(st.integers(1, 6)),
        feature_channels=[draw(st.integers(1, 9)), seventh, width, draw(st.integers(1, 9))],
        decoder_channels=[draw(st.integers(1, 9)), draw(st.integers(1, 9)), seventh, width, width],
        hidden_channels=[hidden, draw(st.integers(1, 9)), hidden, draw(st.integers(1, 9))],
        iters=draw(st.integers(1, 4)),
        depth_min=low,
        depth_max=draw(st.sampled_from([80.0, 150.0, 200.0])),
        mlp_ratio=draw(st.integers(1, 4)),
        num_depth_bins=draw(st.sampled_from([16, 256])),
        regress_scale=draw(st.sampled_from([50.0, 100.0])),
        qkv_bias=draw(st.booleans()),
        slow_fast_gru=draw(st.booleans()),
    )
    size = [draw(st.one_of(st.sampled_from([14, 28, 42, 56]), st.integers(14, 64))) for _ in range(2)]
    return config, (draw(st.integers(1, 2)), 3, *size), draw(st.integers(0, 99))


@QUICK
@given(metric3d_cases())
def test_metric3d(case):
    config, shape, seed = case
    model, tensors = official(Metric3DForDepthEstimation, config, seed)
    images = pixels(shape, seed) * 4 - 2
    expected = metric3d(tensors, config, images)
    with torch.no_grad():
        output = model.train()(images)
        evaluated = model.eval()(images)
    for step in range(config.iters + 1):
        for index, results in enumerate(expected):
            depth, confidence, normals = results[step]
            torch.testing.assert_close(output.predictions_list[step][index, 0], depth, rtol=1e-8, atol=1e-8)
            torch.testing.assert_close(output.confidence_list[step][index, 0], confidence, rtol=1e-8, atol=1e-8)
            torch.testing.assert_close(output.normal_out_list[step][index], normals, rtol=1e-8, atol=1e-8)
    assert torch.equal(evaluated.predicted_depth, output.predictions_list[-1].squeeze(1))
    assert torch.equal(evaluated.normals, output.normal_out_list[-1])


@pytest.mark.parametrize("model_class", [VggtForDepthEstimation, Metric3DForDepthEstimation])
def test_gradients_of_every_weight(model_class):
    """Also shows that no weight is left out, here or there, but those that the networks never use."""
    if model_class is VggtForDepthEstimation:
        config = VggtConfig(
            img_size=28, embed_dim=8, num_heads=1, num_register_tokens=1, vit_depth=1, depth=2, features=8,
            intermediate_layer_idx=[0, 0, 1, 1], out_channels=[4, 4, 4, 4], head_features_2=4,
        )  # fmt: skip
        unused = {"aggregator.patch_embed.mask_token"}
    else:
        config = Metric3DConfig(
            embed_dim=8, depth=4, num_heads=2, num_register_tokens=1, pos_image_size=28, iters=2,
            feature_channels=[4, 4, 8, 8], decoder_channels=[4, 4, 4, 8, 8], hidden_channels=[4, 4, 4, 4],
        )  # fmt: skip
        unused = {f"depth_model.encoder.{name}" for name in ("mask_token", "norm.weight", "norm.bias")}
    model, tensors = official(model_class, config, 0)
    tensors = {name: value.requires_grad_() for name, value in tensors.items()}
    if model_class is VggtForDepthEstimation:
        images = pixels((1, 2, 3, 42, 28), 0)
        sum(x.log().sum() for x in vggt(tensors, config, images)).backward()
        output = model(images)
        (output.predicted_depth.log().sum() + output.confidence.log().sum()).backward()
    else:
        images = pixels((1, 3, 42, 28), 0)
        sum(x.sum() for x in metric3d(tensors, config, images)[0][-1]).backward()
        output = model(images)
        sum(x.sum() for x in (output.predicted_depth, output.confidence, output.normals)).backward()
    assert {name for name, value in tensors.items() if value.grad is None or not value.grad.any()} == unused
    for name in tensors.keys() - unused:
        ours, theirs = model.get_parameter(name).grad, tensors[name].grad
        torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=1e-9 * theirs.abs().max().item())
