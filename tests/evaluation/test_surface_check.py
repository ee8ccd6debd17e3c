"""What is known of surface targets before training: errors as an evaluation has them, the rest plain statistics."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from gift_peft.evaluation.surface_check import describe, describe_nothing, surface_lines
from gift_peft.rules import GroupPictures
from gift_peft.surface_targets import surface_target

H, W = 24, 32


def group(rng, count=3, **parts):
    mask = np.zeros((H, W), bool)
    mask[6:18, 8:24] = True
    images = [Image.fromarray(rng.integers(0, 255, (H, W, 3), dtype=np.uint8)) for _ in range(count)]
    return GroupPictures("door", [f"{i}.png" for i in range(count)], images, [mask] * count, **parts), mask


def predictions(rng, count=3):
    """Inverse depth of a tilted wall; inside the mask each observation sees something farther."""
    rows, columns = np.mgrid[:H, :W]
    wall = 0.5 + 0.004 * columns + 0.002 * rows
    return wall, torch.from_numpy(np.stack([wall] * count) + rng.normal(0, 1e-3, (count, H, W))).float()


def test_measured_errors_are_those_of_a_plain_fit():
    rng = np.random.default_rng(0)
    wall, base = predictions(rng)
    pictures, mask = group(rng)
    base[:, mask] *= 0.8
    truth = np.stack([np.round(1000 / wall)] * 3).astype(np.uint16)
    truth[0, :3] = 0  # unknown
    pictures, _ = group(
        rng, depths=list(truth), reference_proxy=torch.from_numpy(2 * wall + 1).float(), surface="transparent"
    )
    found = surface_target(base.numpy(), np.stack([mask] * 3))
    told = describe(pictures, base, found, "inverse_depth")
    assert told["surface"] == "transparent" and told["model"] == found.model
    for index, row in enumerate(told["observations"]):
        for maps, error in zip((base, torch.from_numpy(found.depth)), row["depth"], strict=True):
            own, known = maps[index].double().numpy(), truth[index] > 0
            slope, offset = np.polyfit(own[known], 1000 / truth[index][known], 1)
            depth = 1000 / (slope * own + offset)
            expected = np.sqrt(np.mean((depth - truth[index])[mask & known] ** 2))
            assert error == pytest.approx(expected, rel=1e-6)
        for maps, error in zip((base, torch.from_numpy(found.depth)), row["proxy"], strict=True):
            own, reference = maps[index].double().numpy(), 2 * wall + 1
            slope, offset = np.polyfit(own.ravel(), reference.ravel(), 1)
            expected = np.sqrt(np.mean((slope * own + offset - reference)[mask] ** 2))
            assert error == pytest.approx(expected, rel=1e-5)
        moved = (found.depth[index] - base[index].numpy())[mask]
        assert row["nearer"] == pytest.approx(np.mean(moved > 0))
        spread = np.subtract(*np.percentile(base[index].numpy().astype(float), (95, 5)))
        assert row["moved"] == pytest.approx(np.median(np.abs(moved)) / spread, rel=1e-5)


def test_depth_that_is_larger_is_not_nearer():
    rng = np.random.default_rng(1)
    _, base = predictions(rng, 1)
    pictures, mask = group(rng, 1)
    found = surface_target(base.numpy(), mask[None], model="quantile")
    found.depth[0, mask] += 0.2
    assert describe(pictures, base, found, "depth")["observations"][0]["nearer"] == 0
    assert describe(pictures, base, found, "inverse_depth")["observations"][0]["nearer"] == 1


def told(surface, errors, **more):
    rows = [{"image": str(i), "nearer": 0.75, "moved": 0.1, **more} for i in range(len(errors))]
    for row, pair in zip(rows, errors, strict=True):
        row |= {"depth": pair}
    return {"surface": surface, "model": ["plane"], "residual": [0.02], "disagreement": [None], "observations": rows}


def test_lines_per_surface_kind():
    groups = [
        ("a", told("mirror", [[200.0, 100.0], [100.0, 50.0]])),
        ("b", told("mirror", [[300.0, 150.0]])),
        ("c", told(None, [None])),
        ("d", {}),  # a file of an older version
    ]
    lines = surface_lines(groups)
    assert lines == [
        "mirror (2 groups): error inside the target against true depth: 200 mm of the base, 100 mm of the surface "
        "target (-50 % [-50, -50])",
        "unknown surface (1 group): 75% of the target moved nearer, by 10.0% of the prediction's range; a plane "
        "misses them by 2.0% (no treated reference or true depth here says whether that is right)",
    ]


def test_partly_known_and_one_group():
    groups = [("a", told("mirror", [[200.0, 100.0]])), ("b", told("mirror", [None]))]
    (line,) = surface_lines(groups)
    assert "of 1 group that have it: 200 mm" in line and line.endswith("(-50 %)")  # no interval of one group


def test_without_a_target_at_this_size_nothing_is_claimed():
    rng = np.random.default_rng(2)
    _, base = predictions(rng, 1)
    pictures, mask = group(rng, 1)
    found = surface_target(base.numpy(), mask[None])
    pictures.masks[0][:] = False
    row = describe(pictures, base, found, "inverse_depth")["observations"][0]
    assert row["nearer"] is None and row["moved"] is None
    assert surface_lines([("a", {"surface": None, "observations": [row]})]) == [
        "unknown surface (1 group): no target at this size"
    ]
    assert not math.isnan(base.sum())


def test_groups_without_a_target_at_this_size_are_counted():
    pictures, _ = group(np.random.default_rng(3), 1)
    nothing = describe_nothing(pictures) | {"surface": "mirror"}
    (line,) = surface_lines([("a", nothing)])
    assert line == "mirror (1 group): no target at this size"
    for pair in ([200.0, 100.0], None):
        *_, line = surface_lines([("a", told("mirror", [pair])), ("b", nothing)])
        assert line == "mirror (2 groups): no target at this size in 1 group, such as b"
