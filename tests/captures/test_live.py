"""Streams over the network: the newest frames while they last, an end where no more come, and a line where none do."""

import itertools
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest

from gift_peft.captures import live
from gift_peft.captures.live import live_frames

SIZE = (48, 64)


class _Stream(BaseHTTPRequestHandler):
    """Motion JPEG, as network cameras send it: 40 pictures whose grey level is their number."""

    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        for index in range(self.server.pictures):
            _, content = cv2.imencode(".jpg", np.full((*SIZE, 3), 5 * index + 20, np.uint8))
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(content)}\r\n\r\n"
            self.wfile.write(head.encode() + content.tobytes() + b"\r\n")
            self.wfile.flush()
            time.sleep(0.03)

    def log_message(self, *args):
        pass


@pytest.fixture
def address():
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Stream)
    server.pictures = 40
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/stream.mjpg"
    server.shutdown()
    server.server_close()


def numbers(frames):
    return [round((float(frame.pixels.mean()) - 20) / 5) for frame in frames]


def test_a_stream_is_read_in_order_until_it_ends(address, monkeypatch):
    monkeypatch.setattr(live, "SILENCE", 0.5)
    frames = list(live_frames(address))
    found = numbers(frames)
    assert found == sorted(set(found)) and len(found) >= 10
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert frames[0].seconds == 0 and all(a.seconds < b.seconds for a, b in itertools.pairwise(frames))


def test_whoever_looks_slowly_sees_the_newest_frames(address, monkeypatch):
    monkeypatch.setattr(live, "SILENCE", 0.5)
    found = []
    for frame in live_frames(address):
        found += numbers([frame])
        time.sleep(0.2)
    assert found == sorted(set(found))
    assert len(found) < 20 and found[-1] >= 35  # not the first twenty, late


def test_leaving_early_ends_the_reading(address):
    frames = live_frames(address)
    next(frames)
    frames.close()
    assert not [thread for thread in threading.enumerate() if isinstance(thread, live._Reader)]


@pytest.mark.parametrize(
    ("device", "message"),
    [(99, "camera 99: cannot be opened; plug it in"), ("http://127.0.0.1:9/x", "/x: cannot be opened; check")],
)
def test_what_is_not_there_is_named(device, message):
    with pytest.raises(ValueError, match=message):
        next(live_frames(device))


@pytest.mark.parametrize("frame", [np.zeros(SIZE, np.uint8), np.zeros((*SIZE, 3), np.uint16)])
def test_cameras_without_color_are_named(frame, monkeypatch):
    class Camera:
        read = staticmethod(lambda: (True, frame))
        release = staticmethod(lambda: None)

    monkeypatch.setattr(live, "_open", lambda *_: Camera)
    with pytest.raises(ValueError, match=r"^camera 0: frames of .*8-bit color"):
        next(live_frames(0))
