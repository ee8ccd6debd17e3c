"""From models and data to the panels of a figure: each group or scene is predicted once for all its panels."""

from collections.abc import Mapping
from typing import Any

import torch

from gift_peft.evaluation.booster_scenes import find_booster, read_ground_truth
from gift_peft.evaluation.on_gift_i import REFERENCES, group_collator
from gift_peft.evaluation.predictors import evaluating, make_predictors, network_size, own_processor, to_millimetres
from gift_peft.evaluation.protocols import get_protocol
from gift_peft.evaluation.scoring import Task, references, resize_prediction
from gift_peft.images import read_image
from gift_peft.models.loading import prediction_kind
from gift_peft.models.pixels import to_pixel_values
from gift_peft.reports.figures import Panel


def group_panels(
    row: dict,
    labels: Mapping[int, str],
    model: Any,
    teacher: Any = None,
    *,
    protocol: str | None = None,
    reference: str = "depth",
    processor: Any = None,
    size: tuple[int, int] | None = None,
    kind: str | None = None,
    batch_size: int = 2,
) -> list[Panel]:
    """Observations of a group of GIFT-I as rows of `before_after`.

    Args:
        row: of `load_gift_i`.
        labels: {index of the observation: what stands above it}.
        model, teacher, protocol, reference, processor, size, kind, batch_size: as in `evaluate_gift_i`.

    Raises:
        ValueError: the group has no such reference.
    """
    kind = kind or prediction_kind(model)
    predictors, frozen = make_predictors(model, teacher, True, batch_size)
    rules = get_protocol(protocol or REFERENCES[reference])
    scale = to_millimetres(model, rules)
    task = Task(predictors, frozen, [], rules, reference, kind, scale)
    group = group_collator([row], model, processor, size)(row)
    with evaluating(model, teacher):
        targets, masks, valids = references(row, group, task)
        maps = [predictors[name](group.pixel_values) for name in ("base", "adapted")]
    panels = []
    for index, label in labels.items():
        if targets[index] is None:
            raise ValueError(f"group {group.group_id} has no {reference} to compare with")
        base, adapted = (scale * resize_prediction(depth[index], targets[index].shape) for depth in maps)
        panel = Panel(label, row["images"][index], targets[index], base, adapted, masks[index], kind, rules.name)
        panel.valid = valids[index]
        panels.append(panel)
    return panels


def scene_panels(
    about: dict,
    scene_name: str,
    labels: Mapping[str, str],
    model: Any,
    teacher: Any = None,
    *,
    protocol: str = "gift",
    processor: Any = None,
    size: tuple[int, int] | None = None,
    kind: str | None = None,
    batch_size: int = 2,
) -> list[Panel]:
    """Images of a Booster scene as rows of `before_after`.

    Args:
        about: of the `BoosterReport`: `root`, `subset`, `resize`, `occlusion`, `tom_classes`.
        scene_name: folder of the scene.
        labels: {stem of the image: what stands above it}.
        model, teacher, protocol, processor, size, kind, batch_size: as in `evaluate_booster`.

    Raises:
        FileNotFoundError: the data is not where it was. ValueError: no such scene or image.
    """
    kind = kind or prediction_kind(model)
    predictors, _ = make_predictors(model, teacher, True, batch_size)
    scale = to_millimetres(model, get_protocol(protocol))
    processor = processor or own_processor(model)
    size = network_size(size, model, processor)
    scenes = {scene.name: scene for scene in find_booster(about["root"], about["subset"], official=False).scenes}
    if scene_name not in scenes:
        raise ValueError(f"Booster root {about['root']} has no scene {scene_name}")
    truth = read_ground_truth(scenes[scene_name], about["resize"], about["occlusion"], about["tom_classes"])
    files = {path.stem: path for path in scenes[scene_name].images}
    if missing := labels.keys() - files.keys():
        raise ValueError(f"scene {scene_name} has no image {min(missing)}")
    images = {stem: read_image(files[stem]) for stem in labels}
    pixel_values = torch.cat([to_pixel_values([image], processor, size) for image in images.values()])
    with evaluating(model, teacher):
        maps = [predictors[name](pixel_values) for name in ("base", "adapted")]
    panels = []
    for (stem, label), *depths in zip(labels.items(), *maps, strict=True):
        base, adapted = (scale * resize_prediction(depth, truth.depth.shape) for depth in depths)
        small = images[stem].resize(truth.depth.shape[::-1])
        panels.append(Panel(label, small, truth.depth, base, adapted, truth.tom, kind, protocol))
    return panels
