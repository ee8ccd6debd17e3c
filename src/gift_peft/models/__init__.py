"""Depth models: loading any base, and architectures that transformers does not have: VGGT, Metric3D V2, MoGe."""

from importlib import import_module


def register_models() -> None:
    """Make transformers' Auto classes know these architectures; `import gift_peft` calls it. Idempotent."""
    # Each registers itself: it may be halfway through its own import, if that is what imports transformers.
    for name in ("vggt", "metric3d", "moge"):
        import_module(f"{__name__}.{name}")
