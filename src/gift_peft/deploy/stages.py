"""What a long command is doing: a bar whose steps have names and whose clock runs on."""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator

from tqdm import tqdm


@contextlib.contextmanager
def stages(count: int) -> Iterator[Callable[[str], None]]:
    """A progress bar whose steps have names; on a terminal its clock runs on within a step."""
    ended = threading.Event()
    with tqdm(total=count, bar_format="deploy: {n_fmt}/{total_fmt} {desc} [{elapsed}]", mininterval=0) as bar:

        def stage(name: str) -> None:
            bar.set_description_str(name, refresh=False)
            bar.update(1)
            bar.refresh()

        def tick() -> None:
            while not ended.wait(1):
                bar.refresh()

        clock = threading.Thread(target=tick, daemon=True)
        if sys.stderr.isatty():
            clock.start()
        try:
            yield stage
        finally:
            ended.set()
