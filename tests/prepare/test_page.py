"""`report.html`: what it says, that it is one file, and how it looks in a real browser."""

import base64
import io
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from gift_peft.prepare.page import write_html

SIZE = (160, 120)


def picture(seed, shift=0.0):
    rng = np.random.default_rng(7)
    scene = cv2.resize(rng.uniform(30, 220, (12, 16, 3)), SIZE, interpolation=cv2.INTER_CUBIC)
    scene[30:80, 50:110] = np.random.default_rng(seed).uniform(0, 255, 3)
    scene = cv2.warpAffine(scene, np.float32([[1, 0, shift], [0, 1, 0]]), SIZE)
    return Image.fromarray(np.clip(scene, 0, 255).astype(np.uint8))


def save(path: Path, image) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    (image if isinstance(image, Image.Image) else Image.fromarray(image)).save(path)
    return path


def registration(**figures):
    found = {
        "method": "features",
        "homography": np.eye(3).tolist(),
        "matches": 250,
        "inliers": 240,
        "inlier_ratio": 0.96,
        "spread": 0.4,
        "median_displacement": 3.21,
        "corner_displacement": 4.5,
        "target_displacement": 3.3,
        "expected_error": None,
        "contrast_threshold": 0.08,
        "difference_before": 9.5,
        "difference_after": 1.25,
        "paper_exact": {"accepted": True, "matches": 5, "inliers": 5, "inlier_ratio": 1, "corner_displacement": 2e5},
    }
    return found | figures


def frame(name, group, status="identity", **more):
    prepared = None if status in ("dropped", "kept?") else f"train/{group}/images/{Path(name).stem}.png"
    values = {
        "name": name,
        "role": "observation",
        "status": status.rstrip("?"),
        "reasons": [],
        "warnings": [],
        "original": f"train/{group}/{name}",
        "prepared": prepared,
        "mask": prepared and f"train/{group}/masks/{Path(name).stem}.png",
        "valid": None,
        "registration": None,
        "quality": None,
    }
    return values | more


def group(group_id, frames, status="kept", **more):
    return {
        "group_id": group_id,
        "split": "train",
        "surface": "mirror",
        "notes": None,
        "folder": f"train/{group_id}",
        "status": status,
        "reasons": [],
        "warnings": [],
        "size": list(SIZE),
        "target_frame": frames[-1]["name"] if frames else None,
        "quality": {"outside_change": 0.5, "mask_area": None},
        "proposal": None,
        "frames": frames,
    } | more


@pytest.fixture
def out(tmp_path):
    """OUT with the pictures of `report`, and RAW beside it."""
    raw, out = tmp_path / "raw", tmp_path / "out"
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[30:80, 50:110] = 255
    valid = np.full(SIZE[::-1], 255, np.uint8)
    valid[:, :12] = 0
    for index, name in enumerate(("1", "2", "3", "<b>4 é")):
        save(raw / f"train/hall/{name}.png", picture(index, 12 if name == "2" else 0))
        save(out / f"train/hall/images/{name}.png", picture(index))
        save(out / f"train/hall/masks/{name}.png", mask)
    save(out / "train/hall/valids/2.png", valid)
    save(out / "masks_proposed/hall/mask.png", np.roll(mask, 9, axis=1))
    (raw / "train/bad").mkdir()
    (raw / "train/bad/1.png").write_bytes(b"")
    save(raw / "train/bad/2.png", picture(1))
    return out


@pytest.fixture
def report():
    frames = [
        frame("1.png", "hall", registration=registration(method="declared static", median_displacement=None)),
        frame("2.png", "hall", "warped", valid="train/hall/valids/2.png", registration=registration()),
        frame("3.png", "hall", "dropped", reasons=[{"code": "blur", "text": "blurred: sharpness 3 < 20"}]),
        frame("<b>4 é.png", "hall", "kept", quality={"sharpness": 123.4}),
    ]
    proposal = {"score": 0.83, "accepted": False, "refined": None, "masks": ["masks_proposed/hall/mask.png"]}
    warnings = [{"code": "mask_border", "text": "the mask touches the border & more"}]
    groups = [
        group("hall", frames, warnings=warnings, notes="<script>alert(1)</script>", proposal=proposal),
        group(
            "bad",
            [frame("1.png", "bad", "kept?"), frame("2.png", "bad", "kept?")],
            "rejected",
            reasons=[{"code": "unreadable", "text": "1.png: not a readable image"}],
            target_frame=None,
            size=None,
        ),
        group("empty", [], "rejected", reasons=[{"code": "no_images", "text": "no images"}], quality=None),
    ]
    spread = {"min": 3, "max": 3, "mean": 3.0}
    numbers = ("groups", "images", "pairs", "references", "rejected_groups", "dropped_frames", "warped_frames")
    return {
        "format": 1,
        "raw": "../raw",
        "settings": {"registration": {"ratio": 0.7}},
        "versions": {"numpy": "2"},
        "statistics": {
            "train": dict(zip(numbers, (1, 3, 3, 0, 2, 1, 1), strict=True))
            | {"group_size": spread, "mask_area": {"min": 0.1, "max": 0.2, "mean": 0.15}},
            "validation": dict.fromkeys(numbers, 0) | {"group_size": None, "mask_area": None},
        },
        "groups": groups,
    }


