"""The commands and code of README.md and docs/: what they tell a newcomer to type must work as it is typed.

Every line of every bash block is run on tiny stand-ins, or, if `ONLY_PARSED` gives a reason, read by the parser that
would read it. Every Python block is run.
"""

import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest
import torch
import yaml
from helpers.booster_tree import write_root
from helpers.demo_folder import write_demo
from helpers.orderings import write_layered, write_md3k
from helpers.tiny import SIZE, write_raw_tree

from gift_peft.captures.foreign import read_layout
from gift_peft.captures.group_facts import GROUP_KEYS
from gift_peft.cli import VERBS, main
from gift_peft.training.arguments import parse_arguments

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
HUB_BASE = "depth-anything/Depth-Anything-V2-Small-hf"
QUICK = ["--num-train-epochs=1", "--size=56x70"]  # added to what trains

ONLY_PARSED = {  # the start of a command: why it is not run here
    "gift-peft demo": "takes minutes; .ci/run runs it",
    "accelerate launch": "needs a large model or several GPUs; tests/training/test_resume.py runs both launchers",
    "torchrun": "needs several GPUs; tests/training/test_resume.py runs both launchers",
    "ACCELERATE_USE_CPU=true torchrun": "starts processes; tests/training/test_resume.py runs both launchers",
    "gift-peft train --config examples/": "needs a large model",
    "gift-peft capture": "needs a camera; tests/prepare/test_capture_verb.py has clips",
    "gift-peft train --config run.yaml": "the file is the reader's",
    "gift-peft prepare RAW gift-i --layout": "needs files in that layout; tests/captures/test_foreign.py has them",
    "gift-peft predict rgb": "needs files of a sensor; tests/deploy/test_predict_metric.py has them",
    "gift-peft predict --video": "needs a clip; tests/deploy/test_predict_metric.py has one",
    "gift-peft evaluate --sensor-depth": "needs files of a sensor; tests/deploy/test_sensor_evaluation.py has them",
    "gift-peft deploy demo/adapter onnx": "exports a minute; tests/deploy/test_onnx_export.py has all forms",
    "gift-peft deploy demo/adapter openvino": "exports a minute; tests/deploy/test_onnx_export.py has all forms",
    "gift-peft deploy demo/adapter int8": "exports a minute; tests/deploy/test_onnx_export.py has all forms",
    "gift-peft deploy demo/adapter dialed": "exports a minute; tests/deploy/test_onnx_export.py has all forms",
    "gift-peft deploy demo/adapter space": "exports a minute; tests/deploy/test_space.py runs the page",
    "gift-peft predict photos --deployed": "needs an export; tests/deploy/test_runtime.py has small ones",
    "gift-peft evaluate --booster booster --predictions": "tests/evaluation/test_stored_predictions.py has the files",
}
IN_CI = [
    "pip install -c constraints.txt -e . && gift-peft demo",
    'pip install -c constraints.txt -e ".[test]" && pytest',
]

NEEDED = {  # a folder that pages name: the command of the README that makes it
    "out": f"gift-peft train --base {HUB_BASE} --dataset gift-i --out out",
    "out/config.yaml": f"gift-peft train --base {HUB_BASE} --dataset gift-i --out out",
    "gift-i": "gift-peft prepare my-captures gift-i",
}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def commands(page: Path) -> list[str]:
    return [line for block in blocks(page, "bash") for line in block.splitlines() if line.strip()]


def only_parsed(command: str) -> bool:
    return any(command.startswith(start) for start in ONLY_PARSED)


@pytest.fixture
def workspace(tmp_path, monkeypatch):
    """A folder as after `gift-peft demo`, with photos and captures of one's own, and the benchmarks."""
    with pytest.warns(UserWarning, match="the base is the local folder"):
        write_demo(tmp_path / "demo")
    write_raw_tree(tmp_path / "my-captures")
    (tmp_path / "my-captures" / "train" / "scene_0").rename(tmp_path / "photos")
    for mask in (tmp_path / "photos" / "masks").iterdir():
        mask.unlink()
    (tmp_path / "photos" / "masks").rmdir()
    (tmp_path / "photo.jpg").write_bytes((tmp_path / "photos" / "0.png").read_bytes())
    write_root(tmp_path / "booster", scenes=1)
    write_layered(tmp_path / "layered-depth")
    write_md3k(tmp_path / "md3k")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_readme_opens_with_the_two_commands_that_ci_runs():
    assert commands(PAGES[0])[:2] == IN_CI
    script = (ROOT / ".ci" / "run").read_text()
    assert "pip install -q -c constraints.txt -e . &&" in script and "gift-peft demo" in script
    assert 'pip install -q -c constraints.txt -e ".[test]" && pytest' in script


