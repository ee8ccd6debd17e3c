"""Configuration of MoGe (Wang et al., CVPR 2025) and MoGe-2 (2025): the sizes are what the checkpoints state.

A variant names the sizes of a released model, for a network without its weights.
"""

from typing import Any

from transformers import PreTrainedConfig


def _stack(width: int, outputs: int, blocks: int = 1) -> dict[str, Any]:
    """A head of MoGe-2: feature pyramid in, `outputs` channels at the finest level out."""
    return {
        "dim_in": [width, 256, 128, 64, 32],
        "dim_out": [None, None, None, None, outputs],
        "dim_res_blocks": [width, 256, 128, 64, 32],
        "num_res_blocks": [0, blocks, blocks, blocks, 0],
        "res_block_in_norm": "none",
        "res_block_hidden_norm": "none",
        "resamplers": ["conv_transpose", "conv_transpose", "conv_transpose", "bilinear"],
    }


def _second(backbone: str, width: int, layers: list[int], blocks: int, normals: bool) -> dict[str, Any]:
    """The sizes of a MoGe-2."""
    network = {
        "encoder": {"backbone": backbone, "intermediate_layers": layers, "dim_out": width},
        "neck": _stack(width, 0, blocks) | {"dim_in": [width + 2, 2, 2, 2, 2], "dim_out": None},
        "points_head": _stack(width, 3),
        "mask_head": _stack(width, 1),
        "scale_head": {"dims": [width, width, width, 1]},
        "remap_output": "exp",
        "num_tokens_range": [1200, 3600],
    }
    return network | ({"normal_head": _stack(width, 3)} if normals else {})


VARIANTS: dict[str, dict[str, Any]] = {
    "moge-vitl": {
        "encoder": "dinov2_vitl14",
        "remap_output": "exp",
        "intermediate_layers": 4,
        "dim_upsample": [256, 128, 64],
        "dim_times_res_block_hidden": 2,
        "num_res_blocks": 2,
        "trained_area_range": [250000, 500000],
        "last_conv_channels": 32,
        "last_conv_size": 1,
    },
    "moge-2-vitl": _second("dinov2_vitl14", 1024, [5, 11, 17, 23], 2, False),
    "moge-2-vitl-normal": _second("dinov2_vitl14", 1024, [5, 11, 17, 23], 2, True),
    "moge-2-vitb-normal": _second("dinov2_vitb14", 768, [5, 11], 1, True),
    "moge-2-vits-normal": _second("dinov2_vits14", 384, [5, 11], 1, True),
}


class MogeConfig(PreTrainedConfig):
    r"""
    Args:
        variant (`str`, *optional*): the released model whose sizes `network` has where it is not given; default
            `"moge-2-vitl-normal"`.
        network (`dict`, *optional*): arguments of the package's `MoGeModel`, which a checkpoint has as `model_config`;
            in its first version `encoder` is a name, in the second a dict.
        num_tokens (`int`, *optional*): patches of a picture at the vision transformer, whatever the picture's size;
            default the package's, the most that the network was trained for.
    """

    model_type = "gift_moge"

    variant: str | None = None
    network: dict | None = None
    num_tokens: int | None = None

    def __post_init__(self, **kwargs):
        if self.network is None:
            self.variant = self.variant or "moge-2-vitl-normal"
            if self.variant not in VARIANTS:
                raise ValueError(f"variant must be one of {', '.join(VARIANTS)}, got {self.variant!r}")
            self.network = VARIANTS[self.variant]
        if not isinstance(self.network.get("encoder"), (str, dict)):
            raise ValueError("network: not the arguments of a MoGe network, it names no encoder")
        if self.num_tokens is not None and self.num_tokens < 1:
            raise ValueError(f"num_tokens must be positive, got {self.num_tokens}")
        super().__post_init__(**kwargs)

    @property
    def version(self) -> str:
        """`v1` or `v2`, the package's module."""
        return "v1" if isinstance(self.network["encoder"], str) else "v2"

    @property
    def depth_estimation_type(self) -> str:
        """`metric`: depth is in metres; `affine`: of unknown scale, the network has no scale head."""
        return "metric" if self.network.get("scale_head") else "affine"

    @property
    def predicts_valid_mask(self) -> bool:
        """Whether the network says where there is no surface."""
        return self.version == "v1" or bool(self.network.get("mask_head"))


__all__ = ["MogeConfig"]
