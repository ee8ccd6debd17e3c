"""Stored predictions: every format gives the same numbers, names are strict, and what is odd is named."""

import numpy as np
import pytest
from helpers.booster_tree import write_scene
from PIL import Image

from gift_peft.evaluation.booster_scenes import find_booster
from gift_peft.evaluation.stored_predictions import PredictionFolder

VALUES = np.arange(12, dtype=np.float32).reshape(3, 4) + 1


def write_pfm(path, values, order="<", kind=b"Pf"):
    """Rows from the bottom up, as the format has them."""
    header = kind + b"\n%d %d\n%s\n" % (values.shape[1], values.shape[0], b"-1.0" if order == "<" else b"1.0")
    path.write_bytes(header + np.flipud(values).astype(f"{order}f4").tobytes())


WRITERS = {
    "npy": lambda path: np.save(path, VALUES),
    "float16.npy": lambda path: np.save(path, VALUES.astype(np.float16)),
    "int.npy": lambda path: np.save(path, VALUES.astype(np.int32)),
    "npz": lambda path: np.savez(path, depth=VALUES),
    "compressed.npz": lambda path: np.savez_compressed(path, VALUES),
    "png": lambda path: Image.fromarray(VALUES.astype(np.uint16)).save(path),
    "pfm": lambda path: write_pfm(path, VALUES),
    "big-endian.pfm": lambda path: write_pfm(path, VALUES, ">"),
}


@pytest.fixture
def stored(tmp_path):
    """The scene, its first image and where that image's prediction goes."""
    write_scene(tmp_path / "data" / "S", size=(12, 16), images=2)
    (scene,) = find_booster(tmp_path / "data").scenes
    place = tmp_path / "pred" / "S" / "camera_00"
    place.mkdir(parents=True)
    return scene, scene.images[0], place


@pytest.mark.parametrize("form", WRITERS)
def test_every_format_gives_the_same_numbers(stored, form):
    scene, image, place = stored
    WRITERS[form](place / f"im0.{form.rpartition('.')[2]}")
    read = PredictionFolder(place.parents[1]).read(scene, image)
    np.testing.assert_array_equal(read, VALUES)
    assert read.dtype == np.float32
    np.testing.assert_allclose(PredictionFolder(place.parents[1], 1 / 256).read(scene, image), VALUES / 256, rtol=1e-7)


def test_doubles_stay_doubles_and_arrays_come_before_pictures(stored):
    scene, image, place = stored
    Image.new("RGB", (4, 3)).save(place / "im0.png")
    np.save(place / "im0.npy", VALUES.astype(np.float64) + 1e-12)
    read = PredictionFolder(place.parents[1]).read(scene, image)
    assert read.dtype == np.float64 and read[0, 0] == 1 + 1e-12


def test_missing_ones_are_listed_and_names_are_strict(stored):
    scene, image, place = stored
    folder = PredictionFolder(place.parents[1])
    with pytest.raises(FileNotFoundError, match=r"2 missing \(as .npy, .*S/camera_00/im0, S/camera_00/im1$"):
        folder.check([scene])
    np.save(place / "im1.npy", VALUES)
    np.save(place / "IM0.npy", VALUES)
    np.save(place / "im0.NPY.npy", VALUES)
    with pytest.raises(FileNotFoundError, match=r"1 missing .*: S/camera_00/im0$"):
        folder.check([scene])
    with pytest.raises(FileNotFoundError, match="S/camera_00/im0 is missing"):
        folder.read(scene, image)
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        PredictionFolder(place / "nowhere")
    with pytest.raises(ValueError, match="prediction_scale 0"):
        PredictionFolder(place, 0)


def test_pictures_need_a_scale_where_the_protocol_fits_none(stored):
    scene, _, place = stored
    for index in range(2):
        Image.fromarray(VALUES.astype(np.uint16)).save(place / f"im{index}.png")
    PredictionFolder(place.parents[1]).check([scene])
    PredictionFolder(place.parents[1], 0.001).check([scene], needs_scale=True)
    with pytest.raises(ValueError, match=r"im0\.png: the protocol fits no scale"):
        PredictionFolder(place.parents[1]).check([scene], needs_scale=True)


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("im0.npy", lambda path: np.save(path, np.where(VALUES == 3, np.nan, VALUES)), "has 1 NaN or infinite"),
        ("im0.npy", lambda path: np.save(path, np.where(VALUES == 3, np.inf, VALUES)), "has 1 NaN or infinite"),
        ("im0.npy", lambda path: np.save(path, VALUES[None]), r"float32 \(1, 3, 4\)"),
        ("im0.npy", lambda path: np.save(path, VALUES > 3), "bool"),
        ("im0.npy", lambda path: np.save(path, np.empty((0, 4))), r"float64 \(0, 4\)"),
        ("im0.npy", lambda path: np.save(path, np.array([{}]), allow_pickle=True), "not a readable prediction"),
        ("im0.npy", lambda path: path.write_bytes(b"not numpy"), "not a readable prediction"),
        ("im0.npz", lambda path: np.savez(path, a=VALUES, b=VALUES), r"2 arrays \(a, b\) where one is expected"),
        ("im0.npz", lambda path: path.write_bytes(b"PK\x03\x04 broken"), "not a readable prediction"),
        ("im0.png", lambda path: Image.fromarray(VALUES.astype(np.uint8)).save(path), "mode L; .*16-bit grey"),
        ("im0.png", lambda path: path.write_bytes(b"nothing"), "not a readable image"),
        ("im0.pfm", lambda path: path.write_bytes(b"Pf\n4 3\n-1.0\n" + bytes(20)), "not a readable image"),
        ("im0.pfm", lambda path: write_pfm(path, VALUES, kind=b"PF"), "not a readable image"),
    ],
)
def test_odd_files_are_named(stored, name, write, message):
    scene, image, place = stored
    write(place / name)
    with pytest.raises(ValueError, match=rf"{name}: .*{message}"):
        PredictionFolder(place.parents[1]).read(scene, image)
