"""The capture coach: looks at a stream of frames, says what would spoil the next photo, and when to take it.

`Coach.see` takes each frame and gives an `Advice`. A photo is due when the scene is still, nothing is wrong, and the
target shows what no photo of the group shows yet. Where the stream comes from and where photos go is the caller's
(`capture_verb.py`); nothing here needs a camera, a display or a person.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from gift_peft.prepare.clip_frames import MOVED, OTHER_CELLS, OTHER_SHARE
from gift_peft.prepare.entries import Remark
from gift_peft.prepare.still_moments import LAG, QUIET, Moment, Stillness
from gift_peft.prepare.stillness import (
    OTHER_CONTENT,
    Anchor,
    cells_inside,
    cells_of,
    change_above,
    difference,
    light_gain,
)

MIN_SHARPNESS = 0.75  # of the first photo's detail, where both show the same
MAX_CLIPPED, MORE_CLIPPED = 0.10, 0.02  # share of the pixels that is white, or black; and more than in the first photo
EXPOSURE_STEP = 1.25  # gain between two photos, above which the exposure is not locked
WAIT_BEFORE_HINT = 4.0  # seconds in which nothing new shows
WAIT_AFTER_MOVING = 2.0  # seconds for putting the camera back before a new group begins
ENOUGH_PHOTOS, ENOUGH_OLD = 3, 3  # photos at least, and moments in a row that showed nothing new
SPOILING = ("moved", "blurred", "over_exposed", "under_exposed")


@dataclass(frozen=True)
class Advice:
    """What is to be said about one frame.

    Args:
        still (`bool`): nothing moves.
        drift (`float`, *optional*): pixels by which the camera has moved since the group's first photo, on average
            over the picture; None while that is not known.
        sharpness (`float`, *optional*): detail over the first photo's, where both show the same; 1 is as sharp.
        bright, dark (`float`): share of the pixels that are nearly white, nearly black.
        changed (`float`): share of the target (of the picture, without a mask) that the photos show differently.
        warnings (`tuple[Remark, ...]`): what would spoil a photo, or is in vain.
        photo (`np.ndarray`, *optional*): (H, W, 3) uint8, the photo to keep now.
        is_reference (`bool`): the photo is the treated reference.
        new_group (`bool`): the camera stays where it was moved to; what follows belongs to the next group.
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


@dataclass
class _Photo:
    cells: np.ndarray
    detail: np.ndarray
    bright: float
    dark: float


@dataclass
class _Group:
    """The photos of one pose, and the moments without anything new since the last one."""

    photos: list[_Photo] = field(default_factory=list)
    anchor: Anchor | None = None
    old_moments: int = 0


