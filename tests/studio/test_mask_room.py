"""The Masks room by its requests: what is shown of a group, what is drawn and saved, and what a request cannot do."""

import base64
import io
import shutil
import threading

import cv2
import numpy as np
import pytest
from helpers.clips import Making, views
from helpers.photos import capture, motion
from PIL import Image

from gift_peft.captures.tree import decode_capture, read_capture
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.studio import mask_room
from gift_peft.studio.mask_room import MaskRoom

SIZE = 180, 240


def opaque(uri):
    """(H, W) bool of an overlay that the page shows, which small photos get enlarged."""
    picture = Image.open(io.BytesIO(base64.b64decode(uri.split(",", 1)[1])))
    assert picture.mode == "RGBA" and picture.size == (2 * SIZE[1], 2 * SIZE[0])
    return cv2.resize(np.asarray(picture)[..., 3], SIZE[::-1], interpolation=cv2.INTER_AREA) > 50


def iou(found, mask):
    return (found & mask).sum() / (found | mask).sum()


def click(mask, target=True):
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    y, x = np.unravel_index(depth.argmax(), depth.shape)
    return {"tool": "click", "x": (x + 0.5) / mask.shape[1], "y": (y + 0.5) / mask.shape[0], "target": target}


def take_masks(folder):
    """The true masks of a group, which has none from now on."""
    masks = [np.asarray(Image.open(path)) > 0 for path in sorted((folder / "masks").iterdir())]
    shutil.rmtree(folder / "masks")
    return masks


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """A room with a group that is open, whose camera moved once, and its true masks."""
    place = tmp_path_factory.mktemp("room")
    rng = np.random.default_rng(0)
    folder = capture(place / "raw" / "hall", 11, 4, SIZE, motions=[motion(rng, SIZE, 6.0, 0.3, 0.0)])
    masks, room = take_masks(folder), MaskRoom(place / "raw", place / "own")
    return room, masks, room.open({"group": "train/hall"})


@pytest.fixture
def room(opened):
    """The room and the true masks; what a test saves goes afterwards."""
    room, masks, _ = opened
    files = set((room.root / "hall").iterdir())
    yield room, masks
    for path in set((room.root / "hall").iterdir()) - files:
        shutil.rmtree(path) if path.is_dir() else path.unlink()


@pytest.fixture
def copy(opened, tmp_path):
    """A copy of the raw tree, to be changed, in a room of its own, and the true masks."""
    room, masks, _ = opened
    return MaskRoom(shutil.copytree(room.root, tmp_path / "raw"), tmp_path / "own"), masks


def test_one_click_makes_the_masks_of_all_photos(room, opened):
    """Also of one whose camera had moved: as `prepare` carries it, and as the page has shown it."""
    room, masks = room
    assert [group["state"] for group in room.groups()["groups"]] == ["4 photos, no mask yet"]
    shown = opened[2]
    assert [photo["status"] for photo in shown["photos"]] == ["warped", "identity", "identity", "kept"]
    assert shown["compares"] and not opaque(shown["overlay"]).any() and not shown["there"]
    edits = [click(masks[-1])]
    drawn = room.draw({"group": "train/hall", "edits": edits})
    assert drawn["area"] == pytest.approx(masks[-1].mean(), rel=0.05)
    assert iou(opaque(drawn["overlay"]), masks[-1]) > 0.95
    saved = room.save({"group": "train/hall", "edits": edits, "version": shown["version"]})
    assert saved["saved"] == "hall/mask.png"
    assert room.groups()["groups"][0] == {"name": "train/hall", "state": "4 photos, mask.png", "done": True}
    for index, mask in enumerate(masks):
        alone = room.start({"group": "train/hall", "photo": f"{index}.png"})
        assert iou(opaque(alone["overlay"]), mask) > 0.95 and not alone["there"]
    again = room.open({"group": "train/hall"})  # a reload
    assert again["there"] and iou(opaque(again["overlay"]), masks[-1]) > 0.95
    assert again["version"] == saved["version"]


def test_what_prepare_says_stands_beside_each_photo(copy, tmp_path):
    room, masks = copy
    folder = room.root / "hall"
    shutil.copy(folder / "1.png", folder / "9.png")
    cv2.imwrite(str(folder / "2.png"), np.random.default_rng(0).integers(0, 255, (*SIZE, 3)))
    Image.fromarray(masks[-1].astype(np.uint8) * 255).save(folder / "mask.png")
    shown = room.open({"group": "train/hall"})
    report = prepare_gift_i(room.root, tmp_path / "out")
    told = {photo["name"]: photo for photo in shown["photos"]}
    for frame in report["groups"][0]["frames"]:
        assert told[frame["name"]]["status"] == frame["status"]
        assert told[frame["name"]]["texts"] == [one["text"] for one in (*frame["reasons"], *frame["warnings"])]
    assert told["9.png"]["status"] == told["2.png"]["status"] == "dropped"


