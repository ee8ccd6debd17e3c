"""The verbs from the outside: exit codes, one-line errors, and the files they leave."""

import json
import subprocess
import sys

import datasets
import numpy as np
import pytest
from helpers.booster_tree import write_predictions, write_root
from helpers.tiny import write_raw_tree

import gift_peft
from gift_peft import cli, evaluate_booster
from gift_peft.evaluation.protocols import PROTOCOLS
from gift_peft.evaluation.results import Report

# transformers 5.23 says so when peft 0.21 loads an adapter; neither is ours.
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning")


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return write_raw_tree(tmp_path_factory.mktemp("tree") / "raw")


@pytest.fixture
def run(capsys):
    """Run a verb: (exit code, stdout, stderr)."""

    def run(*argv):
        with pytest.raises(SystemExit) as exit:
            cli.main([str(word) for word in argv])
        return exit.value.code, *capsys.readouterr()

    return run


@pytest.fixture(scope="module")
def trained(base_dir, tree, tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "out"
    with pytest.raises(SystemExit) as exit:
        cli.main(["train", *train_arguments(base_dir, tree, out), "--max_steps=2"])
    assert exit.value.code == 0
    return out


def train_arguments(base, tree, out):
    return [f"--model_name_or_path={base}", f"--dataset_name={tree}", f"--output_dir={out}", "--size=56x70"]


def test_help_lists_the_verbs(run):
    code, out, _ = run("--help")
    assert code == 0 and "example:" in out
    for verb in cli.VERBS:
        assert f"\n    {verb} " in out
    assert "--lambda-c" in run("train", "--help")[1]


# Prints which of the heavy packages are imported when `gift-peft WORDS` has answered.
IMPORTED = """
import contextlib, os, sys
import gift_peft.cli
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(open(os.devnull, "w")):
    gift_peft.cli.main(sys.argv[1:])
print(*sorted({"torch", "transformers", "datasets", "peft", "cv2", "accelerate", "matplotlib"} & {*sys.modules}))
"""


@pytest.mark.parametrize("words", ["--help", "--version", *(f"{verb} --help" for verb in cli.VERBS)])
def test_an_answer_waits_for_no_heavy_import(words):
    done = subprocess.run([sys.executable, "-c", IMPORTED, *words.split()], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_version_names_what_a_report_of_a_mistake_needs(run):
    code, out, _ = run("--version")
    assert code == 0
    versions = dict(line.split() for line in out.splitlines())
    assert [*versions] == ["gift-peft", "python", "torch", "transformers", "peft", "accelerate", "datasets"]
    assert versions["gift-peft"] == gift_peft.__version__ and versions["datasets"] == datasets.__version__


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["nothing"],
        ["proxies", "--base", "b"],
        ["proxies", "--base", "b", "--dataset", "d", "--foo"],
        ["evaluate", "--base", "b", "--dataset", "d", "--reference", "sonar"],
        ["evaluate", "--base", "b"],
        ["evaluate", "--base", "b", "--dataset", "d", "--booster", "r"],
        ["evaluate", "--booster", "r"],
        ["evaluate", "--booster", "r", "--base", "b", "--predictions", "p"],
        ["evaluate", "--dataset", "d", "--predictions", "p"],
        ["evaluate", "--booster", "r", "--base", "b", "--occlusion", "some"],
        ["predict", "--base", "b", "--out", "o"],
    ],
)
def test_wrong_usage_is_2(argv, run):
    code, _, err = run(*argv)
    assert code == 2
    assert "error:" in err


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["trian"], "unknown verb 'trian'; did you mean train?"),
        (["evalute", "--base", "b"], "unknown verb 'evalute'; did you mean evaluate?"),
        (["xyzzy"], "unknown verb 'xyzzy' (gift-peft --help lists them)"),
        (["predict", "a.png", "--bse", "b", "--out", "o"], "unknown option --bse; did you mean --base?"),
        (["evaluate", "--protocl=gift"], "unknown option --protocl; did you mean --protocol?"),
        (["prepare", "r", "o", "--static_rigg"], "unknown option --static_rigg; did you mean --static-rig?"),
    ],
)
def test_a_misspelled_word_gets_the_nearest_one(argv, message, run):
    code, _, err = run(*argv)
    assert code == 2 and message in err.splitlines()[-1]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["train", "--lora_rnk=3"], "unknown argument --lora_rnk; did you mean lora_rank?"),
        (["train", "--config", "nowhere.yaml"], "config nowhere.yaml: no such file"),
        (["train", "--mixed_precision", "fp16", *train_arguments("b", "d", "o")], "mixed_precision: fp16"),
        (["train", *train_arguments("{base}", "{tmp}/none", "{tmp}/o")], "{tmp}/none"),
        (["proxies", "--base", "{base}", "--dataset", "{tmp}/none"], "{tmp}/none"),
        (["proxies", "--base", "{tmp}/none", "--dataset", "{tree}"], "{tmp}/none"),
        (["evaluate", "--base", "{base}", "--dataset", "{tmp}/none"], "{tmp}/none"),
        (
            ["evaluate", "--base", "{tmp}/none", "--booster", "{tmp}/nowhere"],
            "Booster root {tmp}/nowhere: no such folder",
        ),
        (["predict", "{tmp}/none.png", "--base", "{base}", "--out", "{tmp}/o"], "{tmp}/none.png"),
    ],
)
def test_our_errors_are_one_line_and_1(argv, message, run, base_dir, tree, tmp_path):
    names = {"base": base_dir, "tmp": tmp_path, "tree": tree}
    code, _, err = run(*(word.format(**names) for word in argv))
    errors = [line for line in err.splitlines() if line.startswith("gift-peft: error: ")]
    assert code == 1
    assert len(errors) == 1
    assert errors[0] == err.splitlines()[-1]
    assert message.format(**names) in errors[0]
    assert "Traceback" not in err


