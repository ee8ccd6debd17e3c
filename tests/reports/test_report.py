"""`gift-peft report` on real short runs: what it reads, what it writes, what it says is missing."""

import csv
import io
import json
import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest
import yaml
from helpers.booster_tree import write_root
from helpers.reports import random_rows, report_of
from helpers.runs import arguments
from helpers.tiny import write_raw_tree
from huggingface_hub import ModelCard
from PIL import Image

from gift_peft import cli
from gift_peft.evaluation.results import Report
from gift_peft.evaluation.verb import run_evaluation
from gift_peft.reports.ablation import ablation_table, is_ablation
from gift_peft.reports.chosen import notable_observations
from gift_peft.reports.report import run_report
from gift_peft.reports.saved_run import SavedRun, read_run, run_names
from gift_peft.reports.zero_shot import checkpoint_folders
from gift_peft.training import train

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning")
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return write_raw_tree(tmp_path_factory.mktemp("tree") / "raw", validation=(2, 3))


@pytest.fixture(scope="module")
def trained(base_dir, tree, tmp_path_factory):
    """A run of two epochs, not evaluated yet."""
    out = tmp_path_factory.mktemp("run") / "out"
    train(arguments(base_dir, tree, out, checkpoint_at_steps=["1,4"], license="mit"))
    return out


@pytest.fixture(scope="module")
def evaluated(trained, base_dir, tree):
    """The same run with an evaluation."""
    copy = Path(shutil.copytree(trained, trained.parent / "evaluated"))
    run_evaluation(base_dir, tree, copy / "adapter", out=copy / "evaluation", progress=False)
    return copy


@pytest.fixture
def run_folder(evaluated, tmp_path):
    return Path(shutil.copytree(evaluated, tmp_path / "my-run"))


def test_one_command_from_a_run_to_everything(run_folder, tree, capsys):
    shutil.rmtree(run_folder / "evaluation")
    image = tree / "train" / "scene_0" / "0.png"
    with pytest.raises(SystemExit) as exit:
        cli.main(["report", str(run_folder), "--model-card", "--zero-shot", str(image), "--steps", "1", "4"])
    assert exit.value.code == 0
    said, folder = capsys.readouterr().out, run_folder / "report"
    assert "not in it" not in said and f"Report: {folder}/report.md" in said
    assert (run_folder / "evaluation" / "rows.jsonl").exists()  # it was missing, so it was made
    names = ["before-after", "errors", "dynamics", "retention", "zero-shot-my-run"]
    for name in names:
        with Image.open(folder / f"{name}.png") as picture:
            assert min(picture.size) > 200
        assert (folder / f"{name}.pdf").read_bytes().startswith(b"%PDF-")
    text = (folder / "report.md").read_text()
    linked = re.findall(r"\]\(([^)]+)\)", text)
    assert {f"{name}.png" for name in names} | {"compare.html", "model_card.md"} == set(linked)
    assert all((folder / link).exists() for link in linked)
    report = Report.load(run_folder / "evaluation")
    rows = list(csv.DictReader(io.StringIO((folder / "tables" / "gift-i-proxy.csv").read_text())))
    assert float(rows[0]["ToM RMSE"]) == report.base["tom"]["rmse"]
    assert float(rows[1]["All delta1 %"]) == report.summary["all"]["delta1"]
    for name in ("gift-i-proxy", "gift-i-proxy-intervals", "gift-i-proxy-groups"):
        for suffix in ("txt", "md", "tex", "csv"):
            assert (folder / "tables" / f"{name}.{suffix}").stat().st_size > 50
        for suffix in ("txt", "md"):
            note = " ".join((folder / "tables" / f"{name}.{suffix}").read_text().split())
            assert "Protocol native" in note and "Skipped: 0 of 5 images" in note
    page = (folder / "compare.html").read_text()
    assert page.count("<article>") >= 2 and not re.search(r"(src|href)=\"(?!data:)", page)
    assert not list(folder.rglob(".*"))


def test_the_card_of_a_run_has_its_evaluation(run_folder, base_dir, tree):
    run_report([run_folder], card=True, panels=0)
    card = ModelCard.load(run_folder / "report" / "model_card.md")
    report = Report.load(run_folder / "evaluation")
    measured = {result.metric_type: result.metric_value for result in card.data.eval_results}
    assert measured["gce"] == pytest.approx(report.gce["adapted"], abs=1e-6)
    assert measured["other_rmse"] == pytest.approx(report.summary["other"]["rmse"], abs=1e-6)
    assert (card.data.library_name, card.data.license, card.data.base_model) == ("peft", "mit", None)
    for heading in ("Use", "Results", "Retention", "Recipe", "Data", "What was run", "Limits"):
        assert f"\n## {heading}\n" in card.text
    assert "95 % bootstrap intervals" in card.text and str(tree) not in card.content
    assert str(base_dir) not in card.content and str(run_folder) not in card.content
    assert not list((run_folder / "report").glob("*.html"))  # panels=0: no pictures


