"""`gift-peft prepare`: its options, which are the fields of `settings.py`, and what it says at the end.

A YAML file (`--config`) may state the same names; the command line wins.
"""

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import Field, fields
from pathlib import Path

from gift_peft.captures.known_datasets import choose_layout
from gift_peft.files import read_yaml
from gift_peft.options import OptionParser, did_you_mean, number
from gift_peft.prepare.settings import PrepareSettings, QualitySettings, RegistrationSettings

PARTS = {"registration": RegistrationSettings, "quality": QualitySettings}
NOTES = ("clip", "one_mask", "skipped_files", "exif_turned")  # what is said at the end, beside the report
EXAMPLE_BASE = "depth-anything/Depth-Anything-V2-Small-hf"
DESCRIPTION = """From a folder of photos to a checked GIFT-I dataset: register, check, write, report.

Exit code: 0 if every group is in OUT, 3 if some were rejected (the report says why), 1 if none could be made, or RAW
or a configuration file is wrong, 2 for a wrong command line. Run again, it does what is left to do."""


def run(argv: Sequence[str]) -> int:
    """Prepare, say in a few lines what came of it, and return the exit code.

    Raises ValueError or an OSError (one line) where nothing could be made; a wrong command line leaves by SystemExit.
    """
    words = [word for word in argv if word.replace("_", "-") != "--dry-run"]
    args = parse_arguments(words)
    if len(words) < len(argv):
        from gift_peft.prepare.prepare_plan import tell_plan

        return tell_plan(Path(args.raw), Path(args.out), args.settings, args.num_proc)
    from gift_peft.prepare.prepare import prepare_gift_i

    report = prepare_gift_i(**vars(args))
    for entry in report["groups"]:
        if entry["status"] == "rejected":
            text = entry["reasons"][0]["text"]
            print(f"gift-peft: rejected: {entry['split']}/{entry['group_id']}: {text}", file=sys.stderr)
    for entry in report["groups"]:
        for note in entry["warnings"]:
            if note["code"] in NOTES:
                print(f"gift-peft: {entry['split']}/{entry['group_id']}: {note['text']}", file=sys.stderr)
    accepted = [entry for entry in report["groups"] if entry["status"] == "kept" and entry["proposal"]]
    if accepted:
        names = ", ".join(f"{e['split']}/{e['group_id']} (score {e['proposal']['score']:.2f})" for e in accepted)
        print(f"Masks that were proposed, not drawn, and accepted: {names}")
    for split, found in report["statistics"].items():
        print(
            f"{split}: {found['groups']} groups, {found['images']} images ({found['warped_frames']} frames warped, "
            f"{found['dropped_frames']} dropped), {found['references']} references, "
            f"{found['rejected_groups']} groups rejected"
        )
    page = Path(args.out) / "report.html"
    print(f"Report: {page}")
    kept = sum(found["groups"] for found in report["statistics"].values())
    _tell_masks(report["groups"], args.raw, args.out)
    if not kept:
        raise ValueError(f"no group could be prepared; {page} says why")
    print(f"Next: {_next_command(report['statistics'], args.out)}")
    return 0 if kept == len(report["groups"]) else 3


def _tell_masks(groups: list[dict], raw: str, out: str) -> None:
    """How the masks that are missing may be drawn."""
    lacking = [entry for entry in groups if any(reason["code"] == "masks_missing" for reason in entry["reasons"])]
    if not lacking:
        return
    proposing = shlex.join(["gift-peft", "prepare", raw, out, "--propose-masks"])
    drawing = shlex.join(["gift-peft", "studio", raw])
    one = len(lacking) == 1
    print(
        f"{'A group lacks' if one else f'{len(lacking)} groups lack'} masks: draw them in a browser with `{drawing}`, "
        f"or `{proposing}` draws first ones; "
        "one mask for a group is enough, as mask.png beside its photos (docs/masks.md)"
    )


