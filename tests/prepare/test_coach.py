"""The coach on clips with faults that are known: told before the photo is taken, and silent where nothing is wrong."""

import cv2
import numpy as np
import pytest
from helpers.clips import RATE, Making, pushed, views

from gift_peft.prepare.coach import Coach

SIZE = (240, 320)


def watch(made: Making, mask=None, **options):
    """The advice on each frame."""
    coach = Coach(mask, **options)
    return [coach.see(index, index / RATE, frame[..., ::-1].copy()) for index, frame in enumerate(made.frames)]


def codes(advice) -> set[str]:
    return {item.code for item in advice.warnings}


def told(spoken, hold) -> set[str]:
    return set().union(*(codes(advice) for advice in spoken[hold[0] : hold[1] + 1]))


def photos(spoken, holds) -> list[int]:
    """In which still view each photo was taken."""
    places = [index for index, advice in enumerate(spoken) if advice.photo is not None]
    return [next(k for k, (first, last) in enumerate(holds) if first <= place <= last) for place in places]


@pytest.mark.parametrize("known_mask", [True, False])
def test_a_good_series_is_taken_by_itself_without_a_word(known_mask):
    pictures, mask = views(0, SIZE, 4)
    made = Making(SIZE, drift=0.005)
    for before, after in zip(pictures, [*pictures[1:], None], strict=True):
        made.hold(before, 1.2)
        if after is not None:
            made.fade(before, after)
    spoken = watch(made, mask if known_mask else None)
    assert photos(spoken, made.holds) == [0, 1, 2, 3]
    assert not set().union(*map(codes, spoken))
    assert spoken[-1].changed > (0.8 if known_mask else 0.8 * mask.mean()) and spoken[-1].drift < 0.3


def defocused(picture):
    return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 2.0)