@pytest.mark.parametrize("way", ["option", "environment"])
def test_debug_shows_the_traceback(way, monkeypatch):
    if way == "environment":
        monkeypatch.setenv("GIFT_PEFT_DEBUG", "1")
    with pytest.raises(FileNotFoundError):
        cli.main(["train", "--config", "nowhere.yaml", *(["--debug"] if way == "option" else [])])


def test_ctrl_c_before_training_is_130(run, monkeypatch):
    def interrupt(argv):
        raise KeyboardInterrupt

    monkeypatch.setattr("gift_peft.training.__main__.parse_arguments", interrupt)
    assert run("train")[0] == 130


def test_train_then_a_second_run_is_refused(trained, base_dir, tree, run):
    assert (trained / "adapter/adapter_model.safetensors").exists()
    code, _, err = run("train", *train_arguments(base_dir, tree, trained))
    assert code == 1
    assert "already holds a run" in err.splitlines()[-1]


def test_proxies(base_dir, tree, tmp_path, run):
    code, out, _ = run(
        "proxies", "--base", base_dir, "--dataset", tree, "--size", "56x70", "--proxies_dir", tmp_path / "proxies"
    )
    assert code == 0
    assert str(tmp_path / "proxies" / base_dir.name) in out
    assert len(list((tmp_path / "proxies").rglob("*.safetensors"))) == 3


def test_evaluate(trained, base_dir, tree, tmp_path, run):
    code, out, _ = run(
        "evaluate", "--base", base_dir, "--adapter", trained / "adapter", "--dataset", tree, "--out", tmp_path / "e"
    )
    assert code == 0
    assert "ToM" in out
    metrics = json.loads((tmp_path / "e/metrics.json").read_text())
    rows = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    best = min(rows[1:], key=lambda row: row["val_gce"])
    assert metrics["gce"]["adapted"] == pytest.approx(best["val_gce"], rel=1e-5)
    assert metrics["gce"]["base"] == pytest.approx(rows[0]["val_gce"], rel=1e-5)


def test_evaluate_on_booster(trained, base_dir, tmp_path, run):
    truths = write_root(tmp_path)
    write_predictions(tmp_path / "pred", truths)
    out = ["--out", tmp_path / "e"]
    adapter = ["--base", base_dir, "--adapter", trained / "adapter"]
    code, printed, _ = run("evaluate", "--booster", tmp_path, *adapter, "--resize", 1, "--occlusion", "noc", *out)
    assert code == 0 and "Booster balanced: 2 scenes, 4 images (mm)" in printed and "resolution x1" in printed
    report = Report.load(tmp_path / "e")
    assert report.adapted and report.about["occlusion"] == "noc" and report.about["adapter"].endswith("adapter")
    assert (tmp_path / "e" / "report.md").is_file()
    stored = ["--predictions", tmp_path / "pred", "--protocol", "depth4tom"]
    code, printed, _ = run("evaluate", "--booster", tmp_path, *stored, *out)
    assert code == 0 and "Protocol depth4tom" in printed
    assert Report.load(tmp_path / "e").summary == evaluate_booster(
        tmp_path, predictions=tmp_path / "pred", protocol="depth4tom", progress=False
    ).summary  # fmt: skip
    (tmp_path / "pred" / "Scene1" / "camera_00" / "im1.npy").unlink()
    code, _, err = run("evaluate", "--booster", tmp_path, *stored, *out)
    assert code == 1 and "1 missing" in err and "Scene1/camera_00/im1" in err


def test_evaluate_lists_its_protocols(run):
    code, out, _ = run("evaluate", "--protocol", "gift", "--list-protocols")
    assert code == 0
    assert all(f"\n{name}: " in f"\n{out}" for name in PROTOCOLS)
    code, _, err = run("evaluate", "--booster", "r", "--predictions", "p", "--protocol", "nobody's")
    assert code == 1 and "choose one of gift, native, gift-literal, depth4tom" in err


def test_predict_and_the_adapter_scale(trained, base_dir, tree, tmp_path, run):
    picture = tree / "validation/scene_100/0.png"
    for scale in ("0", "1"):
        adapter = ["--adapter", trained / "adapter", "--adapter-scale", scale]
        code, _, _ = run("predict", picture, "--base", base_dir, *adapter, "--out", tmp_path / scale)
        assert code == 0
        assert (tmp_path / scale / "0.png").exists()
    base, faded, full = (np.load(tmp_path / name) for name in ("0/0_base.npy", "0/0.npy", "1/0.npy"))
    assert full.dtype == np.float32
    assert full.shape == (60, 80)
    assert np.array_equal(base, faded)
    assert not np.array_equal(base, full)


def test_demo_passes_training_arguments_on(monkeypatch, run):
    seen = {}
    monkeypatch.setattr("gift_peft.demo.run.run_demo", lambda **given: seen.update(given))
    assert run("demo", "--out", "there", "--seed", "2", "--lambda_d=0")[0] == 0
    assert seen == {"out": "there", "overwrite_output_dir": False, "seed": 2, "target": None, "extra": ["--lambda-d=0"]}


@pytest.mark.parametrize("script", ["examples/train_gift.py", "-m gift_peft.training", "-m gift_peft"])
def test_other_ways_in_take_the_same_arguments(script, request):
    verb = ["train"] if script.endswith("gift_peft") else []
    done = subprocess.run(
        [sys.executable, *script.split(), *verb, "--lora_rnk=1"],
        capture_output=True,
        text=True,
        cwd=request.config.rootpath,
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == "gift-peft: error: unknown argument --lora_rnk; did you mean lora_rank?"
