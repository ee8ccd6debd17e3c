"""What is tried: the lines of `trials.py`."""

from dataclasses import asdict, dataclass

from observed import Observed


@dataclass(frozen=True)
class Rule:
    """How the target maps are made.

    Args:
        statistic: "auto", "plane", "quantile" (the package's), or a control of `trials.target_maps`.
        fills: so many of each photo; `observations`: whether the photo's own prediction counts too.
    """

    statistic: str = "auto"
    quantile: float = 0.8
    tau: float = 0.7
    fills: int = 6
    observations: bool = True


@dataclass(frozen=True)
class Trial:
    """One training. `rule` None is the paper's objective; `train` and `score` are (set, part) pairs."""

    name: str
    train: tuple[tuple[str, str], ...]
    score: tuple[tuple[str, str], ...]
    rule: Rule | None = Rule()
    photos: str = "all"
    count: int = 0
    lambda_c: float = 2.0
    lambda_d: float = 0.9
    rate: float = 2e-4
    epochs: int = 4
    updates: int = 0
    batch: int = 4
    flips: bool = True

    def describe(self) -> dict:
        return asdict(self)


def part(groups: list[Observed], name: str) -> list[Observed]:
    """A part of a set: "all", every fourth group, or the others."""
    return {"all": groups, "fourth": groups[::4], "others": [g for i, g in enumerate(groups) if i % 4]}[name]


TRAIN = (("train", "all"),)
OLD = (("validation", "all"),)
FRESH = (("fresh_1", "all"), ("fresh_2", "all"), ("fresh_3", "all"))


def first(name: str, **options) -> Trial:
    return Trial(name, TRAIN, OLD, **options)


STAGES = {
    "first": [
        first("auto lambda_c 1 8 epochs", lambda_c=1.0, epochs=8),
        first("auto without fills lambda_c 1.2 8 epochs", rule=Rule(fills=0), lambda_c=1.2, epochs=8),
        first("consensus 8 epochs", rule=None, lambda_c=1.0, flips=False, epochs=8),
        first("auto 8 epochs rate 1e-4", epochs=8, rate=1e-4),
    ],
}
