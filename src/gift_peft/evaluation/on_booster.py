"""Booster's measured depth against a model, its base, or predictions that another program stored.

Scene by scene and image by image: a scene of 12 megapixels takes the memory of one scene. Its images share pose and
geometry and differ in light, so Eq. 7 over them (illumination GCE) tells how much the light alone moves a prediction.
"""

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from gift_peft.evaluation.booster_scenes import TOM_CLASSES, BoosterScene, GroundTruth, find_booster, read_ground_truth
from gift_peft.evaluation.protocols import Protocol, get_protocol
from gift_peft.evaluation.results import (
    BoosterReport,
    count_rows,
    count_scored,
    detect_collapse,
    summarize,
    summarize_gce,
)
from gift_peft.evaluation.scoring import (
    NO_DEPTH,
    Predictor,
    Scorer,
    native_statistics,
    predictors_of,
    resize_prediction,
)
from gift_peft.evaluation.stored_predictions import PredictionFolder
from gift_peft.images import read_image
from gift_peft.losses import GeometryConsistencyError, require_finite
from gift_peft.models.loading import DepthModel
from gift_peft.models.pixels import resize_mask
from gift_peft.rules import KINDS

SCENE_PIXELS = 2**20  # of a prediction kept for GCE and spread; a quarter of Booster's size has fewer

# One image's prediction per model.
ScenePredictor = Callable[[BoosterScene, GroundTruth], Iterable[dict[str, Any]]]


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
) -> BoosterReport:
    """Evaluates a model, beside its base, or stored predictions on Booster.

    A row of the result: `group_id` (the scene), `image` (the stem), `skipped` (None or why), `target_pixels` (ToM),
    `pixels` ({region: pixels with known depth}), and for each of `base`, `adapted` (stored predictions stand under
    `base`): `target_mean` and `spread` (P95-P5) of the prediction in its own units, `scale`, `shift`, `num_clipped`,
    `num_nonpositive` of its alignment, and the metrics of `all`, `tom` and `other` in mm.

    Args:
        root: of the data, at any of three levels (`gift_peft.evaluation.booster_scenes`).
        model, teacher: as in `evaluate_gift_i`: a `PeftModel`; or a model or callable (B,3,h,w) -> (B,H,W) beside a
            `teacher`; or the base alone.
        predictions: folder `<Scene>/camera_00/<image stem>.npy` (or npz, pfm, png), any size, in place of a model.
        kind (`str`, *optional*): `depth` or `inverse_depth`; default the recipe's. Stored predictions need it, unless
            the protocol's own evaluator takes one kind only (`depth4tom`: inverse depth).
        protocol (`str` or `Protocol`): one that compares depth, so not `native`.
        resize (`float`): size of the evaluation relative to the ground truth's, whatever the protocol's own.
        occlusion (`str`): `all`, or `noc` for pixels that both cameras see.
        subset, official: as in `find_booster`.
        tom_classes: material classes of the target; `other` is the rest.
        prediction_scale (`float`, *optional*): predictions times this are in mm, for protocols that fit no scale;
            default 1000 for models that say they are metric, which predict metres, else 1.
        processor, size: of the images; default those of the model.
        baseline (`bool`): False leaves out the base and the collapse check (to validate in training).
        accelerator (`accelerate.Accelerator`, *optional*): spreads the scenes over its processes; every process gets
            the whole report.
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
    fits_no_scale = rules.dof in ("none", "shift")
    if predictions is None:
        model = DepthModel.of(model, teacher=teacher, processor=processor, size=size, kind=kind)
        kind = model.known_kind()
        booster = find_booster(root, subset, official)
        predictors = predictors_of(model, baseline, batch_size)
        predict, models = _from_models(model, predictors), list(predictors)
        prediction_scale = prediction_scale or (model.millimeters_per_unit if fits_no_scale else 1.0)
    else:
        kind = _stored_kind(kind, rules)
        booster = find_booster(root, subset, official)
        stored = PredictionFolder(predictions, prediction_scale)
        stored.check(booster.scenes, needs_scale=fits_no_scale)
        predict, models, prediction_scale = _from_files(stored), ["base"], 1.0
    task = BoosterTask(predict, models, rules, kind, prediction_scale)

    rank, world = (accelerator.process_index, accelerator.num_processes) if accelerator else (0, 1)
    results = []
    bar = tqdm(
        total=sum(len(scene.images) for scene in booster.scenes[rank::world]),
        desc="evaluate Booster",
        unit="image",
        disable=None if progress and rank == 0 else True,
    )
    with bar:
        for index in range(rank, len(booster.scenes), world):
            scene = booster.scenes[index]
            truth = read_ground_truth(scene, resize, occlusion, tom_classes)
            results.append((index, *_evaluate_scene(scene, truth, task, bar)))
    if world > 1:
        from accelerate.utils import gather_object

        results = gather_object(results)
    results.sort(key=lambda result: result[0])
    about = {
        "root": str(root),
        "subset": booster.subset,
        "official": booster.official,
        "resize": resize,
        "occlusion": occlusion,
        "tom_classes": list(tom_classes),
        "kind": kind,
        "predictions": predictions and str(predictions),
    }
    groups = [group for _, group, _ in results]
    return _report(groups, [row for _, _, own in results for row in own], task, about)


@dataclass
class BoosterTask:
    """The choices of one evaluation, the same for every scene."""

    predict: ScenePredictor
    models: list[str]
    protocol: Protocol
    kind: str
    prediction_scale: float


def _stored_kind(kind: str | None, rules: Protocol) -> str:
    kind = kind or rules.expects
    if kind is None:
        raise ValueError('say what the predictions are: kind="depth" or kind="inverse_depth"')
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}: choose one of {', '.join(KINDS)}")
    return kind


def _from_models(model: DepthModel, predictors: dict[str, Predictor]) -> ScenePredictor:
    """Predictions at the network's size; the scene's pictures are opened one at a time."""

    def predict(scene: BoosterScene, truth: GroundTruth) -> Iterator[dict[str, torch.Tensor]]:
        pixels = torch.cat([model.inputs([_read_image(path, truth)]) for path in scene.images])
        maps = {name: predictor(pixels) for name, predictor in predictors.items()}
        for name, depth in maps.items():
            if depth.ndim != 3 or len(depth) != len(scene.images):
                raise ValueError(f"the {name} model predicts {tuple(depth.shape)} for {len(scene.images)} images")
            require_finite(depth, f"scene {scene.name}: the {name} prediction", [path.name for path in scene.images])
        return (dict(zip(maps, depths, strict=True)) for depths in zip(*maps.values(), strict=True))

    return predict


def _read_image(path: Path, truth: GroundTruth):
    image = read_image(path)
    if image.size[::-1] != truth.full_size:
        found, expected = (f"{height}x{width}" for height, width in (image.size[::-1], truth.full_size))
        raise ValueError(f"{path} is {found} (height x width), but disp_00.npy is {expected}")
    return image


def _from_files(stored: PredictionFolder) -> ScenePredictor:
    """Predictions as they are stored, read one at a time."""

    def predict(scene: BoosterScene, truth: GroundTruth) -> Iterator[dict[str, np.ndarray]]:
        return ({"base": stored.read(scene, image)} for image in scene.images)

    return predict


def _evaluate_scene(scene: BoosterScene, truth: GroundTruth, task: BoosterTask, bar: tqdm) -> tuple[dict, list[dict]]:
    """The scene's illumination GCE and its rows."""
    everywhere = np.ones(truth.depth.shape, bool)
    score = Scorer(truth.depth, truth.tom, everywhere, task.protocol, task.kind, task.prediction_scale, NO_DEPTH)
    rows, maps = [], {name: [] for name in task.models}
    for image, predictions in zip(scene.images, task.predict(scene, truth), strict=True):
        row = {"group_id": scene.name, "image": image.stem, "skipped": None}
        row |= {"target_pixels": int(np.count_nonzero(truth.tom)), "pixels": score.pixels}
        for name, prediction in predictions.items():
            small = _at_most(prediction, truth.depth.shape)
            maps[name].append(small)
            row[name] = native_statistics(small, torch.from_numpy(resize_mask(truth.tom, small.shape)))
            scores, skipped = score(prediction)
            row[name] |= scores
            if skipped and not row["skipped"]:
                row["skipped"] = skipped.format(model=name)
        rows.append(row)
        bar.update()
    group = {"group_id": scene.name, "num_images": len(rows)}
    for name, depths in maps.items():
        group |= _illumination_gce(name, depths, truth)
    return group, rows