def test_a_photos_own_mask_is_drawn_on_it_as_it_was_taken(room):
    room, masks = room
    about = {"group": "train/hall", "photo": "0.png"}
    edits = [click(masks[0])]
    version = room.start(about)["version"]
    assert iou(opaque(room.draw({**about, "edits": edits})["overlay"]), masks[0]) > 0.95
    saved = room.save({**about, "edits": edits, "version": version})
    assert saved["saved"] == "hall/masks/0.png"
    cards = {photo["name"]: photo for photo in room.open({"group": "train/hall"})["photos"]}
    assert [name for name, card in cards.items() if card["own"]] == ["0.png"]
    assert iou(opaque(cards["0.png"]["overlay"]), masks[-1]) > 0.9  # in place with the others
    plain, own = (room.photo({**about, "own": own})["picture"] for own in (False, True))
    assert plain != own


def test_the_groups_mask_says_which_photos_keep_their_own(room):
    room, masks = room
    about = {"group": "train/hall", "edits": [click(masks[-1])]}
    own = {**about, "photo": "3.png"}
    assert "saved" in room.save({**own, "version": room.start(own)["version"]})
    told = room.save({**about, "version": room.start(about)["version"]})["saved"]
    assert told == "hall/mask.png (1 photo has a mask of their own, which comes first)"
    decoded = decode_capture(read_capture(room.root / "hall", "train", room.root))
    assert [mask is None for mask in decoded.masks] == [True, True, True, False]


def test_a_mask_in_which_nothing_changes_is_doubted(room):
    room, masks = room
    about = {"group": "train/hall"}
    assert not room.draw({**about, "edits": [click(masks[-1])]})["still"]
    beside = {"tool": "brush", "points": [[0.02, 0.02], [0.02, 0.98]], "size": 0.03, "target": True}
    assert not masks[-1][:, :10].any() and room.draw({**about, "edits": [beside]})["still"]
    assert not room.draw({**about, "edits": [{"tool": "clear"}]})["still"]


def test_two_tabs_do_not_overwrite_each_other(room):
    room, masks = room
    group = {"group": "train/hall"}
    version = room.start(group)["version"]
    first, second = (
        [click(masks[-1])],
        [click(masks[-1]), {"tool": "brush", "points": [[0.1, 0.1]], "size": 0.1, "target": True}],
    )
    assert "saved" in room.save({**group, "edits": first, "version": version})
    kept = (room.root / "hall" / "mask.png").read_bytes()
    refused = room.save({**group, "edits": second, "version": version})
    assert refused["conflict"] and "changed since" in refused["error"]
    assert (room.root / "hall" / "mask.png").read_bytes() == kept
    assert "saved" in room.save({**group, "edits": second, "version": refused["version"]})  # asked for


def test_an_empty_mask_is_of_a_photo_only(room):
    room, _ = room
    with pytest.raises(ValueError, match="nothing is drawn"):
        room.save(
            {
                "group": "train/hall",
                "edits": [{"tool": "clear"}],
                "version": room.start({"group": "train/hall"})["version"],
            }
        )
    about = {"group": "train/hall", "photo": "1.png", "edits": [{"tool": "clear"}]}
    assert "empty-masks allow" in room.save({**about, "version": room.start(about)["version"]})["saved"]


def test_an_unreadable_mask_is_told_and_may_be_drawn_anew(room):
    room, masks = room
    (room.root / "hall" / "mask.png").write_bytes(b"no picture")
    shown = room.start({"group": "train/hall"})
    assert "mask.png" in shown["problem"] and shown["there"]
    saved = room.save({"group": "train/hall", "edits": [click(masks[-1])], "version": shown["version"]})
    assert saved["saved"] == "hall/mask.png" and room.start({"group": "train/hall"})["problem"] is None


CRAFTED = ["../elsewhere", "/etc", "train/../..", "train/hall/..", "train/hall/../../elsewhere", "..\\x", "", "\0"]
CRAFTED += [None, 3, ["train/hall"], {"group": "train/hall"}, "train/none"]


def test_a_request_names_nothing_but_what_is_listed(room):
    room, masks = room
    outside = room.root.parent
    (outside / "elsewhere").mkdir()
    before = {path for path in outside.rglob("*") if not path.is_relative_to(room.temporary)}
    more = {"edits": [click(masks[-1])], "version": ""}
    for name in CRAFTED:
        for method in (room.open, room.photo, room.start, room.draw, room.save):
            with pytest.raises(ValueError, match="there is no group"):
                method({"group": name, "photo": "0.png", **more})
        assert room.progress({"group": name}) == {"said": ""}
        for method in (room.photo, room.start, room.draw, room.save):
            if name is not None:  # None is the whole group's
                with pytest.raises(ValueError, match="there is no photo"):
                    method({"group": "train/hall", "photo": name, **more})
    assert {path for path in outside.rglob("*") if not path.is_relative_to(room.temporary)} == before


