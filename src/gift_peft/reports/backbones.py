"""The paper's three backbones as their model cards need them: licence, how to get them, input and output, sizes.

Parameter counts are facts of the architectures (a slow test builds them without weights and counts); figures of the
paper are marked so.
"""

from dataclasses import dataclass, field

# RMSE of the paper's Tables 1 (GIFT-I, proxy units times 1000) and 2 (Booster, mm): base, + GIFT.
PaperFigures = dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Base:
    """What is known of a base model.

    Args:
        title (`str`): name in headings.
        hub_id (`str`): where its weights are.
        license (`str`): of the weights, a Hub licence id; `unknown` where none is stated.
        model_type (`str`): of its transformers config.
        kind (`str`): what it predicts.
        parameters (`int`): of the whole model.
        encoder_lora, head_lora (`int`): LoRA parameters per rank on the encoder's attention, and on the head.
        head_parameters (`int`): what `head="full"` trains.
        about (`str`): Markdown: origin, licence, how to get it; `{parameters}` and `{gigabytes}` are filled in.
        inout (`str`): Markdown: input and output.
        targets (`str`): where LoRA goes, for the recipe.
        head (`str`): what is trained in full.
        folder (`str`, *optional*): what the examples call the converted weights.
        precision (`str`): what of it is exempt from autocast.
        paper (`dict`): RMSE by row title.
    """

    title: str
    hub_id: str
    license: str
    model_type: str
    kind: str
    parameters: int
    encoder_lora: int
    head_lora: int
    head_parameters: int
    about: str
    inout: str
    targets: str
    head: str
    folder: str | None = None
    precision: str = ""
    paper: PaperFigures = field(default_factory=dict)


def find_base(name: str | None) -> Base | None:
    """The base of that hub id, or of the folder name that the examples use."""
    return next((base for base in BASES if name in (base.hub_id, base.folder)), None) if name else None


def adapter_sizes(base: Base, rank: int) -> dict[str, tuple[int, int]]:
    """{head: (LoRA parameters, others)} that `get_gift_model` trains."""
    encoder, head = rank * base.encoder_lora, rank * base.head_lora
    return {"full": (encoder, base.head_parameters), "lora": (encoder + head, 0), "none": (encoder, 0)}


