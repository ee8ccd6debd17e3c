"""Registration of a group's frames to its last observation: the paper's numbers, made safe (supplement A).

The paper's steps (`matching.py`) by themselves accept homographies of five matches that move a corner by 200,000 px.
Here a frame is warped only if enough matches outside the target agree, they fix the map at the target's corners, the
map is a small motion, and the warped frame fits better outside the target than it did before. A frame whose camera
did not move is not resampled at all.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from gift_peft.prepare.entries import Figures, Remark
from gift_peft.prepare.homography import Fit, corners_of, displacement, distortion, fit_pixels, transform
from gift_peft.prepare.matching import Frame, Matches, find_homography, match_frames
from gift_peft.prepare.settings import RegistrationSettings


@dataclass
class Registration:
    """What was decided about a frame, and why.

    Args:
        status (`str`): "identity" (leave the pixels alone), "warped", or "dropped".
        matrix (`np.ndarray`, *optional*): (3, 3), frame to target frame, pixels; None if dropped.
        figures (`Figures`): what was measured, and by which method.
        reasons (`list[Remark]`): why it was dropped.
        warnings (`list[Remark]`): what to look at although it was not.
    """

    status: str
    matrix: np.ndarray | None
    figures: Figures
    reasons: list[Remark] = field(default_factory=list)
    warnings: list[Remark] = field(default_factory=list)

    def __post_init__(self):
        self.figures.homography = None if self.matrix is None else self.matrix.tolist()


def register(moving: Frame, fixed: Frame, declared_static: bool = False, treated: bool = False) -> Registration:
    """Decide whether `moving` stays as it is, is warped onto `fixed`, or is dropped.

    Deterministic. `treated`: the frame is the surface-treated reference. Its look differs by design, so the pixels
    outside the target may stand in for the 90 % rule, with a warning.
    """
    settings = fixed.settings
    if declared_static:
        return Registration("identity", np.eye(3), Figures("declared static"))
    tries = []
    for contrast in _contrasts(settings):
        tries.append(match_frames(moving, fixed, contrast))
        if _sure(tries[-1], fixed):
            break
    enough = [match for match in tries if not _weak(match, settings)]
    best = max(enough, key=lambda match: (match.inlier_ratio >= settings.min_inlier_ratio, match.count), default=None)
    if best is None:
        result = Registration("dropped", None, _figures(tries[-1]), _diagnose(tries, fixed))
    else:
        result = _decide(best, moving, fixed, treated)
    if result.status == "dropped" and result.reasons[0].code != "moved_too_far":
        by_pixels = _identity_by_pixels(moving, fixed)
        if by_pixels is not None:
            warning = Remark(
                "by_pixels",
                "too few matched points agree, but the pixels outside the target show no motion: it is not moved",
            )
            figures = replace(result.figures, method="pixels", **by_pixels)
            result = Registration("identity", np.eye(3), figures, warnings=[warning])
    return _by_the_paper(moving, fixed, result, treated) if settings.paper_exact else result


def _decide(match: Matches, moving: Frame, fixed: Frame, treated: bool) -> Registration:
    """From matches that determine a map: identity, or the warp if nothing speaks against it."""
    settings = fixed.settings
    fit, error = _refine(match, moving, fixed)
    matrix = np.linalg.inv(fit.matrix)
    frame_corners = corners_of(*fixed.size)
    moved = displacement(fit.matrix, fixed.corners)
    corner, bent = displacement(fit.matrix, frame_corners), distortion(fit.matrix, frame_corners)
    before, after = difference_outside(moving, fixed, matrix)
    figures = replace(
        _figures(match),
        expected_error=error,
        corner_displacement=corner,
        target_displacement=moved,
        difference_before=before,
        difference_after=after,
    )
    # A turn about a point among the features moves them little, but a target far from them much. It is believed only
    # if the pixels confirm it, because the map alone would also move corners of frames whose camera stood still.
    hidden = moved - 2 * error > settings.identity_displacement and after < 0.97 * before
    if match.median_displacement < settings.identity_displacement and not hidden:
        return Registration("identity", np.eye(3), figures)
    if fit is not match.fit and moved < settings.identity_displacement and _still_by(fit, match, settings):
        text = "matched points move by half a pixel or more, but the pixels outside the target do not: it is not moved"
        figures.method = "pixels"
        return Registration("identity", np.eye(3), figures, warnings=[Remark("by_pixels", text)])
    bound, farthest = settings.max_displacement * float(np.hypot(*fixed.size)), max(corner, moved)
    reasons = []
    if farthest > bound:
        reasons.append(
            Remark(
                "moved_too_far", f"the camera moved too far: by {farthest:.1f} px at a corner, {bound:.1f} px allowed"
            )
        )
    if bent > settings.max_distortion:
        text = f"the camera turned or came closer: lengths change by {100 * bent:.1f} %"
        text += f", {100 * settings.max_distortion:.1f} % allowed"
        reasons.append(Remark("distorted", text))
    if match.inlier_ratio < settings.min_inlier_ratio:
        text = f"no one motion of the camera explains it: {match.count} of {match.near.sum()} matched points agree"
        text += f" ({100 * match.inlier_ratio:.0f} %)"
        reasons.append(Remark("low_inlier_ratio", f"{text}, {100 * settings.min_inlier_ratio:.0f} % needed"))
    if error > settings.max_target_error:
        text = f"the camera's motion is uncertain by {error:.2f} px at the target's corners"
        text += f", {settings.max_target_error} px allowed"
        reasons.append(Remark("uncertain", text))
    if fit.correlation < settings.min_correlation:
        text = f"outside the target it does not look like the others (correlation {fit.correlation:.2f}"
        text += f", {settings.min_correlation} needed)"
        reasons.append(Remark("no_match", text))
    if not after <= before:
        text = f"moving it into place would not help: outside the target it would differ by {after:.2f} grey levels"
        text += f", not {before:.2f}"
        reasons.append(Remark("worse_outside", text))
    if treated and fit is not match.fit and [item.code for item in reasons] == ["low_inlier_ratio"]:
        figures.method = "pixels"
        return Registration("warped", matrix, figures, warnings=reasons)
    if reasons:
        return Registration("dropped", None, figures, reasons)
    return Registration("warped", matrix, figures)


def _still_by(fit: Fit, match: Matches, settings: RegistrationSettings) -> bool:
    """Whether a map leaves the places of the agreeing matches where they are, by the median."""
    here = match.fixed[match.agreeing]
    moves = np.linalg.norm(transform(fit.matrix, here) - here, axis=1)
    return float(np.median(moves)) < settings.identity_displacement


def _by_the_paper(moving: Frame, fixed: Frame, ours: Registration, treated: bool) -> Registration:
    """What the paper's numbers alone decide, features inside the target included, with our decision beside it.

    The paper registers observations only; a treated reference stays as it is.
    """
    settings = fixed.settings
    match = match_frames(moving, fixed, settings.contrast_threshold, outside_only=False)
    matrix, ratio, near = match.matrix, match.inlier_ratio, int(match.near.sum())
    accepted = matrix is not None and ratio >= settings.min_inlier_ratio and abs(np.linalg.det(matrix)) > 1e-9
    figures = replace(
        ours.figures,
        method="paper" if treated else "features",
        paper_exact={
            "accepted": bool(accepted),
            "matches": near,
            "inliers": match.count,
            "inlier_ratio": ratio,
            "corner_displacement": None if matrix is None else displacement(matrix, corners_of(*fixed.size)),
        },
        with_additions={"status": ours.status, "reasons": ours.reasons},
    )
    if treated:
        return Registration("identity", np.eye(3), figures)
    if accepted:
        return Registration("warped", matrix, figures)
    share = "" if ratio is None else f" ({100 * ratio:.0f} %)"
    text = f"no one motion of the camera explains it: {match.count} of {near} matched points agree{share}"
    return Registration("dropped", None, figures, [Remark("low_inlier_ratio", text)])


def _contrasts(settings: RegistrationSettings) -> list[float]:
    """The paper's threshold, halved down to the floor."""
    contrasts = [settings.contrast_threshold]
    while contrasts[-1] / 2 >= settings.min_contrast_threshold:
        contrasts.append(contrasts[-1] / 2)
    return contrasts


