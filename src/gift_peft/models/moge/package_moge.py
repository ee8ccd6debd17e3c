"""The package that has MoGe's network, imported when one is built; without it one line says how to install it."""

import importlib
import warnings
from functools import cache
from typing import Any

from torch import nn
from transformers import initialization as init
from transformers.modeling_layers import GradientCheckpointingLayer

# Its metadata asks for opencv-python, torchvision and gradio, which a network does not use and which would replace
# what is installed: without dependencies, and scipy, which its geometry imports.
INSTALL = "pip install --no-deps dlr-moge==2.0.0 dlr-utils3d==1.3 scipy"


def import_moge(version: str) -> Any:
    """The package's module of a version; ValueError with the command that installs it."""
    try:
        return importlib.import_module(f"moge.model.{version}")
    except ImportError as error:
        raise ValueError(f"MoGe's network is in another package, which is missing ({error}): `{INSTALL}`") from None


def build_network(version: str, arguments: dict[str, Any]) -> Any:
    """The package's `MoGeModel` of a version with the arguments that its checkpoints state; ValueError for others."""
    module = import_moge(version)
    # Its layers ask a tensor for a number while they are built, which a meta device cannot give.
    with warnings.catch_warnings(), init.meta_device_safe_creation_ops():
        # The released checkpoints state arguments that the package no longer has.
        warnings.filterwarnings("ignore", "The following deprecated/invalid arguments", UserWarning)
        try:
            network = module.MoGeModel(**arguments)
        except (TypeError, KeyError, AttributeError, IndexError) as error:
            raise ValueError(f"no MoGe {version} network has these sizes ({error})") from None
    for block in (network.backbone if version == "v1" else network.encoder.backbone).blocks:
        block.__class__ = _recomputable(block.__class__)
    return network


@cache
def _recomputable(block_class: type[nn.Module]) -> type[nn.Module]:
    """The class of a transformer block as one that transformers (and the training here) can compute again."""
    members = {"__module__": block_class.__module__, "__doc__": block_class.__doc__}
    return type(block_class.__name__, (GradientCheckpointingLayer, block_class), members)
