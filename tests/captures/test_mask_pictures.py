"""Masks as programs save them: palettes, grey in color channels, transparency, JPEG, and names that nearly fit."""

import io
import json
import unicodedata

import numpy as np
import pytest
from helpers.drawn_masks import BOX, SIZE, picture
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from gift_peft.captures.masks import MaskSource, explain_missing, find_mask
from gift_peft.images import open_image, to_mask

GREY = Image.fromarray(picture())


def again(image: Image.Image, kind="PNG", **options) -> Image.Image:
    """What is read of it after it was saved."""
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return open_image(buffer.getvalue(), "m")


def indexed(mask, colors, numbers=(0, 1)) -> Image.Image:
    image = Image.fromarray(np.where(mask, numbers[1], numbers[0]).astype(np.uint8), "P")
    palette = [0] * 3 * (max(numbers) + 1)
    for number, color in zip(numbers, colors, strict=True):
        palette[3 * number : 3 * number + 3] = color
    image.putpalette(palette)
    return image


# ---- palettes ----

BLACK, WHITE = (0, 0, 0), (255, 255, 255)


@given(mask=arrays(bool, (5, 7)), numbers=st.lists(st.integers(0, 255), min_size=2, max_size=2, unique=True))
@settings(max_examples=40)
def test_a_palette_is_read_by_its_colors_whatever_their_order(mask, numbers):
    for kind in ("PNG", "GIF"):
        image = again(indexed(mask, (BLACK, WHITE), numbers), kind)
        np.testing.assert_array_equal(to_mask(image, "m"), mask)


@pytest.mark.parametrize("how", [{"method": 0}, {"method": 1}, {"method": 2}])
@pytest.mark.parametrize("mask", [BOX, ~BOX], ids=["small", "large"])
def test_what_programs_make_of_black_and_white(mask, how):
    image = Image.fromarray(picture(mask)).convert("RGB").quantize(2, **how)
    assert image.mode == "P"
    np.testing.assert_array_equal(to_mask(again(image), "m"), mask)


def test_colors_need_a_class():
    for colors in ((BLACK, (128, 0, 0)), ((0, 0, 128), WHITE), ((255, 0, 0), (0, 255, 0))):
        image = again(indexed(BOX, colors))
        with pytest.raises(ValueError, match=r"m: mode P; a mask has a single channel, or grey: name the target's"):
            to_mask(image, "m")
        np.testing.assert_array_equal(to_mask(image, "m", 1), BOX)
        np.testing.assert_array_equal(to_mask(image, "m", [0]), ~BOX)
    grey = again(indexed(BOX, (WHITE, BLACK)))  # its numbers are the other way round
    np.testing.assert_array_equal(to_mask(grey, "m", 255), ~BOX)
    with pytest.raises(ValueError, match="mask_class 1 is a palette number and, elsewhere, a grey value"):
        to_mask(again(indexed(BOX, ((1, 1, 1), WHITE))), "m", 1)


# ---- grey in color channels ----


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA", "1", "I;16", "P"])
def test_grey_in_other_channels(mode):
    if mode == "I;16":
        image = Image.fromarray(picture().astype(np.uint16) * 257)
    else:
        image = GREY.convert(mode)
    np.testing.assert_array_equal(to_mask(again(image), "m"), BOX)


def test_transparency_is_read_where_it_can_mean_one_thing():
    nothing, full = Image.new("L", SIZE), Image.new("L", SIZE, 255)
    half = Image.new("L", SIZE, 128)
    for bands in ((GREY, GREY), (full, GREY), (GREY, full)):  # white on nothing, a white cut-out, an opaque mask
        for mode in ("LA", "RGBA"):
            image = Image.merge("LA", bands).convert(mode)
            np.testing.assert_array_equal(to_mask(again(image), "m"), BOX)
    assert not to_mask(again(Image.merge("LA", (nothing, nothing))), "m").any()
    inverse = Image.fromarray(picture(~BOX))
    for bands in ((nothing, GREY), (GREY, half), (inverse, GREY), (full, nothing)):
        with pytest.raises(ValueError, match="transparent pixels that may mean either"):
            to_mask(again(Image.merge("LA", bands)), "m")


def test_values_that_are_neither_black_nor_white(tmp_path):
    for values, message in (
        ((0, 2), "the values 0 and 2"),
        ((200, 255), "the values 200 and 255"),
        ((9, 9), "the value 9"),
    ):
        path = tmp_path / "m.png"
        Image.fromarray(np.where(BOX, values[1], values[0]).astype(np.uint8)).save(path)
        with pytest.raises(
            ValueError, match=rf"m\.png: {message}, not black and white; .* \(`mask_class: {values[1]}`\)"
        ):
            MaskSource(path, "png").read(SIZE)
    np.testing.assert_array_equal(MaskSource(path, "png", None, 9).read(SIZE), np.ones_like(BOX))


# ---- JPEG ----


