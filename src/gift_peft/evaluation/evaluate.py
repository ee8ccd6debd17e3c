"""A model beside its base, inside the target and outside of it: on groups of GIFT-I, or on Booster's measured depth.

Every image is predicted by the base and by the adapted model, aligned to its reference and scored per region; GCE
(Eq. 7) is the mean over groups. The consensus is the base with its target replaced by the group's per-pixel median:
what Eq. 3 pulls towards. Predictions are made in the precision that the model is in, which for `DepthModel` is
float32 without TF32, as the proxies are.
"""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.rows import parsed
from gift_peft.dataset.tensors import Group
from gift_peft.evaluation.booster_scenes import TOM_CLASSES, BoosterScene, GroundTruth, find_booster, read_ground_truth
from gift_peft.evaluation.protocols import Protocol, get_protocol
from gift_peft.evaluation.results import Report, make_report
from gift_peft.evaluation.samples import Predictor, Sample, booster_sample, gift_i_samples, predict_scene
from gift_peft.evaluation.scoring import Task, score_groups
from gift_peft.evaluation.stored_predictions import PredictionFolder
from gift_peft.models.loading import DepthModel
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
    rules = {reference: get_protocol(protocol or REFERENCES[reference])}
    options = (baseline, accelerator, prediction_scale, batch_size, progress)
    return _against(dataset, depth_model, rules, *options)[reference]


def evaluate_references(dataset: Any, model: DepthModel) -> dict[str, Report]:
    """`evaluate_gift_i` against each of `REFERENCES`, with its own protocol; every image is predicted once."""
    rules = {reference: get_protocol(protocol) for reference, protocol in REFERENCES.items()}
    return _against(parsed(dataset), model, rules, True, None, None, 2, True)


def _against(
    dataset: Any,
    model: DepthModel,
    rules: dict[str, Protocol],
    baseline: bool,
    accelerator: Any,
    prediction_scale: float | None,
    batch_size: int,
    progress: bool,
) -> dict[str, Report]:
    """A report for each reference that has a protocol; arguments and errors as of `evaluate_gift_i`."""
    predictors = _predictors(model, baseline, batch_size)
    models = [*predictors, *(["consensus"] if "base" in predictors else [])]
    tasks = {}
    for reference, protocol in rules.items():
        protocol = replace(protocol, resolution=1.0)  # on the reference's own grid
        if reference == "proxy" and protocol.space != "native":
            raise ValueError(
                f"protocol {protocol.name} aligns to depth in {protocol.unit}; proxies are in native units: use "
                '"native", or reference="depth"'
            )
        # Against proxies nothing is ever inverted, so a callable without a recipe need not say what it predicts.
        kind = model.kind or "depth" if reference == "proxy" else model.known_kind()
        if reference == "depth" and protocol.space == "native" and kind == "inverse_depth":
            raise ValueError(f'protocol {protocol.name} would fit inverse depth straight to depth; use "gift"')
        scale = prediction_scale or _unit_of(model, protocol)
        in_mm = reference == "depth"
        tasks[reference] = Task(models, protocol, kind, scale, NO_DEPTH if in_mm else NO_PROXY, in_mm)

    def read(index: int) -> list[Sample]:
        return gift_i_samples(dataset[index], model, predictors, list(tasks), "consensus" in models)

    scored = score_groups(len(dataset), read, list(tasks.values()), accelerator, progress, "group")
    reports = {}
    for (reference, task), (groups, rows) in zip(tasks.items(), scored, strict=True):
        if not rows:
            raise ValueError("the dataset has no groups to evaluate")
        if reference == "depth" and all(row["skipped"] == NO_DEPTH for row in rows):
            raise ValueError(
                'no group of the dataset has true depth; evaluate against the proxies (reference="proxy")'
            )
        reports[reference] = make_report("gift-i", groups, rows, models, task.protocol, reference)
    return reports


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
        scale = prediction_scale or _unit_of(depth_model, rules)

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

    def read(index: int) -> list[Sample]:
        scene = booster.scenes[index]
        truth = read_ground_truth(scene, resize, occlusion, tom_classes)
        return [booster_sample(scene, truth, predict(scene, truth))]

    ((groups, rows),) = score_groups(len(booster.scenes), read, [task], accelerator, progress, "scene")
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


def _unit_of(model: DepthModel, rules: Protocol) -> float:
    """mm per unit of a model's predictions; 1 where a scale is fitted, or, with a warning, where nothing says it."""
    if rules.fits_scale:
        return 1.0
    if model.millimeters_per_unit == 1:
        warnings.warn(
            f"protocol {rules.name} fits no scale, and nothing says that this model predicts metres: its numbers are "
            "taken for mm; prediction_scale (--prediction-scale) says what one unit is",
            stacklevel=4,
        )
    return model.millimeters_per_unit


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
