"""What a run says: on a terminal a bar (loss, GCE, groups/s, time left), always a line per epoch, and how it ended."""

import math
import shlex
import sys
import time
from pathlib import Path

from tqdm import tqdm

from gift_peft.evaluation.table_formats import number
from gift_peft.evaluation.tables import relative_change


class Progress:
    """Lines go to stdout, the bar to stderr where that is a terminal. Only the main process speaks.

    Args:
        total, done: updates of the whole run, and those made before it was interrupted.
        enabled: False on all processes but one.
        unit: what an update takes.
        term: what the consistency of this objective is called.
    """

    def __init__(self, total: int, done: int, enabled: bool, unit: str = "group", term: str = "GCE") -> None:
        self.enabled, self.unit, self.term = enabled, unit, term
        self.total, self.first, self.done = total, done, done
        self.started = time.monotonic()
        self.bar = tqdm(
            total=total,
            initial=done,
            unit=unit,
            desc="GIFT",
            dynamic_ncols=True,
            disable=not enabled or not sys.stderr.isatty(),
        )

    def step(self, loss: float, consistency: float) -> None:
        """One update has been made."""
        self.done += 1
        self.bar.set_postfix({"loss": number(loss), self.term: number(consistency)}, refresh=False)
        self.bar.update()

    def row(self, row: dict, epochs: float) -> None:
        """The line of one row of metrics.jsonl."""
        parts = [f"epoch {_epochs(row['epoch'])}/{_epochs(epochs)}  step {row['step']}  loss {number(row['loss'])}"]
        parts.append(f"{self.term} {number(row['train_gce' if self.term == 'GCE' else 'consistency'])}")
        if row["val_gce"] is not None:
            parts.append(f"validation GCE {number(row['val_gce'])}")
        if row["val_tom_rmse"] is not None:
            parts.append(f"ToM RMSE {number(row['val_tom_rmse'])}  Other RMSE {number(row['val_other_rmse'])}")
        if self.done > self.first:
            rate = (self.done - self.first) / (time.monotonic() - self.started)
            left = round((self.total - self.done) / rate)
            speed = f"{rate:.2f} {self.unit}s/s" if rate >= 0.1 else f"{1 / rate:.0f} s per {self.unit}"
            parts.append(f"{speed}  {left // 3600:d}:{left // 60 % 60:02d}:{left % 60:02d} left")
        self.say("  ".join(parts))

    def say(self, text: str) -> None:
        """A line above the bar."""
        if self.enabled:
            self.bar.write(text, file=sys.stdout)
            sys.stdout.flush()

    def close(self) -> None:
        self.bar.close()


def summary(adapter: Path, rows: list[dict], best_step: int | None, validated: bool, metric: str) -> str:
    """The last lines of a run: which adapter is kept, where the smallest `metric` chose it, and what it changed."""
    row = next(row for row in reversed(rows) if best_step in (None, row["step"]))
    lines = [f"Adapter: {adapter} (step {row['step']})"]
    if validated and best_step is None:
        why = "No validation group has a photo of the treated surface (reference.*)"
        if metric != "tom_rmse":
            why = "No validation group has two photos whose target masks overlap, which GCE compares"
        lines.append(f"  {why}; so adapter/ is simply the last one, not the best of several")
    for title, key in (("validation GCE", "val_gce"), ("ToM RMSE", "val_tom_rmse"), ("Other RMSE", "val_other_rmse")):
        before, after = rows[0][key], row[key]
        if after is not None:
            change = relative_change(before, after)
            shown = f" ({change:+.1f} %)" if math.isfinite(change) else ""
            lines.append(f"  {title:15}{number(before)} -> {number(after)}{shown}")
    if len(lines) > 1 and rows[0]["val_gce"] is not None:
        lines.append(
            "  in the model's own units; RMSE on the validation groups, against its prediction of the treated surface"
        )
    return "\n".join(lines)


def _epochs(count: float) -> str:
    """Epochs with at most two decimals: 3, 0.67."""
    return f"{count:.2f}".rstrip("0").rstrip(".")


def how_to_resume(output: Path, step: int, command: str | None = None) -> str:
    """The last lines of a run that a signal has stopped; `command` goes on with it."""
    config = shlex.quote(str(output / "config.yaml"))
    command = command or f"gift-peft train --config {config} --resume_from_checkpoint latest"
    return f"Stopped after step {step}; {output}/checkpoint-{step} is complete. Go on with\n  {command}"
