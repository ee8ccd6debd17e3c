"""Progress of work that goes group by group: groups, frames and the time left, from the first second on.

Each process at work notes a frame by one byte in a small file of its group; a thread adds them up for the bar, so that
one process and many are shown the same way.
"""

import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from tqdm import tqdm


class FrameBar:
    """A bar of frames, for `with`.

    Args:
        frames: {file of a group's notes: its number of frames}.
        title (`str`): in front of the bar.
    """

    def __init__(self, frames: Mapping[Path, int], title: str) -> None:
        self.frames, self.title = frames, title
        self.finished: set[Path] = set()
        self.ended = threading.Event()

    def __enter__(self) -> "FrameBar":
        every = 0.3 if sys.stderr.isatty() else 10.0  # seconds; a log file gets a line now and then
        self.bar = tqdm(
            total=sum(self.frames.values()), desc=self.title, unit="frame", dynamic_ncols=True, mininterval=every
        )
        self._show()
        self.thread = threading.Thread(target=self._watch, args=[every], daemon=True)
        self.thread.start()
        return self

    def __exit__(self, *error) -> None:
        self.ended.set()
        self.thread.join()
        self._show()
        self.bar.close()

    def group_done(self, notes: Path) -> None:
        """All frames of this group count, whether they were noted or the group ended before."""
        self.finished.add(notes)

    def _watch(self, every: float) -> None:
        while not self.ended.wait(every):
            self._show()

    def _show(self) -> None:
        self.bar.n = sum(
            count if notes in self.finished else min(_size(notes), count) for notes, count in self.frames.items()
        )
        self.bar.set_postfix_str(f"{len(self.finished)}/{len(self.frames)} groups")


def note_frame(notes: Path) -> None:
    """One more frame of a group is done. It never fails: progress is not worth a group."""
    with suppress(OSError), notes.open("ab") as file:
        file.write(b".")


def _size(notes: Path) -> int:
    try:
        return notes.stat().st_size
    except OSError:
        return 0
