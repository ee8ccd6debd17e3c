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
    quantile: float = 0.65
    tau: float = 0.5
    fills: int = 6
    observations: bool = True


@dataclass(frozen=True)
class Trial:
    """One training. `rule` None is the paper's objective; `train` and `score` are (set, `part`) pairs.

    `jitter` as `--color-jitter`.
    """

    name: str
    train: tuple[tuple[str, str | int], ...]
    score: tuple[tuple[str, str | int], ...]
    rule: Rule | None = Rule()
    photos: str = "all"
    lambda_c: float = 2.0
    lambda_d: float = 0.9
    rate: float = 2e-4
    epochs: int = 4
    updates: int = 0
    batch: int = 4
    flips: bool = True
    jitter: float = 0.0

    def describe(self) -> dict:
        return asdict(self)


def part(groups: list[Observed], which: str | int) -> list[Observed]:
    """A part of a set: "all", every fourth group, the others, or the first so many, the kinds in turn."""
    if isinstance(which, int):
        if len(groups) < which:
            raise SystemExit(f"{len(groups)} groups are rendered: render {which}")
        return sorted(groups, key=lambda group: group.name.split("_")[-1])[:which]
    return {"all": groups, "fourth": groups[::4], "others": [g for i, g in enumerate(groups) if i % 4]}[which]


TRAIN = (("train", "all"),)
OLD = (("validation", "all"),)
MANY = (*TRAIN, ("singles", 1000))
FRESH = (("fresh_1", "all"), ("fresh_2", "all"), ("fresh_3", "all"))
UNSEEN = (("fresh_4", "all"), ("fresh_5", "all"), ("fresh_6", "all"))  # rendered after FRESH had been looked at

CYCLES, SCORED_CYCLES = (("blender_train", "all"),), (("blender", "all"),)


def first(name: str, **options) -> Trial:
    return Trial(name, TRAIN, OLD, **options)


# On training groups and the older validation groups: docs/surface-targets.md.
CHOSEN = {"lambda_c": 1.4, "epochs": 8}
HIGH = {"quantile": 0.8, "tau": 0.7}  # without fills


def report(name: str, **options) -> Trial:
    return Trial(name, TRAIN, FRESH, **CHOSEN | options)


def single(name: str, count: int) -> Trial:
    return Trial(name, (("singles", count),), FRESH, updates=2196, **CHOSEN)


PAPER = {"rule": None, "lambda_c": 1.0, "flips": False}

OLD_RULE = Rule(**HIGH)

STAGES = {
    "development": [
        first("auto", rule=OLD_RULE),
        first("auto 8 epochs", rule=OLD_RULE, epochs=8),
        first("auto lambda_c 1 8 epochs", rule=OLD_RULE, lambda_c=1.0, epochs=8),
        first("auto without fills", rule=Rule(fills=0, **HIGH)),
        first("auto without fills lambda_c 1.2 8 epochs", rule=Rule(fills=0, **HIGH), lambda_c=1.2, epochs=8),
        first("consensus", **PAPER),
        first("consensus 8 epochs", **PAPER, epochs=8),
    ],
    "main": [report("surface targets"), report("paper's objective", **PAPER)],
    "controls": [
        report("without fills", rule=Rule(fills=0, **HIGH)),
        report("fills' median (Depth4ToM's label)", rule=Rule("fills' median")),
        report("group median, static", rule=Rule("group median")),
        report("mean shift alone", rule=Rule("shift")),
        report("true depth (upper bound)", rule=Rule("truth")),
        report("fills alone", rule=Rule(observations=False)),
        report("plane for all", rule=Rule("plane")),
        report("quantile for all", rule=Rule("quantile")),
        report("fills alone, plane", rule=Rule("plane", observations=False)),
        report("fills alone, quantile", rule=Rule("quantile", observations=False)),
        report("without fills, plane", rule=Rule("plane", fills=0, **HIGH)),
        report("without fills, quantile", rule=Rule("quantile", fills=0, **HIGH)),
    ],
    # The observations of each training group on which the base errs most.
    "hallucinating": [
        report("surface targets, worse half", photos="worse half"),
        report("paper's objective, worse half", photos="worse half", **PAPER),
    ],
    # Photos of scenes of their own in which the surface cannot be seen; all with the updates of the main runs.
    "singles": [
        single("318 single photos", 318),
        single("50 single photos", 50),
        single("100 single photos", 100),
        single("1000 single photos", 1000),
        Trial("one covered photo of each group", TRAIN, FRESH, photos="one covered", updates=2196, **CHOSEN),
    ],
    # What true depth as the target does not reach either: more photos, more updates.
    "more": [
        report("surface targets, 24 epochs", epochs=24),
    ],
    # Four times the scenes, and other light; the older validation groups choose, the sets after them report.
    "many": [
        Trial("groups alone", TRAIN, (*OLD, *UNSEEN), **CHOSEN),
        Trial("groups alone, other light", TRAIN, (*OLD, *UNSEEN), jitter=0.3, **CHOSEN),
        Trial("groups and 1000 single photos", MANY, (*OLD, *UNSEEN, *FRESH), **CHOSEN),
        Trial(
            "groups and 1000 single photos, 16 epochs, other light",
            MANY,
            (*OLD, *UNSEEN, *FRESH),
            jitter=0.3,
            **CHOSEN | {"epochs": 16},
        ),
        Trial(
            "groups and 1000 single photos, 16 epochs, other light, quantile for all",
            MANY,
            (*OLD, *UNSEEN, *FRESH),
            rule=Rule("quantile"),
            jitter=0.3,
            **CHOSEN | {"epochs": 16},
        ),
        Trial("groups alone, quantile for all", TRAIN, (*OLD, *UNSEEN), rule=Rule("quantile"), **CHOSEN),
    ],
    # Photos of the other renderer's own rooms (blender_groups.py, other seeds), scored on that renderer's groups; all
    # with the updates of surface targets in the main runs.
    "renderer": [
        Trial("surface targets, the renderer's own", CYCLES, SCORED_CYCLES, updates=2196, **CHOSEN),
        Trial("paper's objective, the renderer's own", CYCLES, SCORED_CYCLES, updates=2196, **CHOSEN | PAPER),
    ],
    # The paper's objective over the grid, on the older validation groups.
    "paper's grid": [
        first("consensus lambda_c 1.4 8 epochs", **PAPER | {"lambda_c": 1.4}, epochs=8),
        first("consensus flips 8 epochs", **PAPER | {"flips": True}, epochs=8),
        first("consensus rate 4e-4 8 epochs", **PAPER, rate=4e-4, epochs=8),
    ],
}
