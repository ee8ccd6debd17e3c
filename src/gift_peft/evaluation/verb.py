"""`gift-peft evaluate`: load, evaluate, print the table, leave the files."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gift_peft.evaluation.protocols import get_protocol, list_protocols
from gift_peft.files import write_whole
from gift_peft.options import OptionParser, add_adapter, add_base, add_dataset, use_color

if TYPE_CHECKING:
    from gift_peft.evaluation.results import Report


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
    from gift_peft.models.adapter_base import find_base
    from gift_peft.models.loading import DepthModel

    _check_place(Path(out))
    if booster:  # fail early: large weights take minutes to load
        get_protocol(options.get("protocol", "gift"))
        find_booster(booster, options.get("subset"), options.get("official"))
    if base is None and adapter is not None:
        base, revision = find_base(None, adapter, revision)
    model = (
        None
        if base is None
        else DepthModel.from_pretrained(base, adapter, adapter_scale, revision, size, kind, device, accept_base)
    )
    if booster:
        report = evaluate_booster(booster, model, predictions, kind if model is None else None, **options)
    elif dataset is None:
        raise ValueError("an evaluation needs a dataset, or the root of Booster")
    else:
        groups = load_gift_i(dataset, split, dataset_revision=dataset_revision)
        report = evaluate_gift_i(groups, model, **options)
        report.about = {"dataset": str(dataset), "dataset_revision": dataset_revision, "split": split}
    if model is not None:
        report.about |= {
            "base": str(base),
            "revision": revision,
            "adapter": adapter and str(adapter),
            "adapter_scale": adapter_scale,
            "size": list(model.size),
            "kind": model.kind,
        }
    folder = report.save(out)
    write_whole(folder / "report.md", markdown_table(report))
    print(text_table(report, color=color))
    print(f"Written: {folder}/metrics.json, rows.jsonl, report.md")
    return report


def _check_place(folder: Path) -> None:
    """Raise ValueError if the folder's files of these names are not those of an evaluation."""
    there = [name for name in ("metrics.json", "rows.jsonl", "report.md") if (folder / name).exists()]
    try:
        first = (folder / ("metrics.json" if "metrics.json" in there else "rows.jsonl")).read_text(encoding="utf-8")
        known = json.loads(first if "metrics.json" in there else first.partition("\n")[0]).keys()
    except (OSError, ValueError, AttributeError):
        known = set()
    if there and not (known >= {"protocol", "summary"} or known >= {"group_id", "image"}):
        raise ValueError(
            f"--out {folder}: its {', '.join(there)} is of no evaluation and is kept; name another folder"
        )


def make_parser() -> OptionParser:
    parser = OptionParser(
        "evaluate",
        "Compare base and adapter on validation groups, or on Booster.",
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
    booster.add_argument("--predictions", metavar="DIR", help="stored predictions in place of --base")
    booster.add_argument("--resize", type=float, default=0.25, metavar="X", help="of the ground truth")
    booster.add_argument("--occlusion", choices=["all", "noc"], default="all", help="noc: what both cameras see")
    booster.add_argument("--subset", choices=["balanced", "unbalanced"], help="default: balanced, else what there is")
    booster.add_argument("--partial", action="store_true", help="an incomplete official set is wanted as it is")
    return parser


def run(argv: Sequence[str]) -> int:
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.list_protocols:
        print(list_protocols())
        return 0
    if (args.dataset is None) == (args.booster is None):
        parser.error("one of --dataset and --booster is required")
    if (args.base is None and args.adapter is None) == (args.predictions is None):
        parser.error("one of --base, --adapter and --predictions is required")
    if args.predictions and (args.dataset or args.adapter):
        parser.error("--predictions go with --booster, and without --adapter")
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
        predictions=args.predictions,
        split=args.split,
        dataset_revision=args.dataset_revision,
        out=args.out,
        adapter_scale=args.adapter_scale,
        size=args.size,
        kind=args.kind,
        revision=args.revision,
        accept_base=args.accept_base,
        **options,
    )
    return 0
