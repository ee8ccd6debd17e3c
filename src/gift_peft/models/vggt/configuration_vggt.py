"""Sizes of a VGGT depth network; the defaults are VGGT-1B.

Only what the depth path needs: the aggregator (image tokens, then alternating attention within a frame and over all
frames of a scene) and the DPT depth head. The camera, point and track heads of official checkpoints have no fields.
"""

from huggingface_hub.dataclasses import strict
from transformers import PreTrainedConfig

NUM_LEVELS = 4  # a DPT head fuses four feature maps, at 4, 2, 1 and 1/2 times the patch grid


@strict
class VggtConfig(PreTrainedConfig):
    r"""
    Configuration of [`VggtForDepthEstimation`].

    Args:
        img_size (`int`, *optional*, defaults to 518):
            Side of the images whose patch grid the stored position embedding has. Other sizes interpolate it.
        patch_size (`int`, *optional*, defaults to 14):
            Side of a patch; image heights and widths must be multiples of it.
        embed_dim (`int`, *optional*, defaults to 1024):
            Width of all tokens. The depth head sees twice as much, the frame and the global token side by side.
        num_heads (`int`, *optional*, defaults to 16):
            Attention heads of every block.
        mlp_ratio (`float`, *optional*, defaults to 4.0):
            Width of the blocks' MLPs over `embed_dim`.
        num_register_tokens (`int`, *optional*, defaults to 4):
            Register tokens of the image transformer and, as separate parameters, of the aggregator.
        vit_depth (`int`, *optional*, defaults to 24):
            Blocks of the image transformer.
        depth (`int`, *optional*, defaults to 24):
            Rounds of the aggregator, each one frame block and one global block.
        intermediate_layer_idx (`list[int]`, *optional*, defaults to `[4, 11, 17, 23]`):
            The four rounds (from 0) whose tokens the depth head reads.
        rope_freq (`float`, *optional*, defaults to 100):
            Base of the rotary position embedding.
        qk_norm (`bool`, *optional*, defaults to `True`):
            Whether the aggregator's blocks normalise queries and keys.
        features (`int`, *optional*, defaults to 256):
            Channels of the depth head's fusion.
        out_channels (`list[int]`, *optional*, defaults to `[256, 512, 1024, 1024]`):
            Channels of the four projected feature maps, before fusion.
        head_features_2 (`int`, *optional*, defaults to 32):
            Channels before the last convolution.
        initializer_range (`float`, *optional*, defaults to 0.02):
            Standard deviation of random weights.

    Raises ValueError for sizes that do not fit together.
    """

    model_type = "gift_vggt"
    attribute_map = {  # noqa: RUF012 (transformers declares it so)
        "hidden_size": "embed_dim",
        "num_attention_heads": "num_heads",
        "num_hidden_layers": "depth",
        "image_size": "img_size",
    }

    img_size: int = 518
    patch_size: int = 14
    embed_dim: int = 1024
    num_heads: int = 16
    mlp_ratio: float | int = 4.0
    num_register_tokens: int = 4
    vit_depth: int = 24
    depth: int = 24
    intermediate_layer_idx: list[int] | tuple[int, ...] = (4, 11, 17, 23)
    rope_freq: float | int = 100
    qk_norm: bool = True
    features: int = 256
    out_channels: list[int] | tuple[int, ...] = (256, 512, 1024, 1024)
    head_features_2: int = 32
    initializer_range: float = 0.02

    def __post_init__(self, **kwargs):
        super().__post_init__(**kwargs)
        self.intermediate_layer_idx = list(self.intermediate_layer_idx)
        self.out_channels = list(self.out_channels)
        for name in ("intermediate_layer_idx", "out_channels"):
            if len(getattr(self, name)) != NUM_LEVELS:
                raise ValueError(f"{name} must have {NUM_LEVELS} entries, got {getattr(self, name)}")
        if not all(0 <= index < self.depth for index in self.intermediate_layer_idx):
            raise ValueError(f"intermediate_layer_idx {self.intermediate_layer_idx} must lie in 0..{self.depth - 1}")
        if self.embed_dim % (4 * self.num_heads):
            raise ValueError(
                f"embed_dim {self.embed_dim} must be a multiple of 4 * num_heads = {4 * self.num_heads}: rotary "
                "embedding turns pairs of channels of each head, half of them by row and half by column"
            )
        # Position maps put a sine and a cosine of each axis into a quarter of the channels.
        if self.features % 8 or any(channels % 4 for channels in self.out_channels):
            raise ValueError(
                f"features {self.features} must be a multiple of 8, out_channels {self.out_channels} of 4"
            )
        if self.img_size % self.patch_size:
            raise ValueError(f"img_size {self.img_size} must be a multiple of patch_size {self.patch_size}")


__all__ = ["VggtConfig"]
