"""The one loop of all evaluations: groups are predicted one after the other and scored behind that, in threads.

Scores are taken on the CPU in float64, image by image, so that a row depends neither on the other groups nor on their
order, nor on how many threads there are. Two groups at most are scored while the next one is predicted: a scene of
Booster may be large.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from gift_peft.dataset.shares import Alone, failing_together, in_order, own_share
from gift_peft.evaluation.alignment import align, known, resize_prediction
from gift_peft.evaluation.fitting import DegenerateFitError
from gift_peft.evaluation.metrics import depth_metrics, metric_names
from gift_peft.evaluation.protocols import MILLIMETERS, Protocol
from gift_peft.evaluation.results import REGIONS
from gift_peft.evaluation.safety import Flicker, false_free_space
from gift_peft.evaluation.samples import Observation, Sample
from gift_peft.losses import GeometryConsistencyError, prediction_spread
from gift_peft.models.pixels import resize_mask

SCORERS = 2  # threads, and groups in them

Scored = tuple[list[dict], list[dict]]  # GCE per group, and the rows


@dataclass
class Task:
    """The choices of one evaluation, the same for every group.

    Args:
        models (`list[str]`): those of `base`, `adapted`, `consensus` that are compared.
        protocol, kind: as in `align`.
        prediction_scale (`float`): what predictions are multiplied by first.
        missing (`str`): why a row without a reference is skipped.
        in_mm (`bool`): the reference is depth, so that safety can be measured.
    """

    models: list[str]
    protocol: Protocol
    kind: str
    prediction_scale: float
    missing: str
    in_mm: bool


def score_groups(
    count: int,
    read: Callable[[int], Sequence[Sample]],
    tasks: Sequence[Task],
    accelerator: Any,
    progress: bool,
    unit: str,
) -> list[Scored]:
    """Per task (GCE per group, rows) of all groups in their order, which the processes share.

    `read(index)` predicts a group and gives what each task scores of it. A ValueError or OSError of one process, from
    reading or scoring, is raised in all.
    """
    state = accelerator or Alone()
    mine = own_share(count, state)
    results: list[list[tuple[dict, list[dict]]]] = []
    waiting: deque[Future] = deque()
    pool = ThreadPoolExecutor(SCORERS, thread_name_prefix="scoring")
    quiet = None if progress and state.process_index == 0 else True
    with failing_together(state):
        try:
            for index in tqdm(mine, desc="evaluate", unit=unit, disable=quiet):
                samples = read(index)
                if len(waiting) == SCORERS:
                    results.append(waiting.popleft().result())
                waiting.append(pool.submit(_score_all, samples, tasks))
            results += [future.result() for future in waiting]
        finally:
            pool.shutdown(cancel_futures=True)
    found = in_order(list(zip(mine, results, strict=True)), state)
    by_task = list(zip(*found, strict=True)) or [()] * len(tasks)
    return [([group for group, _ in own], [row for _, rows in own for row in rows]) for own in by_task]


def _score_all(samples: Sequence[Sample], tasks: Sequence[Task]) -> list[tuple[dict, list[dict]]]:
    return [_score_group(sample, task) for sample, task in zip(samples, tasks, strict=True)]


def _score_group(sample: Sample, task: Task) -> tuple[dict, list[dict]]:
    """The group's GCE and its rows."""
    rows, masks, valids = [], [], []
    maps = {name: [] for name in task.models if name != "consensus"}
    flicker = {name: Flicker() for name in maps}
    for observation in sample.observations:
        score = Scorer(observation, task)
        row = {"group_id": sample.group_id, "image": observation.name, **sample.told, "skipped": None}
        row |= {"target_pixels": score.target_pixels, "pixels": score.pixels}
        for name in task.models:
            prediction = observation.predictions[name]
            small = _at_most(prediction, sample.limit)
            if name in maps:
                maps[name].append(small)
            row[name] = _native_statistics(small, observation)
            scores, aligned, skipped = score(prediction)
            row[name] |= scores
            if task.in_mm and name in maps:
                row[name]["false_free_space"] = math.nan
                if aligned is not None and observation.reference is not None:
                    row[name]["false_free_space"] = false_free_space(aligned, observation.reference, score.target)
                    flicker[name].update(aligned, score.target)
            if skipped and not row["skipped"]:
                row["skipped"] = skipped.format(model=name)
        rows.append(row)
        masks.append(observation.mask)
        valids.append(observation.valid)
    group = {"group_id": sample.group_id, **sample.told, "num_images": len(rows)}
    for name, depths in maps.items():
        error = GeometryConsistencyError()
        group[f"gce_{name}"] = error.update(*_on_one_grid(depths, masks, valids))
        group[f"gce_{name}_normalized"] = error.compute_normalized()
        if task.in_mm:
            group[f"flicker_{name}"] = flicker[name].compute()
        group["counted"] = error.num_groups == 1  # False: no two target masks overlap
    return group, rows


