"""The before/after picture, pixel by pixel where it matters; error maps; PDFs."""

import io
import re
import sys

import numpy as np
import pytest
from helpers.reports import panel
from PIL import Image, ImageDraw

from gift_peft.colormap import GREY, colorize_error
from gift_peft.reports.figures import (
    CAPTION,
    GAP,
    HEADER,
    LEGEND,
    TEXT,
    TILE_WIDTH,
    align_panel,
    before_after,
    error_maps,
    error_row,
    panel_row,
    prediction_row,
    save_grid,
)


def tiles(picture: Image.Image, row=0, size=(60, 75)) -> list[np.ndarray]:
    height = round(TILE_WIDTH * size[0] / size[1])
    top = HEADER + row * (CAPTION + height + LEGEND + GAP) + CAPTION
    pixels = np.asarray(picture)
    return [
        pixels[top : top + height, left : left + TILE_WIDTH]
        for left in (GAP + index * (TILE_WIDTH + GAP) for index in range(4))
    ]


@pytest.mark.parametrize("kind", ["depth", "inverse_depth"])
def test_before_after_shows_one_range_and_unknown_in_the_reference_only(tmp_path, kind):
    path = before_after([panel(kind=kind), panel(1, kind=kind)], tmp_path / "figure.png")
    picture = Image.open(path)
    assert picture.size == (GAP + 4 * (TILE_WIDTH + GAP), HEADER + 2 * (CAPTION + 410 + LEGEND + GAP))
    for row in range(2):
        rgb, reference, base, adapted = tiles(picture, row)
        grey = [(tile[7:57, 7:57] == GREY).all(-1).all() for tile in (rgb, reference, base, adapted)]
        assert grey == [False, True, False, False]
        known = np.s_[85:]  # below the unknown corner; a perfect prediction looks like its reference
        difference = np.abs(reference[known].astype(int) - adapted[known])
        assert np.quantile(difference, 0.99) <= 3
        inside = np.s_[128:285, 164:313]
        assert np.abs(reference[inside].astype(int) - base[inside]).mean() > 15


def test_before_after_outlines_the_target(tmp_path):
    rows = tiles(Image.open(before_after([panel()], tmp_path / "figure.png")))
    middle, left = 205, round(20 * TILE_WIDTH / 75)
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
    rows = [text for text in captions if "RMSE" in text]
    assert "mm before, " in rows[0] and "RMSE in the outline: unknown" in rows[1]


@pytest.mark.parametrize("kind", ["depth", "inverse_depth"])
def test_error_maps_are_errors_after_alignment(kind):
    own = panel(kind=kind)
    aligned = align_panel(own)
    row = error_row(own)
    base, adapted = row.tiles[1:]
    assert (base[5:8, 5:8] == GREY).all() and (adapted[5:8, 5:8] == GREY).all()
    # A perfect prediction has the darkest colour of the map everywhere, where something is known.
    zero = colorize_error(np.zeros((1, 1)), 1)[0, 0]
    assert (adapted[20:40, 25:45] == zero).all()
    # The base's error is monotonous in the brightness of its map.
    error = np.abs(aligned.base - own.reference)[own.target]
    brightness = base[own.target].astype(int).sum(-1)
    order = np.argsort(error)
    assert (np.diff(brightness[order]) >= -12).all() and brightness.max() > brightness.min() + 100
    expected = np.sqrt(np.mean((aligned.base - own.reference)[own.target] ** 2))
    assert f"{expected:,.0f} mm before, 0 mm after" in row.caption


def test_pixels_that_do_not_count_neither_fit_nor_score():
    own = panel()
    spoiled = panel()
    spoiled.reference[15:30, 20:50] = 9000
    spoiled.valid = np.ones(own.reference.shape, bool)
    spoiled.valid[15:30, 20:50] = False
    aligned = align_panel(spoiled)
    assert aligned.errors[1] == pytest.approx(0, abs=1e-6)
    assert np.isnan(aligned.reference[20, 30]) and np.isfinite(aligned.adapted[20, 30])
    np.testing.assert_allclose(aligned.adapted, align_panel(own).adapted)


