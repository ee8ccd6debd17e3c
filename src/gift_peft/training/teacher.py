"""The teacher: the frozen base model, asked once for every image before training starts (paper section 4, proxies).

Proxies are float32 and made with the same cut into micro-batches as the group step, so at the first training step the
self-distillation of a model whose adapter is still zero is exactly zero.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from accelerate import PartialState
from accelerate.utils import gather_object, parse_flag_from_env
from tqdm import tqdm

from gift_peft.dataset.gift_i import gift_i_splits, load_gift_i, proxies_command
from gift_peft.dataset.proxies import (
    default_proxies_dir,
    difference,
    make_header,
    picture_digests,
    read_header,
    write_proxies,
)
from gift_peft.dataset.rows import parsed
from gift_peft.models.identity import teacher_id, teacher_revision
from gift_peft.models.loading import DepthModel
from gift_peft.models.pixels import pixel_settings
from gift_peft.rules import GroupPictures

if TYPE_CHECKING:
    from accelerate import Accelerator


def make_proxies(
    base: str | Path,
    dataset_path: str | Path,
    splits: Sequence[str] | None = None,
    size: tuple[int, int] | str | None = None,
    batch_size: int = 2,
    proxies_dir: str | Path | None = None,
    revision: str | None = None,
    accelerator: "Accelerator | None" = None,
    overwrite: bool = False,
) -> Path:
    """Predict every image and treated reference of a dataset and keep it for training and evaluation.

    Can be stopped at any moment and started again: finished groups are kept, each file is whole or absent. Several
    processes (`accelerate launch`) share the groups; the files do not depend on how many there are.

    Args:
        base (`str` or `Path`): the teacher, a hub id or a folder.
        dataset_path (`str` or `Path`): anything `load_gift_i` takes.
        splits (`Sequence[str]`, *optional*): default all that the dataset has.
        size (`tuple[int, int]` or `str`, *optional*): (h, w) or "HxW"; default the recipe's, else the processor's.
        batch_size (`int`): images per forward; predictions equal training's to the bit if it has the same.
        proxies_dir (`str` or `Path`, *optional*): default the dataset's own `proxies` folder, or a cache folder for
            hub ids and folders that cannot be written (`default_proxies_dir`).
        accelerator (`Accelerator`, *optional*): its device and processes; default what `accelerate launch` set up.
        overwrite (`bool`): make every proxy again instead of refusing stale ones.

    Returns:
        `Path`: `<proxies_dir>/<teacher>`.

    Raises:
        ValueError, OSError: in every process, one line naming the file, or group and image: stale proxies, NaN
            predictions, unreadable data, a folder that cannot be written.
    """
    state = accelerator or PartialState(cpu=parse_flag_from_env("ACCELERATE_USE_CPU"))
    identity = teacher_id(base, revision)
    pinned = teacher_revision(base, revision)
    model = DepthModel.from_pretrained(base, revision=revision, size=size, device=state.device)
    folder = Path(proxies_dir or default_proxies_dir(dataset_path, identity)) / identity
    command = proxies_command(base, dataset_path, "x".join(map(str, model.size)), proxies_dir, revision)
    header = make_header(identity, pinned, model.size, pixel_settings(model.processor))
    problem = None
    try:
        for split in splits or gift_i_splits(dataset_path):
            dataset = parsed(load_gift_i(dataset_path, split))
            mine = range(state.process_index, len(dataset), state.num_processes)
            for index in tqdm(
                mine, desc=f"proxies, {split}", unit="group", delay=2, disable=not state.is_main_process
            ):
                row = dataset[index]
                path = folder / split / f"{row.group_id}.safetensors"
                expected = header | picture_digests(row)
                if overwrite or not _is_current(path, expected, row.names, command):
                    write_proxies(path, expected, *_predict_row(model, row, batch_size))
    except (ValueError, OSError) as error:
        problem = error
    _raise_everywhere(problem, state)
    return folder


def _is_current(path: Path, expected: dict, names: Sequence[str], command: str) -> bool:
    """Whether a group's proxies exist and hold; ValueError if they exist and do not."""
    if not path.exists():
        return False
    reason = difference(read_header(path, command), expected, names)
    if reason:
        raise ValueError(f"stale proxy {path}: {reason}; make it again with `{command} --overwrite`")
    return True


def _predict_row(model: DepthModel, row: GroupPictures, batch_size: int):
    """(proxies (N, h, w), reference (h, w) or None) of one row; ValueError naming the image of a bad prediction."""
    names, images = row.names, row.images
    proxies = model.predict(model.inputs(images), batch_size)
    reference = None
    if row.reference is not None:
        reference = model.predict(model.inputs([row.reference]))[0]
    for name, proxy in [*zip(names, proxies, strict=True), ("the reference", reference)]:
        if proxy is not None and tuple(proxy.shape) != model.size:
            raise ValueError(f"the model predicts {tuple(proxy.shape)} for images of {model.size}; they must be equal")
        if proxy is not None and not torch.isfinite(proxy).all():
            raise ValueError(f"group {row.group_id}, {name}: the teacher's prediction has NaN or infinite values")
    return proxies, reference


def _raise_everywhere(problem: Exception | None, state) -> None:
    """Raise the first process's problem in all, so that none waits for one that has stopped."""
    problems = [problem] if state.num_processes == 1 else gather_object([problem])
    problem = next((problem for problem in problems if problem is not None), None)
    if problem is not None:
        raise problem
