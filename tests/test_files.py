"""Whole or absent: files and folders; and small files whose faults are told in one line."""

import math
import os
import shutil
from importlib import import_module
from pathlib import Path

import pytest
from helpers.tiny import tiny_model

from gift_peft import get_gift_model, load_gift_i, save_adapter
from gift_peft.cli import VERBS
from gift_peft.files import (
    check_inputs_stay,
    check_replaceable,
    is_hub_id,
    jsonable,
    portable_name,
    read_yaml,
    reason,
    remove_files,
    strangers,
    unfetched,
    whole_folder,
    write_whole,
)
from gift_peft.models.convert import convert_vggt
from gift_peft.models.identity import check_base_name
from gift_peft.models.loading import load_base
from gift_peft.reports import model_card, targets_page

ROOT = Path(__file__).parents[1]


def test_a_folder_is_whole_or_absent(tmp_path):
    target = tmp_path / "target"
    with whole_folder(target) as folder:
        assert not target.exists()
        (folder / "inner").mkdir()
        (folder / "inner/a").write_text("old")
    with pytest.raises(OSError, match="full"), whole_folder(target, ["inner/*"]) as folder:
        (folder / "a").write_text("new")
        raise OSError("disk full")
    assert [path.name for path in tmp_path.iterdir()] == ["target"]
    assert (target / "inner/a").read_text() == "old"


