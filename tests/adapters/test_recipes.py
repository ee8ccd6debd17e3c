"""Recipes: what is trained, and what stays the base to the bit."""

import pytest
import torch
from helpers.adapted import depth, load_base, trained
from helpers.tiny import tiny_model
from peft import LoraConfig, PeftModel
from torch import nn
from transformers import (
    BeitConfig,
    DepthProConfig,
    DepthProForDepthEstimation,
    Dinov2Config,
    DPTConfig,
    DPTForDepthEstimation,
    PromptDepthAnythingConfig,
    PromptDepthAnythingForDepthEstimation,
    ZoeDepthConfig,
    ZoeDepthForDepthEstimation,
)

from gift_peft.adapters.folder import save_adapter
from gift_peft.adapters.recipes import RECIPES, GiftRecipe, get_gift_model, get_recipe
from gift_peft.adapters.scale import check_lora_config, set_adapter_scale
from gift_peft.group_step import GroupStep


def trainable(model):
    return {name.removeprefix("base_model.model.") for name, p in model.named_parameters() if p.requires_grad}


# ---- recipes ----


def test_depth_anything_recipe(model):
    before = depth(model)
    adapted = get_gift_model(model)
    assert isinstance(adapted, PeftModel) and not adapted.training
    assert torch.equal(depth(adapted), before)
    config = adapted.peft_config["default"]
    assert config.r == 8 and config.lora_alpha == LoraConfig().lora_alpha and config.lora_dropout == 0
    assert set(config.modules_to_save) == {"neck", "head"}
    names = trainable(adapted)
    lora = {name for name in names if "lora_" in name}
    assert len(lora) == 4 * 4 * 2  # layers x projections x (A, B)
    assert all(name.startswith("backbone.encoder.layer.") and ".attention." in name for name in lora)
    assert all(name.startswith(("neck.", "head.")) for name in names - lora)
    heads = [*model.neck.original_module.parameters(), *model.head.original_module.parameters()]
    assert len(names - lora) == len(heads)


def test_head_lora(model):
    adapted = get_gift_model(model, rank=4, head="lora")
    names = trainable(adapted)
    assert all("lora_" in name for name in names) and adapted.peft_config["default"].modules_to_save is None
    layers = {name.split(".lora_")[0] for name in names if name.startswith(("neck.", "head."))}
    expected = {
        name.split(".base_layer")[0]
        for name, module in adapted.base_model.model.named_modules()
        if name.startswith(("neck.", "head.")) and isinstance(module, nn.Conv2d | nn.Linear) and "lora_" not in name
    }
    assert layers == expected and "head.conv1" in layers and "neck.reassemble_stage.layers.0.projection" in layers
    assert not any("layers.0.resize" in name for name in names)  # a transposed convolution
    assert all(p.shape[0] == 4 for name, p in adapted.named_parameters() if "lora_A" in name)
    assert torch.equal(depth(adapted), depth(tiny_model()))


def test_head_lora_leaves_out_what_peft_cannot_merge(model):
    model.head.conv1.padding_mode = "replicate"  # PEFT's own convolution beside it pads with zeros
    model.head.conv2.padding_mode = "reflect"
    adapted = trained(get_gift_model(model, head="lora")).eval()
    names = trainable(adapted)
    assert not any(name.startswith(("head.conv1.", "head.conv2.")) for name in names)
    assert any(name.startswith("head.conv3.") for name in names)
    before = depth(adapted)
    torch.testing.assert_close(depth(adapted.merge_and_unload()), before, rtol=1e-4, atol=1e-5)


def test_head_none(model):
    names = trainable(get_gift_model(model, head="none"))
    assert len(names) == 32 and all("lora_" in name for name in names)


def test_kind_follows_the_config():
    recipe = RECIPES["depth_anything"]
    assert recipe.size == (476, 644)
    assert recipe.kind_for(tiny_model().config) == "inverse_depth"
    metric = tiny_model(depth_estimation_type="metric", max_depth=20)
    assert recipe.kind_for(metric.config) == "depth"
    assert get_recipe(get_gift_model(metric)) is recipe
    own = GiftRecipe(["query"], ["head"], kind="depth")
    assert get_recipe(metric, own) is own and own.kind_for(DPTConfig()) == "depth"
    with pytest.raises(ValueError, match="dpt: the recipe must say kind"):
        GiftRecipe(["query"], ["head"]).kind_for(DPTConfig())
    with pytest.raises(ValueError, match="kind must be one of depth, inverse_depth"):
        GiftRecipe(["query"], ["head"], kind="disparity")


