"""Whether surface targets are better than the base: measured where that can be, described where it cannot.

Both are taken per observation when a group's targets are made, while its pictures are at hand, and stored in the
file's header; what is printed before training is read from there. The measure is that of an evaluation: the base's
prediction, and the same with the surface target inside the mask, are aligned to true depth or to the teacher's
prediction on the treated reference, and compared by the RMSE inside.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch

from gift_peft.evaluation.evaluate import REFERENCES
from gift_peft.evaluation.protocols import get_protocol
from gift_peft.evaluation.samples import Observation
from gift_peft.evaluation.scoring import Scorer, Task
from gift_peft.evaluation.statistics import GroupBootstrap
from gift_peft.evaluation.tables import counted
from gift_peft.losses import prediction_spread
from gift_peft.models.pixels import resize_mask
from gift_peft.rules import UNKNOWN, GroupPictures
from gift_peft.surface_targets import SurfaceTarget

AGAINST = {"depth": "true depth", "proxy": "the treated reference"}


def describe(group: GroupPictures, proxies: torch.Tensor, found: SurfaceTarget, kind: str) -> dict:
    """What is known of a group's surface targets, for the header of their file.

    Args:
        group: with its pictures, and depths or the proxy of its treated reference, if it has any.
        proxies: (N,h,w) in native units. found: of them. kind: what they are.

    Returns:
        `dict`: `surface`; `model`, `residual` and `disagreement` as in `SurfaceTarget`; and `observations`, each with
        `image`, `nearer` (share of the target that was moved toward the camera), `moved` (median distance moved,
        divided by the base's P95-P5) and for each reference that is there, [RMSE of the base, of the surface target]
        inside the mask: `depth` in mm, `proxy` in native units. What is not known is None.
    """
    rows = []
    targets, known = torch.as_tensor(found.depth), proxies != UNKNOWN
    farthest = proxies[known].max()  # stands where the teacher's own mask, of networks that predict depth, says sky
    proxies, targets = proxies.where(known, farthest), targets.where(targets != UNKNOWN, farthest)
    for index, name in enumerate(group.names):
        base, target = proxies[index], targets[index]
        valid = group.valids[index] if len(group.valids) else np.ones(group.masks[index].shape, bool)
        size = base.shape[0], base.shape[1]
        region = torch.from_numpy(resize_mask(group.masks[index], size) & resize_mask(valid, size))
        row: dict = {"image": name, "nearer": None, "moved": None}
        spread = prediction_spread(base.double(), torch.from_numpy(resize_mask(valid, size)))
        if region.any() and spread:
            moved = (target - base)[region].double().numpy()
            row["nearer"] = float(np.mean(moved > 0 if kind == "inverse_depth" else moved < 0))
            row["moved"] = float(np.median(np.abs(moved))) / spread
        if len(group.depths):
            reference = group.depths[index].astype(np.float32)
            row["depth"] = _errors(base, target, reference, group.masks[index], valid, "depth", kind)
        if group.reference_proxy is not None:
            reference = np.asarray(group.reference_proxy)
            mask, there = (resize_mask(each, size) for each in (group.masks[index], valid))
            row["proxy"] = _errors(base, target, reference, mask, there, "proxy", kind)
        rows.append(row)
    fits = {name: [_known(value) for value in getattr(found, name)] for name in ("residual", "disagreement")}
    return {"surface": group.surface, "model": found.model, **fits, "observations": rows}


def describe_nothing(group: GroupPictures) -> dict:
    """What `describe` returns for a group without a pixel of target at the network's size."""
    return {"surface": group.surface, "model": [], "residual": [], "disagreement": [], "observations": []}


def _errors(
    base: torch.Tensor, target: torch.Tensor, reference: np.ndarray, mask, valid, against: str, kind: str
) -> list[float] | None:
    """[base, surface target]: RMSE inside the mask; None where nothing is known there."""
    protocol = replace(get_protocol(REFERENCES[against]), resolution=1.0)
    score = Scorer(Observation("", {}, reference, mask, valid), Task([], protocol, kind, 1.0, "", in_mm=False))
    errors = [score(prediction)[0]["tom"]["rmse"] for prediction in (base, target)]
    return errors if all(map(math.isfinite, errors)) else None


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


# ---- what is printed ----


def surface_lines(groups: Iterable[tuple[str, dict]]) -> list[str]:
    """For each surface kind, in one or two lines, what the targets change.

    Args:
        groups: (group_id, what `describe` returned) of a split; groups whose files do not say it are left out.
    """
    kinds: dict[str, list[tuple[str, dict]]] = {}
    for group_id, told in groups:
        if told:
            kinds.setdefault(told["surface"] or "unknown surface", []).append((group_id, told))
    lines = []
    for kind in sorted(kinds):
        start = f"{kind} ({counted(len(kinds[kind]), 'group')})"
        measured = [line for against in AGAINST if (line := _measured(kinds[kind], against))]
        lines += [f"{start}: {line}" for line in measured or [_described(kinds[kind])]]
        lost = [name for name, told in kinds[kind] if all(row["nearer"] is None for row in told["observations"])]
        if 0 < len(lost) < len(kinds[kind]):
            lines.append(f"{start}: no target at this size in {counted(len(lost), 'group')}, such as {lost[0]}")
    return lines


def _measured(groups: Sequence[tuple[str, dict]], against: str) -> str:
    """The mean error before and after, with a bootstrap interval over groups; empty if there is nothing to compare."""
    rows: list[dict] = [
        {"group_id": group_id, "image": row["image"]}
        | {model: {"tom": {"rmse": error}} for model, error in zip(("base", "adapted"), row[against], strict=True)}
        for group_id, told in groups
        for row in told["observations"]
        if row.get(against)
    ]
    if not rows:
        return ""
    before, after = (float(np.mean([row[model]["tom"]["rmse"] for row in rows])) for model in ("base", "adapted"))
    low, high = GroupBootstrap(rows).change_interval("tom", "rmse")
    interval = f" [{low:+.0f}, {high:+.0f}]" if math.isfinite(low) else ""
    unit = " mm" if against == "depth" else ""
    change = f"{100 * (after / before - 1):+.0f} %{interval}" if before else "unknown"
    compared = len({row["group_id"] for row in rows})
    among = f", of {counted(compared, 'group')} that have it" if compared < len(groups) else ""
    return (
        f"error inside the target against {AGAINST[against]}{among}: {before:.3g}{unit} of the base, "
        f"{after:.3g}{unit} of the surface target ({change})"
    )


def _described(groups: Sequence[tuple[str, dict]]) -> str:
    """What the targets do to predictions, where nothing says whether that is right."""
    rows = [row for _, told in groups for row in told["observations"] if row["nearer"] is not None]
    if not rows:
        return "no target at this size"
    nearer, moved = (float(np.mean([row[name] for row in rows])) for name in ("nearer", "moved"))
    text = f"{nearer:.0%} of the target moved nearer, by {moved:.1%} of the prediction's range"
    for name, told_as in (("disagreement", "predictions disagree by"), ("residual", "a plane misses them by")):
        values = [value for _, told in groups for value in told[name] if value is not None]
        if values:
            text += f"; {told_as} {np.mean(values):.1%}"
    return f"{text} (no treated reference or true depth here says whether that is right)"
