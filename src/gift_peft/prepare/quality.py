"""Quality control of a registered group: is each frame usable, did only the target change, do the masks agree?

The paper filters its captures by hand and names that as a limitation (supplement A). Every check here measures one
figure and compares it with a stated threshold; it warns or drops, and says so with both numbers.
"""

import cv2
import numpy as np

from gift_peft.prepare.entries import FrameQuality, Remark
from gift_peft.prepare.homography import normalize_contrast
from gift_peft.prepare.settings import QualitySettings

SHRINK = 4  # comparisons between frames are made at a quarter of the size: noise and half-pixel shifts average out
# code, figure, whether a small value is bad, threshold of the warning, threshold of dropping, text
CHECKS = (
    (
        "blurred",
        "sharpness",
        True,
        "warn_sharpness",
        "drop_sharpness",
        "blurred: sharpness, where 1 is the middle of the group",
    ),
    ("too_dark", "clipped_dark", False, "warn_clipped", "drop_clipped", "too dark: share of nearly black pixels"),
    (
        "too_bright",
        "clipped_bright",
        False,
        "warn_clipped",
        "drop_clipped",
        "too bright: share of nearly white pixels",
    ),
    (
        "another_scene",
        "outside_correlation",
        True,
        None,
        "min_outside_correlation",
        "another scene: likeness outside the target (correlation)",
    ),
    (
        "outside_change",
        "outside_change",
        False,
        "warn_outside_change",
        "drop_outside_change",
        "something else changed: share of the pixels outside the target",
    ),
    ("mask_small", "mask_area", True, "warn_mask_area_low", None, "small mask: share of the image"),
    ("mask_large", "mask_area", False, "warn_mask_area_high", None, "large mask: share of the image"),
    (
        "mask_border",
        "mask_border",
        False,
        "warn_mask_border",
        None,
        "the mask touches the border: share of the image's border",
    ),
    (
        "mask_disagrees",
        "mask_iou",
        True,
        "warn_mask_iou",
        "drop_mask_iou",
        "another mask than the others: overlap with them",
    ),
)


def sharpness(gray: np.ndarray) -> float:
    """Variance of the Laplacian over the variance of the values of (H, W) uint8; 0 for a flat picture."""
    values = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)  # else noise looks sharp
    variance = float(values.var())
    return float(cv2.Laplacian(values, cv2.CV_32F).var()) / variance if variance > 0 else 0.0


def clipped(gray: np.ndarray) -> tuple[float, float]:
    """Fractions of (H, W) uint8 pixels that are nearly black and nearly white."""
    return float((gray <= 3).mean()), float((gray >= 252).mean())


