"""Official weights to a transformers folder (`gift-peft convert vggt|metric3d SRC DST`).

The folder has config, safetensors, image processor and the model's own code, so that it also loads with
`trust_remote_code=True`. It appears when it is complete, or not at all.
"""

from pathlib import Path
from typing import Any

from huggingface_hub.errors import StrictDataclassError
from safetensors import SafetensorError
from transformers import PreTrainedConfig

from gift_peft.files import check_replaceable, is_hub_id, whole_folder
from gift_peft.models.metric3d import Metric3DConfig, Metric3DForDepthEstimation, Metric3DImageProcessorPil
from gift_peft.models.vggt import VggtConfig, VggtForDepthEstimation, VggtImageProcessorPil

# What a hub id without a file means: facebook/VGGT-1B, JUGGHM/Metric3D.
VGGT_FILE = "model.safetensors"
METRIC3D_FILE = "metric_depth_vit_giant2_800k.pth"


def convert_vggt(source: str | Path, folder: str | Path, config: VggtConfig | str | Path | None = None) -> Path:
    """Write `folder` from official VGGT weights; returns it.

    Args:
        source: a `.safetensors`, `.pt` or `.pth` file, or on the hub `owner/repo` or `owner/repo/file`.
        folder: new, or empty.
        config (*optional*): sizes, as an object or a JSON file; default VGGT-1B.

    Raises:
        FileNotFoundError: no such file here or on the hub.
        ValueError: the file is damaged, no VGGT, or of another size; `folder` is not empty.
    """
    return _convert(VggtForDepthEstimation, VggtImageProcessorPil(), _fetch(source, VGGT_FILE, folder), folder, config)


def convert_metric3d(
    source: str | Path, folder: str | Path, config: Metric3DConfig | str | Path | None = None
) -> Path:
    """Write `folder` from official Metric3D V2 weights; returns it.

    As `convert_vggt`. Without `config` the weights' width tells Small, Large and Giant2 apart; `JUGGHM/Metric3D` alone
    is Giant2.
    """
    source = _fetch(source, METRIC3D_FILE, folder)
    return _convert(Metric3DForDepthEstimation, Metric3DImageProcessorPil(), source, folder, config)


CONVERTERS = {"vggt": convert_vggt, "metric3d": convert_metric3d}


def _fetch(source: str | Path, default: str, folder: str | Path) -> Path:
    """The local file of `source`, downloaded if it is on the hub; after a look at `folder`, which costs less."""
    check_replaceable(Path(folder))
    path, parts = Path(source), str(source).split("/")
    repository, file = "/".join(parts[:2]), "/".join(parts[2:]) or default
    a_file_here = len(parts) < 3 and path.suffix in (".safetensors", ".pt", ".pth")
    if path.exists() or a_file_here or len(parts) < 2 or not parts[-1] or not is_hub_id(repository):
        return path  # from_official says if there is none
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import HfHubHTTPError

    try:
        return Path(hf_hub_download(repository, file))
    except (OSError, ValueError, HfHubHTTPError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise FileNotFoundError(
            f"{source}: no such file, and {file} of {repository} does not come from the hub ({reason})"
        ) from None


def _read_config(config_class: type[PreTrainedConfig], path: str | Path) -> PreTrainedConfig:
    try:
        return config_class.from_json_file(path)
    except (ValueError, TypeError, ArithmeticError, StrictDataclassError) as error:  # no JSON, or wrong values
        raise ValueError(f"{path}: not the sizes of a model ({' '.join(str(error).split())})") from None


def _convert(model_class: type[Any], processor: Any, source: Path, folder: str | Path, config: Any) -> Path:
    folder = Path(folder)
    if config is not None and not isinstance(config, PreTrainedConfig):
        config = _read_config(model_class.config_class, config)
    model = model_class.from_official(source, config)
    try:
        with whole_folder(folder) as temporary:
            model.save_pretrained(temporary)
            processor.save_pretrained(temporary)
    except SafetensorError as error:  # a full disk, which is no OSError there
        raise OSError(f"{folder}: the weights cannot be written ({error})") from None
    return folder