def _next_command(statistics: dict[str, dict], out: str) -> str:
    """What to type next, for this dataset: train, or without groups to train on evaluate."""
    train = statistics.get("train", {"groups": 0})
    if not train["groups"]:
        return shlex.join(["gift-peft", "evaluate", "--base", EXAMPLE_BASE, "--dataset", out])
    words = ["gift-peft", "train", "--base", EXAMPLE_BASE, "--dataset", out, "--out", f"{Path(out)}-run"]
    return shlex.join([*words, *(["--target", "surface"] if train["group_size"]["min"] == 1 else [])])


def parse_arguments(argv: Sequence[str]) -> argparse.Namespace:
    """The arguments of `prepare_gift_i`: `argv` (without the verb) over the file of `--config` over the defaults.

    A wrong command line ends as argparse does it (exit code 2). Raises ValueError or FileNotFoundError naming the
    YAML file and its key.
    """
    parser = make_parser()
    values = vars(parser.parse_args(argv))
    if values["config"] is not None:
        values = vars(parser.parse_args([*_read_config(Path(values["config"])), *argv]))
    del values["config"], values["dry_run"]  # `run` has looked for the second
    parts = {name: kind(**{key: values.pop(key) for key in _options(kind)}) for name, kind in PARTS.items()}
    choices = {key: values.pop(key) for key in _options(PrepareSettings)}
    choices["propose_masks"] |= choices["accept_proposed_masks"] or choices["refine"] is not None
    choices["layout"] = None if choices["layout"] is None else choose_layout(choices["layout"])
    return argparse.Namespace(settings=PrepareSettings(**parts, **choices), **values)


def make_parser() -> OptionParser:
    parser = OptionParser("prepare", DESCRIPTION, "gift-peft prepare my-captures gift-i --num-proc 2")
    parser.usage = "%(prog)s RAW OUT [options]"
    parser.add_argument("raw", metavar="RAW", help="folder of group folders; it is only read")
    parser.add_argument("out", metavar="OUT", help="prepared folder: new, or made by this command before")
    parser.add_argument("--config", metavar="FILE", help="YAML file with values for the options below")
    text = "say what would be done and how long it takes, and write nothing; the exit code is that of the run"
    parser.add_argument("--dry-run", action="store_true", help=text)
    parser.add_argument("--num-proc", type=number(int, 1), default=1, metavar="N", help="groups prepared side by side")
    parser.add_argument("--license", default="unknown", metavar="ID", help="for the dataset card, as cc-by-4.0")
    parser.add_argument("--pretty-name", metavar="NAME", help="for the dataset card; default: the name of RAW")
    for kind in (PrepareSettings, *PARTS.values()):
        group = parser if kind is PrepareSettings else parser.add_argument_group(*kind.__doc__.split(". ", 1))
        for name, option in _options(kind).items():
            form = {"metavar": option.metadata["metavar"]}
            if "choices" in option.metadata:
                form = {"choices": option.metadata["choices"]}
            elif isinstance(option.default, bool):
                form = {"action": argparse.BooleanOptionalAction}
            elif option.default is not None:
                form["type"] = number(type(option.default), option.metadata["least"])
            spelling = f"--{name.replace('_', '-')}"
            group.add_argument(spelling, default=option.default, help=option.metadata["help"], **form)
    return parser


def _options(kind: type) -> dict[str, Field]:
    return {option.name: option for option in fields(kind) if option.metadata}


def _read_config(path: Path) -> list[str]:
    """The file's values as words of a command line, checked by the same parser."""

    def refuse(message: str):
        raise ValueError(f"config {path}: {message}")

    parser = make_parser()
    parser.error = refuse
    known = vars(parser.parse_args(["RAW", "OUT"]))
    for key in ("raw", "out", "config", "dry_run"):
        del known[key]
    words = []
    for key, value in read_yaml(path, f"config {path}").items():
        if key not in known:
            refuse(f"unknown key {key!r}{did_you_mean(str(key), known)}")
        flag = isinstance(known[key], bool)
        if isinstance(value, list | dict) or flag != isinstance(value, bool):
            refuse(f"{key}: {value!r}; expected {'true or false' if flag else 'one value'}")
        if flag:
            words.append(f"--{key}" if value else f"--no-{key}")
        elif value is not None:
            words.append(f"--{key}={value}")
    parser.parse_args(["RAW", "OUT", *words])
    return words
