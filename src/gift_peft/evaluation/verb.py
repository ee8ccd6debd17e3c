"""`gift-peft evaluate`: load, evaluate, print the table, leave the files.

One of four: groups of GIFT-I, Booster, LayeredDepth's first layer, MD-3k.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gift_peft.evaluation.protocols import get_protocol, list_protocols
from gift_peft.files import write_whole
from gift_peft.options import OptionParser, add_adapter, add_base, add_dataset, use_color

if TYPE_CHECKING:
    from gift_peft.evaluation.orderings import OrderingReport
    from gift_peft.evaluation.results import Report
    from gift_peft.models.loading import DepthModel

DATASETS = ("dataset", "booster", "layereddepth", "md3k")  # options, of which one is given


def run_evaluation(
    base: str | Path | None,
    dataset: str | Path | None = None,
    adapter: str | Path | None = None,
    *,
    booster: str | Path | None = None,
    predictions: str | Path | None = None,
    split: str = "validation",
    dataset_revision: str | None = None,
    out: str | Path = "evaluation",
    adapter_scale: float | None = None,
    size: str | tuple[int, int] | None = None,
    kind: str | None = None,
    revision: str | None = None,
    device: str | None = None,
    accept_base: bool = False,
    color: bool = False,
    **options: Any,
) -> "Report":
    """`gift-peft evaluate`: loads, evaluates, prints the table, writes `metrics.json`, `rows.jsonl`, `report.md`.

    Args:
        base, adapter, adapter_scale, revision, size, kind, device, accept_base: as in `DepthModel.from_pretrained`;
            `base` is None where the adapter names it, or stored `predictions` stand in for it.
        dataset, split, dataset_revision: of GIFT-I, as in `load_gift_i`; or `booster`, the root of Booster.
        out: folder of the files.
        color: of the table printed.
        options: further arguments of `evaluate_gift_i`, or of `evaluate_booster`.
    """
    from gift_peft.dataset.gift_i import load_gift_i
    from gift_peft.evaluation.booster_scenes import find_booster
    from gift_peft.evaluation.evaluate import evaluate_booster, evaluate_gift_i
    from gift_peft.evaluation.tables import markdown_table, text_table

    _check_place(Path(out))
    if booster:  # fail early: large weights take minutes to load
        get_protocol(options.get("protocol", "gift"))
        find_booster(booster, options.get("subset"), options.get("official"))
    model, about = _load(base, adapter, adapter_scale, revision, size, kind, device, accept_base)
    if booster:
        report = evaluate_booster(booster, model, predictions, kind if model is None else None, **options)
    elif dataset is None:
        raise ValueError("an evaluation needs a dataset, or the root of Booster")
    else:
        groups = load_gift_i(dataset, split, dataset_revision=dataset_revision)
        report = evaluate_gift_i(groups, model, **options)
        report.about = {"dataset": str(dataset), "dataset_revision": dataset_revision, "split": split}
    if model is not None:
        report.about |= about | {"kind": model.kind}
    folder = report.save(out)
    write_whole(folder / "report.md", markdown_table(report))
    print(text_table(report, color=color))
    print(f"Written: {folder}/metrics.json, rows.jsonl, report.md")
    return report


def _load(
    base, adapter, adapter_scale, revision, size, kind, device, accept_base
) -> tuple["DepthModel | None", dict[str, Any]]:
    """The model and what a report says about it; neither where stored predictions stand in for it."""
    from gift_peft.models.adapter_base import find_base
    from gift_peft.models.loading import DepthModel

    if base is None and adapter is not None:
        base, revision = find_base(None, adapter, revision)
    if base is None:
        return None, {}
    model = DepthModel.from_pretrained(base, adapter, adapter_scale, revision, size, kind, device, accept_base)
    about = {"base": str(base), "revision": revision, "adapter": adapter and str(adapter)}
    return model, about | {"adapter_scale": adapter_scale, "size": list(model.size)}


def _check_place(folder: Path) -> None:
    """Raise ValueError if the folder's files of these names are not those of an evaluation."""
    there = [name for name in ("metrics.json", "rows.jsonl", "report.md") if (folder / name).exists()]
    try:
        first = (folder / ("metrics.json" if "metrics.json" in there else "rows.jsonl")).read_text(encoding="utf-8")
        known = json.loads(first if "metrics.json" in there else first.partition("\n")[0]).keys()
    except (OSError, ValueError, AttributeError):
        known = set()
    if there and not (known >= {"counts", "summary"} or known >= {"group_id", "image"}):
        raise ValueError(
            f"--out {folder}: its {', '.join(there)} is of no evaluation and is kept; name another folder"
        )


