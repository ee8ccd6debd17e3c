"""Reading an official Metric3D V2 checkpoint: safetensors or a torch file, tensors only.

Pickles are opened with `weights_only=True`, so a file that would run code is refused.
"""

import pickle
import re
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

WIDTH = "depth_model.encoder.cls_token"  # its last axis tells the variants apart
WRAPPERS = ("model_state_dict", "state_dict", "model")
# What torch.load raises for cut and changed bytes, found by trying.
DAMAGED = (
    *(RuntimeError, EOFError, OSError, ValueError, LookupError, TypeError, AttributeError, AssertionError),
    *(ArithmeticError, struct.error, zipfile.BadZipFile),
)
# Never used by the network (the norm in giant2 only), so some files leave them out.
OPTIONAL = {"depth_model.encoder.mask_token": 0.0}
OPTIONAL_GIANT2 = {"depth_model.encoder.norm.weight": 1.0, "depth_model.encoder.norm.bias": 0.0}


def read_official(source: str | Path | Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Tensors by official name, from a file or from a dict of tensors.

    `module.` prefixes and a `model_state_dict`, `state_dict` or `model` wrapper are taken off, and of a parameter that
    is stored twice (`norm3` and `downsample.1`) the first name stays. Raises FileNotFoundError, and ValueError for a
    file that is truncated or would run code, and for what is no Metric3D V2 checkpoint, holds something else than a
    tensor, or a tensor with and without the prefix.
    """
    if isinstance(source, Mapping):
        return _named_tensors(source, "the given dict")
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such checkpoint file")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; name the checkpoint file in it, such as model.safetensors")
    with path.open("rb") as file:
        start = file.read(2)
    # Told apart by content: torch files are zip archives or, from before 2020, bare pickles.
    is_torch = start == b"PK" or start[:1] == b"\x80"
    return _named_tensors(_read_torch(path) if is_torch else _read_safetensors(path), str(path))


def fit_official(
    state: Mapping[str, torch.Tensor], expected: Mapping[str, torch.Tensor], variant: str, where: str
) -> dict[str, torch.Tensor]:
    """Float32 copies of `state` for each name of `expected`; what the network never uses may be absent.

    Raises ValueError naming the first tensor that one lacks, that has another shape, or that is not finite.
    """
    optional = OPTIONAL | (OPTIONAL_GIANT2 if variant == "giant2" else {})
    hint = f"is this a checkpoint of another variant than {variant}?"
    for name, tensor in expected.items():
        if name not in state:
            if name not in optional:
                raise ValueError(f"{where}: the tensor {name} is missing; {hint}")
        elif state[name].shape != tensor.shape:
            shapes = f"shape {tuple(state[name].shape)}, the config asks for {tuple(tensor.shape)}"
            raise ValueError(f"{where}: {name} has {shapes}; {hint}")
        elif not state[name].is_floating_point():
            raise ValueError(f"{where}: {name} holds {state[name].dtype}, not floating-point weights")
    for name in state:
        if name not in expected:
            raise ValueError(f"{where}: {name} has no place in the model; {hint}")
    fitted = {}
    for name, tensor in expected.items():
        if name in state:
            fitted[name] = state[name].to(torch.float32, copy=True)
            _check_finite(fitted[name], name, where)
        else:
            fitted[name] = torch.full(tensor.shape, optional[name], dtype=torch.float32)
    return fitted


def _check_finite(tensor: torch.Tensor, name: str, where: str) -> None:
    if not torch.isfinite(tensor).all():
        raise ValueError(f"{where}: {name} holds NaN or infinite values (in float32)")


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


def _named_tensors(content: object, where: str) -> dict[str, torch.Tensor]:
    content = _unwrapped(content, where)
    keys: dict[str, object] = {}
    for key in content:
        name = re.sub(r"^(module\.)+", "", str(key))
        if name in keys:
            raise ValueError(f"{where}: {keys[name]} and {key} are two tensors of one name; leave one out")
        keys[name] = key
    if WIDTH not in keys:
        first = f"its first entry is {next(iter(keys))!r}" if keys else "it is empty"
        raise ValueError(f"{where}: not a Metric3D V2 (ViT) checkpoint, it has no {WIDTH}; {first}")
    for key in keys.values():
        if not isinstance(content[key], torch.Tensor):
            raise ValueError(f"{where}: {key} is a {type(content[key]).__name__}, not a tensor")
    return _once({name: content[key] for name, key in keys.items()}, where)


def _once(named: Mapping[str, torch.Tensor], where: str) -> dict[str, torch.Tensor]:
    """Of a parameter that is stored twice only the first name; ValueError if the two differ."""
    state = {}
    for key, value in named.items():
        name = key.replace(".downsample.1.", ".norm3.")
        if name != key and name in named:
            if not torch.equal(value, named[name]):
                _check_finite(value, key, where)  # NaN is not equal to itself
                raise ValueError(f"{where}: {key} and {name} are one parameter, but have different values")
            continue
        state[name] = value
    return state


def _read_safetensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        return load_file(path)
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