def _at_most(prediction: Any, shape: tuple[int, int]) -> torch.Tensor:
    """A prediction as (h,w) float32, no larger than the evaluation nor than `SCENE_PIXELS`.

    A scene's predictions are in memory together, so it must not take the size of twelve megapixels times eleven.
    """
    factor = min(1.0, math.sqrt(SCENE_PIXELS / (shape[0] * shape[1])))
    limit = round(shape[0] * factor), round(shape[1] * factor)
    if prediction.shape[0] * prediction.shape[1] > limit[0] * limit[1]:
        prediction = resize_prediction(prediction, limit)
    return torch.as_tensor(prediction, dtype=torch.float32)


def _illumination_gce(name: str, depths: list[torch.Tensor], truth: GroundTruth) -> dict:
    """Eqs. 2-3 over a scene's predictions inside ToM, on the grid of the first."""
    shape = depths[0].shape
    depth = torch.stack(
        [d if d.shape == shape else torch.from_numpy(resize_prediction(d, shape)).float() for d in depths]
    )
    mask = torch.from_numpy(resize_mask(truth.tom, shape)).expand(len(depth), *shape)
    error = GeometryConsistencyError()
    value = error.update(depth, mask)
    return {
        f"gce_{name}": value,
        f"gce_{name}_normalized": error.compute_normalized(),
        "counted": error.num_groups == 1,  # False: one image, or no ToM pixel
    }


def _report(groups: list[dict], rows: list[dict], task: BoosterTask, about: dict) -> BoosterReport:
    subject = "adapted" if "adapted" in task.models else "base"
    average = task.protocol.aggregation
    per_scene = {}
    for group in groups:
        own = [row for row in rows if row["group_id"] == group["group_id"]]
        per_scene[group["group_id"]] = {
            "num_images": len(own),
            "num_scored": count_scored(own, subject, "all"),
            "summary": summarize(own, subject, average),
            "base": summarize(own, "base", average) if "base" in task.models else None,
        }
    return BoosterReport(
        summary=summarize(rows, subject, average),
        base=summarize(rows, "base", average) if "base" in task.models else None,
        illumination_gce=summarize_gce(groups, task.models),
        collapse=detect_collapse(rows) if {"base", "adapted"} <= set(task.models) else None,
        per_scene=per_scene,
        counts=count_rows(rows, len(groups), subject),
        protocol=task.protocol.to_dict() | {"description": task.protocol.describe()},
        adapted=subject == "adapted",
        unit="mm",
        groups=groups,
        rows=rows,
        about=about,
    )
