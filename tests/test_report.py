"""Tables: signs, marks and footnotes; the before/after picture, pixel by pixel where it matters."""

import math
import re

import numpy as np
import pytest
from PIL import Image, ImageDraw

from gift_peft.evaluation.colormap import GREY
from gift_peft.evaluation.protocols import PROTOCOLS
from gift_peft.evaluation.report import (
    CAPTION,
    GAP,
    HEADER,
    NO_TEACHING,
    TILE_WIDTH,
    Panel,
    before_after,
    consensus_teaches,
    improved,
    markdown_table,
    number,
    relative_change,
    text_table,
)
from gift_peft.evaluation.results import GiftIReport


def metrics(mae, abs_rel, rmse, delta1):
    return {"mae": mae, "abs_rel": abs_rel, "rmse": rmse, "delta1": delta1}


def make_report(**changes) -> GiftIReport:
    base = {
        "tom": metrics(0.2, 0.1, 0.4, 80.0),
        "other": metrics(0.1, 0.05, 0.2, 95.0),
        "all": metrics(0.12, 0.06, 0.25, 92.0),
    }
    adapted = {
        "tom": metrics(0.1, 0.11, 0.3, 90.0),
        "other": metrics(0.1, 0.06, 0.204, 94.05),
        "all": metrics(0.1, 0.05, 0.2, 93.0),
    }
    consensus = {**base, "tom": metrics(0.1, 0.05, 0.2, 91.0)}
    fields = {
        "summary": adapted,
        "base": base,
        "consensus": consensus,
        "gce": {
            "base": 0.5,
            "adapted": 0.1,
            "base_normalized": 0.05,
            "adapted_normalized": 0.06,
            "num_groups": 7,
            "num_skipped": 1,
        },
        "collapse": {"target_mean_ratio": 0.98, "spread_ratio": 0.9, "alarm": False},
        "by_surface": {"mirror": {"num_images": 5, "summary": adapted, "base": base, "consensus": consensus}},
        "counts": {
            "groups": 8,
            "images": 30,
            "scored": 28,
            "skipped": 2,
            "reasons": {"without a treated reference": 2},
            "without_tom": 1,
            "without_other": 0,
        },
        "protocol": PROTOCOLS["native"].to_dict() | {"description": PROTOCOLS["native"].describe()},
        "reference": "proxy",
        "adapted": True,
        "unit": "native units",
        "groups": [],
        "rows": [],
    }
    return GiftIReport(**fields | changes)


def test_relative_change_has_the_sign_of_the_difference():
    assert relative_change(2, 1) == -50 and relative_change(2, 3) == 50 and relative_change(2, 2) == 0
    assert relative_change(-2, -1) == 50
    for base, adapted in ((None, 1), (1, None), (math.nan, 1), (1, math.inf), (0, 1)):
        assert math.isnan(relative_change(base, adapted))


def test_improvement_is_down_for_errors_and_up_for_delta1():
    assert improved("rmse", -1) and not improved("rmse", 1) and not improved("rmse", 0)
    assert improved("delta1", 1) and not improved("delta1", -1) and not improved("mae", math.nan)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0123456, "0.012346"),
        (1.23456, "1.2346"),
        (123.456, "123.46"),
        (12345.6, "12346"),
        (100.0, "100.00"),
        (0.0, "0.0000"),
        (None, "-"),
        (math.nan, "-"),
        (math.inf, "inf"),
    ],
)
def test_numbers(value, text):
    assert number(value) == text


def test_text_table_is_aligned_and_marks_improvements():
    text = text_table(make_report())
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80 and "\x1b" not in text
    change = next(line for line in lines if line.strip().startswith("change"))
    assert change.split() == ["change", "-50.0", "%*", "+10.0", "%", "-25.0", "%*", "+12.5", "%*"]
    for name in ("tom", "other"):
        block = lines.index(next(line for line in lines if line.lower().startswith(name)))
        assert {line.rstrip("*").rfind(" %") + 2 for line in lines[block + 2 : block + 3]} == {69}
        assert {len(line) for line in lines[block : block + 2]} == {69}
    assert re.search(r"^GCE +0\.50000 +0\.10000 +-80\.0 %\* +-$", text, re.M)
    assert re.search(r"^GCE normalised +0\.050000 +0\.060000 +\+20\.0 % +-$", text, re.M)
    assert re.search(r"^ToM RMSE, mirror \(5\) +0\.40000 +0\.30000 +-25\.0 %\* +0\.20000$", text, re.M)
    assert not any(line.endswith(" ") for line in lines)


def test_colour_only_adds_escapes():
    report = make_report()
    colored = text_table(report, color=True)
    assert "\x1b[32m" in colored and "\x1b[31m" in colored
    assert re.sub(r"\x1b\[\d+m", "", colored) == text_table(report)


def test_markdown_table_is_well_formed_and_bold_where_better():
    text = markdown_table(make_report())
    tables = re.findall(r"(?:^\|.*\n)+", text, re.M)
    assert len(tables) == 2
    for table in tables:
        assert len({line.count("|") for line in table.splitlines()}) == 1
    assert "|  | change | **-50.0 %** | +10.0 % | **-25.0 %** | **+12.5 %** |" in text
    assert "| GCE ↓ | 0.50000 | 0.10000 | **-80.0 %** | - |" in text
    assert "|  | consensus | 0.10000 | 0.050000 | 0.20000 | 91.000 |" in text


