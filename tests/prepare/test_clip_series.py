"""Many synthesized clips of rendered groups and real photos: how much is found, and what is not.

`pytest -m slow -s tests/prepare/test_clip_series.py` prints the figures; the seeds are the numbers of the clips.
"""

import time

import numpy as np
import pytest
from helpers.clip_stills import distinct, real_stills, rendered_stills
from helpers.clips import Making, pushed
from helpers.nudged_clips import judge, make_nudged_clip

from gift_peft.prepare.clip_frames import choose_frames

SIZE = (270, 480)  # height, width
CLIPS = 40
NUDGED, MIRRORS = range(6000, 6060), range(6100, 6124)  # seeds; the method was made with others

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def stills() -> list[tuple[list[np.ndarray], np.ndarray]]:
    return rendered_stills(SIZE) + real_stills(SIZE)


def make(seed: int, stills) -> tuple[Making, np.ndarray, int | None]:
    """A clip, its mask, and the number of the first view after the push of the tripod."""
    rng = np.random.default_rng(seed)
    pictures, mask = stills[seed % len(stills)]
    shown = distinct(pictures, mask, rng, int(rng.integers(3, 7)))
    push = int(rng.integers(1, len(shown))) if seed % 2 and len(shown) > 1 else None
    made = Making(SIZE, seed, noise=float(rng.uniform(1, 5)), drift=float(rng.uniform(-0.015, 0.015)))
    free = [row for row in range(0, SIZE[0] - 40, 10) if not mask[row : row + 40].any()]
    by = float(rng.uniform(3, 12))
    shown = [pushed(picture, by) if push is not None and k >= push else picture for k, picture in enumerate(shown)]
    for number, picture in enumerate(shown):
        made.hold(picture, float(rng.uniform(0.8, 1.6)))
        if free and rng.random() < 0.6:
            row = free[int(rng.integers(len(free)))]
            made.cross(picture, (row, row + 40), float(rng.uniform(0.5, 1.2)))
            made.hold(picture, 0.7)
            made.holds[-2:] = [(made.holds[-2][0], made.holds[-1][1])]
        if number + 1 < len(shown) and number + 1 != push:
            made.fade(picture, shown[number + 1], float(rng.uniform(0.4, 1.2)))
    return made, mask, push


def test_forty_clips(stills, tmp_path):
    views = found = busy = chosen = pushes = split = frames = 0
    spent = 0.0
    for seed in range(CLIPS):
        made, mask, push = make(seed, stills)
        path = made.write(tmp_path / f"{seed}.{'mp4' if seed % 3 else 'avi'}", "mp4v" if seed % 3 else "MJPG")
        start = time.process_time()
        choice = choose_frames([path], (lambda size, mask=mask: mask) if seed % 4 else None)
        spent += time.process_time() - start
        frames += len(made.frames)
        indices = [[frame.index for frame in pose.frames] for pose in choice.poses]
        flat = [index for pose in indices for index in pose]
        shown = [any(first <= index <= last for index in flat) for first, last in made.holds]
        mixed = [index for index in flat if any(first <= index <= last for first, last in made.busy)]
        views, found = views + len(shown), found + sum(shown)
        chosen, busy = chosen + len(flat), busy + len(mixed)
        if push is None:
            right = len(indices) == 1
        else:
            border = made.holds[push][0]
            right = len(indices) == 2 and max(indices[0]) < border <= min(indices[1])
        pushes, split = pushes + 1, split + right
        if mixed or not all(shown) or not right:
            print(f"clip {seed}: views {shown}, mixed {mixed}, groups {indices}, push {push}, {choice.notes}")
    print(
        f"{found} of {views} views found; {busy} of {chosen} frames mixed or crossed; {split} of {pushes} grouped "
        f"rightly; {frames / spent:.0f} frames a second at {SIZE[1]}x{SIZE[0]}"
    )
    assert found >= 0.95 * views and busy == 0
    assert split == pushes


def test_a_nudge_of_the_camera_ends_the_group_and_nothing_else_does(tmp_path):
    large = (720, 1280)
    kinds = [found for found in (rendered_stills(large), real_stills(large)) if found]
    clips = right = views = found = busy = chosen = still = false = frames = 0
    spent = 0.0
    for seed in (*NUDGED, *MIRRORS):
        clip = make_nudged_clip(seed, kinds[seed // 6 % len(kinds)], tmp_path, seed in MIRRORS)
        start = time.process_time()
        choice = choose_frames([clip.path], (lambda size, mask=clip.mask: mask) if seed % 4 else None)
        spent += time.process_time() - start
        clip.path.unlink()
        groups = [[frame.index for frame in pose.frames] for pose in choice.poses]
        split, shown, mixed = judge(clip, groups)
        clips, right, frames = clips + 1, right + split, frames + clip.frames
        views, found = views + len(clip.views), found + shown
        busy, chosen = busy + mixed, chosen + sum(map(len, groups))
        still, false = still + (clip.poses == 1), false + (clip.poses == 1 and not split)
        if not split or mixed or shown < len(clip.views):
            print(f"clip {seed}: {shown} of {clip.views}, mixed {mixed}, {groups}, {choice.notes}; {clip.made}")
    print(
        f"{right} of {clips} clips grouped rightly, {false} of {still} without a nudge split; {found} of {views} "
        f"views found; {busy} of {chosen} frames mixed or crossed; {frames / spent:.0f} frames a second"
    )
    assert right == clips and busy == 0 and found >= 0.95 * views
