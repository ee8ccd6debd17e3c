"""What the verbs of `gift-peft` share: how options are spelled, and how an error becomes an exit code.

Each verb's module has `make_parser()`, an `OptionParser`, and `run(argv)`, which parses, works and returns the exit
code. Only the standard library is imported here: `--help` waits for nothing else.
"""

import argparse
import copy
import difflib
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from importlib import metadata
from typing import Any


class OptionParser(argparse.ArgumentParser):
    """A verb's parser: an option is added with hyphens, accepted with underscores too, and never abbreviated.

    Args:
        verb (`str`): as in `gift-peft VERB`.
        description (`str`): what the verb does, in a line.
        example (`str`): a command to type, which ends the help.
        parents: parsers whose arguments this one takes over, for example an `HfArgumentParser` without help.
    """

    def __init__(self, verb: str, description: str, example: str, parents: Sequence[argparse.ArgumentParser] = ()):
        super().__init__(
            prog=f"gift-peft {verb}",
            description=description,
            epilog=f"example:\n  {example}",
            parents=list(parents),
            formatter_class=_HelpFormatter,
            allow_abbrev=False,
        )
        for action in self._actions:  # an HfArgumentParser states both spellings
            action.option_strings = [option for option in action.option_strings if "_" not in option]
        # For the help alone: `run_verb` takes it out before a verb sees it.
        text = "show the traceback of an error"
        self.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=text)

    def knows(self, option: str) -> bool:
        return _hyphens(option) in self._option_string_actions

    def parse_args(self, args=None, namespace=None):
        words = list(sys.argv[1:] if args is None else args)
        # Before argparse, which would complain of a required option where its name is merely misspelled.
        for word in before_separator(words):
            option = _hyphens(word).partition("=")[0]
            if option.startswith("--") and not self.knows(option):
                known = [name for name in self._option_string_actions if name.startswith("--")]
                self.error(f"unknown option {word.partition('=')[0]}{did_you_mean(option, known)}")
        return super().parse_args(words, namespace)

    def parse_known_args(self, args=None, namespace=None):
        words = list(sys.argv[1:] if args is None else args)
        options = before_separator(words)
        values, rest = super().parse_known_args([*map(_hyphens, options), *words[len(options) :]], namespace)
        for name, value in vars(values).items():
            setattr(values, name, expand_home(value))
        return values, rest


class _HelpFormatter(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Keeps the example's line as it is, and shows the defaults that say something."""

    def add_argument(self, action: argparse.Action) -> None:
        if action.default is None or action.default is False or action.default == []:
            action = copy.copy(action)
            action.default = argparse.SUPPRESS
        super().add_argument(action)


def expand_home(value: Any) -> Any:
    """A path that begins with `~`, or a list of such, with the home folder in its place; anything else as it is.

    A shell does that for words of their own, but neither in `--out=~/run` nor in a YAML file.
    """
    if isinstance(value, list):
        return [expand_home(item) for item in value]
    if isinstance(value, str | os.PathLike) and os.fspath(value).startswith("~"):
        return type(value)(os.path.expanduser(value))
    return value


def before_separator(words: Sequence[str]) -> Sequence[str]:
    """Those before a `--`: what follows is no option, whatever it looks like."""
    return words[: words.index("--")] if "--" in words else words


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The end of a message about an unknown word: "; did you mean X?", or nothing where none is near."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean {near[0]}?" if near else ""


def _hyphens(word: str) -> str:
    """`--proxies-dir=my_folder` for `--proxies_dir=my_folder`; other words as they are."""
    option, equals, value = word.partition("=")
    return option.replace("_", "-") + equals + value if word.startswith("--") else word


def add_base(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """The options that name a base model."""
    parser.add_argument(
        "--base", "--model-name-or-path", required=required, metavar="ID", help="base model: hub id or folder"
    )
    parser.add_argument("--revision", help="branch, tag or commit of the base model")
    parser.add_argument("--size", metavar="HxW", help="at the network; default: the adapter's, else the recipe's")


def add_dataset(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """The option that names a dataset."""
    text = "GIFT-I: raw tree, prepared folder, parquet release or hub id"
    parser.add_argument("--dataset", "--dataset-name", required=required, metavar="ID", help=text)


def add_adapter(parser: argparse.ArgumentParser) -> None:
    """The options that put an adapter on the base."""
    parser.add_argument("--adapter", metavar="ID", help="adapter: hub id or folder")
    text = "take the base although the adapter was trained on other weights"
    parser.add_argument("--accept-base", action="store_true", help=text)
    parser.add_argument("--adapter-scale", type=float, metavar="S", help="0 is the base, 1 the adapter")
    parser.add_argument("--kind", choices=["depth", "inverse_depth"], help="what is predicted, if no recipe says it")


def number(kind: type, least: int) -> Callable[[str], float]:
    """An option's `type`: a finite number of this kind, at least `least`."""

    def parse(text: str):
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not least <= value < math.inf:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {kind.__name__} of at least {least}")
        return value

    return parse


def use_color() -> bool:
    """Whether tables are printed in color: on a terminal, unless NO_COLOR is set."""
    return sys.stdout.isatty() and "NO_COLOR" not in os.environ


def package_version(name: str) -> str:
    """The version of an installed package, without importing it."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def run_verb(run: Callable[[list[str]], int], argv: Sequence[str]) -> int:
    """The exit code of `run(argv)`.

    An error of ours is one line on stderr and 1; a run stopped by Ctrl-C is 130, as a shell expects; wrong usage
    leaves through argparse with 2. `--debug` anywhere in `argv`, or GIFT_PEFT_DEBUG=1, lets the error itself through.
    """
    debug = "--debug" in argv or os.environ.get("GIFT_PEFT_DEBUG", "0") not in ("", "0")
    if not debug:
        _quiet()
    _wait_asleep()
    try:
        return run([word for word in argv if word != "--debug"])
    except KeyboardInterrupt:
        print("gift-peft: stopped", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        if debug:
            raise
        print(f"gift-peft: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1


def _wait_asleep() -> None:
    """Threads of torch's (OpenMP) that wait for one another sleep in place of spinning, read when torch is imported.

    On cores that others use as well, a thread that spins keeps away the one that it waits for: measured on two busy
    cores, an update of the demo's model took ten to fifteen times as long with two threads as with one.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def _quiet() -> None:
    """Our own lines and bars are enough; those of the libraries, not imported yet, come back with --debug."""
    os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")
    warnings.filterwarnings("ignore", category=FutureWarning)  # between transformers and peft, nothing a user can do
    warnings.formatwarning = lambda message, *_, **__: f"gift-peft: warning: {message}\n"
    if not sys.stderr.isatty():  # on a terminal the bars of a download are wanted
        os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")
        os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
