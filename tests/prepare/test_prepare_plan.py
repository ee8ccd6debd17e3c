"""What `gift-peft prepare` says before and while it works: the dry run and the bar."""

import shutil

import pytest
from helpers.photos import capture

from gift_peft.cli import main
from gift_peft.prepare.prepare import prepare_gift_i

SIZE = (160, 200)


def snapshot(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def test_a_bar_of_groups_and_frames_from_the_start(tmp_path, capsys):
    capture(tmp_path / "raw/a", 1, count=2, size=SIZE)
    capture(tmp_path / "raw/b", 2, count=3, size=SIZE, reference=True)
    prepare_gift_i(tmp_path / "raw", tmp_path / "out", num_proc=1)
    shown = capsys.readouterr().err
    assert "0/6 [" in shown and "0/2 groups" in shown and "6/6 [" in shown and "2/2 groups" in shown


def test_a_dry_run_tells_what_the_run_then_does(tmp_path, capsys):
    raw, out = tmp_path / "raw", tmp_path / "out"
    capture(raw / "good", 1, count=2, size=SIZE)
    capture(raw / "treated", 2, count=2, size=SIZE, reference=True)
    words = ["prepare", str(raw), str(out)]

    def code(*more):
        with pytest.raises(SystemExit) as ended:
            main([*words, *more])
        return ended.value.code, *capsys.readouterr()

    there = snapshot(tmp_path)
    told = code("--dry-run")
    assert told[0] == 0 and snapshot(tmp_path) == there and not out.exists()
    assert "train: 1 groups to make, 2 frames" in told[1] and "validation: 1 groups to make, 3 frames" in told[1]
    assert "Time: about" in told[1] and "Nothing was written." in told[1]
    assert code()[0] == 0
    shutil.rmtree(capture(raw / "bare", 14, count=3, size=SIZE) / "masks")
    capture(raw / "alone", 5, count=1, size=SIZE)
    there = snapshot(tmp_path)
    for options in ([], ["--propose-masks"]):
        dry = code("--dry-run", *options)
        assert snapshot(tmp_path) == there and dry[0] == 3
        assert "2 groups are as an earlier run left them" in dry[1]
        assert "would be rejected: train/alone" in dry[2]
    assert "Masks would be proposed, for you to look at: train/bare (3)" in dry[1]
    assert code("--propose-masks")[0] == 3
    shutil.rmtree(raw / "good")
    shutil.rmtree(raw / "treated")
    assert code("--dry-run")[0] == 1 == code()[0]
