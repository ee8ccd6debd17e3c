"""Configuration of Metric3D V2 (Hu et al., 2024): DINOv2 encoder with registers, recurrent depth and normal decoder.

A variant names the sizes of a released model; single fields may be given beside it.
"""

from typing import Any

from transformers import PreTrainedConfig

VARIANTS: dict[str, dict[str, Any]] = {
    "small": {
        "embed_dim": 384,
        "depth": 12,
        "num_heads": 6,
        "feature_channels": [96, 192, 384, 768],
        "decoder_channels": [48, 96, 192, 384, 384],
        "hidden_channels": [48, 48, 48, 48],
        "iters": 4,
    },
    "large": {
        "embed_dim": 1024,
        "depth": 24,
        "num_heads": 16,
        "feature_channels": [256, 512, 1024, 1024],
        "decoder_channels": [128, 256, 512, 1024, 1024],
        "hidden_channels": [128, 128, 128, 128],
        "iters": 8,
    },
    "giant2": {
        "embed_dim": 1536,
        "depth": 40,
        "num_heads": 24,
        "feature_channels": [384, 768, 1536, 1536],
        "decoder_channels": [192, 384, 768, 1536, 1536],
        "hidden_channels": [192, 192, 192, 192],
        "iters": 8,
    },
}


class Metric3DConfig(PreTrainedConfig):
    r"""
    Sizes left out are those of `variant`.

    Args:
        variant (`str`, *optional*, defaults to `"giant2"`): `"small"`, `"large"` or `"giant2"`. Giant2 gives the
            decoder the tokens after each quarter of its blocks, not normalised; the others four times the normalised
            last ones.
        embed_dim (`int`, *optional*): width of the tokens.
        depth (`int`, *optional*): number of encoder blocks.
        num_heads (`int`, *optional*): attention heads of a block.
        patch_size (`int`, *optional*, defaults to 14): side of a patch in pixels.
        num_register_tokens (`int`, *optional*, defaults to 4): tokens between the class token and the patches.
        pos_image_size (`int`, *optional*, defaults to 518): image side of the stored position embedding.
        feature_channels (`list[int]`, *optional*): widths of the feature maps at 1/4, 1/7, 1/14; the last is unused.
        decoder_channels (`list[int]`, *optional*): (unused, 1/4, 1/7, 1/14, 1/14) widths of the fusion.
        hidden_channels (`list[int]`, *optional*): of the recurrent states at 1/4, 1/7, 1/14; the last is unused.
        iters (`int`, *optional*): updates of the recurrent decoder.
        depth_min, depth_max (`float`, *optional*, defaults to 0.1 and 200.0): range of canonical depth in metres.
        mlp_ratio (`int`, *optional*, defaults to 4): hidden width of a block's MLP over `embed_dim`.
        swiglu_hidden (`int`, *optional*): hidden width of a SwiGLU feed-forward; None is an MLP, for giant2 two thirds
            of the MLP's width, rounded up to a multiple of 8.
        qkv_bias (`bool`, *optional*, defaults to `True`): bias of the attention's input projection.
        vit_layer_norm_eps (`float`, *optional*, defaults to 1e-6): of the encoder; the decoder has 1e-5.
        pos_interpolate_offset (`float`, *optional*, defaults to 0.1): added to the grid's sides to scale the position
            embedding; 0 scales it to the grid's size.
        pos_interpolate_antialias (`bool`, *optional*, defaults to `False`): of that bicubic interpolation.
        num_depth_bins (`int`, *optional*, defaults to 256): of the initial depth.
        regress_scale (`float`, *optional*, defaults to 100.0): metres per unit of the recurrent depth state.
        n_gru_layers (`int`, *optional*, defaults to 3), n_downsample (`int`, *optional*, defaults to 2),
        use_cls_token (`bool`, *optional*, defaults to `True`): as released; other values raise ValueError.
        slow_fast_gru (`bool`, *optional*, defaults to `True`): update the coarse states more often than the fine one.
    """

    model_type = "gift_metric3d"

    variant: str = "giant2"
    embed_dim: int | None = None
    depth: int | None = None
    num_heads: int | None = None
    patch_size: int = 14
    num_register_tokens: int = 4
    pos_image_size: int = 518
    feature_channels: list[int] | None = None
    decoder_channels: list[int] | None = None
    hidden_channels: list[int] | None = None
    iters: int | None = None
    depth_min: float = 0.1
    depth_max: float = 200.0
    mlp_ratio: int = 4
    swiglu_hidden: int | None = None
    qkv_bias: bool = True
    vit_layer_norm_eps: float = 1e-6
    pos_interpolate_offset: float = 0.1
    pos_interpolate_antialias: bool = False
    num_depth_bins: int = 256
    regress_scale: float = 100.0
    n_gru_layers: int = 3
    n_downsample: int = 2
    slow_fast_gru: bool = True
    use_cls_token: bool = True

    def __post_init__(self, **kwargs):
        if self.variant not in VARIANTS:
            raise ValueError(f"variant must be one of {', '.join(VARIANTS)}, got {self.variant!r}")
        for name, value in VARIANTS[self.variant].items():
            if getattr(self, name) is None:
                setattr(self, name, list(value) if isinstance(value, list) else value)
        if self.swiglu_hidden is None and self.variant == "giant2":
            self.swiglu_hidden = (int(int(self.embed_dim * self.mlp_ratio) * 2 / 3) + 7) // 8 * 8
        self._check()
        super().__post_init__(**kwargs)

    def _check(self) -> None:
        fixed = {"n_gru_layers": 3, "n_downsample": 2, "use_cls_token": True}
        for name, value in fixed.items():
            if getattr(self, name) != value:
                raise ValueError(f"{name} must be {value}, as in every released model, got {getattr(self, name)!r}")
        for name, length in (("feature_channels", 4), ("decoder_channels", 5), ("hidden_channels", 4)):
            if len(getattr(self, name)) != length:
                raise ValueError(f"{name} must have {length} entries, got {len(getattr(self, name))}")
        if self.iters < 1 or not 0 < self.depth_min < self.depth_max:
            raise ValueError("iters must be at least 1, and 0 < depth_min < depth_max")
        if self.embed_dim % self.num_heads:
            raise ValueError(f"embed_dim {self.embed_dim} is not a multiple of num_heads {self.num_heads}")
        if self.variant == "giant2" and (self.depth % 4 or self.depth < 4):
            raise ValueError(f"giant2 takes a feature after each quarter of its blocks: depth {self.depth} has none")
        # Maps of these widths meet in the decoder without a projection between them.
        features, fusion, hidden = self.feature_channels, self.decoder_channels, self.hidden_channels
        for one, other, names in (
            (features[2], self.embed_dim, "feature_channels[2] and embed_dim"),
            (fusion[3], self.embed_dim, "decoder_channels[3] and embed_dim"),
            (fusion[4], self.embed_dim, "decoder_channels[4] and embed_dim"),
            (fusion[2], features[1], "decoder_channels[2] and feature_channels[1]"),
            (hidden[0], hidden[2], "hidden_channels[0] and hidden_channels[2]"),
        ):
            if one != other:
                raise ValueError(f"{names} must be equal, got {one} and {other}")


__all__ = ["Metric3DConfig"]