def test_no_reason_is_left_over():
    everything = [command for page in PAGES for command in commands(page)]
    assert [start for start in ONLY_PARSED if not any(command.startswith(start) for command in everything)] == []


@pytest.mark.filterwarnings("ignore:the base is the local folder", "ignore:.*booster:UserWarning")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_run(page, workspace):
    """In the order of the page; what the README shows before it may be taken as done."""
    todo = [command for command in commands(page) if command not in IN_CI and not only_parsed(command)]
    for folder, command in NEEDED.items():
        if any(folder in shlex.split(later) for later in todo) and command not in todo:
            todo.insert(0, command)
    for command in dict.fromkeys(todo):
        run(command)
    for left in re.findall(r"--out (\S+)$", "\n".join(todo), flags=re.M):
        assert any(Path(left).iterdir()), left


def run(command: str) -> None:
    program, verb, *argv = shlex.split(command)
    assert program == "gift-peft", command
    argv = ["demo/base" if word == HUB_BASE else word for word in argv]
    more = {"train": QUICK, "proxies": QUICK[1:]}.get(verb, []) if "--help" not in argv else []
    with pytest.raises(SystemExit) as end:
        main([verb, *argv, *more])
    assert not end.value.code, command


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_other_commands_are_parsed(page, tmp_path, monkeypatch):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "run.yaml").write_text(f"model_name_or_path: {HUB_BASE}\ndataset_name: gift-i\noutput_dir: out\n")
    monkeypatch.chdir(tmp_path)
    for command in filter(only_parsed, commands(page)):
        words = [word for word in shlex.split(command) if not word.startswith("ACCELERATE_USE_CPU=")]
        if words[0] != "gift-peft":
            words = ["gift-peft", "train", *launched(words)]
        _, verb, *argv = words
        if verb == "train":
            assert parse_arguments(argv).output_dir
        else:
            import_module(f"gift_peft.{VERBS[verb][0]}").make_parser().parse_args(argv)


def launched(words: list[str]) -> list[str]:
    """The arguments that a launcher hands to the training, read by the launcher's own parser."""
    if words[0] == "accelerate":
        from accelerate.commands.launch import launch_command_parser

        assert words[1] == "launch"
        args = launch_command_parser().parse_args(words[2:])
    else:
        from torch.distributed.run import get_args_parser

        args = get_args_parser().parse_args(words[1:])
    assert args.training_script == ("gift_peft.training" if args.module else "examples/train_gift.py")
    return args.training_script_args


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.stem)
def test_python_blocks(page, workspace):
    names = {"pixel_values": torch.zeros(1, 3, *SIZE)}
    for block in blocks(page, "python"):
        exec(block, names)
    if page.stem != "architecture":
        assert names["depth"].shape in ((1, *SIZE), (60, 80))


def test_yaml_blocks(tmp_path):
    for page in PAGES:
        for block in blocks(page, "yaml"):
            values = yaml.safe_load(block)
            if {"images", "lists"} & set(values):
                (tmp_path / "layout.yaml").write_text(block)
                read_layout(tmp_path / "layout.yaml")
            else:
                assert set(values) <= GROUP_KEYS, page


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_files_and_pictures_it_points_to_exist(page):
    text = page.read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\(([^)#:\s]*)(#[^)\s]+)?\)", text):
        file = page.parent / target if target else page
        if target.startswith("../../actions/"):
            continue  # the badge: an address beside the repository's files
        assert file.exists(), target
        if anchor:
            heads = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), flags=re.M)
            assert anchor[1:] in [re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads], anchor
