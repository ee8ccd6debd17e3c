"""`gift-peft evaluate`: the evaluation of predictions or, with `--sensor-depth`, of sensor depth that they fill."""

from collections.abc import Sequence

from gift_peft.evaluation import verb
from gift_peft.files import write_whole
from gift_peft.options import OptionParser, use_color


def make_parser() -> OptionParser:
    parser = verb.make_parser()
    sensor = parser.add_argument_group("depth sensor")
    text = "evaluate filled sensor depth: a folder <group>/<image>.png (16-bit, mm) or .npy (m)"
    sensor.add_argument("--sensor-depth", metavar="DIR", help=text)
    text = "of the sensor's files: m, mm, or metres per value; default mm for whole numbers, m for others"
    sensor.add_argument("--sensor-unit", metavar="UNIT", help=text)
    sensor.add_argument("--without-masks", action="store_true", help="let the fit find the target out")
    return parser


def run(argv: Sequence[str]) -> int:
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.sensor_depth is None:
        if args.sensor_unit or args.without_masks:
            parser.error("--sensor-unit and --without-masks go with --sensor-depth")
        return verb.run(argv)
    if args.dataset is None or args.booster is not None or args.predictions is not None:
        parser.error("--sensor-depth takes --dataset, whose depths are the truth")
    from gift_peft.dataset.gift_i import load_gift_i
    from gift_peft.deploy.sensor_evaluation import evaluate_sensor
    from gift_peft.evaluation.table_formats import to_markdown, to_text
    from gift_peft.models.loading import DepthModel

    groups = load_gift_i(args.dataset, args.split, dataset_revision=args.dataset_revision)
    model = DepthModel.from_pretrained(
        args.base, args.adapter, args.adapter_scale, args.revision, args.size, args.kind, accept_base=args.accept_base
    )
    report = evaluate_sensor(groups, model, args.sensor_depth, args.sensor_unit, not args.without_masks)
    folder = report.save(args.out)
    write_whole(folder / "sensor.md", to_markdown(report.table()))
    print(to_text(report.table(), use_color()))
    print(f"Written: {folder}/sensor.json, sensor_rows.jsonl, sensor.md")
    return 0
