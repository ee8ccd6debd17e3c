"""Frames of clips: each observation once, none while something moves, groups that end where the camera was pushed."""

import re

import cv2
import numpy as np
import pytest
from helpers.clips import Making, pushed, views
from helpers.photos import scene

from gift_peft.captures.clip import TimeInClip
from gift_peft.prepare.clip_frames import choose_frames, read_frames

SIZE = (240, 320)


def within(index: int, hold: tuple[int, int]) -> bool:
    return hold[0] <= index <= hold[1]


def held(frames, holds) -> list[int]:
    """Which still view each frame shows; -1 for a frame between them."""
    return [next((k for k, hold in enumerate(holds) if within(frame.index, hold)), -1) for frame in frames]


@pytest.mark.parametrize("known_mask", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_each_observation_is_found_once_and_no_mixed_frame(tmp_path, seed, known_mask):
    pictures, mask = views(seed, SIZE, 4)
    made = Making(SIZE, seed, drift=0.02)
    for before, after in zip(pictures, [*pictures[1:], None], strict=True):
        made.hold(before)
        if after is not None:
            made.fade(before, after)
    choice = choose_frames([made.write(tmp_path / "a.mp4")], (lambda size: mask) if known_mask else None)
    assert choice.size == SIZE[::-1] and len(choice.poses) == 1 and choice.notes == []
    assert held(choice.poses[0].frames, made.holds) == [0, 1, 2, 3]


@pytest.mark.parametrize("known_mask", [True, False])
def test_nothing_is_chosen_while_somebody_crosses(tmp_path, known_mask):
    pictures, mask = views(2, SIZE, 2)
    free = [row for row in range(0, SIZE[0] - 20, 4) if not mask[row : row + 20].any()]
    made = Making(SIZE)
    for picture in pictures:
        made.hold(picture, 0.8)
        made.cross(picture, (free[0], free[0] + 20))
        made.hold(picture, 0.8)
    choice = choose_frames([made.write(tmp_path / "a.mp4")], (lambda size: mask) if known_mask else None)
    assert [place // 2 for place in held(choice.poses[0].frames, made.holds)] == [0, 1]


def test_somebody_who_waits_outside_the_target_is_left_out(tmp_path):
    pictures, mask = views(2, SIZE, 4)
    free = [row for row in range(0, SIZE[0] - 24, 4) if not mask[row : row + 24].any()]
    made = Making(SIZE)
    for index, picture in enumerate(pictures):
        if index == 2:
            picture = picture.copy()
            picture[free[0] : free[0] + 24, 30:60] = (230, 20, 20)
        made.hold(picture)
        made.busy.append((len(made.frames), len(made.frames)))
    choice = choose_frames([made.write(tmp_path / "a.mp4")], lambda size: mask)
    assert held(choice.poses[0].frames, made.holds) == [0, 1, 3]
    assert "something stands outside the target" in choice.notes[0]


@pytest.mark.parametrize("known_mask", [True, False])
@pytest.mark.parametrize("pixels", [3, 12])
def test_a_push_of_the_camera_begins_a_new_group(tmp_path, pixels, known_mask):
    pictures, mask = views(3, SIZE, 4)
    made = Making(SIZE)
    for index, picture in enumerate(pictures):
        made.hold(picture if index < 2 else pushed(picture, pixels))
    choice = choose_frames([made.write(tmp_path / "a.mp4")], (lambda size: mask) if known_mask else None)
    assert [held(pose.frames, made.holds) for pose in choice.poses] == [[0, 1], [2, 3]]
    expected = [0.8 * pixels, 0.6 * pixels]
    assert np.allclose(choice.poses[1].matrix[:2, 2], expected, atol=0.6)
    assert "the camera was moved" in choice.notes[0]


@pytest.mark.parametrize("cut_by_border", [False, True])
def test_after_a_push_the_target_is_looked_for_where_it_then_is(tmp_path, cut_by_border):
    pictures, mask = views(3, SIZE, 2)
    if cut_by_border:  # pushed into the picture, it goes on where the first pose did not look
        mask = np.zeros(SIZE, bool)
        mask[60:180, :120] = True
        pictures = [np.where(mask[..., None], scene(70 + k, SIZE), pictures[0]) for k in range(2)]
    made = Making(SIZE)
    for picture in pictures:
        made.hold(picture)
    usual, other = (pushed(picture, 20) for picture in pictures)
    for picture in (usual, usual, usual, other):
        made.hold(picture)
        made.cross(picture, (0, 30), 0.5)
    choice = choose_frames([made.write(tmp_path / "a.mp4")], lambda size: mask)
    first, second = (held(pose.frames, made.holds) for pose in choice.poses)
    assert first == [0, 1] and len(second) == 2 and second[0] in (2, 3, 4) and second[1] == 5
    assert len(choice.notes) == 1


def test_a_short_rest_between_two_pushes_is_a_pose_and_a_slow_pass_is_none(tmp_path):
    pictures, mask = views(3, SIZE, 4)
    made = Making(SIZE, noise=1.0)
    for pixels, seconds in ((0, 1.2), (6, 0.55), (12, 1.2)):
        made.hold(pushed(pictures[0], pixels), seconds)
    choice = choose_frames([made.write(tmp_path / "a.mp4")], lambda size: mask)
    assert [held(pose.frames, made.holds) for pose in choice.poses] == [[0], [1], [2]]
    soft = cv2.GaussianBlur(pictures[0], (0, 0), 6.0).astype(np.float32) * 0.6 + 50
    passing = Making(SIZE, noise=0.5)
    passing.hold(soft, 1.2)
    for frame in range(8):
        passing.add(pushed(soft, 8 + 0.2 * frame))
    passing.hold(pushed(soft, 20), 1.2)
    choice = choose_frames([passing.write(tmp_path / "b.avi", "MJPG")], lambda size: mask)
    assert [held(pose.frames, passing.holds) for pose in choice.poses] == [[0], [1]]
    assert "left out: a moment at" in choice.notes[0] and "alone in its pose" in choice.notes[0]


def test_drifting_light_is_no_new_observation_and_no_motion(tmp_path):
    pictures, _ = views(4, SIZE, 1)
    made = Making(SIZE, drift=-0.05)
    made.hold(pictures[0], 4.0)
    made.cross(pictures[0], (0, 10))
    made.hold(pictures[0], 2.0)
    choice = choose_frames([made.write(tmp_path / "a.mp4")])
    assert len(choice.poses) == 1 and len(choice.poses[0].frames) == 1


def test_what_the_drifting_light_clips_stands_not_outside_the_target(tmp_path):
    pictures, mask = views(2, SIZE, 4)
    made = Making(SIZE, noise=1.0, drift=0.03)
    for picture in pictures:
        lamp = np.where(mask[..., None], picture, np.clip(0.8 * picture, 0, 200))
        lamp[:60, :80] = np.where(mask[:60, :80, None], lamp[:60, :80], 225)
        made.hold(lamp, 2.0)
    choice = choose_frames([made.write(tmp_path / "a.mp4")], lambda size: mask)
    assert held(choice.poses[0].frames, made.holds) == [0, 1, 2, 3] and choice.notes == []


def test_the_most_different_are_taken_where_there_are_many(tmp_path):
    pictures, mask = views(5, SIZE, 5)
    nearly = np.where(mask[..., None], 0.9 * pictures[0] + 0.1 * pictures[1], pictures[0])
    made = Making(SIZE, noise=1.0)
    for picture in (pictures[0], nearly, *pictures[1:3]):
        made.hold(picture)
    choice = choose_frames([made.write(tmp_path / "a.mp4")], lambda size: mask, most=3)
    found = held(choice.poses[0].frames, made.holds)
    assert len({min(place, 1) if place < 2 else place for place in found} & {2, 3}) == 2 and len(found) == 3


def test_the_reference_is_the_moment_that_is_stated_and_no_observation(tmp_path):
    pictures, mask = views(6, SIZE, 2)
    treated = np.where(mask[..., None], 150, pictures[0])
    made = Making(SIZE)
    for picture in (*pictures, treated):
        made.hold(picture)
    path = made.write(tmp_path / "a.mp4")
    choice = choose_frames([path], lambda size: mask, reference=TimeInClip(2.5))
    pose = choice.poses[0]
    assert held(pose.frames, made.holds) == [0, 1] and held([pose.reference], made.holds) == [2]
    with pytest.raises(ValueError, match=r"a\.mp4: it is 2\.9 s long, and the reference is said to be at 99 s"):
        choose_frames([path], reference=TimeInClip(99))
    with pytest.raises(ValueError, match=r"names b\.mp4"):
        choose_frames([path], reference=TimeInClip(1, "b.mp4"))


def test_several_clips_are_one_scene_of_one_size(tmp_path):
    pictures, mask = views(7, SIZE, 2)
    paths = []
    for index, picture in enumerate(pictures):
        made = Making(SIZE, seed=index)
        made.hold(picture)
        paths.append(made.write(tmp_path / f"{index}.mp4"))
    choice = choose_frames(paths, lambda size: mask)
    assert [frame.clip for frame in choice.poses[0].frames] == [0, 1]
    read = list(read_frames(paths, choice.poses[0].frames))
    for frame, pixels in read:
        inside = pixels[..., ::-1][mask].astype(float)
        assert np.abs(inside - pictures[frame.clip][mask]).mean() < 15
    other = Making((120, 160))
    other.hold(views(8, (120, 160), 1)[0][0])
    paths.append(other.write(tmp_path / "3.mp4"))
    with pytest.raises(ValueError, match=r"3\.mp4: frames of 160x120, and 0\.mp4 begins with 320x240"):
        choose_frames(paths)


def test_a_damaged_tail_is_told_and_what_came_before_is_used(tmp_path):
    pictures, mask = views(10, SIZE, 4)
    made = Making(SIZE)
    for picture in pictures:
        made.hold(picture)
    path = made.write(tmp_path / "a.avi", "MJPG")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    choice = choose_frames([path], lambda size: mask)
    assert held(choice.poses[0].frames, made.holds) == [0, 1]
    assert re.match(r"a\.avi is damaged: \d+ of 60 frames could be read", choice.notes[0])


def test_a_clip_without_a_still_moment_says_so(tmp_path):
    pictures, _ = views(9, SIZE, 1)
    made = Making(SIZE)
    for step in range(30):
        made.add(pushed(pictures[0], 3.0 * step))
    path = made.write(tmp_path / "a.mp4")
    with pytest.raises(ValueError, match=r"a\.mp4: no still moment in 1\.9 s; hold camera and scene still"):
        choose_frames([path])