class Page(HTMLParser):
    """Tags with their attributes and text, and whether every tag is closed."""

    VOID = ("meta", "link", "img", "input", "!doctype")

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.words = [], [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def test_what_the_page_says(out, report):
    path = write_html(out, report)
    assert path == out / "report.html" and [p.name for p in out.glob("*report*")] == ["report.html"]
    page = Page(path.read_text(encoding="utf-8"))
    text = " ".join(" ".join(page.words).split())
    for words in (
        "3 groups, 6 frames",
        "train 1 2 3 3 0 1 1 3 – 3 (mean 3) 10 – 20 % (mean 15 %)",
        "validation 0 0 0 0 0 0 0 – –",
        "<script>alert(1)</script>",  # as text
        "the mask touches the border & more",
        "masks proposed with a score of 0.83 (0 to 1), not accepted: not used",
        "flicker against <b>4 é.png",
        "change outside 50 % · target area –",
        "2.png moved into place camera motion 3.21 px",
        "3.png dropped blurred: sharpness 3 < 20",
        "<b>4 é.png registered to",
        "2.png features 250 240 0.96 0.40 3.21 3.30 4.5 – 0.080 9.50 1.25 accepts, corner 200000.0 px –",
        "<b>4 é.png – – – – – – – – – – – – – 123.40",
        "2.png not checked",
        "not checked : the group was rejected before this photo was looked at",
        "mask agreement : overlap (intersection over union)",
        "bad rejected",
        "1.png: not a readable image",
        "no picture",
        '"ratio": 0.7',
    ):
        assert words in text, words
    # hall: three shown once, the warped one before, after and two differences; bad: the readable one
    assert sum(tag == "img" for tag, _ in page.tags) == 3 + 4 + 1
    kinds = [attrs["class"] for tag, attrs in page.tags if tag == "path"]
    assert sorted(kinds) == ["", "", "", "outside", "proposed", "proposed", "proposed", "proposed"]


def test_the_papers_rule_is_shown_only_where_it_was_asked(out, report):
    text = write_html(out, report).read_text(encoding="utf-8")
    assert "the paper&#x27;s rule alone" in text
    for found in report["groups"][0]["frames"]:
        (found["registration"] or {}).pop("paper_exact", None)
    text = write_html(out, report).read_text(encoding="utf-8")
    words = " ".join(" ".join(Page(text).words).split())
    assert "rule alone" not in text and "accepts" not in text
    assert "2.png features 250 240 0.96 0.40 3.21 3.30 4.5 – 0.080 9.50 1.25 –" in words


@pytest.mark.parametrize(
    ("low", "high", "mean", "text"),
    [
        (0.062, 1.0, 0.5312, "6.2 – 100 % (mean 53.1 %)"),
        (0.0000004, 0.99996, 0.1, "0.00004 – 100 % (mean 10 %)"),
        (0, 0, 0, "0 – 0 % (mean 0 %)"),
    ],
)
def test_figures_have_no_exponents(out, report, low, high, mean, text):
    report["statistics"]["train"]["mask_area"] = {"min": low, "max": high, "mean": mean}
    report["statistics"]["train"]["group_size"] = {"min": 2, "max": 1234, "mean": 45678.9}
    page = Page(write_html(out, report).read_text(encoding="utf-8"))
    words = " ".join(" ".join(page.words).split())
    assert text in words and "2 – 1234 (mean 45679)" in words and "e+0" not in words and "e-0" not in words


def test_pictures_can_be_enlarged_as_far_as_the_file_allows(out, report, monkeypatch):
    """The more pictures, the smaller; a small photo is never blown up beyond the thumbnail's width."""
    save(out / "train/hall/images/3.png", picture(3).resize((1600, 1200)))
    report["groups"][0]["frames"][2] |= {"status": "identity", "prepared": "train/hall/images/3.png"}
    for pixels, width in ((60e6, 960), (1e3, 240)):
        monkeypatch.setattr("gift_peft.prepare.page.PIXELS", pixels)
        page = Page(write_html(out, report).read_text(encoding="utf-8"))
        assert sorted({attrs["width"] for tag, attrs in page.tags if tag == "img"}) == sorted({"240", str(width)})
    shots = [attrs for tag, attrs in page.tags if tag == "div" and attrs.get("class", "").startswith("shot")]
    assert len([attrs for attrs in shots if "tabindex" in attrs]) == 8 == sum(tag == "img" for tag, _ in page.tags)


def test_nothing_outside_the_file_and_no_scripts(out, report):
    text = write_html(out, report).read_text(encoding="utf-8")
    page = Page(text)
    assert not any(tag == "script" for tag, _ in page.tags)
    addresses = [attrs[key] for _, attrs in page.tags for key in ("src", "href") if key in attrs]
    assert all(address.startswith(("data:", "#")) for address in addresses)
    assert all(address.startswith("data:image/") for address in re.findall(r"url\((.*?)\)", text))
    assert not re.search(r"https?:|@import", re.sub(r"base64,[\w+/=]+", "", text))


def test_outlines_lie_on_the_mask(out, report):
    page = Page(write_html(out, report).read_text(encoding="utf-8"))
    drawn = next(attrs["d"] for tag, attrs in page.tags if tag == "path" and attrs["class"] == "")
    points = np.array([[float(value) for value in pair.split(",")] for pair in drawn.strip("MZ").split()]) * SIZE
    np.testing.assert_allclose(points.min(axis=0), (50, 30), atol=1)
    np.testing.assert_allclose(points.max(axis=0), (110, 80), atol=1)


def test_differences_are_those_from_the_target_frame(out, report):
    page = Page(write_html(out, report).read_text(encoding="utf-8"))
    images = {attrs["alt"]: attrs["src"] for tag, attrs in page.tags if tag == "img"}
    means = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(images[f"4 × difference {label}"].partition(",")[2]))))
        for label in ("before", "after")
    ]
    outside = np.ones(means[0].shape[:2], bool)
    outside[:, 60:190] = False
    assert means[0][outside].mean() > 20 and means[1][outside].mean() < 2


