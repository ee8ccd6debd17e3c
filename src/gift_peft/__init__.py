"""Geometry-invariant fine-tuning (GIFT): depth models learn to see mirrors and glass, without depth labels."""

__version__ = "0.1.0"
