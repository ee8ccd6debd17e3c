"""Image rules, masks, and pixels equal to those of the Hugging Face processor."""

from fractions import Fraction
from math import floor

import cv2
import numpy as np
import pytest
import torch
from helpers.tiny import SIZE, tiny_processor
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image
from transformers import DPTImageProcessor, pipeline

from gift_peft.dataset.tensors import collate_group
from gift_peft.images import image_digest, open_image, read_image, to_mask
from gift_peft.models.pixels import resize_mask, resolve_size, to_pixel_values

RNG = np.random.default_rng(0)
PICTURE = RNG.integers(0, 255, (40, 60, 3), dtype=np.uint8)


def save(path, array, mode=None, **options):
    image = Image.fromarray(array)
    (image.convert(mode) if mode else image).save(path, **options)
    return path


def one_line(excinfo, *words):
    message = str(excinfo.value)
    assert "\n" not in message and len(message) < 300
    for word in words:
        assert str(word) in message


# ---- images ----


def test_exif_orientation_is_applied(tmp_path):
    exif = Image.Exif()
    exif[Image.ExifTags.Base.Orientation] = 6  # the camera was held upright: turn by 270 degrees
    path = save(tmp_path / "a.png", PICTURE, exif=exif)
    assert np.array_equal(np.asarray(read_image(path)), np.rot90(PICTURE, 3))


def test_grey_and_opaque_alpha_become_rgb(tmp_path):
    grey = save(tmp_path / "grey.png", PICTURE[..., 0])
    assert np.array_equal(np.asarray(read_image(grey)), np.repeat(PICTURE[..., :1], 3, axis=2))
    opaque = save(tmp_path / "opaque.png", np.dstack([PICTURE, np.full((40, 60), 255, np.uint8)]))
    assert np.array_equal(np.asarray(read_image(opaque)), PICTURE)
    indexed = Image.fromarray(np.array([[0, 1]], np.uint8), "P")
    indexed.putpalette([10, 20, 30, 40, 50, 60])
    indexed.save(tmp_path / "palette.png")
    assert np.asarray(read_image(tmp_path / "palette.png")).tolist() == [[[10, 20, 30], [40, 50, 60]]]


