"""The Targets room: what `proxies --target surface` left is shown as it is, and nothing else can be asked for."""

import re
import shutil

import pytest
import torch
from helpers.tiny import SIZE, write_base, write_raw_tree

from gift_peft.dataset.proxies import SurfaceSettings
from gift_peft.studio.target_room import TargetRoom
from gift_peft.training.teacher import make_proxies


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A dataset with surface targets of two bases."""
    folder = tmp_path_factory.mktemp("targets")
    tree = write_raw_tree(folder / "data", train=(2,), validation=(2,))
    for seed in (0, 1):
        base = write_base(folder / f"base{seed}", seed)
        make_proxies(base, tree, size=SIZE, surface=SurfaceSettings(fills=0))
    return tree


@pytest.fixture
def tree(made, tmp_path, fresh_cache):
    return shutil.copytree(made, tmp_path / "data")


def test_every_set_group_and_photo_is_shown(tree):
    room = TargetRoom(tree)
    size = f"{SIZE[0]}x{SIZE[1]}"
    assert [*room.sets] == [f"base0 at {size}", f"base1 at {size}"]
    shown = {}
    for name in room.sets:
        assert room.groups(name) == ["train/scene_0", "validation/scene_100"]
        for group in room.groups(name):
            assert room.photos(name, group) == ["0.png", "1.png"]
            for photo in room.photos(name, group):
                text = shown[name, group, photo] = room.show(name, group, photo)
                captions = [photo, "the base", "surface target"]
                captions += ["treated reference"] if group.startswith("val") else []
                assert re.findall("<figcaption>([^<]*)", text) == [*captions, "their difference"]
                assert text.startswith(f"<h2>{group.split('/')[1]}/{photo}") and "moved by" in text
                assert not re.search(r"<script|src=\"(?!data:)|href=", text)
    assert len(set(shown.values())) == len(shown)


def test_only_what_is_listed_can_be_asked_for(tree):
    room = TargetRoom(tree)
    name = next(iter(room.sets))
    for bad in ("../base0", "/etc", "", "base0"):
        with pytest.raises(ValueError, match="there is no set"):
            room.show(bad, "train/scene_0", "0.png")
    for bad in ("train/../../x", "scene_0", "train/scene_100", "/etc"):
        with pytest.raises(ValueError, match="there is no group"):
            room.show(name, bad, "0.png")
    for bad in ("../0.png", "/etc/passwd", "7.png", ""):
        with pytest.raises(ValueError, match="there is no photo"):
            room.show(name, "train/scene_0", bad)


def test_targets_of_other_photos_are_refused(tree):
    """A photo was replaced since."""
    shutil.copy(tree / "train" / "scene_0" / "1.png", tree / "train" / "scene_0" / "0.png")
    (tree / "train" / "scene_0" / "1.png").unlink()
    room = TargetRoom(tree)
    with pytest.raises(ValueError, match="stale proxy"):
        room.show(next(iter(room.sets)), "train/scene_0", "0.png")


def test_a_folder_without_targets_names_the_command(tmp_path):
    with pytest.raises(ValueError, match=r"gift-peft proxies --base BASE --dataset \S+ --target surface"):
        TargetRoom(tmp_path)


def test_the_difference_is_that_of_target_and_base(tree, monkeypatch):
    seen = []
    real = TargetRoom._group

    def noted(self, *asked):
        group, kind = real(self, *asked)
        seen.append(group)
        return group, kind

    monkeypatch.setattr(TargetRoom, "_group", noted)
    painted = []
    monkeypatch.setattr(
        "gift_peft.reports.targets_page.colorize_error",
        lambda values, high: painted.append((values, high)) or (values[..., None] * [1, 1, 1]).astype("uint8"),
    )
    room = TargetRoom(tree)
    room.show(next(iter(room.sets)), "train/scene_0", "1.png")
    apart = (seen[-1].surface_target[1] - seen[-1].proxies[1]).abs()
    assert torch.equal(torch.from_numpy(painted[0][0]), apart) and painted[0][1] == float(apart.max()) > 0
