"""What stands between a start and the first update: each picture is decoded once, and by a restart none."""

import json
import os
import shutil
from collections import Counter

import pytest
from helpers.runs import arguments, assert_same_run, run_in_processes, train_again
from helpers.tiny import write_raw_tree

from gift_peft.dataset import digests
from gift_peft.dataset import rows as rows_module
from gift_peft.training import GiftTrainingArguments, loop, train


@pytest.fixture
def decoded(monkeypatch):
    """How often each picture was decoded; files count as settled at once."""
    counts, real = Counter(), rows_module.open_image

    def note(source, name):
        counts[name] += 1
        return real(source, name)

    monkeypatch.setattr(rows_module, "open_image", note)
    monkeypatch.setattr(digests, "SETTLED", 0)
    return counts


@pytest.mark.parametrize("target", ["consensus", "surface"])
def test_a_restart_decodes_nothing(base_dir, tmp_path, decoded, target):
    raw = write_raw_tree(tmp_path / "raw")
    options = {"target": "surface", "fills": 1} if target == "surface" else {}
    args = arguments(base_dir, raw, tmp_path / "whole", group_cache_dir=str(tmp_path / "groups"), **options)
    train(args)
    # Once for the proxies, once at network size.
    assert decoded.keys() == set(map(str, raw.rglob("*.png"))) and set(decoded.values()) == {2}
    shutil.copytree(tmp_path / "whole", tmp_path / "out")
    for name in ("adapter", "adapter-last"):
        shutil.rmtree(tmp_path / "out" / name)
    steps = sorted(int(path.name.partition("-")[2]) for path in (tmp_path / "out").glob("checkpoint-*"))
    shutil.rmtree(tmp_path / "out" / f"checkpoint-{steps[-1]}")
    decoded.clear()
    train_again(GiftTrainingArguments(**{**vars(args), "output_dir": str(tmp_path / "out")}))
    assert not decoded
    assert_same_run(tmp_path / "out", tmp_path / "whole")


def test_a_changed_picture_is_noticed_by_a_restart(base_dir, tmp_path, decoded):
    raw = write_raw_tree(tmp_path / "raw")
    args = arguments(base_dir, raw, tmp_path / "out")
    train(args)
    shutil.copy(raw / "train/scene_1/0.png", raw / "train/scene_0/0.png")
    with pytest.raises(ValueError, match=r"stale proxy .*scene_0\.safetensors: image 0\.png has changed"):
        train_again(args)


def test_processes_share_the_pictures(base_dir, tmp_path, monkeypatch, decoded):
    """Before the loop is entered each has decoded its share of the groups once."""
    raw = write_raw_tree(tmp_path / "raw", train=(2, 3, 2, 3), validation=(2, 2))

    class Entered(Exception):
        pass

    def stop(*args):
        raise Entered

    def start(rank):
        monkeypatch.setattr(loop, "adapt", stop)
        try:
            train(arguments(base_dir, raw, tmp_path / "out"))
        except Entered:
            (tmp_path / f"{rank}.json").write_text(json.dumps(decoded))
            os._exit(0)
        os._exit(1)

    assert run_in_processes(start) == [0, 0]
    seen = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2)]
    pictures = list(raw.rglob("*.png"))
    assert Counter(seen[0]) + Counter(seen[1]) == Counter({str(path): 1 for path in pictures})
    assert all(seen)
