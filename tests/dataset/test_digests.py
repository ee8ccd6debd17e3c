"""Digests of pictures, kept: the same as decoding gives, never those of another picture, no worse off when damaged."""

import logging
import os
import time

import numpy as np
import pytest
from helpers.records import records
from helpers.tiny import write_group
from PIL import Image

from gift_peft.dataset import digests as module
from gift_peft.dataset import rows as rows_module
from gift_peft.dataset.digests import DigestCache, GroupDigests, fingerprint
from gift_peft.dataset.export import export_parquet
from gift_peft.dataset.gift_i import dataset_fingerprint, load_gift_i
from gift_peft.dataset.writer import write_gift_i


@pytest.fixture
def raw(tmp_path):
    write_group(tmp_path / "raw/train/scene", 3, 0)
    write_group(tmp_path / "raw/validation/other", 2, 1, reference=True)
    return tmp_path / "raw"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Of the entries; files count as settled at once."""
    monkeypatch.setattr(module, "SETTLED", 0)
    return tmp_path / "digests"


@pytest.fixture
def decoded(monkeypatch):
    """The names of the pictures that were decoded."""
    names, real = [], rows_module.open_image
    monkeypatch.setattr(rows_module, "open_image", lambda source, name: names.append(name) or real(source, name))
    return names


def read(raw, folder, split="validation"):
    return DigestCache(load_gift_i(raw, split), folder).read(0)


@pytest.mark.parametrize("form", ["raw", "prepared", "release"])
@pytest.mark.parametrize("split", ["train", "validation"])
def test_the_second_reading_decodes_nothing(raw, folder, tmp_path, split, form, decoded):
    place = raw
    if form != "raw":
        place = write_gift_i(records(raw), tmp_path / "gift-i", license="cc0-1.0")
    if form == "release":
        place = export_parquet(place, tmp_path / "release", license="cc0-1.0")
    before = sorted(raw.rglob("*"))
    rows = load_gift_i(place, split)
    want = GroupDigests.of(DigestCache(rows).groups[0])
    first, group = DigestCache(rows, folder).read(0)
    assert first == want and group is not None
    decoded.clear()
    again, group = DigestCache(load_gift_i(place, split), folder).read(0)
    assert again == want and group is None and not decoded
    assert fingerprint([again.content]) == dataset_fingerprint(rows)
    assert sorted(raw.rglob("*")) == before  # which may be read-only


@pytest.mark.parametrize("part", ["0.bmp", "masks/0.png", "reference.png"])
@pytest.mark.parametrize("times", ["new", "put back"])
def test_a_changed_picture_is_noticed(raw, folder, part, times):
    """Even one of the same size in bytes, with the old time of modification: its ctime has changed."""
    photo = raw / "validation/other/0.png"
    Image.open(photo).save(photo.with_suffix(".bmp"))
    photo.unlink()
    before, _ = read(raw, folder)
    path = raw / "validation/other" / part
    stat = path.stat()
    pixels = np.asarray(Image.open(path))
    Image.fromarray(255 - pixels if part.startswith("masks") else pixels[::-1]).save(path)
    if part.endswith(".bmp"):
        assert path.stat().st_size == stat.st_size
    if times == "put back":
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    after, group = read(raw, folder)
    assert group is not None and after == GroupDigests.of(group)
    assert after.content != before.content


def test_another_group_or_name_is_another_entry(raw, folder):
    before, _ = read(raw, folder)
    (raw / "validation/other").rename(raw / "validation/moved")
    after, group = read(raw, folder)
    assert group is not None and after.pictures == before.pictures and after.content != before.content


@pytest.mark.parametrize("clock", [0, -3600])
def test_what_was_written_a_moment_ago_or_in_the_future_is_not_kept(raw, tmp_path, monkeypatch, clock):
    real = time.time
    monkeypatch.setattr(module.time, "time", lambda: real() + clock)
    for _ in range(2):
        assert read(raw, tmp_path / "digests")[1] is not None
    assert not (tmp_path / "digests").exists()
    monkeypatch.setattr(module.time, "time", lambda: real() + 3600)
    read(raw, tmp_path / "digests")
    assert read(raw, tmp_path / "digests")[1] is None


@pytest.mark.parametrize("damage", [lambda text: text[:50], lambda text: "[]", lambda text: text.replace("a", "b", 1)])
def test_a_damaged_entry_is_noticed_and_made_again(raw, folder, damage, caplog):
    want, _ = read(raw, folder)
    (path,) = folder.iterdir()
    whole = path.read_text()
    path.write_text(damage(whole))
    with caplog.at_level(logging.WARNING, "gift_peft"):
        assert read(raw, folder)[0] == want
    assert f"{path} is damaged" in caplog.text and path.read_text() == whole


def test_a_folder_that_cannot_be_written_is_told_once(raw, folder, monkeypatch, caplog):
    def refuse(path, content):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(module, "write_whole", refuse)
    cache = DigestCache(load_gift_i(raw, "train"), folder)
    with caplog.at_level(logging.WARNING, "gift_peft"):
        assert cache.read(0)[0] == cache.read(0)[0]
    assert caplog.text.count("No space left") == 1


def test_a_folder_that_cannot_be_is_not_called_damaged(raw, folder, caplog):
    folder.write_text("a file of somebody")
    with caplog.at_level(logging.WARNING, "gift_peft"):
        assert read(raw, folder)[1] is not None
    assert "damaged" not in caplog.text and caplog.text.count("their digests cannot be kept") == 1


def test_a_picture_that_is_gone_or_damaged_is_named(raw, folder):
    cache = DigestCache(load_gift_i(raw, "train"), folder)
    cache.read(0)
    picture = raw / "train/scene/1.png"
    picture.write_bytes(picture.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"scene/1\.png: not a readable image"):
        cache.read(0)
    picture.unlink()
    with pytest.raises(FileNotFoundError, match=r"scene/1\.png: no such file"):
        cache.read(0)
