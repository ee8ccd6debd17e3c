"""Reports and rows made by hand, for what is drawn and written from them."""

import numpy as np
from PIL import Image

from gift_peft.evaluation.metrics import METRICS
from gift_peft.evaluation.protocols import PROTOCOLS
from gift_peft.evaluation.results import (
    REGIONS,
    Report,
    count_rows,
    detect_collapse,
    summarize,
    summarize_gce,
)
from gift_peft.reports.figures import Panel


def metrics(mae, abs_rel, rmse, delta1):
    return {"mae": mae, "abs_rel": abs_rel, "rmse": rmse, "delta1": delta1}


def make_report(**changes) -> Report:
    base = {
        "tom": metrics(0.2, 0.1, 0.4, 80.0),
        "other": metrics(0.1, 0.05, 0.2, 95.0),
        "all": metrics(0.12, 0.06, 0.25, 92.0),
    }
    adapted = {
        "tom": metrics(0.1, 0.11, 0.3, 90.0),
        "other": metrics(0.1, 0.06, 0.204, 94.05),
        "all": metrics(0.1, 0.05, 0.2, 93.0),
    }
    consensus = {**base, "tom": metrics(0.1, 0.05, 0.2, 91.0)}
    fields = {
        "summary": adapted,
        "base": base,
        "consensus": consensus,
        "gce": {
            "base": 0.5,
            "adapted": 0.1,
            "base_normalized": 0.05,
            "adapted_normalized": 0.06,
            "num_groups": 7,
            "num_skipped": 1,
        },
        "collapse": {"target_mean_ratio": 0.98, "spread_ratio": 0.9, "alarm": False},
        "by_surface": {"mirror": {"num_images": 5, "summary": adapted, "base": base, "consensus": consensus}},
        "counts": {
            "groups": 8,
            "images": 30,
            "scored": 28,
            "skipped": 2,
            "reasons": {"without a treated reference": 2},
            "without_tom": 1,
            "without_other": 0,
        },
        "protocol": PROTOCOLS["native"].to_dict() | {"description": PROTOCOLS["native"].describe()},
        "reference": "proxy",
        "adapted": True,
        "unit": "native units",
        "groups": [],
        "rows": [],
    }
    return Report(**fields | changes)


def random_rows(sizes: list[int], seed: int = 0) -> list[dict]:
    """Rows of groups of these sizes with random positive metrics for base and adapted; some regions are empty."""
    rng = np.random.default_rng(seed)
    rows = []
    for number, size in enumerate(sizes):
        for index in range(size):
            row = {"group_id": f"g{number:02d}", "image": f"{index}.png", "surface": None, "skipped": None}
            row["pixels"] = {region: int(rng.integers(10, 1000)) for region in REGIONS}
            for model in ("base", "adapted"):
                row[model] = {region: dict(zip(METRICS, rng.uniform(0.1, 2, 4), strict=True)) for region in REGIONS}
                row[model] |= {"target_mean": 1.0, "spread": 1.0}
            if index == 1:
                for model in ("base", "adapted"):
                    row[model]["other"] = dict.fromkeys(METRICS, float("nan"))
            rows.append(row)
    return rows


def report_of(rows: list[dict], booster: bool = False, **changes):
    """A report whose means are those of the rows."""
    protocol = PROTOCOLS["gift" if booster else "native"]
    groups = [
        {"group_id": name, "surface": None, "counted": True}
        | {f"gce_{m}{s}": 0.1 * k + (m == "base") for m in ("base", "adapted") for s in ("", "_normalized")}
        for k, name in enumerate(dict.fromkeys(row["group_id"] for row in rows))
    ]
    fields = {
        "summary": summarize(rows, "adapted"),
        "base": summarize(rows, "base"),
        "collapse": detect_collapse(rows),
        "counts": count_rows(rows, len(groups), "adapted"),
        "protocol": protocol.to_dict() | {"description": protocol.describe()},
        "adapted": True,
        "groups": groups,
        "rows": rows,
    }
    fields["gce"] = summarize_gce(groups, ["base", "adapted"])
    if booster:
        about = {"subset": "balanced", "occlusion": "all", "tom_classes": [2, 3], "official": False}
        return Report(**fields | {"dataset": "booster", "unit": "mm", "about": about} | changes)
    return Report(**fields | {"reference": "proxy", "unit": "native units"} | changes)


def panel(seed=0, kind="inverse_depth", size=(60, 75), **changes) -> Panel:
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: size[0], : size[1]]
    depth = 1000 + 20.0 * rows + 10 * columns
    target = np.zeros(size, bool)
    target[15:45, 20:50] = True
    wrong = np.where(target, depth * 1.6, depth)
    base, adapted = (1 / wrong, 1 / depth) if kind == "inverse_depth" else (wrong, depth)
    reference = depth.copy()
    reference[:10, :10] = 0
    fields = {
        "label": f"mirror {seed}",
        "image": Image.fromarray(rng.integers(0, 255, (*size, 3), dtype=np.uint8)),
        "reference": reference,
        "base": 7 * base + 2 * base.max(),
        "adapted": adapted,
        "target": target,
        "kind": kind,
    }
    return Panel(**fields | changes)
