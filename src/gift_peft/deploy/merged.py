"""`gift-peft deploy --to transformers`: base and adapter as one plain model, equal to the adapter up to rounding.

A folder that transformers, its pipeline and every tool that reads such folders load as they load the base.
"""

import json
import warnings
from pathlib import Path
from typing import Any

import torch
import yaml
from peft import PeftModel

from gift_peft.adapters.folder import GIFT, processor_at_size, versions
from gift_peft.adapters.recipes import RECIPES
from gift_peft.deploy.stages import stages
from gift_peft.files import is_hub_id, portable_name, reason, whole_folder, write_whole
from gift_peft.models.adapter_base import find_base
from gift_peft.models.loading import DepthModel
from gift_peft.reports.model_card import base_license

TOLERANCE = 1e-7  # largest difference to the adapter in float64, relative to the output's mean
SMALL = 84, 112  # pixels, for that comparison
TEMPLATES = Path(__file__).parent / "templates"
OWN = ("config.json", "preprocessor_config.json", "processor_config.json", "*.safetensors*", "README.md", GIFT, "*.py")


def load_for_deployment(
    adapter: str | Path,
    base: str | Path | None = None,
    adapter_scale: float = 1.0,
    revision: str | None = None,
    size: str | tuple[int, int] | None = None,
    kind: str | None = None,
) -> DepthModel:
    """The adapter on its base, on the CPU, at a scale.

    Args:
        adapter: folder or hub id.
        base (*optional*): default the one that the adapter names, sought beside the adapter too.
        adapter_scale (`float`): 0 is the base, 1 the adapter.
        revision, size, kind: as in `DepthModel.from_pretrained`.

    Raises:
        FileNotFoundError: no such adapter or base. ValueError: the adapter is of another base; a scale outside 0..1.
    """
    check_scale(adapter_scale)
    return DepthModel.from_pretrained(base, adapter, adapter_scale, revision, size, kind, device="cpu")


def check_scale(scale: float) -> None:
    """ValueError unless a scale is from 0 to 1: outside, the output is of no model that was trained."""
    if not 0 <= scale <= 1:
        raise ValueError(f"adapter scale {scale:g}: it goes from 0 (the base) to 1 (the adapter)")


def merged(model: DepthModel) -> DepthModel:
    """A `DepthModel` whose network is one plain model; `model` is taken apart for it.

    Merged and compared in float64, where a network that multiplies rounding does not hide a difference, then rounded
    to float32 once. Raises ValueError, with the reason, where the two are not the same: a layer that PEFT cannot
    merge, a base of lower precision, an output that differs.
    """
    network = model.network
    if not isinstance(network, PeftModel):
        raise ValueError("only a model with an adapter can be merged")
    half = sorted({str(weight.dtype) for weight in network.parameters() if weight.dtype != torch.float32})
    if half:
        raise ValueError(f"the base has weights of {', '.join(half)}: a merged weight would be rounded; load float32")
    # The networks with a recipe take any size, and a small one shows as much.
    size = SMALL if getattr(network.config, "model_type", None) in RECIPES else model.size
    pixels = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            expected = network.double()(pixel_values=pixels).predicted_depth
            plain = network.merge_and_unload(safe_merge=True).eval()
            difference = (plain(pixel_values=pixels).predicted_depth - expected).abs().max() / expected.abs().mean()
        except (ValueError, NotImplementedError, RuntimeError, AttributeError) as error:
            raise ValueError(f"the adapter cannot be merged into its base: {reason(error)}") from None
    if not difference <= TOLERANCE:  # NaN as well
        raise ValueError(f"the merged model differs from the adapter by {difference:.1e} of the output's mean")
    return DepthModel(plain.float(), model.processor, model.size, model.kind)


def deploy_transformers(adapter: str | Path, out: str | Path, base: str | Path | None = None, **options: Any) -> Path:
    """Write `out`, a plain transformers folder with image processor and card; returns it.

    Args: as `load_for_deployment`. Raises as that and as `merged`, and ValueError if `out` holds other files.
    """
    out = Path(out)
    with stages(3) as stage, whole_folder(out, OWN) as temporary:
        stage("the model")
        base, options["revision"] = find_base(base, adapter, options.get("revision"))
        model = load_for_deployment(adapter, base, **options)
        stage("merging, and comparing with the adapter")
        model = merged(model)
        stage("writing")
        model.network.save_pretrained(temporary)
        processor_at_size(model.processor, model.size).save_pretrained(temporary)
        scale = options.get("adapter_scale", 1.0)
        # What transformers' files have no place for, and `DepthModel` reads.
        facts = {"versions": versions(), "size": model.size, "kind": model.known_kind(), "adapter_scale": scale}
        write_whole(temporary / GIFT, json.dumps(facts, indent=2) + "\n")
        (temporary / "README.md").write_text(_card(model, adapter, base, scale), encoding="utf-8")
    return out


def license_of(adapter: str | Path, base: str | Path) -> str:
    """A Hub license id: what the adapter's card says, else that of the base; `other` where neither is known."""
    card = Path(adapter) / "README.md"
    if card.is_file():
        from huggingface_hub import ModelCard

        try:
            stated = ModelCard.load(card).data.license
        except (ValueError, yaml.YAMLError):
            stated = None
        if stated:
            return str(stated)
    return base_license(str(base))


def unit_of(model: DepthModel) -> str:
    """What the numbers of a prediction are, in words."""
    if model.known_kind() == "inverse_depth":
        return "relative inverse depth: larger is nearer, without a unit"
    if model.millimeters_per_unit == 1000 or getattr(model.network.config, "model_type", "") == "gift_metric3d":
        return "depth in meters"
    return "relative depth: larger is farther, without a unit"


def _card(model: DepthModel, adapter: str | Path, base: str | Path, scale: float) -> str:
    from jinja2 import Environment

    template = Environment(keep_trailing_newline=True).from_string((TEMPLATES / "merged.md").read_text("utf-8"))
    code = getattr(model.network.config, "model_type", "").startswith("gift_")
    return template.render(
        base=portable_name(base),
        hub_base=str(base) if is_hub_id(base) else None,
        adapter=portable_name(adapter),
        license=license_of(adapter, base),
        scale=scale,
        kind=model.known_kind(),
        unit=unit_of(model),
        height=model.size[0],
        width=model.size[1],
        own_code=code,
    )
