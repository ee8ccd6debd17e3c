"""Frames of a camera or a network stream as they come: always the newest, never those that wait in a queue.

A thread reads all the time, so that whoever looks at frames more slowly than they come does not fall behind.
"""

import threading
import time
from collections.abc import Generator
from typing import TYPE_CHECKING

import numpy as np

from gift_peft.captures.clip import ClipFrame, check_frame, open_quietly

if TYPE_CHECKING:
    import cv2

SILENCE = 3.0  # seconds without a picture, after which a camera or stream counts as gone
FIRST_PICTURE = 10.0  # seconds that it may take to the first one


def live_frames(device: int | str) -> Generator[ClipFrame, None, None]:
    """The newest frames of a camera (its number) or a stream (its address), with seconds since the first; ends where
    no more come.

    Raises ValueError: it cannot be opened, gives no picture at all, or none in 8-bit color.
    """
    called = f"camera {device}" if isinstance(device, int) else device
    reader = _Reader(_open(device, called))
    reader.start()
    count, start = 0, None
    try:
        while (found := reader.newest(FIRST_PICTURE if start is None else SILENCE)) is not None:
            at, pixels = found
            start = at if start is None else start
            check_frame(pixels, called)
            yield ClipFrame(count, at - start, pixels)
            count += 1
    finally:
        reader.stop()
    if not count:
        raise ValueError(f"{called}: opened, and gives no picture; close other programs that use it")


def _open(device: int | str, called: str) -> "cv2.VideoCapture":
    capture = open_quietly(device)
    if not capture.isOpened():
        hint = "plug it in, close other programs that use it, or name another number"
        if isinstance(device, str):
            hint = "check the address and the network"
        raise ValueError(f"{called}: cannot be opened; {hint}")
    return capture


class _Reader(threading.Thread):
    """Reads a device until it gives no more pictures, and keeps the newest."""

    def __init__(self, capture: "cv2.VideoCapture") -> None:
        super().__init__(daemon=True)
        self.capture = capture
        self.changed = threading.Condition()
        self.found: tuple[float, np.ndarray] | None = None
        self.ended = False

    def run(self) -> None:
        failed_since = None
        while not self.ended:
            there, pixels = self.capture.read()
            now = time.monotonic()
            if there:
                failed_since = None
                with self.changed:
                    self.found = now, pixels
                    self.changed.notify()
                continue
            failed_since = now if failed_since is None else failed_since
            if now - failed_since > SILENCE:
                break
            time.sleep(0.02)
        with self.changed:
            self.ended = True
            self.changed.notify()
        self.capture.release()

    def newest(self, patience: float) -> tuple[float, np.ndarray] | None:
        """When it was read, and its pixels, each once; None if there is none in so many seconds, or no more."""
        with self.changed:
            self.changed.wait_for(lambda: self.found is not None or self.ended, patience)
            found, self.found = self.found, None
        return found

    def stop(self) -> None:
        self.ended = True
        self.join(SILENCE)  # a driver that hangs in a read is left to the end of the process
