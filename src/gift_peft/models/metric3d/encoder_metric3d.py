"""Encoder of Metric3D V2: a DINOv2 vision transformer with register tokens, under the official parameter names.

Pre-norm blocks x += ls1*attention(norm1 x); x += ls2*ffn(norm2 x), with a position embedding that is scaled as the
first DINO release did it (bicubic, by a scale factor and not by a size).
"""

import torch
from torch import nn
from torch.nn import functional as F
from transformers.modeling_layers import GradientCheckpointingLayer

from .configuration_metric3d import Metric3DConfig


def full_precision(x: torch.Tensor) -> torch.Tensor:
    """float32 from half precision; float32 and float64 as they are."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


class Metric3DPatchEmbed(nn.Module):
    def __init__(self, config: Metric3DConfig):
        super().__init__()
        self.proj = nn.Conv2d(3, config.embed_dim, config.patch_size, config.patch_size)

    def forward(self, pixel_values: torch.Tensor) -> torch.Tensor:
        """(B,3,H,W) to (B,C,h,w), one token per patch."""
        return self.proj(pixel_values.to(self.proj.weight.dtype))


class Metric3DAttention(nn.Module):
    def __init__(self, config: Metric3DConfig):
        super().__init__()
        self.num_heads = config.num_heads
        self.qkv = nn.Linear(config.embed_dim, 3 * config.embed_dim, bias=config.qkv_bias)
        self.proj = nn.Linear(config.embed_dim, config.embed_dim)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        q, k, v = self.qkv(x).unflatten(-1, (3, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        return self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class Metric3DLayerScale(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), 1e-5))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x * self.gamma


class Metric3DMlp(nn.Module):
    def __init__(self, config: Metric3DConfig):
        super().__init__()
        hidden = int(config.embed_dim * config.mlp_ratio)
        self.fc1 = nn.Linear(config.embed_dim, hidden)
        self.fc2 = nn.Linear(hidden, config.embed_dim)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class Metric3DSwiGLU(nn.Module):
    def __init__(self, config: Metric3DConfig):
        super().__init__()
        self.w12 = nn.Linear(config.embed_dim, 2 * config.swiglu_hidden)
        self.w3 = nn.Linear(config.swiglu_hidden, config.embed_dim)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        gate, value = self.w12(x).chunk(2, dim=-1)
        return self.w3(F.silu(gate) * value)


class Metric3DBlock(GradientCheckpointingLayer):
    def __init__(self, config: Metric3DConfig):
        super().__init__()
        width, eps = config.embed_dim, config.vit_layer_norm_eps
        self.norm1 = nn.LayerNorm(width, eps=eps)
        self.attn = Metric3DAttention(config)
        self.ls1 = Metric3DLayerScale(width)
        self.norm2 = nn.LayerNorm(width, eps=eps)
        self.mlp = Metric3DMlp(config) if config.swiglu_hidden is None else Metric3DSwiGLU(config)
        self.ls2 = Metric3DLayerScale(width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class Metric3DEncoder(nn.Module):
    """Tokens at four depths of a vision transformer. `mask_token` and giant2's `norm` are stored but take no part."""

    def __init__(self, config: Metric3DConfig):
        super().__init__()
        self.config = config
        width, self.grid = config.embed_dim, config.pos_image_size // config.patch_size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + self.grid**2, width))
        registers = config.num_register_tokens
        self.register_tokens = nn.Parameter(torch.zeros(1, registers, width)) if registers else None
        self.mask_token = nn.Parameter(torch.zeros(1, width))
        self.patch_embed = Metric3DPatchEmbed(config)
        # One chunk of all blocks: the official names have its index.
        self.blocks = nn.ModuleList([nn.ModuleList(Metric3DBlock(config) for _ in range(config.depth))])
        self.norm = nn.LayerNorm(width, eps=config.vit_layer_norm_eps)

    def forward(self, pixel_values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """(B,3,H,W), sides multiples of the patch, to four (B,1+R+h*w,C), shallow to deep."""
        x = self.patch_embed(pixel_values)
        grid = x.shape[-2:]
        x = torch.cat([self.cls_token.expand(x.shape[0], -1, -1), x.flatten(2).transpose(1, 2)], dim=1)
        x = x + self._positions(*grid)
        if self.register_tokens is not None:
            x = torch.cat([x[:, :1], self.register_tokens.expand(x.shape[0], -1, -1), x[:, 1:]], dim=1)
        features, quarter = [], self.config.depth // 4
        for index, block in enumerate(self.blocks[0], start=1):
            x = block(x)
            if self.config.variant == "giant2" and index % quarter == 0:
                features.append(x)
        return tuple(features) if features else (self.norm(x),) * 4

    def _positions(self, height: int, width: int) -> torch.Tensor:
        """Position embedding (1,1+height*width,C) for that grid of patches."""
        if height == width == self.grid:
            return self.pos_embed
        table = full_precision(self.pos_embed[:, 1:]).unflatten(1, (self.grid, self.grid)).permute(0, 3, 1, 2)
        offset = self.config.pos_interpolate_offset
        if offset:  # the sampling grid follows the offset scale factor, which a size would not reproduce
            target = {"scale_factor": ((height + offset) / self.grid, (width + offset) / self.grid)}
        else:
            target = {"size": (height, width)}
        table = F.interpolate(table, mode="bicubic", antialias=self.config.pos_interpolate_antialias, **target)
        patches = table.flatten(2).transpose(1, 2).to(self.pos_embed.dtype)
        return torch.cat([self.pos_embed[:, :1], patches], dim=1)
