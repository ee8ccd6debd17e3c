"""What a run measures between epochs: the base's own loss, GCE and errors on validation groups, RMSE on Booster."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from accelerate import Accelerator
from tqdm import tqdm

from gift_peft.dataset.loader import PreparedGroups
from gift_peft.evaluation.evaluate import evaluate_booster, evaluate_gift_i
from gift_peft.evaluation.metrics import METRICS
from gift_peft.evaluation.results import REGIONS
from gift_peft.losses import GeometryConsistencyError
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


def measure_base(groups: PreparedGroups, lambda_c: float, quiet: bool) -> Iterator[tuple[float, float, float, int]]:
    """(loss, consistency, distillation, number of pairs) of the base on each group of an epoch.

    That needs no forward: the base's predictions are the proxies, its distillation is 0.
    """
    everything = groups.take(range(len(groups)))
    for group in tqdm(everything, "first look", len(groups), unit="group", delay=2, disable=quiet):
        error = GeometryConsistencyError()
        consistency = error.update(group.target, group.mask, group.valid)
        num_pairs = error.num_groups
        consistency = consistency if num_pairs else 0.0
        yield lambda_c * consistency, consistency, 0.0, num_pairs


def measure(
    model: DepthModel,
    groups: Sequence | None,
    booster_root: str | None,
    accelerator: Accelerator,
    is_due: bool,
    should_stop: Callable[[], Any],
) -> dict[str, float | None]:
    """The measured half of a row of metrics.jsonl; all None where no validation `is_due`.

    GCE, and the errors against the teacher on the treated reference, in float32, spread over the processes; RMSE in mm
    on Booster (protocol `gift`, a quarter of its size). Raises Interrupted once `should_stop()` is true.
    """
    keys = ["val_gce", *(f"val_{region}_{metric}" for region in REGIONS for metric in METRICS)]
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
    if is_due and booster_root is not None:
        report = evaluate_booster(booster_root, model, **options)
        row |= {f"booster_{region}_rmse": report.summary[region]["rmse"] for region in ("tom", "other")}
    return row
