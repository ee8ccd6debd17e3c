"""Many pictures through one model without the device waiting: the next ones are decoded and predicted meanwhile."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from gift_peft.images import read_image


def predict_ahead(
    model: Any,
    files: Sequence[Path],
    base_too: bool = False,
    focal_length: float | tuple[float, float] | None = None,
    batch_size: int | None = None,
    decoders: int = 2,
) -> Iterator[dict[str, np.ndarray] | Exception]:
    """In the order of the files, {"own": (H,W) float32, "base": the same of the base} or the error of that picture.

    Args:
        model: a `DepthModel` or `DeployedModel`; or anything with their `depth_at`, which then takes one picture at a
            time.
        base_too (`bool`): with the base's depth.
        batch_size (`int`, *optional*): pictures per forward; default 8 on a GPU, else 1. The last bits of a prediction
            may depend on it.
        decoders (`int`): threads that open and resize pictures.
    """

    batch_size = batch_size or _default_batch(model)

    def decode(file: Path) -> tuple | Exception:
        if not hasattr(model, "depths_of"):
            return (file,)
        try:
            picture = read_image(file)
            return model.inputs([picture]), picture.size[::-1], str(file)
        except (ValueError, OSError) as error:
            return error

    def predict(waiting: list[Future]) -> list[dict[str, np.ndarray] | Exception]:
        results: list[Any] = [future.result() for future in waiting]
        good = [index for index, result in enumerate(results) if not isinstance(result, Exception)]
        try:
            depths = _depths(model, [results[index] for index in good], base_too, focal_length)
        except ValueError:  # of one of them: by itself each has its own error
            depths = []
            for index in good:
                try:
                    depths += _depths(model, [results[index]], base_too, focal_length)
                except ValueError as error:
                    depths.append(error)
        for index, depth in zip(good, depths, strict=True):
            results[index] = depth
        return results

    with ThreadPoolExecutor(decoders) as opening, ThreadPoolExecutor(1) as device:
        ahead: list[Future] = []
        try:
            for start in range(0, len(files), batch_size):
                batch = files[start : start + batch_size]
                ahead.append(device.submit(predict, [opening.submit(decode, file) for file in batch]))
                if len(ahead) > 2:
                    yield from ahead.pop(0).result()
            while ahead:
                yield from ahead.pop(0).result()
        finally:
            for future in ahead:
                future.cancel()


def _depths(model: Any, opened: list[tuple], base_too: bool, focal_length: Any) -> list[Any]:
    if not opened:
        return []
    if not hasattr(model, "depths_of"):
        ways = {"own": False, "base": True} if base_too else {"own": False}
        return [
            {way: model.depth_at(file, focal_length, base=base) for way, base in ways.items()} for (file,) in opened
        ]
    pixels, sizes, names = zip(*opened, strict=True)
    batch = _joined(pixels)
    own = model.depths_of(batch, sizes, names, focal_length)
    if not base_too:
        return [{"own": depth} for depth in own]
    base = model.depths_of(batch, sizes, names, focal_length, base=True)
    return [{"own": first, "base": second} for first, second in zip(own, base, strict=True)]


def _joined(parts: Sequence[Any]) -> Any:
    if isinstance(parts[0], np.ndarray):  # of an exported model, which runs where there is no torch
        return np.concatenate(parts)
    import torch

    return torch.cat(parts)


def _default_batch(model: Any) -> int:
    parameters = getattr(getattr(model, "network", None), "parameters", None)
    weight = next(parameters(), None) if parameters else None
    return 8 if weight is not None and weight.device.type != "cpu" else 1
