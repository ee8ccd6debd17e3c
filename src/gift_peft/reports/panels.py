"""From models and data to the panels of a figure: each group or scene is predicted once for all its panels."""

from collections.abc import Mapping

import numpy as np
import torch

from gift_peft.dataset.tensors import collate_group
from gift_peft.evaluation.booster_scenes import find_booster, read_ground_truth
from gift_peft.evaluation.on_gift_i import REFERENCES
from gift_peft.evaluation.protocols import Protocol, get_protocol
from gift_peft.evaluation.scoring import Task, references, resize_prediction
from gift_peft.images import read_image
from gift_peft.models.loading import DepthModel
from gift_peft.reports.figures import Panel


def group_panels(
    row: dict,
    labels: Mapping[int, str],
    model: DepthModel,
    protocol: str | None = None,
    reference: str = "depth",
) -> list[Panel]:
    """Observations of a group of GIFT-I as rows of `before_after`.

    Args:
        row: of `load_gift_i`.
        labels: {index of the observation: what stands above it}.
        model: with an adapter or a teacher.
        protocol, reference: as in `evaluate_gift_i`.

    Raises:
        ValueError: the group has no such reference.
    """
    rules = get_protocol(protocol or REFERENCES[reference])
    kind = model.known_kind()
    task = Task({}, model, [], rules, reference, kind)
    group = collate_group(row, model.processor, model.size)
    targets, masks, valids = references(row, group, task)
    maps = [predict(group.pixel_values) for predict in (model.predict_base, model.predict)]
    panels = []
    for index, label in labels.items():
        if targets[index] is None:
            raise ValueError(f"group {group.group_id} has no {reference} to compare with")
        base, adapted = (_on_grid(depth[index], targets[index].shape, model, rules) for depth in maps)
        panel = Panel(label, row["images"][index], targets[index], base, adapted, masks[index], kind, rules.name)
        panel.valid = valids[index]
        panels.append(panel)
    return panels


def scene_panels(
    about: dict, scene_name: str, labels: Mapping[str, str], model: DepthModel, protocol: str = "gift"
) -> list[Panel]:
    """Images of a Booster scene as rows of `before_after`.

    Args:
        about: of the report: `root`, `subset`, `resize`, `occlusion`, `tom_classes`.
        scene_name: folder of the scene.
        labels: {stem of the image: what stands above it}.
        model: with an adapter or a teacher.
        protocol: as in `evaluate_booster`.

    Raises:
        FileNotFoundError: the data is not where it was. ValueError: no such scene or image.
    """
    rules, kind = get_protocol(protocol), model.known_kind()
    scenes = {scene.name: scene for scene in find_booster(about["root"], about["subset"], official=False).scenes}
    if scene_name not in scenes:
        raise ValueError(f"Booster root {about['root']} has no scene {scene_name}")
    truth = read_ground_truth(scenes[scene_name], about["resize"], about["occlusion"], about["tom_classes"])
    files = {path.stem: path for path in scenes[scene_name].images}
    if missing := labels.keys() - files.keys():
        raise ValueError(f"scene {scene_name} has no image {min(missing)}")
    images = {stem: read_image(files[stem]) for stem in labels}
    pixel_values = torch.cat([model.inputs([image]) for image in images.values()])
    maps = [predict(pixel_values) for predict in (model.predict_base, model.predict)]
    panels = []
    for (stem, label), *depths in zip(labels.items(), *maps, strict=True):
        base, adapted = (_on_grid(depth, truth.depth.shape, model, rules) for depth in depths)
        small = images[stem].resize(truth.depth.shape[::-1])
        panels.append(Panel(label, small, truth.depth, base, adapted, truth.tom, kind, protocol))
    return panels


def _on_grid(depth: torch.Tensor, shape: tuple[int, int], model: DepthModel, rules: Protocol) -> np.ndarray:
    """A prediction at the reference's size, in mm where the protocol fits no scale."""
    scale = model.millimeters_per_unit if rules.dof in ("none", "shift") else 1.0
    return scale * resize_prediction(depth, shape)
