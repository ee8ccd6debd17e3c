"""Depth models that transformers does not have: VGGT and Metric3D V2.

`import gift_peft` makes transformers' Auto classes know them. Where transformers is not imported yet, this waits until
it is: torch takes longer to import than the command line takes to answer --help.
"""

import importlib
import importlib.util
import sys

HOST = "transformers"


def register_models() -> None:
    """Register both architectures with AutoConfig, AutoModelForDepthEstimation and AutoImageProcessor. Idempotent.

    At once if transformers is imported, else as soon as it has been.
    """
    if HOST in sys.modules:
        _register()
    elif not any(isinstance(finder, _AfterImport) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterImport())


class _AfterImport:
    """An import finder that finds transformers where it is, and registers the models once it has been executed."""

    searching = False

    def find_spec(self, name, path=None, target=None):
        if name != HOST or self.searching:
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
                # Not before: many packages look for transformers without importing it.
                sys.meta_path.remove(self)
                _register()

            spec.loader.exec_module = exec_module
        return spec


def _register() -> None:
    # Each registers itself: it may be halfway through its own import, if that is what imports transformers.
    for name in ("vggt", "metric3d"):
        importlib.import_module(f"{__name__}.{name}")


def register_classes(config, model, image_processor) -> None:
    """Make the Auto classes and pipelines know an architecture, and `save_pretrained` write its code too."""
    from transformers import AutoConfig, AutoImageProcessor, AutoModelForDepthEstimation
    from transformers.models.auto.video_processing_auto import AutoVideoProcessor  # the top level asks for torchvision

    AutoConfig.register(config.model_type, config, exist_ok=True)
    AutoModelForDepthEstimation.register(config, model, exist_ok=True)
    AutoImageProcessor.register(config, image_processor_classes={"pil": image_processor}, exist_ok=True)
    # Pipelines take any remote image processor for a video processor too and would ask before running its code.
    AutoVideoProcessor.register(config, video_processor_classes={}, exist_ok=True)
    config.register_for_auto_class()
    model.register_for_auto_class("AutoModelForDepthEstimation")
    image_processor.register_for_auto_class("AutoImageProcessor")
