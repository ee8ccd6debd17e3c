"""`gift-peft proxies`: its options. `teacher` beside it does the work."""

from collections.abc import Sequence

from gift_peft.options import OptionParser, add_base, add_dataset


def make_parser() -> OptionParser:
    parser = OptionParser(
        "proxies",
        "Keep the frozen model's predictions for a dataset.",
        "gift-peft proxies --base depth-anything/Depth-Anything-V2-Small-hf --dataset gift-i",
    )
    add_base(parser)
    add_dataset(parser)
    parser.add_argument("--splits", nargs="+", metavar="SPLIT", help="default: all")
    parser.add_argument("--proxies-dir", metavar="DIR", help="default: DATASET/proxies")
    parser.add_argument("--overwrite", action="store_true", help="make every proxy again")
    return parser


def run(argv: Sequence[str]) -> int:
    args = make_parser().parse_args(argv)
    from gift_peft.training.teacher import make_proxies

    folder = make_proxies(
        args.base,
        args.dataset,
        splits=args.splits,
        size=args.size,
        proxies_dir=args.proxies_dir,
        revision=args.revision,
        overwrite=args.overwrite,
    )
    print(f"Proxies: {folder}")
    return 0
