"""`gift-peft export`: its options. `export` beside it does the work."""

from collections.abc import Sequence

from gift_peft.options import OptionParser


def make_parser() -> OptionParser:
    parser = OptionParser(
        "export",
        "A dataset as parquet shards with a card, to share or stream.",
        "gift-peft export gift-i gift-i-parquet --license cc-by-4.0",
    )
    parser.add_argument("dataset", metavar="OUT", help="GIFT-I, for example what `gift-peft prepare` wrote")
    parser.add_argument("folder", metavar="DST", help="new folder; upload it with `hf upload`")
    parser.add_argument("--format", choices=["parquet"], default="parquet", help="of the files")
    parser.add_argument("--max-shard-size", default="500MB", metavar="SIZE", help="for example 1GB")
    parser.add_argument("--license", metavar="ID", help="for the card; default: what the dataset's card states")
    return parser


def run(argv: Sequence[str]) -> int:
    args = make_parser().parse_args(argv)
    from gift_peft.dataset.export import export_parquet

    print(f"Dataset: {export_parquet(args.dataset, args.folder, args.max_shard_size, args.license)}")
    return 0
