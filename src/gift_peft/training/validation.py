"""What a run measures between epochs: the base's own loss, GCE and errors on validation groups, RMSE on Booster."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING

from tqdm import tqdm

from gift_peft.evaluation.evaluate import evaluate_booster, evaluate_gift_i
from gift_peft.evaluation.metrics import METRICS
from gift_peft.evaluation.results import REGIONS
from gift_peft.losses import GeometryConsistencyError
from gift_peft.models.loading import DepthModel
from gift_peft.training.start import Interrupted

if TYPE_CHECKING:
    from gift_peft.training.checkpoints import State
    from gift_peft.training.loop import Run


class UntilStopped(Sequence):
    """`groups`, but reading one raises Interrupted after a signal: a validation may take longer than a cluster waits.

    Args:
        groups (`Sequence`): read by index.
        stop (`SimpleNamespace`): what `stop_signals` gives.
    """

    def __init__(self, groups: Sequence, stop: SimpleNamespace) -> None:
        self.groups, self.stop = groups, stop

    def __len__(self) -> int:
        return len(self.groups)

    def __getitem__(self, index: int):
        if self.stop.signum:
            raise Interrupted
        return self.groups[index]


def measure_base(run: Run, state: State) -> None:
    """The base's own loss needs no forward: its predictions are the proxies, its distillation is 0."""
    groups = run.train_groups.take(range(run.epoch_steps))
    quiet = not run.accelerator.is_main_process
    for group in tqdm(groups, "first look", run.epoch_steps, unit="group", delay=2, disable=quiet):
        error = GeometryConsistencyError()
        consistency = error.update(group.target, group.mask, group.valid)
        num_pairs = error.num_groups
        consistency = consistency if num_pairs else 0.0
        state.add(run.args.lambda_c * consistency, consistency, 0.0, num_pairs)


def measure(run: Run, state: State, stop: SimpleNamespace) -> dict:
    """The measured half of a row of metrics.jsonl; None between the base's row and epoch `eval_delay` or the end."""
    keys = ["val_gce", *(f"val_{region}_{metric}" for region in REGIONS for metric in METRICS)]
    if run.args.booster_root is not None:
        keys += ["booster_tom_rmse", "booster_other_rmse"]
    row = dict.fromkeys(keys)
    if 0 < state.step < min(run.args.eval_delay * run.epoch_steps, run.total_steps):
        return row
    if run.validation_groups is not None:
        row |= _validate(run, stop)
    if run.args.booster_root is not None:
        row |= _measure_booster(run)
    return row


def _validate(run: Run, stop: SimpleNamespace) -> dict:
    """GCE and the errors against the teacher on the treated reference, in float32, spread over the processes."""
    # Several processes evaluate their shares apart, and would have to agree after every group.
    alone = run.accelerator.num_processes == 1
    report = evaluate_gift_i(
        UntilStopped(run.validation_groups, stop) if alone else run.validation_groups,
        _model(run),
        baseline=False,
        accelerator=run.accelerator,
        progress=False,
    )
    values = {f"val_{r}_{m}": report.summary[r][m] for r in REGIONS for m in METRICS}
    return {"val_gce": report.gce["adapted"], **values}


def _measure_booster(run: Run) -> dict:
    """RMSE in mm on Booster (protocol `gift`, a quarter of its size)."""
    report = evaluate_booster(
        run.args.booster_root,
        _model(run),
        baseline=False,
        accelerator=run.accelerator,
        progress=False,
    )
    return {f"booster_{region}_rmse": report.summary[region]["rmse"] for region in ("tom", "other")}


def _model(run: Run) -> DepthModel:
    return DepthModel(run.model, run.processor, run.size, run.kind)
