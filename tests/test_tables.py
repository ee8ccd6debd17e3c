"""Tables: signs, marks, footnotes and intervals, in every form they are written in."""

import math
import re

import pytest
from reports import make_report, metrics

from gift_peft.evaluation.layout import (
    number,
)
from gift_peft.evaluation.protocols import PROTOCOLS
from gift_peft.evaluation.results import GiftIReport
from gift_peft.evaluation.tables import (
    NO_TEACHING,
    consensus_teaches,
    improved,
    markdown_table,
    relative_change,
    text_table,
)


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
    block = lines.index(next(line for line in lines if line.startswith("ToM ")))
    ends = {len(line.rstrip("*")) for line in lines[block : block + 4]}
    assert len(ends) == 1  # numbers and changes end in one column, the mark stands behind it
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