def test_links_out_of_the_folder_are_not_followed(copy, tmp_path):
    room, _ = copy
    secret = capture(tmp_path / "secret", 1, 2, SIZE)
    (room.root / "linked").symlink_to(secret, target_is_directory=True)
    with pytest.raises(ValueError, match="a link that leads out of"):
        room.open({"group": "train/linked"})
    (room.root / "hall" / "5.png").symlink_to(secret / "0.png")
    with pytest.raises(ValueError, match=r"5\.png: a link that leads out of"):
        room.open({"group": "train/hall"})
    states = {group["name"]: group["state"] for group in room.groups()["groups"]}
    assert "a link that leads out of" in states["train/linked"]


def test_photos_that_cannot_be_shown_are_told(copy):
    room, _ = copy
    Image.new("RGB", (100, 100)).save(room.root / "hall" / "4.png")
    with pytest.raises(ValueError, match=r"4\.png: 100x100, and the first photo is 240x180"):
        room.open({"group": "train/hall"})
    (room.root / "hall" / "4.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"4\.png: not a readable image"):
        room.open({"group": "train/hall"})


def test_a_clip_gets_its_mask_beside_it(tmp_path):
    pictures, mask = views(4, SIZE, 3)
    making = Making(SIZE)
    for picture in pictures:
        making.hold(picture.astype(float), 1.0)
    making.write(tmp_path / "raw" / "hall" / "clip.mp4")
    room = MaskRoom(tmp_path / "raw", tmp_path / "own")
    assert room.groups()["groups"] == [{"name": "train/hall", "state": "a clip, no mask yet", "done": False}]
    shown = room.open({"group": "train/hall"})
    assert len(shown["photos"]) == 3 and all(photo["name"].startswith("clip_") for photo in shown["photos"])
    saved = room.save({"group": "train/hall", "edits": [click(mask)], "version": shown["version"]})
    assert saved["saved"] == "hall/mask.png"
    found = np.asarray(Image.open(tmp_path / "raw" / "hall" / "mask.png")) > 0
    assert iou(found, mask) > 0.95
    assert room.open({"group": "train/hall"})["there"]  # its photos are chosen anew, by what changes in the mask
    report = prepare_gift_i(tmp_path / "raw", tmp_path / "out")
    assert report["groups"][0]["status"] == "kept"
    assert sorted(path.name for path in (tmp_path / "raw" / "hall").iterdir()) == ["clip.mp4", "mask.png"]


def test_progress_is_told_while_a_group_is_opened(room, monkeypatch):
    room, _ = room
    waits, goes = threading.Event(), threading.Event()
    view = room._views["train/hall"]

    def slow(folder, split, root, temporary, method, say):
        say(lambda: "comparing the photos (1 of 4)")
        waits.set()
        goes.wait(20)
        return view

    monkeypatch.setattr("gift_peft.studio.mask_room.look_at", slow)
    opening = threading.Thread(target=room.open, args=[{"group": "train/hall"}])
    opening.start()
    waits.wait(20)
    assert room.progress({"group": "train/hall"}) == {"said": "comparing the photos (1 of 4)"}
    goes.set()
    opening.join()
    assert room.progress({"group": "train/hall"}) == {"said": ""}


def test_a_group_that_goes_while_groups_are_listed_is_a_line(copy, monkeypatch):
    room, _ = copy
    shutil.copytree(room.root / "hall", room.root / "later")
    found = mask_room.find_clip_group

    def lose(folder, root):
        shutil.rmtree(room.root / "later", ignore_errors=True)
        return found(folder, root)

    monkeypatch.setattr(mask_room, "find_clip_group", lose)
    assert [group["name"] for group in room.groups()["groups"]] == ["train/hall", "train/later"]


def test_a_reference_of_another_size_is_named(tmp_path):
    folder = tmp_path / "raw" / "hall"
    folder.mkdir(parents=True)
    for name, size in (("1.png", (60, 40)), ("reference.png", (50, 40))):
        Image.new("RGB", size, (90, 120, 30)).save(folder / name)
    with pytest.raises(ValueError, match=r"reference\.png: 50x40, and the photos are 60x40"):
        MaskRoom(tmp_path / "raw", tmp_path / "own").open({"group": "validation/hall"})


def test_unsaved_edits_of_one_folder_are_not_those_of_another(copy, opened):
    """The page keeps them by the place of the mask, and groups of two folders may have one name."""
    about = {"group": "train/hall"}
    place, photo = (copy[0].start({**about, **more})["place"] for more in ({}, {"photo": "0.png"}))
    assert len({place, photo, opened[0].start(about)["place"]}) == 3
