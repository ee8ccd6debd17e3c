"""The arguments of `gift-peft prepare`. Every threshold has one; a YAML file (`--config`) may state the same names,
and the command line wins."""

import argparse
import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import yaml

from gift_peft.captures.foreign import Layout, read_layout
from gift_peft.options import OptionParser
from gift_peft.prepare.matching import RegistrationSettings
from gift_peft.prepare.quality import QualitySettings


@dataclass(frozen=True)
class PrepareSettings:
    """Everything that decides what becomes of a group.

    Args:
        registration (`RegistrationSettings`), quality (`QualitySettings`): thresholds.
        static_rig (`bool`): no camera moved, in any group; a `group.yaml` may say it of one.
        propose_masks (`bool`): propose masks for groups that lack any.
        accept_proposed_masks (`bool`): use them.
        refine (`str`, *optional*): "sam2:<model id>", for the proposals' borders.
        layout (`Layout`, *optional*): default: the raw tree.
    """

    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    quality: QualitySettings = field(default_factory=QualitySettings)
    static_rig: bool = False
    propose_masks: bool = False
    accept_proposed_masks: bool = False
    refine: str | None = None
    layout: Layout | None = None


PARTS = {"registration": RegistrationSettings, "quality": QualitySettings}
FLAGS = {
    "static_rig": "no camera moved in any group: nothing is warped (static_rig: true in group.yaml says it of one)",
    "propose_masks": "propose masks for groups that lack any, into OUT/masks_proposed; they are not used",
    "accept_proposed_masks": "use the proposed masks, which the dataset card then says",
    "paper_exact": "the paper's registration thresholds alone; the report says what the rest would have done",
}
EXIT_CODES = """Exit code: 0 if every group is in OUT, 3 if some were rejected (the report says why), 1 if none could
be made, or RAW or a configuration file is wrong, 2 for a wrong command line. Run again, it does what is left to do."""


def parse_arguments(argv: Sequence[str]) -> argparse.Namespace:
    """`raw`, `out`, `settings` (a `PrepareSettings`), `num_proc`, `license` and `pretty_name` from the command line.

    A wrong command line ends as argparse does it (exit code 2). Raises ValueError or FileNotFoundError naming the YAML
    file and its key.
    """
    parser = make_parser()
    given = {key: value for key, value in vars(parser.parse_args(argv)).items() if value is not None}
    config = given.pop("config", None)
    values = {**(_read_config(Path(config)) if config else {}), **given}
    parts = {
        name: kind(**{f.name: values[f.name] for f in fields(kind) if f.name in values})
        for name, kind in PARTS.items()
    }
    if values.get("accept_proposed_masks") or values.get("refine"):
        values["propose_masks"] = True
    layout = values.get("layout")
    settings = PrepareSettings(
        **parts,
        **{key: values[key] for key in ("static_rig", "propose_masks", "accept_proposed_masks") if key in values},
        refine=values.get("refine"),
        layout=None if layout is None else read_layout(layout),
    )
    return argparse.Namespace(
        raw=values["raw"],
        out=values["out"],
        settings=settings,
        num_proc=values.get("num_proc", 1),
        license=values.get("license", "unknown"),
        pretty_name=values.get("pretty_name"),
    )


def make_parser() -> OptionParser:
    parser = OptionParser(
        "prepare",
        f"From a folder of photos to a checked GIFT-I dataset: register, check, write, report.\n\n{EXIT_CODES}",
        "gift-peft prepare photos gift-i --num-proc 4",
    )
    parser.add_argument("raw", metavar="RAW", help="folder of group folders; it is only read")
    parser.add_argument("out", metavar="OUT", help="prepared folder: new, or made by this command before")
    _add(parser, "config", metavar="FILE", help="YAML file with values for these arguments; the command line wins")
    _add(parser, "num_proc", type=_count, metavar="N", help="processes, each with groups of its own (default: 1)")
    _add(parser, "layout", metavar="FILE", help="YAML file that says where RGB, mask and proxy files lie")
    _add(parser, "refine", metavar="sam2:MODEL", help="refine the proposals' borders with SAM 2")
    _add(parser, "license", metavar="ID", help="for the dataset card, for example cc-by-4.0 (default: unknown)")
    _add(parser, "pretty_name", metavar="NAME", help="for the dataset card (default: the name of RAW)")
    for name, text in FLAGS.items():
        _add(parser, name, action=argparse.BooleanOptionalAction, help=text)
    for part, kind in PARTS.items():
        group = parser.add_argument_group(f"thresholds of {part}", f"explained in {kind.__module__}.{kind.__name__}")
        for f in fields(kind):
            if f.name not in FLAGS:
                _add(group, f.name, type=_number(type(f.default)), metavar="X", help=f"default: {f.default:g}")
    return parser


def _add(parser, name: str, **options) -> None:
    parser.add_argument(f"--{name.replace('_', '-')}", dest=name, default=None, **options)


def _raise(message: str):
    raise ValueError(message)


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def _number(kind: type):
    def parse(text: str):
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not 0 <= value < math.inf:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {kind.__name__} of at least 0")
        return value

    return parse


def _read_config(path: Path) -> dict:
    """The file's values, checked by the same parser as if they stood on the command line."""
    if not path.is_file():
        raise FileNotFoundError(f"config: no such file: {path}")
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"config {path}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(values, dict):
        raise ValueError(f"config {path}: expected lines of the form `key: value`")
    parser = make_parser()
    parser.error = _raise
    known = {action.dest for action in parser._actions if action.option_strings} - {"config", "help", "debug"}
    argv = []
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1)
            raise ValueError(f"config {path}: unknown key {key!r}" + (f"; did you mean {near[0]}?" if near else ""))
        if isinstance(value, list | dict) or (key in FLAGS) != isinstance(value, bool):
            wanted = "true or false" if key in FLAGS else "one value"
            raise ValueError(f"config {path}: {key}: {value!r}; expected {wanted}")
        if key in FLAGS:
            argv.append(f"--{'' if value else 'no-'}{key.replace('_', '-')}")
        elif value is not None:
            argv.append(f"--{key}={value}")
    try:
        parsed = parser.parse_args(["RAW", "OUT", *argv])
    except ValueError as error:
        raise ValueError(f"config {path}: {error}") from None
    return {key: value for key, value in vars(parsed).items() if value is not None and key not in ("raw", "out")}
