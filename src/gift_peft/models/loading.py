"""Loading a base with its adapter, ready to predict."""

import pickle
import re
import warnings
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import torch

from gift_peft.models.identity import check_base_name, teacher_revision
from gift_peft.models.pixels import resolve_size


class LoadedModel(NamedTuple):
    """A model ready to predict: eval mode, float32, on its device.

    Args:
        model (`transformers.PreTrainedModel` or `peft.PeftModel`): the base, or the base under its adapter.
        processor: the image processor, the adapter's where it brings one.
        size (`tuple[int, int]`): (height, width) at the network.
        kind (`str`, *optional*): `depth` or `inverse_depth`; None for an architecture without a recipe, unless the
            adapter says it.
    """

    model: Any
    processor: Any
    size: tuple[int, int]
    kind: str | None


def load_base(base: str | Path, revision: str | None = None) -> tuple[Any, Any]:
    """(model in float32 and eval mode, image processor) of a hub id or folder.

    Raises FileNotFoundError where there is none, ValueError for weights that do not fit or are damaged.
    """
    from safetensors import SafetensorError
    from transformers import AutoImageProcessor, AutoModelForDepthEstimation

    check_base_name(base)
    options = {"revision": revision, "trust_remote_code": False}  # no question on the terminal, no foreign code
    try:
        model = AutoModelForDepthEstimation.from_pretrained(base, dtype=torch.float32, **options)
        return model.eval(), AutoImageProcessor.from_pretrained(base, backend="pil", **options)
    except OSError as error:
        raise FileNotFoundError(f"base model {base}: {_first_line(error)}") from error
    except pickle.UnpicklingError:
        raise ValueError(
            f"base model {base}: its weights are a pickle that would run code; take safetensors"
        ) from None
    except (
        ValueError,
        RuntimeError,
        SafetensorError,
        UnpicklingError,
    ) as error:  # of another shape, cut off, no tensors
        raise ValueError(f"base model {base}: {_first_line(error)}") from error


def load_model(
    base: str | Path,
    adapter: str | Path | None = None,
    adapter_scale: float | None = None,
    revision: str | None = None,
    size: str | tuple[int, int] | None = None,
    device: str | torch.device | None = None,
) -> LoadedModel:
    """A base model, with an adapter if one is named.

    Args:
        base: folder or hub id; or `da3:<id>`, `moge:<id>` for a model of those packages, which takes no adapter.
        adapter (*optional*): folder or hub id in PEFT format.
        adapter_scale (`float`, *optional*): 0 is the base, 1 the adapter, to the bit.
        revision (`str`, *optional*): of the base.
        size (*optional*): (height, width) or "HxW"; default the adapter's training size, else the recipe's, else the
            image processor's.
        device (*optional*): default CUDA where there is one.

    Raises:
        FileNotFoundError: no model or adapter at that place.
        ValueError: the adapter was made for another base, or no size is known.
    """
    from gift_peft.adapters.folder import read_gift
    from gift_peft.adapters.recipes import get_recipe
    from gift_peft.adapters.scale import set_adapter_scale
    from gift_peft.models.external import load_external, split_external

    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    if split_external(base):
        if adapter is not None or adapter_scale is not None:
            raise ValueError(f"base {base}: an adapter needs a model of transformers")
        model, processor = load_external(base)
        size = resolve_size(size, None, processor, model.config)
        return LoadedModel(model.to(device).eval(), processor, size, model.config.prediction_kind)
    model, processor = load_base(base, revision)
    config = model.config
    try:
        recipe = get_recipe(model)
    except ValueError:
        recipe = None  # an architecture without a recipe still predicts; its kind has to be told where it matters
    kind = recipe and recipe.kind_for(config)
    if adapter is not None:
        model, processor = _attach(model, processor, base, adapter, revision)
        kind = kind or read_gift(adapter).get("kind")
        if adapter_scale is not None:
            set_adapter_scale(model, adapter_scale)
        stated = getattr(processor, "size", None) or {}
        if size is None and "height" in stated and "width" in stated:
            size = stated["height"], stated["width"]
    elif adapter_scale is not None:
        raise ValueError("adapter_scale needs an adapter")
    size = resolve_size(size, recipe, processor, config)
    return LoadedModel(model.to(device).eval(), processor, size, kind)


