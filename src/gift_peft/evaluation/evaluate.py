"""A model beside its base, inside the target and outside of it: on groups of GIFT-I, or on Booster's measured depth.

Every image is predicted by the base and by the adapted model, aligned to its reference and scored per region; GCE
(Eq. 7) is the mean over groups. The consensus is the base with its target replaced by the group's per-pixel median:
what Eq. 3 pulls towards. Scores are taken on the CPU in float64, image by image, so that a row does not depend on
the other groups or their order.
"""

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.rows import parsed
from gift_peft.dataset.tensors import Group
from gift_peft.evaluation.alignment import align, known, resize_prediction
from gift_peft.evaluation.booster_scenes import TOM_CLASSES, BoosterScene, GroundTruth, find_booster, read_ground_truth
from gift_peft.evaluation.fitting import DegenerateFitError
from gift_peft.evaluation.metrics import depth_metrics, metric_names
from gift_peft.evaluation.protocols import MILLIMETERS, Protocol, get_protocol
from gift_peft.evaluation.results import REGIONS, Report, make_report
from gift_peft.evaluation.safety import Flicker, false_free_space
from gift_peft.evaluation.samples import (
    Observation,
    Predictor,
    Sample,
    booster_sample,
    gift_i_sample,
    predict_scene,
)
from gift_peft.evaluation.stored_predictions import PredictionFolder
from gift_peft.losses import GeometryConsistencyError, prediction_spread
from gift_peft.models.loading import DepthModel
from gift_peft.models.pixels import resize_mask
from gift_peft.rules import KINDS, parse_group

