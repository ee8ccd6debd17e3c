"""Taped distances: exact where the prediction is, robust from six points on, clear about what is wrong."""

from pathlib import Path

import numpy as np
import pytest
from helpers.records import one_line

from gift_peft.deploy.calibration import Calibration
from gift_peft.deploy.intrinsics import Intrinsics

SIZE = 40, 50
PHOTO = Path("photo.jpg")


def scene(kind="inverse_depth"):
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    depth = 1 + 0.03 * row + 0.02 * column
    return depth, ((1 / depth if kind == "inverse_depth" else depth) - 0.1) / 2.5


def table(path, depth, pixels, column="depth_m", factor=1.0):
    lines = [f"{x},{y},{depth[y, x] * factor}" for x, y in pixels]
    path.write_text("\n".join([f"x,y,{column}", *lines]) + "\n")
    return Calibration.read(path)


@pytest.mark.parametrize("kind", ["inverse_depth", "depth"])
@pytest.mark.parametrize(("column", "factor"), [("depth_m", 1), ("depth_mm", 1000)])
def test_two_points_make_a_perfect_prediction_metric(kind, column, factor, tmp_path):
    depth, prediction = scene(kind)
    found, worst = table(tmp_path / "p.csv", depth, [(1, 2), (45, 30)], column, factor).apply(
        PHOTO, prediction, kind, None
    )
    np.testing.assert_allclose(found, depth, rtol=1e-5)
    assert worst < 1e-4


def test_one_wrong_tape_of_seven_is_outvoted_and_told(tmp_path):
    depth, prediction = scene()
    taped = depth.copy()
    taped[20, 25] *= 2
    pixels = [(1, 2), (45, 30), (10, 35), (30, 5), (25, 20), (40, 12), (5, 20), (20, 10)]
    found, worst = table(tmp_path / "p.csv", taped, pixels).apply(PHOTO, prediction, "inverse_depth", None)
    np.testing.assert_allclose(found, depth, rtol=1e-3)
    assert worst == pytest.approx(depth[20, 25], rel=0.01)


def test_a_tape_measures_along_the_line_of_sight(tmp_path):
    depth, prediction = scene()
    camera = Intrinsics.from_fov(90, SIZE[1], SIZE[0])
    taped = depth * np.linalg.norm(camera.rays(), axis=-1)
    calibration = table(tmp_path / "p.csv", taped, [(1, 2), (45, 30), (10, 35)], "distance_m")
    np.testing.assert_allclose(calibration.apply(PHOTO, prediction, "inverse_depth", camera)[0], depth, rtol=1e-5)
    with pytest.raises(ValueError, match="along the line of sight take a camera"):
        calibration.apply(PHOTO, prediction, "inverse_depth", None)


def test_one_point_fixes_a_factor(tmp_path):
    depth, _ = scene()
    calibration = table(tmp_path / "p.csv", depth, [(25, 20)])
    np.testing.assert_allclose(calibration.apply(PHOTO, 7 / depth, "inverse_depth", None)[0], depth, rtol=1e-5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["columns x, y and one of depth_m"]),
        ("x,y\n1,2\n", ["columns x, y and one of depth_m"]),
        ("x,y,depth_m,depth_mm\n1,2,3,4\n", ["one of"]),
        ("x,y,depth_m\n1,two,3\n", ["line 2, y", "'two' is not a number"]),
        ("x,y,depth_m\n1,2,nan\n", ["line 2, depth_m"]),
        ("x,y,depth_m\n1,2,3\n4,5,-1\n", ["line 3, depth_m", "-1 is not positive"]),
        ("image,x,y,depth_m\na.jpg,1,2,3\n,1,2,3\n", ["some lines name an image"]),
    ],
)
def test_a_table_that_is_none_says_where(text, words, tmp_path):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(ValueError) as error:
        Calibration.read(tmp_path / "p.csv")
    one_line(error, tmp_path / "p.csv", *words)


def test_points_that_do_not_go_with_the_photo_are_errors(tmp_path):
    depth, prediction = scene()
    path = tmp_path / "p.csv"
    path.write_text("x,y,depth_m\n1,2,1\n70,2,1\n")
    with pytest.raises(ValueError, match=r"the point 70, 2 is outside photo\.jpg \(50x40\)"):
        Calibration.read(path).apply(PHOTO, prediction, "inverse_depth", None)
    backwards = table(path, 3 / depth, [(1, 2), (45, 30)])
    with pytest.raises(ValueError, match=r"photo\.jpg contradict the prediction: nearer ones are predicted farther"):
        backwards.apply(PHOTO, prediction, "inverse_depth", None)
    with pytest.raises(ValueError, match="differ in distance, but the model sees them equally far"):
        table(path, depth, [(1, 2), (45, 30)]).apply(PHOTO, np.ones(SIZE), "inverse_depth", None)
    path.write_text("image,x,y,depth_m\nother.jpg,1,2,1\n")
    with pytest.raises(ValueError, match=r"image other\.jpg is none of the photos"):
        Calibration.read(path).check([PHOTO])
