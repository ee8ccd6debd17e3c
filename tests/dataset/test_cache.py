"""Groups at network size in files: the same bits as decoding, never stale, and no worse off when damaged."""

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tiny import SIZE, tiny_processor, write_group
from PIL import Image

from gift_peft.dataset import cache as module
from gift_peft.dataset import rows as rows_module
from gift_peft.dataset.cache import GroupCache
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.loader import PreparedGroups, PreparedImages
from gift_peft.dataset.proxies import SurfaceSettings
from gift_peft.dataset.tensors import collate_group
from gift_peft.training.teacher import make_proxies


@pytest.fixture
def raw(tmp_path):
    write_group(tmp_path / "raw/train/scene", 3, 0)
    write_group(tmp_path / "raw/validation/other", 2, 1, reference=True)
    return tmp_path / "raw"


def open_cache(raw, folder, split="train", size=SIZE, **options):
    return GroupCache(load_gift_i(raw, split, **options), tiny_processor(), size, folder)


def assert_equal_groups(got, want):
    assert got.pictures is None
    for name, value in vars(replace(want, pictures=None)).items():
        other = getattr(got, name)
        assert torch.equal(other, value) if isinstance(value, torch.Tensor) else other == value, name


@pytest.fixture
def no_decoding(monkeypatch):
    """Call it, and from then on no picture can be decoded."""

    def forbid(*args, **kwargs):
        raise AssertionError("decoded again")

    return lambda: monkeypatch.setattr(rows_module, "open_image", forbid)


@pytest.mark.parametrize("split", ["train", "validation"])
def test_the_second_reading_decodes_nothing_and_has_the_same_bits(raw, base_dir, tmp_path, split, no_decoding):
    make_proxies(base_dir, raw, size=SIZE)
    teacher = {"teacher": base_dir, "size": SIZE}
    rows = load_gift_i(raw, split, **teacher)
    want = collate_group(rows[0], tiny_processor(), SIZE)
    assert want.target is not None and (want.reference_target is not None) == (split == "validation")
    folder = tmp_path / "cache"
    assert_equal_groups(open_cache(raw, folder, split, **teacher).read(0), want)
    again = GroupCache(rows, tiny_processor(), SIZE, folder)
    no_decoding()
    for _ in range(2):
        assert_equal_groups(again.read(0), want)


def is_mapped(tensor, folder) -> bool:
    """Whether a tensor's memory is that of a file in this folder: pages that are read when asked for."""
    maps = [line.split() for line in Path("/proc/self/maps").read_text().splitlines() if str(folder) in line]
    starts = [tuple(int(side, 16) for side in line[0].split("-")) for line in maps]
    return any(start <= tensor.data_ptr() < end for start, end in starts)


only_linux = pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="only Linux tells what is mapped")


@only_linux
def test_masks_stay_mapped_to_the_file(raw, tmp_path):
    cache = open_cache(raw, tmp_path / "cache")
    cache.read(0)
    group = cache.read(0)
    assert is_mapped(group.mask, tmp_path / "cache") and not is_mapped(group.pixel_values, tmp_path)


def test_entries_are_keyed_by_content_size_and_nothing_else(raw, tmp_path, no_decoding):
    folder = tmp_path / "cache"
    cache = open_cache(raw, folder)
    before = cache.read(0)
    open_cache(raw, folder, size=(28, 42)).read(0)
    assert len(list(folder.iterdir())) == 2
    picture = raw / "train/scene/1.png"
    changed = np.asarray(Image.open(picture)).copy()
    changed[:30] = 255 - changed[:30]
    Image.fromarray(changed).save(picture)
    after = open_cache(raw, folder).read(0)
    assert not torch.equal(after.pixel_values[1], before.pixel_values[1])
    assert torch.equal(after.pixel_values[0], before.pixel_values[0])
    assert len(list(folder.iterdir())) == 3
    mask = raw / "train/scene/masks/0.png"
    Image.fromarray(255 - np.asarray(Image.open(mask))).save(mask)
    assert (open_cache(raw, folder).read(0).mask[0] != before.mask[0]).all()
    # The same pictures elsewhere under other names are the same entry.
    (raw / "train/scene").rename(raw / "train/moved")
    moved = load_gift_i(raw, "train")
    no_decoding()
    assert GroupCache(moved, tiny_processor(), SIZE, folder).read(0).group_id == "moved"


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)


def rename_a_tensor(path):
    path.write_bytes(path.read_bytes().replace(b'"images"', b'"imagez"', 1))


