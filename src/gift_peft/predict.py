"""Depth for single pictures (`gift-peft predict`).

Pictures are resized as in training, and the image processor's own `post_process_depth_estimation` brings the
prediction back to each picture's size, as in transformers' pipeline. Values stay in the network's native units.
"""

import io
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from tqdm import tqdm

from gift_peft.deploy.metric_options import add_metric_options, check_metric_options, make_outputs, run_video
from gift_peft.files import check_inputs_stay, write_whole
from gift_peft.images import PREDICTED, list_images
from gift_peft.options import OptionParser, add_adapter, add_base

if TYPE_CHECKING:
    import torch

    from gift_peft.deploy.metric_outputs import MetricOutputs


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
    outputs: "MetricOutputs | None" = None,
    batch_size: int | None = None,
    deployed: str | Path | None = None,
    backend: str | None = None,
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
        outputs (`MetricOutputs`, *optional*): what else is written of each picture.
        batch_size (`int`, *optional*): pictures per forward; default 8 on a GPU, else 1.
        deployed (*optional*): a folder that `gift-peft deploy` exported, in place of base and adapter.
        backend (`str`, *optional*): what computes a deployed model, `onnx` or `openvino`.

    Returns:
        `list[Path]`: the npy file of each picture.

    Raises:
        FileNotFoundError: a picture, base or adapter that is not there. ValueError: an adapter for another base; an
            output that would replace a picture, or what `predict` did not write. PicturesWithoutDepth, at the end:
            unreadable pictures, non-finite predictions.
    """
    from gift_peft.colormap import color_range, colorize  # not for `--help`, which needs neither OpenCV nor torch
    from gift_peft.deploy.look_ahead import predict_ahead

    files = list_images(images)
    model: Any = None
    if deployed is not None:
        from gift_peft.deploy.deployed import DeployedModel

        model = DeployedModel(deployed, backend, adapter_scale)
    beside = adapter is not None if model is None else model.adapted
    ends = ["_base"] if beside else []
    names = _unique_names(files, ends + (outputs.suffixes() if outputs else []))
    folder = Path(out)
    stems = [name + end for name in names for end in ["", *ends]]
    if outputs is not None:
        stems += [name + end for name in names for end in outputs.suffixes()]
        outputs.check(folder, names, _is_ours)
    _check_outputs(folder, stems, files)
    if model is None:
        from gift_peft.models.loading import DepthModel

        model = DepthModel.from_pretrained(base, adapter, adapter_scale, revision, size, kind, device, accept_base)
    folder.mkdir(parents=True, exist_ok=True)
    mark = PngInfo()
    mark.add_text(*PREDICTED)
    made, wrong = [], []
    results = predict_ahead(model, files, beside, focal_length, batch_size)
    for file, name, result in tqdm(
        zip(files, names, results, strict=True),
        desc="predict",
        unit="image",
        total=len(files),
        disable=None if progress else True,
    ):
        try:
            if isinstance(result, Exception):
                raise result
            depths = {name: result["own"]} | ({f"{name}_base": result["base"]} if "base" in result else {})
            if outputs is not None:
                outputs.write(folder, name, file, depths[name], model.kind, model.millimeters_per_unit)
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
            return image.info.get(PREDICTED[0]) == PREDICTED[1]
    except (OSError, ValueError, SyntaxError):
        return False


def _write(path: Path, save: Callable[[io.BytesIO], None]) -> None:
    content = io.BytesIO()
    save(content)
    write_whole(path, content.getvalue())


def _unique_names(files: Sequence[Path], ends: Sequence[str]) -> list[str]:
    """A file name per picture; `<name><end>` stays free as well for each of the ends."""
    taken: set[str] = set()
    names = []
    for file in files:
        number, name = 1, file.stem
        while {name, *(name + end for end in ends)} & taken:
            number += 1
            name = f"{file.stem}-{number}"
        taken |= {name, *(name + end for end in ends)}
        names.append(name)
    return names


# ---- the verb ----


def make_parser() -> OptionParser:
    parser = OptionParser(
        "predict",
        "Depth of pictures, beside the base's.",
        "gift-peft predict photo.jpg --adapter demo/adapter --out depth",
    )
    parser.add_argument("images", nargs="*", metavar="IMAGE", help="picture files or folders of them")
    add_base(parser, required=False)
    add_adapter(parser)
    text = "of the camera that took the pictures, where the model takes one (Metric3D)"
    parser.add_argument("--focal-length", type=float, metavar="PIXELS", help=text)
    text = "a folder of `gift-peft deploy --to onnx|openvino|int8`, in place of --base and --adapter"
    parser.add_argument("--deployed", metavar="DIR", help=text)
    text = "what computes a deployed model; default: what it was exported for"
    parser.add_argument("--backend", choices=["onnx", "openvino"], help=text)
    parser.add_argument("--out", "--output-dir", required=True, metavar="DIR", help="folder for the npy and png files")
    add_metric_options(parser)
    return parser


def run(argv: Sequence[str]) -> int:
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.deployed is not None:
        fixed = ("base", "adapter", "revision", "size", "kind")
        given = [f"--{name}" for name in fixed if getattr(args, name) is not None]
        if given:
            parser.error(f"--deployed brings its own model: leave {', '.join(given)} out")
    elif args.backend is not None:
        parser.error("--backend computes a model named by --deployed")
    elif args.base is None and args.adapter is None:
        parser.error("one of --base, --adapter and --deployed is required")
    check_metric_options(parser, args)
    if args.video is not None:
        return run_video(args)
    reasons: list[str] = []
    outputs = make_outputs(args)
    begin = time.perf_counter()
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
            outputs=outputs,
            batch_size=args.batch_size,
            deployed=args.deployed,
            backend=args.backend,
        )
    except PicturesWithoutDepth as error:
        files, reasons = error.paths, error.reasons
    seconds = time.perf_counter() - begin
    print(f"Depth maps written to {args.out}: {len(files)} ({len(files) / seconds:.2f} a second, loading included)")
    if outputs is not None and (line := outputs.finish(Path(args.out))):
        print(line)
    for why in reasons:
        print(f"gift-peft: error: {why}", file=sys.stderr)
    if reasons:
        print(f"gift-peft: {len(reasons)} of {len(files) + len(reasons)} pictures have no depth", file=sys.stderr)
    return 1 if reasons else 0
