"""One group of an evaluation: predict, align every observation to the reference, score it per region.

All of it on the CPU in float64, image by image, so that a row does not depend on the other groups or their order.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch

from gift_peft.dataset.tensors import Group
from gift_peft.evaluation.alignment import align, known, to_numpy
from gift_peft.evaluation.fitting import DegenerateFitError
from gift_peft.evaluation.metrics import METRICS, depth_metrics
from gift_peft.evaluation.protocols import Protocol
from gift_peft.evaluation.results import REGIONS
from gift_peft.images import to_mask
from gift_peft.losses import GeometryConsistencyError, prediction_spread, require_finite
from gift_peft.models.loading import DepthModel

Predictor = Callable[[torch.Tensor], torch.Tensor]

NO_PROXY, NO_DEPTH = "without a treated reference", "without true depth"  # why a row is skipped


def predictors_of(model: DepthModel, baseline: bool, batch_size: int) -> dict[str, Predictor]:
    """Base and adapted as functions of pixel values, where there is an adapter or a teacher; else the base alone."""
    own, frozen = (partial(run, batch_size=batch_size) for run in (model.predict, model.predict_base))
    if not model.adapted:
        return {"base": own}
    return {"base": frozen, "adapted": own} if baseline else {"adapted": own}


@dataclass
class Task:
    """The choices of one evaluation, the same for every group."""

    predictors: dict[str, Predictor]
    model: DepthModel
    models: list[str]
    protocol: Protocol
    reference: str
    kind: str
    prediction_scale: float = 1.0


def evaluate_group(row: Any, group: Group, task: Task) -> tuple[dict, list[dict]]:
    """The GCE of a row's group, and its rows."""
    predictions = {name: predict(group.pixel_values) for name, predict in task.predictors.items()}
    for name, prediction in predictions.items():
        _check_prediction(prediction, group, name)
    gce = {"group_id": group.group_id, "surface": group.surface, "num_images": len(group.names)}
    for name, prediction in predictions.items():
        error = GeometryConsistencyError()
        gce[f"gce_{name}"] = error.update(prediction, group.mask, group.valid)
        gce[f"gce_{name}_normalized"] = error.compute_normalized()
        gce["counted"] = error.num_groups == 1  # False: no two target masks meet
    if "consensus" in task.models:
        predictions["consensus"] = consensus(predictions["base"], group.mask, group.valid)
    targets, masks, valids = references(row, group, task)
    rows = []
    for index, name in enumerate(group.names):
        result = {
            "group_id": group.group_id,
            "image": name,
            "surface": group.surface,
            "skipped": None,
            "target_pixels": int(np.count_nonzero(masks[index] & valids[index])),
        }
        own_valid = None if group.valid is None else group.valid[index]
        missing = NO_PROXY if task.reference == "proxy" else NO_DEPTH
        where = targets[index], masks[index], valids[index]
        score = Scorer(*where, task.protocol, task.kind, task.prediction_scale, missing)
        result["pixels"] = score.pixels
        for model in task.models:
            prediction = predictions[model][index]
            result[model] = native_statistics(prediction, group.mask[index], own_valid)
            scores, skipped = score(prediction)
            result[model] |= scores
            if skipped and not result["skipped"]:
                result["skipped"] = skipped.format(model=model)
        rows.append(result)
    return gce, rows


def consensus(prediction: torch.Tensor, mask: torch.Tensor, valid: torch.Tensor | None = None) -> torch.Tensor:
    """(N,h,w) predictions of one group with every target pixel replaced by the group's median at that pixel.

    The median is over the observations in which the pixel is target (and valid); the mean of the middle two if even.
    """
    target = mask if valid is None else mask & valid
    values = torch.where(target, prediction, torch.nan)
    somewhere = target.any(0)
    median = torch.full(prediction.shape[1:], torch.nan, dtype=prediction.dtype)
    middle = np.nanmedian(values[:, somewhere].numpy(), axis=0)
    median[somewhere] = torch.from_numpy(middle.astype(values.numpy().dtype))
    return torch.where(target, median, prediction)


def _check_prediction(prediction: torch.Tensor, group: Group, model: str) -> None:
    if prediction.shape != group.mask.shape:
        made, wanted = ("x".join(map(str, shape[1:])) for shape in (prediction.shape, group.mask.shape))
        raise ValueError(
            f"group {group.group_id}: the {model} model predicts {made} for images of {wanted}; "
            "give a size whose sides are multiples of its patch size"
        )
    require_finite(prediction, f"group {group.group_id}: the {model} prediction", group.names)


