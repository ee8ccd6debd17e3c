"""Figures 5 and 6: what is drawn, relative to what, smoothed how."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gift_peft.reports import curves
from gift_peft.reports.curves import COLORS, DASHES, draw_dynamics, draw_retention, normalized, smooth

pytest.importorskip("matplotlib")


def history(values, key="val_gce", **more):
    return [{"step": 10 * i, "epoch": i, key: value} | more for i, value in enumerate(values)]


def test_curves_start_at_one_and_leave_out_what_was_not_measured():
    epochs, values = normalized(history([0.5, 0.25, None, 1.0]), "val_gce")
    assert epochs == [0, 1, 3] and values == [1, 0.5, 2]
    assert normalized(history([0.5, 0.25]), "booster_tom_rmse") == ([], [])
    with pytest.raises(ValueError, match="val_gce is 0 at step 0"):
        normalized(history([0.0, 0.25]), "val_gce")


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=30), st.sampled_from([1, 3, 5, 9]))
def test_smoothing_is_a_centred_mean(values, width):
    smoothed = smooth(values, width)
    assert len(smoothed) == len(values) and smoothed[0] == values[0] and smoothed[-1] == values[-1]
    for index, value in enumerate(smoothed):
        reach = max(r for r in range(width // 2 + 1) if index - r >= 0 and index + r < len(values))
        window = [values[index + offset] for offset in range(-reach, reach + 1)]
        assert value == pytest.approx(sum(window) / len(window), abs=1e-9)
    line = [3.0 * index for index in range(20)]
    assert smooth(line, width) == pytest.approx(line)  # no lag


@pytest.fixture
def drawn(monkeypatch):
    """{title of the plot: {legend: (epochs, values)}} of what matplotlib was told to draw, unsmoothed and smoothed."""
    from matplotlib.axes import Axes

    lines = []
    original = Axes.plot

    def plot(axis, x, y, **options):
        lines.append((axis, options.get("label"), list(x), list(y), options.get("color"), options.get("linestyle")))
        return original(axis, x, y, **options)

    monkeypatch.setattr(Axes, "plot", plot)
    return lines


def test_dynamics_draws_what_was_logged(tmp_path, drawn):
    rows = history([0.4, 0.2, 0.1, 0.1])
    for row, train in zip(rows, [0.8, 0.4, 0.4, 0.2], strict=True):
        row["train_gce"] = train
    paths = [tmp_path / "a.png", tmp_path / "a.pdf"]
    assert draw_dynamics([("DA", rows)], paths) == [curves.DYNAMICS["train_gce"], curves.DYNAMICS["val_gce"]]
    assert all(path.stat().st_size > 1000 for path in paths) and len(list(tmp_path.iterdir())) == 2
    labels = {label: values for _, label, _, values, *_ in drawn if label}
    assert labels[curves.DYNAMICS["val_gce"]] == pytest.approx(smooth([1, 0.5, 0.25, 0.25], 3))
    assert labels[curves.DYNAMICS["train_gce"]] == pytest.approx(smooth([1, 0.5, 0.5, 0.25], 3))
    for row in rows:
        row["booster_tom_rmse"] = 100.0
    assert curves.DYNAMICS["booster_tom_rmse"] in draw_dynamics([("DA", rows)], paths)


def test_retention_shows_diverged_runs_and_then_the_rest(tmp_path, drawn):
    calm, wild = history([0.5, 0.6, 0.55], "val_other_rmse"), history([0.5, 8, 90], "val_other_rmse")
    assert draw_retention([("1:1", calm), ("1:0", wild)], [tmp_path / "a.png"]) == ["1:1", "1:0"]
    axes = list(dict.fromkeys(axis for axis, *_ in drawn))
    assert [{label for axis, label, *_ in drawn if axis is own and label} for own in axes] == [{"1:1", "1:0"}, {"1:1"}]
    assert [axis.get_yscale() for axis in axes] == ["log", "linear"]
    drawn.clear()
    draw_retention([("1:1", calm)], [tmp_path / "a.png"])
    assert len({axis for axis, *_ in drawn}) == 1
    styles = {(label, color, dash) for _, label, _, _, color, dash in drawn if label}
    assert len(styles) == 1


def test_no_two_runs_look_alike():
    styles = {(COLORS[n % len(COLORS)], DASHES[n % len(DASHES)]) for n in range(math.lcm(len(COLORS), len(DASHES)))}
    assert len(styles) == 28


def test_nothing_to_draw_writes_nothing(tmp_path):
    assert draw_dynamics([("DA", history([None, None]))], [tmp_path / "a.png"]) == []
    assert draw_retention([("DA", history([0.4, 0.3]))], [tmp_path / "a.png"]) == []
    assert not list(tmp_path.iterdir())


def test_a_curve_that_starts_at_zero_is_said(tmp_path):
    with pytest.raises(ValueError, match="the curve cannot be relative"):
        draw_dynamics([("DA", history([0.0, 0.3]))], [tmp_path / "a.png"])
    assert not list(tmp_path.iterdir()) and curves.DIVERGED == 2


def test_titles_and_legends_explain_themselves_and_hide_no_curve(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    shown = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *args, **more: (shown.append(self), save(self, *args, **more)))
    draw_dynamics([("DA", history([0.4, 0.2, 0.1]))], [tmp_path / "a.png"])
    draw_retention([("1:1", history([0.4, 0.5], "val_other_rmse"))], [tmp_path / "b.png"])
    for figure, title in zip(shown, ("inside the target", "outside the target"), strict=True):
        assert title in figure.get_suptitle() and "lower is better" in figure.get_suptitle()
        (axis,) = figure.axes
        legend, frame = axis.get_legend().get_window_extent(), axis.get_window_extent()
        assert legend.y1 <= frame.y0 and legend.x0 >= 0 and legend.x1 <= figure.bbox.x1 and legend.y0 >= 0
        assert "the base" in [text.get_text() for text in axis.get_legend().get_texts()]
        assert axis.get_ylabel() == "times the base's value"
