"""Which frames of a clip become photos of a group: still, sharp moments that differ most inside the target.

A clip is read twice, first to find the moments, then for their pixels, so that memory does not grow with its length.
Where the camera was moved between two moments a group ends and the next one begins. What stands in a still picture
outside the target while it does so in no other (somebody who waits there) is told by the target's mask, if there is
one; what moves is never still.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from gift_peft.captures.clip import Clip, ClipFrame, TimeInClip
from gift_peft.prepare.camera_motion import SURE, Anchor
from gift_peft.prepare.registration import warp
from gift_peft.prepare.still_moments import QUIET, Look, Moment, Stillness
from gift_peft.prepare.stillness import (
    OTHER_CONTENT,
    STRUCTURE_CHANGED,
    cells_inside,
    change_above,
    difference,
)

MOST_LOOKS = 48  # moments of one pose that are remembered; of the two most alike one goes
OTHER_SHARE, OTHER_CELLS = 0.02, 3  # of the target's cells that differ between two observations at least
FOREIGN_CELLS = 0.004  # share of the cells outside the target that may differ from the other moments'
WHITE = 230  # grey levels of a cell, part of which may be clipped
MOVED = 0.0008  # mean motion over the diagonal, above which the camera was moved; at least a pixel
LONE = 0.6  # seconds of stillness from which a pose with a single view is a group of its own, whatever moves in it
RESTS = 0.1  # of what counts as moved: a camera that moves less within a brief moment stands still in it
REFERENCE_NEAR = 1.0  # seconds from the time that is stated to the still moment that it means


@dataclass(frozen=True)
class Chosen:
    """A frame to keep: the clip's place in the list, its number there, and its time."""

    clip: int
    index: int
    seconds: float


@dataclass
class Pose:
    """The frames of one pose of the camera.

    Args:
        frames (`list[Chosen]`): in the order of time.
        matrix (`np.ndarray`, *optional*): (3, 3), pixels of the first pose to this one's; None where that cannot be
            told.
        reference (`Chosen`, *optional*): the treated reference.
    """

    frames: list[Chosen] = field(default_factory=list)
    matrix: np.ndarray | None = None
    reference: Chosen | None = None


@dataclass
class ClipChoice:
    """What was chosen of a group's clips: the groups, (width, height) of the frames, and what a person should know."""

    poses: list[Pose]
    size: tuple[int, int]
    notes: list[str] = field(default_factory=list)


def choose_frames(
    clips: Sequence[Path],
    mask: Callable[[tuple[int, int]], np.ndarray] | None = None,
    most: int = 12,
    reference: TimeInClip | None = None,
    tell: Callable[[int], object] = lambda frames: None,
) -> ClipChoice:
    """The frames of one or several clips of one scene, by the pose of the camera.

    Args:
        clips (`list[Path]`): in the order in which they were taken.
        mask (*optional*): gives the target's mask (H, W) bool of the first pose for a size (width, height).
        most (`int`): frames of a pose.
        reference (`TimeInClip`, *optional*): when the treated surface is shown.
        tell: is given the number of frames read since it was told last.

    Raises FileNotFoundError or ValueError naming the clip: unreadable, of another size than the first, without a
    still moment, or without one where the reference should be.
    """
    names = [path.name for path in clips]
    if reference is not None and (reference.clip not in (None, *names) or (reference.clip is None and len(clips) > 1)):
        raise ValueError(
            f"{clips[0].parent}: reference in group.yaml names {reference.clip or 'no clip'}; write the file's name "
            f'before the time, as "{names[0]} 00:42"'
        )
    scene, notes, total = None, [], 0.0
    for place, path in enumerate(clips):
        clip, watch, frames, seconds = Clip(path), Stillness(), 0, 0.0
        for frame in clip.frames():
            if scene is None:
                size = frame.pixels.shape[1], frame.pixels.shape[0]
                scene = _Scene(size, None if mask is None else mask(size), most)
            _check_size(path, frame, clips[0], scene.size)
            scene.take(place, watch.see(frame.index, frame.seconds, frame.pixels), watch.noise)
            frames, seconds = frames + 1, frame.seconds
            tell(1)
        scene.take(place, watch.finish(), watch.noise)
        if clip.is_cut_short(frames):
            notes.append(f"{path.name} is damaged: {frames} of {clip.frames_stated} frames could be read")
        if reference is not None and reference.clip in (None, path.name) and reference.seconds > seconds + 0.5:
            raise ValueError(
                f"{path}: it is {seconds:.1f} s long, and the reference is said to be at {reference.seconds:g} s"
            )
        total += seconds
    at = None if reference is None else (0 if reference.clip is None else names.index(reference.clip))
    poses = scene.finish(reference, at, clips)
    if not poses and scene.notes:
        raise ValueError(f"{', '.join(map(str, clips))}: no moment can be used; {'; '.join(scene.notes)}")
    if not poses:
        raise ValueError(
            f"{', '.join(map(str, clips))}: no still moment in {total:.1f} s; hold camera and scene still for a "
            "second after each change"
        )
    return ClipChoice(poses, scene.size, notes + scene.notes)