class Coach:
    """Watches one stream.

    Args:
        mask (`np.ndarray`, *optional*): (H, W) bool, the target.
        most (`int`): photos of a group.
    """

    def __init__(self, mask: np.ndarray | None = None, most: int = 12) -> None:
        self.mask, self.most = mask, most
        self.inside, self.outside = (None, None) if mask is None else cells_inside(mask)
        self.matrix = np.eye(3)  # from the first pose to this group's
        self.watch = Stillness()
        self.group = _Group()
        self.wants_reference = False
        self._advice = Advice()
        self._judged: Moment | None = None
        self._measured = self._last_event = 0.0
        self._moved_since: float | None = None
        self._motion = np.eye(3)  # of the camera that was moved

    def ask_reference(self) -> None:
        """From now on the next still moment is the treated reference."""
        self.wants_reference, self._judged = True, None

    def see(self, index: int, seconds: float, pixels: np.ndarray) -> Advice:
        """Advice on the next frame, (H, W, 3) uint8 at this time. Raises ValueError if it is of another size."""
        if self.mask is not None and self.mask.shape != pixels.shape[:2]:
            raise ValueError(
                f"the mask is {self.mask.shape[1]}x{self.mask.shape[0]}, and the frames are {pixels.shape[1]}x"
                f"{pixels.shape[0]}"
            )
        self._advice = replace(self._advice, photo=None, is_reference=False, new_group=False)
        self.watch.see(index, seconds, pixels)
        moment = self.watch.moment if self.watch.still else None
        if moment is None:
            warnings = tuple(item for item in self._advice.warnings if item.code == "moved")
            self._advice = replace(self._advice, still=False, warnings=warnings)
        elif seconds - self._measured >= LAG / 2:
            self._measured = seconds
            self._measure(seconds, pixels)
            ready = moment.best is not None and seconds - moment.start >= QUIET
            if ready and moment is not self._judged and not self._spoiled:
                self._decide(seconds, moment)
        if self._moved_since is not None and seconds - self._moved_since > WAIT_AFTER_MOVING and moment is not None:
            self._begin_group()
        self._hint(seconds, moment)
        return self._advice

    @property
    def _spoiled(self) -> bool:
        return any(item.code in SPOILING for item in self._advice.warnings)

    def _measure(self, seconds: float, pixels: np.ndarray) -> None:
        """Everything about a still frame but whether it is new."""
        photo = _look(pixels)
        first = self.group.photos[0] if self.group.photos else None
        warnings = []
        drift, sharpness = None, None
        most_bright, most_dark = MAX_CLIPPED, MAX_CLIPPED
        if first is not None:
            motion = self.group.anchor.motion(pixels)
            drift = None if motion is None else motion.pixels
            limit = max(1.0, MOVED * float(np.hypot(*pixels.shape[:2])))
            if drift is not None and drift > limit:
                warnings.append(Remark("moved", f"the camera moved by {drift:.1f} px: put it back, or let it stand"))
                self._moved_since = seconds if self._moved_since is None else self._moved_since
                self._motion = motion.matrix
            elif drift is not None:
                self._moved_since = None
            gain = light_gain(photo.cells, first.cells, self.outside)
            sharpness = self._sharpness(photo, first, gain)
            if sharpness is not None and sharpness < MIN_SHARPNESS:
                text = f"out of focus: {sharpness:.0%} of the first photo's sharpness; lock the focus"
                warnings.append(Remark("blurred", text))
            if not 1 / EXPOSURE_STEP < gain < EXPOSURE_STEP:
                text = f"the exposure changed by a factor of {1 / gain:.2f} since the first photo: lock it"
                warnings.append(Remark("exposure_changed", text))
            most_bright = min(MAX_CLIPPED, first.bright + MORE_CLIPPED) if first.bright < MAX_CLIPPED else first.bright
            most_dark = max(MAX_CLIPPED, first.dark + MORE_CLIPPED)
        if photo.bright > most_bright:
            text = f"over-exposed: {photo.bright:.0%} of the picture is white; shorten the exposure"
            warnings.append(Remark("over_exposed", text))
        if photo.dark > most_dark:
            text = f"under-exposed: {photo.dark:.0%} of the picture is black; lengthen the exposure"
            warnings.append(Remark("under_exposed", text))
        kept = [item for item in self._advice.warnings if item.code == "unchanged"]
        self._advice = replace(
            self._advice,
            still=True,
            drift=drift,
            sharpness=sharpness,
            bright=photo.bright,
            dark=photo.dark,
            warnings=(*warnings, *kept),
        )

    def _sharpness(self, photo: _Photo, first: _Photo, gain: float) -> float | None:
        """Detail over the first photo's in cells that show the same and have detail; None if there are few."""
        same = difference(photo.cells, first.cells, self.outside) < 2 * self._content_threshold
        if self.outside is not None:
            same &= self.outside
        if same.sum() < 30:
            return None
        telling = same & (first.detail >= np.quantile(first.detail[same], 0.8))
        total = float(first.detail[telling].sum())
        return float(gain * photo.detail[telling].sum() / total) if total > 0 else None

    def _decide(self, seconds: float, moment: Moment) -> None:
        """Whether this moment is a photo; each is judged once."""
        self._judged = moment
        group, photo = self.group, _look(moment.pixels)
        is_new = all(self._differs(photo, other) for other in group.photos)
        if self.wants_reference:
            self.wants_reference = False
            self._advice = replace(self._advice, photo=moment.pixels, is_reference=True)
        elif is_new and len(group.photos) < self.most:
            if not group.photos:
                mask = self.mask
                if mask is not None and not np.array_equal(self.matrix, np.eye(3)):
                    mask = cv2.warpPerspective(mask.astype(np.uint8), self.matrix, mask.shape[::-1]) > 0
                group.anchor = Anchor(moment.pixels, mask)
            group.photos.append(photo)
            group.old_moments, self._last_event = 0, seconds
            warnings = tuple(item for item in self._advice.warnings if item.code != "unchanged")
            self._advice = replace(
                self._advice, photo=moment.pixels, changed=self._changed(), warnings=warnings, enough=self._enough
            )
        else:
            group.old_moments += 1
            self._warn_unchanged()

    def _begin_group(self) -> None:
        self.matrix = self._motion @ self.matrix
        self.group, self._judged, self._moved_since = _Group(), None, None
        self._advice = Advice(still=True, new_group=True)

    def _hint(self, seconds: float, moment: Moment | None) -> None:
        """Somebody waits for a photo, and nothing new shows."""
        waiting = self.group.photos and not self.wants_reference and moment is self._judged is not None
        if waiting and seconds - max(self._last_event, moment.start) > WAIT_BEFORE_HINT:
            self._warn_unchanged()

    def _warn_unchanged(self) -> None:
        count = len(self.group.photos)
        text = f"nothing new shows since the last of {count} photos: change what is reflected or seen through"
        others = tuple(item for item in self._advice.warnings if item.code != "unchanged")
        self._advice = replace(self._advice, warnings=(*others, Remark("unchanged", text)), enough=self._enough)

    @property
    def _enough(self) -> bool:
        photos = len(self.group.photos)
        return photos >= self.most or (photos >= ENOUGH_PHOTOS and self.group.old_moments >= ENOUGH_OLD)

    @property
    def _content_threshold(self) -> float:
        return change_above(self.watch.noise, OTHER_CONTENT)

    def _differs(self, photo: _Photo, other: _Photo) -> bool:
        changed = difference(photo.cells, other.cells, self.outside) > self._content_threshold
        target = changed if self.inside is None else changed[self.inside]
        return int(target.sum()) >= max(OTHER_CELLS, OTHER_SHARE * (0 if self.inside is None else target.size))

    def _changed(self) -> float:
        first, *others = self.group.photos
        changed = np.zeros(first.cells.shape[:2], bool)
        for photo in others:
            changed |= difference(photo.cells, first.cells, self.outside) > self._content_threshold
        return float(changed.mean() if self.inside is None else changed[self.inside].mean())


def _look(pixels: np.ndarray) -> _Photo:
    """What is remembered of a frame."""
    gray = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    smooth = cv2.GaussianBlur(gray, (5, 5), 1.0)  # else noise counts as detail
    detail = cv2.convertScaleAbs(cv2.Laplacian(smooth, cv2.CV_16S))
    bright, dark = (cv2.countNonZero(cv2.inRange(gray, *bounds)) / gray.size for bounds in ((252, 255), (0, 3)))
    return _Photo(cells_of(pixels), cells_of(np.dstack([detail] * 3))[..., 0], bright, dark)