def tiny_dpt():
    model = DPTForDepthEstimation(
        DPTConfig(
            hidden_size=16,
            num_hidden_layers=4,
            num_attention_heads=2,
            intermediate_size=32,
            image_size=32,
            patch_size=16,
            backbone_out_indices=[0, 1, 2, 3],
            neck_hidden_sizes=[8, 8, 8, 8],
            fusion_hidden_size=8,
            hidden_dropout_prob=0.1,
        )
    ).eval()
    nn.init.ones_(model.head.head[4].bias)  # before a ReLU
    return model


def tiny_zoedepth():
    backbone = BeitConfig(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=32,
        image_size=32,
        patch_size=16,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        use_relative_position_bias=True,
    )
    return ZoeDepthForDepthEstimation(
        ZoeDepthConfig(
            backbone_config=backbone,
            backbone_hidden_size=16,
            neck_hidden_sizes=[8, 8, 8, 8],
            fusion_hidden_size=8,
            bottleneck_features=8,
            num_relative_features=4,
            bin_embedding_dim=8,
            num_attractors=[4, 2, 2, 1],
            bin_configurations=[{"n_bins": 4, "min_depth": 0.001, "max_depth": 10.0, "name": "nyu"}],
        )
    ).eval()


def tiny_promptda():
    backbone = Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        image_size=28,
        patch_size=14,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
    )
    return PromptDepthAnythingForDepthEstimation(
        PromptDepthAnythingConfig(
            backbone_config=backbone,
            reassemble_hidden_size=16,
            patch_size=14,
            neck_hidden_sizes=[8, 8, 8, 8],
            fusion_hidden_size=8,
            head_hidden_size=8,
        )
    ).eval()


def tiny_depth_pro():
    part = {
        "model_type": "dinov2",
        "num_hidden_layers": 2,
        "hidden_size": 16,
        "num_attention_heads": 2,
        "patch_size": 4,
        "image_size": 32,
        "mlp_ratio": 2,
    }
    return DepthProForDepthEstimation(
        DepthProConfig(
            fusion_hidden_size=16,
            patch_size=32,
            intermediate_hook_ids=[1, 0],
            intermediate_feature_dims=[10, 8],
            scaled_images_ratios=[0.5, 1.0],
            scaled_images_overlap_ratios=[0.0, 0.2],
            scaled_images_feature_dims=[12, 8],
            image_model_config=dict(part),
            patch_model_config=dict(part),
            fov_model_config=dict(part),
            use_fov_model=False,
        )
    ).eval()


GENERIC = {
    "dpt": (tiny_dpt, GiftRecipe(["query", "key", "value"], ["neck", "head"], kind="inverse_depth"), 32),
    "zoedepth": (
        tiny_zoedepth,
        GiftRecipe(r"backbone\..*\.attention\..*(q_proj|query|v_proj|value)", ["neck", "metric_head"], kind="depth"),
        32,
    ),
    "prompt_depth_anything": (
        tiny_promptda,
        GiftRecipe(r"backbone\..*\.attention\.(q_proj|v_proj)", ["neck", "head"], kind="depth"),
        28,
    ),
    "depth_pro": (
        tiny_depth_pro,
        GiftRecipe(["q_proj", "v_proj"], ["depth_pro.neck", "fusion_stage", "head"], kind="inverse_depth"),
        64,
    ),
}


@pytest.mark.parametrize(
    ("model_type", "head"),
    [(name, "full") for name in GENERIC] + [("dpt", "lora"), ("dpt", "none"), ("zoedepth", "lora")],
)
def test_generic_recipe(model_type, head, tmp_path):
    """Models without a recipe: wrapped, trained by one group step, saved, loaded, off and on to the bit."""
    make, recipe, side = GENERIC[model_type]
    torch.manual_seed(0)
    base = make()
    with torch.no_grad():
        for parameter in base.parameters():
            parameter += torch.randn_like(parameter) * 0.05
    base.save_pretrained(tmp_path / "base")
    pixels = torch.randn(3, 3, side, side)
    before = depth(base, pixels)
    with pytest.raises(ValueError, match=f"no recipe for model type '{model_type}'.*GiftRecipe"):
        get_gift_model(base)
    model = get_gift_model(base, rank=2, head=head, recipe=recipe)
    assert torch.equal(depth(model, pixels), before)
    mask = torch.rand(before.shape) < 0.5
    output = GroupStep(model).accumulate(pixels, mask, before)
    assert output.num_pairs == 3
    assert any(p.grad is not None and p.grad.any() for p in model.parameters())
    trained(model)
    save_adapter(model, tmp_path / "adapter", "someone/base")
    again = PeftModel.from_pretrained(load_base(tmp_path / "base"), tmp_path / "adapter").eval()
    assert torch.equal(depth(again, pixels), depth(model, pixels))
    set_adapter_scale(again, 0)
    assert torch.equal(depth(again, pixels), before)


