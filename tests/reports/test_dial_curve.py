"""LayeredDepth and MD-3k in `gift-peft report`: tables, the dial's curve, and folders that are damaged."""

import json

import pytest
from PIL import Image

from gift_peft.evaluation.md3k import _with_alpha
from gift_peft.evaluation.ordering_tables import ordering_text
from gift_peft.evaluation.orderings import OrderingReport
from gift_peft.reports.dial_curve import draw_dial
from gift_peft.reports.report import run_report


def accuracies(first, second):
    names = ("sra1", "sra2", "same_sra1", "same_sra2", "reverse_sra1", "reverse_sra2")
    return _with_alpha(dict(zip(names, (first, second, 0.9, 0.9, first - 0.1, second - 0.1), strict=True)))


def make_report(dial=(-1, 0, 1)):
    summary = accuracies(0.7, 0.4)
    questions = {name: 40 for name in summary if not name.endswith("alpha")}
    return OrderingReport(
        dataset="md3k",
        summary=summary,
        base=accuracies(0.5, 0.6),
        counts={"photos": 3, "questions": questions, "outside": dict.fromkeys(questions, 0)},
        adapted=True,
        dial=[{"scale": scale} | accuracies(0.5 + 0.2 * scale, 0.6 - 0.2 * scale) for scale in dial],
        notes=["MD-3k."],
        rows=[{"image": "a.png"}],
        about={"base": "someone/base", "kind": "depth"},
    )


def test_the_report_has_tables_and_the_curve(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    make_report().save(tmp_path / "md3k")
    folder = run_report([tmp_path / "md3k"])
    printed, text = capsys.readouterr().out, (folder / "report.md").read_text()
    assert "Layer dial" in printed and "| adapter scale |" in text and "![layer dial](md3k-dial.png)" in text
    assert "someone/base" in text
    rows = (folder / "tables" / "md3k-dial.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["adapter scale", "-1", "0", "+1"]
    assert [round(float(row.split(",")[3]), 6) for row in rows[1:]] == [0.5, 0.1, -0.3]  # alpha falls toward the glass
    assert Image.open(folder / "md3k-dial.png").size[0] > 500 and (folder / "md3k-dial.pdf").stat().st_size > 1000
    with pytest.raises(ValueError, match="turned no dial"):
        draw_dial(make_report(()), [tmp_path / "x.png"])


def test_the_table_says_what_changed():
    text = ordering_text(make_report())
    assert "SRA(1), the glass" in text and "+0.2000" in text and "-0.4000" in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_damaged_evaluation_is_named(tmp_path):
    make_report().save(tmp_path / "md3k")
    path = tmp_path / "md3k" / "metrics.json"
    values = json.loads(path.read_text())
    del values["counts"]
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match=r"metrics\.json: no evaluation of orderings: it needs"):
        run_report([tmp_path / "md3k"])
