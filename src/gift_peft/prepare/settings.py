"""The settings of `gift-peft prepare`. The dataclasses are its options: every field with a text below is one.

A YAML file (`--config`) may state the same names, and the command line wins.
"""

import argparse
import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import yaml

from gift_peft.captures.foreign import Layout, read_layout

DESCRIPTION = "From a folder of photos to a checked GIFT-I dataset: register, check, write, report."
EPILOG = """X is a number of at least 0. --no-static-rig (and so on) turns off a flag that the --config file turns on.

Example: gift-peft prepare my-captures gift-i --num-proc 2

Exit code: 0 if every group is in OUT, 3 if some were rejected (the report says why), 1 if none could be made, or RAW
or a configuration file is wrong, 2 for a wrong command line. Run again, it does what is left to do."""


def _arg(text: str, default, metavar: str = "X", least: int = 0):
    """A field that is an option; `least` holds for numbers."""
    return field(default=default, metadata={"help": text, "metavar": metavar, "least": least})


@dataclass(frozen=True)
class RegistrationSettings:
    """Thresholds of registration. Lengths are in pixels of the photos; the first eight are the paper's."""

    contrast_threshold: float = _arg("contrast below which SIFT ignores a feature", 0.08)
    edge_threshold: float = _arg("edge response above which SIFT ignores a feature", 10.0)
    ratio: float = _arg("Lowe's ratio test", 0.70)
    displacement_filter: float = _arg("matches that move this much unlike the median match are removed", 20.0)
    reprojection_threshold: float = _arg("distance up to which a match agrees with a map (MAGSAC)", 2.0)
    confidence: float = _arg("probability with which MAGSAC finds the map", 0.9995)
    max_iterations: int = _arg("iterations of MAGSAC", 5000, least=1)
    min_inlier_ratio: float = _arg("share of the filtered matches that must agree with the map", 0.90)
    paper_exact: bool = _arg(
        "the paper's registration thresholds alone; the report says what the rest would have done", False
    )
    min_contrast_threshold: float = _arg("how far contrast_threshold may be halved where matches are few", 0.02)
    target_margin: int = _arg("features and pixels this close to the target do not count", 8)
    min_inliers: int = _arg("agreeing matches outside the target that a map needs", 20)
    min_spread: float = _arg("least deviation of those matches in any direction, over the image diagonal", 0.02)
    identity_displacement: float = _arg("a median displacement below this is no motion", 0.5)
    max_target_error: float = _arg("largest expected error of the map at the target's corners", 0.5)
    max_displacement: float = _arg("largest motion of a corner of frame or target, over the image diagonal", 0.06)
    max_distortion: float = _arg("largest change of a local length by the map, as a fraction", 0.08)
    min_correlation: float = _arg("least correlation of the pixels outside the target with the target frame's", 0.5)

    def __post_init__(self):
        for name in ("contrast_threshold", "min_contrast_threshold", "edge_threshold", "reprojection_threshold"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: must be positive and finite, got {getattr(self, name)}")
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence: must be between 0 and 1, got {self.confidence}")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations: must be at least 1, got {self.max_iterations}")


@dataclass(frozen=True)
class QualitySettings:
    """Thresholds of the quality checks. `warn` leads to a line in the report, `drop` drops the frame."""

    warn_sharpness: float = _arg("sharpness relative to the group's median, below which a frame is blurred", 0.35)
    drop_sharpness: float = _arg("sharpness, below which a frame is dropped", 0.02)
    warn_clipped: float = _arg("fraction of pixels that are nearly black, or nearly white", 0.25)
    drop_clipped: float = _arg("the same, above which a frame is dropped", 0.95)
    warn_outside_change: float = _arg("fraction of the pixels outside the target whose local structure changed", 0.003)
    drop_outside_change: float = _arg("the same, above which a frame is dropped", 0.25)
    min_outside_correlation: float = _arg(
        "correlation outside the target with the target frame, below which it is another scene and dropped", 0.25
    )
    min_target_change: float = _arg(
        "mean grey change (0-255) inside the target, below which two frames are near duplicates; a train group "
        "without a larger change is rejected",
        1.5,
    )
    warn_mask_area_low: float = _arg("fraction of the image that is target, below which a mask is small", 0.002)
    warn_mask_area_high: float = _arg("the same, above which a mask is large", 0.8)
    warn_mask_border: float = _arg("fraction of the image's border that is target", 0.1)
    warn_mask_iou: float = _arg("overlap of a mask with the group's majority mask", 0.8)
    drop_mask_iou: float = _arg("the same, below which a frame is dropped", 0.2)


