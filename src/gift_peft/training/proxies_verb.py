"""`gift-peft proxies`: its options. `teacher` beside it does the work."""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import fields
from itertools import chain
from pathlib import Path

from gift_peft.dataset.proxies import SURFACE_SUFFIX, SurfaceSettings, read_header
from gift_peft.files import check_own_file, write_whole
from gift_peft.options import OptionParser, add_base, add_dataset
from gift_peft.rules import KINDS
from gift_peft.surface_targets import MODELS


def make_parser() -> OptionParser:
    parser = OptionParser(
        "proxies",
        "Keep the frozen model's predictions for a dataset, or the surface targets computed from them.",
        "gift-peft proxies --base depth-anything/Depth-Anything-V2-Small-hf --dataset gift-i",
    )
    add_base(parser)
    add_dataset(parser)
    parser.add_argument("--splits", nargs="+", metavar="SPLIT", help="default: all")
    parser.add_argument("--proxies-dir", metavar="DIR", help="default: DATASET/proxies")
    parser.add_argument("--overwrite", action="store_true", help="make again what is there: proxies, or with --target")
    surface = parser.add_argument_group("surface targets", "where the surfaces are, by what the frozen model predicts")
    surface.add_argument("--target", choices=["surface"], help="also make the surface targets")
    text = {
        "fills": "copies of each photo with its target painted in one color; 0 is allowed",
        "seed": "of their colors",
        "surface_model": "auto: a plane where it fits, else the quantile",
        "surface_quantile": "of inverse depth, higher is nearer; default 0.65, without fills 0.8",
        "surface_tau": "share of the predictions below the plane; default 0.5, without fills 0.7",
    }
    for field in fields(SurfaceSettings):
        kind = float if field.default is None else type(field.default)
        options = {"choices": MODELS} if field.name == "surface_model" else {"type": kind}
        name = f"--{field.name.replace('_', '-')}"
        surface.add_argument(name, default=field.default, help=text[field.name], **options)
    text = "a page to look at: each photo, its base prediction, surface target and treated reference"
    surface.add_argument("--page", metavar="HTML", type=Path, help=text)
    surface.add_argument("--kind", choices=KINDS, help="what is predicted, if no recipe says it")
    return parser


def run(argv: Sequence[str]) -> int:
    parser = make_parser()
    args = parser.parse_args(argv)
    settings = SurfaceSettings(**{field.name: getattr(args, field.name) for field in fields(SurfaceSettings)})
    if args.target is None and (settings != SurfaceSettings() or args.kind or args.page):
        parser.error("fills, seed, kind, page and the surface options are for --target surface")
    from gift_peft.dataset.gift_i import gift_i_splits, load_gift_i
    from gift_peft.training.teacher import make_proxies, told_of_surface

    if args.page:
        from gift_peft.reports.targets_page import MARK

        check_own_file(args.page, MARK, "--page")
    folder = make_proxies(
        args.base,
        args.dataset,
        splits=args.splits,
        size=args.size,
        proxies_dir=args.proxies_dir,
        revision=args.revision,
        overwrite=args.overwrite,
        surface=settings if args.target else None,
        kind=args.kind,
    )
    print(f"{'Surface targets' if args.target else 'Proxies'}: {folder}")
    if args.target:
        for split in args.splits or gift_i_splits(args.dataset):
            names = load_gift_i(args.dataset, split).select_columns(["group_id"])["group_id"]
            print("\n".join(f"  {split}, {line}" for line in told_of_surface(folder, split, names)))
    if args.page:
        print(f"Page: {_write_page(args, settings, folder)}")
    return 0


def _write_page(args: Namespace, settings: SurfaceSettings, folder: Path) -> Path:
    """The page of all splits asked for, whole or not at all."""
    from gift_peft.dataset.gift_i import gift_i_splits, load_gift_i
    from gift_peft.dataset.rows import parsed
    from gift_peft.models.pixels import parse_size
    from gift_peft.reports.targets_page import targets_page

    places = {"proxies_dir": args.proxies_dir, "revision": args.revision, "surface": settings}
    places["size"] = parse_size(folder.name)
    splits = args.splits or gift_i_splits(args.dataset)
    groups = chain.from_iterable(parsed(load_gift_i(args.dataset, split, args.base, **places)) for split in splits)
    made = (place.glob(f"*/*{SURFACE_SUFFIX}.safetensors") for place in (folder, folder.parent))
    kind = read_header(next(chain.from_iterable(made)))["kind"]
    write_whole(args.page, targets_page(groups, kind))
    return args.page
