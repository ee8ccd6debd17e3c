"""How well a sensor's holes and glass are filled, where the truth is known (`gift-peft evaluate --sensor-depth`).

The truth is `depths` of a dataset: rendered depth, or what the sensor says of an opaque twin of the target at the same
place. The sensor alone is compared with the base and the adapted model aligned to it, and with two fillings that take
no model: the border painted inwards, and the plane of a ring about the target.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from gift_peft.dataset.rows import parsed
from gift_peft.deploy.sensor import fill_sensor_depth
from gift_peft.deploy.sensor_files import DEPTH_SUFFIXES, list_files, pair_files, read_depth, to_size
from gift_peft.evaluation.metrics import METRICS, depth_metrics
from gift_peft.evaluation.results import REGIONS, mean, write_results
from gift_peft.evaluation.table_formats import Cell, Table, value_cell
from gift_peft.evaluation.tables import METRIC_NAMES, REGION_NAMES
from gift_peft.models.loading import DepthModel
from gift_peft.rules import GroupPictures, parse_group

METHODS = {
    "sensor": "sensor alone",
    "inpainted": "border painted in",
    "plane": "plane of the ring",
    "base": "base aligned",
    "adapted": "adapted aligned",
}
RING = 1 / 40  # of the longer side: width of the ring whose plane is taken


@dataclass
class SensorReport:
    """The result of `evaluate_sensor`; lengths in mm.

    Args:
        summary (`dict`): {method: {region: {metric: mean over images}}}; the sensor is scored where it has a value.
        coverage (`dict`): {region: mean percent of the pixels with known truth where the sensor has a value}.
        rows (`list[dict]`): one per image: `group_id`, `image`, `coverage`, `skipped` (None or why), and its metrics.
    """

    summary: dict
    coverage: dict
    rows: list[dict] = field(repr=False)

    def save(self, folder: str | Path) -> Path:
        """Writes `sensor.json` and `sensor_rows.jsonl`; returns the folder."""
        facts = {"unit": "mm", "summary": self.summary, "coverage": self.coverage}
        return write_results(folder, self.rows, facts, ("sensor.json", "sensor_rows.jsonl"))

    def table(self) -> Table:
        """Errors per method inside and outside the target."""
        lines: list[list[str | Cell] | None] = []
        for region in REGIONS[:2]:
            for index, (method, scores) in enumerate(self.summary.items()):
                cells = [value_cell(scores[region][metric]) for metric in METRICS]
                lines.append([REGION_NAMES[region] if index == 0 else "", METHODS[method], *cells])
            lines.append(None)
        scored = [row for row in self.rows if not row["skipped"]]
        covered = f"{self.coverage['tom']:.0f} % of the target and {self.coverage['other']:.0f} % of the rest"
        notes = [f"The sensor has a value at {covered}, and is scored there alone; the others everywhere."]
        notes.append(
            f"Metric depth, no alignment to the truth; means over images. Scored: {len(scored)} of {len(self.rows)}."
        )
        notes += sorted(
            {f"{row['group_id']}, {row['image']}: {row['skipped']}" for row in self.rows if row["skipped"]}
        )[:3]
        return Table(
            "Sensor depth, filled (mm)", ["region", ""], [METRIC_NAMES[m] for m in METRICS], lines[:-1], notes=notes
        )


def evaluate_sensor(
    dataset: Any,
    model: DepthModel,
    sensor: str | Path,
    unit: str | None = None,
    use_masks: bool = True,
    progress: bool = True,
) -> SensorReport:
    """Fills the sensor's depth of every observation and compares it with the truth.

    Args:
        dataset: rows of `load_gift_i` with `depths`.
        model: what fills; with an adapter its base is compared too.
        sensor: folder `<group>/<image>.png` (16-bit, mm) or `.npy` (m), as `pair_files` pairs them.
        unit (*optional*): of its files, as in `read_depth`.
        use_masks (`bool`): the target is told to the fit; False lets it find out.

    Raises FileNotFoundError or ValueError: no depth in the dataset, a file that is missing or does not fit.
    """
    root, rows = Path(sensor), []
    dataset = parsed(dataset)
    kind, names = model.known_kind(), ["base", *(["adapted"] if model.adapted else [])]
    for index in tqdm(range(len(dataset)), desc="evaluate", unit="group", disable=None if progress else True):
        group = parse_group(dataset[index])
        if not group.depths:
            continue
        photos = [Path(name) for name in group.names]
        files = list_files(root / group.group_id, DEPTH_SUFFIXES, "sensor depth")
        pairs = pair_files(photos, files, f"sensor depth of group {group.group_id}", tolerance=0.02)
        for place, photo in enumerate(photos):
            row: dict[str, Any] = {"group_id": group.group_id, "image": group.names[place], "skipped": None}
            rows.append(row)
            if photo not in pairs:
                row["skipped"] = "no sensor depth"
                continue
            size = group.masks[place].shape
            depth = to_size(read_depth(pairs[photo], unit), size, str(pairs[photo]), "sensor depth")
            try:
                row |= _score(group, place, depth, model, names, kind, use_masks)
            except ValueError as error:  # one scene that cannot be aligned does not end the comparison
                row["skipped"] = str(error)
    scored = [row for row in rows if not row["skipped"]]
    if not scored:
        why = rows[0]["skipped"] if rows else "no group of the dataset has true depth"
        raise ValueError(f"nothing to compare in {root}: {why}")
    summary = {
        method: {region: {m: mean([row[method][region][m] for row in scored]) for m in METRICS} for region in REGIONS}
        for method in METHODS
        if method in scored[0]
    }
    coverage = {region: mean([row["coverage"][region] for row in scored]) for region in REGIONS}
    return SensorReport(summary, coverage, rows)


def _score(
    group: GroupPictures,
    place: int,
    depth: np.ndarray,
    model: DepthModel,
    names: Sequence[str],
    kind: str,
    use_masks: bool,
) -> dict[str, Any]:
    """The metrics of all methods for one observation, and the sensor's coverage in percent."""
    mask, truth = group.masks[place], np.asarray(group.depths[place], np.float64)
    valid = group.valids[place] if group.valids else np.ones_like(mask)
    there = valid & (truth > 0)
    regions = {"all": there, "tom": there & mask, "other": there & ~mask}
    seen = depth > 0
    maps = {"sensor": depth, "inpainted": paint_in(depth, mask), "plane": plane_of_ring(depth, mask)}
    for name in names:
        prediction = model.depth_at(group.images[place], base=name == "base" and model.adapted)
        maps[name] = fill_sensor_depth(prediction, depth, mask if use_masks else None, kind).depth
    scores: dict[str, Any] = {}
    for name, values in maps.items():
        own = {region: where & seen if name == "sensor" else where for region, where in regions.items()}
        scores[name] = {region: depth_metrics(1000.0 * values, truth, own[region]) for region in REGIONS}
    scores["coverage"] = {
        region: 100 * float(seen[where].mean()) if where.any() else float("nan") for region, where in regions.items()
    }
    return scores


# ---- fillings that take no model ----


def paint_in(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Depth (H,W), 0 in holes, with holes and target painted in from their border (OpenCV, Navier-Stokes)."""
    hole = (mask | (depth <= 0)).astype(np.uint8)
    return cv2.inpaint(depth.astype(np.float32), hole, 3, cv2.INPAINT_NS).astype(np.float64)


def plane_of_ring(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """`paint_in`, but the target is the plane, in inverse depth, that fits a ring about it best (least squares)."""
    width = max(2, round(max(depth.shape) * RING))
    ring = cv2.dilate(mask.astype(np.uint8), np.ones((2 * width + 1, 2 * width + 1), np.uint8)).astype(bool)
    ring &= ~mask & (depth > 0)
    filled = paint_in(depth, mask)
    if np.count_nonzero(ring) < 3:
        return filled
    grid = np.stack([*np.mgrid[: depth.shape[0], : depth.shape[1]], np.ones(depth.shape)], -1)
    plane = grid @ np.linalg.lstsq(grid[ring], 1 / depth[ring], rcond=None)[0]
    filled[mask] = 1 / np.maximum(plane[mask], 1 / (4 * depth.max()))
    return filled
