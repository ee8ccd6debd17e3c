"""How an architecture of ours becomes one that transformers' Auto classes and pipelines know."""


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
