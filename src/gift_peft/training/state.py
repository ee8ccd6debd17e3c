"""Where a run stands: all that a checkpoint must know besides weights, optimizer and RNG (`trainer_state.json`)."""

import json
from dataclasses import dataclass, field
from pathlib import Path

from gift_peft.files import write_whole


@dataclass
class State:
    """Where a run stands; all of it is in `trainer_state.json`. The sums are over the groups of this epoch so far."""

    step: int = 0
    rows: list[dict] = field(default_factory=list)
    best_step: int | None = None
    loss: float = 0.0
    consistency: float = 0.0
    distillation: float = 0.0
    gce: float = 0.0
    num_groups: int = 0
    num_groups_with_pair: int = 0

    def add(self, loss: float, consistency: float, distillation: float, num_pairs: int) -> None:
        """Count one group."""
        self.loss += loss
        self.consistency += consistency
        self.distillation += distillation
        self.num_groups += 1
        if num_pairs:  # GCE leaves out groups without a pair, the loss counts them as 0
            self.gce += consistency
            self.num_groups_with_pair += 1

    def close_epoch(self, epoch_steps: int) -> dict:
        """The means since the last row, as the first half of a row; the sums start again."""
        epoch = self.step / epoch_steps
        row: dict = {"step": self.step, "epoch": int(epoch) if epoch.is_integer() else epoch}
        for name in ("loss", "consistency", "distillation"):
            row[name] = getattr(self, name) / self.num_groups if self.num_groups else None
            setattr(self, name, 0.0)
        row["train_gce"] = self.gce / self.num_groups_with_pair if self.num_groups_with_pair else None
        self.gce, self.num_groups, self.num_groups_with_pair = 0.0, 0, 0
        return row

    def row_of(self, step: int | None) -> dict | None:
        """The row of metrics.jsonl with this step."""
        return next((row for row in self.rows if row["step"] == step), None)


def write_metrics(output: Path, rows: list[dict]) -> None:
    """metrics.jsonl, whole: a resumed run drops the rows after its checkpoint."""
    write_whole(output / "metrics.jsonl", "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows))
