"""The page of surface targets: one file, what differs most first, figures where there is a treated reference."""

import re
from dataclasses import replace

import pytest
import torch
from helpers.tiny import SIZE, write_raw_tree

from gift_peft.cli import main
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.dataset.proxies import SurfaceSettings
from gift_peft.dataset.rows import parsed
from gift_peft.reports import targets_page as page
from gift_peft.rules import UNKNOWN
from gift_peft.training.teacher import make_proxies

pytestmark = pytest.mark.usefixtures("fresh_cache")
TWO = SurfaceSettings(fills=2)


@pytest.fixture
def groups(raw_tree, base_dir):
    make_proxies(base_dir, raw_tree, size=SIZE, surface=TWO)
    splits = (parsed(load_gift_i(raw_tree, split, base_dir, surface=TWO)) for split in ("train", "validation"))
    return [group for rows in splits for group in rows]


def test_every_observation_sorted_by_difference(groups):
    text = page.targets_page(groups, "inverse_depth")
    moved = [float(number) for number in re.findall(r"moved by ([\d.]+)%", text)]
    assert len(moved) == text.count("<h2>") == 7 and moved == sorted(moved, reverse=True) and moved[0] > 0
    assert text.count("<img ") == 5 * 3 + 2 * 4
    assert text.count("treated reference</figcaption>") == 2
    assert not re.search(r"<script|href=\"(?!data:)|src=\"(?!data:)", text)
    assert "7 observations, sorted" in text


def test_a_known_move_is_told(groups):
    """Nearer by a tenth of the range: larger inverse depth, smaller depth; twice the distance to a reference."""
    group = groups[2]
    spread = [float(each.quantile(0.95) - each.quantile(0.05)) for each in group.proxies]
    mask = torch.stack([torch.from_numpy(page.resize_mask(mask, SIZE)) for mask in group.masks])
    step = 0.1 * torch.tensor(spread)[:, None, None] * mask
    for kind, sign in (("inverse_depth", 1), ("depth", -1)):
        target = group.proxies + sign * step
        known = replace(group, surface_target=target, reference_proxy=target[0])
        text = page.targets_page([known], kind)
        assert text.count("moved by 10.0% in the median, nearer on 100% of the target") == 2
        assert "from the treated reference 10.0% before, 0.0% after" in text


def test_what_the_teacher_leaves_out_sets_no_colors_and_no_figures(groups):
    """Sky of a network that masks itself, in one observation and its reference; or zeros all around the target."""
    group = next(group for group in groups if group.reference_proxy is not None)
    mask = torch.stack([torch.from_numpy(page.resize_mask(mask, SIZE)) for mask in group.masks])
    sky = torch.zeros(mask.shape, dtype=torch.bool)
    sky[:, :10] = True
    target = group.proxies + 0.1 * mask
    plain = page.targets_page([replace(group, surface_target=target)], "depth")
    known = {name: getattr(group, name) for name in ("proxies", "reference_proxy")}
    known["surface_target"] = target
    unknown = {name: maps.masked_fill(sky[0] if maps.ndim == 2 else sky, UNKNOWN) for name, maps in known.items()}
    text = page.targets_page([replace(group, **unknown)], "depth")
    moved = [[float(number) for number in re.findall(r"moved by ([\d.]+)%", each)] for each in (plain, text)]
    assert moved[1] == pytest.approx(moved[0], rel=0.5) and "before" in text
    zeros = replace(group, proxies=torch.where(mask, group.proxies, 0), surface_target=torch.where(mask, target, 0))
    assert "before" not in page.targets_page([zeros], "inverse_depth")


def test_long_pages_are_cut_and_say_so(groups, monkeypatch):
    monkeypatch.setattr(page, "LIMIT", 3)
    text = page.targets_page(groups, "depth")
    assert text.count("<h2>") == 3 and "The 3 of 7 observations" in text


def test_names_are_escaped_and_no_target_is_told(groups):
    blank = [0 * mask > 0 for mask in groups[0].masks]
    odd = replace(groups[0], group_id="a<b>", masks=blank)
    text = page.targets_page([odd], "depth")
    assert "a&lt;b&gt;" in text and "no target at this size" in text


def test_the_verb_writes_it(tmp_path, base_dir, capsys):
    raw = write_raw_tree(tmp_path / "raw", train=(1, 2), validation=(1,))
    options = ["--base", base_dir, "--dataset", raw, "--size", "56x70", "--target", "surface", "--fills", "0"]
    with pytest.raises(SystemExit) as ended:
        main(["proxies", *map(str, options), "--page", str(tmp_path / "targets.html")])
    assert ended.value.code == 0 and "Page: " in capsys.readouterr().out
    assert (tmp_path / "targets.html").read_text().count("<h2>") == 4
