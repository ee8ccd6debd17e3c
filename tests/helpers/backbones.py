"""Tiny VGGT and Metric3D V2 models with random weights everywhere, and the stored results of the official networks."""

import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from torch import nn

from gift_peft.models.metric3d import Metric3DConfig, Metric3DForDepthEstimation
from gift_peft.models.vggt import VggtConfig, VggtForDepthEstimation

FIXTURES = Path(__file__).parents[1] / "fixtures"
VGGT = {
    "img_size": 70,
    "embed_dim": 24,
    "num_heads": 2,
    "mlp_ratio": 2.0,
    "num_register_tokens": 3,
    "vit_depth": 2,
    "depth": 4,
    "intermediate_layer_idx": [0, 1, 2, 3],
    "features": 16,
    "out_channels": [8, 12, 16, 20],
    "head_features_2": 8,
}
METRIC3D = {
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


def randomize(model: nn.Module, seed: int = 0, gain: float = 1.0) -> nn.Module:
    """Random weights of fan-in scale, so that outputs depend on every bias, norm and token."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            noise = torch.randn(weight.shape, generator=generator)
            last = name.split(".")[-1]
            if last == "gamma" or ("norm" in name and last == "weight"):
                weight.copy_(1 + 0.1 * noise)
            elif weight.ndim > 1 and "token" not in last and "embed" not in last:
                weight.copy_(noise * gain / weight[0].numel() ** 0.5)
            else:
                weight.copy_(0.1 * noise)
    return model


def tiny_vggt(seed: int = 0, **changes) -> VggtForDepthEstimation:
    """In eval mode."""
    return randomize(VggtForDepthEstimation(VggtConfig(**VGGT | changes)), seed).eval()


def tiny_metric3d(seed: int = 0, **changes) -> Metric3DForDepthEstimation:
    """In eval mode; the recurrence moves by metres, so that depth stays inside its range."""
    model = randomize(Metric3DForDepthEstimation(Metric3DConfig(**METRIC3D | changes)), seed, gain=1.4).eval()
    head = model.depth_model.decoder.update_block.flow_head
    for weight in (head.conv2d.weight, head.conv2d.bias):
        weight.data.mul_(0.02)
    return model


def vggt_golden() -> tuple[dict, dict, dict]:
    """(all tensors of the file, the weights by official name, the sidecar)."""
    tensors = load_file(FIXTURES / "vggt/golden_public.safetensors")
    weights = {name: value for name, value in tensors.items() if not name.startswith("golden.")}
    return tensors, weights, json.loads((FIXTURES / "vggt/golden_public.json").read_text())


def metric3d_golden(name: str = "golden_public") -> tuple[dict, dict, Metric3DConfig]:
    """(all tensors of the file, the weights by official name, their config)."""
    tensors = load_file(FIXTURES / f"metric3d/{name}.safetensors")
    config = json.loads((FIXTURES / f"metric3d/{name}.json").read_text())["config"]
    config.pop("seed")
    weights = {key.removeprefix("weights/"): value for key, value in tensors.items() if key.startswith("weights/")}
    return tensors, weights, Metric3DConfig(**config)


def saved_forms(state: dict, folder: Path) -> dict[str, dict | Path]:
    """A checkpoint as a dict, a safetensors and a torch file, by what an error calls it."""
    save_file(state, folder / "a.safetensors")
    torch.save({"model_state_dict": state}, folder / "b.pth")
    return {"the given dict": state, **{str(path): path for path in (folder / "a.safetensors", folder / "b.pth")}}


def picture(height: int = 60, width: int = 80, seed: int = 0) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8))


def images(*shape, seed=1):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def relative(ours, theirs):
    return ((ours - theirs).abs() / theirs.abs()).max().item()
