"""`DepthModel`: a base with its adapter, ready to predict; everything that predicts takes one.

    model = DepthModel.from_pretrained(base, adapter)
    depth = model.depth_at("photo.jpg")

It is asked once: the image processor, the size at the network, what is predicted and in which unit are its own.
"""

import inspect
import re
import warnings
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import nn

from gift_peft.files import reason, unfetched
from gift_peft.images import given_picture
from gift_peft.models.adapter_base import check_base, find_base
from gift_peft.models.full_precision import without_tf32
from gift_peft.models.identity import adapter_as_base, check_base_name, pickles_alone
from gift_peft.models.pixels import resolve_size, to_pixel_values
from gift_peft.rules import KINDS, UNKNOWN

# Depth Pro's post-processing turns inverse depth into depth, and ZoeDepth's needs torchvision: native units are kept.
RESIZED_HERE = {"zoedepth", "depth_pro"}
METRIC_MODELS = {"zoedepth", "depth_pro", "prompt_depth_anything"}  # they predict metres without saying so


class DepthModel:
    """A base with its adapter, or any network that predicts depth, with what predicting needs.

    Predictions are made in eval mode, in float32, without gradients and without autocast, on the network's device;
    modes and gradients of a network that is being trained are left as they were.

    Args:
        network: a `PeftModel`, whose base is reached by `disable_adapter()`; a depth model of transformers; any module
            or function of pixel values (B,3,h,w) that gives (B,H,W) or an output with `.predicted_depth`.
        processor (*optional*): the image processor; default that of the place the network came from.
        size (*optional*): (height, width) at the network, or "HxW"; default the recipe's, else the processor's.
        kind (`str`, *optional*): what is predicted, `depth` or `inverse_depth`; default what config or recipe say.
        teacher (*optional*): the base of a network that is no `PeftModel`: a network, a folder or a hub id.

    Attributes:
        network: as given.
        processor: a copy that resizes every picture to exactly `size`.
        size (`tuple[int, int]`): (height, width) at the network.
        kind (`str`, *optional*): None where nothing says it.
        millimeters_per_unit (`float`): 1000 for models that say they predict metres, else 1.
        adapted (`bool`): whether there is a base to compare with, so that `predict` is not `predict_base`.
    """

    def __init__(
        self,
        network: Any,
        processor: Any = None,
        size: str | tuple[int, int] | None = None,
        kind: str | None = None,
        teacher: Any = None,
    ) -> None:
        if kind not in (None, *KINDS):
            raise ValueError(f"unknown kind {kind!r}: choose one of {', '.join(KINDS)}")
        config = getattr(network, "config", None)
        self.network, self._processor, self._size = network, processor, size
        self.kind = kind or _stated_kind(network)
        metric = getattr(config, "depth_estimation_type", None) == "metric"
        metric = metric or getattr(config, "model_type", None) in METRIC_MODELS
        self.millimeters_per_unit = 1000.0 if metric else 1.0
        has_adapter = hasattr(network, "disable_adapter")
        if isinstance(teacher, str | Path) and not has_adapter:
            teacher = type(self).from_pretrained(teacher)
        teacher = teacher.network if isinstance(teacher, DepthModel) else teacher
        self._teacher = None if has_adapter else teacher
        self.adapted = has_adapter or teacher is not None

    @classmethod
    def of(cls, model: Any, **options: Any) -> "DepthModel":
        """What the evaluations accept, as one object: a `DepthModel` itself, or a network with the options above."""
        if not isinstance(model, cls):
            return cls(model, **options)
        given = [name for name, value in options.items() if value is not None]
        if given:
            raise ValueError(f"a DepthModel brings its own {' and '.join(given)}: give it where the model is made")
        return model

    @classmethod
    def from_pretrained(
        cls,
        base: str | Path | None = None,
        adapter: str | Path | None = None,
        adapter_scale: float | None = None,
        revision: str | None = None,
        size: str | tuple[int, int] | None = None,
        kind: str | None = None,
        device: str | torch.device | None = None,
        accept_base: bool = False,
    ) -> "DepthModel":
        """A base model, with an adapter if one is named.

        Args:
            base: folder or hub id; or `da3:<id>`, `moge:<id>` for a model of those packages, which takes no adapter.
                Default: the one that the adapter names, sought beside the adapter too.
            adapter (*optional*): folder or hub id in PEFT format.
            adapter_scale (`float`, *optional*): 0 is the base, 1 the adapter, to the bit.
            revision (`str`, *optional*): of the base.
            size (*optional*): (height, width) or "HxW"; default the adapter's training size, else the recipe's, else
                the image processor's.
            kind (`str`, *optional*): `depth` or `inverse_depth`; default the recipe's, else the adapter's.
            device (*optional*): default CUDA where there is one.
            accept_base (`bool`): warn where the adapter was made for another base, in place of refusing it.

        Raises:
            FileNotFoundError: no model or adapter at that place.
            ValueError: the adapter was made for another base, no base or no size is known.
        """
        from gift_peft.adapters.folder import read_gift
        from gift_peft.adapters.scale import set_adapter_scale
        from gift_peft.models.external import load_external, split_external

        if adapter is None and adapter_scale is not None:
            raise ValueError("adapter_scale needs an adapter")
        if adapter is not None and not (base is not None and split_external(base)):
            base, revision = find_base(base, adapter, revision)
        if base is None:
            raise ValueError("a base model or an adapter is needed")
        if split_external(base):
            if adapter is not None:
                raise ValueError(f"base {base}: an adapter needs a model of transformers")
            network, processor = load_external(base)
        else:
            network, processor = load_base(base, revision, with_processor=not _brings_processor(adapter))
        if adapter is None and Path(base).is_dir():  # a merged model says at what size it was trained
            merged = read_gift(base)
            size, kind = size or merged.get("size"), kind or _stated_kind(network) or merged.get("kind")
        if adapter is not None:
            network, processor = _attach(network, processor, base, adapter, revision, accept_base)
            kind = kind or _stated_kind(network) or read_gift(adapter).get("kind")
            if adapter_scale is not None:
                set_adapter_scale(network, adapter_scale)
            stated = getattr(processor, "size", None) or {}
            if size is None and "height" in stated and "width" in stated:
                size = stated["height"], stated["width"]
        size = resolve_size(size, _recipe(network), processor, network.config)
        network.to(device or ("cuda" if torch.cuda.is_available() else "cpu"))
        return cls(network.eval(), processor, size, kind)

    @cached_property
    def size(self) -> tuple[int, int]:
        """(height, width) at the network; ValueError if nothing fixes it."""
        config = getattr(self.network, "config", None)
        return resolve_size(self._size, _recipe(self.network), self._given_processor, config)

    @cached_property
    def processor(self) -> Any:
        """The image processor at that size; ValueError if the network does not say where it came from."""
        from gift_peft.adapters.folder import processor_at_size

        return processor_at_size(self._given_processor, self.size)

    @cached_property
    def _given_processor(self) -> Any:
        if self._processor is not None:
            return self._processor
        source = getattr(getattr(self.network, "config", None), "_name_or_path", "")
        if not source:
            raise ValueError("the model does not say where it came from; pass its processor=")
        return load_processor(source)

    @property
    def masks_itself(self) -> bool:
        """Whether the network says where there is no surface."""
        return getattr(getattr(self.network, "config", None), "predicts_valid_mask", False)

    def known_kind(self) -> str:
        """`kind`; ValueError where nothing says it."""
        if self.kind is None:
            config = getattr(self.network, "config", None)
            name = getattr(config, "model_type", type(self.network).__name__)
            known = "say what the model predicts" if config is None else f"no recipe says what {name} predicts"
            raise ValueError(f'{known}: kind="depth" or kind="inverse_depth"')
        return self.kind

    def inputs(self, images: Sequence[Image.Image]) -> torch.Tensor:
        """N RGB pictures of any size to pixel values (N,3,h,w) float32, as in training."""
        return to_pixel_values(images, self.processor, self.size)

    def predict(self, pixel_values: torch.Tensor, batch_size: int = 2) -> torch.Tensor:
        """(N,3,h,w) to (N,h,w) float32 on the CPU, in native units: micro-batches in image order."""
        return self._predict(pixel_values, batch_size, base=False)

    def predict_base(self, pixel_values: torch.Tensor, batch_size: int = 2) -> torch.Tensor:
        """`predict` of the base alone: with the adapter off, or by the teacher."""
        return self._predict(pixel_values, batch_size, base=True)

    def predict_proxies(self, pixel_values: torch.Tensor, batch_size: int = 2) -> torch.Tensor:
        """`predict_base`, with `rules.UNKNOWN` where the network's own mask says that there is no surface (sky).

        For a network without such a mask (an output `valid_mask`) the same as `predict_base`.
        """
        return self._predict(pixel_values, batch_size, base=True, masked=True)

    def depth_at(
        self,
        image: str | Path | Image.Image | np.ndarray,
        focal_length: float | tuple[float, float] | None = None,
        base: bool = False,
    ) -> np.ndarray:
        """Depth of a picture at its own size, as `gift-peft predict` writes it.

        The image processor's own `post_process_depth_estimation` brings it there, as in transformers' pipeline, except
        for ZoeDepth and Depth Pro, whose own does more than that: there it is the bicubic resize of the others.

        Args:
            image: a file, an RGB picture, or an array (H,W,3) or grey (H,W), uint8.
            focal_length (*optional*): fx or (fx, fy) of the camera in pixels of the picture, where the processor takes
                one (Metric3D, whose depth is then in metres of that camera).
            base (`bool`): depth of the base alone.

        Returns:
            `np.ndarray`: (H,W) float32 in native units.

        Raises:
            FileNotFoundError: no such file.
            ValueError: no picture, NaN or infinity in the prediction, a focal length that the processor does not take.
        """
        picture, name = given_picture(image)
        return self.depths_of(self.inputs([picture]), [(picture.height, picture.width)], [name], focal_length, base)[0]

    def depths_of(
        self,
        pixel_values: torch.Tensor,
        sizes: Sequence[tuple[int, int]],
        names: Sequence[str],
        focal_length: float | tuple[float, float] | None = None,
        base: bool = False,
    ) -> list[np.ndarray]:
        """`depth_at` of several pictures in one forward: `inputs` of them, their (height, width), and what to call
        them in messages."""
        post_process, options = self.processor.post_process_depth_estimation, {}
        if focal_length is not None:
            if "focal_lengths" not in inspect.signature(post_process).parameters:
                raise ValueError(f"focal_length: {type(self.processor).__name__} takes none")
            options["focal_lengths"] = [focal_length] * len(sizes)
        output = self._forward(pixel_values, base)
        if isinstance(output, torch.Tensor):
            output = SimpleNamespace(predicted_depth=output)
        for name, depth in zip(names, output.predicted_depth, strict=True):
            if not torch.isfinite(depth).all():
                raise ValueError(f"{name}: the prediction has NaN or infinite values")
        if getattr(getattr(self.network, "config", None), "model_type", None) in RESIZED_HERE:
            pairs = zip(output.predicted_depth[:, None, None], sizes, strict=True)
            depths = [nn.functional.interpolate(own, tuple(size), mode="bicubic") for own, size in pairs]
        else:
            depths = [own["predicted_depth"] for own in post_process(output, target_sizes=list(sizes), **options)]
        # transformers squeezes a side of one pixel away
        return [depth.float().cpu().numpy().reshape(size) for depth, size in zip(depths, sizes, strict=True)]

    def _predict(self, pixel_values: torch.Tensor, batch_size: int, base: bool, masked: bool = False) -> torch.Tensor:
        depths = []
        for batch in pixel_values.split(batch_size):
            output = self._forward(batch, base)
            depth = getattr(output, "predicted_depth", output).float()
            valid = getattr(output, "valid_mask", None) if masked else None
            depths.append((depth if valid is None else depth.masked_fill(~valid, UNKNOWN)).cpu())
        return torch.cat(depths)

    def _forward(self, pixel_values: torch.Tensor, base: bool) -> Any:
        if base and self._teacher is not None:
            return _forward(self._teacher, pixel_values)
        if not base or not self.adapted:
            return _forward(self.network, pixel_values)
        # PEFT turns on the gradients of every adapter weight when the adapter comes back, frozen ones included.
        gradients = [(weight, weight.requires_grad) for weight in self.network.parameters()]
        try:
            with self.network.disable_adapter():
                return _forward(self.network, pixel_values)
        finally:
            for weight, flag in gradients:
                weight.requires_grad_(flag)


