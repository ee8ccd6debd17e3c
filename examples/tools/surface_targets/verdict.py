"""Can one tell without any reference whether a group's surface target will be better than the base?

    python examples/tools/surface_targets/verdict.py --renders renders --groups 160

Cases from re-rendered training groups, whose true depth is known: the group as it is; only the photos in which the
surface cannot be seen; the mask moved to where nothing is wrong (an opaque wall, board or table); the treated surface
in place of the photos, as if an opaque board had been masked. Each case's numbers are those that `gift-peft proxies`
prints. A logistic rule is fitted to them in five folds of scenes; its AUC and balanced accuracy are over the scenes
that it did not see.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from observed import SIZE, Observed, read_set
from PIL import Image
from tqdm import tqdm
from trials import BASE, base_errors

from gift_peft.evaluation.surface_check import describe
from gift_peft.models.loading import DepthModel
from gift_peft.surface_targets import paint_fills, surface_target

NUMBERS = ("nearer", "moved", "disagreement", "residual")


def moved_mask(rng, mask: np.ndarray) -> np.ndarray | None:
    """The mask shifted to a place that it did not touch, or None where there is no room."""
    rows, columns = np.nonzero(mask)
    height, width = mask.shape
    for _ in range(200):
        down = rng.integers(-rows.min(), height - rows.max())
        right = rng.integers(-columns.min(), width - columns.max())
        shifted = np.zeros_like(mask)
        shifted[rows + down, columns + right] = True
        if not (shifted & mask).any():
            return shifted
    return None


def cases(group: Observed, model: DepthModel, rng) -> list[tuple[str, Observed]]:
    """(what it is, the group) of one scene."""
    found = [("as it is", group)]
    hidden = np.flatnonzero(~group.seen)
    if len(hidden):
        found.append(("hallucinating", group.only(hidden)))
    other = moved_mask(rng, group.mask)
    if other is not None:
        found.append(("wrong mask", _again(group, group.images[:2], group.depths[:2], other, model)))
    found.append(("opaque board", _again(group, group.treated[None], group.depths[:1], group.mask, model)))
    return found


def _again(group: Observed, images, depths, mask, model: DepthModel) -> Observed:
    """Other photos or another mask of the scene: predicted anew."""
    pictures = [Image.fromarray(image) for image in images]
    base = model.predict(model.inputs(pictures)).numpy()
    fills = np.stack(
        [
            model.predict(torch.cat([model.inputs([Image.fromarray(f)]) for f in paint_fills(image, mask, 6)])).numpy()
            for image in images
        ]
    )
    values = dict(vars(group)) | {"images": images, "depths": depths, "mask": mask, "base": base, "fills": fills}
    return Observed(**values | {"base_flipped": base, "fills_flipped": fills, "seen": np.ones(len(images), bool)})


def measure(group: Observed) -> tuple[list[float], float]:
    """(the numbers, the relative change of the error inside the mask)."""
    found = surface_target(group.base, np.broadcast_to(group.mask, group.base.shape), fills=group.fills)
    told = describe(group.pictures(), torch.from_numpy(group.base), found, "inverse_depth")
    own = [np.mean([row[name] or 0.0 for row in told["observations"]]) for name in NUMBERS[:2]]
    own += [np.mean([value for value in told[name] if value is not None] or [0.0]) for name in NUMBERS[2:]]
    before, after = base_errors(group).mean(), base_errors(group, found.depth).mean()
    return [float(value) for value in own], after / before - 1


def area_under_curve(score: np.ndarray, worse: np.ndarray) -> float:
    """The chance that a case that worsens scores higher than one that does not; ties count half."""
    above = score[worse][:, None] - score[~worse][None]
    return float(np.mean((above > 0) + 0.5 * (above == 0)))


def logistic(numbers: np.ndarray, worse: np.ndarray) -> np.ndarray:
    """Weights (K+1,) of a logistic rule with a light ridge, by Newton's method; both answers weigh the same."""
    design = np.c_[np.ones(len(numbers)), numbers]
    balance = np.where(worse, 0.5 / worse.mean(), 0.5 / (~worse).mean())
    weights = np.zeros(design.shape[1])
    ridge = np.diag([0.0, *[1.0] * numbers.shape[1]])
    for _ in range(50):
        chance = 1 / (1 + np.exp(-design @ weights))
        slope = design.T @ (balance * (chance - worse)) + ridge @ weights
        curve = (design * (balance * chance * (1 - chance))[:, None]).T @ design + ridge
        weights -= np.linalg.solve(curve, slope)
    return weights


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--renders", type=Path, default=Path("renders"))
    parser.add_argument("--set", default="shipped/train")
    parser.add_argument("--groups", type=int, default=160)
    args = parser.parse_args()
    groups = read_set(args.renders / args.set, BASE)[: args.groups]
    model = DepthModel.from_pretrained(BASE, size=SIZE)
    rng = np.random.default_rng(0)
    names, scenes, numbers, changes = [], [], [], []
    for scene, group in enumerate(tqdm(groups, "cases", unit="scene")):
        for name, case in cases(group, model, rng):
            own, change = measure(case)
            names.append(name), scenes.append(scene), numbers.append(own), changes.append(change)
    names, scenes, numbers, changes = map(np.array, (names, scenes, numbers, changes))
    worse = changes > 0
    print(f"{len(worse)} cases of {len(groups)} scenes, {worse.sum()} of them worse than the base")
    for name in dict.fromkeys(names.tolist()):
        own = names == name
        middle = ", ".join(f"{n} {v:.3f}" for n, v in zip(NUMBERS, np.median(numbers[own], 0), strict=True))
        change = f"{100 * np.median(changes[own]):+.0f} % in the median"
        print(f"  {name}: {own.sum()}, change {change}, {worse[own].mean():.0%} worse; {middle}")
    for index, name in enumerate(NUMBERS):
        print(f"  {name} alone: AUC {area_under_curve(numbers[:, index], worse):.2f}")
    scaled = (numbers - numbers.mean(0)) / numbers.std(0)
    score = np.zeros(len(worse))
    for fold in range(5):
        test = scenes % 5 == fold
        weights = logistic(scaled[~test], worse[~test])
        score[test] = np.c_[np.ones(test.sum()), scaled[test]] @ weights
    told = score > 0
    balanced = (np.mean(told[worse]) + np.mean(~told[~worse])) / 2
    area = area_under_curve(score, worse)
    print(f"logistic rule, five folds of scenes: AUC {area:.2f}, balanced accuracy {balanced:.2f}")
    print("weights on all:", dict(zip(("constant", *NUMBERS), logistic(scaled, worse).round(3).tolist(), strict=True)))
    print("mean", numbers.mean(0).round(4).tolist(), "std", numbers.std(0).round(4).tolist())


if __name__ == "__main__":
    main()