def _weak(match: Matches, settings: RegistrationSettings) -> Remark | None:
    """Why the matches do not determine a map at all, None if they do."""
    if match.count < settings.min_inliers:
        return Remark(
            "no_match", f"{match.count} matched points agree on the camera's motion, {settings.min_inliers} needed"
        )
    spread = match.spread
    if match.fit is None or spread < settings.min_spread:
        text = f"the points that agree on the camera's motion lie too close together: {spread:.3f} of the photo's"
        text += f" diagonal, {settings.min_spread} needed"
        return Remark("narrow", text)
    return None


def _sure(match: Matches, fixed: Frame) -> bool:
    """Whether a lower contrast threshold, with more matches, has nothing to add."""
    settings = fixed.settings
    return (
        not _weak(match, settings)
        and match.inlier_ratio >= settings.min_inlier_ratio
        and match.fit.expected_error(fixed.corners) <= settings.max_target_error
    )


def _diagnose(tries: list[Matches], fixed: Frame) -> list[Remark]:
    """Of matches that are all weak, the reason that helps: little texture, too large a motion, or no agreement."""
    settings = fixed.settings
    for count, which in zip(tries[-1].features, ("frame", "target frame"), strict=True):
        if count < settings.min_inliers:
            text = f"the {which} has {count} features outside the target, too little texture"
            return [Remark("featureless", f"{text}; if the camera stood still, put static_rig: true in group.yaml")]
    bound = settings.max_displacement * float(np.hypot(*fixed.size))
    for match in tries:
        if len(match.fixed) < 8:
            continue
        matrix, inliers = find_homography(match.moving, match.fixed, settings)  # without the displacement filter
        if matrix is not None and inliers.sum() >= max(8, 0.6 * len(inliers)):
            moved = displacement(matrix, fixed.corners)
            if moved > bound:
                return [
                    Remark(
                        "moved_too_far",
                        f"the camera moved too far: the target by about {moved:.0f} px, {bound:.1f} px allowed",
                    )
                ]
    return [_weak(tries[-1], settings)]