@pytest.mark.parametrize("table", [text_table, markdown_table])
def test_every_table_states_protocol_skips_and_collapse(table):
    text = " ".join(table(make_report()).split())
    assert PROTOCOLS["native"].describe() in text
    assert "Skipped: 2 of 30 images (2 without a treated reference); 1 without known target pixels; GCE" in text
    assert "GCE over 7 groups, 1 without a pair" in text
    assert "target mean x0.98000, spread x0.90000: no collapse alarm (outside 0.5..2)" in text
    alarmed = {"target_mean_ratio": 0.3, "spread_ratio": 0.9, "alarm": True}
    assert "COLLAPSE ALARM" in table(make_report(collapse=alarmed))


@pytest.mark.parametrize("table", [text_table, markdown_table])
def test_a_consensus_no_better_than_the_base_is_said(table):
    def text(report):
        return " ".join(table(report).split())

    good = make_report()
    assert consensus_teaches(good) is True and NO_TEACHING not in text(good)
    for rmse in (0.4, 0.5):
        bad = make_report(consensus={**good.consensus, "tom": metrics(0.1, 0.05, rmse, 91.0)})
        assert consensus_teaches(bad) is False and NO_TEACHING in text(bad)
    unknown = make_report(consensus={**good.consensus, "tom": metrics(*[None] * 4)})
    assert consensus_teaches(unknown) is None and NO_TEACHING not in text(unknown)
    single = make_report(consensus=good.base, gce=good.gce | {"num_groups": 0})
    assert consensus_teaches(single) is None and NO_TEACHING not in text(single)


@pytest.mark.parametrize("table", [text_table, markdown_table])
def test_a_base_alone_has_no_changes(table):
    gce = make_report().gce | {"adapted": None, "adapted_normalized": None}
    text = table(make_report(adapted=False, collapse=None, gce=gce))
    assert " %*" not in text and " %**" not in text and "consensus" in text and "collapse" not in text.lower()


def test_a_loaded_report_gives_the_same_tables(tmp_path):
    report = make_report(base={**make_report().base, "other": metrics(*[math.nan] * 4)})
    loaded = GiftIReport.load(report.save(tmp_path))
    assert text_table(loaded) == text_table(report) and markdown_table(loaded) == markdown_table(report)


# ---- the picture ----


def panel(seed=0, kind="inverse_depth", size=(60, 75), **changes) -> Panel:
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: size[0], : size[1]]
    depth = 1000 + 20.0 * rows + 10 * columns
    target = np.zeros(size, bool)
    target[15:45, 20:50] = True
    wrong = np.where(target, depth * 1.6, depth)
    base, adapted = (1 / wrong, 1 / depth) if kind == "inverse_depth" else (wrong, depth)
    reference = depth.copy()
    reference[:10, :10] = 0
    fields = {
        "label": f"mirror {seed}",
        "image": Image.fromarray(rng.integers(0, 255, (*size, 3), dtype=np.uint8)),
        "reference": reference,
        "base": 7 * base + 2 * base.max(),
        "adapted": adapted,
        "target": target,
        "kind": kind,
    }
    return Panel(**fields | changes)


def tiles(picture: Image.Image, row=0, size=(60, 75)) -> list[np.ndarray]:
    height = round(TILE_WIDTH * size[0] / size[1])
    top = HEADER + row * (CAPTION + height + GAP) + CAPTION
    pixels = np.asarray(picture)
    return [
        pixels[top : top + height, left : left + TILE_WIDTH]
        for left in (GAP + index * (TILE_WIDTH + GAP) for index in range(4))
    ]


@pytest.mark.parametrize("kind", ["depth", "inverse_depth"])
def test_before_after_shows_one_range_and_unknown_in_the_reference_only(tmp_path, kind):
    path = before_after([panel(kind=kind), panel(1, kind=kind)], tmp_path / "figure.png")
    picture = Image.open(path)
    assert picture.size == (GAP + 4 * (TILE_WIDTH + GAP), HEADER + 2 * (CAPTION + 288 + GAP))
    for row in range(2):
        rgb, reference, base, adapted = tiles(picture, row)
        grey = [(tile[5:40, 5:40] == GREY).all(-1).all() for tile in (rgb, reference, base, adapted)]
        assert grey == [False, True, False, False]
        known = np.s_[60:]  # below the unknown corner; a perfect prediction looks like its reference
        difference = np.abs(reference[known].astype(int) - adapted[known])
        assert np.quantile(difference, 0.99) <= 3
        inside = np.s_[90:200, 115:220]
        assert np.abs(reference[inside].astype(int) - base[inside]).mean() > 15


def test_before_after_outlines_the_target(tmp_path):
    rows = tiles(Image.open(before_after([panel()], tmp_path / "figure.png")))
    middle, left = 144, round(20 * TILE_WIDTH / 75)
    for tile in rows:
        assert (tile[middle, left : left + 1] == 255).all() and (tile[middle, left - 1] == 0).all()


def test_before_after_refuses_what_it_cannot_draw(tmp_path):
    with pytest.raises(ValueError, match="at least one panel"):
        before_after([], tmp_path / "x.png")
    with pytest.raises(ValueError, match="shapes must agree"):
        before_after([panel(base=np.ones((3, 4)))], tmp_path / "x.png")
    assert not list(tmp_path.iterdir())


def test_before_after_says_where_the_target_has_no_reference(tmp_path, monkeypatch):
    captions = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda self, at, text, **_: captions.append(text))
    blind = panel()
    blind.reference[blind.target] = 0
    before_after([panel(), blind], tmp_path / "figure.png")
    assert "mm before, " in captions[0] and "RMSE in the outline: unknown" in captions[1]
