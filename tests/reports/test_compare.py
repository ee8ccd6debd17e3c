"""compare.html: self-contained, escaped, and in a real browser a slider that uncovers the right picture."""

import base64
import io
import re
import shutil
import subprocess

import numpy as np
import pytest
from helpers.reports import panel
from PIL import Image

from gift_peft.reports.compare import write_compare
from gift_peft.reports.figures import panel_row

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
OPTIONS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--force-color-profile=srgb",
    "--enable-logging=stderr",
    "--window-size=1200,900",
]


def pictures(page: str) -> list[np.ndarray]:
    sources = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(source)))) for source in sources]


def test_one_file_with_everything_in_it(tmp_path):
    panels = [panel(label="a <b> & c"), panel(1)]
    path = write_compare(iter(panels), tmp_path / "compare.html", title="<script>", notes=["1 < 2"])
    page = path.read_text(encoding="utf-8")
    assert [item.name for item in tmp_path.iterdir()] == ["compare.html"]
    assert page.count("<article>") == 2 and page.count('type="range"') == 2
    assert "a &lt;b&gt; &amp; c" in page and "&lt;script&gt;" in page and "<p>1 &lt; 2</p>" in page
    assert not re.search(r"https?://|(?:src|href)=\"(?!data:)|@import|url\(", page)
    for number, own in enumerate(panels):
        shown = pictures(page)[4 * number : 4 * number + 4]
        for tile, picture in zip(panel_row(own).tiles, shown, strict=True):
            assert picture.shape[1] >= 320 and picture.shape[1] % tile.shape[1] == 0
            factor = picture.shape[1] // tile.shape[1]
            middle = picture[factor // 2 :: factor, factor // 2 :: factor].astype(int)
            away = np.s_[50:58, 55:70]  # from the outline
            assert np.abs(middle[away] - tile[away]).mean() < 25 and middle.shape == tile.shape


def test_no_panels_no_page(tmp_path):
    with pytest.raises(ValueError, match="at least one panel"):
        write_compare(iter([]), tmp_path / "compare.html")
    assert not list(tmp_path.iterdir())


def look(page, tmp_path, name: str) -> tuple[np.ndarray, list[str]]:
    """(screenshot, console messages) of the page in a fresh browser."""
    shot = tmp_path / f"{name}.png"
    command = [BROWSER, *OPTIONS, f"--user-data-dir={tmp_path / name}", f"--screenshot={shot}", page.as_uri()]
    said = subprocess.run(command, capture_output=True, text=True, timeout=300).stderr
    return np.asarray(Image.open(shot).convert("RGB")).astype(int), re.findall(r"CONSOLE.*", said)


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_the_slider_uncovers_one_picture_or_the_other(tmp_path):
    page = write_compare([panel()], tmp_path / "compare.html")
    text = page.read_text(encoding="utf-8")
    shots = {}
    for value in (0, 50, 100):
        moved = tmp_path / f"at{value}.html"
        moved.write_text(text.replace('value="50"', f'value="{value}"'), encoding="utf-8")
        shots[value], console = look(moved, tmp_path, f"at{value}")
        assert console == []
    # The widget is where the picture changes: all adapted at 0, all base at 100, and at 50 half of each.
    changed = np.argwhere(np.abs(shots[0] - shots[100]).sum(-1) > 60)
    (top, left), (bottom, right) = changed.min(0), changed.max(0)
    assert bottom - top > 50 and right - left > 50
    half = np.abs(shots[50] - shots[100]).sum(-1)[top:bottom, left:right] < 30
    other = np.abs(shots[50] - shots[0]).sum(-1)[top:bottom, left:right] < 30
    differs = np.abs(shots[0] - shots[100]).sum(-1)[top:bottom, left:right] > 60
    columns = np.flatnonzero(differs.any(0))
    from_base = [half[:, c][differs[:, c]].mean() > 0.5 for c in columns]
    from_adapted = [other[:, c][differs[:, c]].mean() > 0.5 for c in columns]
    switch = from_base.index(False)
    assert switch > 10 and all(from_base[:switch]) and all(from_adapted[switch + 8 :]) and any(from_adapted)
    broken = tmp_path / "broken.html"
    broken.write_text(text.replace("<script>", "<script>nonsense();"), encoding="utf-8")
    assert any("nonsense" in line for line in look(broken, tmp_path, "broken")[1])  # errors would be seen
