"""`gift-peft prepare`: what it prints. Its options are the settings, `prepare` beside it does the work."""

import sys
from collections.abc import Sequence
from pathlib import Path

from gift_peft.prepare.settings import make_parser, parse_arguments

__all__ = ["make_parser", "run"]


def run(argv: Sequence[str]) -> int:
    """Prepare, and say in a few lines what came of it."""
    args = parse_arguments(argv)
    from gift_peft.prepare.prepare import prepare_gift_i

    report = prepare_gift_i(
        args.raw,
        args.out,
        args.settings,
        num_proc=args.num_proc,
        license=args.license,
        pretty_name=args.pretty_name,
    )
    for entry in report["groups"]:
        if entry["status"] == "rejected":
            text = entry["reasons"][0]["text"]
            print(f"gift-peft: rejected: {entry['split']}/{entry['group_id']}: {text}", file=sys.stderr)
    for split, found in report["statistics"].items():
        print(
            f"{split}: {found['groups']} groups, {found['images']} images ({found['warped_frames']} frames warped, "
            f"{found['dropped_frames']} dropped), {found['references']} references, "
            f"{found['rejected_groups']} groups rejected"
        )
    print(f"Report: {Path(args.out) / 'report.html'}")
    kept = sum(found["groups"] for found in report["statistics"].values())
    if not kept:
        raise ValueError(f"no group could be prepared; {Path(args.out) / 'report.html'} says why")
    return 0 if kept == len(report["groups"]) else 3