def _forward(network: Any, pixel_values: torch.Tensor) -> Any:
    """One forward as predictions are made. A module is called with `pixel_values=`, anything else as a function."""
    is_module = isinstance(network, torch.nn.Module)
    weight = next(network.parameters(), None) if is_module else None
    device = torch.device("cpu") if weight is None else weight.device
    training = [module for module in network.modules() if module.training] if is_module else []
    if training:
        network.eval()
    try:
        with torch.no_grad(), torch.autocast(device.type, enabled=False), without_tf32():
            return network(pixel_values=pixel_values.to(device)) if is_module else network(pixel_values)
    except RuntimeError as error:
        # Some architectures take squares only, or more than the patch size asks for; they say it in terms of tensors.
        if isinstance(error, torch.OutOfMemoryError) or not re.search(r"\bshapes?\b|\bsizes?\b", str(error)):
            raise
        own = getattr(getattr(network, "config", None), "image_size", None)
        advice = f"its own is --size {own}x{own}" if isinstance(own, int) else "give a square --size"
        sides = "x".join(map(str, pixel_values.shape[-2:]))
        text = f"the model does not take images of {sides} (height x width): {reason(error)}; {advice}"
        raise ValueError(text) from error
    finally:
        for module in training:
            module.training = True


def _recipe(network: Any) -> Any:
    from gift_peft.adapters.recipes import get_recipe

    try:
        return get_recipe(network)
    except ValueError:
        return None  # an architecture without a recipe still predicts


