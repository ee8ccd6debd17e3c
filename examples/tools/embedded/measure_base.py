"""What the embedded base knows, and what the groups can teach it: the figures of its model card.

    python examples/tools/embedded/assemble.py --complete --out renders/complete
    python examples/tools/embedded/measure_base.py --renders renders/base --groups renders/complete/gift-i

Prints delta1 and AbsRel on the held-out opaque scenes, delta1 inside the target on the treated references of the
training groups, and the base's error against that of the consensus (the group median) on the training groups.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from pretrain_base import SIZE, load, score
from transformers import AutoImageProcessor, AutoModelForDepthEstimation

from gift_peft import align, depth_metrics, evaluate_gift_i, load_gift_i
from gift_peft.evaluation.alignment import resize_prediction
from gift_peft.models.pixels import to_pixel_values


def treated_references(model, processor, groups) -> dict[str, list[dict]]:
    """Metrics inside the target, per kind, of the base on the treated references (aligned over the whole picture)."""
    rows: dict[str, list[dict]] = {}
    for row in groups:
        depth = np.asarray(row["depths"][0]).astype(float)
        with torch.no_grad():
            output = model(pixel_values=to_pixel_values([row["reference"]], processor, SIZE)).predicted_depth
        predicted = resize_prediction(output[0], depth.shape)
        aligned = align(predicted, depth, depth > 0, "gift", "inverse_depth").aligned
        target = np.asarray(row["masks"][0]) > 127
        rows.setdefault(row["group_id"].split("_")[0], []).append(depth_metrics(aligned, depth, target))
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--base", type=Path, default=Path("renders/model/base"))
    parser.add_argument("--renders", type=Path, default=Path("renders/base"))
    parser.add_argument("--groups", type=Path, default=Path("renders/complete/gift-i"))
    parser.add_argument("--held_out", type=int, default=100, help="scene files, as in pre-training")
    args = parser.parse_args()
    model = AutoModelForDepthEstimation.from_pretrained(args.base).eval()
    processor = AutoImageProcessor.from_pretrained(args.base)

    held_out = score(model, *load(sorted(args.renders.glob("[0-9]*[0-9].npz"))[: args.held_out]))
    print(f"held-out opaque scenes: delta1 {held_out['delta1']:.1f} %, AbsRel {held_out['abs_rel']:.3f}")
    groups = load_gift_i(args.groups, "train")
    rows = treated_references(model, processor, groups)
    rows["all"] = [row for own in rows.values() for row in own]
    for kind, own in rows.items():
        delta1, abs_rel = (np.mean([row[name] for row in own]) for name in ("delta1", "abs_rel"))
        print(f"treated references, inside the target, {kind}: delta1 {delta1:.1f} %, AbsRel {abs_rel:.3f}")
    for reference in ("depth", "proxy"):
        report = evaluate_gift_i(
            groups, model, reference=reference, processor=processor, size=SIZE, kind="inverse_depth"
        )
        for kind in ("mirror", "pane", "solid", ""):
            own = [row for row in report.rows if row["group_id"].startswith(kind) and not row["skipped"]]
            base, consensus = (np.mean([row[name]["tom"]["rmse"] for row in own]) for name in ("base", "consensus"))
            values = f"base {base:.4g}, consensus {consensus:.4g} ({100 * (consensus / base - 1):+.1f} %)"
            print(f"training groups, {reference}, {kind or 'all'}: {values}")


if __name__ == "__main__":
    main()
