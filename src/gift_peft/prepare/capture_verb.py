"""`gift-peft capture`: a coach at the camera, which takes the photos of a group by itself. `coach.py` judges.

It works in a terminal, without a display: warnings and photos are lines, and on a terminal a status line stands below.
A clip in place of a camera is how it is tested, and a way to look at what a clip is good for.
"""

import itertools
import queue
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gift_peft.options import OptionParser, number

DESCRIPTION = """Take the photos of a group: says what would spoil them, and takes one when the scene is still and new.

SOURCE is a camera's number, the address of a stream (rtsp://, http://), or a clip. OUT gets a raw tree, which
`gift-peft prepare` reads. Typed while a camera runs: Enter takes a photo of the next still moment, whatever is said of
it; r and Enter the treated reference, last of all; q and Enter ends without one. Ctrl-C keeps what was taken.
Exit code: 0 if photos were taken, 1 if none was, if the moment of --reference-at
gave none, or if SOURCE cannot be read, 2 for a wrong command line."""


def make_parser() -> OptionParser:
    parser = OptionParser("capture", DESCRIPTION, "gift-peft capture 0 my-captures --group cabinet_door")
    parser.add_argument("source", metavar="SOURCE", help="camera's number, stream's address, or clip")
    parser.add_argument("out", metavar="OUT", help="raw tree, to which a group is added")
    parser.add_argument("--group", metavar="NAME", help="folder of the group; default: the next free group_N")
    parser.add_argument("--mask", metavar="FILE", help="picture of the target, if you have one: white where it is")
    text = "photos of a group at most"
    parser.add_argument("--max-frames", type=number(int, 1), default=12, metavar="N", help=text)
    text = "of a clip: when the treated surface is shown, as 00:42; that moment becomes the reference"
    parser.add_argument("--reference-at", metavar="TIME", help=text)
    return parser


def run(argv: Sequence[str]) -> int:
    """Take photos until the source or the person ends it; the exit code.

    Raises ValueError or an OSError (one line): the source cannot be opened, the group is there, or no photo was taken.
    """
    args = make_parser().parse_args(argv)
    from gift_peft.captures.clip import read_time
    from gift_peft.prepare.capture_session import TYPED, Session, open_source

    at = None if args.reference_at is None else read_time(args.reference_at, "--reference-at")
    if at is not None and at.clip is not None:
        raise ValueError(f"--reference-at {args.reference_at}: the time alone, as 00:42; SOURCE names the clip")
    source = open_source(args.source)
    live = source.clip is None
    if at is not None and live:
        raise ValueError("--reference-at is for clips; at a camera, type r and Enter when the surface is treated")
    asks = TYPED if live else None
    session = Session(Path(args.out), args.group, args.mask, args.max_frames, at and at.seconds, asks)
    typed = _typed() if live and sys.stdin.isatty() else itertools.repeat(None)
    status = _Status()
    frames = source.frames()
    status.show(f"opening {args.source}")
    try:
        for frame in frames:
            with _photo_whole():
                for line in session.see(frame, next(typed)):
                    status.say(line)
                status.show(session.status)
            if session.ended:
                break
        else:
            status.say(f"{session.seconds:7.1f} s  {'no more pictures come' if live else 'the clip ends'}")
    except KeyboardInterrupt:
        status.say(f"{session.seconds:7.1f} s  stopped")
    finally:
        frames.close()
        status.clear()
    for line in session.finish(args.source):
        print(line)
    return 0


@contextmanager
def _photo_whole() -> Iterator[None]:
    """Ctrl-C waits for the end of the block, so that a photo is whole or absent."""
    stopped = threading.Event()
    before = signal.signal(signal.SIGINT, lambda *_: stopped.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if stopped.is_set():
        raise KeyboardInterrupt


def _typed() -> Iterator[str | None]:
    """What was typed since it was asked last: a line, or None."""
    lines: queue.Queue[str] = queue.Queue()

    def listen() -> None:
        for line in sys.stdin:
            lines.put(line.strip())

    threading.Thread(target=listen, daemon=True).start()
    while True:
        try:
            yield lines.get_nowait()
        except queue.Empty:
            yield None


class _Status:
    """Lines on stdout; on a terminal, a line that is written over below them."""

    def __init__(self) -> None:
        self.terminal, self.shown = sys.stdout.isatty(), 0.0

    def say(self, line: str) -> None:
        self.clear()
        print(line, flush=True)

    def show(self, text: Any) -> None:
        if self.terminal and time.monotonic() - self.shown > 0.1:
            self.shown = time.monotonic()
            print(f"\r\x1b[K{text}", end="", flush=True)

    def clear(self) -> None:
        if self.terminal:
            print("\r\x1b[K", end="", flush=True)
