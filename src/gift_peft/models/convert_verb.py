"""`gift-peft convert`: its options. `convert` beside it does the work."""

from collections.abc import Sequence

from gift_peft.options import OptionParser, number


def make_parser() -> OptionParser:
    parser = OptionParser(
        "convert",
        "Official VGGT, Metric3D V2, MoGe or MoGe-2 weights to a transformers folder.",
        "gift-peft convert vggt facebook/VGGT-1B vggt",
    )
    parser.add_argument("architecture", choices=["vggt", "metric3d", "moge"], help="whose weights they are")
    text = "official .safetensors, .pt or .pth file, or hub id (owner/repo or owner/repo/file)"
    parser.add_argument("source", metavar="SRC", help=text)
    parser.add_argument("folder", metavar="DST", help="new folder")
    parser.add_argument("--config", metavar="FILE", help="JSON of other sizes than the released ones")
    text = "MoGe: patches of a picture at its vision transformer; default: the most it was trained for"
    parser.add_argument("--num-tokens", type=number(int, 1), metavar="N", help=text)
    return parser


def run(argv: Sequence[str]) -> int:
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.num_tokens is not None and args.architecture != "moge":
        parser.error("--num-tokens is of MoGe")
    from gift_peft.models.convert import CONVERTERS

    options = {} if args.num_tokens is None else {"num_tokens": args.num_tokens}
    print(f"Model: {CONVERTERS[args.architecture](args.source, args.folder, args.config, **options)}")
    return 0