# ---- in a browser ----


def browser():
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def browse(page: Path, folder: Path, *options) -> subprocess.CompletedProcess:
    command = [browser(), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars"]
    command += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    command += [f"--user-data-dir={folder / 'profile'}", "--enable-logging=stderr", "--window-size=1280,1400"]
    return subprocess.run([*command, *options, page.as_uri()], capture_output=True, text=True, timeout=400, check=True)


@pytest.mark.slow
@pytest.mark.skipif(browser() is None, reason="no Chromium installed")
def test_in_chromium(out, report, tmp_path):
    """Pictures decode, outlines lie on them, nothing sticks out sideways, the flicker works, the console is empty."""
    path = write_html(out, report)
    shot = tmp_path / "shot.png"
    logged = browse(path, tmp_path, f"--screenshot={shot}").stderr
    assert "CONSOLE" not in logged
    colours = np.asarray(Image.open(shot).convert("RGB")).reshape(-1, 3)
    assert len(np.unique(colours // 16, axis=0)) > 100  # pictures are drawn

    probe = """<script>addEventListener("load", () => {
      const broken = [...document.images].filter(image => !image.naturalWidth).length;
      const wide = document.documentElement.scrollWidth > innerWidth;
      const image = document.querySelector(".blink img");
      const still = getComputedStyle(image).animationName;
      document.querySelector(".flicker").click();
      const moving = getComputedStyle(image).animationName;
      const off = [...document.querySelectorAll("svg")].filter(svg => {
        const [a, b] = [svg, svg.previousElementSibling].map(element => element.getBoundingClientRect());
        return Math.abs(a.top - b.top) + Math.abs(a.height - b.height) + Math.abs(a.width - b.width) > 1;
      }).length;
      console.log("probed");
      document.title = [document.images.length, broken, off, wide, still, moving].join(" ");
    })</script></body>"""
    path.write_text(path.read_text(encoding="utf-8").replace("</body>", probe), encoding="utf-8")
    found = browse(path, tmp_path, "--dump-dom")
    assert "CONSOLE" in found.stderr  # messages do arrive, so that their absence above means something
    assert re.search("<title>(.*?)</title>", found.stdout)[1] == "8 0 0 false none flicker"
