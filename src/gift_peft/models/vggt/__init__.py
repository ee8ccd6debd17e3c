"""VGGT (Wang et al., 2025), depth path only, as a transformers model.

Saved folders carry these files, so that they also load with `trust_remote_code=True` where gift-peft is not installed.
"""

from gift_peft.models.auto_classes import register_classes

from .configuration_vggt import VggtConfig
from .image_processing_vggt import VggtImageProcessorPil
from .modeling_vggt import VggtForDepthEstimation

__all__ = ["VggtConfig", "VggtForDepthEstimation", "VggtImageProcessorPil"]

register_classes(VggtConfig, VggtForDepthEstimation, VggtImageProcessorPil)