BASES = (
    Base(
        title="Depth Anything V2-Large",
        hub_id="depth-anything/Depth-Anything-V2-Large-hf",
        license="cc-by-nc-4.0",
        model_type="depth_anything",
        kind="inverse_depth",
        parameters=335_315_649,
        encoder_lora=196_608,
        head_lora=90_177,
        head_parameters=30_947_009,
        about="""\
Depth Anything V2 (Yang et al., 2024) is a DINOv2 ViT-L encoder with a DPT neck and head ({parameters}
parameters, {gigabytes} GB in float32), trained on synthetic pictures and then on its own predictions for real ones.
transformers has it (`DepthAnythingForDepthEstimation`); nothing is converted.

The Large weights are non-commercial (CC BY-NC 4.0), and so is what is derived from them; the Small model's are
Apache-2.0.""",
        inout="""\
RGB, rescaled to [0, 1] and normalised with ImageNet's mean and standard deviation, sides multiples of 14.
`predicted_depth` is relative inverse depth up to an unknown scale and shift, larger is nearer. (The `Metric-Indoor`
checkpoints have the same architecture and predict metres: `examples/depth_anything_v2_metric_large.yaml`.)""",
        targets="query, key, value and output projection of the attention in all 24 encoder blocks",
        head="neck and head",
        paper={
            "GIFT-I ToM (proxy units)": (81.810, 63.086),
            "GIFT-I All (proxy units)": (58.634, 69.767),
            "Booster ToM (mm)": (100.060, 62.376),
            "Booster All (mm)": (58.771, 54.581),
        },
    ),
    Base(
        title="VGGT-1B",
        hub_id="facebook/VGGT-1B",
        license="cc-by-nc-4.0",
        model_type="gift_vggt",
        kind="depth",
        parameters=941_766_882,
        encoder_lora=442_368,
        head_lora=89_154,
        head_parameters=32_654_562,
        about="""\
VGGT (Wang et al., 2025) predicts depth, cameras and points of a scene from one or more frames. gift-peft has
its depth path as a transformers model (`VggtForDepthEstimation`: aggregator and depth head, {parameters} parameters,
{gigabytes} GB in float32) and reads the official weights:

```
gift-peft convert vggt facebook/VGGT-1B vggt-1b
```

A file already downloaded (`model.safetensors`, `model.pt`, `vggt_1B_commercial.pt`) takes the place of the hub id.

- `facebook/VGGT-1B`: non-commercial (CC BY-NC 4.0).
- `facebook/VGGT-1B-Commercial`: VGGT License v1 with its acceptable-use policy, which allows commercial use, but not
  military use among others; access by an application form.

Before the weights are passed on, converted or adapted, read the licence that comes with them: VGGT License v1 asks for
redistribution under the same agreement. The network's code here is written anew and under this project's licence.""",
        inout="""\
RGB in [0, 1], not normalised (the network does that), height and width multiples of 14. `(B, 3, H, W)` is a
batch of single pictures, `(B, S, 3, H, W)` a batch of scenes whose S frames see each other. `predicted_depth` is depth
along the camera's axis in a unit of its own per scene (relative, not metres), larger is farther; `confidence` is above
1.""",
        targets="`qkv` and `proj` of the attention in all 72 blocks (24 image, 24 frame, 24 global)",
        head="`depth_head`",
        folder="vggt-1b",
        precision=" with the depth head in float32",
        paper={
            "GIFT-I ToM (proxy units)": (227.309, 74.546),
            "GIFT-I All (proxy units)": (230.101, 49.782),
            "Booster ToM (mm)": (94.121, 77.022),
            "Booster All (mm)": (52.115, 45.764),
        },
    ),
    Base(
        title="Metric3D V2-Giant2",
        hub_id="JUGGHM/Metric3D",
        license="unknown",
        model_type="gift_metric3d",
        kind="depth",
        parameters=1_377_675_099,
        encoder_lora=368_640,
        head_lora=322_685,
        head_parameters=241_188_187,
        about="""\
Metric3D V2 (Hu et al., 2024) predicts metric depth and surface normals of single images. gift-peft has it as
a transformers model (`Metric3DForDepthEstimation`; Giant2: {parameters} parameters, {gigabytes} GB in float32) and
reads the official weights:

```
gift-peft convert metric3d JUGGHM/Metric3D metric3d-v2-giant2
```

A file already downloaded takes the place of the hub id. Large and Small are told apart by themselves:
`gift-peft convert metric3d JUGGHM/Metric3D/metric_depth_vit_large_800k.pth metric3d-v2-large`.

| | parameters | float32 |
|---|---|---|
| `metric_depth_vit_giant2_800k.pth` | {parameters} | {gigabytes} GB |
| `metric_depth_vit_large_800k.pth` | 411,941,915 | 1.65 GB |
| `metric_depth_vit_small_800k.pth` | 37,495,051 | 0.15 GB |

The original's code is under the 2-clause BSD licence. For the weights no licence is stated: the hub repository has no
model card, and the authors ask to be contacted about commercial use. Take them as weights for research. The network's
code here is written anew and is under this project's licence.""",
        inout="""\
RGB from 0 to 255, normalised with mean (123.675, 116.28, 103.53) and std (58.395, 57.12, 57.375), sides of at
least 14 pixels; multiples of 28 give depth of the input's size. `predicted_depth` is that of a canonical camera with a
focal length of 1000 pixels, in metres from 0.1 to 200; `post_process_depth_estimation(outputs, target_sizes,
focal_lengths=[fx])` makes it metric for a camera whose fx is in pixels of the original picture. `confidence` and
`normals` (x, y, z, kappa) come beside it.

The image processor stretches every picture to 476x644; `keep_aspect_ratio=True` with a size of 616x1064 is the
original's rule (fit inside, centred on the mean colour).""",
        targets="`qkv` and `proj` of the attention in all 40 blocks",
        head="the decoder",
        folder="metric3d-v2-giant2",
        precision=" with the recurrent state in float32",
        paper={
            "GIFT-I ToM (proxy units)": (301.349, 272.389),
            "GIFT-I All (proxy units)": (254.395, 236.046),
            "Booster ToM (mm)": (94.553, 99.109),
            "Booster All (mm)": (62.634, 55.262),
        },
    ),
)
