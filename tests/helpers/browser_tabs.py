"""Tabs of a real browser at a studio of ours: what they asked for, and complained about."""

import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WAIT = 120_000  # milliseconds: others may use the cores as well
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")


@contextmanager
def studio(*words):
    """The address of a studio at work; at its end it has left no temporary folder."""
    settings = {"HF_HUB_OFFLINE": "1", "PYTHONUNBUFFERED": "1", "GRADIO_SHARE": "True", "GRADIO_ALLOWED_PATHS": "/"}
    command = [sys.executable, "-m", "gift_peft", "studio", "--port", "0", *map(str, words)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    server = subprocess.Popen(command, text=True, env=os.environ | settings, **pipes)
    try:
        line = server.stdout.readline()
        yield re.search(r"http://127\.0\.0\.1:\d+", line).group()
    finally:
        server.send_signal(signal.SIGINT)
        told = server.communicate(timeout=60)[1]
    assert server.returncode == 0 and "Traceback" not in told and told.startswith("Opening the studio"), told


class Watched:
    """A tab, and what it asked for and complained about."""

    def __init__(self, browser, url, width=1280):
        self.page, self.url, self.asked, self.wrong = (
            browser.new_page(viewport={"width": width, "height": 900}),
            url,
            [],
            [],
        )
        self.page.set_default_timeout(WAIT)
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("console", lambda message: message.type == "error" and self.wrong.append(message.text))
        self.page.goto(url)

    def said(self, pattern):
        """Wait until the room says what matches."""
        script = "pattern => new RegExp(pattern).test(document.querySelector('#masks .said')?.textContent)"
        self.page.wait_for_function(script, arg=pattern)
        return self.page.locator("#masks .said").text_content()

    def click(self, place, **options):
        canvas = self.page.locator("#masks canvas")
        canvas.scroll_into_view_if_needed()
        box = canvas.bounding_box()
        self.page.mouse.click(box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"], **options)

    def close(self):
        elsewhere = [url for url in self.asked if not url.startswith((f"{self.url}/", "data:", "blob:"))]
        assert not elsewhere and not self.wrong, (elsewhere, self.wrong)
        self.page.close()