DAMAGES = {
    "a flipped bit": flip_a_bit,
    "cut off": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "another file": lambda path: path.write_bytes(b"x" * 5000),
    "without images": rename_a_tensor,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_entry_is_noticed_and_made_again(raw, tmp_path, damage, caplog, no_decoding):
    folder = tmp_path / "cache"
    want = open_cache(raw, folder).read(0)
    (path,) = folder.iterdir()
    good = path.read_bytes()
    DAMAGES[damage](path)
    with caplog.at_level(logging.WARNING, "gift_peft"):
        assert_equal_groups(open_cache(raw, folder).read(0), want)
    assert f"{path} is damaged" in caplog.text
    assert path.read_bytes() == good
    again = load_gift_i(raw, "train")
    no_decoding()
    assert_equal_groups(GroupCache(again, tiny_processor(), SIZE, folder).read(0), want)


def test_a_folder_that_cannot_be_written_is_told_once(raw, tmp_path, monkeypatch, caplog):
    def refuse(path, content):
        raise OSError(28, "No space left on device", str(path))

    cache = open_cache(raw, tmp_path / "cache")
    monkeypatch.setattr(module, "write_whole", refuse)
    with caplog.at_level(logging.WARNING, "gift_peft"):
        first, second = cache.read(0), cache.read(0)
    assert_equal_groups(second, first)
    assert caplog.text.count("No space left") == 1


def test_threads_and_runs_at_the_same_time(raw, tmp_path):
    """Each writes whole files under its own temporary name; whoever is last wins, and nothing else stays."""
    folder = tmp_path / "cache"
    caches = [open_cache(raw, folder) for _ in range(2)]
    with ThreadPoolExecutor(8) as pool:
        groups = list(pool.map(lambda i: caches[i % 2].read(0), range(24)))
    for group in groups:
        assert_equal_groups(group, groups[0])
    assert len(list(folder.iterdir())) == 1


def test_a_stale_proxy_is_found_without_decoding(raw, base_dir, tmp_path):
    make_proxies(base_dir, raw, size=SIZE)
    folder = tmp_path / "cache"
    open_cache(raw, folder, teacher=base_dir).read(0)
    Image.fromarray(255 - np.asarray(Image.open(raw / "train/scene/0.png"))).save(raw / "train/scene/0.png")
    open_cache(raw, folder).read(0)  # the entry of the new picture
    with pytest.raises(ValueError, match=r"stale proxy .*scene\.safetensors: image 0\.png has changed"):
        open_cache(raw, folder, teacher=base_dir).read(0)


@only_linux
@pytest.mark.parametrize("count", [3, 12])
def test_an_image_takes_the_memory_of_one_image_whatever_its_group(base_dir, tmp_path, count):
    write_group(tmp_path / "raw/train/scene", count, 0)
    surface = SurfaceSettings(fills=0)
    make_proxies(base_dir, tmp_path / "raw", size=SIZE, surface=surface)
    rows = load_gift_i(tmp_path / "raw", "train", teacher=base_dir, size=SIZE, surface=surface)
    whole = PreparedGroups(rows, tiny_processor(), SIZE, 0, tmp_path / "cache")[0]  # and fills the cache
    images = PreparedImages(PreparedGroups(rows, tiny_processor(), SIZE, 0, tmp_path / "cache"))
    assert len(images) == count
    for index in (0, count - 1):
        image = images.read(index)
        for name in ("pixel_values", "mask", "surface_target"):
            tensor = getattr(image, name)
            assert torch.equal(tensor[0], getattr(whole, name)[index]), name
            own = tensor.untyped_storage().nbytes() == tensor.element_size() * tensor[0].numel()
            assert own or is_mapped(tensor, tmp_path), name
        assert image.pixel_values.untyped_storage().nbytes() == 12 * SIZE[0] * SIZE[1]


def test_threads_that_want_the_same_group_decode_it_once(raw, tmp_path, monkeypatch):
    calls, real = [], module.resize_pictures
    monkeypatch.setattr(module, "resize_pictures", lambda *args: calls.append(1) or real(*args))
    cache = open_cache(raw, tmp_path / "cache")
    with ThreadPoolExecutor(4) as pool:
        groups = list(pool.map(lambda _: cache.read(0), range(8)))
    assert len(calls) == 1
    for group in groups:
        assert_equal_groups(group, groups[0])


def test_without_a_folder_every_reading_decodes(raw, no_decoding):
    cache = open_cache(raw, None)
    assert_equal_groups(cache.read(0), cache.read(0))
    no_decoding()
    with pytest.raises(AssertionError, match="decoded again"):
        cache.read(0)
