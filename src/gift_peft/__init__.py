"""Geometry-invariant fine-tuning (GIFT): depth models learn to see mirrors and glass, without depth labels.

Makes `datasets.load_dataset("gift_i", data_dir=...)` work and transformers' Auto classes know VGGT, Metric3D V2 and
MoGe, as soon as these packages are imported. The names below are imported when first used: `import gift_peft` is
quick.
"""

import importlib.util
import sys
from collections.abc import Callable
from importlib import import_module

from gift_peft.dataset import register_builder
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
    "MogeConfig": "models.moge",
    "MogeForDepthEstimation": "models.moge",
    "PROTOCOLS": "evaluation.protocols",
    "RECIPES": "adapters.recipes",
    "VggtConfig": "models.vggt",
    "VggtForDepthEstimation": "models.vggt",
    "align": "evaluation.alignment",
    "depth_metrics": "evaluation.metrics",
    "evaluate_booster": "evaluation.evaluate",
    "evaluate_gift_i": "evaluation.evaluate",
    "evaluate_layered_depth": "evaluation.layered_depth",
    "evaluate_md3k": "evaluation.md3k",
    "geometry_consistency_error": "losses",
    "get_gift_model": "adapters.recipes",
    "gift_loss": "losses",
    "group_consistency_loss": "losses",
    "load_gift_i": "dataset.gift_i",
    "masked_l1": "losses",
    "prepare_gift_i": "prepare.prepare",
    "save_adapter": "adapters.folder",
    "self_distillation_loss": "losses",
    "set_adapter_scale": "adapters.scale",
    "train": "training.loop",
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


class _AfterImport:
    """An import finder that finds a package where it is, and calls `action` once it has been executed."""

    def __init__(self, package: str, action: Callable[[], None]):
        self.package, self.action, self.searching = package, action, False

    def find_spec(self, name, path=None, target=None):
        if name != self.package or self.searching:
            return None
        self.searching = True  # so that the other finders are asked
        try:
            spec = importlib.util.find_spec(name)
        finally:
            self.searching = False
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def exec_module(module):
                execute(module)
                # Not before: many packages look for another without importing it.
                sys.meta_path.remove(self)
                self.action()

            spec.loader.exec_module = exec_module
        return spec


def when_imported(package: str, action: Callable[[], None]) -> None:
    """Call `action` at once if `package` is imported, else as soon as it has been."""
    if package in sys.modules:
        action()
    else:
        sys.meta_path.insert(0, _AfterImport(package, action))


when_imported("datasets", register_builder)
when_imported("transformers", register_models)
