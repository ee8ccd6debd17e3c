"""The settings of `gift-peft prepare`. Every field with a text is a command line option (`prepare_verb.py`)."""

import math
from dataclasses import dataclass, field

from gift_peft.captures.foreign import Layout
from gift_peft.captures.group_facts import EMPTY_MASKS
from gift_peft.captures.known_datasets import KnownLayout


def _option(text: str, metavar: str = "X", least: int = 0) -> dict:
    """The metadata of a field that is an option; `least` is the smallest number that it takes."""
    return {"help": text, "metavar": metavar, "least": least}


def _arg(text: str, default, **more):
    return field(default=default, metadata=_option(text, **more))


@dataclass(frozen=True)
class RegistrationSettings:
    """Thresholds of registration. Lengths are in pixels of the photos; the first eight are the paper's."""

    contrast_threshold: float = _arg("contrast below which SIFT ignores a feature", 0.08)
    edge_threshold: float = _arg("edge response above which SIFT ignores a feature", 10.0)
    ratio: float = _arg("Lowe's ratio test", 0.70)
    displacement_filter: float = _arg("matches that move this much unlike the median match are removed", 20.0)
    reprojection_threshold: float = _arg("distance up to which a match agrees with a map (MAGSAC)", 2.0)
    confidence: float = _arg("probability with which MAGSAC finds the map", 0.9995)
    max_iterations: int = _arg("iterations of MAGSAC", 5000, least=1)
    min_inlier_ratio: float = _arg("share of the filtered matches that must agree with the map", 0.90)
    paper_exact: bool = _arg(
        "the paper's registration thresholds alone; the report says what the rest would have done", False
    )
    min_contrast_threshold: float = _arg("how far contrast_threshold may be halved where matches are few", 0.02)
    target_margin: int = _arg("features and pixels this close to the target do not count", 8)
    min_inliers: int = _arg("agreeing matches outside the target that a map needs", 20)
    min_spread: float = _arg("least deviation of those matches in any direction, over the image diagonal", 0.02)
    identity_displacement: float = _arg("a median displacement below this is no motion", 0.5)
    max_target_error: float = _arg("largest expected error of the map at the target's corners", 0.5)
    max_displacement: float = _arg("largest motion of a corner of frame or target, over the image diagonal", 0.06)
    max_distortion: float = _arg("largest change of a local length by the map, as a fraction", 0.08)
    min_correlation: float = _arg("least correlation of the pixels outside the target with the target frame's", 0.5)

    def __post_init__(self):
        for name in ("contrast_threshold", "min_contrast_threshold", "edge_threshold", "reprojection_threshold"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: must be positive and finite, got {getattr(self, name)}")
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence: must be between 0 and 1, got {self.confidence}")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations: must be at least 1, got {self.max_iterations}")


@dataclass(frozen=True)
class QualitySettings:
    """Thresholds of the quality checks. `warn` leads to a line in the report, `drop` drops the frame."""

    warn_sharpness: float = _arg("sharpness relative to the group's median, below which a frame is blurred", 0.35)
    drop_sharpness: float = _arg("sharpness, below which a frame is dropped", 0.02)
    warn_clipped: float = _arg("fraction of pixels that are nearly black, or nearly white", 0.25)
    drop_clipped: float = _arg("the same, above which a frame is dropped", 0.95)
    warn_outside_change: float = _arg("fraction of the pixels outside the target whose local structure changed", 0.003)
    drop_outside_change: float = _arg("the same, above which a frame is dropped", 0.25)
    min_outside_correlation: float = _arg(
        "correlation outside the target with the target frame, below which it is another scene and dropped", 0.25
    )
    min_target_change: float = _arg(
        "mean grey change (0-255) inside the target, below which two frames are near duplicates; a train group "
        "without a larger change is rejected",
        1.5,
    )
    warn_mask_area_low: float = _arg("fraction of the image that is target, below which a mask is small", 0.002)
    warn_mask_area_high: float = _arg("the same, above which a mask is large", 0.8)
    warn_mask_border: float = _arg("fraction of the image's border that is target", 0.1)
    warn_mask_iou: float = _arg("overlap of a mask with the group's majority mask", 0.8)
    drop_mask_iou: float = _arg("the same, below which a frame is dropped", 0.2)


@dataclass(frozen=True)
class PrepareSettings:
    """Everything that decides what becomes of a group; `layout` describes RAW where it is not the raw tree."""

    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    quality: QualitySettings = field(default_factory=QualitySettings)
    static_rig: bool = _arg(
        "no camera moved in any group: nothing is warped (static_rig: true in group.yaml says it of one)", False
    )
    propose_masks: bool = _arg(
        "propose masks for groups that lack any, into OUT/masks_proposed; they are not used", False
    )
    accept_proposed_masks: bool = _arg("use the proposed masks, which the dataset card then says", False)
    empty_masks: str = field(
        default="refuse",
        metadata=_option("what photos without a target are in a group whose others have one: an error, or fine")
        | {"choices": EMPTY_MASKS},
    )
    min_proposal_score: float = _arg("score (0 to 1) below which a proposed mask is never accepted", 0.5)
    refine: str | None = _arg("refine the borders of the proposals with SAM 2", None, metavar="sam2:MODEL")
    max_frames: int = _arg("photos that are chosen of a clip, for each pose of the camera", 12, metavar="N", least=1)
    layout: Layout | KnownLayout | None = field(
        default=None,
        metadata=_option(
            "how RAW is laid out: booster, cleargrasp, photos (images/ and masks/), or a YAML file that says where "
            "RGB and mask files lie",
            metavar="NAME|FILE",
        ),
    )
