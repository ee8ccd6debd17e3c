"""Which observations a report shows, by rule and not by hand, and their panels, predicted group by group."""

import math
from collections.abc import Callable, Iterator

from tqdm import tqdm

from gift_peft.evaluation.results import Report
from gift_peft.evaluation.statistics import value_of
from gift_peft.models.loading import DepthModel
from gift_peft.reports.figures import Panel
from gift_peft.reports.saved_run import SavedRun
from gift_peft.rules import GroupPictures

COMPARED_GROUPS = 40  # in compare.html, one observation each: a browser has to open it


def notable_observations(report: Report, count: int) -> dict[tuple[str, str], str]:
    """{(group, image): why} of at most `count` observations, each of another group, chosen by rule and not by hand.

    In turn: the largest RMSE of the base inside the target, the largest improvement, the largest deterioration.
    """
    scored = []
    for row in report.rows:
        base, adapted = (value_of(row, model, "tom", "rmse") for model in ("base", "adapted"))
        if not row["skipped"] and not math.isnan(base) and not math.isnan(adapted):
            scored.append((row["group_id"], row["image"], base, adapted))
    rankings = {
        "largest error of the base": sorted(scored, key=lambda entry: (-entry[2], entry[:2])),
        "largest improvement": sorted((e for e in scored if e[3] < e[2]), key=lambda e: (e[3] - e[2], e[:2])),
        "largest deterioration": sorted((e for e in scored if e[3] > e[2]), key=lambda e: (e[2] - e[3], e[:2])),
    }
    chosen: dict[tuple[str, str], str] = {}
    groups: set[str] = set()
    while len(chosen) < count and any(rankings.values()):
        for why, ranking in rankings.items():
            while ranking and ranking[0][0] in groups:
                ranking.pop(0)
            if ranking and len(chosen) < count:
                group, image, *_ = ranking.pop(0)
                chosen[group, image] = why
                groups.add(group)
    return chosen


def chosen_panels(
    run: SavedRun, report: Report, notable: dict, kept: dict[tuple[str, str], Panel], device: str | None
) -> Iterator[Panel]:
    """Panels group by group, so that one group is in memory at a time; the notable ones are also put into `kept`."""
    about = report.about
    base = about.get("base") or run.arguments.get("model_name_or_path")
    choices = (about.get(name) for name in ("adapter_scale", "revision", "size", "kind"))
    model = DepthModel.from_pretrained(base, about["adapter"], *choices, device)
    wanted = _wanted(report, notable)
    if not wanted:
        raise ValueError("no image has a known target to compare")
    groups = None if report.dataset == "booster" else _group_rows(report)
    for group_id, images in tqdm(wanted.items(), desc="pictures", unit="group", disable=None):
        labels = {image: _label(group_id, image, notable) for image in images}
        for image, panel in zip(images, _group_panels(report, groups, group_id, labels, model), strict=True):
            if (group_id, image) in notable:
                kept[group_id, image] = panel
            yield panel


def _wanted(report: Report, notable: dict) -> dict[str, list[str]]:
    """{group: images}: the notable images, and of the groups with the largest errors the image with the largest."""
    worst: dict[str, tuple[float, str]] = {}
    for row in report.rows:
        error = value_of(row, "base", "tom", "rmse")
        if not row["skipped"] and not math.isnan(error) and error > worst.get(row["group_id"], (-1.0, ""))[0]:
            worst[row["group_id"]] = error, row["image"]
    largest = set(sorted(worst, key=lambda group: (-worst[group][0], group))[:COMPARED_GROUPS])
    largest |= {group for group, _ in notable}
    return {
        group: list(dict.fromkeys([*(image for own, image in notable if own == group), worst[group][1]]))
        for group in worst
        if group in largest
    }


def _label(group_id: str, image: str, notable: dict) -> str:
    why = notable.get((group_id, image))
    return f"{group_id}/{image}" + (f", {why}" if why else "")


def _group_rows(report: Report) -> Callable[[str], GroupPictures]:
    """From a group's id to the group, as it is in the dataset."""
    from gift_peft.dataset.gift_i import load_gift_i
    from gift_peft.dataset.rows import parsed

    about = report.about
    split = about.get("split") or "validation"
    rows = parsed(load_gift_i(about["dataset"], split, dataset_revision=about.get("dataset_revision")))
    index = {group_id: number for number, group_id in enumerate(rows.select_columns(["group_id"])["group_id"])}

    def find(group_id: str) -> GroupPictures:
        if group_id not in index:
            raise ValueError(f"{about['dataset']} no longer has group {group_id}")
        return rows[index[group_id]]

    return find


def _group_panels(report, find, group_id: str, labels: dict[str, str], model: DepthModel) -> list[Panel]:
    from gift_peft.reports.panels import group_panels, scene_panels

    if report.dataset == "booster":
        return scene_panels(report.about, group_id, labels, model, report.protocol["name"])
    return group_panels(find(group_id), labels, model, report.protocol["name"], report.reference)
