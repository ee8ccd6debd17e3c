"""The coach on clips with faults that are known: told before the photo is taken, and silent where nothing is wrong."""

import cv2
import numpy as np
import pytest
from helpers.clips import RATE, Making, pushed, views

from gift_peft.cli import main
from gift_peft.prepare.coach import Coach

SIZE = (240, 320)


def watch(made: Making, mask=None, **options):
    """The advice on each frame."""
    coach = Coach(mask, **options)
    return [coach.see(index, index / RATE, frame[..., ::-1].copy()) for index, frame in enumerate(made.frames)]


def codes(advice) -> set[str]:
    return {item.code for item in advice.warnings}


def told(advices, hold) -> set[str]:
    return set().union(*(codes(advice) for advice in advices[hold[0] : hold[1] + 1]))


def photos(advices, holds) -> list[int]:
    """In which still view each photo was taken."""
    places = [index for index, advice in enumerate(advices) if advice.photo is not None]
    return [next(k for k, (first, last) in enumerate(holds) if first <= place <= last) for place in places]


@pytest.mark.parametrize("known_mask", [True, False])
def test_a_good_series_is_taken_by_itself_without_a_word(known_mask):
    pictures, mask = views(0, SIZE, 4)
    made = Making(SIZE, drift=0.005)
    for before, after in zip(pictures, [*pictures[1:], None], strict=True):
        made.hold(before, 1.2)
        if after is not None:
            made.fade(before, after)
    advices = watch(made, mask if known_mask else None)
    assert photos(advices, made.holds) == [0, 1, 2, 3]
    assert not set().union(*map(codes, advices))
    assert advices[-1].changed > (0.8 if known_mask else 0.8 * mask.mean()) and advices[-1].drift < 0.3


def defocused(picture):
    return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 2.0)


FAULTS = {
    "moved": lambda picture, first: pushed(picture, 3),
    "blurred": lambda picture, first: defocused(picture),
    "over_exposed": lambda picture, first: np.clip(picture * 2.2, 0, 255),
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
    advices = watch(made, mask)
    assert fault in told(advices, made.holds[1])
    assert photos(advices, made.holds) == [0, 2]
    assert not told(advices, made.holds[0])


def test_a_camera_that_stays_moved_begins_a_new_group():
    pictures, mask = views(3, SIZE, 2)
    made = Making(SIZE)
    made.hold(pictures[0], 1.2)
    made.hold(pushed(pictures[0], 5), 4.0)
    made.hold(pushed(pictures[1], 5), 1.5)
    advices = watch(made, mask)
    assert sum(advice.new_group for advice in advices) == 1
    assert photos(advices, made.holds) == [0, 1, 2]


def test_enough_when_moments_show_nothing_new_or_there_are_as_many_as_asked_for():
    pictures, mask = views(4, SIZE, 4)
    made = Making(SIZE)
    for picture in (*pictures, *pictures[:3]):
        made.hold(picture, 1.0)
    advices = watch(made, mask)
    assert photos(advices, made.holds) == [0, 1, 2, 3]
    assert advices[-1].enough and not advices[made.holds[3][1]].enough
    assert any(advice.enough for advice in watch(made, mask, most=2)[: made.holds[1][1] + 1])


def test_a_mask_of_another_size_is_named():
    with pytest.raises(ValueError, match="the mask is 10x10, and the frames are 320x240"):
        Coach(np.ones((10, 10), bool)).see(0, 0.0, np.zeros((*SIZE, 3), np.uint8))


# ---- the verb ----


def capture(*words) -> int:
    with pytest.raises(SystemExit) as leaving:
        main(["capture", *map(str, words)])
    return leaving.value.code


def test_the_verb_writes_a_raw_group_that_prepare_makes(tmp_path, capsys):
    pictures, mask = views(5, SIZE, 3)
    treated = np.where(mask[..., None], 150, pictures[0])
    made = Making(SIZE)
    for picture in (*pictures, treated):
        made.hold(picture, 1.2)
    clip = made.write(tmp_path / "a.mp4")
    cv2.imwrite(str(tmp_path / "m.png"), mask.astype(np.uint8) * 255)
    words = (clip, tmp_path / "raw", "--mask", tmp_path / "m.png", "--reference-at", "00:03.7")
    assert capture(*words, "--group", "door") == 0
    said = capsys.readouterr().out
    names = sorted(path.name for path in (tmp_path / "raw/door").iterdir())
    assert names == ["001.png", "002.png", "003.png", "mask.png", "reference.png"]
    assert f"Next: gift-peft prepare {tmp_path / 'raw'} {tmp_path / 'raw'}-prepared" in said
    with pytest.raises(SystemExit) as leaving:
        main(["prepare", str(tmp_path / "raw"), str(tmp_path / "out")])
    assert leaving.value.code == 0
    assert capture(*words, "--group", "door") == 1
    assert "door: it is there already; name another group" in capsys.readouterr().err
    assert capture(clip, tmp_path / "raw") == 0
    assert (tmp_path / "raw/group_1/001.png").is_file()


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("99", "camera 99: cannot be opened; plug it in"),
        ("nowhere.mp4", "nowhere.mp4: neither a camera's number"),
        ("notes.mp4", "cannot be opened as a video"),
        ("moving.mp4", "no photo was taken in"),
    ],
)
def test_what_gives_no_photo_is_one_line(tmp_path, capsys, monkeypatch, source, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.mp4").write_text("notes")
    made, picture = Making(SIZE), views(6, SIZE, 1)[0][0]
    for step in range(20):
        made.add(pushed(picture, 4.0 * step))
    made.write(tmp_path / "moving.mp4")
    assert capture(source, "raw") == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert message in said[-1] and said[-1].startswith("gift-peft: error:")
    assert not (tmp_path / "raw").exists()
