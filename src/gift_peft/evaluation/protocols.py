"""Named sets of evaluation choices: a depth error means nothing without the way it was aligned and averaged.

Every table prints the protocol it was made with. `gift` is the paper's affine-aligned evaluation (Experiments,
"Metrics and affine-aligned evaluation"); `native` is the same fit inside the teacher's own output space.
"""

from dataclasses import asdict, dataclass

KINDS = ("depth", "inverse_depth")
# A choice that nothing computes must not stand under a table.
IMPLEMENTED = {
    "space": ("auto", "native"),
    "dof": ("scale_shift",),
    "loss": ("l2",),
    "fit_region": ("valid",),
    "aggregation": ("image",),
    "resolution": (1.0,),
}


@dataclass(frozen=True)
class Protocol:
    """The choices behind one number.

    Args:
        name (`str`): key in `PROTOCOLS`.
        space (`str`): where the fit happens. `auto`: where the prediction lives, so an inverse-depth prediction is
            fitted to 1/reference and inverted. `native`: prediction and reference share a space, nothing is inverted.
        dof (`str`): what is fitted: `scale_shift`.
        loss (`str`): the fit's loss: `l2`, in closed form.
        fit_region (`str`): `valid`: all valid pixels, target and surroundings alike.
        clip (`tuple[float, float]`, *optional*): working range in the reference's unit, applied after alignment and
            inversion. A non-positive aligned disparity means "far" and takes the upper end.
        aggregation (`str`): `image`: the mean over images of each image's own metric.
        resolution (`float`): metrics are taken on the reference's grid times this factor.
        unit (`str`): unit of the reference that `clip` is meant for, `mm` or `native`.
        source (`str`): where the choices come from.
    """

    name: str
    space: str
    dof: str = "scale_shift"
    loss: str = "l2"
    fit_region: str = "valid"
    clip: tuple[float, float] | None = None
    aggregation: str = "image"
    resolution: float = 1.0
    unit: str = "mm"
    source: str = ""

    def __post_init__(self) -> None:
        for name, choices in IMPLEMENTED.items():
            value = getattr(self, name)
            if value not in choices:
                known = ", ".join(map(str, choices))
                raise ValueError(f"protocol {self.name!r}: {name} {value!r}; what is computed is {known}")

    def describe(self) -> str:
        """One line with every choice, as it stands under a table."""
        clip = "no clipping" if self.clip is None else f"clip {self.clip[0]:g}..{self.clip[1]:g} {self.unit}"
        return (
            f"{self.name}: {self.dof} by {self.loss} over {self.fit_region} pixels, space {self.space}, {clip}, "
            f"{self.aggregation} mean, resolution x{self.resolution:g}"
        )

    def to_dict(self) -> dict:
        """The choices as JSON types."""
        return asdict(self) | {"clip": None if self.clip is None else list(self.clip)}


PROTOCOLS = {
    "gift": Protocol(
        "gift",
        space="auto",
        clip=(1.0, 10000.0),
        source="GIFT paper, Experiments: affine alignment on all valid pixels; Booster ground truth in mm",
    ),
    "native": Protocol(
        "native",
        space="native",
        unit="native",
        source="GIFT paper, Experiments: proxies of the frozen teacher, in proxy units",
    ),
}


def get_protocol(protocol: str | Protocol) -> Protocol:
    """The `Protocol` of that name, or the object itself; ValueError lists the names."""
    if isinstance(protocol, Protocol):
        return protocol
    if protocol not in PROTOCOLS:
        raise ValueError(f"unknown protocol {protocol!r}: choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[protocol]
