"""Metric3D V2 with a vision transformer (Hu et al., 2024): metric depth and normals of single images.

Depth is that of a canonical camera with a focal length of 1000 pixels: times f / 1000 it is metric, f being the focal
length of the image as the network sees it (`Metric3DImageProcessorPil.post_process_depth_estimation` does that).
Parameters have their official names.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F
from transformers import PreTrainedModel
from transformers import initialization as init
from transformers.modeling_outputs import DepthEstimatorOutput
from transformers.utils import can_return_tuple

from .checkpoint_metric3d import WIDTH, fit_official, read_official
from .configuration_metric3d import VARIANTS, Metric3DConfig
from .decoder_metric3d import Metric3DDecoder, Metric3DDecoderOutput
from .encoder_metric3d import Metric3DEncoder, Metric3DLayerScale

ALIGNMENT = 64  # bytes, of memory that torch allocates on the CPU


@dataclass
class Metric3DDepthEstimatorOutput(DepthEstimatorOutput):
    """
    Args:
        predicted_depth (`torch.Tensor` of shape `(B, H', W')`): canonical-camera metres in [depth_min, depth_max].
        confidence (`torch.Tensor` of shape `(B, H', W')`): of the depth, unbounded; the original trains it towards one
            minus the relative error.
        normals (`torch.Tensor` of shape `(B, 4, H', W')`): unit normal x, y, z and its concentration kappa >= 0.01.
        predictions_list, confidence_list, normal_out_list (`tuple[torch.Tensor]`, *optional*): the same after every
            iteration, oldest first, of shapes `(B, 1, H', W')`, `(B, 1, H', W')`, `(B, 4, H', W')`; in train mode the
            initial state comes first, so that there are `iters + 1`.
        low_resolution_init (`tuple[torch.Tensor]`, *optional*): depth, confidence and normal of the initial state at a
            quarter of H', W'; empty in eval mode.
    """

    confidence: torch.Tensor | None = None
    normals: torch.Tensor | None = None
    predictions_list: tuple[torch.Tensor, ...] | None = None
    confidence_list: tuple[torch.Tensor, ...] | None = None
    normal_out_list: tuple[torch.Tensor, ...] | None = None
    low_resolution_init: tuple[torch.Tensor, ...] | None = None


class Metric3DDensePrediction(nn.Module):
    """Encoder and decoder, under their official names."""

    def __init__(self, config: Metric3DConfig):
        super().__init__()
        self.patch_size = config.patch_size
        self.encoder = Metric3DEncoder(config)
        self.decoder = Metric3DDecoder(config)

    def forward(self, pixel_values: torch.Tensor, every: bool, initial: bool) -> Metric3DDecoderOutput:
        height, width = (-(-side // self.patch_size) for side in pixel_values.shape[-2:])
        size = (height * self.patch_size, width * self.patch_size)
        if size != tuple(pixel_values.shape[-2:]):
            pixel_values = F.interpolate(pixel_values, size=size, mode="bilinear", align_corners=False)
        return self.decoder(self.encoder(pixel_values), (height, width), every, initial)


class Metric3DForDepthEstimation(PreTrainedModel):
    """Metric3D V2 (Small, Large, Giant2) for single images."""

    config: Metric3DConfig
    config_class = Metric3DConfig
    base_model_prefix = ""
    main_input_name = "pixel_values"
    input_modalities = ("image",)
    supports_gradient_checkpointing = True
    _supports_sdpa = True
    _no_split_modules = ["Metric3DBlock", "Metric3DDecoder"]  # noqa: RUF012 (transformers declares them so)

    def __init__(self, config: Metric3DConfig):
        super().__init__(config)
        self.depth_model = Metric3DDensePrediction(config)
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
        cls, source: str | Path | Mapping[str, torch.Tensor], config: Metric3DConfig | None = None
    ) -> "Metric3DForDepthEstimation":
        """The model with an official checkpoint's weights, float32, in eval mode.

        Args: `source` a `.safetensors`, `.pt` or `.pth` file, or tensors by official name (they are copied); `config`
        its sizes, without it those of the released variant of that width.
        Raises FileNotFoundError, and ValueError naming the first tensor that does not fit, is there twice or is not
        finite, or the file's damage.
        """
        where = "the given dict" if isinstance(source, Mapping) else str(source)
        state = read_official(source)
        if config is None:
            config = _released_config(state, where)
        with torch.device("meta"):
            model = cls(config)
        model.load_state_dict(fit_official(state, model.state_dict(), config.variant, where), assign=True)
        return model.eval()

    @torch.no_grad()
    def _init_weights(self, module: nn.Module) -> None:
        super()._init_weights(module)
        if isinstance(module, Metric3DLayerScale):
            init.constant_(module.gamma, 1e-5)
        elif isinstance(module, Metric3DEncoder):
            for name, parameter in module.named_parameters(recurse=False):
                if name == "mask_token":
                    init.zeros_(parameter)
                else:
                    init.normal_(parameter, std=0.02)

    def get_input_embeddings(self) -> nn.Module:
        return self.depth_model.encoder.patch_embed

    @can_return_tuple
    def forward(
        self,
        pixel_values: torch.Tensor,
        labels: None = None,
        output_iterations: bool | None = None,
        **kwargs: Any,
    ) -> Metric3DDepthEstimatorOutput:
        """Depth, confidence and normals of images, normalised as the image processor does it.

        Args:
            pixel_values (`torch.Tensor`): floats of shape (B, 3, H, W), sides of at least a patch. Sides that are no
                multiple of the patch size are stretched to the next one, h and w patches; outputs are
                H' = 4 floor(3.5 h) high and W' = 4 floor(3.5 w) wide: H and W for multiples of 28.
            output_iterations (`bool`, *optional*): also return the prediction after every iteration; default in train
                mode only. Otherwise only the last is upsampled.

        Raises ValueError for another shape or an integer dtype, NotImplementedError for `labels`.
        """
        if labels is not None:
            raise NotImplementedError("Metric3DForDepthEstimation has no loss of its own: leave labels out")
        self._check_input(pixel_values)
        every = self.training if output_iterations is None else output_iterations
        output = self.depth_model(pixel_values, every, initial=every and self.training)
        lists: dict[str, Any] = {}
        if every:
            depths, confidences, normals = zip(*output.every, strict=True)
            lists = {
                "predictions_list": depths,
                "confidence_list": confidences,
                "normal_out_list": normals,
                "low_resolution_init": tuple(output.initial or ()),
            }
        return Metric3DDepthEstimatorOutput(
            predicted_depth=output.last.depth.squeeze(1),
            confidence=output.last.confidence.squeeze(1),
            normals=output.last.normal,
            **lists,
        )

    def _check_input(self, pixel_values: torch.Tensor) -> None:
        shape, patch = tuple(pixel_values.shape), self.config.patch_size
        if len(shape) != 4 or shape[1] != 3:
            raise ValueError(f"pixel_values must be (B, 3, H, W), got {shape}")
        if 0 in shape:
            raise ValueError(f"pixel_values is empty: {shape}")
        if not pixel_values.is_floating_point():
            raise ValueError(f"pixel_values must be normalised floats, got {pixel_values.dtype}")
        if min(shape[2:]) < patch:
            raise ValueError(f"image size {shape[2]}x{shape[3]}: height and width must be at least {patch}")


def _released_config(state: Mapping[str, torch.Tensor], where: str) -> Metric3DConfig:
    """The config of the variant whose tokens have this width; ValueError if there is none."""
    width = (0, *state[WIDTH].shape)[-1]
    for variant, sizes in VARIANTS.items():
        if sizes["embed_dim"] == width:
            return Metric3DConfig(variant=variant)
    shape = tuple(state[WIDTH].shape)
    raise ValueError(f"{where}: {WIDTH} has shape {shape}, which is none of {', '.join(VARIANTS)}; give a config")


__all__ = ["Metric3DDepthEstimatorOutput", "Metric3DForDepthEstimation"]
