"""The options of `gift-peft prepare`: every field of the settings, with its text and its default in the help."""

import ast
import inspect
import re
import shlex
import shutil
from dataclasses import fields
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from helpers.tiny import write_group

import gift_peft.prepare
from gift_peft.cli import main
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.prepare_verb import PARTS
from gift_peft.prepare.prepare_verb import parse_arguments as parse
from gift_peft.prepare.settings import PrepareSettings
from gift_peft.studio.studio_verb import make_parser

PACKAGE = Path(gift_peft.prepare.__file__).parent


def settings(*argv):
    return parse(["R", *argv, "O"]).settings


@pytest.mark.parametrize("spell", [str, lambda name: name.replace("_", "-")])
def test_every_field_is_an_option(tmp_path, spell):
    assert settings() == PrepareSettings()
    for part, kind in PARTS.items():
        for f in fields(kind):
            option = f"--{spell(f.name)}"
            if isinstance(f.default, bool):
                assert getattr(getattr(settings(option), part), f.name) is True
                assert settings(option, f"--{spell('no_' + f.name)}") == PrepareSettings()
            else:
                value = 0.5 if f.name == "confidence" else f.default * 2
                assert settings(option, str(value)) == PrepareSettings(**{part: kind(**{f.name: value})})
    for name in ("static_rig", "propose_masks", "accept_proposed_masks"):
        assert getattr(settings(f"--{spell(name)}"), name) is True
        assert getattr(settings(f"--{spell(name)}", f"--{spell('no_' + name)}"), name) is False
    layout = tmp_path / "layout.yaml"
    layout.write_text("root: release")
    args = parse(["R", "O", f"--{spell('pretty_name')}=A b", "--layout", str(layout), "--refine", "sam2:x"])
    assert args.pretty_name == "A b" and args.settings.layout.root == "release" and args.settings.propose_masks
    assert set(vars(args)) <= inspect.signature(prepare_gift_i).parameters.keys()


def test_help_says_every_option_its_default_and_an_example(capsys):
    with pytest.raises(SystemExit) as ended:
        parse(["--help"])
    words = " ".join(capsys.readouterr().out.split())
    assert ended.value.code == 0 and "example: gift-peft prepare" in words and "--static_rig" not in words
    for f in (f for kind in PARTS.values() for f in fields(kind)):
        assert f.metadata["help"] in words
        assert re.search(rf"--{f.name.replace('_', '-')}[ ,]", words)
        if not isinstance(f.default, bool):
            assert f"{f.metadata['help']} (default: {f.default})" in words


def test_missing_masks_point_to_the_studio(tmp_path, capsys):
    """With a command that can be typed as it stands, whatever the folder is called."""
    raw = tmp_path / "my photos"
    for name in ("a", "b"):
        shutil.rmtree(write_group(raw / name, 2, 0) / "masks")
    with pytest.raises(SystemExit) as ended:
        main(["prepare", str(raw), str(tmp_path / "out")])
    told = capsys.readouterr()
    assert ended.value.code == 1 and told.out.count("groups lack masks") == 1
    commands = [shlex.split(words) for words in re.findall(r"`(gift-peft [^`]+)`", told.out)]
    assert [words[1:] for words in commands] == [
        ["studio", str(raw)],
        ["prepare", str(raw), str(tmp_path / "out"), "--propose-masks"],
    ]
    assert make_parser().parse_args(commands[0][2:]).folder == str(raw)
    assert told.err.count("gift-peft studio RAW") == 2  # of each group


def test_no_circle_among_the_modules_of_prepare():
    """Imports inside functions count too."""
    graph = {}
    for path in PACKAGE.glob("*.py"):
        imported = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
        names = [node.module for node in imported if (node.module or "").startswith("gift_peft.prepare.")]
        graph[f"gift_peft.prepare.{path.stem}"] = set(names)
    assert len(graph) > 10 and graph["gift_peft.prepare.prepare"]
    list(TopologicalSorter(graph).static_order())  # a CycleError names the circle
