"""`gift-peft synthesize`: its options, and what it says at the end. `synthesize.py` does the work."""

import sys
from collections.abc import Sequence
from pathlib import Path

from gift_peft.options import OptionParser, number

DESCRIPTION = """Groups for training from single photos: each photo, and copies with a target of one plain color.

Groups with a treated reference or in validation/ are skipped. Exit code: 0 if all other photos are in OUT, 3 if some
were rejected, 1 if none could be painted, 2 for a wrong command line. Run again, it does what is left to do.
What is known about such groups, and what is not: docs/capture.md."""


def make_parser() -> OptionParser:
    parser = OptionParser("synthesize", DESCRIPTION, "gift-peft synthesize my-photos painted --num-proc 2")
    text = "raw tree, or a flat folder of photos with masks/<name>.png; it is only read"
    parser.add_argument("photos", metavar="PHOTOS", help=text)
    parser.add_argument("out", metavar="OUT", help="raw tree with a train split: new, or made by this command before")
    parser.add_argument("--fills", type=number(int, 1), default=3, metavar="N", help="painted copies of each photo")
    parser.add_argument("--seed", type=number(int, 0), default=0, metavar="N", help="of the colors")
    parser.add_argument("--num-proc", type=number(int, 1), default=1, metavar="N", help="photos painted side by side")
    return parser


def run(argv: Sequence[str]) -> int:
    """Paint, say in a few lines what came of it, and return the exit code.

    Raises ValueError or an OSError (one line) where nothing could be made.
    """
    args = make_parser().parse_args(argv)
    from gift_peft.prepare.synthesize import synthesize_groups

    report = synthesize_groups(args.photos, args.out, args.fills, args.seed, args.num_proc)
    for what, found in (("skipped", report.skipped), ("rejected", report.rejected)):
        for name, why in found.items():
            print(f"gift-peft: {what}: {name}: {why}", file=sys.stderr)
    if not report.groups:
        raise ValueError(f"PHOTOS {args.photos}: no photo could be painted")
    before = len(report.groups) - len(report.made)
    print(
        f"{Path(args.out) / 'train'}: {len(report.groups)} groups, a photo and {args.fills} painted "
        f"{'copy' if args.fills == 1 else 'copies'} each ({len(report.made)} made, {before} there before, "
        f"{len(report.removed)} removed)"
    )
    return 3 if report.rejected else 0
