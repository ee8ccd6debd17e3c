"""The README's commands and code, run on tiny stand-ins: what it tells a newcomer to type must work as it is typed."""

import re
import shlex
from pathlib import Path

import pytest
import torch
from helpers.tiny import SIZE, tiny_model, tiny_processor, write_base, write_raw_tree

from gift_peft import get_gift_model, save_adapter
from gift_peft.cli import main
from gift_peft.training.arguments import parse_arguments

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README, flags=re.S)
COMMANDS = [line for language, block in BLOCKS if language == "bash" for line in block.strip().splitlines()]
HUB_BASE = "depth-anything/Depth-Anything-V2-Small-hf"


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A folder as after `gift-peft demo`, with photos and captures of one's own."""
    write_base(tmp_path / "demo" / "base")
    model = get_gift_model(tiny_model())
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if "lora_B" in name:
                weight.fill_(0.01)
    save_adapter(model, tmp_path / "demo" / "adapter", "demo/base", processor=tiny_processor(), size=SIZE)
    write_raw_tree(tmp_path / "my-captures")
    (tmp_path / "my-captures" / "train" / "scene_0").rename(tmp_path / "photos")
    for mask in (tmp_path / "photos" / "masks").iterdir():
        mask.unlink()
    (tmp_path / "photos" / "masks").rmdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(command: str, *more: str) -> None:
    program, *argv = shlex.split(command)
    assert program == "gift-peft"
    argv = ["demo/base" if word == HUB_BASE else word for word in argv]
    with pytest.raises(SystemExit) as end:
        main([*argv, *more])
    assert not end.value.code


def test_it_opens_with_the_two_commands_that_ci_runs():
    assert COMMANDS[:2] == [
        "pip install -c constraints.txt -e . && gift-peft demo",
        'pip install -c constraints.txt -e ".[test]" && pytest',
    ]
    script = (ROOT / ".ci" / "run").read_text()
    assert "pip install -q -c constraints.txt -e . &&" in script and "gift-peft demo" in script
    assert 'pip install -q -c constraints.txt -e ".[test]" && pytest' in script


def test_every_other_command_is_run_here():
    verbs = [shlex.split(command)[:2] for command in COMMANDS[2:]]
    assert verbs == [
        ["gift-peft", "predict"],
        ["gift-peft", "train"],
        ["gift-peft", "evaluate"],
        ["gift-peft", "prepare"],
        ["gift-peft", "export"],
        ["accelerate", "launch"],
        ["gift-peft", "report"],
    ]


def test_python_blocks(workplace):
    names = {"pixel_values": torch.zeros(1, 3, *SIZE)}
    for language, block in BLOCKS:
        if language == "python":
            exec(block, names)
    assert names["depth"].shape == (1, *SIZE)


@pytest.mark.filterwarnings("ignore:the base is the local folder")
def test_commands(workplace):
    predict, train, evaluate, prepare, export, launch, report = COMMANDS[2:]
    run(predict)
    assert len(list(Path("depth").glob("*.npy"))) == 4  # two photos, adapter and base
    run(train, "--num_train_epochs=1", "--size=56x70")
    assert Path("out/adapter/adapter_model.safetensors").exists()
    run(evaluate)
    run(prepare)
    assert Path("gift-i/report.html").exists()
    run(export)
    assert list(Path("release").rglob("*.parquet"))
    run(report.replace("report demo", "report out"))
    assert Path("out/report/model_card.md").exists()
    config = shlex.split(launch)[shlex.split(launch).index("--config") + 1]
    assert parse_arguments(["--config", str(ROOT / config)]).num_train_epochs == 50


def test_files_and_pictures_it_points_to_exist():
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).exists(), target