REFERENCES = {"proxy": "native", "depth": "gift"}  # and the protocol that goes with each
NO_PROXY, NO_DEPTH = "without a treated reference", "without true depth"  # why a row is skipped


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
) -> Report:
    """Evaluates a model on groups, beside its base.

    A row of the result: `group_id`, `image`, `surface`, `skipped` (None or why), `target_pixels`, `pixels` ({region:
    pixels with a known reference}), and for each of `base`, `adapted`, `consensus`: `target_mean` and `spread`
    (P95-P5) of the prediction in native units, `scale`, `shift`, `num_clipped`, `num_nonpositive` of its alignment,
    and the metrics of `all`, `tom` and `other`; against depth also `false_free_space`.

    Args:
        dataset: rows of `load_gift_i`, or ready `Group`s, read by index; or a path or hub id, of which the validation
            split is taken. Proxies attached to it give the treated reference's target; without them the base predicts
            it here, which comes to the same.
        model: a `DepthModel`; or a `PeftModel`, whose base is reached by `disable_adapter()`; a model or a callable
            (B,3,h,w) -> (B,H,W) beside a `teacher`; or the base alone, to see where it stands.
        teacher: the frozen model or callable, or its folder or hub id, where `model` has no adapter.
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
    dataset = parsed(dataset)
    if size is None and not isinstance(model, DepthModel):
        size = _proxies_size(dataset)
    depth_model = DepthModel.of(model, teacher=teacher, processor=processor, size=size, kind=kind)
    rules = replace(get_protocol(protocol or REFERENCES[reference]), resolution=1.0)  # on the reference's own grid
    if reference == "proxy" and rules.space != "native":
        raise ValueError(
            f'protocol {rules.name} aligns to depth in {rules.unit}; proxies are in native units: use "native", or '
            'reference="depth"'
        )
    # Against proxies nothing is ever inverted, so a callable without a recipe need not say what it predicts.
    kind = depth_model.kind or "depth" if reference == "proxy" else depth_model.known_kind()
    if reference == "depth" and rules.space == "native" and kind == "inverse_depth":
        raise ValueError(f'protocol {rules.name} would fit inverse depth straight to depth; use "gift"')
    predictors = _predictors(depth_model, baseline, batch_size)
    models = [*predictors, *(["consensus"] if "base" in predictors else [])]
    scale = prediction_scale or (1.0 if rules.fits_scale else depth_model.millimeters_per_unit)
    in_mm = reference == "depth"
    task = Task(models, rules, kind, scale, NO_DEPTH if in_mm else NO_PROXY, in_mm)

    def read(index: int) -> Sample:
        return gift_i_sample(dataset[index], depth_model, predictors, reference, "consensus" in models)

    groups, rows = _evaluate(len(dataset), read, task, accelerator, progress, "group")
    if not rows:
        raise ValueError("the dataset has no groups to evaluate")
    if reference == "depth" and all(row["skipped"] == NO_DEPTH for row in rows):
        raise ValueError('no group of the dataset has true depth; evaluate against the proxies (reference="proxy")')
    return make_report("gift-i", groups, rows, models, rules, reference)


def _proxies_size(dataset: Any) -> tuple[int, int] | None:
    """(height, width) of the proxies attached to a dataset, if there are any."""
    if len(dataset) == 0 or isinstance(first := dataset[0], Group):
        return None
    first = parse_group(first)
    proxies = first.reference_proxy if first.proxies is None else first.proxies
    return None if proxies is None else tuple(np.asarray(proxies).shape[-2:])


def evaluate_booster(
    root: str | Path,
    model: Any = None,
    predictions: str | Path | None = None,
    kind: str | None = None,
    protocol: str | Protocol = "gift",
    resize: float = 0.25,
    occlusion: str = "all",
    *,
    teacher: Any = None,
    subset: str | None = None,
    official: bool | None = None,
    tom_classes: Sequence[int] = TOM_CLASSES,
    prediction_scale: float | None = None,
    processor: Any = None,
    size: tuple[int, int] | None = None,
    baseline: bool = True,
    accelerator: Any = None,
    batch_size: int = 2,
    progress: bool = True,
) -> Report:
    """Evaluates a model, beside its base, or stored predictions on Booster.

    The rows are those of `evaluate_gift_i` without `surface`: `group_id` is the scene, `image` the stem, the target
    ToM, the reference measured depth in mm. Stored predictions stand under `base`, and there is no `consensus`.

    Args:
        root: of the data, at any of three levels (`gift_peft.evaluation.booster_scenes`).
        model, teacher, processor, size, baseline, accelerator, prediction_scale: as in `evaluate_gift_i`.
        predictions: folder `<Scene>/camera_00/<image stem>.npy` (or npz, pfm, png), any size, in place of a model.
        kind (`str`, *optional*): `depth` or `inverse_depth`; default the recipe's. Stored predictions need it, unless
            the protocol's own evaluator takes one kind only (`depth4tom`: inverse depth).
        protocol (`str` or `Protocol`): one that compares depth, so not `native`.
        resize (`float`): size of the evaluation relative to the ground truth's, whatever the protocol's own.
        occlusion (`str`): `all`, or `noc` for pixels that both cameras see.
        subset, official: as in `find_booster`.
        tom_classes: material classes of the target; `other` is the rest.
        batch_size (`int`): images per forward.

    Raises:
        FileNotFoundError: a file that is missing, or the list of predictions that are.
        ValueError: a damaged file, a size, class or number that cannot be, an unknown argument, no kind.
    """
    if (model is None) == (predictions is None):
        raise ValueError("evaluate_booster takes a model or predictions, one of the two")
    rules = get_protocol(protocol)
    if rules.space == "native":
        raise ValueError(f'protocol {rules.name} compares in native units, and Booster has depth: use "gift"')
    if rules.resolution not in (None, resize):
        warnings.warn(f"protocol {rules.name} is meant for x{rules.resolution:g}, not x{resize:g}", stacklevel=2)
    rules = replace(rules, resolution=resize)
    booster = find_booster(root, subset, official)
    if predictions is None:
        depth_model = DepthModel.of(model, teacher=teacher, processor=processor, size=size, kind=kind)
        kind = depth_model.known_kind()
        predictors = _predictors(depth_model, baseline, batch_size)
        models = [*predictors]
        scale = prediction_scale or (1.0 if rules.fits_scale else depth_model.millimeters_per_unit)

        def predict(scene: BoosterScene, truth: GroundTruth) -> Iterable[dict[str, Any]]:
            return predict_scene(scene, truth, depth_model, predictors)

    else:
        kind = _stored_kind(kind, rules)
        stored = PredictionFolder(predictions, prediction_scale)
        stored.check(booster.scenes, needs_scale=not rules.fits_scale)
        models, scale = ["base"], 1.0  # the folder has scaled what it reads

        def predict(scene: BoosterScene, truth: GroundTruth) -> Iterable[dict[str, Any]]:
            return ({"base": stored.read(scene, image)} for image in scene.images)

    task = Task(models, rules, kind, scale, NO_DEPTH, in_mm=True)

    def read(index: int) -> Sample:
        scene = booster.scenes[index]
        truth = read_ground_truth(scene, resize, occlusion, tom_classes)
        return booster_sample(scene, truth, predict(scene, truth))

    groups, rows = _evaluate(len(booster.scenes), read, task, accelerator, progress, "scene")
    report = make_report("booster", groups, rows, models, rules, "depth")
    report.about = {
        "root": str(root),
        "subset": booster.subset,
        "official": booster.official,
        "resize": resize,
        "occlusion": occlusion,
        "tom_classes": list(tom_classes),
        "kind": kind,
        "predictions": predictions and str(predictions),
    }
    return report


def _stored_kind(kind: str | None, rules: Protocol) -> str:
    kind = kind or rules.expects
    if kind is None:
        raise ValueError('say what the predictions are: kind="depth" or kind="inverse_depth"')
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}: choose one of {', '.join(KINDS)}")
    return kind


def _predictors(model: DepthModel, baseline: bool, batch_size: int) -> dict[str, Predictor]:
    """Base and adapted as functions of pixel values, where there is an adapter or a teacher; else the base alone."""
    own, base = (partial(predict, batch_size=batch_size) for predict in (model.predict, model.predict_base))
    if not model.adapted:
        return {"base": own}
    return {"base": base, "adapted": own} if baseline else {"adapted": own}


# ---- the one loop ----


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


def _evaluate(
    count: int, read: Callable[[int], Sample], task: Task, accelerator: Any, progress: bool, unit: str
) -> tuple[list[dict], list[dict]]:
    """(GCE per group, rows) of all groups in their order, which the processes share."""
    rank, world = (accelerator.process_index, accelerator.num_processes) if accelerator else (0, 1)
    quiet = None if progress and rank == 0 else True
    mine = tqdm(range(rank, count, world), desc="evaluate", unit=unit, disable=quiet)
    results = [(index, *_score_group(read(index), task)) for index in mine]
    if world > 1:
        from accelerate.utils import gather_object

        results = gather_object(results)
    results.sort(key=lambda result: result[0])
    return [group for _, group, _ in results], [row for _, _, own in results for row in own]


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