def _refine(match: Matches, moving: Frame, fixed: Frame) -> tuple[Fit, float]:
    """The better of the fits to the matches and, from there, to the pixels, and its error at the target's corners.

    The pixels' fit is taken where its expected error is smaller and the matches agree with it. Otherwise the matches'
    is, and the distance between the two fits counts as its error if that is larger.
    """
    by_points, by_pixels = match.fit, fit_pixels(fixed.levels, moving.levels, match.fit.matrix)
    error = by_points.expected_error(fixed.corners)
    if by_pixels is None or by_pixels.correlation < fixed.settings.min_correlation:
        return by_points, error
    here, there = match.fixed[match.agreeing], match.moving[match.agreeing]
    residual = [
        np.median(np.linalg.norm(transform(fit.matrix, here) - there, axis=1)) for fit in (by_points, by_pixels)
    ]
    by_pixels_error = by_pixels.expected_error(fixed.corners)
    if by_pixels_error < error and residual[1] < 1.2 * residual[0] + 0.3:
        return by_pixels, by_pixels_error
    apart = transform(by_points.matrix, fixed.corners) - transform(by_pixels.matrix, fixed.corners)
    return by_points, max(error, float(np.linalg.norm(apart, axis=1).max()))


def _identity_by_pixels(moving: Frame, fixed: Frame) -> dict | None:
    """Figures of the pixels outside the target if they say that the camera did not move, else None."""
    settings = fixed.settings
    fit = fit_pixels(fixed.levels, moving.levels, np.eye(3))
    if fit is None or fit.correlation < settings.min_correlation:
        return None
    error, moved = fit.expected_error(fixed.corners), displacement(fit.matrix, fixed.corners)
    if error > settings.max_target_error or moved > settings.identity_displacement:
        return None
    return {"expected_error": error, "target_displacement": moved}


def difference_outside(moving: Frame, fixed: Frame, matrix: np.ndarray) -> tuple[float, float]:
    """Mean absolute grey difference (0-255) outside both targets, before and after the warp, over the same pixels.

    Gain and offset between the pictures are fitted away each time: a lamp that was dimmed is not a difference.
    """
    valid = valid_area(matrix, fixed.size)
    warped = cv2.warpPerspective(moving.gray, matrix, fixed.size, flags=cv2.INTER_LINEAR)
    outside = cv2.warpPerspective(moving.outside.astype(np.uint8), matrix, fixed.size, flags=cv2.INTER_NEAREST) > 0
    region = fixed.outside & moving.outside & outside & valid
    return tuple(_difference(picture[region], fixed.gray[region]) for picture in (moving.gray, warped))


def _difference(values: np.ndarray, goal: np.ndarray) -> float:
    if not values.size:
        return float("nan")
    values, goal = values.astype(np.float64), goal.astype(np.float64)
    deviation = values.std()
    gain = np.mean((values - values.mean()) * (goal - goal.mean())) / deviation**2 if deviation > 0 else 0.0
    return float(np.abs(goal - goal.mean() - gain * (values - values.mean())).mean())


def valid_area(matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool: where the warped frame has pixels, that is, all that linear interpolation asks for."""
    width, height = size
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    inverse = np.linalg.inv(matrix)
    scale = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
    u = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / scale
    v = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / scale
    return (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1) & (scale > 0)


def warp(array: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """A picture (H, W, 3) uint8 linearly, anything else (masks, depth; (H, W)) by the nearest pixel.

    Outside its old borders a picture repeats its last pixels, because a network would see a black wedge as an object
    of the scene; masks and depth have 0 there.
    """
    height, width = array.shape[:2]
    if array.ndim == 3:
        return cv2.warpPerspective(
            array, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    stored = array.astype(np.uint8) if array.dtype == bool else array
    return cv2.warpPerspective(stored, matrix, (width, height), flags=cv2.INTER_NEAREST).astype(array.dtype)


def _figures(match: Matches) -> Figures:
    return Figures(
        contrast_threshold=match.contrast,
        matches=int(match.near.sum()),
        inliers=match.count,
        inlier_ratio=match.inlier_ratio,
        spread=match.spread if match.count else None,
        median_displacement=match.median_displacement,
    )