def read_frames(clips: Sequence[Path], frames: Sequence[Chosen]) -> Iterator[tuple[Chosen, np.ndarray]]:
    """The chosen frames, and their pixels (H, W, 3) uint8 BGR, clip by clip."""
    for place, path in enumerate(clips):
        wanted = {frame.index: frame for frame in frames if frame.clip == place}
        if wanted:
            for frame in Clip(path).frames(wanted):
                yield wanted.pop(frame.index), frame.pixels
        if wanted:
            raise ValueError(f"{path}: frame {min(wanted)} cannot be decoded a second time")


def _check_size(path: Path, frame: ClipFrame, first: Path, size: tuple[int, int]) -> None:
    height, width = frame.pixels.shape[:2]
    if (width, height) != size:
        raise ValueError(
            f"{path}: frames of {width}x{height}, and {first.name} begins with {size[0]}x{size[1]}; the clips of a "
            "group have one size, so put it into a group of its own"
        )


@dataclass(eq=False)
class _Found:
    """A moment as it is remembered: its frame, and how long it lasted."""

    clip: int
    look: Look
    start: float
    end: float
    rests: bool = True  # the camera stands, and does not pass slowly

    @property
    def chosen(self) -> Chosen:
        return Chosen(self.clip, self.look.index, self.look.seconds)

    @property
    def lasted(self) -> float:
        return self.end - self.start


