"""What the commands that fill a folder group by group share: where it may lie, one run at a time, many processes.

Such a command keeps a hidden folder in OUT: by it, it knows OUT as its own, and the lock of the run at work is in it.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import cv2
from filelock import FileLock, Timeout

from gift_peft.files import write_whole

CARD, CARD_NOTE = "README.md", "card"

Job = TypeVar("Job")
Result = TypeVar("Result")


def check_places(verb: str, source: Path, called: str, out: Path, state: str) -> None:
    """Raise ValueError or FileNotFoundError unless `source` is a folder apart from `out`, and that new, empty or ours.

    `called` is how messages call the source; `state` the name of the hidden folder.
    """
    if not source.is_dir():
        raise FileNotFoundError(f"{called} {source}: no such folder")
    there, here = source.resolve(), out.resolve()
    if here == there or here.is_relative_to(there) or there.is_relative_to(here):
        raise ValueError(f"OUT {out}: it must lie neither inside {called} nor around it; {called} is left as it is")
    if out.exists() and not out.is_dir():
        raise ValueError(f"OUT {out}: not a folder")
    if out.is_dir() and any(out.iterdir()) and not (out / state).is_dir():
        raise ValueError(f"OUT {out}: not empty, and not made by gift-peft {verb}; name a new folder")


@contextmanager
def alone(verb: str, out: Path, state: str) -> Iterator[None]:
    """One run at a time in OUT; the system lifts the lock of a run that was killed."""
    (out / state).mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(out / state / "lock", timeout=0):
            yield
    except Timeout:
        raise ValueError(f"OUT {out}: another gift-peft {verb} is at work there; wait for it") from None


def check_card(verb: str, out: Path, state: str) -> None:
    """Raise ValueError if OUT's card was edited by hand since the command wrote it."""
    card, note = out / CARD, out / state / CARD_NOTE
    if card.is_file() and note.is_file() and note.read_text(encoding="utf-8") != _digest(card):
        raise ValueError(
            f"{card}: changed since gift-peft {verb} wrote it, and it would be replaced; move it away, run again, and "
            "bring your changes to the new one"
        )


def note_card(out: Path, state: str) -> None:
    """Note what the card is as the command has written it (or that there is none)."""
    if (out / CARD).is_file():
        write_whole(out / state / CARD_NOTE, _digest(out / CARD))
    else:
        (out / state / CARD_NOTE).unlink(missing_ok=True)


def _digest(path: Path) -> str:
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def side_by_side(
    verb: str, work: Callable[[Job], Result], jobs: Sequence[Job], num_proc: int
) -> Iterator[tuple[Job, Result]]:
    """Every job with its result, as they finish."""
    if num_proc == 1 or len(jobs) < 2:
        threads = cv2.getNumThreads()
        try:
            for job in jobs:
                yield job, work(job)
        finally:
            cv2.setNumThreads(threads)
        return
    # Started anew, not forked: OpenCV's and torch's threads do not survive a fork.
    pool = ProcessPoolExecutor(min(num_proc, len(jobs)), mp_context=get_context("spawn"))
    try:
        futures = {pool.submit(work, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool:
        raise OSError(
            f"a process of gift-peft {verb} was killed, perhaps for memory, or could not start because the calling "
            'script has no `if __name__ == "__main__":`; finished groups are kept, run again with fewer (--num-proc)'
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)
