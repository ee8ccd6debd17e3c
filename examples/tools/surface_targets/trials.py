"""Train the embedded base in one of many ways on rendered groups, and score it on others.

    python examples/tools/surface_targets/trials.py --renders renders --out trials development
    python examples/tools/surface_targets/trials.py --renders renders --out trials main --seeds 0 1 2

A trial is a line of `plan.py`: which photos, what they are pulled to, and the weights. Every trial trains the same
parts with the same number of updates unless its line says otherwise, keeps the last adapter, and scores it once on
each set and on those of `--also`; finished ones are skipped. `tables.py` reads what stands in `--out`.
"""

import argparse
import hashlib
import json
import os
import time
from pathlib import Path

import numpy as np
import plan
import torch
from observed import SIZE, Observed, fingerprint, read_set
from tqdm import tqdm

from gift_peft import GroupStep, evaluate_gift_i, get_gift_model, save_adapter
from gift_peft.dataset.light import in_light
from gift_peft.dataset.loader import epoch_flips, epoch_order
from gift_peft.evaluation.alignment import align
from gift_peft.models.loading import DepthModel, load_base
from gift_peft.surface_targets import surface_target
from gift_peft.training.speed import channels_last_head
from gift_peft.training.surface_step import PredictedDepth, SurfaceStep

BASE = Path(__file__).resolve().parents[3] / "src" / "gift_peft" / "demo" / "base"


def target_maps(group: Observed, rule: plan.Rule, flipped: bool) -> np.ndarray:
    """(N,H,W): what every observation of a group is pulled to inside the mask; outside, its own prediction."""
    turn = slice(None, None, -1) if flipped else slice(None)
    own, fills = (group.base_flipped, group.fills_flipped) if flipped else (group.base, group.fills)
    mask = np.broadcast_to(group.mask[:, turn], own.shape)
    if rule.statistic in ("auto", "plane", "quantile"):
        observations, painted = (own, fills[:, : rule.fills]) if rule.observations else (fills[:, 0], fills[:, 1:])
        found = surface_target(
            observations, mask, None, painted, "inverse_depth", None, rule.statistic, rule.quantile, rule.tau
        ).depth
        return np.where(mask, found, own)
    if rule.statistic == "group median":  # the minimum of Eq. 3
        return np.where(mask, np.median(own, axis=0), own)
    if rule.statistic == "fills' median":  # Depth4ToM's label
        return np.where(mask, np.median(fills, axis=1), own)
    if rule.statistic == "shift":  # the surface target's mean shift and nothing of its shape
        surface = target_maps(group, plan.Rule(), flipped)
        moved = [np.mean((there - here)[one]) for there, here, one in zip(surface, own, mask, strict=True)]
        return np.where(mask, own + np.array(moved)[:, None, None], own)
    if rule.statistic == "truth":
        maps = []
        for depth, here, one in zip(group.depths[:, :, turn], own, mask, strict=True):
            inverse = 1 / depth.astype(np.float64)
            slope, offset = np.polyfit(inverse[~one], here[~one], 1)
            maps.append(np.where(one, slope * inverse + offset, here))
        return np.stack(maps)
    raise ValueError(f"unknown statistic {rule.statistic}")


def kept_maps(store: Path, groups: list[Observed], rule: plan.Rule, flipped: bool) -> list[torch.Tensor]:
    """`target_maps` of all groups, float32; computed once for each rule and choice of photos."""
    key = hashlib.blake2b(repr((rule, flipped)).encode(), digest_size=8)
    for group in groups:
        key.update(f"{group.name} {group.base.sum():.9e}".encode())
    path = store / f"maps-{key.hexdigest()}.pt"
    if not path.exists():
        maps = [
            torch.from_numpy(target_maps(group, rule, flipped)).float()
            for group in tqdm(groups, f"targets, {rule.statistic}", delay=5)
        ]
        torch.save(maps, path.with_suffix(".part"))
        os.replace(path.with_suffix(".part"), path)
    return torch.load(path)


