"""examples/inference.py on a tiny adapter, and what it prints."""

import re
import runpy
import sys

import pytest
import torch
from helpers.tiny import tiny_processor, write_group
from PIL import Image
from transformers import AutoModelForDepthEstimation

from gift_peft import get_gift_model, save_adapter

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning")


def test_inference_example(base_dir, tmp_path, capsys, monkeypatch, request):
    model = get_gift_model(AutoModelForDepthEstimation.from_pretrained(base_dir))
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter.add_(0.02 * torch.randn_like(parameter))
    save_adapter(model, tmp_path / "adapter", str(base_dir), processor=tiny_processor(), size=(56, 70))
    image = write_group(tmp_path / "group", 2, 0) / "0.png"
    script = request.config.rootpath / "examples/inference.py"
    monkeypatch.setattr(
        sys, "argv", [str(script), f"--base={base_dir}", f"--adapter={tmp_path / 'adapter'}", f"--image={image}"]
    )
    runpy.run_path(str(script), run_name="__main__")

    said = capsys.readouterr().out
    values = {name: float(mean) for name, mean in re.findall(r"^(.*?): .* mean (\S+)$", said, re.M)}
    assert said.count("(60, 80)") == 4  # the picture's size

    def mean() -> float:
        pixel_values = tiny_processor()(Image.open(image), return_tensors="pt")["pixel_values"]
        with torch.no_grad():
            output = model.eval()(pixel_values=pixel_values)
        (depth,) = tiny_processor().post_process_depth_estimation(output, target_sizes=[(60, 80)])
        return depth["predicted_depth"].mean().item()

    assert values["adapted"] == values["pipeline"] == pytest.approx(mean(), abs=2e-4)
    with model.disable_adapter():
        assert values["adapter off"] == pytest.approx(mean(), abs=2e-4)
    assert values["scale 0.5"] not in (values["adapted"], values["adapter off"])
    assert float(re.search(r"at most (\S+)", said).group(1)) < 1e-4
