"""Point clouds: geometry, edges and files."""

import io

import numpy as np
import pytest

from gift_peft.deploy.intrinsics import Intrinsics
from gift_peft.deploy.pointcloud import cut_edges, encode_points, to_points


def test_a_plane_stays_a_plane_and_whole():
    """z = 2 + 0.5 x + 0.3 y, met by the rays of a camera: a slanted wall loses no point, however steep."""
    camera = Intrinsics.from_fov(80, 90, 60)
    rays = camera.rays()
    depth = 2 / (1 - 0.5 * rays[..., 0] - 0.3 * rays[..., 1])
    picture = np.random.default_rng(0).integers(0, 255, (60, 90, 3), dtype=np.uint8)
    points, colors = to_points(depth, picture, camera)
    assert len(points) == 60 * 90 and points.dtype == np.float32
    np.testing.assert_allclose(points[:, 2], 2 + 0.5 * points[:, 0] + 0.3 * points[:, 1], rtol=1e-5)
    np.testing.assert_array_equal(colors, picture.reshape(-1, 3))


def test_the_veil_between_two_surfaces_is_cut():
    row = np.r_[np.full(20, 1.0), np.linspace(1, 3, 6)[1:-1], np.full(20, 3.0)]
    depth = np.tile(row, (10, 1))
    kept = cut_edges(depth)
    assert not kept[:, 20:24].all(1).any() and kept[:, :19].all() and kept[:, 25:].all()
    depth[4, 4], depth[5, 5] = 0, np.nan
    assert not cut_edges(depth)[4, 4] and not cut_edges(depth)[5, 5]


@pytest.mark.parametrize("form", ["ply", "glb"])
def test_files_are_read_back_by_trimesh(form):
    trimesh = pytest.importorskip("trimesh", reason="the extra `pointcloud` is not installed")
    points = np.float32([[0, 1, 2], [3, 4, 5]])
    colors = np.uint8([[255, 0, 0], [0, 128, 255]])
    loaded = trimesh.load(io.BytesIO(encode_points(points, colors, form)), file_type=form)
    cloud = loaded if form == "ply" else next(iter(loaded.geometry.values()))
    flip = [1, 1, 1] if form == "ply" else [1, -1, -1]
    np.testing.assert_allclose(cloud.vertices, points * flip)
    expected = colors if form == "ply" else [[255, 0, 0], [0, 55, 255]]  # 128 of 255 in sRGB is 22 % of the light
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], expected)
