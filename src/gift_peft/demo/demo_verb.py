"""`gift-peft demo`: its options. `run` beside it does the work."""

from collections.abc import Sequence

from gift_peft.options import OptionParser


def make_parser() -> OptionParser:
    parser = OptionParser(
        "demo",
        "Train and evaluate the embedded model on the embedded groups. More options go to `gift-peft train`.",
        "gift-peft demo --out demo",
    )
    parser.add_argument(
        "--out", "--output-dir", default="demo", metavar="DIR", help="folder for adapter, table and pictures"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument(
        "--target",
        choices=("consensus", "surface"),
        help="only this: the paper's objective, or surface targets; default both, one after the other",
    )
    parser.add_argument("--overwrite-output-dir", action="store_true", help="delete an earlier demo in --out")
    return parser


def run(argv: Sequence[str]) -> int:
    args, rest = make_parser().parse_known_args(argv)
    from gift_peft.demo.run import run_demo

    run_demo(
        out=args.out, overwrite_output_dir=args.overwrite_output_dir, seed=args.seed, target=args.target, extra=rest
    )
    return 0
