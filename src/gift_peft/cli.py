"""`gift-peft`: one verb per step. Thin: the work lives in the modules that own it, imported when it is asked for.

An error of ours is one line on stderr and exit code 1; wrong usage of a verb is argparse's 2; a run stopped by Ctrl-C
or SIGTERM ends with 130 or 143, as a shell expects. `--debug` or GIFT_PEFT_DEBUG=1 shows the traceback.
"""

import argparse
import os
import sys
import warnings
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> None:
    """Run a verb and leave through `sys.exit`."""
    parser = _parser()
    args, rest = parser.parse_known_args(argv)
    if rest and args.verb not in ("demo", "prepare", "train"):
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    debug = args.debug or os.environ.get("GIFT_PEFT_DEBUG", "0") not in ("", "0")
    try:
        if not debug:
            _quiet()
        code = args.run(args, rest)
    except KeyboardInterrupt:
        print("gift-peft: stopped", file=sys.stderr)
        code = 130
    except (ValueError, OSError) as error:
        if debug:
            raise
        print(f"gift-peft: error: {' '.join(str(error).split())}", file=sys.stderr)
        code = 1
    sys.exit(code)


def _parser() -> argparse.ArgumentParser:
    debug = argparse.ArgumentParser(add_help=False)
    debug.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser = argparse.ArgumentParser(
        prog="gift-peft",
        description="Teach the depth model you already use to see mirrors and glass.",
        allow_abbrev=False,
    )
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name, run, text, **options):
        sub = verbs.add_parser(name, parents=[debug], help=text, description=text, allow_abbrev=False, **options)
        sub.set_defaults(run=run, usage_error=sub.error)
        return sub

    demo = verb(
        "demo", _demo, "train and evaluate the embedded model on the embedded groups; more options go to train"
    )
    demo.add_argument("--out", default="demo", help="folder for adapter, table and pictures (default: demo)")
    demo.add_argument("--seed", type=int, default=0)
    demo.add_argument("--overwrite_output_dir", action="store_true", help="delete an earlier demo in --out")

    proxies = verb("proxies", _proxies, "keep the frozen model's predictions for a dataset")
    _add_model_and_data(proxies)
    proxies.add_argument("--splits", nargs="+", metavar="SPLIT", help="default: all")
    proxies.add_argument("--proxies_dir", help="default: DATASET/proxies")
    proxies.add_argument("--overwrite", action="store_true", help="make every proxy again")

    export = verb("export", _export, "a dataset as parquet shards with a card, to share or stream")
    export.add_argument("dataset", metavar="OUT", help="GIFT-I, for example what `gift-peft prepare` wrote")
    export.add_argument("folder", metavar="DST", help="new folder; upload it with `hf upload`")
    export.add_argument("--format", choices=["parquet"], default="parquet")
    export.add_argument("--max-shard-size", default="500MB", metavar="SIZE", help="for example 1GB (default: 500MB)")
    export.add_argument("--license", help="for the card; default: the one that the dataset's card states")

    # Their own parsers know the arguments (`gift-peft prepare --help`).
    verb("prepare", _prepare, "from a folder of photos to a checked dataset, with a report", add_help=False)
    verb("train", _train, "fine-tune a model on groups of images into an adapter", add_help=False)

    evaluate = verb("evaluate", _evaluate, "compare base and adapter on validation groups, or on Booster")
    _add_model(evaluate, required=False)
    evaluate.add_argument("--dataset", help="GIFT-I: raw tree, prepared folder, parquet release or hub id")
    _add_adapter(evaluate)
    evaluate.add_argument("--dataset_revision", help="branch, tag or commit of a hub dataset")
    evaluate.add_argument("--split", default="validation")
    evaluate.add_argument("--reference", choices=["proxy", "depth"], default="proxy", help="what to compare with")
    evaluate.add_argument("--protocol", help="default: native against proxies, gift against depth")
    evaluate.add_argument("--list-protocols", action=_ListProtocols, help="print what each does, and its source")
    evaluate.add_argument("--prediction_scale", type=float, help="to mm, for protocols that fit no scale")
    evaluate.add_argument("--out", default="evaluation", help="folder for metrics.json, rows.jsonl, report.md")
    booster = evaluate.add_argument_group("Booster")
    booster.add_argument("--booster", metavar="ROOT", help="evaluate on Booster instead of GIFT-I")
    booster.add_argument("--predictions", metavar="DIR", help="stored predictions in place of --base")
    booster.add_argument("--resize", type=float, default=0.25, help="of the ground truth (default: 0.25)")
    booster.add_argument("--occlusion", choices=["all", "noc"], default="all", help="noc: what both cameras see")
    booster.add_argument("--subset", choices=["balanced", "unbalanced"], help="default: balanced, else what there is")
    booster.add_argument("--partial", action="store_true", help="an incomplete official set is wanted as it is")

    predict = verb("predict", _predict, "depth of pictures, beside the base's")
    predict.add_argument("images", nargs="+", metavar="IMAGE", help="picture files or folders of them")
    _add_model(predict)
    _add_adapter(predict)
    predict.add_argument(
        "--focal-length", type=float, metavar="PIXELS", help="of the camera that took the pictures, for Metric3D"
    )
    predict.add_argument("--out", required=True, help="folder for the npy and png files")
    report = verb("report", _report, "tables, figures and model card of runs, from what they left behind")
    report.add_argument("runs", nargs="+", metavar="RUN", help="folder of a run or of an evaluation")
    report.add_argument("--out", help="default: RUN/report, for several runs ./report")
    report.add_argument(
        "--model-card",
        "--model_card",
        nargs="?",
        const=True,
        metavar="FILE",
        help="also write the model card (default: OUT/model_card.md); RUN may then be the YAML file of a run to come",
    )
    report.add_argument("--panels", type=int, default=3, help="rows of the before/after figure; 0: no pictures")
    report.add_argument(
        "--zero-shot", "--zero_shot", nargs="+", default=[], metavar="IMAGE", help="pictures for base and checkpoints"
    )
    report.add_argument(
        "--steps", type=int, nargs="+", default=[], help="checkpoints of --zero-shot; default: kept ones"
    )

    convert = verb("convert", _convert, "official VGGT or Metric3D V2 weights to a transformers folder")
    convert.add_argument("architecture", choices=["vggt", "metric3d"])
    convert.add_argument(
        "source",
        metavar="SRC",
        help="official .safetensors, .pt or .pth file, or hub id (owner/repo or owner/repo/file)",
    )
    convert.add_argument("folder", metavar="DST", help="new folder")
    convert.add_argument("--config", metavar="FILE", help="JSON of other sizes than the released ones")
    return parser


