"""The server's door: which requests come through, to whom it listens, and what it leaves behind."""

import asyncio
import os
import socket
from types import SimpleNamespace
from urllib.request import proxy_bypass_environment

import numpy as np
import pytest
from PIL import Image

from gift_peft.studio import server
from gift_peft.studio.compare_room import CompareRoom
from gift_peft.studio.server import Guard, Rooms, build, check_gradio, free_port, private_folder

PORT = 7860
OWN = {"host": f"127.0.0.1:{PORT}"}


def answer(path, headers=OWN, kind="http", folder="/nowhere"):
    """(status, headers) that a request gets; 200 is what stands behind the door."""

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": [(b"x", b"y")]})
        await send({"type": "http.response.body", "body": b""})

    sent = []

    async def send(message):
        sent.append(message)

    pairs = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": kind, "path": path, "headers": pairs, "method": "GET"}
    asyncio.run(Guard(app, PORT, folder)(scope, None, send))
    if sent[0]["type"] == "websocket.close":
        return "closed", {}
    return sent[0]["status"], {name.decode(): value.decode() for name, value in sent[0]["headers"]}


@pytest.mark.parametrize("path", ["/", "/assets/a.js", "/gradio_api/queue/join", "/gradio_api/component_server/"])
def test_what_the_page_needs_is_served_with_a_policy(path):
    status, headers = answer(path)
    assert status == 200 and headers["x"] == "y"
    rules = dict(rule.strip().split(" ", 1) for rule in headers["content-security-policy"].split(";"))
    assert "http" not in headers["content-security-policy"] and "*" not in headers["content-security-policy"]
    assert rules["default-src"].startswith("'self'") and rules["frame-ancestors"] == "'none'"
    assert answer(path, OWN | {"origin": f"http://127.0.0.1:{PORT}"})[0] == 200
    assert answer(path, {"host": f"localhost:{PORT}", "origin": f"http://localhost:{PORT}"})[0] == 200


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"host": "evil.example"},
        {"host": f"evil.example:{PORT}"},  # a name that leads to 127.0.0.1
        {"host": "127.0.0.1"},
        {"host": f"127.0.0.1:{PORT}.evil.example"},
        OWN | {"origin": "http://evil.example"},
        OWN | {"origin": "null"},
        OWN | {"origin": "http://127.0.0.1:8080"},  # another server of this computer
        OWN | {"origin": f"https://127.0.0.1:{PORT}.evil.example"},
    ],
)
def test_requests_of_other_sites_are_refused(headers):
    assert answer("/", headers)[0] == answer("/gradio_api/component_server/", headers)[0] == 403


@pytest.mark.parametrize(
    "path",
    [
        "/etc/passwd",
        "/../etc/passwd",
        "/assets/../../../etc/passwd",
        "/static/../config",
        "/gradio_api/file=/etc/passwd",
        "/gradio_api/file=../../etc/passwd",
        "/gradio_api/file=%2Fetc%2Fpasswd",
        "/gradio_api/file=http://evil.example/a",
        "/gradio_api/file=https:/evil.example/a",
        "/gradio_api/file=",
        "/gradio_api/file/etc/passwd",
        "/file=/etc/passwd",
        "/gradio_api/proxy=https://evil.example",
        "/gradio_api/custom_component/1/client/component/a",
        "/gradio_api/stream/a/b/1/c.ts",
        "/gradio_api/vibe-code",
        "/monitoring",
        "/docs",
    ],
)
def test_everything_else_is_refused(path):
    assert answer(path)[0] == 403


def test_files_are_those_of_the_private_folder(tmp_path):
    private, other = tmp_path / "private", tmp_path / "private-too"
    for folder in (private / "gradio", other):
        folder.mkdir(parents=True)
        (folder / "a.png").write_bytes(b"")
    (private / "link.png").symlink_to(other / "a.png")
    ask = lambda path: answer(f"/gradio_api/file={path}", folder=private)[0]  # noqa: E731
    assert ask(private / "gradio" / "a.png") == 200
    assert ask(private / "gradio" / ".." / ".." / "private-too" / "a.png") == 403
    assert ask(other / "a.png") == ask(private / "link.png") == ask(private.parent) == 403


def test_sockets_of_browsers_are_closed():
    assert answer("/", kind="websocket")[0] == "closed"


def test_a_port_in_use_is_told():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=rf"^port {port} cannot be used[^\n]*--port"):
            free_port(port)
    assert free_port(0) > 0
    with pytest.raises(ValueError, match="port 70000"):
        free_port(70_000)


def test_gradio_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setattr(server, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r'pip install "gift-peft\[studio\]"$'):
        check_gradio()


def test_the_private_folder_goes_and_gradio_tells_nobody(monkeypatch):
    for name in ("GRADIO_TEMP_DIR", "GRADIO_ANALYTICS_ENABLED", "NO_PROXY", "no_proxy"):
        monkeypatch.setenv(name, "before")  # put back after the test
    with private_folder() as folder:
        assert os.environ["GRADIO_TEMP_DIR"].startswith(str(folder))
        assert os.environ["GRADIO_ANALYTICS_ENABLED"] == "False"
        assert proxy_bypass_environment("127.0.0.1:7860") and proxy_bypass_environment("before")
        (folder / "gradio").mkdir()
    assert not folder.exists()


def test_browsers_leave_out_the_port_80(monkeypatch):
    assert answer("/", {"host": "127.0.0.1"})[0] == 403
    monkeypatch.setitem(globals(), "PORT", 80)
    assert answer("/", {"host": "127.0.0.1", "origin": "http://127.0.0.1"})[0] == 200
    assert answer("/", {"host": "evil.example"})[0] == 403


def test_photos_reach_the_room_as_their_files_are(tmp_path):
    """Converted by the page, a deep one would come white, and with another idea of transparency."""
    gr = pytest.importorskip("gradio")
    image_data = pytest.importorskip("gradio.data_classes").ImageData
    room = SimpleNamespace(model=SimpleNamespace(adapted=True))
    photos = [one for one in build(Rooms(compare=room), "a").blocks.values() if isinstance(one, gr.Image)]
    Image.fromarray(np.full((4, 5), 3000, np.uint16)).save(tmp_path / "deep.png")
    given = image_data(path=str(tmp_path / "deep.png"), orig_name="deep.png")
    assert [photo.preprocess(given) for photo in photos] == [given.path]


def test_what_is_no_picture_reaches_the_room_too_which_says_so(tmp_path):
    """gradio would decode it before, and fail with a traceback."""
    gr = pytest.importorskip("gradio")
    image_data = pytest.importorskip("gradio.data_classes").ImageData
    room = SimpleNamespace(model=SimpleNamespace(adapted=True))
    (photo,) = [one for one in build(Rooms(compare=room), "a").blocks.values() if isinstance(one, gr.Image)]
    (tmp_path / "notes.png").write_text("notes")
    given = image_data(path=str(tmp_path / "notes.png"), orig_name="notes.png")
    assert photo.preprocess(given) == given.path and photo.preprocess(None) is None
    with pytest.raises(ValueError, match=r"notes\.png: not a readable image"):
        CompareRoom.compare(room, photo.preprocess(given), 1.0)


def test_names_that_are_no_text_can_be_sent():
    answer = server._answer(lambda request: {"bar\udce9": [request["name"], 3, None, {"picture": "é"}]})
    assert answer({"name": "\ud800"}) == {r"bar\udce9": [r"\ud800", 3, None, {"picture": "é"}]}

    def fails(request):
        raise ValueError(request["name"])

    assert server._answer(fails)({"name": "a\ud800"}) == {"error": r"a\ud800"}
