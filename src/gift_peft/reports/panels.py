"""From models and data to the panels of a figure: each group or scene is predicted once for all its panels."""

from collections.abc import Mapping
from dataclasses import replace

from PIL import Image

from gift_peft.evaluation.alignment import resize_prediction
from gift_peft.evaluation.booster_scenes import find_booster, read_ground_truth
from gift_peft.evaluation.evaluate import REFERENCES
from gift_peft.evaluation.protocols import get_protocol
from gift_peft.evaluation.samples import Sample, booster_sample, gift_i_samples, predict_scene
from gift_peft.images import read_image
from gift_peft.models.loading import DepthModel
from gift_peft.reports.figures import Panel
from gift_peft.rules import GroupPictures, parse_group


def group_panels(
    row: dict | GroupPictures,
    labels: Mapping[str, str],
    model: DepthModel,
    protocol: str | None = None,
    reference: str = "depth",
) -> list[Panel]:
    """Observations of a group of GIFT-I as rows of `before_after`.

    Args:
        row: of `load_gift_i`, parsed or not.
        labels: {name of the image: what stands above it}.
        model: with an adapter or a teacher.
        protocol, reference: as in `evaluate_gift_i`.

    Raises:
        ValueError: the group has no such image, or no such reference.
    """
    group = parse_group(row)
    pictures = dict(zip(group.names, group.images, strict=True))
    _check(f"group {group.group_id}", labels, pictures)
    (sample,) = gift_i_samples(group, model, {"base": model.predict_base, "adapted": model.predict}, [reference])
    return _panels(sample, labels, pictures, model, protocol or REFERENCES[reference])


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
    scenes = {scene.name: scene for scene in find_booster(about["root"], about["subset"], official=False).scenes}
    if scene_name not in scenes:
        raise ValueError(f"Booster root {about['root']} has no scene {scene_name}")
    scene = scenes[scene_name]
    truth = read_ground_truth(scene, about["resize"], about["occlusion"], about["tom_classes"])
    files = {path.stem: path for path in scene.images}
    _check(f"scene {scene_name}", labels, files)
    scene = replace(scene, images=tuple(files[stem] for stem in labels))
    pictures = {stem: read_image(files[stem]).resize(truth.depth.shape[::-1]) for stem in labels}
    predictions = predict_scene(scene, truth, model, {"base": model.predict_base, "adapted": model.predict})
    return _panels(booster_sample(scene, truth, predictions), labels, pictures, model, protocol)


def _check(where: str, labels: Mapping[str, str], pictures: Mapping) -> None:
    if missing := labels.keys() - pictures.keys():
        raise ValueError(f"{where} has no image {min(missing)}")


def _panels(
    sample: Sample, labels: Mapping[str, str], pictures: Mapping[str, Image.Image], model: DepthModel, protocol: str
) -> list[Panel]:
    """In the order of the labels; predictions in mm where the protocol fits no scale."""
    scale = 1.0 if get_protocol(protocol).fits_scale else model.millimeters_per_unit
    found = {observation.name: observation for observation in sample.observations}
    panels = []
    for name, label in labels.items():
        one = found[name]
        if one.reference is None:
            raise ValueError(f"group {sample.group_id} has no reference to compare {name} with")
        base, adapted = (
            scale * resize_prediction(one.predictions[m], one.reference.shape) for m in ("base", "adapted")
        )
        panel = Panel(label, pictures[name], one.reference, base, adapted, one.mask, model.known_kind(), protocol)
        panel.valid = one.valid
        panels.append(panel)
    return panels
