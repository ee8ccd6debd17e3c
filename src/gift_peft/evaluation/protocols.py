"""Named sets of evaluation choices: a depth error means nothing without the way it was aligned and averaged.

Every table prints the protocol it was made with. `gift` is the paper's affine-aligned evaluation (Experiments,
"Metrics and affine-aligned evaluation"); `native` is the same fit inside the teacher's own output space; the others
are what published evaluators do, so that numbers can be compared with theirs.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from gift_peft.rules import KINDS

METRICS = ("mae", "abs_rel", "rmse", "delta1")


def metric_names(thresholds: Sequence[float] = ()) -> tuple[str, ...]:
    """The keys of `depth_metrics` with these thresholds: `delta_1.05` is the percentage within a factor of 1.05."""
    return (*METRICS, *(f"delta_{threshold:.2f}" for threshold in thresholds))


# A choice that nothing computes must not stand under a table.
CHOICES = {
    "space": ("auto", "depth", "inverse", "native"),
    "dof": ("scale_shift", "none"),
    "loss": ("l2", "l1_rel"),
    "inverse_loss": (None, "l2", "l1_rel"),
    "floor": (None, "ref_max"),
    "nonpositive": ("far", "near"),
    "expects": (None, *KINDS),
    "unit": ("mm", "cm", "native"),
}
MILLIMETERS = {"mm": 1.0, "cm": 10.0, "native": 1.0}  # in a protocol's unit


@dataclass(frozen=True)
class Protocol:
    """The choices behind one number. What is fitted is fitted over all valid pixels, target and surroundings alike;
    a mean is over images, of each image's own metric.

    Args:
        name (`str`): key in `PROTOCOLS`.
        space (`str`): where the fit happens. `auto`: where the prediction lives, so an inverse-depth prediction is
            fitted to 1/reference and inverted. `depth`: depth, whatever the prediction is. `inverse`: 1/reference; a
            depth prediction is inverted first. `native`: prediction and reference share a space, nothing is inverted.
        dof (`str`): what is fitted: `scale_shift`, or `none`.
        loss (`str`): the fit's loss. `l2`: least squares, in closed form. `l1_rel`: sum |s d + t - y| / y, exactly, on
            the valid pixels nearest to the centres of a 64x64 grid.
        inverse_loss (`str`, *optional*): the loss where the fit is in inverse depth; default `loss`.
        clip (`tuple[float, float]`, *optional*): working range in the reference's unit, applied after alignment and
            inversion.
        floor (`str`, *optional*): `ref_max`: an aligned inverse depth is raised to that of the farthest reference.
        nonpositive (`str`): what an aligned inverse depth below 0 means: `far`, the upper end of `clip`, or `near`,
            the lower one. (0 is infinitely far in both.)
        resolution (`float`, *optional*): metrics are taken on the reference's grid times this factor; None leaves it
            to the evaluation, whose report states it.
        unit (`str`): of the reference, the clip range, MAE and RMSE: `mm`, `cm` or `native`.
        thresholds (`tuple[float, ...]`): further deltas in the report, beside that of 1.25.
        ranked_by (`str`, *optional*): the metric of the target by which the published benchmark ranks.
        expects (`str`, *optional*): what the published evaluator takes stored predictions for, where nobody says.
        source (`str`): where the choices come from.

    Raises:
        ValueError: a choice that is not one, or an inversion without `clip` or `floor`, whose depth could be infinite.
    """

    name: str
    space: str
    dof: str = "scale_shift"
    loss: str = "l2"
    inverse_loss: str | None = None
    clip: tuple[float, float] | None = None
    floor: str | None = None
    nonpositive: str = "far"
    resolution: float | None = None
    unit: str = "mm"
    expects: str | None = None
    thresholds: tuple[float, ...] = ()
    ranked_by: str | None = None
    source: str = ""

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                known = ", ".join(map(str, choices))
                raise ValueError(f"protocol {self.name!r}: {name} {value!r}; what is computed is {known}")
        if any(not 1 < threshold < math.inf for threshold in self.thresholds):
            raise ValueError(f"protocol {self.name!r}: thresholds {self.thresholds}; each is a factor above 1")
        if self.ranked_by not in (None, *metric_names(self.thresholds)):
            names = ", ".join(metric_names(self.thresholds))
            raise ValueError(f"protocol {self.name!r}: ranked_by {self.ranked_by!r}; what is computed is {names}")
        if self.clip is not None and not self.clip[0] < self.clip[1]:
            raise ValueError(f"protocol {self.name!r}: clip {self.clip}; the lower end comes first")
        if self.clip is None and self.floor is None and self.space in ("auto", "inverse"):
            raise ValueError(
                f"protocol {self.name!r}: inverting may give an infinite depth; name a clip range or floor='ref_max'"
            )

    @property
    def fits_scale(self) -> bool:
        """Whether a prediction may be in any unit."""
        return self.dof != "none"

    def inverts(self, kind: str) -> bool:
        """Whether a prediction of this kind is aligned in inverse depth."""
        return self.space == "inverse" or (self.space == "auto" and kind == "inverse_depth")

    def loss_for(self, kind: str) -> str:
        """The loss of the fit for a prediction of this kind."""
        return (self.inverse_loss or self.loss) if self.inverts(kind) else self.loss

    def describe(self) -> str:
        """One line with every choice, as it stands under a table."""
        other = f" ({self.inverse_loss} in inverse depth)" if self.inverse_loss else ""
        fit = f"scale and shift by {self.loss}{other} over valid pixels" if self.fits_scale else "no alignment"
        clip = "no clipping" if self.clip is None else f"clip {self.clip[0]:g}..{self.clip[1]:g} {self.unit}"
        parts = [f"{self.name}: {fit}", f"space {self.space}", clip]
        if self.floor:
            parts.append("inverse depth at least that of the farthest reference")
        if self.nonpositive == "near":
            parts.append("negative inverse depth is near")
        parts.append("image mean")
        if self.resolution is not None:
            parts.append(f"resolution x{self.resolution:g}")
        if self.ranked_by:
            parts.append(f"ranked by {_in_words(self.ranked_by)} on ToM")
        return ", ".join(parts)

    def to_dict(self) -> dict:
        """The choices as JSON types."""
        clip = None if self.clip is None else list(self.clip)
        return asdict(self) | {"clip": clip, "thresholds": list(self.thresholds)}


def _in_words(metric: str) -> str:
    return {"mae": "MAE", "abs_rel": "AbsRel", "rmse": "RMSE"}.get(metric, metric.replace("_", " "))


WORKING_RANGE = (1.0, 10000.0)  # mm: Booster's evaluators drop ground truth outside of it
STRICT = (1.05, 1.10, 1.15, 1.20)  # of the challenges on Booster, which rank by the first
_PRESETS = (
    Protocol(
        "gift",
        space="auto",
        clip=WORKING_RANGE,
        source="GIFT paper, Experiments: affine alignment on all valid pixels; Booster ground truth in mm",
    ),
    Protocol(
        "native",
        space="native",
        unit="native",
        source="GIFT paper, Experiments: proxies of the frozen teacher, in proxy units",
    ),
    Protocol(
        "gift-literal",
        space="depth",
        clip=WORKING_RANGE,
        source="GIFT paper, the alignment equation to the letter: (s d + t - y)^2 with y depth, whatever d is",
    ),
    Protocol(
        "depth4tom",
        space="inverse",
        clip=WORKING_RANGE,
        nonpositive="near",
        resolution=0.25,
        expects="inverse_depth",
        source="Costanzino et al., ICCV 2023, evaluate_mono.py of CVLAB-Unibo/Depth4ToM-code (least squares)",
    ),
    Protocol(
        "ntire24",
        space="depth",
        clip=WORKING_RANGE,
        resolution=1.0,
        thresholds=STRICT,
        ranked_by="delta_1.05",
        source="NTIRE 2024 challenge on HR depth from images of specular and transparent surfaces, mono track: as "
        "ntire25",
    ),
    Protocol(
        "tricky24",
        space="depth",
        clip=WORKING_RANGE,
        resolution=0.25,
        thresholds=STRICT,
        ranked_by="delta_1.05",
        source="TRICKY 2024 challenge, monocular depth from images of specular and transparent surfaces: as ntire25, "
        "at 1028x752, a quarter of Booster's size",
    ),
    Protocol(
        "ntire25",
        space="depth",
        clip=WORKING_RANGE,
        resolution=1.0,
        thresholds=STRICT,
        ranked_by="delta_1.05",
        source="NTIRE 2025 challenge on HR depth from images of specular and transparent surfaces, mono track: scale "
        "and shift first, evaluated in the depth domain at full resolution (working range: ours)",
    ),
    Protocol(
        "moge-affine",
        space="auto",
        loss="l1_rel",
        inverse_loss="l2",
        floor="ref_max",
        source="MoGe, moge/test/metrics.py: depth_affine_invariant, disparity_affine_invariant (delta1 there counts "
        "negative depth as right, here it never does)",
    ),
    Protocol(
        "metric",
        space="depth",
        dof="none",
        clip=WORKING_RANGE,
        source="Depth Pro on Booster, and NTIRE 2026 (there in cm: ntire26): metric depth, nothing fitted",
    ),
    Protocol(
        "ntire26",
        space="depth",
        dof="none",
        clip=(WORKING_RANGE[0] / 10, WORKING_RANGE[1] / 10),
        resolution=1.0,
        unit="cm",
        ranked_by="rmse",
        source="NTIRE 2026 challenge, mono track on Booster: metric depth in cm at full resolution, nothing fitted, "
        "ranked by RMSE on ToM (working range: ours)",
    ),
)
PROTOCOLS = {protocol.name: protocol for protocol in _PRESETS}


def get_protocol(protocol: str | Protocol) -> Protocol:
    """The `Protocol` of that name, or the object itself; ValueError lists the names."""
    if isinstance(protocol, Protocol):
        return protocol
    if protocol not in PROTOCOLS:
        raise ValueError(f"unknown protocol {protocol!r}: choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[protocol]


def list_protocols() -> str:
    """Every preset's choices and source, for `gift-peft evaluate --list-protocols`."""
    return "\n".join(f"{protocol.describe()}\n    {protocol.source}" for protocol in PROTOCOLS.values())