class SmallFrame:
    """A registered frame at a quarter of its size, for comparisons."""

    def __init__(self, gray: np.ndarray, target: np.ndarray, valid: np.ndarray | None):
        """`gray` (H, W) uint8, `target` (H, W) bool, `valid` (H, W) bool or None for all."""
        height, width = (max(side // SHRINK, 1) for side in gray.shape)

        def share(mask: np.ndarray) -> np.ndarray:
            return cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)

        self.gray = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
        valid = np.ones(gray.shape, bool) if valid is None else valid
        self.mask_area = float(target.mean())
        inside = share(target & valid)
        self.inside = inside > min(0.5, 0.99 * float(inside.max()))  # something is left of a target that is thin
        margin = cv2.dilate(target.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0
        self.outside = share(~margin & valid) > 0.999
        self.structure = normalize_contrast(self.gray, self.outside)


def outside_change(frame: SmallFrame, target_frame: SmallFrame) -> float | None:
    """Fraction of the pixels outside both targets whose local structure differs; None if there are none."""
    region = frame.outside & target_frame.outside
    if not region.any():
        return None
    difference = cv2.blur(np.abs(frame.structure - target_frame.structure), (5, 5))
    return float((difference[region] > 0.7).mean())


def outside_correlation(frame: SmallFrame, target_frame: SmallFrame) -> float | None:
    """Correlation of local structure outside both targets; None where there is hardly any structure to compare."""
    region = frame.outside & target_frame.outside
    here, there = frame.structure[region], target_frame.structure[region]
    if region.sum() < 100 or min(here.std(), there.std()) < 0.1:
        return None
    return float(np.corrcoef(here, there)[0, 1])


def target_change(frame: SmallFrame, other: SmallFrame) -> float | None:
    """Mean absolute grey change inside both targets, exposure outside taken out; None if they do not overlap."""
    inside, outside = frame.inside & other.inside, frame.outside & other.outside
    if not inside.any():
        return None
    values, goal = frame.gray.astype(np.float32), other.gray.astype(np.float32)
    gain, offset = 1.0, 0.0
    if outside.sum() > 100:
        here, there = values[outside], goal[outside]
        # By standard deviations, not least squares: symmetric, and noise does not shrink it.
        gain = float(np.clip(there.std() / max(here.std(), 1e-3), 0.25, 4.0))
        offset = float(there.mean() - gain * here.mean())
    return float(np.abs(values[inside] * gain + offset - goal[inside]).mean())


def pairwise_changes(frames: list[SmallFrame]) -> np.ndarray:
    """(N, N) symmetric: `target_change` of every two frames; NaN on the diagonal and where masks do not overlap."""
    changes = np.full((len(frames), len(frames)), np.nan)
    for index, frame in enumerate(frames):
        for other in range(index + 1, len(frames)):
            change = target_change(frame, frames[other])
            changes[index, other] = changes[other, index] = np.nan if change is None else change
    return changes


def check_frames(
    names: list[str],
    frames: list[SmallFrame],
    grays: list[np.ndarray],
    target: int,
    changes: np.ndarray,
    settings: QualitySettings,
) -> tuple[list[FrameQuality], list[list[Remark]], list[list[Remark]]]:
    """Per frame: measured figures, reasons to drop it, warnings.

    Args:
        names (`list[str]`): of N frames.
        frames (`list[SmallFrame]`): registered.
        grays (`list[np.ndarray]`): (H, W) uint8, as taken: warping blurs.
        target (`int`): which of them the others were registered to.
        changes (`np.ndarray`): (N, N), of `pairwise_changes`.
    """
    majority = np.mean([frame.inside for frame in frames], axis=0) > 0.5
    sharp = [sharpness(gray) for gray in grays]
    usual = float(np.median(sharp))
    all_figures, all_reasons, all_warnings = [], [], []
    for index, frame in enumerate(frames):
        dark, bright = clipped(grays[index])
        nearest = None if np.isnan(changes[index]).all() else int(np.nanargmin(changes[index]))
        union = (frame.inside | majority).sum()
        figures = FrameQuality(
            sharpness=sharp[index] / usual if usual > 0 else None,
            clipped_dark=dark,
            clipped_bright=bright,
            outside_change=None if index == target else outside_change(frame, frames[target]),
            outside_correlation=None if index == target else outside_correlation(frame, frames[target]),
            target_change=None if nearest is None else float(changes[index, nearest]),
            mask_area=frame.mask_area,
            mask_border=_border(frame.inside),
            mask_iou=float((frame.inside & majority).sum() / union) if union else None,
        )
        reasons, warnings = _judge(figures, settings)
        if nearest is not None and nearest < index and changes[index, nearest] < settings.min_target_change:
            text = f"inside the target it differs from {names[nearest]} by {changes[index, nearest]:.2f} grey levels"
            warnings.append(Remark("near_duplicate", f"{text}, threshold {settings.min_target_change}"))
        all_figures.append(figures)
        all_reasons.append(reasons)
        all_warnings.append(warnings)
    return all_figures, all_reasons, all_warnings


def check_group_change(changes: np.ndarray, settings: QualitySettings) -> tuple[float | None, str | None]:
    """The largest change inside the target between two frames, and the complaint if the group teaches nothing.

    `changes` (N, N) of `pairwise_changes`; nothing to say about a single frame.
    """
    if len(changes) < 2:
        return None, None
    if np.isnan(changes).all():
        return None, "the masks of no two frames overlap, so the group teaches nothing"
    most = float(np.nanmax(changes))
    if most < settings.min_target_change:
        needed = f"{settings.min_target_change} needed"
        return most, f"the target changes by at most {most:.2f} grey levels, {needed}: the group teaches nothing"
    return most, None


def _border(mask: np.ndarray) -> float:
    """Fraction of the image's border that a mask covers."""
    return float(np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean())


def _judge(figures: FrameQuality, settings: QualitySettings) -> tuple[list[Remark], list[Remark]]:
    """Reasons to drop a frame, and warnings, from its figures."""
    reasons, warnings = [], []
    for code, figure, low, warn, drop, text in CHECKS:
        value = getattr(figures, figure)
        for name, found in ((drop, reasons), (warn, warnings)):
            threshold = None if name is None else getattr(settings, name)
            if None not in (value, threshold) and (value < threshold if low else value > threshold):
                found.append(Remark(code, f"{text}: {plain_number(value)}, threshold {plain_number(threshold)}"))
                break
    return reasons, warnings


def plain_number(value: float) -> str:
    """Three digits and no exponent."""
    text = f"{value:.3g}"
    return text if "e" not in text else f"{value:.0f}" if abs(value) >= 1 else f"{value:.6f}".rstrip("0").rstrip(".")
