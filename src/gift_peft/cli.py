"""`gift-peft VERB`: which module does what. Each verb's options and work stand in its own module, imported when asked
for; exit codes are those of `options.run_verb`."""

import argparse
import platform
import sys
from collections.abc import Sequence
from importlib import import_module

from gift_peft.options import did_you_mean, package_version, run_verb

VERBS = {
    "demo": ("demo.demo_verb", "train and evaluate the embedded model on the embedded groups"),
    "prepare": ("prepare.prepare_verb", "from a folder of photos to a checked dataset, with a report"),
    "capture": ("prepare.capture_verb", "a coach at the camera, which takes the photos of a group by itself"),
    "synthesize": ("prepare.synthesize_verb", "groups from single photos: painted copies of each"),
    "export": ("dataset.export_verb", "a dataset as parquet shards with a card, to share or stream"),
    "proxies": ("training.proxies_verb", "keep the frozen model's predictions for a dataset"),
    "train": ("training.__main__", "fine-tune a model on groups of images into an adapter"),
    "evaluate": ("deploy.evaluate_verb", "compare base and adapter on validation groups, or on a benchmark"),
    "predict": ("predict", "depth of pictures, beside the base's"),
    "deploy": ("deploy.deploy_verb", "an adapter and its base as one model that runs elsewhere"),
    "report": ("reports.report_verb", "tables, figures and model card of runs, from what they left behind"),
    "convert": ("models.convert_verb", "official VGGT, Metric3D V2 or MoGe weights to a transformers folder"),
}
PACKAGES = ("torch", "transformers", "peft", "accelerate", "datasets")


def main(argv: Sequence[str] | None = None) -> None:
    """Run a verb and leave through `sys.exit`."""
    argv = sys.argv[1:] if argv is None else argv
    parser = _parser()
    if argv and not argv[0].startswith("-") and argv[0] not in VERBS:
        parser.error(f"unknown verb {argv[0]!r}{did_you_mean(argv[0], VERBS)} (gift-peft --help lists them)")
    module, _ = VERBS[parser.parse_args(argv[:1]).verb]
    sys.exit(run_verb(lambda words: import_module(f"gift_peft.{module}").run(words), argv[1:]))


def _parser() -> argparse.ArgumentParser:
    """Of the first word; the rest is the verb's."""
    parser = argparse.ArgumentParser(
        prog="gift-peft",
        description="Teach the depth model you already use to see mirrors and glass.",
        epilog="example: gift-peft demo --out demo; `gift-peft VERB --help` has an example of each verb",
        allow_abbrev=False,
    )
    parser.add_argument(
        "-V", "--version", action=_Version, help="print the versions of gift-peft and what it stands on"
    )
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for verb, (_, text) in VERBS.items():
        verbs.add_parser(verb, help=text, add_help=False)
    return parser


class _Version(argparse.Action):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, nargs=0, **kwargs)

    def __call__(self, parser, namespace, values, option_string=None):
        print(f"gift-peft {package_version('gift-peft')}\npython {platform.python_version()}")
        for name in PACKAGES:
            print(f"{name} {package_version(name)}")
        parser.exit()