def truncated(path):
    save(path, RNG.integers(0, 255, (200, 300, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def transparent(path):
    alpha = np.full((40, 60), 255, np.uint8)
    alpha[3, 3] = 254
    save(path, np.dstack([PICTURE, alpha]))


BAD_IMAGES = {
    "transparent.png": (transparent, "transparent"),
    "key_colour.png": (lambda path: save(path, PICTURE, transparency=tuple(map(int, PICTURE[0, 0]))), "transparent"),
    "grey16.png": (lambda path: Image.fromarray(PICTURE[..., 0].astype(np.uint16) * 257).save(path), "16-bit"),
    "colour16.png": (lambda path: cv2.imwrite(str(path), PICTURE.astype(np.uint16) * 257), "16-bit"),
    "print.jpg": (lambda path: save(path, PICTURE, "CMYK"), "CMYK"),
    "cut.jpg": (truncated, "truncated"),
    "cut.png": (truncated, "truncated"),
    "words.png": (lambda path: path.write_text("not a picture"), "not a readable image"),
    "missing.png": (lambda path: None, "no such file"),
}


@pytest.mark.parametrize("name", BAD_IMAGES)
def test_bad_images_are_errors_that_name_the_file(tmp_path, name):
    write, reason = BAD_IMAGES[name]
    write(tmp_path / name)
    with pytest.raises((ValueError, FileNotFoundError)) as excinfo:
        read_image(tmp_path / name)
    one_line(excinfo, tmp_path / name, reason)


def test_digest_is_of_the_content(tmp_path):
    digest = image_digest(read_image(save(tmp_path / "a.png", PICTURE)))
    assert digest == image_digest(read_image(save(tmp_path / "a.bmp", PICTURE)))
    assert digest != image_digest(Image.fromarray(PICTURE.reshape(60, 40, 3)))
    changed = PICTURE.copy()
    changed[-1, -1, -1] ^= 1
    assert digest != image_digest(Image.fromarray(changed))


# ---- masks ----


@given(
    levels=st.lists(st.integers(0, 255), min_size=1, max_size=2),
    pattern=hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2)),
)
def test_two_valued_masks(levels, pattern):
    array = np.where(pattern, levels[0], levels[-1]).astype(np.uint8)
    threshold = 1 if array.max() <= 1 else 128
    expected = [[value >= threshold for value in row] for row in array.tolist()]
    assert to_mask(Image.fromarray(array), "m").tolist() == expected


def test_a_third_value_needs_a_class(tmp_path):
    array = np.array([[0, 1, 2], [2, 3, 0]], np.uint8)
    with pytest.raises(ValueError) as excinfo:
        to_mask(Image.fromarray(array), "m.png")
    one_line(excinfo, "m.png", "4 different values", "group.yaml")
    assert np.array_equal(to_mask(Image.fromarray(array), "m.png", 2), array == 2)
    assert np.array_equal(to_mask(Image.fromarray(array), "m.png", [1, 3]), (array == 1) | (array == 3))


def test_mask_modes(tmp_path):
    pattern = RNG.random((6, 7)) > 0.5
    with pytest.raises(ValueError, match=r"m\.png: mode RGB; a mask has a single channel"):
        to_mask(Image.fromarray(PICTURE), "m.png")
    indexed = Image.fromarray((~pattern).astype(np.uint8), "P")
    indexed.putpalette([255, 255, 255, 0, 0, 0])  # white first, as some programs order it
    indexed.save(tmp_path / "p.png")
    Image.fromarray(pattern).save(tmp_path / "1.png")
    Image.fromarray(pattern.astype(np.uint16) * 65535).save(tmp_path / "16.png")
    for name in ("p.png", "1.png", "16.png"):
        assert np.array_equal(to_mask(open_image(tmp_path / name), name), pattern), name


@given(
    mask=hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, max_side=23)),
    size=st.tuples(st.integers(1, 20), st.integers(1, 20)),
)
def test_resize_mask_takes_the_nearest_pixel_centre(mask, size):
    resized = resize_mask(mask, size)
    assert resized.shape == size and resized.dtype == bool
    for i, j in np.ndindex(*size):
        at = Fraction(2 * i + 1, 2 * size[0]) * mask.shape[0], Fraction(2 * j + 1, 2 * size[1]) * mask.shape[1]
        assert resized[i, j] == mask[floor(at[0]), floor(at[1])]


# ---- pixels ----


@settings(deadline=None, max_examples=25)
@given(
    size=st.tuples(st.integers(1, 5), st.integers(1, 5)),
    shape=st.tuples(st.integers(3, 90), st.integers(3, 90)),
    resample=st.sampled_from([0, 2, 3]),
    rescale=st.booleans(),
    normalize=st.booleans(),
)
def test_pixels_are_the_processors_to_the_bit(size, shape, resample, rescale, normalize):
    size = (size[0] * 14, size[1] * 14)
    rng = np.random.default_rng(shape[0])
    images = [Image.fromarray(rng.integers(0, 255, (*shape, 3), dtype=np.uint8)) for _ in range(2)]
    options = {"resample": resample, "do_rescale": rescale, "do_normalize": normalize, "ensure_multiple_of": 14}
    exact = DPTImageProcessor(size={"height": size[0], "width": size[1]}, keep_aspect_ratio=False, **options)
    other = DPTImageProcessor(size={"height": 518, "width": 518}, keep_aspect_ratio=True, do_pad=True, **options)
    expected = exact(images=images, return_tensors="pt")["pixel_values"]
    for processor in (exact, other):
        pixels = to_pixel_values(images, processor, size)
        assert pixels.dtype == torch.float32 and pixels.is_contiguous()
        assert torch.equal(pixels, expected.float())


def test_pixels_are_what_a_pipeline_feeds_the_model(base_dir):
    image = Image.fromarray(PICTURE)
    fed = pipeline("depth-estimation", model=str(base_dir)).preprocess(image)["pixel_values"]
    assert torch.equal(to_pixel_values([image], tiny_processor(), SIZE), fed)


