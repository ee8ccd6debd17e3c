"""What `report.json` holds, one dataclass per object of it.

The file is one object: `format` (1), `raw` (RAW, relative to OUT), `settings` (`settings.PrepareSettings`), `versions`
(of gift-peft, opencv, numpy, pillow, python), `removed` (groups, as "train/a", that an earlier run had made and that
RAW no longer has), `statistics` (a `Statistics` for "train" and for "validation", where they have groups) and `groups`
(a list of `GroupEntry`, in the order of the dataset). Paths use forward slashes. A figure that could not be measured
is null.
"""

from dataclasses import asdict, dataclass, field

from gift_peft.files import jsonable

ONLY_EXACT = {"paper_exact", "with_additions"}  # keys that are left out without --paper-exact


@dataclass(frozen=True)
class Remark:
    """A reason or a warning: `code` for programs, `text` for people."""

    code: str
    text: str


@dataclass
class Figures:
    """How a frame was registered; displacements and errors are in pixels of the photos."""

    method: str = "features"  # or "pixels", "declared static", "paper" (which leaves a treated reference alone)
    homography: list[list[float]] | None = None  # 3x3, frame to target frame; None if dropped
    matches: int | None = None
    inliers: int | None = None
    inlier_ratio: float | None = None
    spread: float | None = None  # of the agreeing matches, over the image diagonal
    median_displacement: float | None = None
    corner_displacement: float | None = None  # of the frame's corners
    target_displacement: float | None = None  # of the target's corners
    expected_error: float | None = None  # at the target's corners
    contrast_threshold: float | None = None
    difference_before: float | None = None  # mean absolute grey difference outside the target, 0-255
    difference_after: float | None = None
    paper_exact: dict | None = None  # accepted, matches, inliers, inlier_ratio, corner_displacement
    with_additions: dict | None = None  # status, reasons: what would have been decided without --paper-exact


@dataclass
class ReferenceQuality:
    """What is measured of a treated reference; the last two against the target frame."""

    clipped_dark: float  # fraction of the pixels
    clipped_bright: float
    outside_change: float | None
    outside_correlation: float | None


@dataclass
class FrameQuality(ReferenceQuality):
    """What is measured of an observation."""

    sharpness: float | None  # relative to the group's median
    target_change: float | None  # mean grey change inside the target, against the most similar frame
    mask_area: float  # fraction of the image
    mask_border: float  # fraction of the image's border
    mask_iou: float | None  # with the group's majority mask


@dataclass
class FrameEntry:
    """One picture of a group."""

    name: str  # its path inside the group's folder, as in `image_names`
    role: str  # "observation" or "reference"
    original: str  # path relative to RAW
    # "identity" (not resampled), "warped" or "dropped"; "kept": the target frame, or the group was rejected before
    status: str = "kept"
    reasons: list[Remark] = field(default_factory=list)  # why it was dropped
    warnings: list[Remark] = field(default_factory=list)
    prepared: str | None = None  # these three: paths relative to OUT
    mask: str | None = None
    valid: str | None = None
    registration: Figures | None = None  # None: the target frame, or never reached
    quality: FrameQuality | ReferenceQuality | None = None

    def drop(self, reasons: list[Remark]) -> None:
        self.status, self.reasons = "dropped", reasons


@dataclass
class GroupQuality:
    """Of a group's frames: the largest change inside the target, the mean mask, and the worst of the rest."""

    target_change: float | None
    mask_area: float | None
    outside_change: float | None
    mask_iou: float | None


@dataclass
class GroupEntry:
    """One group."""

    group_id: str
    split: str
    folder: str  # relative to RAW
    surface: str | None = None
    notes: str | None = None
    status: str = "kept"  # or "rejected"
    reasons: list[Remark] = field(default_factory=list)  # why it was rejected
    warnings: list[Remark] = field(default_factory=list)  # about the group as a whole
    size: list[int] | None = None  # width, height
    target_frame: str | None = None  # the observation that the others are registered to
    quality: GroupQuality | dict = field(default_factory=dict)  # {}: rejected before it was measured
    proposal: dict | None = None  # `proposals.Proposal` without its mask; mask_area, accepted, masks (paths in OUT)
    frames: list[FrameEntry] = field(default_factory=list)  # natural order, the treated reference last

    def reject(self, reason: Remark) -> None:
        self.status, self.reasons = "rejected", [reason]

    def as_json(self) -> dict:
        """Nested JSON types. JSON has no NaN: what could not be measured is null."""
        return jsonable(asdict(self, dict_factory=_present))


def _present(items: list[tuple]) -> dict:
    return {key: value for key, value in items if value is not None or key not in ONLY_EXACT}


@dataclass
class Statistics:
    """Of one split; `group_size` and `mask_area` are {"min", "max", "mean"}, None without groups."""

    groups: int
    images: int
    pairs: int
    references: int
    rejected_groups: int
    dropped_frames: int
    warped_frames: int
    group_size: dict | None
    mask_area: dict | None  # fraction of the image
