"""Where masks are kept, and what saving never leaves: two masks, half of one, another's work gone, another folder."""

import errno
import json
import os
import threading
from functools import partial

import numpy as np
import pytest
from helpers.clips import Making
from helpers.photos import scene, write_capture
from PIL import Image

from gift_peft.captures.tree import read_capture
from gift_peft.studio.mask_files import Changed, frame_place, group_place, photo_place, save_mask

SIZE = 60, 80


@pytest.fixture
def raw(tmp_path):
    """A raw tree of a group of two photos without masks, beside a folder that is nobody's business."""
    root = tmp_path / "raw"
    frames = [scene(seed, SIZE) for seed in (0, 1)]
    write_capture(root / "hall", frames, [np.zeros(SIZE, bool)] * 2)
    for mask in (root / "hall" / "masks").iterdir():
        mask.unlink()
    (root / "hall" / "masks").rmdir()
    (tmp_path / "elsewhere").mkdir()
    return root


def box(left=10):
    mask = np.zeros(SIZE, bool)
    mask[10:40, left : left + 30] = True
    return mask


def of_group(raw):
    return partial(group_place, raw / "hall", "train", raw, False)


def of_photo(raw, mask_class=None, photo="0.png"):
    return partial(photo_place, raw / "hall" / photo, raw / "hall", raw, mask_class)


def save(find, mask, raw, version=None):
    return save_mask(find, mask, find().version if version is None else version, raw)


def files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_groups_mask_is_what_the_reader_takes_for_all(raw):
    place = save(of_group(raw), box(), raw)
    assert place.path == raw / "hall" / "mask.png" and np.array_equal(place.read(SIZE[::-1]), box())
    capture = read_capture(raw / "hall", "train", raw)
    assert capture.common.path == place.path and len(capture.images) == 2


def test_a_photos_mask_lies_beside_it(raw):
    place = save(of_photo(raw), box(), raw)
    assert place.path == raw / "hall" / "masks" / "0.png"
    masks = read_capture(raw / "hall", "train", raw).masks
    assert np.array_equal(masks[0].read(SIZE[::-1]), box()) and masks[1] is None


@pytest.mark.parametrize("name", ["mask/0.png", "masks/0.PNG", "MASKS/0.png"])
def test_a_drawn_mask_is_replaced_where_it_lies(raw, name):
    path = raw / "hall" / name
    path.parent.mkdir()
    Image.fromarray(box(0).astype(np.uint8) * 255).save(path, "PNG")
    before = len(files(raw))
    if path.suffix == ".png":
        assert save(of_photo(raw), box(), raw).path == path and len(files(raw)) == before
    else:  # in another case it is read only where nothing is called as the photo is
        save(of_photo(raw), box(), raw)
    assert np.array_equal(read_capture(raw / "hall", "train", raw).masks[0].read(SIZE[::-1]), box())


@pytest.mark.parametrize("facts", ["mask_class: 2", "mask_class: [3, 4]", ""])
def test_it_is_read_by_the_groups_own_class(raw, facts):
    (raw / "hall" / "group.yaml").write_text(facts)
    for find in (of_group(raw), of_photo(raw, read_capture(raw / "hall", "train", raw).facts.get("mask_class"))):
        assert np.array_equal(save(find, box(), raw).read(SIZE[::-1]), box())


@pytest.mark.parametrize("facts", ["mask_class: glass", "mask_class: 999"])
def test_a_class_that_cannot_be_drawn_is_told(raw, facts):
    (raw / "hall" / "group.yaml").write_text(facts)
    before = files(raw)
    with pytest.raises(ValueError, match=r"mask_class[^\n]*255$"):
        save(of_group(raw), box(), raw)
    assert files(raw) == before


def test_a_second_mask_for_all_is_not_made(raw):
    shape = {"label": "a", "points": [[1, 1], [30, 1], [30, 30]], "shape_type": "polygon"}
    labelme = {"shapes": [shape], "imagePath": "mask.png", "imageWidth": 80, "imageHeight": 60}
    (raw / "hall" / "mask.json").write_text(json.dumps(labelme))
    before = files(raw)
    with pytest.raises(ValueError, match=r"mask\.png and mask\.json|mask\.json and mask\.png"):
        save(of_group(raw), box(), raw)
    assert files(raw) == before


