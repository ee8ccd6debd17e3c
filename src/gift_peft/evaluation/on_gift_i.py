"""What GIFT did on groups of GIFT-I: the adapted model beside its base, inside the target and outside of it.

Every observation is predicted by the frozen and by the adapted model, aligned to the group's reference (the frozen
model's prediction on the treated reference, or true depth) and scored per region; GCE (Eq. 7) is the mean over groups.
The consensus is the base with its target replaced by the group's per-pixel median: what Eq. 3 pulls towards.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.tensors import Group, collate_group
from gift_peft.evaluation.protocols import Protocol, get_protocol
from gift_peft.evaluation.results import (
    GiftIReport,
    by_surface,
    count_rows,
    detect_collapse,
    summarize,
    summarize_gce,
)
from gift_peft.evaluation.scoring import NO_DEPTH, Task, evaluate_group, predictors_of
from gift_peft.models.loading import DepthModel

REFERENCES = {"proxy": "native", "depth": "gift"}  # and the protocol that goes with each


def evaluate_gift_i(
    dataset: Any,
    model: Any = None,
    teacher: Any = None,
    protocol: str | Protocol | None = None,
    reference: str = "proxy",
    *,
    processor: Any = None,
    size: tuple[int, int] | None = None,
    kind: str | None = None,
    baseline: bool = True,
    accelerator: Any = None,
    prediction_scale: float | None = None,
    batch_size: int = 2,
    progress: bool = True,
) -> GiftIReport:
    """Evaluates a model on groups, beside its base.

    A row of the result: `group_id`, `image`, `surface`, `skipped` (None or why), `target_pixels`, and for each of
    `base`, `adapted`, `consensus`: `target_mean` and `spread` (P95-P5) of the prediction in native units, `scale`,
    `shift`, `num_clipped`, `num_nonpositive` of its alignment, and the metrics of `all`, `tom` and `other`.

    Args:
        dataset: rows of `load_gift_i`, or ready `Group`s, read by index; or a path or hub id, of which the validation
            split is taken. Proxies attached to it give the treated reference's target; without them the frozen model
            predicts it here, which comes to the same.
        model: a `PeftModel`, whose base is reached by `disable_adapter()`; a model or a callable
            (B,3,h,w) -> (B,H,W) beside a `teacher`; or the base alone, to see where it stands.
        teacher: the frozen model or callable, or its folder or hub id, where `model` is not a `PeftModel`.
        protocol (`str` or `Protocol`, *optional*): default `native` against proxies, `gift` against depth.
        reference (`str`): `proxy`, or `depth`: the true z-depth of `depths`, on its own grid (predictions are resized
            bilinearly).
        processor, size: of the images; default those of the model (the size of the proxies if there are any).
        kind (`str`, *optional*): `depth` or `inverse_depth`; default the recipe's.
        baseline (`bool`): False leaves out the base, the consensus and the collapse check (to validate in training).
        accelerator (`accelerate.Accelerator`, *optional*): spreads the groups over its processes; every process gets
            the whole report.
        prediction_scale (`float`, *optional*): predictions times this are in mm, for protocols that fit no scale;
            default 1000 for models that say they are metric, which predict metres, else 1.
        batch_size (`int`): the cut of a group, in image order, as the teacher's.

    Raises:
        ValueError: a non-finite prediction (naming group and image), a prediction of another size than the image,
            an unknown reference, kind or protocol, a protocol in another space than the reference, a dataset without
            the reference asked for.
    """
    if reference not in REFERENCES:
        raise ValueError(f"unknown reference {reference!r}: choose one of {', '.join(REFERENCES)}")
    if model is None:
        raise ValueError("evaluate_gift_i needs a model")
    if isinstance(dataset, str | Path):
        dataset = load_gift_i(dataset, "validation")
    if size is None and not isinstance(model, DepthModel):
        size = _proxies_size(dataset)
    model = DepthModel.of(model, teacher=teacher, processor=processor, size=size, kind=kind)
    rules = replace(get_protocol(protocol or REFERENCES[reference]), resolution=1.0)  # on the reference's own grid
    if reference == "proxy" and rules.space != "native":
        raise ValueError(
            f'protocol {rules.name} aligns to depth in {rules.unit}; proxies are in native units: use "native", or '
            'reference="depth"'
        )
    # Against proxies nothing is ever inverted, so a callable without a recipe need not say what it predicts.
    kind = model.kind or "depth" if reference == "proxy" else model.known_kind()
    if reference == "depth" and rules.space == "native" and kind == "inverse_depth":
        raise ValueError(f'protocol {rules.name} would fit inverse depth straight to depth; use "gift"')
    predictors = predictors_of(model, baseline, batch_size)
    models = [*predictors, *(["consensus"] if "base" in predictors else [])]
    scale = prediction_scale or (model.millimeters_per_unit if rules.dof in ("none", "shift") else 1.0)
    task = Task(predictors, model, models, rules, reference, kind, scale)

    rank, world = (accelerator.process_index, accelerator.num_processes) if accelerator else (0, 1)
    results = []
    for index in tqdm(
        range(rank, len(dataset), world),
        desc="evaluate",
        unit="group",
        disable=None if progress and rank == 0 else True,
    ):
        row = dataset[index]
        group = row if isinstance(row, Group) else collate_group(row, model.processor, model.size)
        results.append((index, *evaluate_group(row, group, task)))
    if world > 1:
        from accelerate.utils import gather_object

        results = gather_object(results)
    results.sort(key=lambda result: result[0])
    groups = [group for _, group, _ in results]
    rows = [row for _, _, own in results for row in own]
    if not rows:
        raise ValueError("the dataset has no groups to evaluate")
    if reference == "depth" and all(row["skipped"] == NO_DEPTH for row in rows):
        raise ValueError('no group of the dataset has true depth; evaluate against the proxies (reference="proxy")')
    return _report(groups, rows, task)


def _proxies_size(dataset: Any) -> tuple[int, int] | None:
    """(height, width) of the proxies attached to a dataset, if there are any."""
    first = dataset[0] if len(dataset) else None
    if first is None or isinstance(first, Group):
        return None
    proxies = [first[name] for name in ("proxies", "reference_proxy") if first.get(name) is not None]
    return tuple(np.asarray(proxies[0]).shape[-2:]) if proxies else None


def _report(groups: list[dict], rows: list[dict], task: Task) -> GiftIReport:
    subject = "adapted" if "adapted" in task.models else "base"
    compared = {"base", "adapted"} <= set(task.models)
    average = task.protocol.aggregation
    return GiftIReport(
        summary=summarize(rows, subject, average),
        base=summarize(rows, "base", average) if "base" in task.models else None,
        consensus=summarize(rows, "consensus", average) if "consensus" in task.models else None,
        gce=summarize_gce(groups, task.models),
        collapse=detect_collapse(rows) if compared else None,
        by_surface=by_surface(rows, task.models, subject, average),
        counts=count_rows(rows, len(groups), subject),
        protocol=task.protocol.to_dict() | {"description": task.protocol.describe()},
        reference=task.reference,
        adapted=subject == "adapted",
        unit="native units" if task.reference == "proxy" else "mm",
        groups=groups,
        rows=rows,
    )
