"""What Windows and macOS do not have is not needed there."""

import ast
import runpy
import sys
from pathlib import Path

import pytest
import torch
from accelerate import Accelerator

import gift_peft
from gift_peft.training import profiling, start

UNIX_ONLY = {"crypt", "curses", "fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}


def test_no_module_needs_a_unix_module_to_be_imported():
    for path in Path(gift_peft.__file__).parent.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert UNIX_ONLY.isdisjoint(name.partition(".")[0] for name in names), path


@pytest.mark.parametrize("missing", ["resource", None])
def test_peak_memory_without_proc_and_without_resource(missing, monkeypatch):
    if missing:
        monkeypatch.setitem(sys.modules, missing, None)  # importing it is an error
    names = runpy.run_path(profiling.__file__)

    def no_such_file(path, *args, **options):
        raise FileNotFoundError(2, "No such file or directory", str(path))

    monkeypatch.setattr(Path, "read_text", no_such_file)
    monkeypatch.setattr(Path, "write_text", no_such_file)
    names["reset_peak_memory"](torch.device("cpu"))
    assert 2**26 < names["peak_memory"](torch.device("cpu")) < 2**40


def test_a_build_of_torch_without_distributed_tells_its_errors(monkeypatch, tmp_path):
    monkeypatch.delattr(torch.distributed, "DistError")
    with pytest.raises(RuntimeError, match="as it was"), start.tell_lost_processes(Accelerator(cpu=True), tmp_path):
        raise RuntimeError("as it was")
