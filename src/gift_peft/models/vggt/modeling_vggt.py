"""VGGT's depth path: image transformer, aggregator that alternates frame and global attention, DPT depth head.

Module names are the official checkpoint's, so its safetensors load as they are. Nothing is kept in buffers: rotary
angles, position maps and pixel normalisation follow from the image size, and a buffer outside the checkpoint would
come back from `from_pretrained` undefined.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import PreTrainedModel
from transformers import initialization as init
from transformers.modeling_layers import GradientCheckpointingLayer
from transformers.modeling_outputs import DepthEstimatorOutput
from transformers.modeling_utils import ALL_ATTENTION_FUNCTIONS
from transformers.utils.generic import can_return_tuple

from .checkpoint_vggt import OPTIONAL, check_official, float32_copy, read_official
from .configuration_vggt import VggtConfig
from .head_vggt import VggtDepthHead

IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)
ALIGNMENT = 64  # bytes, of memory that torch allocates on the CPU
VIT_NORM_EPS = 1e-6  # the image transformer's; every other LayerNorm of VGGT has torch's 1e-5


@dataclass
class VggtDepthEstimatorOutput(DepthEstimatorOutput):
    """What [`VggtForDepthEstimation`] returns.

    Args:
        predicted_depth (`torch.Tensor` of shape `(B, H, W)`, or `(B, S, H, W)` for scenes of S frames):
            Depth along the camera's axis, relative (each scene has its own unit), positive.
        hidden_states (`tuple[torch.Tensor]`, *optional*, with `output_hidden_states=True`):
            The four token maps that the head reads, each `(B, S, 1 + registers + patches, 2 * embed_dim)`.
        confidence (`torch.Tensor`, shaped as `predicted_depth`):
            Confidence of each pixel, above 1.
    """

    confidence: Tensor | None = None


def eager_attention(
    module: nn.Module, query: Tensor, key: Tensor, value: Tensor, attention_mask: None, scaling: float, **kwargs: Any
) -> tuple[Tensor, Tensor]:
    """Attention over (B, heads, N, d) without a fused kernel, for `attn_implementation="eager"`."""
    weights = (query @ key.transpose(2, 3) * scaling).softmax(dim=-1)
    return (weights @ value).transpose(1, 2), weights


def rotary_angles(
    grid: tuple[int, int], num_special: int, head_dim: int, base: float, device: torch.device, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Cosine and sine, each (num_special + h * w, head_dim), of the 2-D rotary embedding of one frame's tokens.

    The first half of the channels turns with the patch's row, the second with its column, both counted from 1.
    Camera and register tokens are at 0: they do not turn.
    """
    height, width = grid
    half = head_dim // 2
    frequency = base ** -(torch.arange(0, half, 2, device=device, dtype=dtype) / half)
    rows = torch.arange(1, height + 1, device=device, dtype=dtype)[:, None].expand(height, width).reshape(-1, 1)
    columns = torch.arange(1, width + 1, device=device, dtype=dtype)[None, :].expand(height, width).reshape(-1, 1)
    rows, columns = rows * frequency, columns * frequency
    angles = F.pad(torch.cat([rows, rows, columns, columns], dim=-1), (0, 0, num_special, 0))
    return angles.cos(), angles.sin()


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Turn (B, heads, N, d) by angles (N, d): within each half, channel j pairs with channel j + d/4."""
    first, second = x.unflatten(-1, (2, 2, -1)).unbind(-2)
    return x * cos + torch.stack((-second, first), dim=-2).flatten(-3) * sin


class VggtAttention(nn.Module):
    def __init__(self, config: VggtConfig, qk_norm: bool):
        super().__init__()
        self.config = config
        self.head_dim = config.embed_dim // config.num_heads
        self.is_causal = False
        self.qkv = nn.Linear(config.embed_dim, 3 * config.embed_dim)
        self.q_norm = nn.LayerNorm(self.head_dim) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(self.head_dim) if qk_norm else nn.Identity()
        self.proj = nn.Linear(config.embed_dim, config.embed_dim)

    def forward(self, x: Tensor, cos: Tensor | None = None, sin: Tensor | None = None) -> Tensor:
        query, key, value = self.qkv(x).unflatten(-1, (3, -1, self.head_dim)).permute(2, 0, 3, 1, 4)
        query, key = self.q_norm(query), self.k_norm(key)
        if cos is not None:
            query, key = rotate(query, cos, sin), rotate(key, cos, sin)
        # Norms and angles may be float32 where autocast or bf16 weights make the values half.
        query, key = query.to(value.dtype), key.to(value.dtype)
        attention: Callable = ALL_ATTENTION_FUNCTIONS.get_interface(self.config._attn_implementation, eager_attention)
        x, _ = attention(self, query, key, value, None, scaling=self.head_dim**-0.5, dropout=0.0)
        return self.proj(x.flatten(2))


class VggtMlp(nn.Module):
    def __init__(self, config: VggtConfig):
        super().__init__()
        hidden = int(config.embed_dim * config.mlp_ratio)
        self.fc1 = nn.Linear(config.embed_dim, hidden)
        self.fc2 = nn.Linear(hidden, config.embed_dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class VggtLayerScale(nn.Module):
    def __init__(self, config: VggtConfig, initial: float):
        super().__init__()
        self.initial = initial
        self.gamma = nn.Parameter(torch.full((config.embed_dim,), initial))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class VggtBlock(GradientCheckpointingLayer):
    """Pre-norm transformer block. With `cos` and `sin` of (N, head_dim) its attention is rotary."""

    def __init__(self, config: VggtConfig, eps: float, layer_scale: float, qk_norm: bool):
        super().__init__()
        self.norm1 = nn.LayerNorm(config.embed_dim, eps=eps)
        self.attn = VggtAttention(config, qk_norm)
        self.ls1 = VggtLayerScale(config, layer_scale)
        self.norm2 = nn.LayerNorm(config.embed_dim, eps=eps)
        self.mlp = VggtMlp(config)
        self.ls2 = VggtLayerScale(config, layer_scale)

    def forward(self, x: Tensor, cos: Tensor | None = None, sin: Tensor | None = None) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x), cos, sin))
        return x + self.ls2(self.mlp(self.norm2(x)))


class VggtPatchEmbedding(nn.Module):
    def __init__(self, config: VggtConfig):
        super().__init__()
        self.proj = nn.Conv2d(3, config.embed_dim, kernel_size=config.patch_size, stride=config.patch_size)

    def forward(self, images: Tensor) -> Tensor:
        return self.proj(images.to(self.proj.weight.dtype)).flatten(2).transpose(1, 2)


class VggtVisionTransformer(nn.Module):
    """DINOv2 with registers: normalised images (B, 3, H, W) to patch tokens (B, h * w, C), final norm applied."""

    def __init__(self, config: VggtConfig):
        super().__init__()
        self.patch_size = config.patch_size
        self.grid_side = config.img_size // config.patch_size
        width = config.embed_dim
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + self.grid_side**2, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, config.num_register_tokens, width))
        self.mask_token = nn.Parameter(torch.zeros(1, width), requires_grad=False)  # stored, never used
        self.patch_embed = VggtPatchEmbedding(config)
        self.blocks = nn.ModuleList(
            VggtBlock(config, eps=VIT_NORM_EPS, layer_scale=1.0, qk_norm=False) for _ in range(config.vit_depth)
        )
        self.norm = nn.LayerNorm(width, eps=VIT_NORM_EPS)

    def position_embedding(self, grid: tuple[int, int], dtype: torch.dtype) -> Tensor:
        """(1, 1 + h * w, C): as stored on the native grid, else resized bicubically with antialiasing."""
        side = self.grid_side
        if grid == (side, side):
            return self.pos_embed.to(dtype)
        cls, patches = self.pos_embed[:, :1], self.pos_embed[:, 1:]
        patches = patches.unflatten(1, (side, side)).permute(0, 3, 1, 2)
        exact = torch.promote_types(patches.dtype, torch.float32)
        patches = F.interpolate(patches.to(exact), size=grid, mode="bicubic", antialias=True, align_corners=False)
        return torch.cat([cls, patches.flatten(2).transpose(1, 2).to(cls.dtype)], dim=1).to(dtype)

    def forward(self, images: Tensor) -> Tensor:
        batch, _, height, width = images.shape
        x = torch.cat([self.cls_token.expand(batch, -1, -1), self.patch_embed(images)], dim=1)
        x = x + self.position_embedding((height // self.patch_size, width // self.patch_size), x.dtype)
        registers = self.register_tokens.expand(batch, -1, -1)  # between cls and patches, without a position
        x = torch.cat([x[:, :1], registers.to(x.dtype), x[:, 1:]], dim=1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)[:, 1 + registers.shape[1] :]


class VggtAggregator(nn.Module):
    """Images (B, S, 3, H, W) in [0, 1] to the token maps that the head reads.

    Each is (B, S, 1 + registers + h * w, 2C): the tokens after a frame block beside those after the global block that
    follows. Frame blocks attend within a frame, global blocks over all frames of a scene.
    """

    def __init__(self, config: VggtConfig):
        super().__init__()
        self.config = config
        width = config.embed_dim
        self.patch_embed = VggtVisionTransformer(config)
        # Entry 0 belongs to the first frame of a scene, entry 1 to all others.
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, width))
        self.register_token = nn.Parameter(torch.zeros(1, 2, config.num_register_tokens, width))
        self.frame_blocks = self._blocks(config)
        self.global_blocks = self._blocks(config)

    @staticmethod
    def _blocks(config: VggtConfig) -> nn.ModuleList:
        return nn.ModuleList(
            VggtBlock(config, eps=1e-5, layer_scale=0.01, qk_norm=config.qk_norm) for _ in range(config.depth)
        )

    def forward(self, images: Tensor) -> list[Tensor]:
        config = self.config
        scenes, frames, _, height, width = images.shape
        patches = self.patch_embed(normalize(images).flatten(0, 1))
        special = torch.cat([self.camera_token, self.register_token], dim=2)
        special = torch.cat(
            [special[:, :1].expand(scenes, -1, -1, -1), special[:, 1:].expand(scenes, frames - 1, -1, -1)], dim=1
        )
        x = torch.cat([special.flatten(0, 1).to(patches.dtype), patches], dim=1)
        cos, sin = rotary_angles(
            (height // config.patch_size, width // config.patch_size),
            num_special=special.shape[2],
            head_dim=config.embed_dim // config.num_heads,
            base=config.rope_freq,
            device=x.device,
            dtype=torch.promote_types(x.dtype, torch.float32),
        )
        scene_cos, scene_sin = cos.repeat(frames, 1), sin.repeat(frames, 1)
        levels = {}
        for index, (frame_block, global_block) in enumerate(zip(self.frame_blocks, self.global_blocks, strict=True)):
            frame_tokens = frame_block(x, cos, sin)
            scene_tokens = global_block(
                frame_tokens.unflatten(0, (scenes, frames)).flatten(1, 2), scene_cos, scene_sin
            )
            x = scene_tokens.unflatten(1, (frames, -1)).flatten(0, 1)
            if index in config.intermediate_layer_idx:
                levels[index] = torch.cat([frame_tokens, x], dim=-1).unflatten(0, (scenes, frames))
        return [levels[index] for index in config.intermediate_layer_idx]


def normalize(images: Tensor) -> Tensor:
    """ImageNet mean and deviation of (B, S, 3, H, W), with plain numbers: no buffers, no copies to the device."""
    channels = zip(images.unbind(2), IMAGE_MEAN, IMAGE_STD, strict=True)
    return torch.stack([(channel - mean) / std for channel, mean, std in channels], dim=2)


class VggtForDepthEstimation(PreTrainedModel):
    """VGGT's aggregator and depth head."""

    config: VggtConfig
    config_class = VggtConfig
    base_model_prefix = "vggt"
    main_input_name = "pixel_values"
    input_modalities = ("image",)
    supports_gradient_checkpointing = True
    _no_split_modules = ["VggtBlock"]  # noqa: RUF012 (transformers declares them so)
    _supports_sdpa = True
    _keys_to_ignore_on_load_unexpected = [r"^(camera|point|track)_head\."]  # noqa: RUF012
    _keys_to_ignore_on_load_missing = [r"^aggregator\.patch_embed\.mask_token$"]  # noqa: RUF012

    def __init__(self, config: VggtConfig):
        super().__init__(config)
        self.aggregator = VggtAggregator(config)
        self.depth_head = VggtDepthHead(config)
        self.post_init()

    @classmethod
    def from_pretrained(cls, *args: Any, **kwargs: Any) -> Any:
        """As [`PreTrainedModel.from_pretrained`]; the loaded model computes the same bits as the one that was saved.

        Loaded weights are views into a file, at any address, and some CPU kernels (a product with a single row) add up
        in an order that depends on it. Here they get the alignment that a fresh tensor has.
        """
        loaded = super().from_pretrained(*args, **kwargs)
        model = loaded[0] if isinstance(loaded, tuple) else loaded  # with output_loading_info=True
        for parameter in model.parameters():
            if parameter.device.type == "cpu" and parameter.data_ptr() % ALIGNMENT:
                parameter.data = parameter.data.clone()
        return loaded

    @classmethod
    def from_official(
        cls, source: str | Path | Mapping[str, Tensor], config: VggtConfig | None = None
    ) -> "VggtForDepthEstimation":
        """The model with an official checkpoint's weights, float32, in eval mode.

        Args: `source` a `.safetensors`, `.pt` or `.pth` file, or tensors by official name (they are copied; entries
        outside `aggregator.` and `depth_head.` are ignored); `config` its sizes, VGGT-1B without.
        Raises FileNotFoundError, and ValueError naming the first tensor that does not fit, is there twice or is not
        finite, or what is wrong in a file.
        """
        where = "the given dict" if isinstance(source, Mapping) else str(source)
        state = read_official(source)
        with torch.device("meta"):
            model = cls(VggtConfig() if config is None else config)
        expected = model.state_dict()
        check_official(state, expected, where)
        if OPTIONAL not in state:
            state[OPTIONAL] = torch.zeros(expected[OPTIONAL].shape)
        for name in expected:
            # One at a time: a copy of all beside the file's own would double the memory.
            state[name] = float32_copy(state[name], name, where)
        model.load_state_dict(state, assign=True)
        return model.eval()

    @torch.no_grad()
    def _init_weights(self, module: nn.Module) -> None:
        super()._init_weights(module)
        if isinstance(module, VggtLayerScale):
            init.constant_(module.gamma, module.initial)
        elif isinstance(module, (VggtVisionTransformer, VggtAggregator)):
            for name, parameter in module.named_parameters(recurse=False):
                if name == "mask_token":
                    init.zeros_(parameter)
                else:
                    init.normal_(parameter, std=self.config.initializer_range)

    def get_input_embeddings(self) -> nn.Module:
        return self.aggregator.patch_embed.patch_embed

    @can_return_tuple
    def forward(
        self,
        pixel_values: Tensor,
        labels: None = None,
        output_hidden_states: bool | None = None,
        **kwargs: Any,
    ) -> VggtDepthEstimatorOutput:
        """Depth of RGB images in [0, 1] (the network normalises them itself).

        Args:
            pixel_values (`torch.Tensor`): floats of shape (B, 3, H, W), B scenes of one frame, or (B, S, 3, H, W), B
                scenes of S frames that see each other. H and W are multiples of the patch size.
            output_hidden_states (`bool`, *optional*): also return the token maps that the depth head reads.

        Raises ValueError for another shape or an integer dtype, NotImplementedError for `labels`.
        """
        if labels is not None:
            raise NotImplementedError("VggtForDepthEstimation has no loss of its own: leave labels out")
        self._check_input(pixel_values)
        images = pixel_values.unsqueeze(1) if pixel_values.ndim == 4 else pixel_values
        levels = self.aggregator(images)
        logits = self.depth_head(levels, tuple(images.shape[-2:]))
        # exp in half precision would round depth to 8 bits, and numpy knows no bf16.
        logits = logits.to(torch.promote_types(logits.dtype, torch.float32))
        depth, confidence = logits.exp().unbind(1)
        shape = pixel_values.shape[:-3] + pixel_values.shape[-2:]
        if output_hidden_states is None:
            output_hidden_states = self.config.output_hidden_states
        return VggtDepthEstimatorOutput(
            predicted_depth=depth.reshape(shape),
            confidence=1 + confidence.reshape(shape),
            hidden_states=tuple(levels) if output_hidden_states else None,
        )

    def _check_input(self, pixel_values: Tensor) -> None:
        shape = tuple(pixel_values.shape)
        if len(shape) not in (4, 5) or shape[-3] != 3:
            raise ValueError(f"pixel_values must be (B, 3, H, W) or (B, S, 3, H, W), got {shape}")
        if 0 in shape:
            raise ValueError(f"pixel_values is empty: {shape}")
        if not pixel_values.is_floating_point():
            raise ValueError(f"pixel_values must be floats in [0, 1], got {pixel_values.dtype}")
        patch = self.config.patch_size
        if shape[-2] % patch or shape[-1] % patch:
            raise ValueError(f"image size {shape[-2]}x{shape[-1]}: height and width must be multiples of {patch}")


__all__ = ["VggtDepthEstimatorOutput", "VggtForDepthEstimation"]
