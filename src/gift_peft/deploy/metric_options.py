"""The options of `gift-peft predict` for sensors, cameras, clips and point clouds, and what they ask for."""

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from gift_peft.options import number

if TYPE_CHECKING:
    from gift_peft.deploy.metric_outputs import MetricOutputs


def add_metric_options(parser: argparse.ArgumentParser) -> None:
    """Adds them; what they need is imported where it is used."""
    parser.add_argument("--batch-size", type=number(int, 1), metavar="N", help="pictures per forward")
    parser.add_argument("--png16", action="store_true", help="also a 16-bit PNG, which says its unit")
    sensor = parser.add_argument_group("metric depth")
    text = "depth of a sensor, registered to the photos: a file or folder (16-bit PNG in mm, npy in m)"
    sensor.add_argument("--sensor-depth", metavar="PATH", help=text)
    text = "masks of the target: there the sensor is not believed; with --video, where flicker is measured"
    sensor.add_argument("--sensor-mask", metavar="PATH", help=text)
    text = "of the sensor's files: m, mm, or metres per value; default mm for whole numbers, m for others"
    sensor.add_argument("--sensor-unit", type=_unit, metavar="UNIT", help=text)
    text = "between the times in the names of a photo and its sensor depth"
    sensor.add_argument("--sensor-tolerance", type=number(float, 0), default=0.02, metavar="SECONDS", help=text)
    text = "a table of taped distances: columns x, y, depth_m (or depth_mm, distance_m, distance_mm), perhaps image"
    sensor.add_argument("--calibrate", metavar="CSV", help=text)
    cloud = parser.add_argument_group("point clouds")
    cloud.add_argument("--pointcloud", choices=["ply", "glb"], help="a file of colored points per photo")
    cloud.add_argument(
        "--camera", metavar="YAML", help="fx fy cx cy width height, or ROS's; default: the photo's EXIF"
    )
    cloud.add_argument("--fov", type=_fov, metavar="DEGREES", help="horizontal field of view, in place of --camera")
    clip = parser.add_argument_group("clips")
    clip.add_argument("--video", metavar="CLIP", help="a clip, or the number of a camera, in place of photos")
    clip.add_argument("--frames", type=number(int, 1), metavar="N", help="of the clip or camera; default: all")


def check_metric_options(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Wrong usage, which ends through the parser."""
    if (args.video is None) == (not args.images):
        parser.error("photos or --video are required, one of the two")
    if args.video is not None:
        others = ("sensor_depth", "calibrate", "pointcloud", "png16", "camera", "fov", "focal_length")
        given = [f"--{name.replace('_', '-')}" for name in others if getattr(args, name)]
        if given:
            parser.error(f"{given[0]} goes with photos, not with --video")
    elif args.frames is not None:
        parser.error("--frames goes with --video")
    if args.sensor_depth is None:
        given = [name for name in ("sensor_mask", "sensor_unit") if getattr(args, name)]
        if given and not (given == ["sensor_mask"] and args.video is not None):
            parser.error(f"--{given[0].replace('_', '-')} goes with --sensor-depth")
    elif args.calibrate is not None:
        parser.error("--sensor-depth and --calibrate both say what a metre is: one of the two")
    if args.camera is not None and args.fov is not None:
        parser.error("--camera and --fov both say what the camera is: one of the two")


def make_outputs(args: argparse.Namespace) -> "MetricOutputs | None":
    """What the options ask for, with every file found and paired before a model is loaded; None if nothing is."""
    if not (args.sensor_depth or args.calibrate or args.png16 or args.pointcloud):
        return None
    from gift_peft.deploy.calibration import Calibration
    from gift_peft.deploy.intrinsics import Intrinsics
    from gift_peft.deploy.metric_outputs import MetricOutputs
    from gift_peft.deploy.pointcloud import check_trimesh
    from gift_peft.deploy.sensor_files import SensorFiles
    from gift_peft.images import list_images

    photos = list_images(args.images)
    outputs = MetricOutputs(png16=args.png16, pointcloud=args.pointcloud, fov=args.fov)
    if args.pointcloud is not None:
        check_trimesh()
    if args.camera is not None:
        outputs.camera = Intrinsics.from_yaml(args.camera)
    if args.sensor_depth is not None:
        paths = args.sensor_depth, args.sensor_mask
        outputs.sensor = SensorFiles.find(photos, *paths, args.sensor_unit, args.sensor_tolerance)
    if args.calibrate is not None:
        outputs.calibration = Calibration.read(args.calibrate)
        outputs.calibration.check(photos)
    return outputs


def run_video(args: argparse.Namespace) -> int:
    """`gift-peft predict --video`: the exit code."""
    from gift_peft.deploy.deployed import DeployedModel
    from gift_peft.deploy.video import predict_video

    if args.deployed is not None:
        model: Any = DeployedModel(args.deployed, args.backend, args.adapter_scale)
    else:
        from gift_peft.models.loading import DepthModel

        scale, revision = args.adapter_scale, args.revision
        model = DepthModel.from_pretrained(
            args.base, args.adapter, scale, revision, args.size, args.kind, accept_base=args.accept_base
        )
    result = predict_video(args.video, model, args.out, args.sensor_mask, args.frames, args.batch_size or 1)
    print(f"{result['clip']}: {result['frames']} frames, {result['frames_per_second']:.2f} a second")
    for name, percent in result.get("flicker_percent", {}).items():
        print(f"Flicker inside the target, {name}: {percent:.2f} % of the spread of depth outside")
    return 0


def _checked(parse: Callable[[str], object], text: str):
    try:
        return parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _fov(text: str) -> float:
    return _checked(lambda word: _within(float(word), 1, 179, "degrees"), text)


def _unit(text: str) -> str:
    if text not in ("m", "mm"):
        _checked(lambda word: _within(float(word), 1e-7, 1e3, "m per value"), text)
    return text


def _within(value: float, low: float, high: float, unit: str) -> float:
    if not low <= value <= high:
        raise ValueError(f"{value:g} is not within {low:g}..{high:g} {unit}")
    return value
