"""Work that the processes of a run share, group by group. Where one fails all say why, and none is left waiting."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

from accelerate.utils import gather_object

Item = TypeVar("Item")


class Alone(NamedTuple):
    """The state of a process that does all of the work, whatever others do."""

    process_index: int = 0
    num_processes: int = 1


def own_share(count: int, state: Any) -> range:
    """Which of so many groups are this process's; `state` is an `Accelerator`, a `PartialState` or `Alone`."""
    return range(state.process_index, count, state.num_processes)


@contextmanager
def failing_together(state: Any) -> Iterator[None]:
    """Inside, each process works for itself; the first process's ValueError or OSError is raised in all of them."""
    problem = None
    try:
        yield
    except (ValueError, OSError) as error:
        problem = error
    problems = [problem] if state.num_processes == 1 else gather_object([problem])
    problem = next((problem for problem in problems if problem is not None), None)
    if problem is not None:
        raise problem


def in_order(found: list[tuple[int, Item]], state: Any) -> list[Item]:
    """What the processes have found, in the order of the numbers beside it, on all of them."""
    if state.num_processes > 1:
        found = sorted(gather_object(found), key=lambda pair: pair[0])
    return [item for _, item in found]
