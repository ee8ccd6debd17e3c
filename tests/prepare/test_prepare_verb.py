"""The options of `gift-peft prepare`: every field of the settings, in both spellings; help loads nothing heavy."""

import ast
import inspect
import re
import subprocess
import sys
from dataclasses import fields
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import gift_peft.prepare
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.prepare_verb import parse_arguments as parse
from gift_peft.prepare.settings import PrepareSettings, QualitySettings, RegistrationSettings

PACKAGE = Path(gift_peft.prepare.__file__).parent
THRESHOLDS = [(part, f) for part in (RegistrationSettings, QualitySettings) for f in fields(part)]


@pytest.mark.parametrize("spell", [str, lambda name: name.replace("_", "-")])
def test_every_field_is_an_option_in_both_spellings(tmp_path, spell):
    for kind, part in ((RegistrationSettings, "registration"), (QualitySettings, "quality")):
        for f in fields(kind):
            if isinstance(f.default, bool):
                argv, value = [f"--{spell(f.name)}"], True
                assert (
                    getattr(getattr(parse(["R", "O", *argv, f"--{spell('no_' + f.name)}"]).settings, part), f.name)
                    is False
                )
            else:
                value = type(f.default)(f.default * 2) if f.name != "confidence" else 0.5
                argv = [f"--{spell(f.name)}", str(value)]
            assert getattr(getattr(parse(["R", *argv, "O"]).settings, part), f.name) == value, f.name
            assert parse(["R", "O"]).settings == PrepareSettings()
    for name in ("static_rig", "propose_masks", "accept_proposed_masks"):
        assert getattr(parse([f"--{spell(name)}", "R", "O"]).settings, name) is True
        assert getattr(parse(["R", "O", f"--{spell('no_' + name)}"]).settings, name) is False
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
    for _, f in THRESHOLDS:
        assert f.metadata["help"] in words
        assert re.search(rf"--{f.name.replace('_', '-')}[ ,]", words)
        if not isinstance(f.default, bool):
            assert f"{f.metadata['help']} (default: {f.default})" in words


def test_help_imports_nothing_heavy():
    # Not through the package's doorway, whose own imports are another test's.
    script = f"""
import resource, sys, types
package = types.ModuleType("gift_peft")
package.__path__ = [{str(PACKAGE.parent)!r}]
sys.modules["gift_peft"] = package
from gift_peft.prepare.prepare_verb import run
try:
    run(["--help"])
except SystemExit:
    print([name for name in ("torch", "transformers", "datasets", "peft", "cv2") if name in sys.modules])
    print(resource.getrusage(resource.RUSAGE_SELF).ru_utime)
"""
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    heavy, seconds = said.splitlines()[-2:]
    assert heavy == "[]" and float(seconds) < 2


def test_no_circle_among_the_modules_of_prepare():
    """Imports inside functions count too."""
    graph = {}
    for path in PACKAGE.glob("*.py"):
        imported = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
        names = [node.module for node in imported if (node.module or "").startswith("gift_peft.prepare.")]
        graph[f"gift_peft.prepare.{path.stem}"] = set(names)
    assert len(graph) > 10 and graph["gift_peft.prepare.prepare"]
    list(TopologicalSorter(graph).static_order())  # a CycleError names the circle
