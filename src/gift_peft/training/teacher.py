"""The teacher: the frozen base model, asked once for every image before training starts (paper section 4, proxies).

Proxies are float32, without TF32. Where training is too, the self-distillation of a model whose adapter is still zero
is exactly zero, however both are cut into batches: the losses take differences of rounding for none. Surface targets
are computed from the proxies, and from what the teacher predicts for the flipped photos and for fills
(surface_targets.py).
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from accelerate import PartialState
from accelerate.utils import parse_flag_from_env
from PIL import Image
from tqdm import tqdm

from gift_peft.dataset.digests import DigestCache, default_digests_dir
from gift_peft.dataset.gift_i import gift_i_splits, load_gift_i
from gift_peft.dataset.proxies import (
    EARLIER,
    SURFACE_SUFFIX,
    TOLD,
    ProxyStore,
    SurfaceSettings,
    default_proxies_dir,
    difference,
    has_earlier_set,
    make_header,
    proxies_command,
    read_header,
    write_proxies,
    write_surface,
)
from gift_peft.dataset.shares import failing_together, own_share
from gift_peft.evaluation.surface_check import describe, describe_nothing, surface_lines
from gift_peft.models.identity import earlier_revision, teacher_id, teacher_revision
from gift_peft.models.loading import DepthModel
from gift_peft.models.pixels import pixel_settings, resize_mask
from gift_peft.rules import UNKNOWN, GroupPictures
from gift_peft.surface_targets import SurfaceTarget, paint_fills, surface_target

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
    surface: SurfaceSettings | None = None,
    kind: str | None = None,
    model: DepthModel | None = None,
) -> Path:
    """Predict every image and treated reference of a dataset and keep it for training and evaluation.

    Can be stopped at any moment and started again: finished groups are kept, each file is whole or absent. Several
    processes (`accelerate launch`) share the groups; the files do not depend on how many there are.

    Args:
        base (`str` or `Path`): the teacher, a hub id or a folder.
        dataset_path (`str` or `Path`): anything `load_gift_i` takes.
        splits (`Sequence[str]`, *optional*): default all that the dataset has.
        size (`tuple[int, int]` or `str`, *optional*): (h, w) or "HxW"; default the recipe's, else the processor's.
        batch_size (`int`): images per forward; the same everywhere, so that equal proxies are equal files.
        proxies_dir (`str` or `Path`, *optional*): default the dataset's own `proxies` folder, or a cache folder for
            hub ids and folders that cannot be written (`default_proxies_dir`).
        accelerator (`Accelerator`, *optional*): its device and processes; default what `accelerate launch` set up.
        overwrite (`bool`): make every proxy again instead of refusing stale ones; with `surface`, every surface target
            (proxies that hold are kept).
        surface (`SurfaceSettings`, *optional*): also make the surface targets, with these settings.
        kind (`str`, *optional*): what the teacher predicts, for surface targets; default what its recipe says.
        model (`DepthModel`, *optional*): the teacher, where it is loaded already; its size and kind are its own.

    Returns:
        `Path`: `<proxies_dir>/<teacher>/<h>x<w>`; files that 0.1.0 made one folder higher stay there while they hold.

    Raises:
        ValueError, OSError: in every process, one line naming the file, or group and image: stale proxies or surface
            targets, NaN predictions, unreadable data, a folder that cannot be written, an unknown kind.
    """
    state = accelerator or PartialState(cpu=parse_flag_from_env("ACCELERATE_USE_CPU"))
    identity = teacher_id(base, revision)
    pinned = teacher_revision(base, revision)
    model = model or DepthModel.from_pretrained(base, revision=revision, size=size, kind=kind, device=state.device)
    folder = Path(proxies_dir or default_proxies_dir(dataset_path, identity)) / identity
    named = "x".join(map(str, model.size))
    place = (base, dataset_path, named, proxies_dir, revision)
    command = proxies_command(*place)
    header = make_header(identity, pinned, model.size, pixel_settings(model.processor))
    surface_header, surface_command = {}, ""
    if surface is not None:
        surface_header = header | surface.header() | {"kind": model.known_kind()}
        surface_command = proxies_command(*place, surface) + (f" --kind {kind}" if kind else "")

    earlier = {}
    if has_earlier_set(folder) and Path(base).is_dir():
        earlier = {EARLIER: earlier_revision(base)}

    def make(groups: DigestCache, index: int, split: str) -> None:
        group_id, names = groups.facts(index)
        if surface is not None and group_id.endswith(SURFACE_SUFFIX):
            raise ValueError(f"group {group_id}: rename it; so the surface targets of another group are called")
        digests, row = groups.read(index)
        store = ProxyStore(str(folder), named, split, header | earlier, command)
        file = f"{group_id}.safetensors"
        known = header | digests.pictures
        holds = partial(_is_current, names=names)
        if (overwrite and surface is None) or not holds(store.path(file), known | earlier, command, "proxy"):
            row = row or groups.groups[index]
            write_proxies(store.place(file), known, *_predict_row(model, row, batch_size))
        if surface is None:
            return
        file = f"{group_id}{SURFACE_SUFFIX}.safetensors"
        known = surface_header | digests.pictures | digests.masks
        if overwrite or not holds(store.path(file), known | earlier, surface_command, "surface target"):
            proxies, reference = store.read(group_id, names, digests.pictures)
            row = replace(row or groups.groups[index], reference_proxy=reference)
            *targets, told = _surface_row(model, row, proxies, surface, batch_size)
            write_surface(store.place(file), known | {TOLD: told}, *targets)

    what = "proxies" if surface is None else "surface targets"
    with failing_together(state):
        for split in splits or gift_i_splits(dataset_path):
            groups = DigestCache(load_gift_i(dataset_path, split), default_digests_dir())
            bar = {"desc": f"{what}, {split}", "unit": "group", "delay": 2, "disable": not state.is_main_process}
            for index in tqdm(own_share(len(groups), state), **bar):
                make(groups, index, split)
    return folder / named


def told_of_surface(folder: Path, split: str, group_ids: Iterable[str]) -> list[str]:
    """What the surface targets of a split change, per surface kind: `surface_lines` of their files' headers.

    Args:
        folder: what `make_proxies` returned. split: of the dataset. group_ids: of its groups; files of an
            earlier version, which do not tell, are left out.
    """
    store = ProxyStore(str(folder.parent), folder.name, split, {}, "")
    files = ((name, store.path(f"{name}{SURFACE_SUFFIX}.safetensors")) for name in group_ids)
    return surface_lines((name, read_header(path).get(TOLD, {})) for name, path in files)


def _is_current(path: Path, expected: dict, command: str, what: str, names: Sequence[str]) -> bool:
    """Whether a group's proxies, or surface targets, exist and hold; ValueError if they exist and do not."""
    if not path.exists():
        return False
    reason = difference(read_header(path, command, what), expected, names)
    if reason:
        raise ValueError(f"stale {what} {path}: {reason}; make it again with `{command} --overwrite`")
    return True


