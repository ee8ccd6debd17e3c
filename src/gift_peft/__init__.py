"""Geometry-invariant fine-tuning (GIFT): depth models learn to see mirrors and glass, without depth labels.

Importing the package makes `datasets.load_dataset("gift_i", data_dir=...)` work and transformers' Auto classes know
VGGT and Metric3D V2. The names below are imported when first used, so that `gift-peft --help` does not wait for torch.
"""

from importlib import import_module

from gift_peft.dataset.gift_i import register
from gift_peft.models import register_models

__version__ = "0.1.0"

_HOME = {
    "DepthModel": "models.loading",
    "GeometryConsistencyError": "losses",
    "GiftI": "dataset.gift_i",
    "GiftRecipe": "adapters.recipes",
    "GroupStep": "group_step",
    "Metric3DConfig": "models.metric3d",
    "Metric3DForDepthEstimation": "models.metric3d",
    "PROTOCOLS": "evaluation.protocols",
    "RECIPES": "adapters.recipes",
    "VggtConfig": "models.vggt",
    "VggtForDepthEstimation": "models.vggt",
    "align": "evaluation.alignment",
    "depth_metrics": "evaluation.metrics",
    "evaluate_booster": "evaluation.evaluate",
    "evaluate_gift_i": "evaluation.evaluate",
    "geometry_consistency_error": "losses",
    "get_gift_model": "adapters.recipes",
    "gift_loss": "losses",
    "group_consistency_loss": "losses",
    "load_gift_i": "dataset.gift_i",
    "masked_l1": "losses",
    "save_adapter": "adapters.folder",
    "self_distillation_loss": "losses",
    "set_adapter_scale": "adapters.scale",
}

__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'gift_peft' has no attribute {name!r}")
    value = getattr(import_module(f"gift_peft.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register()
register_models()
