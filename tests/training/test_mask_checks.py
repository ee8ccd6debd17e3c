"""Masks that cannot teach are refused, those that nearly cannot are told."""

import logging

import numpy as np
import pytest
import torch
from helpers.runs import arguments
from helpers.tiny import write_raw_tree
from PIL import Image

from gift_peft.group_inputs import GroupInputs
from gift_peft.training import train
from gift_peft.training.mask_checks import check_surroundings, smallest_pair, warn_of_masks


def inputs(mask, valid=None, names=("a.png", "b.png", "c.png")):
    count = len(mask)
    return GroupInputs(
        torch.zeros(count, 3, 2, 2), mask, torch.zeros(mask.shape), valid, list(names[:count]) if names else None
    )


def masks(count=3, side=40):
    mask = torch.zeros(count, side, side, dtype=torch.bool)
    mask[:, 5:25, 5:25] = True
    return mask


def test_masks_without_any_surroundings():
    mask = torch.ones(2, 6, 6, dtype=torch.bool)
    with pytest.raises(ValueError, match="group hall: its masks cover the whole photos") as error:
        check_surroundings("hall", mask, None)
    assert "\n" not in str(error.value)
    valid = torch.ones_like(mask)
    mask[:, 0], valid[:, 0] = False, False  # the only pixels outside do not exist
    with pytest.raises(ValueError, match="group hall"):
        check_surroundings("hall", mask, valid)
    valid[1, 0, 0] = True
    check_surroundings("hall", mask, valid)


def test_nearly_none_and_none_of_one_photo_are_told(caplog):
    warn_of_masks("hall", inputs(masks()))
    assert not caplog.records
    mask = masks()
    mask[1] = True
    warn_of_masks("hall", inputs(mask))
    assert "group hall: the mask of b.png covers the whole photo" in caplog.text
    mask[:] = True
    mask[:, 0, :5] = False
    warn_of_masks("hall", inputs(mask))
    assert "group hall: 100 % of its pixels are target" in caplog.text


def test_a_pair_that_shares_next_to_nothing_is_told(caplog):
    mask = masks()
    mask[2] = False
    mask[2, 24:34, 24:34] = True  # one pixel of the others
    assert smallest_pair(inputs(mask)) == ("a.png", "c.png", 1)
    with caplog.at_level(logging.WARNING):
        warn_of_masks("hall", inputs(mask, names=None))
    assert "group hall: the masks of image 0 and image 2 share 1 pixels only" in caplog.text
    mask[2, 24:34, 24:34] = False
    mask[2, 30:34, 30:34] = True  # none: no pair at all
    assert smallest_pair(inputs(mask)) is None
    assert smallest_pair(inputs(masks())) is None


def test_a_training_on_such_masks_stops_before_its_first_update(base_dir, tmp_path):
    tree = write_raw_tree(tmp_path / "raw", validation=())
    folder = next((tree / "train").iterdir()) if (tree / "train").is_dir() else next(tree.iterdir())
    for path in (folder / "masks").iterdir():
        size = Image.open(path).size
        Image.fromarray(np.full(size[::-1], 255, np.uint8)).save(path)
    out = tmp_path / "out"
    with pytest.raises(ValueError, match=f"group {folder.name}: its masks cover the whole photos"):
        train(arguments(base_dir, tree, out))
    assert not (out / "adapter-last").exists() and not (out / "metrics.jsonl").exists()