def test_resolve_size(model):
    class Recipe:
        size = (476, 644)

    processor = tiny_processor()
    assert resolve_size("56x70", Recipe, processor) == resolve_size([56, 70], Recipe, processor) == (56, 70)
    assert resolve_size(None, Recipe, processor) == (476, 644)
    assert resolve_size(None, None, processor) == SIZE
    for size, words in (
        ((50, 70), ["50x70", "multiples of the patch size 14", "56x70"]),
        ("big", ["'big'", "476x644"]),
    ):
        with pytest.raises(ValueError) as excinfo:
            resolve_size(size, None, processor)
        one_line(excinfo, *words)
    free = DPTImageProcessor(size={"shortest_edge": 56})
    with pytest.raises(ValueError, match="--size"):
        resolve_size(None, None, free)
    with pytest.raises(ValueError, match="patch size 14"):
        resolve_size((50, 70), None, free, model.config)  # the processor does not know, the model does


# ---- groups ----


def row(count=2, size=(40, 60), **columns):
    rng = np.random.default_rng(count)
    pictures = [Image.fromarray(rng.integers(0, 255, (*size, 3), dtype=np.uint8)) for _ in range(count)]
    mask = np.zeros(size, np.uint8)
    mask[10:20, 10:30] = 255
    return {
        "group_id": "g7",
        "surface": 1,
        "image_names": [f"{index}.png" for index in range(count)],
        "images": pictures,
        "masks": [Image.fromarray(mask)] * count,
        "valids": [],
        "depths": [],
        "reference": None,
        **columns,
    }


def test_collate_group():
    depth = RNG.integers(0, 60000, (40, 60), dtype=np.uint16)
    valid = np.ones((40, 60), np.uint8)
    valid[:, :30] = 0
    proxies = torch.rand(2, *SIZE)
    group = collate_group(
        row(
            depths=[Image.fromarray(depth)] * 2,
            valids=[Image.fromarray(valid)] * 2,
            reference=Image.fromarray(PICTURE),
            proxies=proxies,
            reference_proxy=proxies[0],
        ),
        tiny_processor(),
        SIZE,
    )
    assert (group.group_id, group.surface, group.names) == ("g7", "transparent", ["0.png", "1.png"])
    assert group.pixel_values.shape == (2, 3, *SIZE) and group.reference_pixel_values.shape == (1, 3, *SIZE)
    assert group.mask.dtype == torch.bool and group.mask.shape == (2, *SIZE)
    assert group.mask.float().mean().item() == pytest.approx(200 / 2400, abs=0.01)
    assert not group.valid[:, :, :35].any() and group.valid[:, :, 35:].all()
    assert torch.equal(group.target, proxies) and torch.equal(group.reference_target, proxies[0])
    assert np.array_equal(group.pictures.depths[1], depth) and group.pictures.masks[0].sum() == 200
    plain = collate_group(row(), tiny_processor(), SIZE)
    assert plain.valid is plain.target is plain.reference_target is plain.reference_pixel_values is None
    assert not plain.pictures.depths and not plain.pictures.valids


def small(dtype=np.uint8):
    return Image.fromarray(np.zeros((30, 60), dtype))


@pytest.mark.parametrize(
    "columns, words",
    [
        ({"masks": [small()] * 2}, ["mask of 0.png is 30x60", "40x60"]),
        ({"masks": [small()]}, ["2 image names, but 1 masks"]),
        ({"valids": [small()] * 2}, ["valid mask of 0.png is 30x60"]),
        ({"depths": [small(np.uint16)] * 2}, ["depth of 0.png is 30x60"]),
        ({"reference": Image.fromarray(PICTURE[:30])}, ["reference is 30x60"]),
        ({"reference": Image.fromarray(PICTURE).convert("CMYK")}, ["reference", "CMYK"]),
        ({"proxies": torch.zeros(2, 28, 28)}, ["28x28", "56x70", "gift-peft proxies"]),
    ],
)
def test_collate_group_refuses(columns, words):
    with pytest.raises(ValueError) as excinfo:
        collate_group(row(**columns), tiny_processor(), SIZE)
    one_line(excinfo, "g7", *words)


def test_images_of_one_group_have_one_size():
    images = [Image.fromarray(PICTURE), Image.fromarray(PICTURE[:30])]
    with pytest.raises(ValueError, match=r"g7: the image of 1.png is 30x60 .* 40x60"):
        collate_group(row(images=images), tiny_processor(), SIZE)
