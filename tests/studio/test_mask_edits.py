"""Edits to masks: strokes and polygons against their definitions, the order of edits, what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.studio.mask_edits import View, check_edits, draw_edits

SHAPE = 60, 80
shares = st.floats(0, 1, allow_nan=False)
points = st.lists(st.tuples(shares, shares).map(list), min_size=1, max_size=5)


def view(shape=SHAPE):
    """A group in which a box changes, a third of each side."""
    change = np.zeros(shape, np.float32)
    change[shape[0] // 3 : 2 * shape[0] // 3, shape[1] // 3 : 2 * shape[1] // 3] = 30
    picture = np.full((*shape, 3), 100, np.uint8)
    picture[change > 0] = 200
    return View(picture, change, 2.0)


def empty(shape=SHAPE):
    return np.zeros(shape, bool)


def centers(shape=SHAPE):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return columns + 0.5, rows + 0.5


def distance_to(stroke, shape=SHAPE):
    """Of every pixel's center to the nearest piece of a line of shares."""
    x, y = centers(shape)
    line = [(px * shape[1], py * shape[0]) for px, py in stroke]
    best = np.full(shape, np.inf)
    for (x0, y0), (x1, y1) in zip(line, line[1:] or line, strict=False):
        length = (x1 - x0) ** 2 + (y1 - y0) ** 2
        along = np.clip(((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / length, 0, 1) if length > 0 else 0
        best = np.minimum(best, np.hypot(x - x0 - along * (x1 - x0), y - y0 - along * (y1 - y0)))
    return best


@settings(max_examples=60, deadline=None)
@given(points, st.floats(0.05, 0.4))
def test_a_stroke_is_what_lies_near_its_line(stroke, size):
    drawn = draw_edits(empty(), [{"tool": "brush", "points": stroke, "size": size, "target": True}], view())
    far, radius = distance_to(stroke), size * SHAPE[1] / 2
    assert drawn[far < radius - 1.5].all() and not drawn[far > radius + 1.5].any()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(shares, shares).map(list), min_size=3, max_size=3))
def test_a_triangle_is_what_lies_on_one_side_of_its_edges(corners):
    drawn = draw_edits(empty(), [{"tool": "polygon", "points": corners, "target": True}], view())
    (x0, y0), (x1, y1), (x2, y2) = [(px * SHAPE[1], py * SHAPE[0]) for px, py in corners]
    x, y = centers()
    sides = [
        (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        for ax, ay, bx, by in ((x0, y0, x1, y1), (x1, y1, x2, y2), (x2, y2, x0, y0))
    ]
    inside = np.all([side > 1e-6 for side in sides], axis=0) | np.all([side < -1e-6 for side in sides], axis=0)
    outside = np.any([side > 1e-6 for side in sides], axis=0) & np.any([side < -1e-6 for side in sides], axis=0)
    assert drawn[inside].all() and not drawn[outside].any()


STROKE = {"tool": "brush", "points": [[0.1, 0.5], [0.9, 0.5]], "size": 0.1, "target": True}
CLICK = {"tool": "click", "x": 0.5, "y": 0.5, "target": True}


def test_later_edits_win_and_the_start_is_left_alone():
    start = empty()
    start[:10] = True
    before = start.copy()
    drawn = draw_edits(start, [STROKE, {**STROKE, "points": [[0.5, 0.5]], "target": False}], view())
    assert drawn[30, 10] and drawn[30, 70] and not drawn[30, 40] and drawn[:10].all()
    assert np.array_equal(start, before)
    assert not draw_edits(start, [STROKE, {"tool": "clear"}], view()).any()
    assert draw_edits(start, [{"tool": "clear"}, STROKE], view())[30, 10]


@pytest.mark.parametrize("scale", [1, 3])
def test_a_click_and_a_proposal_find_the_box_at_any_size(scale):
    """The photo is larger than what clicks are judged by."""
    large = SHAPE[0] * scale, SHAPE[1] * scale
    box = view(large).change > 0
    for edit in (CLICK, {"tool": "propose"}):
        found = draw_edits(empty(large), [edit], view())
        assert (found & box).sum() / (found | box).sum() > 0.9
    nothing = View(view().picture, np.zeros(SHAPE, np.float32), 1.0)
    assert not draw_edits(empty(), [{"tool": "propose"}], nothing).any()


def test_a_miss_takes_away_only_what_it_stands_on():
    start = empty()
    start[:8, :8] = True
    miss = {**CLICK, "target": False}
    left = draw_edits(start | (view().change > 0), [{**miss, "x": 0.05, "y": 0.05}], view())
    assert left[30, 40] and not left[3, 4]
    assert np.array_equal(draw_edits(start, [miss], view()), start)  # on nothing


def test_sam_redraws_what_was_clicked_on(monkeypatch):
    asked = []

    def redraw(proposal, image, method):
        asked.append((proposal.mask.copy(), image.shape, method))
        return type(proposal)(np.ones_like(proposal.mask), 0.0)

    monkeypatch.setattr("gift_peft.studio.mask_edits.refine", redraw)
    with_sam = View(view().picture, view().change, 2.0, "sam2:tiny")
    assert draw_edits(empty(), [CLICK], with_sam).all()
    assert draw_edits(empty(), [CLICK, STROKE], with_sam).all() and len(asked) == 1  # asked once for one question
    assert asked[0][0][30, 40] and not asked[0][0][5, 5] and asked[0][2] == "sam2:tiny"


@pytest.mark.parametrize(
    "edits",
    [
        None,
        {"tool": "clear"},
        ["clear"],
        [{}],
        [{"tool": "../../etc/passwd"}],
        [{"tool": "click", "x": 0.5, "target": True}],
        [{"tool": "click", "x": "0.5", "y": 0.5, "target": True}],
        [{"tool": "click", "x": float("nan"), "y": 0.5, "target": True}],
        [{"tool": "click", "x": float("inf"), "y": 0.5, "target": True}],
        [{"tool": "click", "x": 10**400, "y": 0.5, "target": True}],
        [{"tool": "click", "x": 0.5, "y": 0.5}],
        [{"tool": "click", "x": True, "y": 0.5, "target": True}],
        [{**STROKE, "points": []}],
        [{**STROKE, "points": [[0.5]]}],
        [{**STROKE, "points": "abc"}],
        [{**STROKE, "points": [[0.5, 1e300]]}],
        [{**STROKE, "points": [[0.5, 0.5]] * 30_000}],
        [{**STROKE, "size": 0}],
        [{**STROKE, "size": 1e9}],
        [{**STROKE, "size": None}],
        [{"tool": "polygon", "points": [[0, 0], [1, 1]], "target": True}],
        [{"tool": "clear"}] * 2000,
    ],
)
def test_a_page_cannot_send_anything_else(edits):
    with pytest.raises(ValueError, match=r"^edits: [^\n]{1,200}$"):
        check_edits(edits)


def test_what_is_right_is_taken_as_it_is():
    edits = [CLICK, STROKE, {"tool": "propose"}, {"tool": "clear"}]
    assert check_edits(edits) is edits