def test_heads_whose_names_mean_more_to_peft():
    """PEFT matches path endings: `head.head` in DPT's `head`, or a `camera_head` beside a `head`."""
    model = get_gift_model(tiny_dpt(), recipe=GENERIC["dpt"][1])
    assert set(model.peft_config["default"].modules_to_save) == {"neck", "head.head"}

    class Two(nn.Module):
        def __init__(self):
            super().__init__()
            self.encoder = nn.Linear(2, 2)
            self.head = nn.Sequential(nn.Linear(2, 2))
            self.camera_head = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 2))

    with pytest.raises(ValueError, match=r"PEFT would take 'head.0' for camera_head.0 as well"):
        get_gift_model(Two(), recipe=GiftRecipe(["encoder"], ["head"], kind="depth"))
    model = get_gift_model(Two(), recipe=GiftRecipe(["encoder"], ["camera_head"], kind="depth"))
    assert {name.split(".")[0] for name in trainable(model)} == {"encoder", "camera_head"}


def test_own_dropout_is_switched_off():
    model = get_gift_model(tiny_dpt().train(), recipe=GENERIC["dpt"][1])
    assert model.training
    GroupStep(model)  # refuses dropout


# ---- what is refused ----


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_base_is_refused(model, dtype):
    with pytest.raises(ValueError, match=r"the base is in b?float16 .* load it with dtype=torch.float32"):
        get_gift_model(model.to(dtype))


@pytest.mark.parametrize(
    ("lora", "message"),
    [
        ({"init_lora_weights": "pissa"}, "init_lora_weights='pissa' changes the base"),
        ({"init_lora_weights": "pissa_niter_4"}, "pissa_niter_4"),
        ({"init_lora_weights": "olora"}, "olora"),
        ({"init_lora_weights": False}, "init_lora_weights=False"),
        ({"bias": "all"}, "bias='all' trains the base's own biases"),
        ({"bias": "lora_only"}, "bias='lora_only'"),
        ({"lora_dropout": 0.1}, "lora_dropout must be 0, got 0.1"),
        ({"use_dora": True}, "use_dora"),
    ],
)
def test_options_that_break_the_teacher_are_refused(model, lora, message):
    before = model.state_dict().keys()
    recipe = GiftRecipe(RECIPES["depth_anything"].target_modules, ["neck", "head"], lora=lora)
    with pytest.raises(ValueError, match=message):
        get_gift_model(model, recipe=recipe)
    assert model.state_dict().keys() == before  # still a plain model
    if "lora_dropout" not in lora:  # harmless in a finished adapter
        with pytest.raises(ValueError, match=message):
            check_lora_config(LoraConfig(target_modules=["q_proj"], **lora))


def test_lora_options_reach_peft(model):
    recipe = GiftRecipe(["q_proj"], ["head"], lora={"lora_alpha": 32, "use_rslora": True})
    adapted = trained(get_gift_model(model, recipe=recipe))
    assert adapted.peft_config["default"].lora_alpha == 32
    after = depth(adapted)
    set_adapter_scale(adapted, 0)
    set_adapter_scale(adapted, 1)
    assert torch.equal(depth(adapted), after)


def test_bad_arguments(model):
    with pytest.raises(ValueError, match="head must be one of full, lora, none"):
        get_gift_model(model, head="all")
    with pytest.raises(ValueError, match="the model has no module 'decoder'"):
        get_gift_model(model, recipe=GiftRecipe(["q_proj"], ["decoder"]))
    for targets in (["query"], r"encoder\.attention\.q_proj"):
        with pytest.raises(ValueError, match=r"target_modules: .* names no module of this DepthAnythingFor"):
            get_gift_model(model, recipe=GiftRecipe(targets, ["head"]))
    with pytest.raises(ValueError, match=r"has no module 'head' \(there are relative_head, metric_head\)"):
        get_gift_model(tiny_zoedepth(), recipe=GiftRecipe(["query"], ["head"]))
    with pytest.raises(ValueError, match="already has an adapter"):
        get_gift_model(get_gift_model(model))