def _predict_row(model: DepthModel, row: GroupPictures, batch_size: int):
    """(proxies (N, h, w), reference (h, w) or None) of one row; ValueError naming the image of a bad prediction."""
    names, images = row.names, row.images
    proxies = model.predict_proxies(model.inputs(images), batch_size)
    reference = None
    if row.reference is not None:
        reference = model.predict_proxies(model.inputs([row.reference]))[0]
    for name, proxy in [*zip(names, proxies, strict=True), ("the reference", reference)]:
        if proxy is not None and tuple(proxy.shape) != model.size:
            raise ValueError(f"the model predicts {tuple(proxy.shape)} for images of {model.size}; they must be equal")
        if proxy is not None:
            _require_finite(proxy, row, name)
    return proxies, reference


def _require_finite(prediction: torch.Tensor, row: GroupPictures, name: str) -> None:
    if not torch.isfinite(prediction).all():
        raise ValueError(f"group {row.group_id}, {name}: the teacher's prediction has NaN or infinite values")


def _surface_row(
    model: DepthModel, row: GroupPictures, proxies: torch.Tensor, settings: SurfaceSettings, batch_size: int
) -> tuple[torch.Tensor, torch.Tensor, dict]:
    """(target, target_flipped), each (N, h, w), and what is known of them, of one row; ValueError naming the group.

    A row without a pixel to teach at this size keeps its own predictions. Flipped are the pixels that the network
    takes, as training does it: what a resized photo's mirror image shows may differ by rounding. What the teacher
    itself leaves out stays UNKNOWN, unless other predictions say what is there.
    """
    masks = np.stack([resize_mask(mask, model.size) for mask in row.masks])
    valids = np.stack([resize_mask(valid, model.size) for valid in row.valids]) if row.valids else np.ones_like(masks)
    flipped = model.predict_proxies(model.inputs(row.images).flip(-1), batch_size)
    if not (masks & valids).any():
        return proxies, flipped, describe_nothing(row)
    fills: list[torch.Tensor] = []
    fills_flipped: list[torch.Tensor] = []
    for name, image, mask, mirrored in zip(row.names, row.images, row.masks, flipped, strict=True):
        _require_finite(mirrored, row, f"{name} flipped")
        painted = paint_fills(np.asarray(image), mask, settings.fills, settings.seed)
        if settings.fills:
            pixels = torch.cat([model.inputs([Image.fromarray(fill)]) for fill in painted])
            # UNKNOWN is no depth: `surface_target` leaves it out like every value that is not positive.
            fills.append(model.predict_proxies(pixels, batch_size))
            fills_flipped.append(model.predict_proxies(pixels.flip(-1), batch_size))
            _require_finite(torch.stack([fills[-1], fills_flipped[-1]]), row, f"a fill of {name}")

    def surface(
        own: torch.Tensor, painted: list[torch.Tensor], turn: slice
    ) -> tuple[torch.Tensor, SurfaceTarget | None]:
        inside, there = masks[:, :, turn], valids[:, :, turn] & (own != UNKNOWN).numpy()
        if not (inside & there).any():
            return own, None
        found = surface_target(
            own.numpy(),
            inside,
            row.surface,
            torch.stack(painted).numpy() if painted else None,
            model.known_kind(),
            there,
            settings.surface_model,
            settings.surface_quantile,
            settings.surface_tau,
        )
        target = torch.from_numpy(found.depth).float()
        if not target.isfinite().all():
            raise ValueError("the surface target has NaN or infinite values")
        return target, found

    try:
        target, found = surface(proxies, fills, slice(None))
        target_flipped, _ = surface(flipped, fills_flipped, slice(None, None, -1))
        told = describe_nothing(row) if found is None else describe(row, proxies, found, model.known_kind())
        return target, target_flipped, told
    except ValueError as error:
        raise ValueError(f"group {row.group_id}: {error}") from None
