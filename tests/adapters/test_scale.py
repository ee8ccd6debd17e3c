"""`set_adapter_scale`: 0 is the base and 1 the trained model, both to the bit; between them the weights are mixed."""

import pytest
import torch
from helpers.adapted import PIXELS, depth, trained
from helpers.tiny import tiny_model, write_base
from peft import LoraConfig, PeftModel, get_peft_model
from transformers import AutoModelForDepthEstimation

from gift_peft.adapters.folder import save_adapter
from gift_peft.adapters.recipes import HEADS, get_gift_model
from gift_peft.adapters.scale import active_lora, active_saved_modules, scale_comes_back, set_adapter_scale

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning")


@pytest.mark.parametrize("head", HEADS)
def test_adapter_scale(head):
    base = depth(tiny_model())
    model = trained(get_gift_model(tiny_model(), head=head))
    state = {name: value.clone() for name, value in model.state_dict().items()}
    full, seen = depth(model), {}
    for scale in (0.5, 0, 1, 0.25, 0.5, 0, 0.25, 1, 1, 0.5, 0.25, 0):
        set_adapter_scale(model, scale)
        seen.setdefault(scale, depth(model))
        assert torch.equal(depth(model), seen[scale])  # no drift
        with model.disable_adapter():
            assert torch.equal(depth(model), base)
        assert torch.equal(depth(model), seen[scale])
    assert torch.equal(seen[0], base) and torch.equal(seen[1], full)
    assert len({value.sum().item() for value in seen.values()}) == 4
    set_adapter_scale(model, 1)
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())
    assert model.state_dict().keys() == state.keys()


def test_scaled_weights(model):
    """base + s (trained - base) for saved modules; alpha / r times s for LoRA."""
    model = trained(get_gift_model(model, rank=4))
    wrapper = model.base_model.model.head
    base, full = wrapper.original_module.conv1.weight.clone(), wrapper.modules_to_save["default"].conv1.weight.clone()
    set_adapter_scale(model, 0.3)
    torch.testing.assert_close(wrapper.modules_to_save["default"].conv1.weight, base + 0.3 * (full - base))
    assert torch.equal(wrapper.original_module.conv1.weight, base)
    layer = model.base_model.model.backbone.encoder.layer[0].attention.q_proj
    assert layer.scaling["default"] == pytest.approx(0.3 * 8 / 4)


def test_scale_then_merge(model):
    """In float64: the LoRA matrices start at random, and in float32 rounding alone may differ by 1e-5."""
    model, pixels = trained(get_gift_model(model)).double(), PIXELS.double()
    set_adapter_scale(model, 0.5)
    scaled = depth(model, pixels)
    torch.testing.assert_close(depth(model.merge_and_unload(), pixels), scaled, rtol=1e-10, atol=1e-10)


@pytest.fixture
def adapter_folder(tmp_path):
    """An adapter whose head was trained in full, and its base."""
    write_base(tmp_path / "base")
    with pytest.warns(UserWarning, match="local folder"):
        save_adapter(trained(get_gift_model(tiny_model())), tmp_path / "adapter", str(tmp_path / "base"))
    return tmp_path / "adapter"


def test_transformers_own_switch_leaves_the_head_off(adapter_folder):
    """What upstream does: if this fails, `enable_adapters` is mended there, and card and docs may say so."""
    model = AutoModelForDepthEstimation.from_pretrained(adapter_folder).eval()
    adapted = depth(model)
    model.disable_adapters()
    assert torch.equal(depth(model), depth(tiny_model()))
    model.enable_adapters()
    assert not torch.equal(depth(model), adapted)
    assert {wrapper.disable_adapters for wrapper, _ in active_saved_modules(model)} == {True}
    assert {layer.disable_adapters for layer, _ in active_lora(model)} == {False}


@pytest.mark.parametrize("way", ["off", "off and on", "head off", "lora off", "peft"])
def test_setting_the_scale_switches_everything_on(way, adapter_folder):
    if way == "peft":
        model = PeftModel.from_pretrained(tiny_model(), adapter_folder).eval()
        adapted = depth(model)
        model.base_model.disable_adapter_layers()
    else:
        model = AutoModelForDepthEstimation.from_pretrained(adapter_folder).eval()
        adapted = depth(model)
        if way.startswith("off"):
            model.disable_adapters()
        if way == "off and on":
            model.enable_adapters()
        parts = {"head off": active_saved_modules, "lora off": active_lora}.get(way, lambda model: [])(model)
        for module, _ in parts:
            module.enable_adapters(False)
    assert not torch.equal(depth(model), adapted)
    for scale, expected in ((1, adapted), (0, depth(tiny_model())), (1, adapted)):
        set_adapter_scale(model, scale)
        assert torch.equal(depth(model), expected)


@pytest.mark.parametrize("head", ["full", "lora"])
def test_the_scale_comes_back_to_the_bit(head):
    model = trained(get_gift_model(tiny_model(), rank=6, head=head))  # alpha / 6 is no power of two
    for scale in (1, 0.3, -0.7, 0.1):
        set_adapter_scale(model, scale)
        scalings, before = [layer.scaling[name] for layer, name in active_lora(model)], depth(model)
        with pytest.raises(RuntimeError, match="stop"), scale_comes_back(model):
            set_adapter_scale(model, 0.25)
            assert not torch.equal(depth(model), before)
            raise RuntimeError("stop")
        assert [layer.scaling[name] for layer, name in active_lora(model)] == scalings
        assert torch.equal(depth(model), before)
    model.base_model.disable_adapter_layers()
    with scale_comes_back(model):
        set_adapter_scale(model, 1)
    assert torch.equal(depth(model), depth(tiny_model()))  # it was off
    model.base_model.enable_adapter_layers()
    model.merge_adapter()
    with pytest.raises(ValueError, match="merged"), scale_comes_back(model):
        pass


def test_scale_refusals(model):
    with pytest.raises(ValueError, match="no active LoRA adapter"):
        set_adapter_scale(model, 0.5)
    model = trained(get_gift_model(model))
    with pytest.raises(ValueError, match="must be finite"):
        set_adapter_scale(model, float("nan"))
    set_adapter_scale(model, 0.5)
    trained(model)  # at scale 0.5: what should scale 1 be now?
    before = depth(model)
    with pytest.raises(ValueError, match=r"changed at adapter scale 0.5: set it to 1"):
        set_adapter_scale(model, 1)
    assert torch.equal(depth(model), before)
    model = trained(get_gift_model(tiny_model()))
    model.merge_adapter()
    with pytest.raises(ValueError, match="merged"):
        set_adapter_scale(model, 0.5)
    dora = get_peft_model(tiny_model(), LoraConfig(target_modules=["q_proj"], use_dora=True))
    with pytest.raises(ValueError, match="use_dora"):
        set_adapter_scale(dora, 0)