def train(trial: plan.Trial, groups: list[Observed], seed: int, store: Path, base: Path):
    """The model with its trained adapter, and seconds of training."""
    model, processor = load_base(base)
    torch.manual_seed(seed)
    network = get_gift_model(model).eval()
    parameters = [p for p in network.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(parameters, lr=trial.rate)
    helper = DepthModel(network, processor, SIZE)
    inputs = [helper.inputs(group.pictures().images) for group in groups]
    began = time.perf_counter()
    if trial.rule is None:
        update, feed, epoch = _consensus(network, trial, groups, inputs, seed)
    else:
        update, feed, epoch = _surface(network, processor, trial, groups, inputs, seed, store)
    total = trial.updates or trial.epochs * epoch
    with channels_last_head(network):
        for number, item in zip(tqdm(range(total), trial.name, mininterval=20), feed, strict=False):
            optimizer.param_groups[0]["lr"] = trial.rate * (1 - number / total)
            update(item)
            optimizer.step()
    return helper, time.perf_counter() - began


def _orders(count: int, seed: int):
    epoch = 0
    while True:
        yield epoch, epoch_order(count, seed, epoch)
        epoch += 1


def _consensus(network, trial, groups, inputs, seed):
    step = GroupStep(network, trial.lambda_c, trial.lambda_d, 4)

    def feed():
        for epoch, order in _orders(len(groups), seed):
            flips = epoch_flips(len(order), seed, epoch) if trial.flips else [False] * len(order)
            yield from zip(order, flips, strict=True)

    def update(item):
        index, flip = item
        group, turn = groups[index], slice(None, None, -1) if item[1] else slice(None)
        mask = torch.from_numpy(np.repeat(group.mask[None, :, turn], len(group.images), 0).copy())
        proxies = torch.from_numpy(group.base_flipped if flip else group.base)
        for parameter in network.parameters():
            parameter.grad = None
        step.accumulate(inputs[index].flip(-1) if flip else inputs[index], mask, proxies)

    return update, feed(), len(groups)


def _surface(network, processor, trial, groups, inputs, seed, store):
    step = SurfaceStep(PredictedDepth(network), trial.lambda_c, trial.lambda_d, 4)
    places = [(row, image) for row, group in enumerate(groups) for image in range(len(group.images))]
    both = [False, True] if trial.flips else [False]
    generator = torch.Generator().manual_seed(seed)
    maps = {flip: kept_maps(store, groups, trial.rule, flip) for flip in both}

    def feed():
        for epoch, order in _orders(len(places), seed):
            flips = epoch_flips(len(order), seed, epoch) if trial.flips else [False] * len(order)
            items = [(*places[index], flip) for index, flip in zip(order, flips, strict=True)]
            yield from (items[start : start + trial.batch] for start in range(0, len(items), trial.batch))

    def update(items):
        pixels, masks, wanted = [], [], []
        for row, image, flip in items:
            one, mask = inputs[row][image], torch.from_numpy(groups[row].mask)
            pixels.append(one.flip(-1) if flip else one)
            masks.append(mask.flip(-1) if flip else mask)
            wanted.append(maps[flip][row][image])
        photos = torch.stack(pixels)
        if trial.jitter:
            drawn = 1 + trial.jitter * (2 * torch.rand(len(photos), 5, generator=generator) - 1)
            photos = in_light(photos, drawn.numpy(), processor)
        step.accumulate(photos, torch.stack(masks), torch.stack(wanted))

    return update, feed(), -(-len(places) // trial.batch)


def choose(groups: list[Observed], photos: str) -> list[Observed]:
    """The observations that a trial trains on."""
    if photos == "all":
        return groups
    if photos == "unseen singles":  # each photo in which the surface is not seen, a group of its own
        return [group.only([i]) for group in groups for i in np.flatnonzero(~group.seen)]
    if photos == "seen singles":
        return [group.only([i]) for group in groups for i in np.flatnonzero(group.seen)]
    if photos == "one covered":  # one of each group, in which the surface shows
        return [group.only(np.flatnonzero(group.seen)[:1]) for group in groups if group.seen.any()]
    if photos == "singles":
        return [group.only([i]) for group in groups for i in range(len(group.images))]
    if photos == "worse half":  # at least two, by the base's own error inside the target
        chosen = []
        for group in groups:
            errors = base_errors(group)
            keep = np.sort(np.argsort(-errors)[: max(2, len(errors) // 2)])
            chosen.append(group.only(keep))
        return chosen
    raise ValueError(f"unknown photos {photos}")


def base_errors(group: Observed, maps: np.ndarray | None = None) -> np.ndarray:
    """(N,) RMSE inside the target against true depth in mm, of the base or of other maps in its place."""
    errors = []
    for here, depth in zip(group.base if maps is None else maps, group.depths, strict=True):
        aligned = np.asarray(align(here, depth.astype(np.float64), depth > 0, "gift", "inverse_depth").aligned)
        errors.append(np.sqrt(np.mean((aligned - depth)[group.mask] ** 2)))
    return np.array(errors)


def score(model: DepthModel, groups: list[Observed]) -> dict:
    """Per reference the report's figures and, for intervals, one line per image."""
    pictures = [group.pictures() for group in groups]
    kinds = {group.name: group.kind for group in groups}
    result = {}
    for reference in ("proxy", "depth"):
        report = evaluate_gift_i(pictures, model, reference=reference, progress=False)
        rows = [
            {"group_id": row["group_id"], "image": row["image"], "kind": kinds[row["group_id"]]}
            | {who: {region: row[who][region]["rmse"] for region in ("tom", "other")} for who in ("base", "adapted")}
            for row in report.rows
        ]
        result[reference] = {"rows": rows, "gce": report.gce, "collapse": report.collapse["alarm"]}
    return result


def run(trial: plan.Trial, seed: int, sets: dict[str, list[Observed]], out: Path, base: Path, scored) -> None:
    """Train, keep the adapter, and add the scores on the sets that are missing in the trial's result.

    Raises SystemExit where a result of another trial or base has the name.
    """
    path = out / f"{trial.name.replace(' ', '_').replace('/', '-')}.{seed}.json"
    adapter = path.with_suffix("")
    described = json.loads(json.dumps(trial.describe())) | {"base": fingerprint(base)}
    result = json.loads(path.read_text()) if path.exists() else None
    if result and result["trial"] | {"score": 0} != described | {"score": 0}:
        raise SystemExit(f"{path} is of another trial or base: take another --out")
    keys = {name if part == "all" else f"{name}:{part}": (name, part) for name, part in scored}
    if result and keys.keys() <= result["sets"].keys():
        return
    if result and adapter.exists():
        model = DepthModel.from_pretrained(base, adapter, size=SIZE)
    else:  # without its adapter a result cannot be added to
        groups = [group for name, part in trial.train for group in plan.part(sets[name], part)]
        groups = choose(groups, trial.photos)
        model, seconds = train(trial, groups, seed, out, base)
        save_adapter(model.network, adapter, str(base), processor=model.processor, size=SIZE)
        result = {"trial": described, "seed": seed, "photos": sum(len(group.images) for group in groups)}
        result |= {"groups": len(groups), "train_seconds": seconds, "sets": {}}
    for key in sorted(keys.keys() - result["sets"].keys()):
        result["sets"][key] = score(model, plan.part(sets[keys[key][0]], keys[key][1]))
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(result))
    os.replace(temporary, path)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stage", choices=sorted(plan.STAGES))
    parser.add_argument("--renders", type=Path, default=Path("renders"))
    parser.add_argument("--out", type=Path, default=Path("trials"))
    parser.add_argument("--base", type=Path, default=BASE, help="another base model")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--only", help="the one of this name")
    parser.add_argument("--also", nargs="+", default=[], help="sets to score on besides the trial's own")
    args = parser.parse_args()
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "2")))
    args.out.mkdir(parents=True, exist_ok=True)
    trials = [trial for trial in plan.STAGES[args.stage] if args.only in (None, trial.name)]
    also = tuple((name, "all") for name in args.also)
    needed = sorted({name for trial in trials for name, _ in (*trial.train, *trial.score, *also)})
    sets = {name: read_set(args.renders / name, args.base) for name in needed}
    for seed in args.seeds:
        for trial in trials:
            run(trial, seed, sets, args.out, args.base, (*trial.score, *also))


if __name__ == "__main__":
    main()
