"""Depth for single pictures (`gift-peft predict`).

Pictures are resized as in training, and the image processor's own `post_process_depth_estimation` brings the
prediction back to each picture's size, as in transformers' pipeline. Values stay in the network's native units.
"""

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from gift_peft.files import write_whole
from gift_peft.images import list_images
from gift_peft.options import OptionParser, add_adapter, add_base

if TYPE_CHECKING:
    import torch


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
        base, adapter, adapter_scale, revision, size, device: as in `DepthModel.from_pretrained`.
        out: folder; made if missing, existing files of these names are replaced.
        kind (`str`, *optional*): decides which end is bright; default the recipe's.
        focal_length (*optional*): of the camera in pixels, as in `DepthModel.depth_at`.
        deployed (*optional*): a folder that `gift-peft deploy` exported, in place of base and adapter.
        backend (`str`, *optional*): what computes a deployed model, `onnx` or `openvino`.

    Returns:
        `list[Path]`: the npy file of each picture.

    Raises:
        FileNotFoundError: a picture, base or adapter that is not there. ValueError: an unreadable picture, a
            non-finite prediction, an adapter for another base.
    """
    from gift_peft.colormap import color_range, colorize  # not for `--help`, which needs neither OpenCV nor torch

    files = list_images(images)
    model: Any
    if deployed is not None:
        from gift_peft.deploy.deployed import DeployedModel

        model = DeployedModel(deployed, backend, adapter_scale)
    elif base is None:
        raise ValueError("predict needs a base or a deployed folder")
    else:
        from gift_peft.models.loading import DepthModel

        model = DepthModel.from_pretrained(base, adapter, adapter_scale, revision, size, kind, device)
    names = _unique_names(files, beside=model.adapted)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    for file, name in tqdm(
        list(zip(files, names, strict=True)), desc="predict", unit="image", disable=None if progress else True
    ):
        depths = {name: model.depth_at(file, focal_length)}
        if model.adapted:
            depths[f"{name}_base"] = model.depth_at(file, focal_length, base=True)
        low, high = color_range(*depths.values())
        for stem, depth in depths.items():
            picture = Image.fromarray(colorize(depth, low, high, model.kind or "inverse_depth"))
            _write(folder / f"{stem}.npy", lambda file, depth=depth: np.save(file, depth))
            _write(folder / f"{stem}.png", lambda file, picture=picture: picture.save(file, "PNG"))
    return [folder / f"{name}.npy" for name in names]


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
        "gift-peft predict photo.jpg --base demo/base --adapter demo/adapter --out depth",
    )
    parser.add_argument("images", nargs="+", metavar="IMAGE", help="picture files or folders of them")
    add_base(parser, required=False)
    add_adapter(parser)
    text = "of the camera that took the pictures, where the model takes one (Metric3D)"
    parser.add_argument("--focal-length", type=float, metavar="PIXELS", help=text)
    text = "a folder of `gift-peft deploy --to onnx|openvino|int8`, in place of --base and --adapter"
    parser.add_argument("--deployed", metavar="DIR", help=text)
    text = "what computes a deployed model; default: what it was exported for"
    parser.add_argument("--backend", choices=["onnx", "openvino"], help=text)
    parser.add_argument("--out", "--output-dir", required=True, metavar="DIR", help="folder for the npy and png files")
    return parser


def run(argv: Sequence[str]) -> int:
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.deployed is None and args.base is None:
        parser.error("the following arguments are required: --base/--model-name-or-path, or --deployed")
    if args.deployed is not None:
        fixed = ("base", "adapter", "revision", "size", "kind")
        given = [f"--{name}" for name in fixed if getattr(args, name) is not None]
        if given:
            parser.error(f"--deployed brings its own model: leave {', '.join(given)} out")
    elif args.backend is not None:
        parser.error("--backend computes a model named by --deployed")
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
        deployed=args.deployed,
        backend=args.backend,
    )
    print(f"Depth maps written to {args.out}: {len(files)}")
    return 0
