"""Tables: signs, marks, footnotes and intervals, in every form they are written in."""

import csv
import io
import math
import re
import statistics

import numpy as np
import pytest
from helpers.reports import make_report, metrics, random_rows, report_of
from hypothesis import given
from hypothesis import strategies as st

from gift_peft.evaluation.metrics import METRICS
from gift_peft.evaluation.protocols import PROTOCOLS
from gift_peft.evaluation.results import REGIONS, Report
from gift_peft.evaluation.statistics import GroupBootstrap, mean_interval, median_of
from gift_peft.evaluation.table_formats import (
    Cell,
    Table,
    change_cell,
    estimate_cell,
    number,
    to_csv,
    to_latex,
    to_markdown,
    to_text,
    value_cell,
)
from gift_peft.evaluation.tables import (
    BACKBONE_UNITS,
    NO_TEACHING,
    comparison_table,
    consensus_teaches,
    group_table,
    improved,
    markdown_table,
    relative_change,
    text_table,
    uncertainty_table,
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
    loaded = Report.load(report.save(tmp_path))
    assert text_table(loaded) == text_table(report) and markdown_table(loaded) == markdown_table(report)


# ---- intervals and medians ----


def straight_mean(rows, model, region, metric):
    """The mean over images, over any rows (a group may occur twice under two names)."""
    values = [row[model][region][metric] for row in rows]
    values = [value for value in values if not math.isnan(value)]
    return sum(values) / len(values)


@pytest.mark.parametrize("metric", ["mae", "rmse"])
def test_bootstrap_draws_whole_groups_and_takes_the_tables_own_mean(metric):
    rows = random_rows([3, 1, 2, 4])
    bootstrap = GroupBootstrap(rows)
    means = bootstrap._means("base", "other", metric)
    names = ["g00", "g01", "g02", "g03"]
    for draw, mean in list(zip(bootstrap.draws, means, strict=True))[:25]:
        drawn = []
        for name, times in zip(names, draw, strict=True):
            for copy in range(int(times)):
                drawn += [row | {"group_id": f"{name}-{copy}"} for row in rows if row["group_id"] == name]
        assert mean == pytest.approx(straight_mean(drawn, "base", "other", metric), rel=1e-12)
    low, high = bootstrap.interval("base", "other", metric)
    assert (low, high) == pytest.approx(np.percentile(means, [2.5, 97.5]))
    assert low < straight_mean(rows, "base", "other", metric) < high


def test_changes_come_from_the_same_draws():
    rows = random_rows([2, 3, 2, 5])
    for row in rows:
        for region in REGIONS:
            row["adapted"][region] = {metric: 0.7 * value for metric, value in row["base"][region].items()}
    low, high = GroupBootstrap(rows).change_interval("tom", "rmse")
    assert low == pytest.approx(-30) and high == pytest.approx(-30)  # unpaired draws would spread around it


def test_intervals_depend_on_neither_order_nor_null():
    rows = random_rows([2, 3, 4, 2, 5, 3, 1, 4])
    expected = GroupBootstrap(rows).interval("adapted", "other", "mae")
    assert GroupBootstrap(rows[::-1]).interval("adapted", "other", "mae") == expected
    for row in rows:
        if math.isnan(row["adapted"]["other"]["mae"]):
            row["adapted"]["other"]["mae"] = None  # as a saved report has it
    assert GroupBootstrap(rows).interval("adapted", "other", "mae") == expected
    assert GroupBootstrap(rows, seed=1).interval("adapted", "other", "mae") != expected


def test_one_group_has_no_interval():
    bootstrap = GroupBootstrap(random_rows([5]))
    assert all(map(math.isnan, bootstrap.interval("base", "tom", "mae")))
    assert all(map(math.isnan, bootstrap.change_interval("tom", "mae")))
    assert all(map(math.isnan, mean_interval([0.3])))
    # Of two groups only one has pixels outside the target: that is one group.
    rows = random_rows([2, 2])
    for row in rows[2:]:
        row["base"]["other"] = dict.fromkeys(METRICS, math.nan)
    assert all(map(math.isnan, GroupBootstrap(rows).interval("base", "other", "mae")))


def test_coverage_of_the_interval():
    """95 % intervals over 40 groups hold the true mean in about that share of 200 experiments."""
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        low, high = mean_interval(list(rng.normal(2.0, 1.0, 40)))
        hits += low <= 2.0 <= high
    assert 0.88 <= hits / 200 <= 0.985


@given(st.lists(st.floats(0.01, 100), min_size=1, max_size=9))
def test_median_is_over_images(values):
    rows = [{"base": {"tom": {"mae": value}}} for value in values]
    assert median_of(rows, "base", "tom", "mae") == pytest.approx(statistics.median(values))
    unknown = {"base": {"tom": {"mae": None}}}
    assert median_of([unknown, *rows], "base", "tom", "mae") == median_of(rows, "base", "tom", "mae")
    assert math.isnan(median_of([unknown], "base", "tom", "mae"))


# ---- several reports ----


def test_comparison_has_the_papers_form():
    first, second = report_of(random_rows([2, 3])), report_of(random_rows([2, 3], seed=1))
    table = comparison_table([("VGGT", first), ("DA", second)])
    assert [row and row[0] for row in table.rows] == ["VGGT", "DA", None, "VGGT + GIFT", "", "DA + GIFT", ""]
    assert table.spans == [("ToM", 4), ("All", 4)]
    base, adapted, change = table.rows[0], table.rows[3], table.rows[4]
    for column, (region, metric) in enumerate([(r, m) for r in ("tom", "all") for m in METRICS], start=1):
        assert base[column].values == (first.base[region][metric],)
        assert adapted[column].values == (first.summary[region][metric],)
        percent = 100 * (first.summary[region][metric] / first.base[region][metric] - 1)
        assert change[column].values[0] == pytest.approx(percent)
        assert bool(change[column].good) == ((percent > 0) == (metric == "delta1"))
        assert change[column].text.startswith("+" if percent > 0 else "-")
    notes = "\n".join(table.notes)
    assert "Protocol native" in notes and BACKBONE_UNITS in notes
    assert "VGGT: Skipped: 0 of 5 images" in notes and "DA: Skipped: 0 of 5 images" in notes


def test_baselines_stand_above_and_a_shared_base_once():
    rows = random_rows([2, 3])
    adapted = report_of(rows, booster=True)
    baseline = report_of(random_rows([2, 3], seed=5), booster=True)
    baseline.adapted, baseline.summary = False, baseline.base
    other = report_of(rows, booster=True)
    table = comparison_table([("DA", adapted), ("DA", other), ("MoGe", baseline)])
    assert [row and row[0] for row in table.rows] == ["DA", "MoGe", None, "DA + GIFT", "", "DA + GIFT", ""]
    assert "ToM is classes 2, 3" in table.notes[0] and "not the complete official set" in table.notes[0]
    assert BACKBONE_UNITS not in table.notes and "mm" in table.title


def test_booster_reports_have_tables_of_their_own():
    text = text_table(report_of(random_rows([2, 3]), booster=True))
    assert text.startswith("Booster balanced: 2 scenes, 5 images (mm)")
    assert "illumination GCE" in text and "\nGCE" not in text and "consensus" in text.lower()
    assert "per scene" in group_table(report_of(random_rows([2, 3]), booster=True)).title


@pytest.mark.parametrize("write", [to_text, to_markdown, to_latex])
@pytest.mark.parametrize("make", [uncertainty_table, group_table, lambda report: comparison_table([("DA", report)])])
def test_protocol_and_skips_stand_under_every_table(make, write):
    text = " ".join(write(make(report_of(random_rows([2, 3])))).replace("\\_", "_").split())
    assert PROTOCOLS["native"].describe() in text and "Skipped: 0 of 5 images" in text


def test_uncertainty_table_holds_means_intervals_and_medians():
    report = report_of(random_rows([2, 3, 4]))
    bootstrap = GroupBootstrap(report.rows)
    lines = {row[0]: row[1:] for row in uncertainty_table(report).body()}
    base, adapted, change, base_median, adapted_median = lines["ToM RMSE ↓"]
    assert base.values == (report.base["tom"]["rmse"], *bootstrap.interval("base", "tom", "rmse"))
    assert adapted.values == (report.summary["tom"]["rmse"], *bootstrap.interval("adapted", "tom", "rmse"))
    assert change.values[1:] == bootstrap.change_interval("tom", "rmse")
    assert base_median.values == (float(np.median([row["base"]["tom"]["rmse"] for row in report.rows])),)
    assert adapted_median.values == (float(np.median([row["adapted"]["tom"]["rmse"] for row in report.rows])),)
    gce = lines["GCE ↓"]
    assert gce[0].values[0] == report.gce["base"] and len(gce[0].values) == 3 and len(lines) == 13
    alone = report_of(random_rows([2, 3]), adapted=False)
    for row in alone.rows:
        del row["adapted"]
    assert uncertainty_table(alone).columns == ["base", "base"]


def test_group_table_has_a_line_per_group():
    report = report_of(random_rows([2, 3]))
    table = group_table(report)
    assert [row[0] for row in table.body()] == ["g00", "g01"] and [row[2] for row in table.body()] == ["2", "3"]
    first = [row["base"]["tom"]["rmse"] for row in report.rows[:2]]
    assert table.body()[0][3].values[0] == pytest.approx(sum(first) / 2)
    other = [row["base"]["other"]["rmse"] for row in report.rows[2:]]
    assert table.body()[1][6].values[0] == pytest.approx((other[0] + other[2]) / 2)  # the second has no such pixel


# ---- the four forms ----


def small_table() -> Table:
    rows = [
        ["a_1 & b", value_cell(1.23456), change_cell(-12.34, True)],
        None,
        ["c|d", estimate_cell(value_cell(2.0), (1.5, 2.5)), change_cell(3.0, False)],
        ["e", value_cell(None), Cell("none")],
    ]
    return Table("50 % of {it}", ["name"], ["RMSE ↓", "δ1 % ↑"], rows, [("ToM", 2)], ["note_1: 100 %"])


def test_csv_keeps_all_digits_and_parses():
    lines = list(csv.reader(io.StringIO(to_csv(small_table()))))
    assert lines[0] == ["name", "ToM RMSE", "ToM RMSE low", "ToM RMSE high", "ToM delta1 %"]
    assert lines[1] == ["a_1 & b", "1.23456", "", "", "-12.34"]
    assert lines[2] == ["c|d", "2.0", "1.5", "2.5", "3.0"]
    assert lines[3] == ["e", "", "", "", "none"]


def test_latex_is_escaped_and_balanced():
    text = to_latex(small_table())
    assert r"a\_1 \& b & 1.2346 & \textbf{-12.3 \%} \\" in text
    assert r"\multicolumn{2}{c}{ToM}" in text and r"\cmidrule(lr){2-3}" in text and r"RMSE $\downarrow$" in text
    assert r"\caption{50 \% of \{it\}. note\_1: 100 \%}" in text
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert {len(re.findall(r"(?<!\\)&", row)) for row in rows[1:]} == {2}  # (the first spans columns)
    assert text.count(r"\begin{") == text.count(r"\end{") == 2 and r"\resizebox{" in text
    assert len(re.findall(r"(?<!\\){", text)) == len(re.findall(r"(?<!\\)}", text))
    assert not re.search(r"(?<!\\)[%_]", re.sub(r"\$[^$]*\$", "", text))


def test_markdown_escapes_what_would_end_a_cell():
    lines = to_markdown(small_table()).splitlines()
    assert lines[2] == "| name | ToM RMSE ↓ | ToM δ1 % ↑ |"
    assert r"| c\|d | 2.0000 [1.5000, 2.5000] | +3.0 % |" in lines and "| a_1 & b | 1.2346 | **-12.3 %** |" in lines


def test_text_stacks_spans_and_marks_improvements_alone():
    table = small_table()
    table.spans = [("ToM", 1), ("All", 1)]
    text = to_text(table)
    blocks = text.split("\n\n")
    assert blocks[1].splitlines()[0].split() == ["ToM", "RMSE"] and "-12.3 %*" in text and "+3.0 %*" not in text


@pytest.mark.parametrize(
    ("percent", "text"), [(-66.23, "-66.2 %"), (0.0104, "+0.01 %"), (0.0, "+0.0 %"), (math.nan, "-")]
)
def test_changes(percent, text):
    assert change_cell(percent, percent < 0).text == text
