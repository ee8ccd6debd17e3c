"""Metric3D V2 (Hu et al., 2024), Small, Large and Giant2, as a transformers model.

Saved folders carry these files, so that they also load with `trust_remote_code=True` where gift-peft is not installed.
"""

from gift_peft.models.auto_classes import register_classes

from .configuration_metric3d import Metric3DConfig
from .image_processing_metric3d import Metric3DImageProcessorPil
from .modeling_metric3d import Metric3DForDepthEstimation

__all__ = ["Metric3DConfig", "Metric3DForDepthEstimation", "Metric3DImageProcessorPil"]

register_classes(Metric3DConfig, Metric3DForDepthEstimation, Metric3DImageProcessorPil)
