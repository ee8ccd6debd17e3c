"""GIFT-I's epoch in numbers (paper, supplement B), and how a sample of its groups stands for it."""

from __future__ import annotations

from dataclasses import dataclass

# {group size: groups}: a log-normal distribution, adjusted until all three sums are GIFT-I's (paper, supplement B).
GROUP_SIZES = {
    2: 10, 3: 21, 4: 34, 5: 33, 6: 39, 7: 31, 8: 27, 9: 28, 10: 27, 11: 18, 12: 15, 13: 9, 14: 13, 15: 10, 16: 3,
    17: 6, 18: 5, 19: 2, 20: 2, 21: 3, 22: 3, 23: 1, 24: 3, 25: 2, 26: 1, 27: 1, 29: 1, 31: 1, 33: 1, 35: 1, 40: 1,
    55: 1,
}  # fmt: skip


@dataclass
class Stratum:
    """The groups up to a size, and the size of the one that stands for them."""

    groups: int
    images: int
    pairs: int
    sample: int


def make_strata(limits: tuple[int, ...]) -> list[Stratum]:
    strata, low = [], 1
    for high in limits:
        inside = {n: count for n, count in GROUP_SIZES.items() if low < n <= high}
        groups, images = sum(inside.values()), sum(n * count for n, count in inside.items())
        pairs = sum(n * (n - 1) // 2 * count for n, count in inside.items())
        strata.append(Stratum(groups, images, pairs, round(images / groups)))
        low = high
    return strata


@dataclass
class Timing:
    """Seconds of a group's updates, in all and per phase; image forwards; updates."""

    seconds: float
    phases: dict[str, float]
    forwards: int
    updates: int

    def in_epoch(self, stratum: Stratum, method: str) -> Timing:
        """What the groups of the stratum take, if their images (in (a): their pairs) take as long as these."""
        scale = stratum.pairs / self.updates if method == "a" else stratum.images / stratum.sample
        phases = {name: value * scale for name, value in self.phases.items()}
        seconds = self.seconds * scale
        if method == "a":  # a group is loaded once for all of its pairs
            phases["load"] = self.phases["load"] * stratum.groups
            seconds = (self.seconds - self.phases["load"]) * scale + phases["load"]
        updates = stratum.pairs if method == "a" else stratum.groups
        return Timing(seconds, phases, round(self.forwards * scale), updates)

    def __add__(self, other: Timing) -> Timing:
        phases = {name: value + other.phases[name] for name, value in self.phases.items()}
        return Timing(
            self.seconds + other.seconds, phases, self.forwards + other.forwards, self.updates + other.updates
        )