class _Stand:
    """What is seen from one pose: its moments, where the target is in it, and what later moments are compared with.

    Args:
        matrix (`np.ndarray`, *optional*): (3, 3), pixels of the first pose to this one's; None where not known.
        mask (`np.ndarray`, *optional*): (H, W) bool, the target in the first pose.
        pixels (`np.ndarray`): (H, W, 3) uint8, the first moment's.
    """

    def __init__(self, matrix: np.ndarray | None, mask: np.ndarray | None, pixels: np.ndarray) -> None:
        self.matrix, self.moments = matrix, []
        unknown = mask
        if mask is not None and matrix is not None and (here := warp(mask, matrix)).any():
            # Where the first pose did not look the target may go on: a mirror is often cut by the picture's border.
            mask, unknown = here, here | ~warp(np.ones_like(mask), matrix)
        self.inside = None if mask is None else cells_inside(mask)[0]
        self.outside = None if unknown is None else cells_inside(unknown)[1]
        self.anchor: Anchor | None = Anchor(pixels, unknown)

    def is_another_view(self, found: _Found) -> bool:
        region = self.outside
        changed = difference(found.look.cells, self.moments[0].look.cells, region) > 2 * OTHER_CONTENT
        return float(changed[region].mean() if region is not None else changed.mean()) > STRUCTURE_CHANGED

    def remember(self, found: _Found) -> None:
        self.moments.append(found)
        if len(self.moments) > MOST_LOOKS:
            # Of the newest and the one most like it, that with less detail goes.
            *others, new = self.moments
            near = min(others, key=lambda found: float(self._changes(found, new).mean()))
            self.moments.remove(min(near, new, key=lambda found: found.look.detail))

    def choose(self, treated: _Found | None, most: int, threshold: float) -> tuple[list[_Found], list[str]]:
        """Those that differ most, each observation once, in the order of time; and what was left out.

        `threshold` is the grey levels above which a cell shows something else.
        """
        moments, notes = self._without_foreign([found for found in self.moments if found is not treated], threshold)
        if treated is not None:
            moments = [found for found in moments if self._differs(found, treated, self.inside, threshold)]
        if not moments:
            return [], notes
        target = self.inside if self.inside is not None else self._changing(moments, threshold)
        chosen = [max(moments, key=lambda found: found.look.detail)]
        left = [found for found in moments if found is not chosen[0]]
        nearest = {id(found): self._apart(found, chosen[0], target) for found in left}
        while left and len(chosen) < most:
            left = [found for found in left if self._differs(found, chosen[-1], target, threshold)]
            if not left:
                break
            farthest = max(left, key=lambda found: nearest[id(found)])
            chosen.append(farthest)
            left.remove(farthest)
            for found in left:
                nearest[id(found)] = min(nearest[id(found)], self._apart(found, farthest, target))
        return sorted(chosen, key=lambda found: (found.clip, found.look.index)), notes

    def _changes(self, found: _Found, other: _Found) -> np.ndarray:
        return difference(found.look.cells, other.look.cells, self.outside)

    def _apart(self, found: _Found, other: _Found, target: np.ndarray) -> float:
        return float(self._changes(found, other)[target].mean())

    def _differs(self, found: _Found, other: _Found, target: np.ndarray | None, threshold: float) -> bool:
        changes = self._changes(found, other)
        changed = (changes if target is None else changes[target]) > threshold
        return int(changed.sum()) >= max(OTHER_CELLS, OTHER_SHARE * (0 if target is None else target.sum()))

    def _changing(self, moments: list[_Found], threshold: float) -> np.ndarray:
        """(h, w) bool: the cells that change in the pose at all; all of them where none do."""
        usual = moments[len(moments) // 2]
        changed = np.zeros(usual.look.cells.shape[:2], bool)
        for found in moments:
            changed |= self._changes(found, usual) > threshold
        return changed if changed.any() else np.ones_like(changed)

    def _without_foreign(self, moments: list[_Found], threshold: float) -> tuple[list[_Found], list[str]]:
        """Without moments in which something stands outside the target that most others do not show."""
        if self.outside is None or self.outside.sum() < 30 or len(moments) < 3:
            return moments, []
        usual = np.median([found.look.cells for found in moments], axis=0).astype(np.float32)
        limit = max(OTHER_CELLS, FOREIGN_CELLS * self.outside.sum())
        kept, notes = [], []
        for found in moments:
            foreign = difference(found.look.cells, usual, self.outside) > 3 * threshold
            # What is nearly white in both says nothing: the light that drifts has clipped it in one of them.
            white = np.minimum(found.look.cells, usual).max(axis=2) > WHITE
            told = self.outside & (cv2.dilate(white.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
            if foreign[told].sum() <= limit:
                kept.append(found)
            else:
                notes.append(f"left out: at {found.look.seconds:.1f} s something stands outside the target")
        # If all differ there, it is what the target does to its surroundings, or their own change.
        return (moments, []) if 2 * len(kept) <= len(moments) else (kept, notes)


class _Scene:
    """Sorts the moments of a stream into poses."""

    def __init__(self, size: tuple[int, int], mask: np.ndarray | None, most: int) -> None:
        self.size, self.mask, self.most = size, mask, most
        self.notes: list[str] = []
        self.noise = 1.0
        self.moved = max(1.0, MOVED * float(np.hypot(*size)))
        self.stands: list[_Stand] = []

    def take(self, clip: int, moment: Moment | None, noise: float) -> None:
        if moment is None:
            return
        self.noise = noise
        found = _Found(clip, moment.best, moment.start, moment.end)
        if found.lasted < LONE:
            passed = Anchor(moment.first).motion(moment.last)
            seen = passed is not None and SURE * passed.error < self.moved
            found.rests = seen and passed.pixels <= max(RESTS * self.moved, SURE * passed.error)
        if not self.stands:
            self._stand(np.eye(3), moment.pixels)
        else:
            now = self.stands[-1]
            motion = now.anchor.motion(moment.pixels)
            if motion is not None and motion.pixels > max(self.moved, SURE * motion.error):
                self._stand(None if now.matrix is None else motion.matrix @ now.matrix, moment.pixels)
            elif motion is None and now.is_another_view(found):
                self._stand(None, moment.pixels)
        self.stands[-1].remember(found)

    def _stand(self, matrix: np.ndarray | None, pixels: np.ndarray) -> None:
        if self.stands:
            self.stands[-1].anchor = None  # it is compared with no more
        self.stands.append(_Stand(matrix, self.mask, pixels))

    def finish(self, reference: TimeInClip | None, at: int | None, clips: Sequence[Path]) -> list[Pose]:
        treated = None if reference is None else self._treated(reference, at, clips)
        poses = []
        for stand in self.stands:
            frames, notes = stand.choose(treated, self.most, change_above(self.noise, OTHER_CONTENT))
            self.notes += notes
            pose = Pose([found.chosen for found in frames], stand.matrix)
            if treated in stand.moments:
                owner = pose if frames or not poses else poses[-1]
                owner.reference = treated.chosen
            brief = len(frames) == 1 and sum(found.lasted for found in stand.moments) < LONE
            brief = brief and not any(found.rests for found in stand.moments)
            if brief and len(self.stands) > 1 and pose.reference is None:
                self.notes.append(
                    f"left out: a moment at {frames[0].look.seconds:.1f} s, alone in its pose of the camera"
                )
            elif pose.frames:
                poses.append(pose)
        if treated is not None and poses and not any(pose.reference for pose in poses):
            # The camera was touched after the surface was treated; registration finds by how much.
            poses[0].reference = treated.chosen
        if len(poses) > 1:
            at_times = ", ".join(f"{pose.frames[0].seconds:.1f}" for pose in poses[1:])
            self.notes.append(f"the camera was moved: further groups begin at {at_times} s")
        return poses

    def _treated(self, reference: TimeInClip, at: int, clips: Sequence[Path]) -> _Found:
        """The moment that the reference's time means."""
        moments = [found for stand in self.stands for found in stand.moments if found.clip == at]

        def distance(found: _Found) -> float:
            return max(found.start - reference.seconds, reference.seconds - found.end, 0.0)

        nearest = min(moments, key=distance, default=None)
        if nearest is None or distance(nearest) > REFERENCE_NEAR:
            raise ValueError(
                f"{clips[at]}: no still moment at {reference.seconds:g} s, where group.yaml says that the reference "
                f"is; it takes {QUIET:g} s without motion"
            )
        return nearest
