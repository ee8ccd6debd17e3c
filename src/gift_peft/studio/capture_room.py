"""The Capture room without its page: a camera is watched, the coach takes the photos, the page shows both.

A thread reads the one source that the command line named and asks the session that the terminal asks as well
(`prepare/capture_session.py`). The page asks again and again what there is to see; when nobody has asked for a few
seconds, its tab was closed, and the camera stops.
"""

import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from gift_peft.captures.links import checked
from gift_peft.captures.tree import find_groups
from gift_peft.images import jpeg_uri
from gift_peft.prepare.capture_session import Session, Source, free_name
from gift_peft.rules import SPLITS

GONE = 8.0  # seconds without a question, after which a tab counts as closed
PATIENCE = 1.0  # seconds that a question waits for the next picture
CLOSING = 5.0  # seconds that closing a camera may take
SIDE, THUMBNAIL = 960, 320  # pixels: the longer side of what is shown
TEAL = (0, 200, 190)  # of the target's border
LINES = 8  # of what was said, that are shown
ASKED = "press R; Q ends without one"
TYPED = {"photo": "", "reference": "r"}  # buttons of the page, as they are typed in a terminal


class CaptureRoom:
    """One source, one capture at a time, for the tab that began it.

    Every method but `close` takes a request, a dict that a browser sent. Nothing in it becomes a path: a group's name
    is checked, a split and a photo are looked up.

    Args:
        root (`Path`): RAW; it may be absent.
        source (`Source`): where frames come from.
        mask (`str`, *optional*): file of the target's mask.
    """

    def __init__(self, root: Path, source: Source, mask: str | None = None) -> None:
        self.root, self.source, self.mask = root, source, mask
        self.session: Session | None = None
        self._news = threading.Condition()  # for what follows, which the page sees
        self._tab, self._asked = "", 0.0  # who captures, and when it asked last
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._shown: dict = {}
        self._pixels: np.ndarray | None = None
        self._number = self._version = 0  # of the picture; of the strip
        self._typed: deque[str] = deque()
        self._said: deque[str] = deque(maxlen=LINES)
        self._wrong: str | None = None
        self._ended: tuple[tuple, dict] | None = None  # what is said at the end, and of which state
        self._taking = threading.Lock()  # one asks the session at a time
        self._thumbnails: dict[Path, str] = {}

    def look(self, request: dict) -> dict:
        """What there is to see now, as soon as there is a newer picture than `seen`.

        `state` is "idle", "running", "stopped" or, in a tab that does not capture, "elsewhere"; `picture` is there
        while it runs; `version` changes with the photos.
        """
        tab, seen = _tab(request), request.get("seen")
        with self._news:
            running, mine = self._runs(), tab == self._tab
            if running and not mine:
                return {"state": "elsewhere", "next": self._elsewhere(), "version": self._version}
            if mine:
                self._asked = time.monotonic()
            if running:
                self._news.wait_for(lambda: self._number != seen or not self._runs(), PATIENCE)
                running = self._runs()
            pixels, number = self._pixels, self._number
            state = "running" if running else "stopped" if self.session is not None else "idle"
            answer = {"state": state, "number": number, "version": self._version, **self._shown}
            answer |= {"said": list(self._said), "wrong": self._wrong}
        if running and pixels is not None and number != seen:
            answer["picture"] = jpeg_uri(_small(pixels, SIDE, self.session.coach.mask_here), quality=80)
        return answer if running else answer | self._between()

    def start(self, request: dict) -> dict:
        """Begin a group of the name `group` ("" for the next free one), where RAW has splits in `split`."""
        tab, name = _tab(request), request.get("group")
        if not isinstance(name, str):
            raise ValueError("group: its name is a text")
        splits, split = self._splits(), request.get("split")
        if splits and split not in splits:
            raise ValueError(f"split: one of {', '.join(splits)}")
        out = checked(self.root / str(split), self.root) if splits else self.root
        with self._news:
            self._check_free(tab)
            session = Session(out, name.strip() or None, self.mask, asks=ASKED)
            self.session, self._version = session, self._version + 1
            self._thumbnails.clear()
            self._said.clear()
            self._begin(tab)
        return {}

    def resume(self, request: dict) -> dict:
        """Open the stream again and go on with the group."""
        tab = _tab(request)
        with self._news:
            self._check_free(tab)
            if self.session is None or not self._can_resume():
                raise ValueError("there is nothing to go on with: start a group")
            self.session.resume()
            self._begin(tab)
        return {}

    def press(self, request: dict) -> dict:
        """A button: `what` is "photo" or "reference" (of the next still moment) or "end"."""
        what = request.get("what")
        if what not in (*TYPED, "end"):
            raise ValueError(f"what: one of {', '.join(TYPED)}, end")
        with self._news:
            if not self._runs() or _tab(request) != self._tab:
                raise ValueError("this tab takes no photos now")
            if what == "end":
                self._stop.set()
                self._shown = self._shown | {"next": "The camera is being closed.", "well": True}
            else:
                self._typed.append(TYPED[what])
        return {}

    def drop(self, request: dict) -> dict:
        """Delete `photo` ("hall/001.png"), which was taken in this capture."""
        with self._taking:
            photo = self._photos().get(str(request.get("photo")))
            if photo is None or (self._runs() and _tab(request) != self._tab):
                raise ValueError(f"there is no photo {str(request.get('photo'))[:80]!r} to drop here")
            told, count = self.session.drop(photo), self._count()
            self._thumbnails.pop(photo, None)
        with self._news:
            self._said.append(told)
            self._version += 1
            self._shown["photos"] = count
        return {}

    def strip(self, _: Any = None) -> dict:
        """`photos` of this capture, each with `name` and `picture`."""
        with self._taking:
            photos = self._photos()
            for path in photos.values():
                if path in self._thumbnails or not path.is_file():
                    continue
                if (pixels := cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)) is not None:
                    self._thumbnails[path] = jpeg_uri(_small(pixels, THUMBNAIL), quality=80)
            shown = [{"name": name, "picture": self._thumbnails.get(path)} for name, path in photos.items()]
        return {"photos": shown}

    def close(self) -> list[str]:
        """Stop the camera, with the photo whole that is just written; what a terminal would say at the end."""
        self._stop.set()
        thread = self._thread
        if thread is not None:
            thread.join(CLOSING)
        return self._finished()[0] if self.session is not None else []

    # ---- the thread ----

    def _begin(self, tab: str) -> None:
        self._tab, self._asked, self._wrong, self._pixels = tab, time.monotonic(), None, None
        self._shown = self._show(self.session) | {"next": "The camera is being opened.", "well": True}
        self._typed.clear()
        self._stop = threading.Event()
        work = {"args": (self.session, self._stop), "daemon": True, "name": "capture"}
        self._thread = threading.Thread(target=self._take, **work)
        self._thread.start()

    def _take(self, session: Session, stop: threading.Event) -> None:
        frames, clip, start = self.source.frames(), self.source.clip is not None, time.monotonic()
        wrong: str | None = "it ended by an error of its own, which stands in the terminal"
        last = "no more pictures come" if not clip else "the clip ends"
        try:
            for frame in frames:
                if clip:  # as fast as it was taken, so that somebody can follow
                    while (ahead := start + frame.seconds - time.monotonic()) > 0 and not self._left(stop):
                        stop.wait(min(ahead, PATIENCE))
                if self._left(stop):
                    last = "stopped" if stop.is_set() else "the page was closed, and the camera is off"
                    break
                with self._taking:
                    said = session.see(frame, self._typed.popleft() if self._typed else None)
                    shown = self._show(session)
                with self._news:
                    self._pixels, self._number, self._shown = frame.pixels, self._number + 1, shown
                    self._version += session.advice.photo is not None
                    self._said.extend(said)
                    self._news.notify_all()
                if session.ended:
                    last = ""
                    break
            wrong = None
        except (ValueError, OSError) as error:
            wrong = " ".join(str(error).split())
        finally:
            frames.close()
            with self._news:
                self._wrong = wrong
                if last and wrong is None:
                    self._said.append(f"{session.seconds:7.1f} s  {last}")
                self._thread = None
                self._news.notify_all()

    def _left(self, stop: threading.Event) -> bool:
        """Whether somebody has ended it, or its tab was closed."""
        return stop.is_set() or time.monotonic() - self._asked > GONE

    def _show(self, session: Session) -> dict:
        return {
            "group": session.folder.name,
            "figures": session.figures,
            "of": "picture" if session.mask is None else "target",  # what has changed
            "next": session.next_step,
            "well": not session.advice.warnings,
            "enough": session.advice.enough,
            "photos": self._count(),
        }

    # ---- looked up ----

    def _runs(self) -> bool:
        return self._thread is not None

    def _check_free(self, tab: str) -> None:
        """Raise ValueError unless this tab may begin: nobody captures."""
        if self._runs():
            mine = "the camera is being closed: try again in a moment"
            raise ValueError(self._elsewhere() if tab != self._tab else mine if self._stop.is_set() else "it runs")

    def _elsewhere(self) -> str:
        group, photos = self._shown.get("group"), self._shown.get("photos")
        return f"Another tab of this studio takes photos of {group} ({photos} so far); end it there first."

    def _can_resume(self) -> bool:
        """Whether the stream may be opened again for this group: it is live, and has not ended with a reference."""
        return self.source.clip is None and not self.session.references

    def _between(self) -> dict:
        """What a tab shows while nothing runs: where photos would go, and what became of those that were taken."""
        splits = self._splits()
        free = {split: free_name(self.root / split) for split in splits} or {"": free_name(self.root)}
        answer: dict = {"source": self.source.name, "free": free}
        if self.session is None:
            return answer
        with self._taking:
            key = self._version, self.session.frames, self._wrong, self.session.undrawn
            if self._ended is None or self._ended[0] != key:  # looking through a large RAW takes its time
                told, wrong = self._finished()
                self._ended = key, {"told": told, "groups": self._groups(), "wrong": wrong}
            return answer | self._ended[1] | {"resumes": self._can_resume()}

    def _finished(self) -> tuple[list[str], str | None]:
        """What is said at the end, or what is wrong."""
        try:
            return self.session.finish(self.source.name), self._wrong
        except (ValueError, OSError) as error:
            return [], self._wrong or str(error)

    def _groups(self) -> list[str]:
        """The groups that were made, as the Masks room calls them."""
        made = {folder.resolve() for folder in self.session.photos}
        try:
            found = find_groups(self.root)
        except (ValueError, OSError):
            return []
        return [f"{split}/{path.name}" for split, paths in found.items() for path in paths if path.resolve() in made]

    def _splits(self) -> list[str]:
        return [split for split in SPLITS if (self.root / split).is_dir()]

    def _photos(self) -> dict[str, Path]:
        """Those of this capture by their names, the references last."""
        if self.session is None:
            return {}
        taken = [path for photos in self.session.photos.values() for path in photos] + self.session.references
        return {f"{path.parent.name}/{path.name}": path for path in taken}

    def _count(self) -> int:
        return sum(map(len, self.session.photos.values()))


def _tab(request: dict) -> str:
    tab = request.get("tab")
    if not isinstance(tab, str) or not 0 < len(tab) <= 64:
        raise ValueError("tab: who asks")
    return tab


def _small(pixels: np.ndarray, side: int, mask: np.ndarray | None = None) -> Image.Image:
    """A frame (H, W, 3) uint8 BGR, at most so large, with the border of a mask (H, W) bool."""
    height, width = pixels.shape[:2]
    scale = min(1.0, side / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = pixels[..., ::-1] if scale == 1 else cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)[..., ::-1]
    small = np.ascontiguousarray(small)
    if mask is not None and mask.shape == (height, width):
        there = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        cv2.drawContours(small, cv2.findContours(there, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)[0], -1, TEAL, 2)
    return Image.fromarray(small)
