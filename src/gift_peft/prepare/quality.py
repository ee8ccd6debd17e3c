"""Quality control of a registered group: is each frame usable, did only the target change, do the masks agree?

The paper filters its captures by hand and names that as a limitation (supplement A). Every check here measures one
figure and compares it with a stated threshold; it warns or drops, and says so with both numbers.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from gift_peft.prepare.homography import normalise_contrast

SHRINK = 4  # comparisons between frames are made at a quarter of the size: noise and half-pixel shifts average out


@dataclass(frozen=True)
class QualitySettings:
    """Thresholds of the checks; `warn_` leads to a line in the report, `drop_` drops the frame.

    Args:
        warn_sharpness, drop_sharpness (`float`): a frame's sharpness (variance of the Laplacian over the variance of
            the grey values) relative to the group's median, below which it counts as blurred.
        warn_clipped, drop_clipped (`float`): fraction of pixels that are nearly black, or nearly white.
        warn_outside_change, drop_outside_change (`float`): fraction of the pixels outside the target whose local
            structure differs from the target frame's: something else moved, or a shadow did.
        min_outside_correlation (`float`): of local structure outside the target with the target frame's, below which
            it is another scene, whatever the rig was declared to be.
        min_target_change (`float`): mean grey change (0-255) inside the common target, against every other frame,
            below which a frame is a near duplicate; if no frame changes more, the group teaches nothing and a train
            group is rejected.
        warn_mask_area_low, warn_mask_area_high (`float`): fraction of the image.
        warn_mask_border (`float`): fraction of the image's border that is target.
        warn_mask_iou, drop_mask_iou (`float`): overlap of a mask with the group's majority mask.
    """

    warn_sharpness: float = 0.35
    drop_sharpness: float = 0.02
    warn_clipped: float = 0.25
    drop_clipped: float = 0.95
    warn_outside_change: float = 0.003
    drop_outside_change: float = 0.25
    min_outside_correlation: float = 0.25
    min_target_change: float = 1.5
    warn_mask_area_low: float = 0.002
    warn_mask_area_high: float = 0.8
    warn_mask_border: float = 0.1
    warn_mask_iou: float = 0.8
    drop_mask_iou: float = 0.2


def sharpness(gray: np.ndarray) -> float:
    """Variance of the Laplacian over the variance of the values of (H, W) uint8; 0 for a flat picture."""
    values = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)  # else noise looks sharp
    variance = float(values.var())
    return float(cv2.Laplacian(values, cv2.CV_32F).var()) / variance if variance > 0 else 0.0


def clipped(gray: np.ndarray) -> tuple[float, float]:
    """Fractions of (H, W) uint8 pixels that are nearly black and nearly white."""
    return float((gray <= 3).mean()), float((gray >= 252).mean())


class Small:
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
        self.structure = normalise_contrast(self.gray, self.outside)


def outside_change(frame: Small, target_frame: Small) -> float | None:
    """Fraction of the pixels outside both targets whose local structure differs; None if there are none."""
    region = frame.outside & target_frame.outside
    if not region.any():
        return None
    difference = cv2.blur(np.abs(frame.structure - target_frame.structure), (5, 5))
    return float((difference[region] > 0.7).mean())


def outside_correlation(frame: Small, target_frame: Small) -> float | None:
    """Correlation of local structure outside both targets; None where there is hardly any structure to compare."""
    region = frame.outside & target_frame.outside
    here, there = frame.structure[region], target_frame.structure[region]
    if region.sum() < 100 or min(here.std(), there.std()) < 0.1:
        return None
    return float(np.corrcoef(here, there)[0, 1])


def target_change(frame: Small, other: Small) -> float | None:
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


def pairwise_changes(frames: list[Small]) -> np.ndarray:
    """(N, N) symmetric: `target_change` of every two frames; NaN on the diagonal and where masks do not overlap."""
    changes = np.full((len(frames), len(frames)), np.nan)
    for index, frame in enumerate(frames):
        for other in range(index + 1, len(frames)):
            change = target_change(frame, frames[other])
            changes[index, other] = changes[other, index] = np.nan if change is None else change
    return changes


def check_frames(
    names: list[str],
    frames: list[Small],
    grays: list[np.ndarray],
    target: int,
    changes: np.ndarray,
    settings: QualitySettings,
) -> tuple[list[dict], list[list[dict]], list[list[dict]]]:
    """Per frame: measured figures, reasons to drop it, warnings.

    Args:
        names (`list[str]`): of N frames.
        frames (`list[Small]`): registered.
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
        figures = {
            "sharpness": sharp[index] / usual if usual > 0 else None,
            "clipped_dark": dark,
            "clipped_bright": bright,
            "outside_change": None if index == target else outside_change(frame, frames[target]),
            "outside_correlation": None if index == target else outside_correlation(frame, frames[target]),
            "target_change": None if nearest is None else float(changes[index, nearest]),
            "mask_area": frame.mask_area,
            "mask_border": _border(frame.inside),
            "mask_iou": float((frame.inside & majority).sum() / union) if union else None,
        }
        reasons, warnings = _judge(figures, settings)
        if nearest is not None and nearest < index and changes[index, nearest] < settings.min_target_change:
            text = f"inside the target it differs from {names[nearest]} by {changes[index, nearest]:.2f} grey levels"
            warnings.append({"code": "near_duplicate", "text": f"{text}, threshold {settings.min_target_change}"})
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


def _judge(figures: dict, settings: QualitySettings) -> tuple[list[dict], list[dict]]:
    """Reasons to drop a frame, and warnings, from its figures."""
    reasons, warnings = [], []

    def check(code: str, figure: str, low: bool, warn: float | None, drop: float | None, text: str) -> None:
        value = figures[figure]
        if value is None:
            return
        for threshold, found in ((drop, reasons), (warn, warnings)):
            if threshold is not None and (value < threshold if low else value > threshold):
                found.append({"code": code, "text": f"{text}: {value:.4g}, threshold {threshold:g}"})
                return

    s = settings
    check("blurred", "sharpness", True, s.warn_sharpness, s.drop_sharpness, "sharpness relative to the group")
    check("too_dark", "clipped_dark", False, s.warn_clipped, s.drop_clipped, "fraction of black pixels")
    check("too_bright", "clipped_bright", False, s.warn_clipped, s.drop_clipped, "fraction of white pixels")
    check(
        "another_scene", "outside_correlation", True, None, s.min_outside_correlation, "correlation outside the target"
    )
    check(
        "outside_change",
        "outside_change",
        False,
        s.warn_outside_change,
        s.drop_outside_change,
        "fraction that changed outside the target",
    )
    check("mask_small", "mask_area", True, s.warn_mask_area_low, None, "fraction of the image that is target")
    check("mask_large", "mask_area", False, s.warn_mask_area_high, None, "fraction of the image that is target")
    check("mask_border", "mask_border", False, s.warn_mask_border, None, "fraction of the border that is target")
    check("mask_disagrees", "mask_iou", True, s.warn_mask_iou, s.drop_mask_iou, "overlap with the group's masks")
    return reasons, warnings
