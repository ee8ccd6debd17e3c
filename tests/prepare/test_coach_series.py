"""The coach on many clips with one fault each, or none: how many are told in time, and how much is said in vain.

`pytest -m slow -s tests/prepare/test_coach_series.py` prints the figures; the seeds are the numbers of the clips.
"""

import time
from collections import Counter

import pytest
from helpers.clip_stills import real_stills, rendered_stills
from helpers.fault_clips import FAULTS, FaultClip, make_fault_clip

from gift_peft.captures.clip import Clip
from gift_peft.prepare.coach import Coach

SEEDS = range(3000, 3040)
TELLS = {"over_exposed": {"over_exposed", "exposure_changed"}}  # a dark scene that becomes bright has nothing white
LATE = 0.3  # seconds after a fault in which it may still be said, and a moment still be taken

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def stills():
    size = (720, 1280)
    return [found for found in (rendered_stills(size), real_stills(size)) if found]


def watch(clip: FaultClip, mask):
    """(seconds, advice) of each frame, and the processor's seconds."""
    coach, start = Coach(mask), time.process_time()
    spoken = [
        (frame.seconds, coach.see(frame.index, frame.seconds, frame.pixels)) for frame in Clip(clip.path).frames()
    ]
    return spoken, time.process_time() - start


def judge(clip: FaultClip, spoken) -> tuple[bool, int, int]:
    """Whether the fault was told, and no photo taken of it; views with a photo; good frames with a warning."""
    photos = [at for at, advice in spoken if advice.photo is not None]
    told = True
    if clip.fault:
        first, last = clip.spoiled
        moved_on = min((at for at, advice in spoken if advice.new_group), default=last)
        codes = TELLS.get(clip.fault, {clip.fault})
        told = any(first - 0.7 <= at <= last + LATE and advice.codes & codes for at, advice in spoken)
        told &= not any(first <= at <= min(last, moved_on) for at in photos)
    found = sum(any(start <= at <= end + LATE for at in photos) for start, end in clip.views)
    alarms = 0
    for start, end in clip.good:
        # The same view again after somebody has passed: that nothing new shows is true.
        true = set() if (start, end) in clip.views else {"unchanged"}
        alarms += sum(bool(advice.codes - true) for at, advice in spoken if start <= at < end)
    return told, found, alarms


def test_faults_are_told_before_the_photo_and_little_else_is(stills, tmp_path):
    told, wanted = Counter(), Counter()
    found = views = alarms = good = frames = 0
    spent = 0.0
    for number, seed in enumerate(SEEDS):
        fault = (*FAULTS, None)[number % (len(FAULTS) + 1)]
        clip = make_fault_clip(seed, stills[number // 5 % len(stills)], tmp_path, fault)
        spoken, seconds = watch(clip, clip.mask if number // 10 % 2 == 0 else None)
        right, taken, wrong = judge(clip, spoken)
        clip.path.unlink()
        wanted[fault] += 1
        told[fault] += right
        found, views = found + taken, views + len(clip.views)
        alarms += wrong
        good += sum(start <= at < end for at, _ in spoken for start, end in clip.good)
        frames, spent = frames + len(spoken), spent + seconds
        if not right or taken < len(clip.views) or wrong:
            print(
                f"clip {seed}: {fault} told {right}, {taken} of {len(clip.views)} views, {wrong} alarms; {clip.made}"
            )
    faults = sum(told[fault] for fault in FAULTS), sum(wanted[fault] for fault in FAULTS)
    print(
        f"{faults[0]} of {faults[1]} faults told before a photo {dict(told)}; warnings in {alarms} of {good} good "
        f"frames; {found} of {views} views taken; {frames / spent:.0f} frames a second a core"
    )
    assert faults[0] >= 0.95 * faults[1] and alarms < 0.02 * good and found >= 0.95 * views
