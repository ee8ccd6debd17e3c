"""`gift-peft deploy`: its options. The modules beside it do the work, one for each `--to`."""

from collections.abc import Sequence
from importlib import import_module

from gift_peft.options import OptionParser

# What --to takes: the module and function that write it, and what it is in words.
FORMS = {
    "transformers": ("merged", "deploy_transformers"),
    "onnx": ("onnx_export", "deploy_onnx"),
    "openvino": ("openvino_export", "deploy_openvino"),
    "int8": ("onnx_export", "deploy_int8"),
    "space": ("space", "deploy_space"),
}
DIALED = ("onnx", "openvino", "int8", "space")


def make_parser() -> OptionParser:
    parser = OptionParser(
        "deploy",
        "An adapter and its base as one model that runs elsewhere.",
        "gift-peft deploy out/adapter model --to onnx",
    )
    parser.add_argument("adapter", metavar="ADAPTER", help="adapter: folder or hub id")
    parser.add_argument("out", metavar="OUT", help="new folder")
    text = (
        "transformers: a plain merged model; onnx, openvino: a graph that is right at every size and batch; int8: an "
        "ONNX graph with weights of 8 bits; space: a page to try it in, for here or a Hugging Face Space"
    )
    parser.add_argument("--to", required=True, choices=[*FORMS], help=text)
    parser.add_argument(
        "--base", "--model-name-or-path", metavar="ID", help="base model; default: the one that the adapter names"
    )
    parser.add_argument("--revision", help="branch, tag or commit of the base model")
    parser.add_argument("--adapter-scale", type=float, metavar="S", help="0 is the base, 1 the adapter (default)")
    parser.add_argument("--size", metavar="HxW", help="at the network; default: the adapter's, else the recipe's")
    parser.add_argument("--kind", choices=["depth", "inverse_depth"], help="what is predicted, if no recipe says it")
    text = "a second input, adapter_scale, goes from the base (0) to the adapter (1): one file for both"
    parser.add_argument("--dial", action="store_true", help=text)
    text = "photos for the page of a Space; default: some of the embedded groups"
    parser.add_argument("--examples", nargs="+", default=[], metavar="PHOTO", help=text)
    return parser


def run(argv: Sequence[str]) -> int:
    parser = make_parser()
    args = parser.parse_args(argv)
    options = {"revision": args.revision, "size": args.size, "kind": args.kind}
    if args.to != "space":  # a Space always has the dial
        if args.dial and args.to not in DIALED:
            parser.error(f"--dial: a merged model has no dial; take --to {', '.join(DIALED[:-1])}")
        if args.dial and args.adapter_scale is not None:
            parser.error("--dial leaves the scale open: leave --adapter-scale out")
        options["adapter_scale"] = 1.0 if args.adapter_scale is None else args.adapter_scale
        if args.dial:
            options["dial"] = True
        if args.examples:
            parser.error("--examples are of --to space")
    else:
        if args.adapter_scale is not None:
            parser.error("--adapter-scale: the page of a Space has a slider for it")
        options["examples"] = args.examples
    module, function = FORMS[args.to]
    deploy = getattr(import_module(f"gift_peft.deploy.{module}"), function)
    print(f"Written: {deploy(args.adapter, args.out, args.base, **options)}")
    return 0
