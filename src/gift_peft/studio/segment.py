"""Click to segment: the target under a click, from what changes in the group and where the picture has edges.

The change map says roughly where the target is (its strong regions), and GrabCut draws the border: in a band around a
region, by the change and the colors together. A click on something else cuts a region in two where the picture has an
edge between the clicks.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gift_peft.prepare.proposals import LEAST_CHANGE, clean, strong

BAND = 0.02  # of the diagonal: how far a border may be from that of the strong region
DISK = 0.006  # of the diagonal: what a click surely means
NEAR = 0.03  # of the diagonal: how far beside a region a click may be and still mean it
TOLERANCE = 12  # Lab levels (0-255): colors of one thing, where nothing changes
SURE = 0.7  # of the way to a click beside the target: what is surely of the clicked target
ROUNDS = 3  # of GrabCut
CEILING = 8.0  # times the noise: more change says nothing more


@dataclass(frozen=True)
class Click:
    """Where somebody clicked, in pixels of the map, and whether the target is there."""

    x: float
    y: float
    target: bool = True


def segment(picture: np.ndarray, change: np.ndarray, noise: float, clicks: Sequence[Click]) -> np.ndarray:
    """(h, w) bool: the targets that were clicked on.

    Args:
        picture (`np.ndarray`): (h, w, 3) uint8 RGB, the group's median or the photo itself.
        change (`np.ndarray`): (h, w) float32 of `proposals.change_map`; zeros where there is nothing to compare.
        noise (`float`): the change that counts as none.
        clicks: at least one on the target, or nothing is found; those beside it say what is not.
    """
    hits = [_place(click, change.shape) for click in clicks if click.target]
    misses = [_place(click, change.shape) for click in clicks if not click.target]
    if not hits:
        return np.zeros(change.shape, bool)
    regions = clean(strong(change, noise), change) if change.max() > noise else np.zeros(change.shape, bool)
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)
    seed = np.zeros(change.shape, bool)
    for hit in hits:
        seed |= _region_at(hit, regions, seed, change, lab)
    features = _features(lab, change, noise)
    if misses:
        seed = _cut(seed, hits, misses, features)
    return _draw_border(seed, hits, misses, features)


def cut_away(
    mask: np.ndarray, picture: np.ndarray, change: np.ndarray, noise: float, clicks: Sequence[Click]
) -> np.ndarray:
    """`mask` (h, w) bool without the parts that were clicked on as no target; the rest of it stays to the pixel.

    The other arguments are those of `segment`. Without a click on the target, its middle counts as one.
    """
    hits = [_place(click, mask.shape) for click in clicks if click.target]
    misses = [_place(click, mask.shape) for click in clicks if not click.target]
    if not any(mask[place] for place in misses):
        return mask
    if not hits:
        depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        away = np.minimum(depth, _distance(misses, mask.shape) / 2)  # in the middle, and not under a click
        hits = [np.unravel_index(int(away.argmax()), mask.shape)]
    return _cut(mask, hits, misses, _features(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB), change, noise))


def _place(click: Click, shape: tuple[int, ...]) -> tuple[int, int]:
    """(row, column) inside the map."""
    return int(np.clip(click.y, 0, shape[0] - 1)), int(np.clip(click.x, 0, shape[1] - 1))


def _length(share: float, shape: tuple[int, ...]) -> int:
    return max(1, round(share * float(np.hypot(*shape))))


def _disk(place: tuple[int, int], radius: int, shape: tuple[int, ...]) -> np.ndarray:
    canvas = np.zeros(shape, np.uint8)
    cv2.circle(canvas, place[::-1], radius, 1, -1)
    return canvas > 0


def _region_at(
    hit: tuple[int, int], regions: np.ndarray, seed: np.ndarray, change: np.ndarray, lab: np.ndarray
) -> np.ndarray:
    """What one click means: the strong region there or close by, else what changes as much, else what looks alike."""
    _, labels = cv2.connectedComponents((regions | seed).astype(np.uint8))
    near = labels * _disk(hit, 1, labels.shape)
    if not near.any() and not seed.any():
        near = labels * _disk(hit, _length(NEAR, labels.shape), labels.shape)
    if near.any():
        found = np.bincount(near[near > 0])
        return labels == found.argmax()
    disk = _disk(hit, _length(DISK, labels.shape), labels.shape)
    level = float(np.median(change[disk]))
    if level > LEAST_CHANGE / 2:
        _, labels = cv2.connectedComponents((change > level / 2).astype(np.uint8))
        return labels == labels[hit]
    flood = np.zeros((lab.shape[0] + 2, lab.shape[1] + 2), np.uint8)
    flags = 4 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    smooth = cv2.bilateralFilter(lab, 7, 20, 5)
    cv2.floodFill(
        smooth,
        flood,
        hit[::-1],
        0,
        (TOLERANCE * 2, TOLERANCE, TOLERANCE),
        (TOLERANCE * 2, TOLERANCE, TOLERANCE),
        flags,
    )
    return (flood[1:-1, 1:-1] > 0) | disk


def _features(lab: np.ndarray, change: np.ndarray, noise: float) -> np.ndarray:
    """(h, w, 3) uint8, in which a target differs from what is beside it: change, lightness and color in one."""
    level = np.log1p(np.minimum(change / noise, CEILING)) / np.log1p(CEILING)
    color = np.clip((lab[..., 1].astype(np.float32) + lab[..., 2] - 256) / 2 + 128, 0, 255)
    features = np.dstack([255 * level, lab[..., 0].astype(np.float32) / 2 + 64, color])
    return np.ascontiguousarray(features.astype(np.uint8))  # as opencv takes it


def _cut(
    seed: np.ndarray, hits: Sequence[tuple[int, int]], misses: Sequence[tuple[int, int]], features: np.ndarray
) -> np.ndarray:
    """The seed without what belongs to the clicks beside the target, which is at most what is nearer to one of them.

    There a watershed finds the edge: on one side the click, on the other all of the seed that is nearer to a hit.
    """
    apart, radius = (_distance(places, seed.shape) for places in (hits, misses)), _length(DISK, seed.shape)
    to_hit, to_miss = apart
    markers = np.zeros(seed.shape, np.int32)
    markers[seed & (to_hit < SURE * to_miss)] = 1
    markers[to_miss <= radius] = 2
    markers[to_hit <= radius] = 1
    parts = cv2.watershed(features, markers)
    return seed & (parts != 2)


def _distance(places: Sequence[tuple[int, int]], shape: tuple[int, ...]) -> np.ndarray:
    """(h, w) float32: of each pixel to the nearest of the places."""
    free = np.ones(shape, np.uint8)
    free[tuple(np.transpose(places))] = 0
    return cv2.distanceTransform(free, cv2.DIST_L2, 5)


def _draw_border(
    seed: np.ndarray, hits: Sequence[tuple[int, int]], misses: Sequence[tuple[int, int]], features: np.ndarray
) -> np.ndarray:
    """The seed with its border where change and colors end, at most `BAND` away; then holes are filled."""
    reach = _length(BAND, seed.shape)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    mask = seed.astype(np.uint8)
    inside, around = cv2.erode(mask, disk, borderValue=1) > 0, cv2.dilate(mask, disk) > 0
    marks = np.where(seed, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    marks[inside], marks[~around] = cv2.GC_FGD, cv2.GC_BGD
    radius = _length(DISK, seed.shape)
    for place in hits:
        marks[_disk(place, radius, seed.shape)] = cv2.GC_FGD
    for place in misses:
        marks[_disk(place, radius, seed.shape)] = cv2.GC_BGD
    if not ((marks == cv2.GC_BGD).any() and (marks == cv2.GC_FGD).any()):
        return seed
    cv2.setRNGSeed(0)  # GrabCut's clusters are drawn; the same clicks shall give the same mask
    models, part = (np.zeros((1, 65)), np.zeros((1, 65))), _surroundings(around, 10 * reach)
    near = np.ascontiguousarray(marks[part])
    if (near == cv2.GC_BGD).any():
        cv2.grabCut(np.ascontiguousarray(features[part]), near, None, *models, ROUNDS, cv2.GC_INIT_WITH_MASK)
        marks[part] = near
    found = ((marks == cv2.GC_FGD) | (marks == cv2.GC_PR_FGD)).astype(np.uint8)
    _, background = cv2.connectedComponents(1 - np.pad(found, 1), connectivity=4)
    filled = (background != background[0, 0])[1:-1, 1:-1]
    for place in misses:  # a hole that somebody clicked on is no mistake
        hole = background[place[0] + 1, place[1] + 1]
        if hole and not found[place]:
            filled &= background[1:-1, 1:-1] != hole
    return filled


def _surroundings(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    """The box around a mask and a margin: GrabCut's time goes with its pixels."""
    spans = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    rows, columns = (slice(max(span[0] - margin, 0), span[-1] + margin + 1) for span in spans)
    return rows, columns