class Scorer:
    """Alignment and metrics per region of the predictions of one observation."""

    def __init__(self, observation: Observation, task: Task) -> None:
        self.task, self.reference = task, observation.reference
        mask = observation.mask
        valid = np.ones(mask.shape, bool) if observation.valid is None else observation.valid
        there = np.zeros(mask.shape, bool) if self.reference is None else valid & known(self.reference)
        self.unit = MILLIMETERS[task.protocol.unit]
        if self.reference is not None and self.unit != 1:
            self.reference = self.reference / self.unit
        self.regions = {"all": there, "tom": there & mask, "other": there & ~mask}
        self.pixels = {name: int(np.count_nonzero(self.regions[name])) for name in REGIONS}
        self.target = mask & valid
        self.target_pixels = int(np.count_nonzero(self.target))

    def __call__(self, prediction: Any) -> tuple[dict, np.ndarray | None, str | None]:
        """Scores and aligned (H,W), in mm or native units, of a (h,w) prediction; NaN and why without a reference."""
        task = self.task
        nothing = {"scale": float("nan"), "shift": float("nan"), "num_clipped": 0, "num_nonpositive": 0}
        thresholds = task.protocol.thresholds
        nothing |= {region: dict.fromkeys(metric_names(thresholds), float("nan")) for region in REGIONS}
        if self.reference is None or self.pixels["all"] < 2:
            return nothing, None, task.missing
        prediction = resize_prediction(prediction, self.reference.shape)
        if (scale := task.prediction_scale / self.unit) != 1:
            prediction = prediction * scale
        try:
            alignment = align(prediction, self.reference, self.regions["all"], task.protocol, task.kind)
        except DegenerateFitError:
            return nothing, None, "with a constant {model} prediction"
        scores = {name: getattr(alignment, name) for name in ("scale", "shift", "num_clipped", "num_nonpositive")}
        for name in REGIONS:
            scores[name] = depth_metrics(alignment.aligned, self.reference, self.regions[name], thresholds)
        return scores, alignment.aligned * self.unit, None


def _at_most(prediction: Any, limit: tuple[int, int] | None) -> torch.Tensor:
    """A prediction as (h,w) float32 of no more pixels than `limit`."""
    if limit and prediction.shape[0] * prediction.shape[1] > limit[0] * limit[1]:
        prediction = resize_prediction(prediction, limit)
    return torch.as_tensor(prediction, dtype=torch.float32)


def _native_statistics(prediction: torch.Tensor, observation: Observation) -> dict:
    """Mean over the target and spread of a (h,w) prediction, in its units, which tell whether outputs collapse."""
    _, target, valid = _on_one_grid([prediction], [observation.mask], [observation.valid])
    inside = prediction[(target if valid is None else target & valid)[0]]
    mean = float(inside.double().mean()) if inside.numel() else float("nan")
    return {"target_mean": mean, "spread": prediction_spread(prediction, None if valid is None else valid[0])}


def _on_one_grid(
    depths: list[torch.Tensor], masks: list[np.ndarray], valids: list[np.ndarray | None]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """Predictions, target and valid masks of a group (N,h,w), at the size of the first prediction."""
    height, width = depths[0].shape
    shape = height, width
    depth = torch.stack(
        [d if d.shape == shape else torch.from_numpy(resize_prediction(d, shape)).float() for d in depths]
    )
    mask = torch.from_numpy(np.stack([resize_mask(mask, shape) for mask in masks]))
    if valids[0] is None:
        return depth, mask, None
    return (
        depth,
        mask,
        torch.from_numpy(np.stack([resize_mask(valid, shape) for valid in valids if valid is not None])),
    )
