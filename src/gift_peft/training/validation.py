"""What a run measures between epochs: GCE and errors on validation groups, RMSE on Booster."""

from collections.abc import Callable, Sequence
from typing import Any

from accelerate import Accelerator

from gift_peft.evaluation.evaluate import evaluate_booster, evaluate_gift_i
from gift_peft.evaluation.metrics import METRICS
from gift_peft.evaluation.results import REGIONS
from gift_peft.models.loading import DepthModel
from gift_peft.training.start import Interrupted


class UntilStopped(Sequence):
    """`groups`, but reading one raises Interrupted after a signal: a validation may take longer than a cluster waits.

    Args:
        groups (`Sequence`): read by index.
        should_stop: whether a signal has come.
    """

    def __init__(self, groups: Sequence, should_stop: Callable[[], Any]) -> None:
        self.groups, self.should_stop = groups, should_stop

    def __len__(self) -> int:
        return len(self.groups)

    def __getitem__(self, index: int):
        if self.should_stop():
            raise Interrupted
        return self.groups[index]


def measure(
    model: DepthModel,
    groups: Sequence | None,
    booster_root: str | None,
    accelerator: Accelerator,
    metric: str,
    is_due: bool,
    should_stop: Callable[[], Any],
) -> dict[str, float | None]:
    """The measured half of a row of metrics.jsonl; all None where no validation `is_due`.

    GCE, and the errors against the teacher on the treated reference, in float32, spread over the processes; RMSE in mm
    on Booster (protocol `gift`, a quarter of its size); normalized GCE if it is the `metric` that chooses an adapter.
    Raises Interrupted once `should_stop()` is true.
    """
    keys = ["val_gce", *(f"val_{region}_{metric}" for region in REGIONS for metric in METRICS)]
    if metric not in keys:
        keys.append(metric)
    if booster_root is not None:
        keys += ["booster_tom_rmse", "booster_other_rmse"]
    row = dict.fromkeys(keys)
    options = {"baseline": False, "accelerator": accelerator, "progress": False}
    if is_due and groups is not None:
        # Several processes evaluate their shares apart, and would have to agree after every group.
        alone = accelerator.num_processes == 1
        report = evaluate_gift_i(UntilStopped(groups, should_stop) if alone else groups, model, **options)
        row |= {f"val_{r}_{m}": report.summary[r][m] for r in REGIONS for m in METRICS}
        row["val_gce"] = report.gce["adapted"]
        if "val_normalized_gce" in row:
            row["val_normalized_gce"] = report.gce["adapted_normalized"]
    if is_due and booster_root is not None:
        report = evaluate_booster(booster_root, model, **options)
        row |= {f"booster_{region}_rmse": report.summary[region]["rmse"] for region in ("tom", "other")}
    return row
