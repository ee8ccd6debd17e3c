"""How long a run is, and what is due after so many updates: arithmetic on the arguments and the length of an epoch."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from gift_peft.training.arguments import GiftTrainingArguments
from gift_peft.training.checkpoints import State

Item = TypeVar("Item")


@dataclass
class Schedule:
    """What is due when.

    Args:
        args: of the run.
        epoch_steps (`int`): updates of an epoch, which the objective says.
    """

    args: GiftTrainingArguments
    epoch_steps: int

    @property
    def total_steps(self) -> int:
        return self.args.max_steps if self.args.max_steps > 0 else self.args.num_train_epochs * self.epoch_steps

    def learning_rate(self, step: int) -> float:
        """Of the update after `step`: from the step alone, so that a resumed run needs no state of a scheduler."""
        args, warm = self.args, self.args.warmup_steps
        if step < warm:
            return args.learning_rate * (step + 1) / (warm + 1)
        falling = args.lr_scheduler_type == "linear"
        return args.learning_rate * (1 - (step - warm) / (self.total_steps - warm)) if falling else args.learning_rate

    def row_is_due(self, state: State) -> bool:
        """At the start, after every epoch and at the end, unless it was written before an interruption."""
        at = state.step % self.epoch_steps == 0 or state.step == self.total_steps
        return at and (not state.rows or state.rows[-1]["step"] != state.step)

    def validation_is_due(self, step: int) -> bool:
        """With a row, but not between the base's and that of epoch `eval_delay` or the end."""
        return not 0 < step < min(self.args.eval_delay * self.epoch_steps, self.total_steps)

    def checkpoint_is_due(self, step: int) -> bool:
        every = self.args.checkpointing_steps or self.epoch_steps
        return step > 0 and (step % every == 0 or step in self.args.checkpoint_at_steps or step == self.total_steps)


def updates_after(step: int, epoch_steps: int, epoch_updates: Callable[[int], Sequence[Item]]) -> Iterator[Item]:
    """What all updates after `step` take, without end; `epoch_updates(epoch)` has that of each update of an epoch."""
    epoch, done = divmod(step, epoch_steps)
    while True:
        yield from epoch_updates(epoch)[done:]
        epoch, done = epoch + 1, 0
