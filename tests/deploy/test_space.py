"""The Space: its folder, its pictures and scenes, and (slow) the page itself in a browser without a network."""

import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.exports import write_adapter
from helpers.tiny import tiny_model, tiny_processor
from PIL import Image

from gift_peft.cli import main
from gift_peft.colormap import colorize as by_opencv
from gift_peft.deploy.space_app import colorize, distances, write_scene

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def read_glb(path: Path) -> tuple[dict, bytes]:
    content = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", content[:12])
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack("<I4s", content[12:20])
    assert kind == b"JSON" and size % 4 == 0
    binary, kind = struct.unpack("<I4s", content[20 + size : 28 + size])
    assert kind == b"BIN\0" and len(content) == 28 + size + binary
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def test_colors_are_those_of_predict():
    depth = np.linspace(0, 1, 500, dtype=np.float32).reshape(20, 25)
    for kind in ("inverse_depth", "depth"):
        ours = np.asarray(colorize(depth, 0, 1, kind == "inverse_depth"), int)
        assert np.abs(ours - by_opencv(depth, 0, 1, kind)).max() < 8  # 17 places of a table of 256


def test_a_scene_is_the_surface_and_no_wall(tmp_path):
    z = np.ones((60, 80), np.float32)
    z[:, 40:] = 2  # a step
    picture = Image.fromarray(np.full((60, 80, 3), (200, 10, 30), np.uint8))
    write_scene(tmp_path / "a.glb", picture, z, field_of_view=90)
    scene, binary = read_glb(tmp_path / "a.glb")
    count = scene["accessors"][0]["count"]
    assert count == 60 * 80 and scene["buffers"][0]["byteLength"] == len(binary)
    views = [(view["byteOffset"], view["byteLength"]) for view in scene["bufferViews"]]
    points, colors, triangles = (binary[start : start + length] for start, length in views)
    points = np.frombuffer(points, "<f4").reshape(-1, 3)
    triangles = np.frombuffer(triangles, "<u4").reshape(-1, 3)
    assert np.frombuffer(colors, np.uint8).reshape(-1, 4)[0].tolist() == [147, 1, 3, 255]  # (200, 10, 30) as light
    assert len(triangles) == 2 * 59 * (79 - 1)  # one column of squares lies on the step
    depths = -(points[:, 2] - 1)
    assert np.ptp(depths[triangles], axis=1).max() < 0.1
    # 90 degrees: the outermost column lies as far to the side as it is away.
    right = points.reshape(60, 80, 3)[:, -1]
    assert np.allclose(right[:, 0], depths.reshape(60, 80)[:, -1] * 39.5 / 40, rtol=1e-5)
    assert scene["accessors"][0]["max"] == points.max(0).tolist()


def test_inverse_depth_becomes_a_distance():
    inverse = np.linspace(3, 9, 100).reshape(10, 10)
    z = distances(inverse, near_is_large=True)
    assert np.all(np.diff(z.ravel()) <= 0) and 0.2 < z.min() < 0.3 and z.max() == 1
    assert np.array_equal(distances(inverse, near_is_large=False), inverse)


def test_examples_and_scales_are_of_their_forms(tmp_path, capsys):
    for words in (["--to=onnx", "--examples", "a.jpg"], ["--to=space", "--adapter-scale=1"]):
        with pytest.raises(SystemExit) as end:
            main(["deploy", "adapter", str(tmp_path / "out"), *words])
        assert end.value.code == 2
    assert capsys.readouterr().err.count("gift-peft deploy: error") == 2


@pytest.fixture(scope="module")
def space(tmp_path_factory):
    pytest.importorskip("gradio")
    adapter = write_adapter(tmp_path_factory.mktemp("adapter"), tiny_model(), tiny_processor(), (56, 84))
    with pytest.raises(SystemExit) as end:
        main(["deploy", str(adapter), str(adapter.parent / "space"), "--to", "space"])
    assert end.value.code == 0
    return adapter.parent / "space"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the base is the local folder", "ignore::DeprecationWarning")
def test_the_folder_is_a_space(space):
    card = (space / "README.md").read_text()
    front = yaml.safe_load(card.split("---")[1])
    assert front["sdk"] == "gradio" and front["app_file"] == "app.py" and front["sdk_version"][0].isdigit()
    assert (space / "requirements.txt").read_text().startswith(f"gradio=={front['sdk_version']}\n")
    assert len(front["short_description"]) <= 60
    examples = sorted((space / "examples").iterdir())
    assert len(examples) == 3 and all(Image.open(path).mode == "RGB" for path in examples)
    assert str(space.parent) not in card + (space / "about.json").read_text() + (space / "preprocess.json").read_text()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
@pytest.mark.filterwarnings("ignore:the base is the local folder", "ignore::DeprecationWarning")
def test_the_page_in_a_browser_without_a_network(space, tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    settings = {"GRADIO_SERVER_PORT": str(port), "GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_OFFLINE": "1"}
    server = subprocess.Popen([sys.executable, "app.py"], cwd=space, env=os.environ | settings)
    try:
        _wait(port)
        with playwright.sync_playwright() as tool:
            browser = tool.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
            page = browser.new_page()
            asked, failed = [], []
            page.on("request", lambda request: asked.append(request.url))
            page.on("pageerror", lambda error: failed.append(str(error)))
            page.goto(f"http://127.0.0.1:{port}", timeout=120_000)
            page.locator("#photo input[type=file]").set_input_files(str(next((space / "examples").iterdir())))
            page.get_by_text("% from the base").wait_for(timeout=120_000)
            assert page.locator("#depths img").count() >= 2
            page.screenshot(path=tmp_path / "page.png", full_page=True)
            browser.close()
        elsewhere = [url for url in asked if not url.startswith((f"http://127.0.0.1:{port}", "data:", "blob:"))]
        assert not elsewhere and not failed
    finally:
        server.terminate()
        server.wait(20)


def _wait(port: int) -> None:
    for _ in range(240):
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5).read()
            return
        except OSError:
            time.sleep(0.5)
    raise AssertionError("the page does not answer")