def _stated_kind(network: Any) -> str | None:
    """What a model's config or recipe say it predicts."""
    config, recipe = getattr(network, "config", None), _recipe(network)
    # A model of another package says it itself.
    return getattr(config, "prediction_kind", None) or (recipe and recipe.kind_for(config))


# ---- from a folder or the hub ----


def load_base(base: str | Path, revision: str | None = None, with_processor: bool = True) -> tuple[Any, Any]:
    """(model in float32 and eval mode, image processor) of a hub id or folder; the processor is None if not asked for.

    Raises FileNotFoundError where there is none, ValueError for an adapter, and for weights that do not fit or are
    damaged.
    """
    from safetensors import SafetensorError
    from transformers import AutoModelForDepthEstimation

    check_base_name(base)
    options = {"revision": revision, "trust_remote_code": False}  # no question on the terminal, no foreign code
    try:
        model = AutoModelForDepthEstimation.from_pretrained(base, dtype=torch.float32, use_safetensors=True, **options)
        processor = load_processor(base, revision) if with_processor else None
    except OSError as error:
        if "safetensors" in str(error) and Path(base).is_dir() and any(Path(base).glob("*.bin")):
            raise pickles_alone(base) from None
        raise FileNotFoundError(f"base model {base}: {reason(error)}") from error
    except (ValueError, RuntimeError, SafetensorError) as error:  # of another shape, cut off, no tensors
        raise ValueError(f"base model {base}: {unfetched(base) or reason(error)}") from error
    if getattr(model, "peft_config", None):  # transformers loads the base of an adapter by itself
        raise adapter_as_base(base)
    return model.eval(), processor