class _ListProtocols(argparse.Action):
    """Prints the protocols and ends, whatever else is asked for."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, nargs=0, **kwargs)

    def __call__(self, parser, namespace, values, option_string=None):
        from gift_peft.evaluation.protocols import list_protocols

        print(list_protocols())
        parser.exit()


def _add_model(parser: argparse.ArgumentParser, required: bool = True) -> None:
    parser.add_argument("--base", required=required, help="base model: hub id or folder")
    parser.add_argument("--revision", help="branch, tag or commit of the base model")
    parser.add_argument("--size", metavar="HxW", help="at the network; default: the adapter's, else the recipe's")


def _add_model_and_data(parser: argparse.ArgumentParser) -> None:
    _add_model(parser)
    parser.add_argument(
        "--dataset", required=True, help="GIFT-I: raw tree, prepared folder, parquet release or hub id"
    )


def _add_adapter(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--adapter", help="adapter: hub id or folder")
    parser.add_argument("--adapter-scale", type=float, help="0 is the base, 1 the adapter")
    parser.add_argument("--kind", choices=["depth", "inverse_depth"], help="what is predicted, if no recipe says it")


def _demo(args: argparse.Namespace, rest: list[str]) -> int:
    from gift_peft.demo.run import run_demo

    run_demo(out=args.out, overwrite_output_dir=args.overwrite_output_dir, seed=args.seed, extra=rest)
    return 0


def _proxies(args: argparse.Namespace, rest: list[str]) -> int:
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


def _prepare(args: argparse.Namespace, rest: list[str]) -> int:
    from gift_peft.prepare.settings import run

    return run(rest)


def _export(args: argparse.Namespace, rest: list[str]) -> int:
    from gift_peft.dataset.export import export_parquet

    folder = export_parquet(args.dataset, args.folder, args.max_shard_size, args.license)
    print(f"Dataset: {folder}")
    return 0


def _train(args: argparse.Namespace, rest: list[str]) -> int:
    from gift_peft.training.arguments import parse_arguments

    arguments = parse_arguments(rest)
    from gift_peft.training import train  # after the arguments are known to be right: this takes seconds

    result = train(arguments)
    return 128 + result.signal if result.signal else 0


def _evaluate(args: argparse.Namespace, rest: list[str]) -> int:
    if (args.dataset is None) == (args.booster is None):
        args.usage_error("one of --dataset and --booster is required")
    if (args.base is None) == (args.predictions is None):
        args.usage_error("one of --base and --predictions is required")
    if args.predictions and (args.dataset or args.adapter):
        args.usage_error("--predictions go with --booster, and without --adapter")
    from gift_peft.evaluation.verb import run_booster, run_evaluation

    common = {
        "out": args.out,
        "adapter_scale": args.adapter_scale,
        "size": args.size,
        "kind": args.kind,
        "revision": args.revision,
        "prediction_scale": args.prediction_scale,
        "color": sys.stdout.isatty() and "NO_COLOR" not in os.environ,
    }
    if args.booster:
        run_booster(
            args.booster,
            args.base,
            args.adapter,
            predictions=args.predictions,
            protocol=args.protocol or "gift",
            resize=args.resize,
            occlusion=args.occlusion,
            subset=args.subset,
            official=False if args.partial else None,
            **common,
        )
        return 0
    run_evaluation(
        args.base,
        args.dataset,
        args.adapter,
        reference=args.reference,
        protocol=args.protocol,
        split=args.split,
        dataset_revision=args.dataset_revision,
        **common,
    )
    return 0


def _predict(args: argparse.Namespace, rest: list[str]) -> int:
    from gift_peft.predict import predict_images

    files = predict_images(
        args.images,
        args.base,
        args.adapter,
        args.adapter_scale,
        out=args.out,
        size=args.size,
        kind=args.kind,
        revision=args.revision,
        focal_length=args.focal_length,
    )
    print(f"Depth maps written to {args.out}: {len(files)}")
    return 0


def _report(args: argparse.Namespace, rest: list[str]) -> int:
    from gift_peft.reports.report import run_report

    run_report(
        args.runs,
        args.out,
        card=args.model_card or False,
        zero_shot=args.zero_shot,
        steps=args.steps,
        panels=args.panels,
        color=sys.stdout.isatty() and "NO_COLOR" not in os.environ,
    )
    return 0


def _convert(args: argparse.Namespace, rest: list[str]) -> int:
    from gift_peft.models.convert import CONVERTERS

    folder = CONVERTERS[args.architecture](args.source, args.folder, args.config)
    print(f"Model: {folder}")
    return 0


def _quiet() -> None:
    """Our own lines and bars are enough; those of the libraries come back with --debug."""
    os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")
    warnings.filterwarnings("ignore", category=FutureWarning)  # between transformers and peft, nothing a user can do
    warnings.formatwarning = lambda message, *_, **__: f"gift-peft: warning: {message}\n"
    if not sys.stderr.isatty():  # on a terminal the bars of a download are wanted
        import datasets
        import huggingface_hub

        datasets.disable_progress_bars()
        huggingface_hub.utils.disable_progress_bars()