def test_predictions_of_one_picture_share_their_colours():
    image = Image.new("RGB", (40, 30))
    near, far = np.full((30, 40), 2.0), np.full((30, 40), 1.0)
    row = prediction_row("photo.jpg", image, [near, far, near], "inverse_depth")
    assert [tile.shape for tile in row.tiles] == [(30, 40, 3)] * 4
    assert (row.tiles[1] == row.tiles[3]).all() and row.tiles[1].sum() > row.tiles[2].sum()
    flipped = prediction_row("photo.jpg", image, [near, far], "depth")
    assert flipped.tiles[1].sum() < flipped.tiles[2].sum()


def test_a_pdf_is_the_same_picture_seven_inches_wide_and_the_same_every_time(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # it is not needed
    rows = [panel(), panel(1)]
    first, second = (before_after(rows, tmp_path / name).read_bytes() for name in ("a.pdf", "b.pdf"))
    assert first[:5] == b"%PDF-" and first == second
    width, height = map(float, re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", first).groups())
    picture = Image.open(before_after(rows, tmp_path / "a.png"))
    assert (width, height) == pytest.approx([side * 72 / 300 for side in picture.size], abs=0.01)
    assert 6.9 < width / 72 < 7.1 and picture.info["dpi"] == pytest.approx((300, 300), abs=0.1)
    start, end = first.index(b"\xff\xd8"), first.rindex(b"\xff\xd9") + 2
    inside = np.asarray(Image.open(io.BytesIO(first[start:end])))
    assert np.abs(inside.astype(int) - np.asarray(picture)).mean() < 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.pdf", "a.png", "b.pdf"]


def test_a_long_caption_goes_on_in_the_next_line_at_the_same_size(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(
        ImageDraw.ImageDraw, "text", lambda self, at, text, font, **_: written.append((text, font.size, font))
    )
    name = "a/" + "very_long_name_of_a_picture" * 6 + ".png, largest error of the base"
    picture = Image.open(error_maps([panel(label=name)], tmp_path / "figure.png"))
    lines = [(text, size, font) for text, size, font in written if size == TEXT][:-2]  # without the bar's two
    assert len(lines) > 1 and {size for _, size, _ in lines} == {TEXT}
    assert "".join(text for text, *_ in lines).replace(" ", "").startswith(name.replace(" ", ""))
    assert all(font.getlength(text) <= picture.width - 2 * GAP for text, _, font in lines)
    assert picture.height == HEADER + len(lines) * CAPTION + 410 + LEGEND + GAP


@pytest.mark.parametrize("size", [(40, 30), (30, 40), (64, 36), (50, 50)])
def test_tiles_have_the_photos_own_aspect_ratio(tmp_path, size):
    """Predictions have the network's; nobody wants to see a face squeezed to it."""
    own = panel(image=Image.new("RGB", size, (200, 30, 30)))
    picture = np.asarray(Image.open(before_after([own], tmp_path / "figure.png")))
    height = round(TILE_WIDTH * size[1] / size[0])
    assert picture.shape[0] == HEADER + CAPTION + height + LEGEND + GAP
    photo = picture[HEADER + CAPTION : HEADER + CAPTION + height, GAP : GAP + TILE_WIDTH].astype(int)
    red = (np.abs(photo - (200, 30, 30)).sum(-1) < 40).mean()
    assert red > 0.9  # all but the outline


@pytest.mark.parametrize("kind", ["depth", "inverse_depth"])
def test_the_color_bar_goes_from_near_to_far_with_units(kind):
    near, far = (4.0, 0.0000125) if kind == "inverse_depth" else (0.5, 12345.678)
    row = prediction_row(
        "photo.jpg", Image.new("RGB", (40, 30)), [np.full((30, 40), near), np.full((30, 40), far)], kind
    )
    assert row.bar.left.startswith("near: ") and row.bar.right.startswith("far: ")
    assert "e" not in row.bar.left.split()[1] + row.bar.right.split()[1]
    assert "(the model's units)" in row.bar.right
    assert (row.bar.colors[0, 0] == row.tiles[1][0, 0]).all() and (row.bar.colors[0, -1] == row.tiles[2][0, 0]).all()
    millimeters = panel_row(panel(kind=kind)).bar
    first, last = (int(text.split()[1].replace(",", "")) for text in (millimeters.left, millimeters.right))
    assert first < last and millimeters.left.endswith(" mm")
    assert (error_row(panel()).bar.left, error_row(panel()).bar.right[-11:]) == ("no error", " mm or more")


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"x\.svg: a figure is \.png or \.pdf"):
        save_grid([panel_row(panel())], ("a", "b", "c", "d"), tmp_path / "x.svg")
