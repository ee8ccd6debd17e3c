"""`gift-peft report`: its options. `report` beside it does the work."""

from collections.abc import Sequence

from gift_peft.options import OptionParser, use_color


def make_parser() -> OptionParser:
    parser = OptionParser(
        "report",
        "Tables, figures and model card of runs, from what they left behind.",
        "gift-peft report run --model-card --zero-shot photo.jpg",
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="folder of a run or of an evaluation")
    parser.add_argument("--out", "--output-dir", metavar="DIR", help="default: RUN/report, for several runs ./report")
    text = "also write the model card (default: OUT/model_card.md); RUN may then be the YAML file of a run to come"
    parser.add_argument("--model-card", nargs="?", const=True, default=False, metavar="FILE", help=text)
    parser.add_argument("--panels", type=int, default=3, metavar="N", help="rows of before and after; 0: no pictures")
    text = "pictures for base and checkpoints"
    parser.add_argument("--zero-shot", nargs="+", default=[], metavar="IMAGE", help=text)
    text = "checkpoints of --zero-shot; default: kept ones"
    parser.add_argument("--steps", type=int, nargs="+", default=[], metavar="STEP", help=text)
    return parser


def run(argv: Sequence[str]) -> int:
    args = make_parser().parse_args(argv)
    from gift_peft.reports.report import run_report

    run_report(
        args.runs,
        args.out,
        card=args.model_card,
        zero_shot=args.zero_shot,
        steps=args.steps,
        panels=args.panels,
        color=use_color(),
    )
    return 0