def large() -> np.ndarray:
    mask = np.zeros((240, 320), bool)
    mask[60:190, 80:250] = True
    return mask


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_a_jpeg_is_cut_in_the_middle(mode):
    mask = large()
    image = again(Image.fromarray(picture(mask)).convert(mode), "JPEG", quality=90)
    assert len(np.unique(np.asarray(image.convert("L")))) > 2
    np.testing.assert_array_equal(to_mask(image, "m"), mask)
    np.testing.assert_array_equal(to_mask(image, "m", 255), mask)


def test_a_jpeg_that_is_not_black_and_white_is_refused():
    mask = large()
    soft = np.clip(np.linspace(-3, 4, 320) * 255, 0, 255).astype(np.uint8)[None].repeat(240, axis=0)  # 14 % between
    classes = np.where(mask, 90, 0).astype(np.uint8)
    for array, target in ((soft, None), (classes, None), (picture(mask), 2)):
        with pytest.raises(ValueError, match=r"m: \d+ different values, .* \(JPEG\) that does not keep them"):
            to_mask(again(Image.fromarray(array), "JPEG", quality=80), "m", target)


@given(st.integers(0, 100), st.integers(0, 32), st.integers(0, 32))
@settings(max_examples=30)
def test_a_hundredth_may_lie_between(between, dark, bright):
    """Just at the limit: 99 % within 32 of black or white."""
    values = np.full(10_000, dark, np.uint8)
    values[5000:] = 255 - bright
    values[4900 : 4900 + between] = 100
    values[0], values[1] = 0, 255
    image = Image.fromarray(values.reshape(100, 100))
    image.format = "JPEG"
    np.testing.assert_array_equal(to_mask(image, "m").ravel(), values >= 128)
    values[4800:4901] = 100  # one more than a hundredth
    image = Image.fromarray(values.reshape(100, 100))
    image.format = "JPEG"
    with pytest.raises(ValueError, match="near black or white"):
        to_mask(image, "m")


# ---- names ----


@pytest.fixture
def group(tmp_path):
    folder = tmp_path / "raw/train/scene"
    (folder / "masks").mkdir(parents=True)
    Image.new("RGB", SIZE).save(folder / "IMG_1.jpg")
    return folder


PLACES = {
    "upper case suffix": "masks/IMG_1.PNG",
    "tif": "masks/IMG_1.tif",
    "bmp": "masks/IMG_1.BMP",
    "gif": "masks/IMG_1.gif",
    "lower case": "masks/img_1.png",
    "whole name": "masks/IMG_1.jpg.png",
    "folder in the singular": "mask/IMG_1.png",
    "folder in capitals": "Masks/IMG_1.png",
    "ending in capitals": "IMG_1_Mask.png",
    "ending, another format": "masks/IMG_1_mask.bmp",
}


@pytest.mark.parametrize("name", PLACES)
def test_names_and_formats(group, name):
    path = group / PLACES[name]
    path.parent.mkdir(exist_ok=True)
    GREY.save(path)
    source = find_mask(group / "IMG_1.jpg", group, group.parents[1])
    assert source.path == path
    np.testing.assert_array_equal(source.read(SIZE), BOX)


@pytest.mark.parametrize("forms", [("NFD", "NFC"), ("NFC", "NFD")])
@pytest.mark.parametrize("suffix", ["png", "json", "_mask.png"])
def test_accents_composed_or_not(group, forms, suffix):
    photo, mask = (unicodedata.normalize(form, "Küche é") for form in forms)
    Image.new("RGB", SIZE).save(group / f"{photo}.jpg")
    path = group / "masks" / (mask + ("." if suffix[0] != "_" else "") + suffix)
    if suffix == "json":
        path.write_text(json.dumps({"shapes": [], "imagePath": f"../{mask}.jpg"}))
    else:
        GREY.save(path)
    assert find_mask(group / f"{photo}.jpg", group, group.parents[1]).path == path


def test_a_mask_of_another_photo_is_not_taken(group):
    """Where case tells photos apart, it tells masks apart; two files that may both be meant are refused."""
    Image.new("RGB", SIZE).save(group / "img_1.jpg")
    GREY.save(group / "masks/img_1.png")
    assert find_mask(group / "IMG_1.jpg", group, group.parents[1]) is None
    GREY.save(group / "masks/IMG_1.tif")
    GREY.save(group / "masks/IMG_1.bmp")
    with pytest.raises(ValueError, match=r"IMG_1\.bmp and IMG_1\.tif may both be the mask of IMG_1\.jpg; keep one"):
        find_mask(group / "IMG_1.jpg", group, group.parents[1])
    GREY.save(group / "masks/IMG_1.png")
    assert find_mask(group / "IMG_1.jpg", group, group.parents[1]).path.name == "IMG_1.png"


def test_near_misses_are_named(group):
    for name in ("IMG_1 copy.png", "IMG_01.png", "IMG_1b.png"):
        GREY.save(group / "masks" / name)
    text = explain_missing(group / "IMG_1.jpg", group, group.parents[1])
    assert "masks/IMG_1.png for the image IMG_1.jpg; in masks/ IMG_01.png, IMG_1 copy.png and 1 more fit" in text
    assert "--propose-masks" in text and "\n" not in text
