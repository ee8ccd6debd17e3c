"""`gift-peft train --dry-run`: the plan, what is missing, every mistake at once, and nothing on disk."""

import re

import pytest
from helpers.runs import arguments
from helpers.tiny import write_group, write_raw_tree

from gift_peft import cli
from gift_peft.demo import run as demo
from gift_peft.training import train
from gift_peft.training.arguments import GiftTrainingArguments
from gift_peft.training.dry_run import advice

pytestmark = pytest.mark.usefixtures("fresh_cache")


@pytest.fixture
def dry(capsys):
    """(exit code, what was printed) of a dry run with these options."""

    def dry(base, tree, out, *options):
        words = [f"--base={base}", f"--dataset={tree}", f"--out={out}", "--size=56x70", *options]
        with pytest.raises(SystemExit) as left:
            cli.main(["train", "--dry-run", *words])
        return left.value.code, capsys.readouterr().out

    return dry


def files(root):
    return {path: path.stat().st_mtime_ns for path in root.rglob("*")}


@pytest.mark.parametrize("options", [[], ["--target=surface", "--fills=1", "--per-device-train-batch-size=2"]])
def test_a_plan_writes_nothing_and_counts_as_the_run_does(base_dir, tmp_path, dry, capsys, options):
    tree = write_raw_tree(tmp_path / "raw", train=(2, 3), validation=(2,))
    before = files(tmp_path)
    code, told = dry(base_dir, tree, tmp_path / "out", "--num_train_epochs=3", *options)
    assert code == 0 and files(tmp_path) == before
    assert "train: 2 groups, 5 images, 2 to 3 a group" in told and "validation: 1 groups, 2 images" in told
    assert "Missing predictions of the teacher: 7 of 7 images" in told and "A run would start" in told
    assert re.search(r"Time on this machine as busy as it is now: .*updates .*validations", told)
    planned = int(re.search(r"(\d+) updates over 3 epochs", told)[1])
    pairs = (word[2:].replace("-", "_").split("=") for word in options)
    numbers = {name: int(value) if value.isdigit() else value for name, value in pairs}
    result = train(arguments(base_dir, tree, tmp_path / "out", max_steps=-1, num_train_epochs=3, **numbers))
    assert result.step == planned
    proxies = (tree / "proxies").rglob("*.safetensors")
    assert list(proxies)
    _, told = dry(base_dir, tree, tmp_path / "other", "--num_train_epochs=3", *options)
    assert "Missing predictions of the teacher: 0 of 7 images" in told


def test_every_mistake_is_told_at_once(base_dir, tmp_path, dry):
    tree = write_raw_tree(tmp_path / "raw", train=(2,), validation=())
    write_group(tree / "train/alone", 1, 9)
    (tmp_path / "run").mkdir()
    (tmp_path / "run/metrics.jsonl").write_text('{"step": 0, "epoch": 0, "loss": 1, "train_gce": 1}\n')
    code, told = dry(tmp_path / "nowhere", tree, tmp_path / "run")
    wrong = [line for line in told.splitlines() if line.startswith("A run would fail: ")]
    assert code == 1 and len(wrong) == 3 and "Nothing was written." in told
    for words in ("already holds a run", "nowhere", "alone"):
        assert sum(words in line for line in wrong) == 1
    code, told = dry(base_dir, tmp_path / "none", tmp_path / "out")
    assert code == 1 and str(tmp_path / "none") in told and not (tmp_path / "out").exists()


def test_a_size_that_does_not_fit_fails_before_anything_is_measured(base_dir, tmp_path, dry):
    tree = write_raw_tree(tmp_path / "raw", validation=())
    code, told = dry(base_dir, tree, tmp_path / "out", "--size=55x70")
    assert code == 1 and "multiples of the patch size 14" in told and "Measuring" not in told


def test_advice_is_for_few_groups_and_few_updates():
    args = GiftTrainingArguments("b", "d", "o")
    few = " ".join(advice(args, 12, 600, validated=False))
    assert "--learning-rate 2e-4" in few and "--num-train-epochs 334" in few and "--head lora" in few
    assert "nothing will be measured" in few
    assert advice(args, 353, 17650, validated=True) == []
    fast = GiftTrainingArguments("b", "d", "o", learning_rate=2e-4, head="lora")
    assert advice(fast, 12, 600, validated=True) == []


def test_the_demo_has_no_dry_run(tmp_path):
    with pytest.raises(ValueError, match="dry_run: only `gift-peft train` has it"):
        demo.run_demo(tmp_path / "demo", extra=["--dry_run"])
    assert not (tmp_path / "demo").exists()
