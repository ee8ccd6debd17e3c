"""Files of a depth sensor: units, holes, sizes, and which belongs to which photo."""

from pathlib import Path

import numpy as np
import pytest
from helpers.records import one_line
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from gift_peft.deploy.sensor_files import SensorFiles, pair_files, read_depth, to_size

DEPTH = np.array([[500, 1500, 0], [2500, 65535, 900]], np.uint16)


def names(pairs):
    return {photo.name: file.name for photo, file in pairs.items()}


def paths(*stems):
    return [Path(stem) for stem in stems]


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_pictures_are_millimetres_and_65535_is_a_hole(suffix, tmp_path):
    Image.fromarray(DEPTH).save(tmp_path / f"d.{suffix}")
    expected = np.array([[0.5, 1.5, 0], [2.5, 0, 0.9]])
    np.testing.assert_allclose(read_depth(tmp_path / f"d.{suffix}"), expected)
    np.testing.assert_allclose(read_depth(tmp_path / f"d.{suffix}", "0.0001"), expected / 10)


def test_npy_is_metres_or_whole_millimetres_and_what_is_not_a_distance_is_a_hole(tmp_path):
    np.save(tmp_path / "m.npy", np.float32([[0.5, np.nan, np.inf], [-np.inf, -1, 0.9]]))
    np.testing.assert_allclose(read_depth(tmp_path / "m.npy"), [[0.5, 0, 0], [0, 0, 0.9]], rtol=1e-6)
    np.save(tmp_path / "mm.npy", DEPTH)
    np.testing.assert_allclose(read_depth(tmp_path / "mm.npy"), [[0.5, 1.5, 0], [2.5, 0, 0.9]])
    np.save(tmp_path / "channel.npy", np.float32(DEPTH / 1000)[..., None])
    assert read_depth(tmp_path / "channel.npy").shape == (2, 3)


def test_what_is_no_depth_or_in_another_unit_is_one_line(tmp_path):
    Image.fromarray((DEPTH > 0).astype(np.uint8) * 255).save(tmp_path / "eight.png")
    Image.fromarray(np.zeros((2, 3, 3), np.uint8)).save(tmp_path / "rgb.png")
    Image.fromarray(np.zeros((2, 3), np.uint16)).save(tmp_path / "zero.png")
    Image.fromarray(np.ones((2, 3), np.uint16) * 2).save(tmp_path / "metres.png")
    np.save(tmp_path / "millimetres.npy", DEPTH.astype(np.float32))
    np.save(tmp_path / "cube.npy", np.ones((2, 2, 2)))
    (tmp_path / "broken.npy").write_bytes(b"no")
    wrong = {
        "eight.png": ["an 8-bit picture", "16-bit PNG in mm"],
        "rgb.png": ["a picture of mode RGB"],
        "zero.png": ["no depth at all"],
        "metres.png": ["taken as mm", "--sensor-unit m"],
        "millimetres.npy": ["taken as m", "--sensor-unit mm"],
        "cube.npy": ["(2, 2, 2)"],
        "broken.npy": ["not a readable npy file"],
    }
    for name, words in wrong.items():
        with pytest.raises(ValueError) as error:
            read_depth(tmp_path / name)
        one_line(error, tmp_path / name, *words)
    with pytest.raises(FileNotFoundError, match=r"gone\.npy: no such file"):
        read_depth(tmp_path / "gone.npy")


def test_another_size_of_the_same_view_is_taken_and_another_shape_is_not():
    values = np.arange(12.0).reshape(3, 4)
    np.testing.assert_array_equal(to_size(values, (6, 8), "d.png", "sensor depth")[::2, ::2], values)
    with pytest.raises(ValueError, match=r"d\.png: the sensor depth is 3x4 .* the photo 6x6: another camera"):
        to_size(values, (6, 6), "d.png", "sensor depth")


def test_names_pair_by_themselves_and_without_the_words_for_their_kind():
    assert names(pair_files(paths("a.jpg", "b.jpg"), paths("b.png", "a.npy", "c.png"), "depth", 0.02)) == {
        "a.jpg": "a.npy",
        "b.jpg": "b.png",
    }
    found = pair_files(
        paths("01-transparent-rgb-img.jpg", "x_Color_7.png"), paths("x_Depth_7.png", "01_depth.png"), "d", 0
    )
    assert names(found) == {"01-transparent-rgb-img.jpg": "01_depth.png", "x_Color_7.png": "x_Depth_7.png"}
    assert names(pair_files(paths("photo.jpg"), paths("anything.png"), "depth", 0)) == {"photo.jpg": "anything.png"}
    with pytest.raises(ValueError, match=r"both a\.npy and a\.png would belong to one photo"):
        pair_files(paths("a.jpg", "b.jpg"), paths("a.npy", "a.png"), "depth", 0.02)
    with pytest.raises(ValueError, match=r"would belong to both u/a\.jpg and v/a\.jpg"):
        pair_files(paths("u/a.jpg", "v/a.jpg"), paths("a.png", "b.png"), "depth", 0.02)
    with pytest.raises(ValueError, match=r"no depth belongs to a photo by its name: a\.jpg beside x\.png"):
        pair_files(paths("a.jpg", "b.jpg"), paths("x.png", "y.png"), "depth", 0.02)


@pytest.mark.parametrize("factor", [1, 1e3, 1e6, 1e9])
def test_times_in_names_pair_within_a_tolerance(factor):
    """Seconds as TUM writes them, and whole ms, us and ns as cameras do."""

    def name(seconds):
        return f"{seconds:.6f}.png" if factor == 1 else f"frame_{round(seconds * factor)}.png"

    begin = 1305031102.175
    photos = paths(*(name(begin + 0.033 * index) for index in range(5)))
    files = paths(*(name(begin + 0.033 * index + 0.011) for index in (0, 1, 3, 4)))
    found = pair_files(photos, files, "depth", 0.02)
    assert [photos.index(photo) for photo in found] == [0, 1, 3, 4]
    assert [files.index(file) for file in found.values()] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match=r"name or time within 0\.005 s"):
        pair_files(photos, files, "depth", 0.005)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(0, 400), min_size=2, max_size=8, unique=True),
    st.lists(st.integers(0, 400), min_size=2, max_size=8, unique=True),
)
def test_no_file_is_used_twice_and_no_pair_is_too_far_apart(first, second):
    start = 1_700_000_000.0
    photos, files = (paths(*(f"{start + 0.001 * value:.4f}.png" for value in side)) for side in (first, second))
    files = [path.with_suffix(".npy") for path in files]
    try:
        found = pair_files(photos, files, "depth", 0.02)
    except ValueError:
        found = {}
    assert len(set(found.values())) == len(found)
    assert all(abs(float(photo.stem) - float(file.stem)) < 0.0201 for photo, file in found.items())


def test_masks_must_be_there_for_every_photo_with_depth(tmp_path):
    for folder, stems in (("depth", "ab"), ("mask", "a")):
        (tmp_path / folder).mkdir()
        for stem in stems:
            Image.fromarray(np.full((2, 3), 255, np.uint16 if folder == "depth" else np.uint8)).save(
                tmp_path / folder / f"{stem}.png"
            )
    photos = paths("a.jpg", "b.jpg")
    assert len(SensorFiles.find(photos, tmp_path / "depth").depths) == 2
    with pytest.raises(ValueError, match=r"b\.jpg: no mask in .*mask"):
        SensorFiles.find(photos, tmp_path / "depth", tmp_path / "mask")
    with pytest.raises(FileNotFoundError, match=r"sensor depth .*nowhere: no such file or folder"):
        SensorFiles.find(photos, tmp_path / "nowhere")
