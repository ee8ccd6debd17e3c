"""Reading an official VGGT checkpoint: safetensors or a torch file, tensors only, depth path only.

Pickles are opened with `weights_only=True`, so a file that would run code is refused. Tensors of the camera, point and
track heads are left on disk.
"""

import pickle
import struct
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open

DEPTH_PATH = ("aggregator.", "depth_head.")
WRAPPERS = ("model_state_dict", "state_dict", "model")
# What torch.load raises for cut and changed bytes, found by trying.
DAMAGED = (
    *(RuntimeError, EOFError, OSError, ValueError, LookupError, TypeError, AttributeError, AssertionError),
    *(ArithmeticError, struct.error, zipfile.BadZipFile),
)
OPTIONAL = "aggregator.patch_embed.mask_token"  # only pre-training used it; some files leave it out


def read_official(source: str | Path | Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Tensors of aggregator and depth head by official name, from a file or from a dict of tensors.

    `module.` prefixes and a `model_state_dict`, `state_dict` or `model` wrapper are taken off. Raises
    FileNotFoundError, and ValueError for a file that is truncated or would run code, and for what is no VGGT
    checkpoint, holds something else than a tensor on the depth path, or a tensor with and without the prefix.
    """
    if isinstance(source, Mapping):
        return _depth_path(source, "the given dict")
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such checkpoint file")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; name the checkpoint file in it, such as model.safetensors")
    with path.open("rb") as file:
        start = file.read(2)
    # Told apart by content: torch files are zip archives or, from before 2020, bare pickles.
    if start == b"PK" or start[:1] == b"\x80":
        return _depth_path(_read_torch(path), str(path))
    return _read_safetensors(path)


def check_official(state: Mapping[str, torch.Tensor], expected: Mapping[str, torch.Tensor], where: str) -> None:
    """Raise ValueError naming the first tensor that `state` lacks, has too much, or in another shape."""
    for name, tensor in expected.items():
        if name not in state:
            if name == OPTIONAL:
                continue
            raise ValueError(f"{where}: the tensor {name} is missing; is this another variant than the config's?")
        if state[name].shape != tensor.shape:
            raise ValueError(
                f"{where}: {name} has shape {tuple(state[name].shape)}, the config asks for {tuple(tensor.shape)}"
            )
        if not state[name].is_floating_point():
            raise ValueError(f"{where}: {name} holds {state[name].dtype}, not floating-point weights")
    for name in state:
        if name not in expected:
            raise ValueError(f"{where}: {name} has no place in the config's model; is this another variant?")


def float32_copy(tensor: torch.Tensor, name: str, where: str) -> torch.Tensor:
    """The weights to compute with; ValueError naming them if they are not finite."""
    copy = tensor.to(torch.float32, copy=True)
    if not torch.isfinite(copy).all():
        raise ValueError(f"{where}: {name} holds NaN or infinite values (in float32)")
    return copy


def _unwrapped(content: object, where: str) -> Mapping:
    """The dict inside the wrappers; ValueError for none."""
    while isinstance(content, Mapping) and (
        inner := [key for key in WRAPPERS if isinstance(content.get(key), Mapping)]
    ):
        content = content[inner[0]]
    if not isinstance(content, Mapping):
        raise ValueError(f"{where}: holds a {type(content).__name__}, not tensors by name")
    if not any(isinstance(value, torch.Tensor) for value in content.values()):
        for key in WRAPPERS:
            if key in content:
                raise ValueError(f"{where}: {key} is a {type(content[key]).__name__}, not tensors by name")
    return content


def _depth_path(content: object, where: str) -> dict[str, torch.Tensor]:
    content = _unwrapped(content, where)
    keys = _depth_keys(content, where)
    for key in keys.values():
        if not isinstance(content[key], torch.Tensor):
            raise ValueError(f"{where}: {key} is a {type(content[key]).__name__}, not a tensor")
    return {name: content[key] for name, key in keys.items()}


def _official(key: object) -> str:
    key = str(key)
    while key.startswith("module."):  # nn.DataParallel, DistributedDataParallel
        key = key.removeprefix("module.")
    return key


def _depth_keys(keys: Collection, where: str) -> dict[str, object]:
    """The key of every tensor of the depth path, by official name; ValueError for none, and for two of one name."""
    found: dict[str, object] = {}
    for key in keys:
        name = _official(key)
        if not name.startswith(DEPTH_PATH):
            continue
        if name in found:
            raise ValueError(f"{where}: {found[name]} and {key} are two tensors of one name; leave one out")
        found[name] = key
    if not found:
        first = f"its first entry is {_official(next(iter(keys)))!r}" if keys else "it is empty"
        raise ValueError(f"{where}: not a VGGT checkpoint, no tensor starts with {' or '.join(DEPTH_PATH)}; {first}")
    return found


def _read_safetensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(key) for name, key in _depth_keys(file.keys(), str(path)).items()}
    except (SafetensorError, OSError) as error:
        raise ValueError(
            f"{path}: truncated, or neither a safetensors nor a torch file ({path.stat().st_size} bytes: "
            f"{_first_line(error)})"
        ) from None


def _read_torch(path: Path) -> object:
    try:
        return torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except pickle.UnpicklingError as error:
        raise ValueError(
            f"{path}: refused, it holds more than tensors and would run code, or is damaged ({_first_line(error)})"
        ) from None
    except DAMAGED as error:
        raise ValueError(
            f"{path}: truncated, or not a torch file ({path.stat().st_size} bytes: {_first_line(error)})"
        ) from None


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
