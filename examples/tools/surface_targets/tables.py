"""The tables of docs/surface-targets.md, from what `trials.py` left.

    python examples/tools/surface_targets/tables.py trials
    python examples/tools/surface_targets/tables.py trials --against "surface targets"
    python examples/tools/surface_targets/tables.py trials --sets fresh_4 fresh_5 fresh_6

A figure is the change of the mean RMSE against the base in percent: of each set and seed, then their mean. Intervals
are bootstrap intervals over groups (2,000 draws of whole groups within each set, the same draws for all trials, so
that differences are paired, and the same places in each set, which makes them somewhat too wide); seeds of one trial
are averaged within a draw.
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path

import numpy as np

DRAWS = 2000
COLUMNS = (
    ("ToM proxy", "proxy", "tom", None),
    ("Other proxy", "proxy", "other", None),
    ("ToM depth", "depth", "tom", None),
    ("Other depth", "depth", "other", None),
    ("mirror", "depth", "tom", "mirror"),
    ("pane", "depth", "tom", "pane"),
    ("solid", "depth", "tom", "solid"),
)


def read(folder: Path) -> dict[str, list[dict]]:
    """{name of the trial: its results, one per seed}."""
    trials = defaultdict(list)
    for path in sorted(folder.glob("*.json")):
        result = json.loads(path.read_text())
        trials[result["trial"]["name"]].append(result)
    return dict(trials)


def own_sets(result: dict) -> list[str]:
    """The sets of a trial's line in the plan, without those of `--also`."""
    return [name if part == "all" else f"{name}:{part}" for name, part in result["trial"]["score"]]


def of_sets(results: list[dict], names: list[str]) -> list[dict]:
    """The results on these sets alone; those that were not scored on all of them are left out."""
    return [
        result | {"sets": {name: result["sets"][name] for name in names}}
        for result in results
        if result["sets"].keys() >= set(names)
    ]


def changes(results: list[dict], reference: str, region: str, kind: str | None, draws: bool) -> np.ndarray:
    """(1,) the figure, or (DRAWS,) its draws."""
    per_set = []
    for name in results[0]["sets"]:
        per_seed = []
        for result in results:
            rows = [row for row in result["sets"][name][reference]["rows"] if kind in (None, row["kind"])]
            groups = sorted({row["group_id"] for row in rows})
            place = {group: index for index, group in enumerate(groups)}
            sums = np.zeros((2, len(groups)))
            for row in rows:
                sums[:, place[row["group_id"]]] += row["base"][region], row["adapted"][region]
            weights = np.ones((1, len(groups)))
            if draws:
                even = np.full(len(groups), 1 / len(groups))
                weights = np.random.default_rng(0).multinomial(len(groups), even, DRAWS).astype(float)
            before, after = weights @ sums[0], weights @ sums[1]
            per_seed.append(100 * (after / before - 1))
        per_set.append(np.mean(per_seed, axis=0))
    return np.mean(per_set, axis=0)


def agreement(results: list[dict]) -> float:
    """Change of GCE in percent, mean over sets and seeds."""
    pairs = [part["depth"]["gce"] for result in results for part in result["sets"].values()]
    return float(np.mean([100 * (pair["adapted"] / pair["base"] - 1) for pair in pairs]))


def line(name: str, results: list[dict], intervals: bool) -> str:
    cells = [name, str(len(results)), f"{results[0]['photos']:,}"]
    for _, reference, region, kind in COLUMNS:
        cell = f"{changes(results, reference, region, kind, False)[0]:+.1f}"
        if intervals and kind is None:
            low, high = np.percentile(changes(results, reference, region, kind, True), (2.5, 97.5))
            cell += f" [{low:+.0f}, {high:+.0f}]"
        cells.append(cell)
    alarm = any(part["depth"]["collapse"] for result in results for part in result["sets"].values())
    return f"| {' | '.join([*cells, f'{agreement(results):+.0f}', 'ALARM' if alarm else 'no'])} |"


def difference(results: list[dict], others: list[dict]) -> str:
    """Of ToM and Other: this trial's change minus the other's, in points, with a paired interval."""
    cells = []
    for title, reference, region, kind in COLUMNS[:4]:
        middle = changes(results, reference, region, kind, False) - changes(others, reference, region, kind, False)
        draws = changes(results, reference, region, kind, True) - changes(others, reference, region, kind, True)
        low, high = np.percentile(draws, (2.5, 97.5))
        cells.append(f"{title} {middle[0]:+.1f} [{low:+.1f}, {high:+.1f}]")
    return ", ".join(cells)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trials", type=Path)
    parser.add_argument("--against", help="a trial: paired differences of all others to it")
    parser.add_argument("--sets", nargs="+", help="these, and trials scored on all of them; default: each trial's own")
    parser.add_argument("--no-intervals", action="store_true")
    args = parser.parse_args()
    chosen = {name: of_sets(results, args.sets or own_sets(results[0])) for name, results in read(args.trials).items()}
    trials = {name: results for name, results in chosen.items() if results}
    if args.against and args.against not in trials:
        parser.error(f"--against {args.against}: no such trial was scored on these sets")
    heads = ["trial", "seeds", "photos", *(title for title, *_ in COLUMNS), "GCE", "alarm"]
    print(f"| {' | '.join(heads)} |\n|---|{'---:|' * (len(heads) - 1)}")
    for name, results in trials.items():
        print(line(name, results, not args.no_intervals))
    if args.against:
        print(f"\nAgainst {args.against}, points:")
        for name, results in trials.items():
            if name != args.against:
                print(f"- {name}: {difference(results, trials[args.against])}")


if __name__ == "__main__":
    main()
