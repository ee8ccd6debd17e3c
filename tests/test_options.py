"""Options as they are typed: both spellings of each, the synonyms, the help; what is told of an error."""

import argparse
import os
import re
import subprocess
import sys
import warnings
from importlib import import_module
from pathlib import Path

import pytest

from gift_peft.cli import VERBS
from gift_peft.options import OptionParser, expand_home, run_verb
from gift_peft.training import arguments

SYNONYMS = {
    "--base": "--model-name-or-path",
    "--dataset": "--dataset-name",
    "--out": "--output-dir",
}


@pytest.fixture(params=VERBS)
def parser(request):
    """Each verb's parser; a wrong option is a ValueError."""
    module, _ = VERBS[request.param]
    parser = import_module(f"gift_peft.{module}").make_parser()
    parser.error = _raise
    return parser


def _raise(message):
    raise ValueError(message)


def options(parser):
    """(option, action) of all that take a value, as they stand in the help."""
    own = [action for action in parser._actions if not isinstance(action, argparse._HelpAction)]
    return [(option, action) for action in own for option in action.option_strings if option.startswith("--")]


def parsed(parser, option, action):
    """What the option makes of a right value: {dest: value}, without the defaults of others."""
    count = {"+": 1, "*": 1, "?": 0, None: 1}.get(action.nargs, action.nargs)
    word = action.choices[0] if action.choices else "2"
    for other in parser._actions:
        other.required, other.default = False, argparse.SUPPRESS
        if not other.option_strings:
            other.nargs, other.choices = "*", None
    return vars(parser.parse_args([option, *[str(word)] * count]))


def test_every_option_is_taken_with_hyphens_and_underscores(parser):
    tried = options(parser)
    assert len(tried) > 1
    for option, action in tried:
        hyphens = parsed(parser, option, action)
        assert hyphens == parsed(parser, f"--{option[2:].replace('-', '_')}", action)
        assert action.dest in hyphens


def test_help_has_one_spelling_and_an_example(parser):
    text = parser.format_help()
    assert not re.search(r"--[\w-]*_", text.partition("example:")[0])
    verb = parser.prog.removeprefix("gift-peft ")
    example = re.search(rf"\nexample:\n  gift-peft {verb}( .+)$", text.rstrip())
    parser.parse_args(example.group(1).split())  # is one that it takes itself
    for option, action in options(parser):
        assert action.help, option


def test_synonyms_mean_the_same_everywhere(parser):
    known = dict(options(parser))
    for option, other in SYNONYMS.items():
        assert known.get(option) is known.get(other), (option, other)


def test_values_and_positional_words_keep_their_underscores():
    parser = OptionParser("try", "text", "gift-peft try")
    parser.add_argument("word")
    parser.add_argument("--some-option", action=argparse.BooleanOptionalAction)
    parser.add_argument("--other-option")
    args = parser.parse_args(["a_b", "--no_some_option", "--other_option=c_d"])
    assert (args.word, args.some_option, args.other_option) == ("a_b", False, "c_d")
    assert parser.parse_args(["a_b", "--other_option", "c_d"]).other_option == "c_d"
    with pytest.raises(SystemExit):
        parser.parse_args(["a_b", "--other", "c"])  # no abbreviations


@pytest.fixture
def clean(monkeypatch):
    """`run_verb` changes these for the rest of a process."""
    monkeypatch.delenv("GIFT_PEFT_DEBUG", raising=False)
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    for name in ("HF_DATASETS_DISABLE_PROGRESS_BARS", "HF_HUB_DISABLE_PROGRESS_BARS", "TRANSFORMERS_VERBOSITY"):
        monkeypatch.delenv(name, raising=False)
    with warnings.catch_warnings():
        yield


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ValueError("two\nlines"), 1, "gift-peft: error: two lines\n"),
        (FileNotFoundError("no such file: a"), 1, "gift-peft: error: no such file: a\n"),
        (KeyboardInterrupt(), 130, "gift-peft: stopped\n"),
    ],
)
def test_an_error_becomes_a_line_and_an_exit_code(error, code, line, clean, capsys):
    def run(argv):
        raise error

    assert run_verb(run, ["--some"]) == code
    assert capsys.readouterr().err == line


