"""How right the target maps themselves are, before anything is trained on them.

    python examples/tools/surface_targets/maps.py --renders renders --sets train validation

The base's error inside the target on the photos and on the treated reference, and how each rule's maps, in place of
the base's prediction, change the former: mean RMSE against true depth, aligned over the whole picture. With `--base`
those of another base model.
"""

import argparse
from pathlib import Path

import numpy as np
import plan
from observed import Observed, read_set
from tqdm import tqdm
from trials import BASE, base_errors, target_maps

from gift_peft import align, depth_metrics

RULES = {
    "automatic, with fills": plan.Rule(),
    "plane, with fills": plan.Rule("plane"),
    "quantile, with fills": plan.Rule("quantile"),
    "automatic, without fills": plan.Rule(fills=0, **plan.HIGH),
    "automatic, from fills alone": plan.Rule(observations=False),
    "median of the fills": plan.Rule("fills' median"),
    "median of the group": plan.Rule("group median"),
}


def treated(group: Observed) -> dict:
    """Metrics inside the target of the base's prediction of the treated reference."""
    depth = group.depths[0].astype(np.float64)
    return depth_metrics(align(group.reference, depth, depth > 0, "gift", "inverse_depth").aligned, depth, group.mask)


def changes(groups: list[Observed], errors: list[np.ndarray], rule: plan.Rule, name: str) -> dict[str, float]:
    """Percent, over all photos and over those of each kind."""
    kinds = np.concatenate([[group.kind] * len(group.images) for group in groups])
    ours = [base_errors(group, target_maps(group, rule, False)) for group in tqdm(groups, name, delay=2)]
    before, after = np.concatenate(errors), np.concatenate(ours)
    chosen = {"all": np.ones(len(kinds), bool)} | {kind: kinds == kind for kind in ("mirror", "pane", "solid")}
    return {kind: 100 * (after[rows].mean() / before[rows].mean() - 1) for kind, rows in chosen.items() if rows.any()}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--renders", type=Path, default=Path("renders"))
    parser.add_argument("--sets", nargs="+", default=["train"])
    parser.add_argument("--base", type=Path, default=BASE)
    args = parser.parse_args()
    for name in args.sets:
        groups = read_set(args.renders / name, args.base)
        errors = [base_errors(group) for group in groups]
        reference = [treated(group) for group in groups]
        rmse, delta1 = (np.mean([metrics[key] for metrics in reference]) for key in ("rmse", "delta1"))
        photos = np.concatenate(errors).mean()
        print(f"{name}: {photos:.0f} mm on the photos; treated {rmse:.0f} mm, delta1 {delta1:.1f} %")
        for label, rule in RULES.items():
            parts = ", ".join(f"{kind} {value:+.1f}" for kind, value in changes(groups, errors, rule, label).items())
            print(f"  {label}: {parts}")


if __name__ == "__main__":
    main()
