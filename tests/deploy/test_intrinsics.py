"""Cameras from files, fields of view and EXIF."""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from gift_peft.deploy.intrinsics import Intrinsics


def test_field_of_view_reaches_the_border():
    camera = Intrinsics.from_fov(90, 640, 480)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((320, 320, 319.5, 239.5))
    half = Intrinsics.from_fov(60, 100, 50).rays()[0, :, 0]
    assert math.degrees(math.atan(-half[0] + 0.5 / (50 / math.tan(math.radians(30))))) == pytest.approx(30, abs=1e-6)


def test_yaml_of_three_kinds(tmp_path):
    (tmp_path / "a.yaml").write_text("xres: 1280\nyres: 720\nfx: 921\nfy: 920\ncx: 642\ncy: 359\n")
    ros = "image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    (tmp_path / "b.yaml").write_text(ros + "  data: [500, 0, 320, 0, 501, 240, 0, 0, 1]\n")
    (tmp_path / "c.yaml").write_text("width: 640\nheight: 480\nK: [500, 0, 320, 0, 501, 240, 0, 0, 1]\n")
    assert Intrinsics.from_yaml(tmp_path / "a.yaml") == Intrinsics(921, 920, 642, 359, 1280, 720)
    for name in "bc":
        assert Intrinsics.from_yaml(tmp_path / f"{name}.yaml") == Intrinsics(500, 501, 320, 240, 640, 480)
    half = Intrinsics.from_yaml(tmp_path / "a.yaml").at(640, 360, "x.jpg")
    assert (half.fx, half.cx, half.cy) == pytest.approx((460.5, 320.75, 179.25))
    with pytest.raises(ValueError, match=r"x\.jpg: 640x480, but the camera's pictures are 1280x720"):
        Intrinsics.from_yaml(tmp_path / "a.yaml").at(640, 480, "x.jpg")
    (tmp_path / "d.yaml").write_text("fx: 921\nwidth: 4\nheight: -3\n")
    with pytest.raises(ValueError, match=r"camera .*d\.yaml: no positive number for fy, cx, cy, height; it takes"):
        Intrinsics.from_yaml(tmp_path / "d.yaml")
    with pytest.raises(FileNotFoundError, match=r"camera .*gone"):
        Intrinsics.from_yaml(tmp_path / "gone.yaml")


def save(path: Path, tags: dict, orientation=None, size=(60, 40)):
    exif = Image.Exif()
    if orientation:
        exif[ExifTags.Base.Orientation] = orientation
    exif.get_ifd(ExifTags.IFD.Exif).update(tags)
    Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(path, exif=exif)
    return path


def test_exif_by_equivalent_and_by_focal_plane(tmp_path):
    """A full-frame camera with a 36 mm lens has a focal length of one picture's width, however it says so."""
    equivalent = save(tmp_path / "a.jpg", {ExifTags.Base.FocalLengthIn35mmFilm: 36})
    assert Intrinsics.from_exif(equivalent).fx == pytest.approx(60, rel=1e-6)
    turned = Intrinsics.from_exif(save(tmp_path / "b.jpg", {ExifTags.Base.FocalLengthIn35mmFilm: 36}, orientation=6))
    assert (turned.width, turned.height) == (40, 60) and turned.fx == pytest.approx(60, rel=1e-6)
    plane = {ExifTags.Base.FocalLength: 36.0, ExifTags.Base.FocalPlaneXResolution: 600 / 36 * 25.4}
    plane |= {ExifTags.Base.FocalPlaneResolutionUnit: 2, ExifTags.Base.ExifImageWidth: 600}
    assert Intrinsics.from_exif(save(tmp_path / "c.jpg", plane)).fx == pytest.approx(60, rel=1e-4)
    assert Intrinsics.from_exif(save(tmp_path / "d.jpg", {})) is None
    (tmp_path / "e.jpg").write_bytes(b"no picture")
    assert Intrinsics.from_exif(tmp_path / "e.jpg") is None
