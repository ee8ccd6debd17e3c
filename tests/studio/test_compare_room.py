"""The Compare room against `DepthModel` and `set_adapter_scale` themselves."""

import threading

import numpy as np
import pytest
import trimesh
from helpers.exports import write_adapter
from helpers.photos import scene
from helpers.tiny import SIZE, tiny_model, tiny_processor
from PIL import Image

from gift_peft import DepthModel
from gift_peft.adapters.scale import set_adapter_scale
from gift_peft.colormap import colorize
from gift_peft.studio.compare_room import CompareRoom

pytestmark = pytest.mark.filterwarnings("ignore:the base is the local folder", "ignore:.is_gradient_checkpointing")


@pytest.fixture(scope="module")
def adapter(tmp_path_factory):
    return write_adapter(tmp_path_factory.mktemp("adapter"), tiny_model(), tiny_processor(), SIZE)


@pytest.fixture
def room(adapter, tmp_path):
    return CompareRoom(DepthModel.from_pretrained(None, adapter), tmp_path / "own")


@pytest.fixture
def photo(tmp_path):
    Image.fromarray(scene(0, (90, 120))).save(tmp_path / "photo.png")
    return tmp_path / "photo.png"


@pytest.mark.parametrize("scale", [0.0, 0.35, 1.0])
def test_it_shows_what_the_model_predicts_at_the_scale(room, adapter, photo, scale):
    (base, adapted), told = room.compare(photo, scale)
    model = DepthModel.from_pretrained(None, adapter)
    set_adapter_scale(model.network, scale)
    depths = model.depth_at(photo, base=True), model.depth_at(photo)
    low, high = np.percentile(np.concatenate([depth.ravel() for depth in depths]), (1, 99)).tolist()
    for picture, depth in zip((base, adapted), depths, strict=True):
        assert np.array_equal(np.asarray(picture), colorize(depth, low, high, "inverse_depth"))
    assert f"adapter at {scale:.2f}" in told and ("average 0.0%" in told) == (scale == 0)
    assert np.array_equal(np.asarray(base), np.asarray(adapted)) == (scale == 0)


def test_another_photo_under_the_same_name_is_another(room, photo):
    before = room.compare(photo, 0.5)[0][0]
    Image.fromarray(scene(1, (90, 120))).save(photo)
    assert np.asarray(before).tobytes() != np.asarray(room.compare(photo, 0.5)[0][0]).tobytes()


def test_tabs_that_move_the_slider_at_once_get_their_own_scale(room, photo):
    expected = {scale: np.asarray(room.compare(photo, scale)[0][1]) for scale in (0.0, 0.5, 1.0)}
    wrong = []

    def tab(scale):
        for _ in range(4):
            if not np.array_equal(np.asarray(room.compare(photo, scale)[0][1]), expected[scale]):
                wrong.append(scale)

    tabs = [threading.Thread(target=tab, args=[scale]) for scale in expected]
    [one.start() for one in tabs]
    [one.join() for one in tabs]
    assert not wrong


def test_the_points_are_those_of_the_camera(room, photo):
    path = room.points(photo, 1.0, 90.0)
    cloud = next(iter(trimesh.load(path).geometry.values()))
    assert 90 * 120 / 2 < len(cloud.vertices) <= 90 * 120 and path.is_relative_to(room.temporary)
    x, y, z = np.asarray(cloud.vertices).T
    away = -(z - 1)  # the scene's middle distance is at the origin, and the camera looks along -z
    assert away.min() > 0 and np.abs(x / away).max() == pytest.approx(119 / 120, abs=0.02)  # 90 degrees across
    assert np.abs(y / away).max() <= 89 / 120 + 0.02
    shares = scene(0, (90, 120)).reshape(-1, 3) / 255  # sRGB; glTF has linear colors
    light = np.where(shares > 0.04045, ((shares + 0.055) / 1.055) ** 2.4, shares / 12.92)
    assert {tuple(one) for one in cloud.colors[:, :3]} <= {tuple(one) for one in np.round(255 * light).astype(int)}


def test_a_base_alone_is_shown_without_a_scale(photo, tmp_path):
    room = CompareRoom(DepthModel(tiny_model().eval(), tiny_processor(), SIZE), tmp_path / "own")
    (base, adapted), told = room.compare(photo, 1.0)
    assert np.array_equal(np.asarray(base), np.asarray(adapted)) and "--adapter" in told


@pytest.mark.parametrize("scale", [-0.1, 1.5, float("nan")])
def test_a_scale_beyond_the_slider_is_refused(room, photo, scale):
    with pytest.raises(ValueError, match="from 0 to 1"):
        room.compare(photo, scale)


def test_what_is_no_photo_is_told(room, tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"")
    with pytest.raises(ValueError, match=r"a\.jpg: not a readable image"):
        room.compare(tmp_path / "a.jpg", 1.0)
