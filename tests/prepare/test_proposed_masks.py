"""Masks that are missing: proposed, looked at, accepted, and what of it is done again."""

import shutil

import numpy as np
import pytest
from helpers.photos import capture, entry
from PIL import Image

from gift_peft.cli import main
from gift_peft.dataset.gift_i import load_gift_i
from gift_peft.prepare import proposals
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.settings import PrepareSettings

SIZE = (160, 200)

pytestmark = pytest.mark.usefixtures("fresh_cache")


def test_proposed_masks_are_used_only_when_accepted(tmp_path):
    group = capture(tmp_path / "raw/g", 14, count=3, size=SIZE)
    drawn = np.asarray(Image.open(group / "masks/2.png")) > 0
    shutil.rmtree(group / "masks")
    raw, out = tmp_path / "raw", tmp_path / "out"
    found = prepare_gift_i(raw, out)["groups"][0]
    assert found["status"] == "rejected" and "missing mask" in found["reasons"][0]["text"]
    found = prepare_gift_i(raw, out, PrepareSettings(propose_masks=True))["groups"][0]
    assert found["status"] == "rejected" and found["reasons"][0]["code"] == "masks_proposed"
    assert found["proposal"]["accepted"] is False and len(found["proposal"]["masks"]) == 3
    assert not (out / "train/g").exists() and not (raw / "g/masks_proposed").exists()
    mask = np.asarray(Image.open(out / found["proposal"]["masks"][2])) > 0
    assert (mask & drawn).sum() / (mask | drawn).sum() > 0.6
    settings = PrepareSettings(propose_masks=True, accept_proposed_masks=True)
    found = prepare_gift_i(raw, out, settings)["groups"][0]
    assert found["status"] == "kept" and found["proposal"]["accepted"] is True
    assert "proposed" in (out / "README.md").read_text()
    row = load_gift_i(out, "train")[0]
    assert np.array_equal(np.asarray(row["masks"][2]) > 0, mask)
    for name in found["proposal"]["masks"]:  # taken over by hand: now they are drawn
        (group / "masks").mkdir(exist_ok=True)
        shutil.copy(out / name, group / "masks")
    found = prepare_gift_i(raw, out)["groups"][0]
    assert found["status"] == "kept" and found["proposal"] is None
    assert "proposed" not in (out / "README.md").read_text() and not (out / "masks_proposed/train/g").exists()


def without_masks(folder, seed, count=3, **options):
    group = capture(folder, seed, count=count, size=SIZE, **options)
    shutil.rmtree(group / "masks")
    return group


def test_a_weak_proposal_is_accepted_only_where_it_is_asked_for(tmp_path, capsys, monkeypatch):
    """What stands out a little on a board on which nothing reflects is no target."""
    raw, out = tmp_path / "raw", tmp_path / "out"
    without_masks(raw / "glass", 14)
    without_masks(raw / "board", 15)
    mask = np.asarray(Image.open(capture(tmp_path / "drawn", 15, size=SIZE) / "masks/0.png")) > 0
    real, scores = proposals.propose, iter([0.014])

    def propose(images):  # groups come in natural order: the board first
        score = next(scores, None)
        return real(images) if score is None else proposals.Proposal(mask, score, 0.2, 0.2, 0.35)

    monkeypatch.setattr(proposals, "propose", propose)
    accept = PrepareSettings(propose_masks=True, accept_proposed_masks=True)
    report = prepare_gift_i(raw, out, accept)
    board, glass = entry(report, "board"), entry(report, "glass")
    assert glass["status"] == "kept" and glass["proposal"]["score"] > accept.min_proposal_score
    assert board["status"] == "rejected" and board["reasons"][0]["code"] == "weak_proposal"
    text = board["reasons"][0]["text"]
    assert "score of 0.01, below 0.5" in text and text.endswith("--min-proposal-score 0.01")
    assert board["proposal"]["masks"] and not board["proposal"]["accepted"]
    with pytest.raises(SystemExit) as ended:
        words = ["--accept-proposed-masks", "--min-proposal-score", "0.01"]
        main(["prepare", str(raw), str(out), *words])
    assert ended.value.code == 0
    assert "accepted: train/board (score 0.01), train/glass (score 0." in capsys.readouterr().out


def test_accepting_masks_does_nothing_twice(tmp_path, monkeypatch):
    """Groups with drawn masks stay as they are; proposals of the run before are taken as they were looked at."""
    raw, out = tmp_path / "raw", tmp_path / "out"
    capture(raw / "drawn", 1, count=2, size=SIZE)
    without_masks(raw / "bare", 14)
    first = prepare_gift_i(raw, out, PrepareSettings(propose_masks=True))
    before = {path: path.stat().st_mtime_ns for path in (out / "train/drawn").rglob("*.png")}
    looked_at = {path.name: path.read_bytes() for path in (out / "masks_proposed").rglob("*.png")}
    with monkeypatch.context() as patch:
        patch.setattr("gift_peft.prepare.proposals.propose", None)  # calling it would be an error
        accepted = prepare_gift_i(raw, out, PrepareSettings(propose_masks=True, accept_proposed_masks=True))
    assert entry(accepted, "bare")["status"] == "kept" and len(looked_at) == 3
    assert before and before == {path: path.stat().st_mtime_ns for path in (out / "train/drawn").rglob("*.png")}
    assert looked_at == {path.name: path.read_bytes() for path in (out / "masks_proposed").rglob("*.png")}
    kept = [entry(report, "bare")["proposal"] | {"accepted": None} for report in (first, accepted)]
    assert kept[0] == kept[1]
    settings = PrepareSettings(propose_masks=True, accept_proposed_masks=True)
    again = prepare_gift_i(raw, tmp_path / "fresh", settings)
    assert {**again, "raw": ""} == {**accepted, "raw": ""}


def test_one_observation_and_its_reference_get_a_proposal(tmp_path):
    raw = tmp_path / "raw"
    group = capture(raw / "validation/one", 14, count=1, size=SIZE, reference=True)
    drawn = np.asarray(Image.open(group / "masks/0.png")) > 0
    shutil.rmtree(group / "masks")
    without_masks(raw / "validation/alone", 15, count=1)
    report = prepare_gift_i(raw, tmp_path / "out", PrepareSettings(propose_masks=True))
    found = entry(report, "one")
    mask = np.asarray(Image.open(tmp_path / "out" / found["proposal"]["masks"][0])) > 0
    assert found["reasons"][0]["code"] == "masks_proposed" and (mask & drawn).sum() / (mask | drawn).sum() > 0.6
    assert entry(report, "alone")["status"] == "rejected"
