"""A group as the Masks room shows it: its photos where one camera sees them, what `prepare` says of each, and what
changes.

`prepare` itself is asked, in a temporary folder: what is shown is what a run would decide. A clip's frames are chosen
as a run chooses them.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from gift_peft.captures.links import checked
from gift_peft.captures.tree import Capture
from gift_peft.images import read_image
from gift_peft.prepare.clip_groups import is_clip_job, replace_clips
from gift_peft.prepare.group import prepare_group
from gift_peft.prepare.job import Job
from gift_peft.prepare.proposals import change_map
from gift_peft.prepare.registration import warp
from gift_peft.prepare.settings import PrepareSettings
from gift_peft.studio.mask_edits import View

SIDE = 960  # pixels: the longer side of what is shown and judged; what is drawn is kept at the photo's own size
CHANGE_SIDE = 640  # of the comparison, which takes its time; the picture shows where borders are exactly
LEAST_SIDE = 400  # small photos are enlarged to about that: a border is found between their pixels
Said = Callable[[], str]  # what is being done, in words, when it is asked
SETTINGS = PrepareSettings(propose_masks=True)  # nothing is accepted: a group without masks is looked at all the same


@dataclass
class GroupView:
    """A group that was looked at.

    Args:
        folder (`Path`): the group's in RAW, where its masks belong.
        capture (`Capture`): its files; of a clip, of the frames chosen from it, which lie in a temporary folder.
        from_clip (`bool`).
        verdict (`list[str]`): what `prepare` says of the group as a whole.
        told (`list[dict]`): of each photo `status` and `texts`.
        matrices (`list[np.ndarray]`): (3, 3), from each photo's pixels to those of the last one that `prepare` keeps;
            unit matrices where a photo is not moved.
        size (`tuple[int, int]`): (width, height) of the photos.
        pictures (`list[np.ndarray]`): (h, w, 3) uint8, moved into place, at working size.
        whole (`View`): of the group.
        own (`dict[int, View]`): of single photos, as their own cameras see them.
    """

    folder: Path
    capture: Capture
    from_clip: bool
    verdict: list[str]
    told: list[dict]
    matrices: list[np.ndarray]
    size: tuple[int, int]
    pictures: list[np.ndarray]
    whole: View
    own: dict[int, View] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        return [self.capture.name(path) for path in self.capture.images]

    def moved(self, index: int) -> bool:
        return not np.array_equal(self.matrices[index], np.eye(3))

    def carried(self, mask: np.ndarray, index: int) -> np.ndarray:
        """A mask (H, W) of the group where the camera of this photo sees it."""
        return warp(mask, np.linalg.inv(self.matrices[index])) if self.moved(index) else mask

    def placed(self, mask: np.ndarray, index: int) -> np.ndarray:
        """A mask (H, W) of this photo where the others are."""
        return warp(mask, self.matrices[index]) if self.moved(index) else mask

    def view(self, index: int | None) -> View:
        """What clicks on a photo are judged by; of the group for None."""
        if index is None or not self.moved(index):
            return self.whole if index is None else replace(self.whole, picture=self.pictures[index], drawn={})
        if index not in self.own:
            height, width = self.whole.change.shape
            scale = np.diag([width / self.size[0], height / self.size[1], 1.0])
            back = scale @ np.linalg.inv(self.matrices[index]) @ np.linalg.inv(scale)
            change = cv2.warpPerspective(self.whole.change, back, (width, height), flags=cv2.INTER_LINEAR)
            picture = at_working_size(np.asarray(read_image(self.capture.images[index])))
            self.own[index] = replace(self.whole, picture=picture, change=change, drawn={})
        return self.own[index]


def look_at(
    folder: Path, split: str, root: Path, temporary: Path, method: str | None, say: Callable[[str | Said], None]
) -> GroupView:
    """Decode, register and compare the photos of a group; `say` is told what is being done.

    Args:
        folder, split, root: of the group in the raw tree RAW.
        temporary: a folder of ours, where `prepare` works.
        method: of `View`.

    Raises ValueError or OSError, in a line: unreadable photos, links that lead out of RAW, no still moment in a clip.
    """
    place = temporary / hashlib.sha256(f"{split}/{folder.name}".encode()).hexdigest()[:16]
    (place / "staging").mkdir(parents=True, exist_ok=True)
    job = Job(root, place / "staging", folder, split, SETTINGS)
    job.notes.unlink(missing_ok=True)
    from_clip = is_clip_job(job)
    if from_clip:
        say("reading the clip and choosing its photos")
        job = replace_clips([job], place / "clips", 1)[0]  # where the camera was pushed, what was before
    capture = job.read()
    for path in (*capture.images, *([capture.reference] if capture.reference else [])):
        checked(path, root.resolve() if not from_clip else place)
    frames = len(capture.images)

    def count() -> str:
        done = job.notes.stat().st_size if job.notes.exists() else 0
        return f"comparing the photos ({min(done, frames)} of {frames})"

    say(count)
    entry = prepare_group(job).entry
    say("looking for what changes")
    observations = [frame for frame in entry["frames"] if frame["role"] == "observation"]
    observations = observations or [{"status": "kept", "reasons": [], "warnings": []}] * frames
    matrices = [_matrix(frame) for frame in observations]
    pictures, size = _pictures(capture, matrices)
    compared = [picture for picture, frame in zip(pictures, observations, strict=True) if frame["status"] != "dropped"]
    if capture.reference is not None and len(compared) < 2:
        treated = np.asarray(read_image(capture.reference))
        if treated.shape[1::-1] != size:
            raise ValueError(
                f"{capture.reference}: {treated.shape[1]}x{treated.shape[0]}, and the photos are {size[0]}x{size[1]}"
            )
        compared.insert(0, at_working_size(treated))
    change, noise = np.zeros(pictures[0].shape[:2], np.float32), 1.0
    if len(compared) > 1:
        change, noise = change_map(compared, CHANGE_SIDE)
        change = cv2.resize(change, pictures[0].shape[1::-1], interpolation=cv2.INTER_LINEAR)
    middle = np.median(np.stack(compared or pictures[-1:]), axis=0).astype(np.uint8)
    verdict = [
        remark["text"] for remark in (*entry["reasons"], *entry["warnings"]) if remark["code"] != "masks_proposed"
    ]
    told = [_told(frame) for frame in observations]
    view = View(middle, change, noise, method)
    return GroupView(folder, capture, from_clip, verdict, told, matrices, size, pictures, view)


def _matrix(frame: dict) -> np.ndarray:
    figures = frame.get("registration")
    return np.array(figures["homography"]) if frame["status"] == "warped" and figures else np.eye(3)


def _told(frame: dict) -> dict:
    words = {"identity": "fits as it is", "kept": "fits as it is", "warped": "moved into place", "dropped": "left out"}
    texts = [remark["text"] for remark in (*frame["reasons"], *frame["warnings"])]
    return {"status": frame["status"], "says": words[frame["status"]], "texts": texts}


def _pictures(capture: Capture, matrices: list[np.ndarray]) -> tuple[list[np.ndarray], tuple[int, int]]:
    """The photos in place and small, and their size; ValueError where they differ in it."""
    pictures, size = [], None
    for path, matrix in zip(capture.images, matrices, strict=True):
        pixels = np.asarray(read_image(path))
        if size not in (None, pixels.shape[1::-1]):
            raise ValueError(
                f"{path}: {pixels.shape[1]}x{pixels.shape[0]}, and the first photo is {size[0]}x{size[1]}"
            )
        size = pixels.shape[1::-1]
        pictures.append(at_working_size(pixels if np.array_equal(matrix, np.eye(3)) else warp(pixels, matrix)))
    return pictures, size


def at_working_size(pixels: np.ndarray) -> np.ndarray:
    """A picture (H, W, 3) made smaller, or a small one larger by a whole factor."""
    height, width = pixels.shape[:2]
    longer = max(height, width)
    scale = SIDE / longer if longer > SIDE else max(1, round(LEAST_SIDE / longer))
    if scale == 1:
        return pixels
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