def predict_depth(model: Any, pixel_values: torch.Tensor, batch_size: int = 2) -> torch.Tensor:
    """(N,3,h,w) images to (N,h,w) float32 on the CPU: micro-batches in image order, no gradients, no autocast.

    `model` is called with `pixel_values=` if it is a module (`.predicted_depth` or a tensor comes back), else as a
    plain function of the tensor.
    """
    is_module = isinstance(model, torch.nn.Module)
    weight = next(model.parameters(), None) if is_module else None
    device = torch.device("cpu") if weight is None else weight.device
    depths = []
    with torch.no_grad(), torch.autocast(device.type, enabled=False):
        for batch in pixel_values.split(batch_size):
            output = model(pixel_values=batch.to(device)) if is_module else model(batch)
            depths.append(getattr(output, "predicted_depth", output).float().cpu())
    return torch.cat(depths)


def prediction_kind(model: Any) -> str:
    """`depth` or `inverse_depth`, as the model's recipe says; ValueError where there is none to ask."""
    from gift_peft.adapters.recipes import get_recipe

    config = getattr(model, "config", None)
    if config is None:
        raise ValueError('say what the model predicts: kind="depth" or kind="inverse_depth"')
    if getattr(config, "prediction_kind", None):  # a model of another package says it itself
        return config.prediction_kind
    try:
        return get_recipe(model).kind_for(config)
    except ValueError:
        name = getattr(config, "model_type", type(model).__name__)
        raise ValueError(f'no recipe says what {name} predicts: kind="depth" or kind="inverse_depth"') from None


def _attach(model, processor, base, adapter, revision):
    """The PeftModel and its image processor; one clear error if the adapter belongs to another base."""
    from peft import PeftModel
    from safetensors import SafetensorError
    from transformers import AutoImageProcessor

    from gift_peft.adapters.folder import ADAPTER_WEIGHTS, PROCESSOR_CONFIG, read_adapter_config

    made_for = read_adapter_config(adapter).base_model_name_or_path
    _check_base(base, revision, adapter, made_for)
    mismatch = f"adapter {adapter} does not fit base {base}: it was trained on {made_for}"
    with warnings.catch_warnings():
        # peft 0.21 reads an attribute that transformers 5.23 deprecates, and only warns of weights it did not find.
        warnings.filterwarnings("ignore", "`is_gradient_checkpointing` is deprecated", FutureWarning)
        warnings.filterwarnings("error", "Found missing adapter keys", UserWarning)
        try:
            model = PeftModel.from_pretrained(model, adapter)
        except (RuntimeError, ValueError, LookupError, TypeError, AttributeError, UserWarning, re.error) as error:
            raise ValueError(f"{mismatch} ({_first_line(error)})") from None
        except (OSError, SafetensorError) as error:
            raise ValueError(f"adapter {adapter}: damaged {ADAPTER_WEIGHTS} ({_first_line(error)})") from None
    try:
        processor = AutoImageProcessor.from_pretrained(adapter, backend="pil", trust_remote_code=False)
    except (OSError, ValueError, TypeError, AttributeError, LookupError) as error:
        if (Path(adapter) / PROCESSOR_CONFIG).exists():
            raise ValueError(f"adapter {adapter}: damaged {PROCESSOR_CONFIG} ({_first_line(error)})") from None
        # An adapter that PEFT alone saved: the base's processor serves.
    return model, processor


def _check_base(base, revision, adapter, made_for: str | None) -> None:
    """ValueError unless the adapter was trained on this base, as far as weights and names tell.

    Two folders are compared by the digest in gift.json (without it, of the folder named, if that is still there), two
    hub ids by name. A folder here for a hub id there, or the
    other way round, may be a copy: then shapes alone decide.
    """
    from gift_peft.adapters.folder import read_gift

    trained, present = read_gift(adapter).get("base_revision") or "", teacher_revision(base, revision)
    if not trained and made_for and (Path(made_for) / "config.json").is_file():
        trained = teacher_revision(made_for)
    was_folder, is_folder = (pin.startswith("sha256:") for pin in (trained, present))
    if was_folder and is_folder and trained != present:
        raise ValueError(f"adapter {adapter} was trained on {made_for}, whose files are not those of base {base}")
    if made_for not in (None, str(base)) and not was_folder and not is_folder and not Path(made_for).exists():
        raise ValueError(f"adapter {adapter} was trained on {made_for}, not on base {base}")


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
