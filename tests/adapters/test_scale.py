"""`set_adapter_scale`: 0 is the base and 1 the trained model, both to the bit; between them the weights are mixed."""

import pytest
import torch
from helpers.adapted import PIXELS, depth, trained
from helpers.tiny import tiny_model
from peft import LoraConfig, get_peft_model

from gift_peft.adapters.recipes import HEADS, get_gift_model
from gift_peft.adapters.scale import set_adapter_scale


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
