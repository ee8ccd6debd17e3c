"""Depth for single pictures (`gift-peft predict`).

Pictures are resized as in training, and the image processor's own `post_process_depth_estimation` brings the
prediction back to each picture's size, as in transformers' pipeline. Values stay in the network's native units.
"""

import io
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from tqdm import tqdm

from gift_peft.files import check_inputs_stay, write_whole
from gift_peft.images import list_images
from gift_peft.options import OptionParser, add_adapter, add_base

if TYPE_CHECKING:
    import torch


MARK = ("Software", "gift-peft predict")  # a text in our PNGs: what lacks it is somebody's own


class PicturesWithoutDepth(ValueError):
    """Some pictures could not be read, or predicted; the others were.

    Args:
        reasons (`list[str]`): a line per picture, which names it.
        paths (`list[Path]`): the npy files of the others.
    """

    def __init__(self, reasons: list[str], paths: list[Path]) -> None:
        self.reasons, self.paths = reasons, paths
        count = len(reasons) + len(paths)
        super().__init__(f"{len(reasons)} of {count} pictures have no depth: {'; '.join(reasons)}")


def predict_images(
    images: Sequence[str | Path],
    base: str | Path | None = None,
    adapter: str | Path | None = None,
    adapter_scale: float | None = None,
    *,
    out: str | Path,
    size: str | tuple[int, int] | None = None,
    kind: str | None = None,
    revision: str | None = None,
    focal_length: float | tuple[float, float] | None = None,
    device: "str | torch.device | None" = None,
    accept_base: bool = False,
    progress: bool = True,
) -> list[Path]:
    """Writes `<stem>.npy` and `<stem>.png` per picture and, with an adapter, `<stem>_base.npy/.png` beside them.

    The npy is (H,W) float32 at the picture's own size, in the model's native units: relative inverse depth for a
    relative Depth Anything (large is near), depth for metric models. The two PNGs of a picture share one colour range;
    near is bright. Pictures of one stem become `<stem>-2` and so on.

    Args:
        images: files, or folders whose pictures are taken.
        base, adapter, adapter_scale, revision, size, device, accept_base: as in `DepthModel.from_pretrained`.
        out: folder; made if missing. What an earlier `predict` left there under these names is replaced, nothing else.
        kind (`str`, *optional*): decides which end is bright; default the recipe's.
        focal_length (*optional*): of the camera in pixels, as in `DepthModel.depth_at`.

    Returns:
        `list[Path]`: the npy file of each picture.

    Raises:
        FileNotFoundError: a picture, base or adapter that is not there. ValueError: an adapter for another base; an
            output that would replace a picture, or what `predict` did not write. PicturesWithoutDepth, at the end:
            unreadable pictures, non-finite predictions.
    """
    from gift_peft.colormap import color_range, colorize  # not for `--help`, which needs neither OpenCV nor torch
    from gift_peft.models.loading import DepthModel

    files = list_images(images)
    names = _unique_names(files, beside=adapter is not None)
    folder = Path(out)
    stems = [stem for name in names for stem in ([name] if adapter is None else [name, f"{name}_base"])]
    _check_outputs(folder, stems, files)
    model = DepthModel.from_pretrained(base, adapter, adapter_scale, revision, size, kind, device, accept_base)
    folder.mkdir(parents=True, exist_ok=True)
    mark = PngInfo()
    mark.add_text(*MARK)
    made, wrong = [], []
    for file, name in tqdm(
        list(zip(files, names, strict=True)), desc="predict", unit="image", disable=None if progress else True
    ):
        try:
            depths = {name: model.depth_at(file, focal_length)}
            if adapter is not None:
                depths[f"{name}_base"] = model.depth_at(file, focal_length, base=True)
        except ValueError as error:  # of this picture: the others are still wanted
            wrong.append(str(error))
            continue
        low, high = color_range(*depths.values())
        for stem, depth in depths.items():
            picture = Image.fromarray(colorize(depth, low, high, model.kind or "inverse_depth"))
            # The PNG first: by its mark a later run knows both as its own.
            _write(folder / f"{stem}.png", lambda file, picture=picture: picture.save(file, "PNG", pnginfo=mark))
            _write(folder / f"{stem}.npy", lambda file, depth=depth: np.save(file, depth))
        made.append(folder / f"{name}.npy")
    if not made and len(set(wrong)) == 1:  # no matter of the pictures, or a single one
        raise ValueError(wrong[0])
    if wrong:
        raise PicturesWithoutDepth(wrong, made)
    return made


def _check_outputs(folder: Path, stems: Sequence[str], files: Sequence[Path]) -> None:
    """Raise ValueError if an output would replace a picture that is read, or a file that `predict` did not write."""
    pairs = [(folder / f"{stem}.png", folder / f"{stem}.npy") for stem in stems]
    check_inputs_stay([path for pair in pairs for path in pair], files)
    for pair in pairs:
        there = [path for path in pair if os.path.lexists(path)]
        if there and not _is_ours(pair[0]):
            raise ValueError(f"{there[0]} was not written by gift-peft predict and is kept: choose another folder")


def _is_ours(picture: Path) -> bool:
    try:
        with Image.open(picture) as image:
            return image.info.get(MARK[0]) == MARK[1]
    except (OSError, ValueError, SyntaxError):
        return False


def _write(path: Path, save: Callable[[io.BytesIO], None]) -> None:
    content = io.BytesIO()
    save(content)
    write_whole(path, content.getvalue())


def _unique_names(files: Sequence[Path], beside: bool) -> list[str]:
    """A file name per picture; `beside` keeps `<name>_base` free as well."""
    taken: set[str] = set()
    names = []
    for file in files:
        number, name = 1, file.stem
        while {name, f"{name}_base"} & taken if beside else name in taken:
            number += 1
            name = f"{file.stem}-{number}"
        taken |= {name, f"{name}_base"} if beside else {name}
        names.append(name)
    return names


# ---- the verb ----


def make_parser() -> OptionParser:
    parser = OptionParser(
        "predict",
        "Depth of pictures, beside the base's.",
        "gift-peft predict photo.jpg --adapter demo/adapter --out depth",
    )
    parser.add_argument("images", nargs="+", metavar="IMAGE", help="picture files or folders of them")
    add_base(parser, required=False)
    add_adapter(parser)
    text = "of the camera that took the pictures, where the model takes one (Metric3D)"
    parser.add_argument("--focal-length", type=float, metavar="PIXELS", help=text)
    parser.add_argument("--out", "--output-dir", required=True, metavar="DIR", help="folder for the npy and png files")
    return parser


def run(argv: Sequence[str]) -> int:
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.base is None and args.adapter is None:
        parser.error("one of --base and --adapter is required")
    reasons: list[str] = []
    try:
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
            accept_base=args.accept_base,
        )
    except PicturesWithoutDepth as error:
        files, reasons = error.paths, error.reasons
    print(f"Depth maps written to {args.out}: {len(files)}")
    for why in reasons:
        print(f"gift-peft: error: {why}", file=sys.stderr)
    if reasons:
        print(f"gift-peft: {len(reasons)} of {len(files) + len(reasons)} pictures have no depth", file=sys.stderr)
    return 1 if reasons else 0
