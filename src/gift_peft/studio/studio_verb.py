"""`gift-peft studio`: its options, what kind of folder it is started at, and which rooms that opens."""

import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gift_peft.options import OptionParser, add_adapter, add_base, number
from gift_peft.rules import SPLITS

if TYPE_CHECKING:
    from gift_peft.studio.server import Rooms

DESCRIPTION = """A page in your browser, served to this computer alone: take the photos of a group with a coach, draw
the masks of a folder of photos or clips, look at surface targets, compare base and adapter on a photo of yours.

Nothing is sent anywhere, and only the given folder is written: photos that you take, masks when you save them."""


def make_parser() -> OptionParser:
    parser = OptionParser("studio", DESCRIPTION, "gift-peft studio my-captures")
    text = (
        "RAW (draws masks; new or not, takes photos with --source), a prepared folder (shows surface targets), or a "
        "run or adapter (compares it with its base)"
    )
    parser.add_argument("folder", metavar="FOLDER", help=text)
    add_base(parser, required=False)
    add_adapter(parser)
    parser.add_argument(
        "--refine", metavar="sam2:MODEL", help="redraws what is clicked on, with SAM 2 of transformers"
    )
    text = "takes photos into RAW: a camera's number, a stream's address, or a clip"
    parser.add_argument("--source", metavar="SOURCE", help=text)
    text = "for --source, picture of the target, if you have one: white where it is"
    parser.add_argument("--mask", metavar="FILE", help=text)
    parser.add_argument("--port", type=number(int, 0), default=7860, metavar="N", help="of 127.0.0.1; 0: a free one")
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    return parser


def run(argv: Sequence[str]) -> int:
    """Serve until Ctrl-C; ValueError or OSError, in a line, where nothing can be shown."""
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.adapter_scale is not None:
        parser.error("--adapter-scale is chosen on the page")
    if args.mask is not None and args.source is None:
        parser.error("--mask goes with --source")
    kind = kind_of(Path(args.folder), args.source is not None)
    if kind != "raw" and args.refine is not None:
        parser.error("--refine draws masks, in a folder of photos or clips")
    from gift_peft.studio.server import build, check_gradio, free_port, private_folder, serve

    check_gradio()
    port = free_port(args.port)
    print("Opening the studio ...", file=sys.stderr, flush=True)
    with private_folder() as temporary:
        rooms = _rooms(args, kind, temporary)
        blocks = build(rooms, f"gift-peft studio: {Path(args.folder).resolve().name}")
        try:
            serve(blocks, port, temporary, args.open, lambda url: print(f"Studio: {url} (Ctrl-C ends it)", flush=True))
        finally:
            for line in rooms.capture.close() if rooms.capture is not None else ():
                print(line)
    return 0


def kind_of(folder: Path, captures: bool = False) -> str:
    """ "raw", "prepared", "run" or "adapter"; FileNotFoundError or ValueError, in a line, for anything else.

    Where photos are taken (`captures`), the folder is a raw tree, and may be absent or empty.
    """
    if captures:
        from gift_peft.prepare.capture_session import check_tree

        splits = [folder / split for split in SPLITS if (folder / split).is_dir()]
        for place in splits or [folder]:
            check_tree(place)
        return "raw"
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    if (folder / "adapter_config.json").is_file():
        return "adapter"
    if (folder / "config.yaml").is_file() or (folder / "metrics.jsonl").is_file():
        if not (folder / "adapter" / "adapter_config.json").is_file():
            raise FileNotFoundError(
                f"{folder}: a run without an adapter yet; start the studio when `train` has saved one"
            )
        return "run"
    if any((folder / split / "metadata.parquet").is_file() for split in SPLITS):
        return "prepared"
    from gift_peft.captures.clip import find_clips
    from gift_peft.captures.folders import files_below
    from gift_peft.captures.tree import find_groups
    from gift_peft.images import is_image_file

    expected = (
        "the studio takes a folder with a folder of photos or a clip per group, a prepared folder, or a run; photos "
        "are taken with --source 0"
    )
    try:
        groups = [path for found in find_groups(folder).values() for path in found]
    except FileNotFoundError:
        raise FileNotFoundError(f"{folder}: no groups in it; {expected}") from None
    for group in groups:
        try:
            files = list(files_below(group))
        except (OSError, ValueError):
            continue  # another group may be whole; the room says what is wrong with this one
        if any(map(is_image_file, files)) or find_clips(files):
            return "raw"
    raise ValueError(f"{folder}: none of its folders holds photos or a clip; {expected}")


def _rooms(args: Namespace, kind: str, temporary: Path) -> "Rooms":
    from gift_peft.studio.server import Rooms

    folder, rooms = Path(args.folder), Rooms()
    adapter, base = args.adapter, args.base
    if kind in ("run", "adapter"):
        adapter = adapter or (folder / "adapter" if kind == "run" else folder)
    if adapter is not None or base is not None:
        rooms.compare = _compare(args, adapter, temporary)
    if kind == "raw":
        from gift_peft.prepare.proposals import load_sam2
        from gift_peft.studio.mask_room import MaskRoom

        if args.refine is not None:
            load_sam2(args.refine)  # what is wrong with it is told now, and not at the first click
        if args.source is not None:
            rooms.capture = _capture(args)
        rooms.masks = MaskRoom(folder, temporary, args.refine)
    if kind == "prepared":
        from gift_peft.studio.target_room import TargetRoom

        try:
            rooms.targets = TargetRoom(folder)
        except ValueError:
            if rooms.compare is None:
                raise
    return rooms


def _capture(args: Namespace):
    from gift_peft.prepare.capture_session import open_source, read_target
    from gift_peft.studio.capture_room import CaptureRoom

    read_target(args.mask)  # what is wrong with it is told now, and not when somebody presses Start
    return CaptureRoom(Path(args.folder), open_source(args.source), args.mask)


def _compare(args: Namespace, adapter: str | Path | None, temporary: Path):
    from gift_peft.deploy.pointcloud import check_trimesh
    from gift_peft.models.loading import DepthModel
    from gift_peft.studio.compare_room import CompareRoom

    check_trimesh()
    options = {"revision": args.revision, "size": args.size, "kind": args.kind, "accept_base": args.accept_base}
    return CompareRoom(DepthModel.from_pretrained(args.base, adapter, **options), temporary)
