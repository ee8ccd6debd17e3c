"""The groups that an evaluation scores: predictions beside what they are compared with, image by image.

A group of GIFT-I and a scene of Booster are the same thing: images of one pose and geometry. Booster's predictions and
pictures come one at a time, so that a scene of 12 megapixels takes the memory of one scene.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from gift_peft.dataset.tensors import Group, collate_group
from gift_peft.evaluation.booster_scenes import BoosterScene, GroundTruth
from gift_peft.images import read_image
from gift_peft.losses import require_finite
from gift_peft.models.loading import DepthModel
from gift_peft.rules import UNKNOWN

SCENE_PIXELS = 2**20  # of a prediction kept for GCE and spread; a quarter of Booster's size has fewer

Predictor = Callable[[torch.Tensor], torch.Tensor]


@dataclass
class Observation:
    """One image of a group.

    Args:
        name (`str`): in the rows of the result.
        predictions (`dict`): per model (h,w), numpy or torch, of any size.
        reference (`np.ndarray`, *optional*): (H,W), in mm or native units; None where there is none.
        mask (`np.ndarray`): (H,W) bool, the target.
        valid (`np.ndarray`, *optional*): (H,W) bool, the pixels that exist; None is all of them.
    """

    name: str
    predictions: Mapping[str, Any]
    reference: np.ndarray | None
    mask: np.ndarray
    valid: np.ndarray | None = None


@dataclass
class Sample:
    """One group.

    Args:
        group_id (`str`): its name.
        observations (`Iterable[Observation]`): can be gone through once.
        told (`dict`): what else its rows say, `surface` on GIFT-I.
        limit (`tuple[int, int]`, *optional*): larger predictions are reduced to it for GCE and spread, for which all
            are in memory together.
    """

    group_id: str
    observations: Iterable[Observation]
    told: dict = field(default_factory=dict)
    limit: tuple[int, int] | None = None


# ---- GIFT-I ----


def gift_i_samples(
    row: Any,
    model: DepthModel,
    predictors: Mapping[str, Predictor],
    references: Sequence[str],
    consensus_too: bool = False,
) -> list[Sample]:
    """A group of GIFT-I beside each reference, all of it predicted once.

    Args:
        row: of `load_gift_i`, or a ready `Group`.
        model: what rows are fed to; its base predicts a treated reference whose proxy is not stored.
        predictors: {name: pixel values (N,3,h,w) to (N,h,w)}.
        references: of `proxy` and `depth`.
        consensus_too (`bool`): with the `consensus` of `base` among the predictions.

    Raises ValueError naming group and image for predictions that are not finite or not of the images' size.
    """
    group = row if isinstance(row, Group) else collate_group(row, model.processor, model.size)
    maps = _predict(predictors, group.pixel_values, f"group {group.group_id}", group.names)
    for name, prediction in maps.items():
        if prediction.shape != group.mask.shape:
            made, wanted = ("x".join(map(str, shape[1:])) for shape in (prediction.shape, group.mask.shape))
            raise ValueError(
                f"group {group.group_id}: the {name} model predicts {made} for images of {wanted}; "
                "give a size whose sides are multiples of its patch size"
            )
    return [_beside(group, model, maps, reference, consensus_too) for reference in references]


def _beside(
    group: Group, model: DepthModel, maps: dict[str, torch.Tensor], reference: str, consensus_too: bool
) -> Sample:
    """One reference of `gift_i_samples`."""
    if group.target is None and model.masks_itself and reference == "proxy":
        there = model.predict_proxies(group.pixel_values) != UNKNOWN
        group = replace(group, valid=there if group.valid is None else group.valid & there)
    if consensus_too:
        maps = maps | {"consensus": consensus(maps["base"], group.mask, group.valid)}
    known = _against_depth(group) if reference == "depth" else _against_proxy(group, model)
    observations = [
        Observation(name, {model: depth[index] for model, depth in maps.items()}, *known[index])
        for index, name in enumerate(group.names)
    ]
    return Sample(group.group_id, observations, {"surface": group.surface})


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


def _against_proxy(group: Group, model: DepthModel) -> list[tuple]:
    """Per observation the base's prediction on the treated reference, mask and valid mask, at the network's size."""
    target = group.reference_target
    if target is None and group.reference_pixel_values is not None:
        target = model.predict_proxies(group.reference_pixel_values)[0]
        require_finite(target[None], f"group {group.group_id}: the frozen prediction", ["the treated reference"])
    return _on_network_grid(group, None if target is None else target.numpy())


def _against_depth(group: Group) -> list[tuple]:
    """Per observation true depth, mask and valid mask on the depth's own grid, where the masks were drawn."""
    pictures = group.pictures
    if pictures is None:
        raise ValueError('reference="depth" needs the rows of load_gift_i: a Group has no masks at the depth\'s size')
    if not pictures.depths:
        return _on_network_grid(group, None)
    depths = [depth.astype(np.float32) for depth in pictures.depths]
    return list(zip(depths, pictures.masks, pictures.valids or [None] * len(depths), strict=True))


def _on_network_grid(group: Group, reference: np.ndarray | None) -> list[tuple]:
    valids = [None] * len(group.mask) if group.valid is None else group.valid.numpy()
    return [(reference, mask, valid) for mask, valid in zip(group.mask.numpy(), valids, strict=True)]


# ---- Booster ----


def booster_sample(scene: BoosterScene, truth: GroundTruth, predictions: Iterable[dict[str, Any]]) -> Sample:
    """A scene of Booster with the predictions of its images in their order."""
    factor = min(1.0, math.sqrt(SCENE_PIXELS / truth.depth.size))
    observations = (
        Observation(image.stem, own, truth.depth, truth.tom)
        for image, own in zip(scene.images, predictions, strict=True)
    )
    limit = round(truth.depth.shape[0] * factor), round(truth.depth.shape[1] * factor)
    return Sample(scene.name, observations, limit=limit)


def predict_scene(
    scene: BoosterScene, truth: GroundTruth, model: DepthModel, predictors: Mapping[str, Predictor]
) -> Iterator[dict[str, torch.Tensor]]:
    """Predictions of a scene's images at the network's size; the pictures are opened one at a time."""
    pixels = torch.cat([model.inputs([_read_image(path, truth)]) for path in scene.images])
    maps = _predict(predictors, pixels, f"scene {scene.name}", [path.name for path in scene.images])
    return (dict(zip(maps, depths, strict=True)) for depths in zip(*maps.values(), strict=True))


def _read_image(path, truth: GroundTruth):
    image = read_image(path)
    if image.size[::-1] != truth.full_size:
        found, expected = (f"{height}x{width}" for height, width in (image.size[::-1], truth.full_size))
        raise ValueError(f"{path} is {found} (height x width), but disp_00.npy is {expected}")
    return image


def _predict(
    predictors: Mapping[str, Predictor], pixel_values: torch.Tensor, what: str, names: list[str]
) -> dict[str, torch.Tensor]:
    """Every model's (N,h,w), one per image and finite."""
    maps = {name: predict(pixel_values) for name, predict in predictors.items()}
    for name, depth in maps.items():
        if depth.ndim != 3 or len(depth) != len(names):
            raise ValueError(f"{what}: the {name} model predicts {tuple(depth.shape)} for {len(names)} images")
        require_finite(depth, f"{what}: the {name} prediction", names)
    return maps
