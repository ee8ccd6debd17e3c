"""How good mask proposals are: intersection over union with the drawn masks of a dataset that has them.

    python examples/tools/measure_proposals.py src/gift_peft/demo/gift-i --split validation

Prints one line a group and the mean. A group's treated reference takes part where it has a single observation, or
with --reference everywhere.
"""

import argparse

import numpy as np

import gift_peft
from gift_peft.prepare.proposals import propose


def measure(dataset: str, split: str, reference: bool = False) -> list[tuple[str, float, float]]:
    """(group id, intersection over union with the pixels that most of its masks mark, score) of every group."""
    rows = []
    for row in gift_peft.load_gift_i(dataset, split):
        images = [np.asarray(image) for image in row["images"]]
        if row["reference"] is not None and (reference or len(images) == 1):
            images.append(np.asarray(row["reference"]))
        drawn = np.mean([np.asarray(mask) > 127 for mask in row["masks"]], axis=0) > 0.5
        proposal = propose(images)
        union = (proposal.mask | drawn).sum()
        rows.append((row["group_id"], float((proposal.mask & drawn).sum() / union) if union else 1.0, proposal.score))
        print(f"{rows[-1][0]:24} IoU {rows[-1][1]:.3f}  score {rows[-1][2]:.2f}", flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", help="GIFT-I: raw tree, prepared folder, parquet release or hub id")
    parser.add_argument("--split", default="validation")
    parser.add_argument("--reference", action="store_true", help="use the treated reference as one more image")
    args = parser.parse_args()
    rows = measure(args.dataset, args.split, args.reference)
    print(f"{len(rows)} groups: mean IoU {np.mean([overlap for _, overlap, _ in rows]):.3f}")


if __name__ == "__main__":
    main()
