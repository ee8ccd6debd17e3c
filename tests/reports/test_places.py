"""Where a report writes and what it leaves alone; where it finds a run's data again."""

import json
import re
import shutil
from pathlib import Path

import pytest
import yaml
from helpers.runs import arguments

from gift_peft.evaluation.verb import run_evaluation
from gift_peft.reports.report import run_report
from gift_peft.reports.saved_run import read_run
from gift_peft.training import train

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning")
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def evaluated(base_dir, tree, tmp_path_factory):
    """A run of one update, evaluated."""
    out = tmp_path_factory.mktemp("run") / "out"
    train(arguments(base_dir, tree, out, max_steps=1))
    run_evaluation(base_dir, tree, out / "adapter", out=out / "evaluation", progress=False)
    return out


@pytest.fixture
def run_folder(evaluated, tmp_path):
    return Path(shutil.copytree(evaluated, tmp_path / "my-run"))


def test_two_evaluations_of_a_run_are_told_apart(run_folder, tmp_path):
    shutil.copytree(run_folder / "evaluation", run_folder / "later")
    run_report([run_folder], tmp_path / "report", panels=0)
    text = (tmp_path / "report/report.md").read_text()
    for place in ("evaluation", "later"):
        assert re.search(rf"^\| .* \({place}\) \+ GIFT \|", text, re.MULTILINE), text


def test_a_report_keeps_what_no_report_wrote(run_folder, tmp_path):
    for name in ("report.md", "tables/mine.csv", "holiday.png", "model_card.md"):
        out = tmp_path / name.replace("/", "-")
        (out / name).parent.mkdir(parents=True)
        (out / name).write_text("mine")
        with pytest.raises(ValueError, match=rf"has {name.partition('/')[0]}, which no report wrote"):
            run_report([run_folder], out, panels=0)
        assert [path.read_text() for path in out.rglob("*") if path.is_file()] == ["mine"]
    out = tmp_path / "reports"
    (out / "sub").mkdir(parents=True)
    (out / "sub/holiday.png").write_text("mine")
    for _ in range(2):
        run_report([run_folder], out, panels=0)
    assert (out / "sub/holiday.png").read_text() == "mine" and "Not finished" not in (out / "report.md").read_text()
    shutil.copy(ROOT / "README.md", out / "zero-shot-my-run.png")
    with pytest.raises(ValueError, match=r"zero-shot-my-run\.png would replace the input"):
        run_report([run_folder], out, panels=0, zero_shot=[out / "zero-shot-my-run.png"])
    plan = tmp_path / "plan.yaml"
    shutil.copy(run_folder / "config.yaml", plan)
    with pytest.raises(ValueError, match="would replace the input"):
        run_report([plan], card=plan)


def test_an_evaluation_keeps_what_no_evaluation_wrote(evaluated, base_dir, tree, tmp_path):
    (tmp_path / "report.md").write_text("mine")
    with pytest.raises(ValueError, match=r"its report\.md is of no evaluation and is kept"):
        run_evaluation(base_dir, tree, evaluated / "adapter", out=tmp_path)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_a_run_that_was_moved_finds_its_data(evaluated, tree, base_dir, tmp_path, monkeypatch):
    """Named from another folder, or by where it was before: what was moved with the run is found beside it."""
    work = tmp_path / "new place"
    run = Path(shutil.copytree(evaluated, work / "runs/my-run"))
    shutil.copytree(tree, work / "runs/raw")
    shutil.copytree(base_dir, work / "models/base")
    names = {"dataset_name": "/gone/before/raw", "model_name_or_path": "models/base"}
    names |= {"dataset": "/gone/before/raw", "base": "models/base", "adapter": "runs/my-run/adapter"}

    def edit(path, change):
        values = yaml.safe_load(path.read_text())
        change(values)
        path.write_text(json.dumps(values))

    edit(
        run / "config.yaml",
        lambda values: values.update({k: names[k] for k in ("dataset_name", "model_name_or_path")}),
    )
    about = {key: names[key] for key in ("dataset", "base", "adapter")}
    edit(run / "evaluation/metrics.json", lambda values: values["about"].update(about))
    monkeypatch.chdir(tmp_path)
    with pytest.warns(UserWarning, match=rf"dataset /gone/before/raw: taken from {work}/runs/raw"):
        saved = read_run(run)
    found = saved.arguments | saved.evaluations["evaluation"].about
    assert {key: found[key] for key in names} == {
        "dataset_name": f"{work}/runs/raw",
        "model_name_or_path": f"{work}/models/base",
        "dataset": f"{work}/runs/raw",
        "base": f"{work}/models/base",
        "adapter": f"{run}/adapter",
    }
    with pytest.warns(UserWarning, match="taken from"):
        folder = run_report([run], panels=1)
    assert (folder / "before-after.png").is_file() and "Not in this report" not in (folder / "report.md").read_text()
