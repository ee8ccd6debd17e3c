"""`gift-peft convert`: its options. `convert` beside it does the work."""

from collections.abc import Sequence

from gift_peft.options import OptionParser


def make_parser() -> OptionParser:
    parser = OptionParser(
        "convert",
        "Official VGGT or Metric3D V2 weights to a transformers folder.",
        "gift-peft convert vggt facebook/VGGT-1B vggt",
    )
    parser.add_argument("architecture", choices=["vggt", "metric3d"], help="whose weights they are")
    text = "official .safetensors, .pt or .pth file, or hub id (owner/repo or owner/repo/file)"
    parser.add_argument("source", metavar="SRC", help=text)
    parser.add_argument("folder", metavar="DST", help="new folder")
    parser.add_argument("--config", metavar="FILE", help="JSON of other sizes than the released ones")
    return parser


def run(argv: Sequence[str]) -> int:
    args = make_parser().parse_args(argv)
    from gift_peft.models.convert import CONVERTERS

    print(f"Model: {CONVERTERS[args.architecture](args.source, args.folder, args.config)}")
    return 0