FAULTS = {
    "moved": lambda picture, first: pushed(picture, 3),
    "blurred": lambda picture, first: defocused(picture),
    "over_exposed": lambda picture, first: np.clip(picture * 2.5, 0, 255),
    "unchanged": lambda picture, first: first,
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("seed", [1, 2])
def test_a_fault_is_told_and_no_photo_of_it_is_taken(fault, seed):
    pictures, mask = views(seed, SIZE, 3)
    made = Making(SIZE, seed)
    made.hold(pictures[0], 1.2)
    made.cross(pictures[0], (0, 30), 0.5)
    made.hold(FAULTS[fault](pictures[1], pictures[0]), 1.2)
    made.cross(pictures[2], (0, 30), 0.5)
    made.hold(pictures[2], 1.2)
    spoken = watch(made, mask)
    assert fault in told(spoken, made.holds[1])
    assert photos(spoken, made.holds) == [0, 2]
    assert not told(spoken, made.holds[0])


def test_a_camera_that_stays_moved_begins_a_new_group():
    pictures, mask = views(3, SIZE, 2)
    made = Making(SIZE)
    made.hold(pictures[0], 1.2)
    made.hold(pushed(pictures[0], 5), 4.0)
    made.hold(pushed(pictures[1], 5), 1.5)
    coach = Coach(mask)
    spoken = [coach.see(index, index / RATE, frame[..., ::-1].copy()) for index, frame in enumerate(made.frames)]
    assert sum(advice.new_group for advice in spoken) == 1
    assert photos(spoken, made.holds) == [0, 1, 2]
    carried = pushed(mask.astype(np.uint8) * 255, 5) > 127
    assert (carried & coach.mask_here).sum() > 0.95 * (carried | coach.mask_here).sum()


def test_enough_when_changes_show_nothing_new_or_there_are_as_many_as_asked_for():
    pictures, mask = views(4, SIZE, 3)
    made = Making(SIZE)
    shown = (*pictures, *pictures)
    for before, after in zip(shown, [*shown[1:], None], strict=True):
        made.hold(before, 1.4)
        if after is not None:
            made.fade(before, after)
    spoken = watch(made, mask)
    assert photos(spoken, made.holds) == [0, 1, 2]
    assert all("unchanged" in told(spoken, hold) for hold in made.holds[3:])
    assert spoken[-1].enough and not spoken[made.holds[4][1]].enough
    few = watch(made, mask, most=2)
    assert any(advice.enough for advice in few[: made.holds[1][1] + 1]) and photos(few, made.holds) == [0, 1]


def test_somebody_who_passes_is_no_change_at_once_and_a_long_wait_is():
    pictures, mask = views(2, SIZE, 1)
    made = Making(SIZE)
    made.hold(pictures[0], 1.2)
    made.cross(pictures[0], (0, 20), 0.6)
    made.hold(pictures[0], 4.0)
    spoken = watch(made, mask)
    first = made.holds[1][0]
    assert not told(spoken, (first, first + round(0.6 * RATE)))
    assert "unchanged" in told(spoken, made.holds[1]) and photos(spoken, made.holds) == [0]


def test_a_slow_change_of_the_light_is_no_fault_and_a_step_is_one_until_it_lasts():
    pictures, mask = views(6, SIZE, 2)
    made = Making(SIZE, drift=-0.03)
    made.hold(pictures[0], 3.0)
    made.fade(*pictures)
    made.hold(pictures[1], 1.2)
    spoken = watch(made, mask)
    assert not told(spoken, made.holds[1]) and photos(spoken, made.holds) == [0, 1]
    made = Making(SIZE)
    made.hold(pictures[0], 1.2)
    made.hold(0.6 * pictures[1], 4.0)
    spoken = watch(made, mask)
    assert "exposure_changed" in told(spoken, made.holds[1]) and photos(spoken, made.holds) == [0, 1]
    taken = max(index for index, advice in enumerate(spoken) if advice.photo is not None)
    assert taken - made.holds[1][0] > 2 * RATE and not codes(spoken[-1]) & {"exposure_changed"}


def test_white_from_the_beginning_is_told_first():
    pictures, mask = views(7, SIZE, 1)
    made = Making(SIZE)
    made.hold(np.clip(pictures[0] * 4.0, 0, 255), 1.5)
    spoken = watch(made, mask)
    assert "bright" in told(spoken, made.holds[0]) and not photos(spoken, made.holds)


def test_a_person_may_ask_for_a_photo_and_for_the_reference():
    pictures, mask = views(8, SIZE, 1)
    made = Making(SIZE)
    made.hold(pictures[0], 3.0)
    coach, kinds = Coach(mask), []
    for index, frame in enumerate(made.frames):
        if index == 15:
            coach.ask_photo()
        if index == 30:
            coach.ask_reference()
        advice = coach.see(index, index / RATE, frame[..., ::-1].copy())
        kinds += [] if advice.photo is None else [advice.is_reference]
    assert kinds == [False, False, True] and len(coach.group.cells) == 2


def test_a_mask_of_another_size_is_named():
    with pytest.raises(ValueError, match="the mask is 10x10, and the frames are 320x240"):
        Coach(np.ones((10, 10), bool)).see(0, 0.0, np.zeros((*SIZE, 3), np.uint8))


def test_a_target_that_fills_the_picture_says_nothing_of_the_camera():
    made = Making(SIZE)
    for seed in (3, 4):
        made.hold(views(seed, SIZE, 1)[0][0], 1.5)
    spoken = watch(made, np.ones(SIZE, bool))
    assert len(photos(spoken, made.holds)) == 2 and not set().union(*map(codes, spoken))


def test_no_group_begins_where_the_target_is_out_of_the_picture():
    pictures, mask = views(3, SIZE, 1)[0], np.zeros(SIZE, bool)
    mask[80:200, :6] = True
    made = Making(SIZE)
    for push in (0, -12):
        made.hold(pushed(pictures[0], push), 3.5)
    spoken = watch(made, mask)
    assert "moved" in codes(spoken[-1]) and not any(advice.new_group for advice in spoken)
    assert np.isfinite([advice.changed for advice in spoken]).all()


def test_a_reference_of_another_pose_begins_no_group():
    picture, made = views(3, SIZE, 1)[0][0], Making(SIZE)
    for push in (0, 5):
        made.hold(pushed(picture, push), 3.5)
    coach, spoken = Coach(), []
    for index, frame in enumerate(made.frames):
        if index == made.holds[1][0]:
            coach.ask_reference()
        spoken.append(coach.see(index, index / RATE, frame[..., ::-1].copy()))
    assert "moved" in codes(spoken[-1])
    assert not any(advice.new_group or advice.is_reference for advice in spoken)