def load_processor(source: str | Path, revision: str | None = None) -> Any:
    """The image processor of a folder or hub id; Pillow resizes, as in training, and no foreign code runs."""
    from transformers import AutoImageProcessor

    return AutoImageProcessor.from_pretrained(source, revision=revision, backend="pil", trust_remote_code=False)


def _brings_processor(adapter: str | Path | None) -> bool:
    from gift_peft.adapters.folder import PROCESSOR_CONFIG

    return adapter is not None and (Path(adapter) / PROCESSOR_CONFIG).is_file()


def _attach(model, processor, base, adapter, revision, accept_base):
    """The PeftModel and its image processor; one clear error if the adapter belongs to another base."""
    from peft import PeftModel
    from safetensors import SafetensorError

    from gift_peft.adapters.folder import ADAPTER_WEIGHTS, PROCESSOR_CONFIG, read_adapter_config

    made_for = read_adapter_config(adapter).base_model_name_or_path
    check_base(base, revision, adapter, made_for, accept_base)
    mismatch = f"adapter {adapter} does not fit base {base}: it was trained on {made_for}"
    with warnings.catch_warnings():
        # peft 0.21 reads an attribute that transformers 5.23 deprecates, and only warns of weights it did not find.
        warnings.filterwarnings("ignore", "`is_gradient_checkpointing` is deprecated", FutureWarning)
        warnings.filterwarnings("error", "Found missing adapter keys", UserWarning)
        try:
            model = PeftModel.from_pretrained(model, adapter)
        except (RuntimeError, ValueError, LookupError, TypeError, AttributeError, UserWarning, re.error) as error:
            raise ValueError(f"{mismatch} ({reason(error)})") from None
        except (OSError, SafetensorError) as error:
            why = unfetched(adapter) or f"damaged {ADAPTER_WEIGHTS} ({reason(error)})"
            raise ValueError(f"adapter {adapter}: {why}") from None
    try:
        processor = load_processor(adapter)
    except (OSError, ValueError, TypeError, AttributeError, LookupError) as error:
        if (Path(adapter) / PROCESSOR_CONFIG).exists():
            raise ValueError(f"adapter {adapter}: damaged {PROCESSOR_CONFIG} ({reason(error)})") from None
        # An adapter that PEFT alone saved: the base's processor serves.
    return model, processor
