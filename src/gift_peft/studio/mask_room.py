"""The Masks room without its page: which groups there are, what is seen of one, what a list of edits draws, saving.

Every method takes a request, a dict that a browser sent, and gives a dict. Nothing in a request is believed: a group
and a photo are looked up by name in what the folder holds, and never become a path.
"""

import base64
import io
import os
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Lock, RLock
from typing import Any

import cv2
import numpy as np
from PIL import Image

from gift_peft.captures.clip_group import find_clip_group
from gift_peft.captures.links import checked
from gift_peft.captures.tree import find_groups, read_capture
from gift_peft.colormap import colorize_error
from gift_peft.files import printable
from gift_peft.images import jpeg_uri
from gift_peft.studio.group_view import GroupView, look_at
from gift_peft.studio.mask_edits import check_edits, draw_edits
from gift_peft.studio.mask_files import Changed, MaskPlace, frame_place, group_place, photo_place, save_mask

KEPT = 2  # groups whose photos stay in memory
THUMBNAIL = 320  # pixels across
TEAL, LINE = (0, 200, 190, 110), (255, 255, 255, 255)  # of the mask's area and border
STILL = 0.1  # share of a mask that changes in the group, below which it is told
MOST_CHANGE = 4.0  # times the noise: where the heat map is brightest


