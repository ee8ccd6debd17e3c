"""Does training in bf16 end where float32 ends? The demo in both, and how far each of its figures is apart.

    OMP_NUM_THREADS=2 python examples/tools/compare_precisions.py                     # the paper's objective, whole
    python examples/tools/compare_precisions.py --target surface --max_steps 20       # a quick look

Every error, and GCE, is compared as its relative change against the base in percent, delta1 in percent of the pixels.
Exit code 1 if any is more than two points apart. Autocast in bf16 is what a GPU does by default; here it runs on
whatever accelerate chooses, the CPU included, which only emulates it.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from gift_peft.demo.run import run_demo
from gift_peft.evaluation.results import REGIONS, Report

MOST = 2.0  # points
PRECISIONS = {"float32": "no", "bf16": "bf16"}


def changes(reports: dict[str, Report]) -> dict[str, float]:
    """{figure: its change against the base, in percent; of delta1 the difference}."""
    gce = reports["proxy"].gce
    found = {"GCE": 100 * (gce["adapted"] / gce["base"] - 1)}
    for reference, report in reports.items():
        for region in REGIONS:
            for name, value in report.summary[region].items():
                base = report.base[region][name]
                change = value - base if name.startswith("delta") else 100 * (value / base - 1)
                found[f"{region} {name}, {reference}"] = change
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", choices=["consensus", "surface"], default="consensus")
    parser.add_argument("--max_steps", type=int, default=-1, help="stop both after so many updates")
    args = parser.parse_args()
    found = {}
    for name, precision in PRECISIONS.items():
        print(f"\n{name}\n", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            options = [f"--mixed_precision={precision}", f"--max_steps={args.max_steps}"]
            reports = run_demo(Path(folder) / "demo", target=args.target, extra=options)[args.target]
        found[name] = changes(reports)
    print(f"\n| {args.target}: change against the base | float32 | bf16 | apart |\n|---|---:|---:|---:|")
    apart = {figure: abs(found["bf16"][figure] - change) for figure, change in found["float32"].items()}
    for figure, distance in apart.items():
        first, second = (found[name][figure] for name in PRECISIONS)
        print(f"| {figure} | {first:+.1f} | {second:+.1f} | {distance:.2f} |")
    worst = max(apart, key=apart.get)
    print(f"\nFarthest apart: {worst}, {apart[worst]:.2f} points")
    sys.exit(0 if apart[worst] <= MOST else 1)


if __name__ == "__main__":
    main()
