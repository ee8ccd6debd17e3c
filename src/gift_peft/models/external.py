"""Depth models of other packages, to stand beside ours in a table: `da3:<id>` and `moge:<id>` where a base is named.

Thin: the package (depth-anything-3, or MoGe as dlr-moge) is imported when such a base is asked for, and its network is
called as a transformers depth model is: `pixel_values` (B,3,H,W) in, `.predicted_depth` (B,H,W) out, in float32, and
MoGe's own mask as `.valid_mask`. They cannot carry a GIFT adapter; MoGe converted by `gift-peft convert moge` can.
"""

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from transformers import DPTImageProcessorPil
from transformers.modeling_outputs import DepthEstimatorOutput

from gift_peft.files import reason
from gift_peft.models.moge.modeling_moge import MogeDepthEstimatorOutput
from gift_peft.models.moge.package_moge import INSTALL

SIZE = (476, 644)  # of the paper's backbones; a multiple of the patches of both
PATCH = 14
# What the packages' loaders raise for the weights of something else, or for a file that holds none.
NOT_ITS_WEIGHTS = (RuntimeError, LookupError, TypeError, AttributeError, ValueError, EOFError, pickle.UnpicklingError)
IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}


@dataclass(frozen=True)
class ExternalConfig:
    """What the evaluation asks a model's configuration for.

    Args:
        model_type (`str`): `da3` or `moge`.
        depth_estimation_type (`str`, *optional*): `metric` where depth is in metres.
        prediction_kind (`str`): both predict depth.
        predicts_valid_mask (`bool`): whether it says where there is no surface.
        patch_size (`int`): sides of the input are multiples of it.
    """

    model_type: str
    depth_estimation_type: str | None = None
    prediction_kind: str = "depth"
    predicts_valid_mask: bool = False
    patch_size: int = PATCH


class ExternalDepth(nn.Module):
    """`predict` (pixel_values to an output with `predicted_depth`) of a `network`, as a transformers depth model."""

    def __init__(self, network: nn.Module, predict: Callable[[Any, torch.Tensor], Any], config) -> None:
        super().__init__()
        self.network, self.predict, self.config = network, predict, config

    def forward(self, pixel_values: torch.Tensor) -> Any:
        return self.predict(self.network, pixel_values)


def split_external(base: Any) -> tuple[str, str] | None:
    """("da3" or "moge", id) of a base named with such a prefix, else None."""
    package, colon, name = str(base).partition(":")
    return (package, name) if colon and package in _LOADERS else None


def load_external(base: Any) -> tuple[ExternalDepth, DPTImageProcessorPil]:
    """The model and an image processor for it.

    Raises ValueError naming the base where its package cannot be imported or reads no such weights, FileNotFoundError
    where there are none.
    """
    package, _, name = str(base).partition(":")
    try:
        return _LOADERS[package](name)
    except ImportError as error:
        raise ValueError(f"base {base}: {error}; {_INSTALL[package]}") from None
    except OSError as error:
        raise FileNotFoundError(f"base {base}: {reason(error)}") from None
    except NOT_ITS_WEIGHTS as error:
        told = reason(error)
        why = f"not a file of weights ({told})" if told.isdigit() else told  # what unpickling says of other files
        raise ValueError(f"base {base}: {why}") from None


# ---- Depth Anything 3 ----


def _load_da3(name: str) -> tuple[ExternalDepth, DPTImageProcessorPil]:
    from depth_anything_3.api import DepthAnything3

    model = DepthAnything3.from_pretrained(name)
    # Only the nested model scales its depth to metres; the metric one needs the camera's focal length for that.
    metric = "metric" if "nested" in getattr(model, "model_name", "") else None
    return ExternalDepth(model.model, _predict_da3, ExternalConfig("da3", metric)), _processor(**IMAGENET)


def _predict_da3(network: nn.Module, pixel_values: torch.Tensor) -> DepthEstimatorOutput:
    # The network below its API, which would autocast to half precision; every image is a scene of one view.
    return DepthEstimatorOutput(predicted_depth=network(pixel_values[:, None])["depth"][:, 0])


# ---- MoGe ----


def _load_moge(name: str) -> tuple[ExternalDepth, DPTImageProcessorPil]:
    from moge.model import v1, v2

    try:
        model = v2.MoGeModel.from_pretrained(name)
    except TypeError:  # a checkpoint of the first version has none of the second's parts
        model = v1.MoGeModel.from_pretrained(name)
    metric = "metric" if hasattr(model, "scale_head") else None
    # MoGe normalises colours itself.
    config = ExternalConfig("moge", metric, predicts_valid_mask=True)
    return ExternalDepth(model, _predict_moge, config), _processor(do_normalize=False)


def _predict_moge(network: Any, pixel_values: torch.Tensor) -> MogeDepthEstimatorOutput:
    # Unmasked: where MoGe masks, it says infinity, and a mirror is what it may mask.
    found = network.infer(pixel_values, apply_mask=False, use_fp16=False)
    return MogeDepthEstimatorOutput(predicted_depth=found["depth"], valid_mask=found.get("mask"))


# Its metadata asks for numpy below 2, xformers and open3d, which its networks do not use: it runs with numpy 2.
INSTALL_DA3 = (
    "pip install --no-deps depth-anything-3==0.1.1 moviepy==1.0.3 evo",
    "pip install torchvision omegaconf addict einops plyfile pycolmap scipy imageio imageio-ffmpeg proglog decorator "
    "requests",
)
_LOADERS = {"da3": _load_da3, "moge": _load_moge}
_INSTALL = {
    "da3": f"`{INSTALL_DA3[0]}` and `{INSTALL_DA3[1]}`",
    "moge": f"`{INSTALL}`",
}


def _processor(**settings: Any) -> DPTImageProcessorPil:
    size = {"height": SIZE[0], "width": SIZE[1]}
    return DPTImageProcessorPil(size=size, ensure_multiple_of=PATCH, keep_aspect_ratio=False, resample=3, **settings)
