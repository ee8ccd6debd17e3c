"""The still moments of a stream of frames: stretches in which nothing moves, and of each the sharpest frame.

Each frame is compared with one a little earlier. A hand that crosses, a cross-fade, a camera that is pushed: all that
moves ends the stretch, and frames near its ends do not count, since a movement begins and ends unseen. Only cells are
kept, and of a few recent frames; memory does not grow with the stream.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from gift_peft.prepare.stillness import MAX_CHANGE, cells_of, change_above, detail_of, difference, noise_of

LAG = 0.2  # seconds between the frames that are compared, and from a stretch's end to the frames that count
STEP = 0.03  # seconds; of a faster stream only some frames are looked at
QUIET = 0.4  # seconds that a still moment lasts at least
MOVED_CELLS = 0.0008  # share of the cells, and one, that may differ in a still frame: noise has its outliers
KEY_FRAME = 5.0  # times the median, which no part of the picture that changes can raise: still noise
TAIL, MAX_TAIL = 1.6, 3.5  # times what all but as many cells stay below in quiet frames; and grey levels at most
DRIFT = 2.0  # grey levels within one moment, from its first frame to the others; a slow fade exceeds it


@dataclass
class Look:
    """A frame as it is remembered: where it is, its cells, and its detail."""

    index: int
    seconds: float
    cells: np.ndarray
    detail: float = 0.0


@dataclass
class Moment:
    """A still stretch. `best` is its sharpest frame that counts; None while it is too short.

    Pixels are (H, W, 3) uint8, of the best frame, of the first and, once it has ended, of the last before its end
    may have begun; whoever takes the moment drops them soon.
    """

    start: float
    end: float
    best: Look | None = None
    pixels: np.ndarray | None = None
    first: np.ndarray | None = None
    last: np.ndarray | None = None


class Stillness:
    """Watches a stream: `see` takes the frames in order and says when a moment has ended.

    `still` says whether the last frame was, `noise` is what cells that show the same differ by, in grey
    levels (`noise_of`).
    """

    def __init__(self) -> None:
        self.noise = 1.0
        self.still = False
        self.moment: Moment | None = None
        self._recent: deque[Look] = deque()
        self._waiting: deque[tuple[Look, np.ndarray]] = deque()
        self._first: np.ndarray | None = None
        self._noises, self._tails = _LowQuantile(), _LowQuantile()

    def see(self, index: int, seconds: float, pixels: np.ndarray) -> Moment | None:
        """The moment that this frame, (H, W, 3) uint8, has ended, if it lasted long enough."""
        if self._recent and seconds - self._recent[-1].seconds < STEP:
            return None
        look = Look(index, seconds, cells_of(pixels))
        before = self._earlier(seconds)
        self._recent.append(look)
        if before is None:
            return None
        changes = difference(look.cells, before.cells)
        self._noises.add(noise_of(changes))
        self.noise = self._noises.value
        self._tails.add(float(np.partition(changes.ravel(), -self._may_differ(changes))[-self._may_differ(changes)]))
        self.still = self._shows_the_same(changes)
        ended = None
        if self.still and self.moment is not None and self._drifts(look.cells):
            ended, self.still = self._finish(), False
        if not self.still:
            return self._finish() or ended
        if self.moment is None:
            self.moment, self._first = Moment(before.seconds, seconds, first=pixels), look.cells
        self.moment.end = seconds
        look.detail = detail_of(pixels)
        self._waiting.append((look, pixels))
        while self._waiting and seconds - self._waiting[0][0].seconds >= LAG:
            self._count(*self._waiting.popleft())
        return ended

    def finish(self) -> Moment | None:
        """The moment in which the stream ends, or is cut: what follows belongs to another one."""
        return self._finish()

    @property
    def cells(self) -> np.ndarray:
        """Of the frame that was looked at last."""
        return self._recent[-1].cells

    @property
    def threshold(self) -> float:
        """Grey levels above which a cell has changed from one moment to the next."""
        return change_above(self.noise)

    def _earlier(self, seconds: float) -> Look | None:
        """The latest frame that is at least LAG older; those before it are forgotten."""
        while len(self._recent) > 1 and seconds - self._recent[1].seconds >= LAG:
            self._recent.popleft()
        old_enough = self._recent and seconds - self._recent[0].seconds >= LAG
        return self._recent[0] if old_enough else None

    def _drifts(self, cells: np.ndarray) -> bool:
        return not self._shows_the_same(difference(cells, self._first), DRIFT)

    def _shows_the_same(self, changes: np.ndarray, least: float = 0.0) -> bool:
        """Whether differences (h, w) are noise. At a codec's key frames all cells differ a little more."""
        pumping = min(KEY_FRAME * float(np.median(changes)), MAX_CHANGE)
        tail = min(TAIL * self._tails.value, MAX_TAIL)
        return bool((changes > max(self.threshold, pumping, tail, least)).sum() < self._may_differ(changes))

    @staticmethod
    def _may_differ(changes: np.ndarray) -> int:
        """One more than the cells that may differ in a still frame."""
        return min(2 + int(MOVED_CELLS * changes.size), changes.size)

    def _count(self, look: Look, pixels: np.ndarray) -> None:
        moment = self.moment
        if moment.best is None or look.detail > moment.best.detail:
            moment.best, moment.pixels = look, pixels

    def _finish(self) -> Moment | None:
        moment, self.moment, self._first = self.moment, None, None
        if moment is not None and self._waiting:
            moment.last = self._waiting[0][1]
        self._waiting.clear()
        long_enough = moment is not None and moment.best is not None and moment.end - moment.start >= QUIET
        return moment if long_enough else None


@dataclass
class _LowQuantile:
    """A fifth of the values so far are smaller; of as many as there may be, in a small histogram."""

    counts: np.ndarray = field(default_factory=lambda: np.zeros(200, int))

    def add(self, value: float) -> None:
        self.counts[min(int(value * 20), len(self.counts) - 1)] += 1

    @property
    def value(self) -> float:
        place = int(np.searchsorted(np.cumsum(self.counts), 0.2 * self.counts.sum()))
        return (place + 1) / 20
