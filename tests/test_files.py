"""What a name of a model or dataset means: one rule for every door."""

from pathlib import Path

import pytest
from helpers.tiny import tiny_model

from gift_peft import get_gift_model, load_gift_i, save_adapter
from gift_peft.files import is_hub_id, portable_name
from gift_peft.models.convert import convert_vggt
from gift_peft.models.identity import check_base_name

NO_HUB_IDS = ["a/b/c", "/a/b", "./model", ".", "..", "model/", "owner/", "~/model", "owner/mo del", "a--b", ""]


@pytest.fixture(autouse=True)
def empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", ["owner/model", "model", "Depth-Anything_V2.5", Path("owner/model")])
def test_a_name_is_on_the_hub_unless_it_is_here(name, tmp_path):
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
