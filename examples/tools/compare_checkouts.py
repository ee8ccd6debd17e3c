"""Do two checkouts compute the same bits? Runs the demo of each at seed 0 on one thread and compares what they leave.

    git worktree add ../before v0.1.0
    python examples/tools/compare_checkouts.py ../before .                        # the whole demo: minutes for each
    python examples/tools/compare_checkouts.py ../before . -- --max_steps 20      # a quick look

Compared byte for byte: adapters, proxies, metrics.jsonl, the rows of both evaluations and of a third one under the
protocol depth4tom. Both run in this environment, with the package of their own `src`. Exit code 1 if anything differs.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

COMPARED = (
    "demo/adapter*/adapter_model.safetensors",
    "demo/metrics.jsonl",
    "demo/evaluation-*/rows.jsonl",
    "demo/gift-i/proxies/**/*.safetensors",
    "depth4tom/rows.jsonl",
)
EVALUATE = "evaluate --base demo/base --adapter demo/adapter --dataset demo/gift-i --reference depth"


def run(checkout: Path, folder: Path, demo_arguments: list[str]) -> dict[str, str]:
    """{file: sha256} of what a checkout's demo and evaluation leave in `folder`."""
    folder.mkdir()
    environment = {
        **os.environ,
        "PYTHONPATH": str(checkout.resolve() / "src"),
        "HF_HOME": str(folder / "hf"),
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
    }
    for line in (["demo", "--seed", "0", *demo_arguments], [*EVALUATE.split(), "--protocol", "depth4tom"]):
        command = [sys.executable, "-m", "gift_peft", *line, "--out", "demo" if line[0] == "demo" else "depth4tom"]
        print(f"{checkout}: gift-peft {' '.join(command[3:])}", flush=True)
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"{checkout}: {done.stderr.strip() or done.stdout.strip()}")
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for pattern in COMPARED
        for path in sorted(folder.glob(pattern))
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("demo_arguments", nargs="*", help="after --, more arguments of the demo")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        before = run(args.before, Path(place) / "before", args.demo_arguments)
        after = run(args.after, Path(place) / "after", args.demo_arguments)
    differing = [name for name in before if before[name] != after.get(name)]
    extra = sorted(after.keys() - before.keys())
    for name in differing:
        print(f"{'differs' if name in after else 'missing'}: {name}")
    for name in extra:
        print(f"new: {name}")
    print(f"{len(before) - len(differing)} of {len(before)} files have the same bytes")
    for name in ("demo/adapter/adapter_model.safetensors", "demo/metrics.jsonl"):
        print(f"{after.get(name, 'missing')}  {name}")
    return 1 if differing or extra or not before else 0


if __name__ == "__main__":
    sys.exit(main())
