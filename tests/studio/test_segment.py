"""Click to segment, on groups whose targets are known."""

import cv2
import numpy as np
import pytest
from helpers.photos import scene, target, with_content

from gift_peft.prepare.proposals import change_map
from gift_peft.studio.segment import Click, cut_away, segment


def group(seed, size=(240, 320), count=6):
    """(median picture, change map, noise, target) of a group of a still camera."""
    rng = np.random.default_rng(seed)
    picture, mask = scene(seed, size), target(seed, size)
    frames = [with_content(picture, mask, rng, noise=2.0) for _ in range(count)]
    return np.median(np.stack(frames), axis=0).astype(np.uint8), *change_map(frames, 320), mask


def iou(found, mask):
    return (found & mask).sum() / (found | mask).sum()


def middle(mask, hit=True):
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    y, x = np.unravel_index(depth.argmax(), depth.shape)
    return Click(x + 0.5, y + 0.5, hit)


@pytest.mark.parametrize("seed", range(6))
def test_one_click_finds_the_target(seed):
    picture, change, noise, mask = group(seed)
    found = segment(picture, change, noise, [middle(mask)])
    assert iou(found, mask) > 0.95
    assert np.array_equal(found, segment(picture, change, noise, [middle(mask)]))  # the same again


def test_without_a_click_on_the_target_nothing_is_found():
    picture, change, noise, mask = group(0)
    assert not segment(picture, change, noise, []).any()
    assert not segment(picture, change, noise, [middle(mask, hit=False)]).any()


def two_regions():
    """A group in which two things change that touch, with an edge between them in every photo."""
    rng = np.random.default_rng(5)
    left, right = np.zeros((200, 300), bool), np.zeros((200, 300), bool)
    left[50:150, 60:160], right[50:150, 160:240] = True, True
    frames = []
    for _ in range(6):
        frame = np.full((200, 300, 3), 120.0)
        frame[left] = rng.uniform(120, 250, 3)
        frame[right] = rng.uniform(0, 110, 3)
        frames.append(np.clip(frame + rng.normal(0, 2, frame.shape), 0, 255).astype(np.uint8))
    return np.median(np.stack(frames), axis=0).astype(np.uint8), *change_map(frames, 300), left, right


def test_a_click_beside_the_target_cuts_the_other_thing_off():
    picture, change, noise, left, right = two_regions()
    both = segment(picture, change, noise, [middle(left)])
    assert iou(both, left | right) > 0.95
    assert iou(segment(picture, change, noise, [middle(left), middle(right, hit=False)]), left) > 0.95
    assert iou(segment(picture, change, noise, [middle(right), middle(left, hit=False)]), right) > 0.95


def test_what_is_cut_away_leaves_the_rest_to_the_pixel():
    picture, change, noise, left, right = two_regions()
    drawn = left | right
    drawn[20:30, 200:210] = True  # by hand, where nothing changes
    kept = cut_away(drawn, picture, change, noise, [middle(right, hit=False)])
    assert np.array_equal(kept & ~right, drawn & ~right | (kept & ~right)) and not (kept & ~drawn).any()
    assert (kept & left).sum() > 0.98 * left.sum() and (kept & right).sum() < 0.05 * right.sum()
    assert kept[20:30, 200:210].all()
    beside = cut_away(drawn, picture, change, noise, [Click(5, 5, False)])
    assert beside is drawn  # nothing there to cut


def test_where_nothing_can_be_compared_a_click_goes_by_color():
    picture = np.full((200, 300, 3), (90, 110, 130), np.uint8)
    mask = np.zeros((200, 300), np.uint8)
    cv2.circle(mask, (140, 90), 50, 1, -1)
    picture[mask > 0] = (190, 180, 160)
    noisy = np.clip(picture + np.random.default_rng(0).normal(0, 3, picture.shape), 0, 255).astype(np.uint8)
    found = segment(noisy, np.zeros((200, 300), np.float32), 1.0, [Click(140, 90)])
    assert iou(found, mask > 0) > 0.95


@pytest.mark.parametrize("place", [(-5, -5), (0, 0), (319.9, 239.9), (1e6, 3)])
def test_clicks_at_and_beyond_the_border_are_taken_to_it(place):
    picture, change, noise, _ = group(1)
    assert segment(picture, change, noise, [Click(*place)]).shape == change.shape
    assert segment(picture, change, noise, [Click(160, 120), Click(*place, False)]).shape == change.shape