def test_an_evaluation_of_another_adapter_is_not_on_the_card(run_folder, base_dir, tree):
    run_evaluation(base_dir, tree, run_folder / "adapter", out=run_folder / "half", adapter_scale=0.5, progress=False)
    run_evaluation(base_dir, tree, run_folder / "checkpoint-1", out=run_folder / "early", progress=False)
    run_report([run_folder], card=run_folder / "card.md", panels=0)
    results = ModelCard.load(run_folder / "card.md").data.eval_results
    assert [result.metric_type for result in results].count("gce") == 1
    whole = Report.load(run_folder / "evaluation")
    assert results[0].metric_value == pytest.approx(whole.gce["adapted"], abs=1e-6)
    assert "(adapter scale 0.5) + GIFT" in (run_folder / "report" / "report.md").read_text()


def test_what_cannot_be_drawn_is_said_and_the_rest_is_there(run_folder, tmp_path, capsys):
    about = json.loads((run_folder / "evaluation" / "metrics.json").read_text())
    about["about"]["base"] = str(tmp_path / "gone")
    (run_folder / "evaluation" / "metrics.json").write_text(json.dumps(about))
    capsys.readouterr()
    run_report([run_folder])
    text = (run_folder / "report" / "report.md").read_text()
    assert f"Not in this report: pictures of {run_folder}: base model {tmp_path / 'gone'}" in text
    assert "not in it: pictures of" in capsys.readouterr().out and "dynamics.png" in text