def run_orderings(
    name: str,
    root: str | Path,
    base: str | Path | None,
    adapter: str | Path | None = None,
    *,
    predictions: str | Path | None = None,
    out: str | Path = "evaluation",
    adapter_scale: float | None = None,
    size: str | tuple[int, int] | None = None,
    kind: str | None = None,
    revision: str | None = None,
    device: str | None = None,
    accept_base: bool = False,
    color: bool = False,
    **options: Any,
) -> "OrderingReport":
    """`gift-peft evaluate --layereddepth ROOT` and `--md3k ROOT`; arguments as in `run_evaluation`.

    `name` is `layereddepth` or `md3k`; `options` are further arguments of its evaluator.
    """
    from gift_peft.evaluation.layered_depth import evaluate_layered_depth, find_layered_depth
    from gift_peft.evaluation.md3k import evaluate_md3k, read_md3k
    from gift_peft.evaluation.ordering_tables import ordering_markdown, ordering_text

    _check_place(Path(out))
    evaluate = {"layereddepth": evaluate_layered_depth, "md3k": evaluate_md3k}[name]
    if base is not None or adapter is not None:  # fail early: large weights take minutes to load
        read_md3k(root) if name == "md3k" else find_layered_depth(root, options.get("partial", False))
    model, about = _load(base, adapter, adapter_scale, revision, size, kind, device, accept_base)
    report = evaluate(root, model, predictions, kind if model is None else None, **options)
    report.about |= about
    folder = report.save(out)
    write_whole(folder / "report.md", ordering_markdown(report))
    print(ordering_text(report, color=color))
    print(f"Written: {folder}/metrics.json, rows.jsonl, report.md")
    return report


def make_parser() -> OptionParser:
    parser = OptionParser(
        "evaluate",
        "Compare base and adapter on validation groups, or on a public benchmark.",
        "gift-peft evaluate --base demo/base --adapter demo/adapter --dataset demo/gift-i",
    )
    add_base(parser, required=False)
    add_dataset(parser, required=False)
    add_adapter(parser)
    parser.add_argument("--dataset-revision", metavar="REVISION", help="branch, tag or commit of a hub dataset")
    parser.add_argument("--split", default="validation", help="of GIFT-I")
    parser.add_argument("--reference", choices=["proxy", "depth"], default="proxy", help="what to compare with")
    parser.add_argument("--protocol", metavar="NAME", help="default: native against proxies, gift against depth")
    parser.add_argument("--list-protocols", action="store_true", help="print what each does, and its source")
    parser.add_argument("--prediction-scale", type=float, metavar="X", help="to mm, for protocols that fit no scale")
    parser.add_argument(
        "--out", "--output-dir", default="evaluation", metavar="DIR", help="for metrics.json, rows.jsonl, report.md"
    )
    booster = parser.add_argument_group("Booster")
    booster.add_argument("--booster", metavar="ROOT", help="evaluate on Booster instead of GIFT-I")
    text = "stored predictions in place of --base (of any benchmark)"
    booster.add_argument("--predictions", metavar="DIR", help=text)
    booster.add_argument("--resize", type=float, default=0.25, metavar="X", help="of the ground truth")
    booster.add_argument("--occlusion", choices=["all", "noc"], default="all", help="noc: what both cameras see")
    booster.add_argument("--subset", choices=["balanced", "unbalanced"], help="default: balanced, else what there is")
    booster.add_argument("--partial", action="store_true", help="an incomplete official set is wanted as it is")
    orderings = parser.add_argument_group("which point is nearer, on glass")
    orderings.add_argument("--layereddepth", metavar="ROOT", help="evaluate on LayeredDepth's first layer")
    orderings.add_argument("--md3k", metavar="ROOT", help="evaluate the layer preference on MD-3k")
    text = "the adapter's layer dial: also at these scales (default: -1 to 1 in quarters; 0 is the base)"
    orderings.add_argument("--dial", nargs="*", type=float, metavar="S", help=text)
    return parser


def run(argv: Sequence[str]) -> int:
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.list_protocols:
        print(list_protocols())
        return 0
    named = [name for name in DATASETS if getattr(args, name) is not None]
    if len(named) != 1:
        parser.error("one of --dataset, --booster, --layereddepth and --md3k is required")
    if (args.base is None and args.adapter is None) == (args.predictions is None):
        parser.error("one of --base, --adapter and --predictions is required")
    if args.predictions and (args.dataset or args.adapter):
        parser.error("--predictions go with a benchmark, and without --adapter")
    if args.dial is not None and (not args.adapter or named[0] not in ("layereddepth", "md3k")):
        parser.error("--dial turns an --adapter on --md3k or --layereddepth")
    if named[0] in ("layereddepth", "md3k") and (args.protocol or args.prediction_scale):
        parser.error("--protocol and --prediction-scale align depth; --layereddepth and --md3k ask for an order alone")
    names = ("adapter_scale", "size", "kind", "revision", "out", "predictions", "accept_base")
    model = {name: getattr(args, name) for name in names}
    if named[0] in ("layereddepth", "md3k"):
        from gift_peft.evaluation.orderings import DIAL_SCALES

        options = {"dial": args.dial or (DIAL_SCALES if args.dial is not None else ()), "color": use_color()}
        options |= {"partial": args.partial} if args.layereddepth else {}
        run_orderings(named[0], getattr(args, named[0]), args.base, args.adapter, **model, **options)
        return 0
    options: dict[str, Any] = {"prediction_scale": args.prediction_scale, "color": use_color()}
    if args.booster:
        options |= {"resize": args.resize, "occlusion": args.occlusion, "subset": args.subset}
        options |= {"protocol": args.protocol or "gift", "official": False if args.partial else None}
    else:
        options |= {"reference": args.reference, "protocol": args.protocol}
    run_evaluation(
        args.base,
        args.dataset,
        args.adapter,
        booster=args.booster,
        split=args.split,
        dataset_revision=args.dataset_revision,
        **model,
        **options,
    )
    return 0