def native_statistics(prediction: torch.Tensor, mask: torch.Tensor, valid: torch.Tensor | None = None) -> dict:
    """Mean over the target and spread of a (h,w) prediction, in its units, which tell whether outputs collapse."""
    target = prediction[mask if valid is None else mask & valid]
    mean = float(target.double().mean()) if target.numel() else float("nan")
    return {"target_mean": mean, "spread": prediction_spread(prediction, valid)}


def references(row: Any, group: Group, task: Task) -> tuple[Sequence, list[np.ndarray], list[np.ndarray]]:
    """Per observation: the reference (None without one), the target mask and the valid mask, all on its grid."""
    shape = tuple(group.mask.shape[1:])
    masks = list(group.mask.numpy())
    valids = [np.ones(shape, bool)] * len(masks) if group.valid is None else list(group.valid.numpy())
    if task.reference == "proxy":
        target = group.reference_target
        if target is None and group.reference_pixel_values is not None:
            target = task.model.predict_base(group.reference_pixel_values)[0]
            require_finite(target[None], f"group {group.group_id}: the frozen prediction", ["the treated reference"])
        return [None if target is None else target.numpy()] * len(masks), masks, valids
    if group.depths is None:
        return [None] * len(masks), masks, valids
    if isinstance(row, Group):
        raise ValueError('reference="depth" needs the rows of load_gift_i: a Group has no masks at the depth\'s size')
    # On the depth's own grid, where the masks were drawn (one size per group).
    label = [f"group {group.group_id}, image {name}" for name in group.names]
    masks = [to_mask(mask, f"{at}: its mask") for mask, at in zip(row["masks"], label, strict=True)]
    valids = [to_mask(mask, f"{at}: its valid mask") for mask, at in zip(row.get("valids") or [], label, strict=False)]
    return (
        [depth.numpy() for depth in group.depths],
        masks,
        valids or [np.ones(mask.shape, bool) for mask in masks],
    )


class Scorer:
    """Alignment and metrics per region of the predictions of one image.

    Args:
        reference (`np.ndarray`, *optional*): (H,W), in mm or native units; None where there is none.
        mask, valid (`np.ndarray`): (H,W) bool, the target and the pixels that exist.
        protocol, kind: as in `align`.
        prediction_scale (`float`): what predictions are multiplied by first.
        missing (`str`): the reason to give where the reference says nothing.
    """

    def __init__(
        self,
        reference: np.ndarray | None,
        mask: np.ndarray,
        valid: np.ndarray,
        protocol: Protocol,
        kind: str,
        prediction_scale: float = 1.0,
        missing: str = NO_DEPTH,
    ) -> None:
        self.reference, self.protocol, self.kind, self.scale = reference, protocol, kind, prediction_scale
        self.missing = missing
        there = np.zeros(valid.shape, bool) if reference is None else valid & known(reference)
        self.regions = {"all": there, "tom": there & mask, "other": there & ~mask}
        self.fit = self.regions["other"] if protocol.fit_region == "other" else there
        self.pixels = {name: int(np.count_nonzero(self.regions[name])) for name in REGIONS}

    def __call__(self, prediction: Any) -> tuple[dict, str | None]:
        """Scores of a (h,w) prediction of any size; NaN and the reason where there is nothing to compare."""
        nothing = {"scale": float("nan"), "shift": float("nan"), "num_clipped": 0, "num_nonpositive": 0}
        nothing |= {region: dict.fromkeys(METRICS, float("nan")) for region in REGIONS}
        if self.pixels["all"] < 2:
            return nothing, self.missing
        prediction = resize_prediction(prediction, self.reference.shape)
        if self.scale != 1:
            prediction = prediction * self.scale
        try:
            alignment = align(prediction, self.reference, self.fit, self.protocol, self.kind)
        except DegenerateFitError:
            return nothing, "with a constant {model} prediction" if self.fit.any() else "without pixels to fit"
        scores = {name: getattr(alignment, name) for name in ("scale", "shift", "num_clipped", "num_nonpositive")}
        for name in REGIONS:
            scores[name] = depth_metrics(alignment.aligned, self.reference, self.regions[name])
        return scores, None


def resize_prediction(prediction: Any, size: tuple[int, int]) -> np.ndarray:
    """(h,w) numpy or torch to the reference's (H,W) float64, by OpenCV's bilinear interpolation where they differ."""
    prediction = to_numpy(prediction, np.float64)
    if prediction.shape != tuple(size):
        prediction = cv2.resize(prediction, size[::-1], interpolation=cv2.INTER_LINEAR)
    return prediction
