"""The loss-weight ablation of the paper (Table 3, Figures 5 and 6) on your own model and data, from one YAML file.

    python examples/ablate_weights.py --config examples/depth_anything_v2_large.yaml --dataset_name my-gift-i \
        --output_dir ablation

trains lambda_c:lambda_d = 1:1, 1:1.5, 1:2, 2:1 and 1:0 one after the other into `ablation/1-1`, `ablation/1-1.5`, ...,
evaluates each adapter with the smallest validation GCE and writes `ablation/report`. `--ratios 1:1 1:4` takes others;
all further arguments are those of `gift-peft train`. Stopped, the same command goes on where it was.
"""

import argparse
import sys
from pathlib import Path

from gift_peft.evaluation.verb import run_evaluation
from gift_peft.reports.report import run_report
from gift_peft.training import train
from gift_peft.training.arguments import parse_arguments

RATIOS = [(1.0, 1.0), (1.0, 1.5), (1.0, 2.0), (2.0, 1.0), (1.0, 0.0)]  # (lambda_c, lambda_d)
OURS = ("lambda_c", "lambda_d", "resume_from_checkpoint", "overwrite_output_dir", "push_to_hub")


def main(argv: list[str]) -> int:
    """Exit code: 0, or 128 + the signal that stopped a run."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--ratios", nargs="+", default=RATIOS, type=weights, metavar="C:D")
    own, rest = parser.parse_known_args(argv)
    if {"-h", "--help"} & set(rest):
        print(__doc__)
        return 0
    for word in rest:
        name = word.removeprefix("--").split("=")[0].replace("-", "_")
        if word.startswith("--") and name in OURS:
            raise ValueError(f"{word.split('=')[0]}: the ablation sets it itself")
    output = Path(parse_arguments(rest).output_dir)
    folders = []
    for weight_c, weight_d in dict.fromkeys(own.ratios):
        folder = output / f"{weight_c:g}-{weight_d:g}"
        print(f"== {weight_c:g}:{weight_d:g} in {folder}", flush=True)
        options = [f"--lambda_c={weight_c}", f"--lambda_d={weight_d}", f"--output_dir={folder}"]
        if (folder / "config.yaml").exists():
            options.append("--resume_from_checkpoint=latest")
        args = parse_arguments([*rest, *options])
        result = train(args)
        if result.signal:
            return 128 + result.signal
        if result.metrics[-1]["val_gce"] is not None:
            run_evaluation(
                args.model_name_or_path,
                args.dataset_name,
                folder / "adapter",
                out=folder / "evaluation",
                revision=args.model_revision,
            )
        folders.append(folder)
    run_report(folders, output / "report", panels=0)
    return 0


def weights(text: str) -> tuple[float, float]:
    """`1:1.5` as (1.0, 1.5)."""
    consistency, _, distillation = text.partition(":")
    try:
        return float(consistency), float(distillation)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: expected CONSISTENCY:DISTILLATION, such as 1:1.5") from None


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except (ValueError, OSError) as error:
        sys.exit(f"ablate_weights: error: {' '.join(str(error).split())}")