def test_debug_is_taken_out_and_lets_the_error_through(clean):
    seen = []
    assert run_verb(lambda argv: seen.append(argv) or 3, ["a", "--debug", "--b=c"]) == 3
    assert seen == [["a", "--b=c"]]
    with pytest.raises(ValueError, match="as it was"):
        run_verb(lambda argv: _raise("as it was"), ["--debug"])
    with pytest.raises(KeyError):  # a mistake of ours is never hidden
        run_verb(lambda argv: {}["a"], [])


def test_what_follows_two_hyphens_is_taken_as_it_is():
    parser = OptionParser("try", "A try.", "gift-peft try")
    parser.add_argument("--out-dir")
    parser.add_argument("files", nargs="+")
    args = parser.parse_args(["--out_dir=a_b", "--", "--x_y.jpg", "x_y"])
    assert (args.out_dir, args.files) == ("a_b", ["--x_y.jpg", "x_y"])


def test_the_home_folder_is_written_out_in_every_option(parser, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    tried = 0
    for option, action in options(parser):
        if action.choices or action.type not in (None, str, Path) or action.nargs == 0:
            continue
        for other in parser._actions:
            other.required, other.default = False, argparse.SUPPRESS
            if not other.option_strings:
                other.nargs, other.choices = "*", None
        value = vars(parser.parse_args([f"{option}=~/x y"]))[action.dest]
        assert value in (f"{tmp_path}/x y", [f"{tmp_path}/x y"], Path(f"{tmp_path}/x y")), option
        tried += 1
    assert tried or parser.prog == "gift-peft synthesize"  # which has numbers alone


def test_only_a_leading_tilde_is_the_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    words = ["~", "~/a", "a~", "/x/~/y", "~nobody-has-this-name/x", "", Path("~/a"), ["~/a", 3], None, 1.5]
    expected = ["/home/me", "/home/me/a", "a~", "/x/~/y", "~nobody-has-this-name/x", "", Path("/home/me/a")]
    assert expand_home(words) == [*expected, ["/home/me/a", 3], None, 1.5]


def test_a_misspelled_option_is_told_with_the_nearest(parser, monkeypatch):
    """Also where a required one is missing because it is the one that is misspelled."""
    for option, _ in options(parser):
        wrong = f"{option[:-2]}{option[-1]}{option[-2]}x"
        if len(option) < 8 or parser.knows(wrong):
            continue
        with pytest.raises(ValueError, match=f"unknown option {wrong}; did you mean --") as told:
            parser.parse_args([wrong, "3"])
        nearest = str(told.value).split("did you mean ")[1].rstrip("?")
        assert parser.knows(nearest)
    with pytest.raises(ValueError, match=r"unknown option --qqqqzzzz$"):
        parser.parse_args(["--qqqqzzzz=3"])


def test_what_follows_two_hyphens_is_no_option():
    parser = OptionParser("try", "Try.", "gift-peft try")
    parser.add_argument("names", nargs="*")
    assert parser.parse_args(["--", "--what"]).names == ["--what"]


def test_the_help_of_train_has_every_argument_in_one_group():
    text = arguments.make_parser().format_help()
    start = [text.index(f"\n{title}:\n") for title in arguments.SECTIONS.values()]
    assert start == sorted(start) and set(arguments.SECTIONS) <= set(arguments._names())
    for name in arguments._names():
        assert len(re.findall(rf"^  --{name.replace('_', '-')}(?![\w-])", text, re.MULTILINE)) == 1
    assert text.index("--model-name-or-path") > start[0] and "--base ID --dataset ID --out DIR [options]" in text


# Prints OpenMP's settings, as the library says that it has read them, once a verb has imported torch.
SETTINGS = """
from gift_peft.options import run_verb
run_verb(lambda argv: __import__("torch").get_num_threads() and 0, [])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other OpenMP libraries display other words")
@pytest.mark.parametrize(("given", "expected"), [({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")])
def test_threads_wait_asleep_unless_told_otherwise(given, expected):
    """A thread that spins takes a busy core from the one that it waits for; libgomp reads this once, when loaded."""
    unset = {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}
    env = {name: value for name, value in os.environ.items() if name not in unset}
    env |= {"OMP_DISPLAY_ENV": "VERBOSE", **given}
    done = subprocess.run([sys.executable, "-c", SETTINGS], capture_output=True, text=True, check=True, env=env)
    assert f"OMP_WAIT_POLICY = '{expected}'" in done.stderr
