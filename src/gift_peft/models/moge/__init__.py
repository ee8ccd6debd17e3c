"""MoGe and MoGe-2 (Wang et al., 2024 and 2025) as a transformers model: the network is that of the package dlr-moge.

Saved folders carry these files, so that they also load with `trust_remote_code=True` where gift-peft is not installed;
the package they need everywhere.
"""

from gift_peft.models.auto_classes import register_classes

from .configuration_moge import MogeConfig
from .image_processing_moge import MogeImageProcessorPil
from .modeling_moge import MogeForDepthEstimation

__all__ = ["MogeConfig", "MogeForDepthEstimation", "MogeImageProcessorPil"]

register_classes(MogeConfig, MogeForDepthEstimation, MogeImageProcessorPil)
