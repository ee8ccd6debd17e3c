"""The capture coach: looks at a stream of frames, says what would spoil the next photo, and when to take it.

`Coach.see` takes each frame and gives an `Advice`. Still frames are averaged and compared with the group's first
photo: has the camera moved (`camera_motion.py`), is it in focus (`focus.py`), has the light changed, does the target
show what no photo shows yet. A photo is due when it does and nothing is wrong. Where frames come from and photos go is
the caller's (`capture_session.py`); nothing here needs a camera, a display or a person.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from gift_peft.prepare.camera_motion import SURE, Anchor, Motion
from gift_peft.prepare.clip_frames import MOVED, OTHER_CELLS
from gift_peft.prepare.entries import Remark
from gift_peft.prepare.focus import SIDE, Focus
from gift_peft.prepare.registration import warp
from gift_peft.prepare.still_moments import QUIET, Moment, Stillness
from gift_peft.prepare.stillness import (
    NOISES,
    OTHER_CONTENT,
    STRUCTURE_CHANGED,
    cells_inside,
    change_above,
    difference,
    light_gain,
    noise_of,
)

EVERY = 0.19  # seconds between two measurements of a still scene
FRAMES = 4  # that each of the two running means reaches back over
LEAST_PUSH = 1.5  # pixels
BLURRED, LESS_SHARP = 1.25, 0.96  # pixels of blur, of a picture of at most SIDE; and the fine contrast that is left
WHITE, BLACK = 250, 3  # grey levels
MAX_WHITE, MAX_BLACK = 0.10, 0.30  # share of the first photo's pixels
MORE_CLIPPED, IN_BRIGHTER = 0.03, 1.08  # share that has become white (black) since; and the light that it takes
LIGHT_STEP, LIGHT_DRIFT = 1.2, 0.05  # gain that is a step; and per second what is a drift, which does no harm
NEW_TARGET, NEW_PICTURE = 0.05, 0.003  # share of the target, or without a mask of the picture, that must be new
LEAST_OUTSIDE = 30  # cells, from which they are a control
TAIL_OF_MEDIAN, MAX_CONTROL = 5.0, 3.0  # 99 of 100 cells stay below so many medians; grey levels
BLINK = 0.35  # seconds of restlessness that are a codec's or a flicker's, and no change of the scene
SAME_AGAIN = 0.8  # seconds of stillness after something was changed, from which nothing new has come of it
NOTHING_COMES = 2.0  # seconds of stillness after a photo, or after the last change, without anything new
TOLD_LONG_ENOUGH = 2.0  # seconds, after which a camera stands where it was moved to, and a doubtful photo is taken
ENOUGH_PHOTOS, ENOUGH_OLD = 3, 3  # photos at least, and changes in a row that showed nothing new
SPOILING = ("moved", "blurred", "over_exposed", "under_exposed")  # no photo is taken
DOUBTFUL = ("exposure_changed", "bright", "dark")  # none before it was told for a while


@dataclass(frozen=True)
class Advice:
    """What is to be said about one frame.

    Args:
        still (`bool`): nothing moves.
        drift (`float`, *optional*): pixels by which the camera has moved since the group's first photo, on average
            over the picture; None while that is not known.
        sharpness (`float`, *optional*): fine contrast over the first photo's, where both show the same; 1 is as sharp.
        bright, dark (`float`): share of the pixels that are nearly white, nearly black.
        changed (`float`): share of the target (of the picture, without a mask) that the photos show differently.
        warnings (`tuple[Remark, ...]`): what would spoil a photo, or is in vain.
        photo (`np.ndarray`, *optional*): (H, W, 3) uint8, the photo to keep now.
        is_reference (`bool`): the photo is the treated reference.
        new_group (`bool`): the camera stays where it was moved to; this photo and what follows is the next group's.
        enough (`bool`): more photos add nothing.
    """

    still: bool = False
    drift: float | None = None
    sharpness: float | None = None
    bright: float = 0.0
    dark: float = 0.0
    changed: float = 0.0
    warnings: tuple[Remark, ...] = ()
    photo: np.ndarray | None = None
    is_reference: bool = False
    new_group: bool = False
    enough: bool = False

    @property
    def codes(self) -> frozenset[str]:
        return frozenset(item.code for item in self.warnings)


class _Means:
    """Two running means of a still scene, of every other frame each, so that they share no noise; and of its cells."""

    def __init__(self) -> None:
        self.count = 0

    def add(self, gray: np.ndarray, cells: np.ndarray) -> None:
        if not self.count:
            self.halves, self.cells = [gray.astype(np.float32), gray.astype(np.float32)], cells
        elif self.count == 1:
            self.halves[1] = gray.astype(np.float32)
        else:
            cv2.accumulateWeighted(gray, self.halves[self.count % 2], max(1 / (self.count // 2 + 1), 1 / FRAMES))
        self.cells = self.cells + (cells - self.cells) * max(1 / (self.count + 1), 0.5 / FRAMES)
        self.count += 1

    @property
    def gray(self) -> np.ndarray:
        return (self.halves[0] + self.halves[1]) / 2


@dataclass
class _Group:
    """The photos of one pose: the cells of each, and what later frames are compared with."""

    cells: list[np.ndarray] = field(default_factory=list)
    dropped: list[np.ndarray] = field(default_factory=list)  # of photos that a person did not want
    first: np.ndarray | None = None  # cells of the first photo, dropped or not: in its light the others are judged
    anchor: Anchor | None = None
    focus: Focus | None = None
    bright: float = 0.0
    dark: float = 0.0
    old_changes: int = 0  # changes of the scene without anything new since the last photo


class Coach:
    """Watches one stream.

    Args:
        mask (`np.ndarray`, *optional*): (H, W) bool, the target.
        most (`int`): photos of a group.
    """

    def __init__(self, mask: np.ndarray | None = None, most: int = 12) -> None:
        self.mask, self.most = mask, most
        self.matrix = np.eye(3)  # from the first pose to this group's
        self.inside, self.outside = (None, None) if mask is None else cells_inside(mask)
        self.watch = Stillness()
        self.group = _Group()
        self.wanted: str | None = None  # "reference" or "photo": what a person has asked for
        self._advice = Advice()
        self._wrong: list[Remark] = []
        self._nothing_new: Remark | None = None
        self._means = _Means()
        self._measured = self._last_still = self._still_since = self._last_news = 0.0
        self._stirred = False  # something was changed since the last photo
        self._since: dict[str, float] = {}  # when each of the present warnings was told first
        self._moved: Motion | None = None
        self._moved_since: float | None = None  # which lasts through what moves in between
        self._light, self._light_at = 1.0, 0.0

    def ask_reference(self) -> None:
        """The next still moment is the treated reference."""
        self.wanted = "reference"
        self.restart()

    def ask_photo(self) -> None:
        """The next still moment is a photo, whatever is said about it."""
        self.wanted = "photo"

    def drop(self, number: int, again: bool = False) -> None:
        """A photo of this group, by its number from 0, does not count; `again`: what it showed may come again.

        After the last one the group begins anew, from wherever the camera is then.
        """
        group = self.group
        cells = group.cells.pop(number)
        group.dropped += [] if again else [cells]
        group.old_changes = 0
        if not group.cells:
            self.group = _Group(dropped=group.dropped[-1:])
            self.wanted = None if self.wanted == "reference" else self.wanted
        self._advice = replace(self._advice, changed=self._changed() if group.cells else 0.0, enough=False)
        self.restart()

    @property
    def waits(self) -> bool:
        """Whether nothing has moved since the last photo."""
        return bool(self.group.cells) and not self._stirred

    def see(self, index: int, seconds: float, pixels: np.ndarray) -> Advice:
        """Advice on the next frame, (H, W, 3) uint8 BGR at this time. Raises ValueError if it is of another size."""
        if self.mask is not None and self.mask.shape != pixels.shape[:2]:
            raise ValueError(
                f"the mask is {self.mask.shape[1]}x{self.mask.shape[0]}, and the frames are {pixels.shape[1]}x"
                f"{pixels.shape[0]}"
            )
        self._advice = replace(self._advice, photo=None, is_reference=False, new_group=False, still=False)
        if self.watch.see(index, seconds, pixels) is not None or not self.watch.still:
            self._means = _Means()
        moment = self.watch.moment
        if not self.watch.still or moment is None:
            if seconds - self._last_still > BLINK:
                self._nothing_new = None
                self._say(seconds, [])
            return self._advice
        if seconds - self._last_still > BLINK:
            self._still_since, self._stirred = seconds, True
        self._last_still = seconds
        self._means.add(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), self.watch.cells)
        self._advice = replace(self._advice, still=True)
        if self._means.count >= 2 and seconds - self._measured >= EVERY:
            self._measured = seconds
            before = self._advice.codes & {*SPOILING}
            self._say(seconds, self._measure(seconds))
            if self._advice.codes & {*SPOILING} != before:
                self.restart()  # frames from before are not of what is judged now
            else:
                self._decide(seconds, moment)
        return self._advice

    # ---- what is wrong ----

    def _measure(self, seconds: float) -> list[Remark]:
        """Everything about a still scene but whether it is new."""
        gray, cells, group = self._means.gray, self._means.cells, self.group
        bright, dark = (float(share.mean()) for share in (gray >= WHITE, gray <= BLACK))
        self._advice = replace(self._advice, bright=bright, dark=dark)
        white, black = f"{bright:.0%} of the picture is white", f"{dark:.0%} of the picture is black"
        if group.anchor is None:
            found = []
            if bright > MAX_WHITE:
                found.append(Remark("bright", f"over-exposed: {white}; shorten the exposure"))
            if dark > MAX_BLACK:
                found.append(Remark("dark", f"under-exposed: {black}; lengthen the exposure"))
            return found
        gain = 1 / light_gain(cells, group.first, self.outside)
        if bright > group.bright + MORE_CLIPPED and gain > IN_BRIGHTER:
            return [Remark("over_exposed", f"over-exposed: {white}, and it was {group.bright:.0%}; lock the exposure")]
        if dark > group.dark + MORE_CLIPPED and gain < 1 / IN_BRIGHTER:
            return [Remark("under_exposed", f"under-exposed: {black}, and it was {group.dark:.0%}; lock the exposure")]
        found = self._judge_light(seconds, gain)
        motion = group.anchor.motion(np.clip(np.round(gray), 0, 255).astype(np.uint8))
        found += self._judge_motion(seconds, motion, cells)
        if not any(item.code == "moved" for item in found):
            found += self._judge_focus(gray, motion)
        return found

    def _judge_light(self, seconds: float, gain: float) -> list[Remark]:
        """A step of the exposure; once it was told for a while, it is what the light is."""
        step = gain / self._light
        drift = 1 + LIGHT_DRIFT * min(seconds - self._light_at, 4.0)
        accepted = self._told_for(seconds, "exposure_changed") > TOLD_LONG_ENOUGH
        if accepted or 1 / (LIGHT_STEP * drift) < step < LIGHT_STEP * drift:
            self._light, self._light_at = gain, seconds
            return []
        return [Remark("exposure_changed", f"the exposure changed by a factor of {step:.2f}; lock it")]

    def _judge_motion(self, seconds: float, motion: Motion | None, cells: np.ndarray) -> list[Remark]:
        self._moved, since, self._moved_since = None, self._moved_since, None
        self._advice = replace(self._advice, drift=None if motion is None else motion.pixels)
        if motion is None:
            if self.outside is not None and self.outside.sum() < LEAST_OUTSIDE:
                return []  # the target fills the picture: that it shows something else says nothing of the camera
            changed = difference(cells, self.group.first, self.outside) > 2 * OTHER_CONTENT
            share = float((changed if self.outside is None else changed[self.outside]).mean())
            if share <= STRUCTURE_CHANGED:
                return []
            self._moved_since = seconds if since is None else since
            return [Remark("moved", "the camera shows another view: put it back")]
        height, width = self._means.gray.shape
        if motion.pixels <= max(LEAST_PUSH, MOVED * float(np.hypot(width, height)), SURE * motion.error):
            return []
        self._moved, self._moved_since = motion, seconds if since is None else since
        return [Remark("moved", f"the camera moved by {motion.pixels:.1f} px; put it back, or let it stand")]

    def _judge_focus(self, gray: np.ndarray, motion: Motion | None) -> list[Remark]:
        seen = motion is not None and motion.pixels > SURE * motion.error
        blur = self.group.focus.blur(gray, motion.matrix if seen else None)
        self._advice = replace(self._advice, sharpness=None if blur is None else blur.sharpness)
        limit = BLURRED * max(1.0, max(gray.shape) / SIDE)
        if blur is None or blur.pixels < limit or blur.sharpness > LESS_SHARP:
            return []
        text = f"out of focus by {blur.pixels:.1f} px: {blur.sharpness:.0%} of the first photo's sharpness"
        return [Remark("blurred", f"{text}; lock the focus")]

    # ---- what is to be done ----

    def _decide(self, seconds: float, moment: Moment) -> None:
        """A photo, a new group, or a word that nothing new shows."""
        if "moved" in self._advice.codes:
            stays = self.wanted == "photo" or seconds - self._moved_since > TOLD_LONG_ENOUGH
            # A reference of another pose would stand in a group without photos.
            if stays and self.wanted != "reference" and self._can_carry_mask():
                self._begin_group()
            return
        ready = moment.best is not None and seconds - moment.start >= QUIET
        if self.wanted is None:
            spoiled = self._advice.codes & {*SPOILING}
            doubtful = any(
                self._told_for(seconds, code) < TOLD_LONG_ENOUGH for code in self._advice.codes & {*DOUBTFUL}
            )
            if spoiled or doubtful:
                self._last_news = seconds
                return
        elif self.wanted == "reference" and self._advice.codes & {"moved", "blurred"}:
            return
        known = (*self.group.cells, *self.group.dropped)
        is_new = all(self._differs(self._means.cells, photo) for photo in known)
        if self.wanted or (is_new and len(self.group.cells) < self.most):
            if ready:
                self._take(seconds, moment)
        elif not is_new and self._nothing_new is None:
            again = self._stirred and seconds - self._still_since >= SAME_AGAIN
            if again or seconds - max(self._last_news, self._still_since) >= NOTHING_COMES:
                self.group.old_changes += self._stirred
                self._stirred = False
                count = len(self.group.cells)
                last = {0: "the photo that was dropped", 1: "the photo"}.get(count, f"the last of {count} photos")
                text = f"nothing new shows since {last}: change what is reflected or seen through"
                self._nothing_new = Remark("unchanged", text)
                self._say(seconds, self._wrong)
                self._advice = replace(self._advice, enough=self._enough)

    def _take(self, seconds: float, moment: Moment) -> None:
        is_reference, self.wanted = self.wanted == "reference", None
        self._nothing_new = None
        self._say(seconds, self._wrong)
        self._last_news, self._stirred = seconds, False
        if not is_reference:
            group = self.group
            if group.anchor is None:
                mask, group.first = self.mask_here, self._means.cells
                group.anchor = Anchor(np.clip(np.round(self._means.gray), 0, 255).astype(np.uint8), mask)
                group.focus = Focus(*self._means.halves, mask)
                group.bright, group.dark = self._advice.bright, self._advice.dark
                self._light, self._light_at = 1.0, seconds
            group.cells.append(self._means.cells)
            group.old_changes = 0
        self._advice = replace(
            self._advice,
            photo=moment.pixels,
            is_reference=is_reference,
            changed=self._changed(),
            enough=self._enough,
        )

    def _begin_group(self) -> None:
        self.matrix = self.matrix if self._moved is None else self._moved.matrix @ self.matrix
        if self.mask is not None:
            self.inside, self.outside = cells_inside(self.mask_here)
        self.group = _Group()
        self._wrong, self._nothing_new, self._since, self._moved_since = [], None, {}, None
        self._advice = Advice(still=True, new_group=True)
        self.restart()

    def _can_carry_mask(self) -> bool:
        """Whether it is known where the target is after the camera's motion, and is in the picture."""
        if self.mask is None or self._moved is None:
            return self.mask is None
        return bool(warp(self.mask, self._moved.matrix @ self.matrix).any())

    @property
    def mask_here(self) -> np.ndarray | None:
        return (
            self.mask if self.mask is None or np.array_equal(self.matrix, np.eye(3)) else warp(self.mask, self.matrix)
        )

    def restart(self) -> None:
        """A new moment begins: frames seen so far are no photo of it."""
        self.watch.finish()
        self._means = _Means()

    def _say(self, seconds: float, wrong: list[Remark]) -> None:
        """From now on this is wrong; that nothing new shows is no matter while no photo could be taken."""
        self._wrong = wrong
        codes = {item.code for item in wrong}
        nothing_new = [self._nothing_new] if self._nothing_new is not None and not codes & {*SPOILING} else []
        self._since = {code: self._since.get(code, seconds) for code in codes}
        self._advice = replace(self._advice, warnings=(*wrong, *nothing_new))

    def _told_for(self, seconds: float, code: str) -> float:
        return seconds - self._since.get(code, seconds)

    @property
    def _enough(self) -> bool:
        photos = len(self.group.cells)
        return photos >= self.most or (photos >= ENOUGH_PHOTOS and self.group.old_changes >= ENOUGH_OLD)

    def _change(self, cells: np.ndarray, photo: np.ndarray) -> np.ndarray:
        """(h, w) bool: the cells that show something else than in a photo.

        What a codec makes of noise, and leaves of what stood there before, differs as well, but everywhere: outside
        the target, or without a mask in half of the picture at least, it tells how much is none.
        """
        apart = difference(cells, photo, self.outside)
        if self.outside is not None and self.outside.sum() >= LEAST_OUTSIDE:
            control = noise_of(apart[self.outside])
        else:
            control = TAIL_OF_MEDIAN * float(np.median(apart))
        return apart > max(change_above(self.watch.noise, OTHER_CONTENT), NOISES * min(control, MAX_CONTROL))

    def _differs(self, cells: np.ndarray, photo: np.ndarray) -> bool:
        change = self._change(cells, photo)
        if self.inside is None:
            return int(change.sum()) >= NEW_PICTURE * change.size
        return int(change[self.inside].sum()) >= max(OTHER_CELLS, NEW_TARGET * self.inside.sum())

    def _changed(self) -> float:
        first, *others = self.group.cells or [self._means.cells]
        changed = np.zeros(first.shape[:2], bool)
        for photo in others:
            changed |= self._change(photo, first)
        return float(changed.mean() if self.inside is None else changed[self.inside].mean())