def test_a_folder_replaces_the_earlier_one_and_what_a_killed_writer_left(tmp_path):
    target = tmp_path / "target"
    for name in ("target", ".target.tmp", ".target.old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "stale").write_text(name)
    with whole_folder(target, own=["stale"]) as folder:
        (folder / "fresh").write_text("")
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == ["target", "target/fresh"]


# ---- whose a file is ----


def write(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(name)


def test_a_folder_with_anything_else_in_it_is_never_replaced(tmp_path):
    target = tmp_path / "target"
    write(target, "data/a.bin", "notes/mine.txt")
    (tmp_path / ".target.old").mkdir()
    for own in ((), ["data/*"], ["notes/*.md", "data/*"]):
        said = r"target holds files that were not written .*notes/mine\.txt"
        with pytest.raises(ValueError, match=said), whole_folder(target, own):
            raise AssertionError("asked before the work")
        assert strangers(target) == ["data/a.bin", "notes/mine.txt"]
    with pytest.raises(ValueError, match=r"late\.txt"), whole_folder(tmp_path / "new") as folder:
        write(folder, "ours")
        write(tmp_path, "new/late.txt")  # while we were at work
    assert strangers(tmp_path) == ["new/late.txt", "target/data/a.bin", "target/notes/mine.txt"]


def test_what_a_desktop_leaves_and_empty_folders_are_nobodys(tmp_path):
    write(tmp_path, ".DS_Store", "sub/._a.png", "sub/Thumbs.db")
    (tmp_path / "sub/empty").mkdir()
    check_replaceable(tmp_path)
    write(tmp_path, ".hidden")
    with pytest.raises(ValueError, match=r"\(\.hidden\)"):
        check_replaceable(tmp_path)
    with pytest.raises(OSError, match="hidden exists and is no folder"):
        check_replaceable(tmp_path / ".hidden")
    (tmp_path / ".hidden").unlink()
    (tmp_path / "sub/link").symlink_to(tmp_path.parent)  # a folder elsewhere: named, not entered
    assert strangers(tmp_path) == ["sub/link"]


def test_a_link_to_a_folder_stays_a_link(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    with whole_folder(tmp_path / "link") as folder:
        write(folder, "a")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "disk/a").read_text() == "a"


def test_files_are_removed_with_the_folders_that_they_leave_empty(tmp_path):
    write(tmp_path, "a/b/1", "a/b/2", "a/c/1", "d/1")
    remove_files(tmp_path, ["a/b/1", "a/b/2", "d/1", "gone/1"])
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["a", "a/c", "a/c/1"]


def test_a_file_of_another_is_not_written_over(tmp_path):
    """Both verbs that take the name of one file say so before they load anything: there is no base and no dataset."""
    card = ["report", str(ROOT / "examples/vggt_1b.yaml"), "--model-card"]
    page = ["proxies", "--base", "nothing", "--dataset", "nothing", "--target", "surface", "--page"]
    for command in (card, page):
        mine = tmp_path / "mine.txt"
        mine.write_text("mine")
        for path, error, message in ((mine, ValueError, "is kept"), (tmp_path, IsADirectoryError, "is a folder")):
            with pytest.raises(error, match=f"{command[-1]} .*{message}") as raised:
                import_module(f"gift_peft.{VERBS[command[0]][0]}").run([*command[1:], str(path)])
            assert str(path) in str(raised.value)
        assert mine.read_text() == "mine" and list(tmp_path.iterdir()) == [mine]
    assert targets_page.MARK in targets_page.PAGE
    for _ in range(2):  # a card of ours is written again
        import_module("gift_peft.reports.report_verb").run([*card[1:], str(tmp_path / "card.md")])
    assert model_card.MARK in (tmp_path / "card.md").read_text()


def test_an_output_never_is_an_input(tmp_path):
    photos = tmp_path / "photos"
    write(photos, "Kitchen.PNG", "caf\u00e9.png")
    (tmp_path / "linked").symlink_to(photos)
    (tmp_path / "alias.png").symlink_to(photos / "Kitchen.PNG")
    os.link(photos / "Kitchen.PNG", tmp_path / "hard.png")
    inputs = [photos / "Kitchen.PNG", photos / "caf\u00e9.png"]
    same = [photos / "kitchen.png", photos / "cafe\u0301.png", tmp_path / "linked/KITCHEN.png"]
    same += [tmp_path / "alias.png", tmp_path / "hard.png", photos / "../photos/Kitchen.PNG"]
    for path in same:
        with pytest.raises(ValueError, match=r"would replace the input .*photos"):
            check_inputs_stay([tmp_path / "other.png", path], inputs)
    with pytest.raises(ValueError, match="would replace the input"):  # an input that is a link: the link stays too
        check_inputs_stay([tmp_path / "ALIAS.png"], [tmp_path / "alias.png"])
    check_inputs_stay([photos / "kitchen.npy", tmp_path / "Photos/Kitchen.PNG", tmp_path / "new/kitchen.png"], inputs)


def test_weights_that_were_not_fetched(tmp_path):
    (tmp_path / "model.safetensors").write_text(
        "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 9\n"
    )
    shutil.copy(ROOT / "src/gift_peft/demo/base/config.json", tmp_path)
    with pytest.raises(ValueError, match=r"base model .*: of model\.safetensors only Git LFS's pointer is there"):
        load_base(tmp_path)
    assert unfetched(ROOT / "src/gift_peft/demo/base") is None and unfetched("somebody/on-the-hub") is None


def test_a_folder_is_never_seen_half_deleted(tmp_path, monkeypatch):
    from gift_peft.files import remove_folder

    for name in ("target", ".target.tmp"):  # the second as a killed run left it
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text(name)
    seen, real = [], shutil.rmtree
    monkeypatch.setattr(shutil, "rmtree", lambda path, **options: seen.append(path.name) or real(path, **options))
    remove_folder(tmp_path / "target")
    assert seen == [".target.tmp", ".target.tmp"] and not list(tmp_path.iterdir())


def test_a_file_stands_in_the_way_of_a_folder(tmp_path):
    (tmp_path / "target").write_text("mine")
    with pytest.raises(OSError), whole_folder(tmp_path / "target/inner"):
        pass
    assert (tmp_path / "target").read_text() == "mine"


def test_windows_opens_no_folders_to_sync(tmp_path, monkeypatch):
    """os.open of a folder is PermissionError there; files are still synced, which takes the right to write."""
    synced, real = [], os.open

    def opens(path, flags, *rest):
        if os.path.isdir(path):
            raise PermissionError(13, "Permission denied", str(path))
        assert flags & os.O_RDWR
        synced.append(os.path.basename(path))
        return real(path, flags, *rest)

    target = tmp_path / "target"
    monkeypatch.setattr("gift_peft.files._OPENS_FOLDERS", False)
    monkeypatch.setattr(os, "open", opens)
    with whole_folder(target) as folder:
        (folder / "inner").mkdir()
        (folder / "inner/a").write_text("x")
    assert (target / "inner/a").read_text() == "x" and "a" in synced


def test_an_error_without_a_text_has_a_reason():
    assert reason(EOFError()) == "EOFError"
    assert reason(ValueError("  ")) == "ValueError"
    assert reason(ValueError("\nfirst\nsecond")) == "first"
    assert len(reason(ValueError("x" * 1000))) == 200


def test_yaml_is_read_or_refused_in_one_line(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("a: 1\n")
    assert read_yaml(path) == {"a": 1}
    path.write_text("# nothing\n")
    assert read_yaml(path) == {}
    for content, message in (
        (b"- 1\n", "expected lines of the form `key: value`"),
        (b"text\n", "expected lines"),
        (b"a: b: c\n", "not valid YAML"),
        (b"a: \xff\n", "not valid YAML"),
        (b"[" * 5000, "not valid YAML"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message) as caught:
            read_yaml(path, "config a.yaml")
        assert str(caught.value).startswith("config a.yaml: ") and "\n" not in str(caught.value)
    with pytest.raises(FileNotFoundError, match=r"b\.yaml: no such file"):
        read_yaml(tmp_path / "b.yaml")


def test_json_holds_no_nan():
    assert jsonable({"a": [math.nan, 1.0, (math.inf,)], "b": None}) == {"a": [None, 1.0, [None]], "b": None}


def test_text_is_written_as_utf8(tmp_path):
    write_whole(tmp_path / "a/b.txt", "größe")
    assert (tmp_path / "a/b.txt").read_bytes() == "größe".encode()


# ---- on the Hub, or a path here: one rule for every door ----

NO_HUB_IDS = ["a/b/c", "/a/b", "./model", ".", "..", "model/", "owner/", "~/model", "owner/mo del", "a--b", ""]


@pytest.mark.parametrize("name", ["owner/model", "model", "Depth-Anything_V2.5", Path("owner/model")])
def test_a_name_is_on_the_hub_unless_it_is_here(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert is_hub_id(name) and portable_name(name) == str(name)
    check_base_name(name)
    (tmp_path / name).mkdir(parents=True)
    assert not is_hub_id(name) and portable_name(name) == Path(name).name
    (tmp_path / "file").touch()
    assert not is_hub_id("file")


@pytest.mark.parametrize("name", NO_HUB_IDS)
def test_what_can_only_be_a_path_is_asked_for_nowhere_else(name, tmp_path, monkeypatch):
    def never(*args, **kwargs):
        raise AssertionError("asked the hub")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("huggingface_hub.hf_hub_download", never)
    monkeypatch.setattr("datasets.load_dataset", never)
    assert not is_hub_id(name)
    if Path(name).exists():  # as ".", ".." and "" do
        return
    for door in (check_base_name, lambda name: load_gift_i(name, "train")):
        with pytest.raises(FileNotFoundError, match="no such folder"):
            door(name)
    if name != "a/b/c":  # there it is file c of the repository a/b
        with pytest.raises(FileNotFoundError, match="no such checkpoint file"):
            convert_vggt(name, "new")


def test_the_last_part_of_a_path_is_portable(tmp_path):
    assert portable_name(tmp_path / "model") == portable_name("a/b/model") == portable_name("~/model") == "model"


def test_an_adapter_of_a_path_has_no_base_on_its_card(tmp_path):
    with pytest.warns(UserWarning, match="others cannot load this adapter"):
        save_adapter(get_gift_model(tiny_model()), tmp_path / "adapter", "somewhere/else/base")
    assert "base_model" not in (tmp_path / "adapter" / "README.md").read_text()