def test_one_that_would_not_be_read_is_taken_back(raw):
    """The reader refuses two files that may both be the photo's."""
    (raw / "hall" / "masks").mkdir()
    Image.fromarray(np.zeros(SIZE, np.uint8)).save(raw / "hall" / "masks" / "0.png")
    (raw / "hall" / "masks" / "0.png").rename(raw / "hall" / "masks" / "0.bmp.part")
    (raw / "hall" / "1.jpg").write_bytes((raw / "hall" / "1.png").read_bytes())  # shares the mask of 1.png
    before = files(raw)
    with pytest.raises(ValueError, match=r"1\.png|1\.jpg"):
        save_mask(of_group(raw), box(), "", raw)
    assert files(raw) == before


def test_what_was_changed_meanwhile_is_left_alone(raw):
    version = of_group(raw)().version
    save(of_group(raw), box(), raw)
    mine, theirs = box(30), files(raw)
    with pytest.raises(Changed, match=r"^hall/mask\.png was changed"):
        save(of_group(raw), mine, raw, version)
    assert files(raw) == theirs
    save(of_group(raw), mine, raw, of_group(raw)().version)
    assert np.array_equal(of_group(raw)().read(SIZE[::-1]), mine)


def test_of_many_tabs_that_save_at_once_one_does(raw):
    version, results = of_group(raw)().version, []
    barrier = threading.Barrier(6)

    def tab(left):
        barrier.wait()
        try:
            save(of_group(raw), box(left), raw, version)
            results.append(left)
        except Changed:
            results.append(None)

    tabs = [threading.Thread(target=tab, args=[left]) for left in range(6)]
    [one.start() for one in tabs]
    [one.join() for one in tabs]
    (winner,) = [one for one in results if one is not None]
    assert len(results) == 6 and np.array_equal(of_group(raw)().read(SIZE[::-1]), box(winner))
    assert len(list((raw / "hall").glob("*mask*"))) == 1  # no partial file either


def test_nothing_is_written_out_of_the_folder(raw):
    elsewhere = raw.parent / "elsewhere"
    (raw / "hall" / "masks").symlink_to(elsewhere, target_is_directory=True)
    with pytest.raises(ValueError, match=r"hall/masks/0\.png: its folder is a link out of"):
        save(of_photo(raw), box(), raw)
    assert not files(elsewhere)


def test_a_link_as_mask_is_replaced_and_what_it_led_to_stays(raw):
    other = raw / "kept.png"
    Image.fromarray(np.zeros(SIZE, np.uint8)).save(other)
    before = other.read_bytes()
    (raw / "hall" / "mask.png").symlink_to(other)
    save(of_group(raw), box(), raw)
    assert other.read_bytes() == before and not (raw / "hall" / "mask.png").is_symlink()


def test_a_full_disk_leaves_the_old_mask(raw, monkeypatch):
    save(of_group(raw), box(), raw)
    before = files(raw)

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"mask\.png"):
        save(of_group(raw), box(30), raw)
    assert files(raw) == before


def test_masks_of_a_clip_and_of_its_frames(tmp_path):
    """They lie in RAW; the frames do not."""
    making = Making(SIZE)
    making.hold(scene(0, SIZE).astype(float), 0.4)
    making.write(tmp_path / "raw" / "hall" / "clip.mp4")
    folder, root = tmp_path / "raw" / "hall", tmp_path / "raw"
    place = save_mask(
        lambda: group_place(folder, "train", root, True), box(), group_place(folder, "train", root, True).version, root
    )
    assert place.path == folder / "mask.png" and np.array_equal(place.read(SIZE[::-1]), box())
    frame = tmp_path / "chosen" / "clip_000003.png"
    find = partial(frame_place, frame, folder, root)
    assert find().read(SIZE[::-1]) is None
    assert save_mask(find, box(30), find().version, root).path == folder / "masks" / "clip_000003.png"
    assert np.array_equal(find().read(SIZE[::-1]), box(30))
