"""One group from photos to a checked, registered group on disk; `captures.py` runs this for every group of a tree."""

import os
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from gift_peft.captures.foreign import read_proxy
from gift_peft.captures.tree import Capture, check_masks, decode_capture
from gift_peft.dataset.writer import write_group
from gift_peft.prepare.job import Job, Outcome, capture_digest
from gift_peft.prepare.matching import Frame
from gift_peft.prepare.quality import Small, check_frames, check_group_change, pairwise_changes
from gift_peft.prepare.registration import Registration, reason, register, valid_area, warp, warp_stored
from gift_peft.rules import check_count, check_group_id

MIN_SIDE = 32  # pixels; below, neither features nor local contrast mean anything


class Rejection(Exception):
    """Ends the work on a group; carries the reasons."""

    def __init__(self, *reasons: dict):
        super().__init__("; ".join(item["text"] for item in reasons))
        self.reasons = list(reasons)


def prepare_group(job: Job) -> Outcome:
    """Read, register, check and stage one group. What is wrong with it ends in its entry, never in an exception."""
    cv2.setNumThreads(1)  # groups run side by side instead
    digest = None
    group = _Group(job)
    try:
        check_group_id(job.group_id)
        group.capture = job.read()
        group.start()
        digest = capture_digest(group.capture, job.settings)
        if digest == job.known:
            return Outcome(digest, group.entry, unchanged=True)
        if None in group.capture.masks and not job.settings.propose_masks:
            check_masks(group.capture)
        group.decode()
        row = group.prepare()
        return Outcome(digest, _finite(group.entry), row)
    except Rejection as rejection:
        group.reject(rejection.reasons)
    except (OSError, ValueError, cv2.error, MemoryError, RecursionError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        group.reject([reason("unreadable", _printable(text.replace(f"{job.raw}{os.sep}", "")))])
        digest = None  # it may be a passing trouble (permissions, memory): try again next time
    return Outcome(digest, _finite(group.entry))


class _Group:
    """The work on one group, step by step; `entry` is its part of the report (`captures.py` lists the keys)."""

    def __init__(self, job: Job):
        self.job, self.settings = job, job.settings
        self.capture: Capture | None = None
        self.entry = {
            "group_id": _printable(job.group_id),
            "split": job.split,
            "surface": None,
            "notes": None,
            "folder": self._relative(job.folder),
            "status": "kept",
            "reasons": [],
            "warnings": [],
            "size": None,
            "target_frame": None,
            "quality": {},
            "proposal": None,
            "frames": [],
        }

    def _relative(self, path: Path) -> str:
        return _printable(path.relative_to(self.job.raw).as_posix())

    def reject(self, reasons: list[dict]) -> None:
        self.entry |= {"status": "rejected", "reasons": reasons}
        for frame in self.entry["frames"]:
            frame |= {"prepared": None, "mask": None, "valid": None}

    def start(self) -> None:
        """The frames as the report lists them."""
        capture = self.capture
        notes = capture.facts.get("notes")
        self.entry |= {"surface": capture.facts.get("surface"), "notes": None if notes is None else str(notes)}
        paths = [(path, "observation") for path in capture.images]
        paths += [(capture.reference, "reference")] if capture.reference is not None else []
        self.entry["frames"] = [
            {
                "name": _printable(capture.name(path) if path.is_relative_to(capture.folder) else path.name),
                "role": role,
                "status": "kept",
                "reasons": [],
                "warnings": [],
                "original": self._relative(path),
                "prepared": None,
                "mask": None,
                "valid": None,
                "registration": None,
                "quality": None,
            }
            for path, role in paths
        ]

    def decode(self) -> None:
        for path in self.capture.images:
            if str(path) != _printable(str(path)):
                raise ValueError(f"{path}: the name is not valid Unicode text; rename the file")
        self.decoded = decode_capture(self.capture)
        size = self.decoded.images[0].size
        self.entry["size"] = list(size)
        if min(size) < MIN_SIDE:
            raise ValueError(f"group {self.job.group_id}: {size[0]}x{size[1]} pixels; a side has at least {MIN_SIDE}")
        for index, first in self.decoded.duplicates.items():
            name = self.entry["frames"][first]["name"]
            self._drop(self.entry["frames"][index], [reason("duplicate", f"the same picture as {name}")])
        self.frames = [self.entry["frames"][index] for index in self.decoded.kept]
        self.reference = self.entry["frames"][-1] if self.decoded.reference is not None else None
        self.images = [np.asarray(image) for image in self.decoded.images]
        self.treated = None if self.decoded.reference is None else np.asarray(self.decoded.reference)
        self.masks = self.decoded.masks

    def _drop(self, frame: dict, reasons: list[dict]) -> None:
        frame |= {"status": "dropped", "reasons": reasons}

    def prepare(self) -> dict:
        """The staged group's metadata row."""
        if any(mask is None for mask in self.masks):
            self._propose()
        self._register()
        self._check()
        return self._write()

    def _register(self) -> None:
        """Every other observation, and the treated reference, to the last observation."""
        settings = self.settings.registration
        static = self.settings.static_rig or self.capture.facts.get("static_rig", False)
        target = Frame(self.images[-1], self.masks[-1], settings)
        self.entry["target_frame"] = self.frames[-1]["name"]
        self._valids: dict[str, np.ndarray] = {}
        self.maps: list[np.ndarray | None] = []
        for frame, image, mask in zip(self.frames[:-1], self.images, self.masks, strict=False):
            self.maps.append(self._note(frame, register(Frame(image, mask, settings), target, static)))
        self.maps.append(np.eye(3))
        self.treated_map = None
        if self.treated is not None:
            # Nobody draws a mask for it, and the camera may have moved a little: the target's, and some more.
            side = 2 * round(0.01 * float(np.hypot(*target.size))) + 1
            around = (
                None if self.masks[-1] is None else cv2.dilate(self.masks[-1].astype(np.uint8), np.ones((side, side)))
            )
            treated = Frame(self.treated, None if around is None else around > 0, settings)
            result = register(treated, target, static, treated=True)
            self.treated_map = self._note(self.reference, result)
            if result.status == "warped":
                self.reference["warnings"].append(
                    reason("reference_moved", "the camera moved before the treated reference was taken; it is warped")
                )

    def _note(self, frame: dict, result: Registration) -> np.ndarray | None:
        """Put a decision into the report; the map to apply, None if the frame is dropped."""
        keys = ("matches", "inliers", "inlier_ratio", "spread", "median_displacement", "corner_displacement")
        keys += ("target_displacement", "expected_error", "contrast_threshold", "difference_before")
        keys += ("difference_after", "paper_exact")
        frame["status"] = result.status
        frame["reasons"], frame["warnings"] = result.reasons, result.warnings
        frame["registration"] = {
            "method": result.method,
            "homography": None if result.matrix is None else result.matrix.tolist(),
            **{key: result.figures.get(key) for key in keys},
        }
        if "with_additions" in result.figures:
            frame["registration"]["with_additions"] = result.figures["with_additions"]
        return result.matrix

    def _warped(self, array: np.ndarray, frame: dict, matrix: np.ndarray) -> np.ndarray:
        return warp(array, matrix) if frame["status"] == "warped" else array

    def _valid(self, frame: dict, matrix: np.ndarray) -> np.ndarray:
        """(H, W) bool, computed once per frame: checks and files ask for it."""
        if frame["name"] not in self._valids:
            width, height = self.entry["size"]
            whole = frame["status"] != "warped"
            valid = np.ones((height, width), bool) if whole else valid_area(matrix, (width, height))
            self._valids[frame["name"]] = valid
        return self._valids[frame["name"]]

    def _propose(self) -> None:
        """Masks for a group that lacks some; they stay beside the dataset unless accepted."""
        from gift_peft.prepare.proposals import propose, refine

        drawn, self.masks = self.masks, [None] * len(self.masks)
        self._register()
        usable = [index for index, matrix in enumerate(self.maps) if matrix is not None]
        if len(usable) < 2:
            raise Rejection(reason("no_proposal", "fewer than two frames are registered, so nothing can be compared"))
        aligned = [self._warped(self.images[index], self.frames[index], self.maps[index]) for index in usable]
        proposal = propose(aligned)
        if self.settings.refine is not None and proposal.mask.any():
            proposal = refine(proposal, aligned[-1], self.settings.refine)
        folder = self.job.staging / "masks_proposed" / self.job.split / self.job.group_id
        paths = []
        for index in usable if proposal.mask.any() else ():
            mask = warp(proposal.mask, np.linalg.inv(self.maps[index]))
            path = (folder / self.frames[index]["name"]).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask.astype(np.uint8) * 255).save(path)
            paths.append(path.relative_to(self.job.staging).as_posix())
            self.masks[index] = mask
        accepted = self.settings.accept_proposed_masks and bool(paths)
        figures = {key: value for key, value in asdict(proposal).items() if key != "mask"}
        self.entry["proposal"] = {
            **figures,
            "mask_area": float(proposal.mask.mean()),
            "accepted": accepted,
            "masks": paths,
        }
        if not paths:
            raise Rejection(reason("no_proposal", "nothing stands out from noise and changes of the light"))
        if not accepted:
            text = "masks are missing; look at the proposed ones, then copy them into masks/ or accept them"
            raise Rejection(reason("masks_proposed", f"{text} (--accept-proposed-masks)"))
        for index, mask in enumerate(drawn):
            if mask is not None:
                self.masks[index] = mask
            elif self.masks[index] is None:  # dropped above, and it will be again
                self.masks[index] = np.zeros(self.images[index].shape[:2], bool)

    def _check(self) -> None:
        """Quality of the frames that are still there, then of the group."""
        kept = [index for index, matrix in enumerate(self.maps) if matrix is not None]
        target = kept.index(len(self.frames) - 1)
        grays = [_gray(self.images[index]) for index in kept]
        smalls = [
            Small(
                _gray(self._warped(self.images[index], self.frames[index], self.maps[index])),
                self._warped(self.masks[index], self.frames[index], self.maps[index]),
                self._valid(self.frames[index], self.maps[index]),
            )
            for index in kept
        ]
        quality = self.settings.quality
        names = [self.frames[index]["name"] for index in kept]
        changes = pairwise_changes(smalls)
        for index, figures, reasons, warnings in zip(
            kept, *check_frames(names, smalls, grays, target, changes, quality), strict=True
        ):
            frame = self.frames[index]
            frame["quality"] = figures
            frame["warnings"] = frame["warnings"] + warnings
            if reasons:
                self._drop(frame, reasons)
                self.maps[index] = None
        if self.treated_map is not None:
            self._check_reference(smalls[target])
        left = [position for position, index in enumerate(kept) if self.maps[index] is not None]
        most, complaint = check_group_change(changes[np.ix_(left, left)], quality)
        areas = [smalls[position].mask_area for position in left]
        self.entry["quality"] = {
            "target_change": most,
            "mask_area": float(np.mean(areas)) if areas else None,
            "outside_change": max(
                (frame["quality"]["outside_change"] or 0.0 for frame in self.frames if frame["quality"]), default=None
            ),
            "mask_iou": min(
                (
                    frame["quality"]["mask_iou"]
                    for frame in self.frames
                    if frame["quality"] and frame["quality"]["mask_iou"] is not None
                ),
                default=None,
            ),
        }
        self._check_count(len(left))
        if complaint is not None:
            item = reason("target_unchanged", complaint)
            if self.job.split == "train":
                raise Rejection(item)
            self.entry["warnings"].append(item)
        if self.job.split == "train" and not any(areas):
            raise Rejection(reason("masks_empty", "every mask is empty, so there is nothing to train on"))

    def _is_warped(self, index: int) -> bool:
        return self.frames[index]["status"] == "warped"

    def _check_reference(self, target: Small) -> None:
        frame = self.reference
        gray = _gray(self.treated)
        registered = _gray(self._warped(self.treated, frame, self.treated_map))
        small = Small(registered, self.masks[-1], self._valid(frame, self.treated_map))
        both, unknown = [small, target], np.full((2, 2), np.nan)  # inside the target it differs by design
        names = [frame["name"], self.entry["target_frame"]]
        figures, reasons, warnings = check_frames(names, both, [gray, gray], 1, unknown, self.settings.quality)
        about = ("clipped_dark", "clipped_bright", "outside_change", "outside_correlation")
        frame["quality"] = {key: figures[0][key] for key in about}
        codes = ("too_dark", "too_bright", "another_scene", "outside_change")
        frame["warnings"] = frame["warnings"] + [item for item in warnings[0] if item["code"] in codes]
        bad = [item for item in reasons[0] if item["code"] in codes]
        if bad:
            self._drop(frame, bad)
            self.treated_map = None

    def _check_count(self, count: int) -> None:
        has_reference = self.treated_map is not None
        if self.reference is not None and not has_reference:
            text = "; ".join(item["text"] for item in self.reference["reasons"])
            self.entry["warnings"].append(reason("reference_dropped", f"the treated reference is dropped: {text}"))
        try:
            check_count(self.job.group_id, count, self.job.split, has_reference)
        except ValueError:
            dropped = [
                f"{frame['name']}: {', '.join(item['text'] for item in frame['reasons'])}"
                for frame in self.entry["frames"]
                if frame["status"] == "dropped"
            ]
            text = f"{count} of {len(self.capture.images)} observations are left; dropped are {'; '.join(dropped)}"
            raise Rejection(reason("too_few_frames", text)) from None

    def _write(self) -> dict:
        kept = [index for index, matrix in enumerate(self.maps) if matrix is not None]
        reference = None if self.treated_map is None else self.capture.reference
        moved = [index for index in kept if self._is_warped(index)]
        # Where the reference has no pixels nothing can be compared with it, in any frame.
        everywhere = None
        if reference is not None and self.reference["status"] == "warped":
            everywhere = self._valid(self.reference, self.treated_map)
            reference = Image.fromarray(warp(self.treated, self.treated_map))
        valids = []
        if moved or everywhere is not None:
            valids = [self._valid(self.frames[index], self.maps[index]) for index in kept]
            valids = [valid if everywhere is None else valid & everywhere for valid in valids]
        row = write_group(
            {
                "split": self.job.split,
                "group_id": self.job.group_id,
                "surface": self.entry["surface"],
                "image_names": [self.frames[index]["name"] for index in kept],
                "images": [
                    Image.fromarray(warp(self.images[index], self.maps[index]))
                    if index in moved
                    else self.capture.images[self.decoded.kept[index]]
                    for index in kept
                ],
                "masks": [self._warped(self.masks[index], self.frames[index], self.maps[index]) for index in kept],
                "valids": valids,
                "reference": reference,
            },
            self.job.staging,
        )
        for position, index in enumerate(kept):
            for key, column in (("prepared", "images"), ("mask", "masks"), ("valid", "valids")):
                if row[f"{column}_file_names"]:
                    self.frames[index][key] = f"{self.job.split}/{row[f'{column}_file_names'][position]}"
        if reference is not None:
            self.reference["prepared"] = f"{self.job.split}/{row['reference_file_name']}"
        if self.capture.proxies:
            self._write_proxies(kept)
        return row

    def _write_proxies(self, kept: list[int]) -> None:
        """Stored predictions follow their frames, by the nearest pixel; whose they are is not known, so they stay
        beside the dataset (`proxies_given/`) and `gift-peft proxies` makes those that train."""
        if len(self.capture.proxies) != len(self.capture.images):
            raise ValueError(f"group {self.job.group_id}: {len(self.capture.proxies)} proxies for its images")
        folder = self.job.staging / "proxies_given" / self.job.split / self.job.group_id
        for index in kept:
            path = self.capture.proxies[self.decoded.kept[index]]
            proxy = read_proxy(path)
            if self._is_warped(index):
                proxy = warp_stored(proxy, self.maps[index], tuple(self.entry["size"]))
            target = (folder / self.frames[index]["name"]).with_suffix(".npy")
            target.parent.mkdir(parents=True, exist_ok=True)
            np.save(target, proxy)


def _gray(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def _printable(text: str) -> str:
    """File names may hold bytes that are no text; a report may not."""
    return text.encode("utf-8", "backslashreplace").decode()


def _finite(value):
    """JSON has no NaN: what could not be measured is null, however deep it lies."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