def test_without_matplotlib_the_curves_say_what_to_install(run_folder, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    run_report([run_folder])
    folder, said = run_folder / "report", capsys.readouterr().out
    assert (folder / "before-after.png").exists() and (folder / "compare.html").exists()
    assert {path.name for path in folder.glob("*.pdf")} == {"before-after.pdf", "errors.pdf"}
    assert not (folder / "dynamics.png").exists()
    assert said.count("pip install gift-peft[plots]") == 2  # two figures of curves


def test_metrics_alone_still_give_curves(run_folder):
    shutil.rmtree(run_folder / "adapter")
    shutil.rmtree(run_folder / "evaluation")
    run_report([run_folder])
    assert (run_folder / "report" / "dynamics.png").exists()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda run: (run / "metrics.jsonl").write_text('{"step": 0\n'), r"metrics\.jsonl: not valid JSON"),
        (lambda run: (run / "metrics.jsonl").write_text("[]\n"), r"metrics\.jsonl: every line needs step and epoch"),
        (lambda run: (run / "config.yaml").write_text("a: [\n"), r"config\.yaml: not valid YAML"),
        (lambda run: (run / "adapter" / "gift.json").write_text("{"), r"gift\.json: not valid JSON"),
        (lambda run: shutil.rmtree(run), r"my-run: neither a run \(config\.yaml"),
    ],
)
def test_damaged_runs_are_named(run_folder, spoil, message):
    spoil(run_folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        run_report([run_folder])
    assert not (run_folder / "report").exists()


def test_runs_of_one_name_do_not_overwrite_each_other(run_folder, tmp_path):
    other = Path(shutil.copytree(run_folder, tmp_path / "elsewhere" / "my-run"))
    folder = run_report([run_folder, other], tmp_path / "both", panels=1)
    names = {path.name for path in folder.iterdir()}
    assert {"before-after-my-run.png", "before-after-my-run-2.png", "compare-my-run-2.html"} <= names
    tables = {path.name for path in (folder / "tables").iterdir()}
    assert {"gift-i-proxy.csv", "gift-i-proxy-my-run-groups.csv", "gift-i-proxy-my-run-2-groups.csv"} <= tables
    with pytest.raises(ValueError, match="panels: must not be negative, got -1"):
        run_report([run_folder], panels=-1)


def test_a_card_of_several_runs_and_a_report_of_a_plan_are_refused(run_folder, tmp_path):
    with pytest.raises(ValueError, match="--model-card is of one run"):
        run_report([run_folder, run_folder], card=True)
    with pytest.raises(ValueError, match=r"evaluation: no config\.yaml, so nothing says what was trained"):
        run_report([run_folder / "evaluation"], card=True)
    plan = ROOT / "examples" / "vggt_1b.yaml"
    with pytest.raises(ValueError, match=r"vggt_1b\.yaml: not a run yet; --model-card FILE"):
        run_report([plan])


def test_checkpoints_for_the_zero_shot_panel(run_folder):
    run = read_run(run_folder)
    assert list(checkpoint_folders(run, [4])) == [4]
    assert list(checkpoint_folders(run)) == [1, 4]  # those it was told to keep
    run.arguments["checkpoint_at_steps"] = [4, 20000]  # training ended before
    assert list(checkpoint_folders(run)) == [4]
    with pytest.raises(FileNotFoundError, match=r"no such image: nowhere\.jpg"):
        run_report([run_folder], zero_shot=["nowhere.jpg"])
    assert not (run_folder / "report").exists()
    with pytest.raises(FileNotFoundError, match=r"no checkpoint of step 7 \(there are: 1, 2, 3, 4\)"):
        checkpoint_folders(run, [7])


# ---- which pictures ----


def test_notable_observations_are_extremes_of_different_groups():
    report = report_of(random_rows([3] * 6, seed=2))
    chosen = notable_observations(report, 6)
    assert len(chosen) == 6 and len({group for group, _ in chosen}) == 6
    errors = {(r["group_id"], r["image"]): [r[m]["tom"]["rmse"] for m in ("base", "adapted")] for r in report.rows}
    first, second, third, *_ = chosen
    assert chosen[first] == "largest error of the base" and errors[first][0] == max(e[0] for e in errors.values())
    left = {key: value for key, value in errors.items() if key[0] != first[0]}
    assert chosen[second] == "largest improvement" and second == min(left, key=lambda k: left[k][1] - left[k][0])
    left = {key: value for key, value in left.items() if key[0] != second[0]}
    assert chosen[third] == "largest deterioration" and third == max(left, key=lambda k: left[k][1] - left[k][0])
    assert len(notable_observations(report, 20)) == 6
    report.rows[0]["skipped"] = "without a treated reference"
    assert ("g00", "0.png") not in notable_observations(report, 20)


# ---- loss weights ----


def ablated(weight_d: float, gce, other, booster=None) -> SavedRun:
    rows = [{"step": 0, "epoch": 0, "val_gce": 1.0, "val_tom_rmse": 0.3, "val_other_rmse": 0.1}]
    for epoch, (own, outside) in enumerate(zip(gce, other, strict=True), start=1):
        rows.append(
            {"step": 5 * epoch, "epoch": epoch, "val_gce": own, "val_tom_rmse": own / 2, "val_other_rmse": outside}
        )
        if booster:
            rows[-1] |= {"booster_tom_rmse": booster, "booster_other_rmse": 2 * booster}
    arguments = {"model_name_or_path": "b", "dataset_name": "d", "lambda_c": 1.0, "lambda_d": weight_d}
    return SavedRun(Path(f"run-{weight_d}"), arguments, rows)


def test_weights_are_compared_at_the_smallest_gce_and_collapse_does_not_compete():
    runs = [
        ablated(1.0, [0.5, 0.2, 0.3], [0.1, 0.11, 0.12], 60.0),
        ablated(1.5, [0.5, 0.4, 0.3], [0.1, 0.1, 0.1], 50.0),
        ablated(0.0, [0.1, 0.01, 0.02], [0.1, 0.9, 1.0], 900.0),
    ]
    assert is_ablation(runs)
    table = ablation_table(runs)
    assert [row[:2] for row in table.body()] == [["1:1", "10"], ["1:1.5", "15"], ["1:0†", "10"]]
    assert table.spans == [("GIFT-I validation", 3), ("Booster (mm)", 2)]
    values = [[cell.values[0] for cell in row[2:]] for row in table.body()]
    assert values == [[0.2, 0.1, 0.11, 60, 120], [0.3, 0.15, 0.1, 50, 100], [0.01, 0.005, 0.9, 900, 1800]]
    best = [[cell.good for cell in row[2:]] for row in table.body()]
    assert best == [[True, True, None, None, None], [None, None, True, True, True], [None] * 5]
    assert any("collapsed" in note for note in table.notes) and any("Protocol native" in note for note in table.notes)


def test_the_collapse_alarm_counts_where_an_affine_fit_hides_it():
    runs = [ablated(1.0, [0.5], [0.1]), ablated(0.0, [0.0], [0.11])]
    runs[1].evaluations["evaluation"] = report_of(
        random_rows([2, 3]), collapse={"target_mean_ratio": 1.0, "spread_ratio": 1e-6, "alarm": True}
    )
    table = ablation_table(runs)
    assert [row[0] for row in table.body()] == ["1:1", "1:0†"]
    assert [cell.good for cell in table.body()[0][2:]] == [True] * 3 and table.body()[1][2].good is None
    assert any("Skipped: 0 of 5 images" in note for note in table.notes)


def test_booster_columns_come_from_evaluations_where_training_logged_none():
    runs = [ablated(1.0, [0.5], [0.1]), ablated(2.0, [0.4], [0.1])]
    assert ablation_table(runs).columns == ["GCE ↓", "ToM RMSE ↓", "Other RMSE ↓"]
    report = report_of(random_rows([2, 3]), booster=True)
    runs[1].evaluations["booster"] = report
    table = ablation_table(runs)
    assert [cell.text for cell in table.body()[0][5:]] == ["-", "-"]
    assert table.body()[1][5].values == (report.summary["tom"]["rmse"],)
    assert any("Booster: Skipped: 0 of 5 images" in note for note in table.notes)


def test_runs_that_differ_in_more_are_no_ablation():
    runs = [ablated(1.0, [0.5], [0.1]), ablated(2.0, [0.4], [0.1])]
    assert not is_ablation(runs[:1]) and not is_ablation([runs[0], runs[0]])
    runs[1].arguments["dataset_name"] = "other"
    assert not is_ablation(runs)
    assert run_names([runs[0]]) == ["b"] and run_names(runs) == ["b 1:1", "b 1:2"]
    runs[1].arguments["lambda_d"] = 1.0
    assert run_names(runs) == ["b (run-1.0)", "b (run-2.0)"]
    runs[1].path = Path("elsewhere") / "run-1.0"
    assert run_names(runs) == ["b (run-1.0)", "b (run-1.0-2)"]


def ablate(monkeypatch, *argv) -> int:
    script = ROOT / "examples" / "ablate_weights.py"
    monkeypatch.setattr(sys, "argv", [str(script), *map(str, argv)])
    with pytest.raises(SystemExit) as exit:
        runpy.run_path(str(script), run_name="__main__")
    return exit.value.code


def test_the_ablation_example_trains_evaluates_reports_and_goes_on(base_dir, tree, tmp_path, monkeypatch):
    out = tmp_path / "ablation"
    values = {"model_name_or_path": str(base_dir), "dataset_name": str(tree), "output_dir": str(out), "size": "56x70"}
    config = tmp_path / "one.yaml"
    config.write_text(yaml.safe_dump(values | {"num_train_epochs": 1, "learning_rate": 2e-4}))
    assert ablate(monkeypatch, "--config", config, "--ratios", "1:1", "1:0") == 0
    text = (out / "report" / "tables" / "loss-weights.md").read_text()
    assert "| 1:1 | 2 |" in text and "| 1:0" in text
    for name in ("1-1", "1-0"):
        assert (out / name / "evaluation" / "metrics.json").exists()
    assert yaml.safe_load((out / "1-0" / "config.yaml").read_text())["lambda_d"] == 0
    first = (out / "1-1" / "metrics.jsonl").read_text()
    # The same command again, with one ratio more and another epoch: what is there is the beginning.
    assert ablate(monkeypatch, "--config", config, "--ratios", "1:1", "1:2", "--num_train_epochs=2") == 0
    assert (out / "1-1" / "metrics.jsonl").read_text().startswith(first)
    assert len((out / "1-1" / "metrics.jsonl").read_text().splitlines()) == 3
    assert (out / "report" / "retention.png").exists()
    assert "--lambda_c: the ablation sets it itself" in ablate(monkeypatch, "--config", config, "--lambda_c=2")


def test_booster_has_its_own_tables_and_pictures(run_folder, base_dir, tmp_path, capsys):
    write_root(tmp_path / "booster", scenes=3)
    shutil.rmtree(run_folder / "evaluation")
    options = {"kind": "inverse_depth", "resize": 0.5, "progress": False}
    run_evaluation(
        base_dir, None, run_folder / "adapter", booster=tmp_path / "booster", out=run_folder / "booster", **options
    )
    run_report([run_folder], card=True)
    folder = run_folder / "report"
    assert "not in it" not in capsys.readouterr().out
    for name in (
        "before-after-booster.png",
        "errors-booster.pdf",
        "compare-booster.html",
        "tables/booster-groups.csv",
    ):
        assert (folder / name).stat().st_size > 100
    page = (folder / "compare-booster.html").read_text()
    assert 3 <= page.count("<article>") <= 6 and "measured depth" in page
    # The caption's error is the table's: the same alignment on the same grid.
    rows = (run_folder / "booster" / "rows.jsonl").read_text().splitlines()
    errors = [json.loads(row)["base"]["tom"]["rmse"] for row in rows]
    assert f"RMSE in the outline: {max(errors):,.0f} mm before" in page
    results = ModelCard.load(folder / "model_card.md").data.eval_results
    assert [result.dataset_type for result in results] == 12 * ["booster"]
    shutil.rmtree(tmp_path / "booster")
    run_report([run_folder])
    assert "not in it: pictures of" in capsys.readouterr().out
