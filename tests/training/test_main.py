"""`-m gift_peft.training` trains by itself: the command line's errors and exit codes without the command line."""

import runpy
import signal
import sys
import warnings

import pytest

from gift_peft.training import loop

REQUIRED = ["--base=m", "--dataset=d", "--out=o"]


@pytest.fixture
def run(monkeypatch, capsys):
    """The module with these arguments: (exit code, stdout, stderr)."""
    monkeypatch.setitem(sys.modules, "gift_peft.cli", None)  # importing it is an error
    monkeypatch.delitem(sys.modules, "gift_peft.training.__main__", raising=False)
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)  # which it changes for its process
    for name in ("HF_DATASETS_DISABLE_PROGRESS_BARS", "HF_HUB_DISABLE_PROGRESS_BARS", "TRANSFORMERS_VERBOSITY"):
        monkeypatch.setenv(name, "error" if name.startswith("T") else "1")

    def run(*argv):
        monkeypatch.setattr(sys, "argv", ["gift_peft.training", *argv])
        with pytest.raises(SystemExit) as exit:
            runpy.run_module("gift_peft.training", run_name="__main__")
        return exit.value.code, *capsys.readouterr()

    return run


def test_help(run):
    code, out, _ = run("--help")
    assert code == 0
    assert "--lambda-c" in out and "--model-name-or-path" in out and "--base" in out
    assert out.rstrip().splitlines()[-1].startswith("  gift-peft train --base ")


def test_an_error_is_one_line_and_1(run, monkeypatch):
    line = "gift-peft: error: unknown argument --lora_rnk; did you mean lora_rank?\n"
    assert run("--lora_rnk=1") == (1, "", line)

    def fail(args):
        raise OSError("two\nlines")

    monkeypatch.setattr(loop, "train", fail)
    assert run(*REQUIRED) == (1, "", "gift-peft: error: two lines\n")


@pytest.mark.parametrize("way", ["option", "environment"])
def test_debug_shows_the_traceback(way, run, monkeypatch):
    if way == "environment":
        monkeypatch.setenv("GIFT_PEFT_DEBUG", "1")
    with pytest.raises(ValueError, match="did you mean lora_rank"):
        run("--lora_rnk=1", *(["--debug"] if way == "option" else []))


@pytest.mark.parametrize(("signum", "code"), [(None, 0), (signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_is_128_more(signum, code, run, monkeypatch, tmp_path):
    given = []

    def train(args):
        given.append(args)
        return loop.TrainResult(tmp_path, 1, [], None, signum)

    monkeypatch.setattr(loop, "train", train)
    assert run(*REQUIRED, "--lora-rank=3")[0] == code
    assert (given[0].model_name_or_path, given[0].lora_rank) == ("m", 3)


def test_ctrl_c_before_the_first_update_is_130(run, monkeypatch):
    def interrupt(args):
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "train", interrupt)
    assert run(*REQUIRED)[0] == 130