@dataclass(frozen=True)
class PrepareSettings:
    """Everything that decides what becomes of a group; `layout` describes RAW where it is not the raw tree."""

    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    quality: QualitySettings = field(default_factory=QualitySettings)
    static_rig: bool = _arg(
        "no camera moved in any group: nothing is warped (static_rig: true in group.yaml says it of one)", False
    )
    propose_masks: bool = _arg(
        "propose masks for groups that lack any, into OUT/masks_proposed; they are not used", False
    )
    accept_proposed_masks: bool = _arg("use the proposed masks, which the dataset card then says", False)
    refine: str | None = _arg("refine the borders of the proposals with SAM 2", None, "sam2:MODEL")
    layout: Layout | None = field(
        default=None,
        metadata={"help": "YAML file that says where RGB and mask files lie", "metavar": "FILE", "least": 0},
    )


@dataclass
class PrepareArguments:
    """The arguments of `prepare_gift_i`, as the command line states them."""

    raw: Path
    out: Path
    settings: PrepareSettings
    num_proc: int = _arg("processes, each with groups of its own", 1, "N", least=1)
    license: str = _arg("for the dataset card, for example cc-by-4.0", "unknown", "ID")
    pretty_name: str | None = _arg("for the dataset card; default: the name of RAW", None, "NAME")


PARTS = {"registration": RegistrationSettings, "quality": QualitySettings}


def _options(kind: type) -> dict:
    return {f.name: f for f in fields(kind) if f.metadata}


def parse_arguments(argv: Sequence[str]) -> PrepareArguments:
    """The command line `argv` (without the verb) over the YAML file of `--config` over the defaults.

    A wrong command line ends as argparse does it (exit code 2). Raises ValueError or FileNotFoundError naming the
    YAML file and its key.
    """
    parser = _parser()
    given = parser.parse_args(argv)
    if given.config is not None:
        given = parser.parse_args([*_read_config(Path(given.config)), *argv])
    parts = {name: kind(**{key: getattr(given, key) for key in _options(kind)}) for name, kind in PARTS.items()}
    choices = {key: getattr(given, key) for key in _options(PrepareSettings)}
    choices["propose_masks"] |= given.accept_proposed_masks or given.refine is not None
    choices["layout"] = None if given.layout is None else read_layout(given.layout)
    more = {key: getattr(given, key) for key in _options(PrepareArguments)}
    return PrepareArguments(Path(given.raw), Path(given.out), PrepareSettings(**parts, **choices), **more)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="gift-peft prepare",
        usage="%(prog)s RAW OUT [options]",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("raw", metavar="RAW", help="folder of group folders; it is only read")
    parser.add_argument("out", metavar="OUT", help="prepared folder: new, or made by this command before")
    parser.add_argument("--config", metavar="FILE", help="YAML file with values for the options below")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    for kind in (PrepareArguments, PrepareSettings, *PARTS.values()):
        group = parser if kind not in PARTS.values() else parser.add_argument_group(*kind.__doc__.split(". ", 1))
        for option in _options(kind).values():
            _add(group, option)
    return parser


def _add(parser, option) -> None:
    """An option under both spellings, --num-proc and --num_proc; the help shows the first."""
    text, metavar, least = option.metadata["help"], option.metadata["metavar"], option.metadata["least"]
    kind = type(option.default)
    if kind is bool:
        forms = [(option.name, {"action": "store_true"}), (f"no_{option.name}", {"action": "store_false"})]
    elif kind in (int, float):
        text += f" (default: {option.default:g})"
        forms = [(option.name, {"type": _number(kind, least), "metavar": metavar})]
    else:
        forms = [(option.name, {"metavar": metavar})]
    for name, form in forms:
        for spelling in dict.fromkeys((name.replace("_", "-"), name)):
            shown = text if spelling == option.name.replace("_", "-") else argparse.SUPPRESS
            parser.add_argument(f"--{spelling}", dest=option.name, default=option.default, help=shown, **form)


def _number(kind: type, least: int):
    def parse(text: str):
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not least <= value < math.inf:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {kind.__name__} of at least {least}")
        return value

    return parse


def _read_config(path: Path) -> list[str]:
    """The file's values as words of a command line, checked by the same parser."""
    if not path.is_file():
        raise FileNotFoundError(f"config: no such file: {path}")

    def refuse(message: str):
        raise ValueError(f"config {path}: {message}")

    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        refuse(f"not valid YAML: {' '.join(str(error).split())}")
    if not isinstance(values, dict):
        refuse("expected lines of the form `key: value`")
    known = {
        key: f for kind in (PrepareArguments, PrepareSettings, *PARTS.values()) for key, f in _options(kind).items()
    }
    words = []
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1)
            refuse(f"unknown key {key!r}" + (f"; did you mean {near[0]}?" if near else ""))
        flag = isinstance(known[key].default, bool)
        if isinstance(value, list | dict) or flag != isinstance(value, bool):
            refuse(f"{key}: {value!r}; expected {'true or false' if flag else 'one value'}")
        if flag:
            words.append(f"--{key}" if value else f"--no_{key}")
        elif value is not None:
            words.append(f"--{key}={value}")
    parser = _parser()
    parser.error = refuse
    parser.parse_args(["RAW", "OUT", *words])
    return words
