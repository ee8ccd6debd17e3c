"""Files of several pictures, of floats, that stand for a file elsewhere, or that are named by a pattern."""

import numpy as np
import pytest
from helpers.drawn_masks import BOX, picture
from PIL import Image

from gift_peft.captures.masks import MaskSource
from gift_peft.captures.tree import decode_capture, read_capture
from gift_peft.images import list_images, open_image

SIZE = (12, 8)
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb\nsize 12345\n"


def frames(*masks):
    return [Image.fromarray(picture(mask)) for mask in masks]


@pytest.mark.parametrize("suffix", [".tif", ".gif", ".png", ".webp"])
def test_one_of_several_pictures_is_not_guessed(tmp_path, suffix):
    path = tmp_path / f"1{suffix}"
    first, second = frames(np.zeros_like(BOX), BOX)
    first.save(path, save_all=True, append_images=[second], **({"lossless": True} if suffix == ".webp" else {}))
    with pytest.raises(ValueError, match=rf"1\{suffix}: it holds 2 pictures; save each as a file of its own"):
        MaskSource(path, "png").read(SIZE)


def test_previews_and_second_views_are_no_second_picture(tmp_path):
    whole = frames(BOX)[0]
    whole.save(tmp_path / "1.tif", save_all=True, append_images=[whole.resize((6, 4))])
    np.testing.assert_array_equal(MaskSource(tmp_path / "1.tif", "png").read(SIZE), BOX)
    photo = Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 96, 3), np.uint8))
    photo.save(tmp_path / "photo.jpg", format="MPO", save_all=True, append_images=[photo.rotate(180)])
    assert open_image(tmp_path / "photo.jpg").size == photo.size


@pytest.mark.parametrize("high", [1, 255])
def test_masks_of_floats(tmp_path, high):
    path = tmp_path / "1.tif"
    Image.fromarray(BOX.astype(np.float32) * high).save(path)
    np.testing.assert_array_equal(MaskSource(path, "png").read(SIZE), BOX)
    for other in (0.5, np.nan, np.inf, -1.0):
        Image.fromarray(np.where(BOX, np.float32(high), np.float32(other))).save(path)
        with pytest.raises(ValueError, match=r"1\.tif: its values are fractions, negative or not finite"):
            MaskSource(path, "png").read(SIZE)


def test_pointers_of_git_lfs(tmp_path):
    path = tmp_path / "1.png"
    path.write_text(POINTER)
    with pytest.raises(ValueError, match=r"1\.png: .*`git lfs pull` fetches the file"):
        open_image(path)
    folder = tmp_path / "train/cup"
    folder.mkdir(parents=True)
    for name in ("1", "2"):
        Image.new("RGB", SIZE).save(folder / f"{name}.jpg")
    (folder / "x.json").write_text(POINTER)
    with pytest.raises(ValueError, match=r"x\.json: .*`git lfs pull` fetches the file"):
        read_capture(folder, "train", tmp_path)


def test_photos_still_in_icloud_are_told(tmp_path):
    folder = tmp_path / "train/cup"
    (folder / "masks").mkdir(parents=True)
    for seed, name in enumerate(("1", "2")):
        pixels = np.random.default_rng(seed).integers(0, 255, (8, 12, 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"{name}.jpg")
        frames(BOX)[0].save(folder / f"masks/{name}.png")
    (folder / ".3.jpg.icloud").write_bytes(b"bplist00")
    note = decode_capture(read_capture(folder, "train", tmp_path)).notes["skipped_files"]
    assert note == "1 file is not read: .3.jpg.icloud (download what is still in iCloud)"


def test_a_pattern_that_no_shell_expanded(tmp_path):
    for name in ("b.jpg", "a.jpg", "c.png", "d[1].jpg"):
        Image.new("RGB", SIZE).save(tmp_path / name)
    assert [path.name for path in list_images([str(tmp_path / "*.jpg")])] == ["a.jpg", "b.jpg", "d[1].jpg"]
    assert [path.name for path in list_images([tmp_path / "d[1].jpg"])] == ["d[1].jpg"]
    with pytest.raises(FileNotFoundError, match=r"no such image: .*/\*\.tif"):
        list_images([tmp_path / "*.tif"])