class MaskRoom:
    """Masks for the groups of a raw tree.

    Args:
        root: RAW.
        temporary: a folder of ours.
        method (`str`, *optional*): "sam2:<model id>", to redraw the borders of what is clicked on.
    """

    def __init__(self, root: Path, temporary: Path, method: str | None = None) -> None:
        self.root, self.temporary, self.method = root, temporary, method
        self._views: OrderedDict[str, GroupView] = OrderedDict()
        self._looking = RLock()  # one group is looked at at a time; the others wait
        self._said: dict[str, str | Callable[[], str]] = {}
        self._drawing = Lock()

    def groups(self, _: Any = None) -> dict:
        """`groups`, each with `name` ("train/hall"), `state` and `done`."""
        try:
            found = self._folders().items()
        except FileNotFoundError:
            raise ValueError(f"{self.root} has no groups yet: take photos (Capture), or put them there") from None
        return {"groups": [self._state(f"{split}/{group}", split, folder) for (split, group), folder in found]}

    def progress(self, request: dict) -> dict:
        """What is being done to open a group, in words."""
        said = self._said.get(str(request.get("group")), "")
        return {"said": said if isinstance(said, str) else said()}

    def open(self, request: dict) -> dict:
        """A group anew: its photos as thumbnails with what is said of them, the heat map, the masks and versions."""
        name, split, folder = self._folder(request)
        with self._looking:
            view = self._look(name, split, folder)
        mask, state = self._saved(name, view, None)
        heat = colorize_error(view.whole.change, MOST_CHANGE * view.whole.noise)
        return {
            "name": name,
            "size": list(view.whole.change.shape[::-1]),
            "verdict": view.verdict if state["there"] else ["no mask for all photos yet", *view.verdict],
            "photos": [self._card(name, view, index) for index in range(len(view.names))],
            "compares": bool(view.whole.change.any()),
            "heat": jpeg_uri(Image.fromarray(heat), quality=80),
            "overlay": overlay_uri(mask, view),
            **state,
        }

    def _card(self, name: str, view: GroupView, index: int) -> dict:
        """A photo in the strip: in place with the others, with its own mask if it has one."""
        thumbnail = Image.fromarray(view.pictures[index])
        thumbnail.thumbnail((THUMBNAIL, THUMBNAIL))
        card = {"name": view.names[index], **view.told[index], "picture": jpeg_uri(thumbnail, quality=80)}
        if self._place(name, view, index).source is None:
            return card | {"own": False}
        mask, state = self._saved(name, view, index)
        if not state["there"]:  # an export that lists the photo, and nobody has said what is in it
            return card | {"own": False}
        return card | {"own": True, "overlay": overlay_uri(view.placed(mask, index), view)}

    def photo(self, request: dict) -> dict:
        """A photo at working size: `picture` in place with the others, or as its own camera sees it (`own`)."""
        _, view, index = self._view(request)
        if index is None:
            raise ValueError("photo: its name is missing")
        own = request.get("own") is True
        pixels = view.view(index).picture if own else view.pictures[index]
        return {"picture": jpeg_uri(Image.fromarray(pixels), quality=90)}

    def start(self, request: dict) -> dict:
        """The saved mask of a group, or of a photo of it, with its version: where edits begin."""
        name, view, index = self._view(request)
        mask, state = self._saved(name, view, index)
        return {"overlay": overlay_uri(mask, view), "area": float(mask.mean()), **state}

    def draw(self, request: dict) -> dict:
        """What the saved mask becomes by `edits`: `overlay`, `area`, its share of the photo, and `still`: whether
        hardly anything changes in it, so that it may be no mirror or glass."""
        name, view, index = self._view(request)
        mask = self._drawn(name, view, index, check_edits(request.get("edits")))
        judged = view.view(index)
        inside = cv2.resize(mask.astype(np.uint8), judged.change.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        changes = float((judged.change[inside] > judged.noise).mean()) if inside.any() else 1.0
        still = bool(judged.change.any()) and changes < STILL
        return {"overlay": overlay_uri(mask, view), "area": float(mask.mean()), "still": still}

    def save(self, request: dict) -> dict:
        """Keep what `edits` make of the mask of `version`: of the group, or of `photo`.

        `conflict` is true where the mask was changed since; `version` is then the new one, and nothing was saved.
        """
        name, view, index = self._view(request)
        mask = self._drawn(name, view, index, check_edits(request.get("edits")))
        if index is None and not mask.any():
            raise ValueError("nothing is drawn yet; the mask of a group has a target")

        def find() -> MaskPlace:
            return self._place(name, view, index)

        try:
            place = save_mask(find, mask, str(request.get("version")), self.root)
        except Changed as error:
            return {"conflict": True, "error": str(error), "version": find().version}
        told = place.path.relative_to(self.root).as_posix()
        own = sum(self._saved(name, view, one)[1]["there"] for one in range(len(view.names)))
        if index is None and own:
            told += f" ({own} photo{'s have' if own > 1 else ' has'} a mask of their own, which comes first)"
        if not mask.any():
            told += ", which is empty: no target shows there (prepare takes that with --empty-masks allow)"
        return {"saved": told, "version": place.version}

    def _look(self, name: str, split: str, folder: Path) -> GroupView:
        try:
            say = partial(self._said.__setitem__, name)
            view = self._views[name] = look_at(folder, split, self.root, self.temporary, self.method, say)
        finally:
            self._said.pop(name, None)
        self._views.move_to_end(name)
        while len(self._views) > KEPT:
            self._views.popitem(last=False)
        return view

    # ---- looked up, never taken from a request ----

    def _folders(self) -> dict[tuple[str, str], Path]:
        return {(split, folder.name): folder for split, found in find_groups(self.root).items() for folder in found}

    def _folder(self, request: dict) -> tuple[str, str, Path]:
        """The group's name, split and folder; ValueError if there is no such group, or it is a link out of RAW."""
        name = request.get("group")
        folders = {printable(f"{split}/{folder}"): (split, path) for (split, folder), path in self._folders().items()}
        if not isinstance(name, str) or name not in folders:
            raise ValueError(f"there is no group {str(name)[:80]!r}")
        split, path = folders[name]
        return name, split, checked(path, self.root)

    def _view(self, request: dict) -> tuple[str, GroupView, int | None]:
        name, split, folder = self._folder(request)
        view = self._views.get(name)
        if view is None:  # opened before many others
            with self._looking:
                view = self._look(name, split, folder)
        photo = request.get("photo")
        if photo is not None and photo not in view.names:
            raise ValueError(f"group {name}: there is no photo {str(photo)[:80]!r}")
        return name, view, None if photo is None else view.names.index(photo)

    # ---- masks ----

    def _place(self, name: str, view: GroupView, index: int | None) -> MaskPlace:
        if index is None:
            return group_place(view.folder, name.split("/", 1)[0], self.root, view.from_clip)
        photo = view.capture.images[index]
        if view.from_clip:
            return frame_place(photo, view.folder, self.root)
        return photo_place(photo, view.folder, self.root, view.capture.facts.get("mask_class"))

    def _saved(self, name: str, view: GroupView, index: int | None) -> tuple[np.ndarray, dict]:
        """The mask (H, W) to begin with, and `there`, `place`, `version`, `problem`. A photo without its own begins
        with the group's, carried to where its camera sees it."""
        place, mask, problem = self._place(name, view, index), None, None
        try:
            mask = place.read(view.size)
        except (ValueError, OSError) as error:
            problem = str(error)
        there = mask is not None or problem is not None
        state = {"there": there, "place": os.path.abspath(place.path), "version": place.version, "problem": problem}
        if mask is None and index is not None:
            mask = view.carried(self._saved(name, view, None)[0], index)
        return np.zeros(view.size[::-1], bool) if mask is None else mask, state

    def _drawn(self, name: str, view: GroupView, index: int | None, edits: list[dict]) -> np.ndarray:
        with self._drawing:
            return draw_edits(self._saved(name, view, index)[0], edits, view.view(index))

    def _state(self, name: str, split: str, folder: Path) -> dict:
        """How far the masks of a group are, from its files alone."""
        try:
            clip = find_clip_group(checked(folder, self.root), self.root)
            if clip is not None:
                drawn = clip.mask is not None
                return {"name": name, "state": f"a clip, {'mask.png' if drawn else 'no mask yet'}", "done": drawn}
            capture = read_capture(folder, split, self.root)
        except (ValueError, OSError) as error:
            return {"name": name, "state": " ".join(str(error).replace(f"{self.root}/", "").split()), "done": False}
        own = sum(mask is not None and mask.annotated for mask in capture.masks)
        count = len(capture.images)
        if capture.common is not None:
            more = f", {own} of their own" if own else ""
            return {"name": name, "state": f"{count} photos, {capture.common.path.name}{more}", "done": True}
        state = "no mask yet" if not own else f"masks of {own}"
        return {"name": name, "state": f"{count} photos, {state}", "done": own in (1, count) and own > 0}


def overlay_uri(mask: np.ndarray, view: GroupView) -> str:
    """The mask as a transparent PNG at working size: its area in teal, its border in white."""
    height, width = view.whole.change.shape
    small = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.5
    pixels = np.zeros((height, width, 4), np.uint8)
    pixels[small] = TEAL
    border = small & (cv2.erode(small.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) == 0)
    pixels[border] = LINE
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=3)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
