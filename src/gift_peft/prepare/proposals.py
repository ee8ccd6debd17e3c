"""Mask proposals for groups that have none: the target is where a fixed camera sees different things.

A group's images differ only in what its target reflects or transmits (paper section 3), so the robust spread of each
pixel over the group, in Lab and after exposure and white balance are taken out, is large on the target and small
elsewhere. Shadows, light thrown back into the scene and objects moved beside the target change as well, so this is a
proposal, for a person to look at: it never trains anything unless it is accepted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import SimpleNamespace

import cv2
import numpy as np
from PIL import Image

from gift_peft.files import reason
from gift_peft.models.pixels import to_pixel_values

WORKING_SIDE = 512  # pixels; a proposal is no finer, and averaging takes sensor noise out
LIGHTNESS_WEIGHT = 0.7  # of L against a and b: shadows change lightness most
EDGE_TOLERANCE = 0.3  # pixels that an image may be off; a change smaller than this times the gradient counts as none
NOISE_FACTOR = 8.0  # times the image's quietest tenth (a target may fill most of it): the tail of noise is below
LEAST_CHANGE = 2.0  # Lab units, about what can just be seen
RELATIVE_CHANGE = 0.3  # of the strong changes of the same region; weaker ones around it are its shadow or glow
LEAST_AREA = 0.001  # of the image
LEAST_SHARE = 0.1  # of the strongest region's summed change


@dataclass(frozen=True)
class Proposal:
    """A proposed target region of one group.

    Args:
        mask (`np.ndarray`): (H, W) bool, the same for all images of the group.
        score (`float`): 0 (nothing stands out) to 1; the product of the three figures below.
        concentration (`float`): share of the group's whole change that is inside the mask.
        changed (`float`): share of the mask that does change (the rest was filled in).
        edge (`float`): how much of the change ends at the mask's border: 1 - just outside / just inside.
        noise (`float`): Lab units up to which a change counts as none in this group.
        refined (`str`, *optional*): what refined the border, "sam2:<model id>".
        kept_regions (`int`): regions that the refinement left as they were, because its answer was another object.
    """

    mask: np.ndarray
    score: float
    concentration: float = 0.0
    changed: float = 0.0
    edge: float = 0.0
    noise: float = 0.0
    refined: str | None = None
    kept_regions: int = 0


def propose(images: Sequence[np.ndarray]) -> Proposal:
    """The region in which a group's registered images differ.

    Args:
        images (`Sequence[np.ndarray]`): two or more (H, W, 3) uint8 RGB of one size, camera fixed or registered; the
            treated reference may be among them.

    Returns:
        `Proposal`: an empty mask with score 0 where nothing stands out from noise and changes of the light.

    Raises:
        ValueError: fewer than two images, other shapes or types, differing sizes.
    """
    change, noise = change_map(images)
    height, width = images[0].shape[:2]
    mask = clean(strong(change, noise), change)
    figures = _figures(mask, change, noise)
    full = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
    return Proposal(full, float(np.prod(figures)), *figures, noise)


# ---- what changes ----


def change_map(images: Sequence[np.ndarray], side: int = WORKING_SIDE) -> tuple[np.ndarray, float]:
    """Where a group's registered images differ, and the change that counts as none; both in Lab units.

    The map (h, w) float32, its longer side at most `side`, is the upper quartile over the images of the distance to
    their median: an observation may look like the median by chance, and one may hold something that passed by.

    Raises ValueError: fewer than two images, other shapes or types, differing sizes.
    """
    if len(images) < 2:
        raise ValueError(f"{len(images)} image(s); a proposal compares at least two")
    for image in images:
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.shape != images[0].shape:
            raise ValueError("a proposal takes (height, width, 3) uint8 RGB images of one size")
    change = _change(images, side)
    return change, max(NOISE_FACTOR * float(np.quantile(change, 0.1)), LEAST_CHANGE)


def _change(images: Sequence[np.ndarray], side: int) -> np.ndarray:
    height, width = images[0].shape[:2]
    scale = min(1.0, side / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    labs = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
    labs = np.stack([cv2.cvtColor(lab.astype(np.float32) / 255, cv2.COLOR_RGB2LAB) for lab in labs])
    for _ in range(2):  # the median is better once the images agree in exposure
        median = np.median(labs, axis=0)
        labs = np.stack([_match_light(lab, median) for lab in labs])
    labs = np.stack([cv2.GaussianBlur(lab, (0, 0), 1.0) for lab in labs])
    median = np.median(labs, axis=0).astype(np.float32)
    distance = np.linalg.norm((labs - median) * np.float32([LIGHTNESS_WEIGHT, 1, 1]), axis=-1)
    slopes = [cv2.Sobel(median, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1))]
    gradient = np.sqrt(sum((slope**2).sum(axis=-1) for slope in slopes))
    return np.maximum(np.quantile(distance, 0.75, axis=0) - EDGE_TOLERANCE * gradient, 0).astype(np.float32)


def _match_light(lab: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """`lab` (h, w, 3) with each channel mapped affinely onto the reference's; what changed is trimmed from the fit."""
    matched = np.empty_like(lab)
    for channel in range(3):
        x, y = (array[..., channel].ravel().astype(np.float64) for array in (lab, reference))
        gain, offset = 1.0, float(np.median(y - x))
        for _ in range(4):
            residual = np.abs(y - gain * x - offset)
            kept = residual <= 2.5 * (1.4826 * np.median(residual) + 0.3)
            spread = x[kept].var()
            if spread > 1:  # a flat channel has no gain to find
                covariance = ((x[kept] - x[kept].mean()) * (y[kept] - y[kept].mean())).mean()
                gain = float(np.clip(covariance / spread, 0.5, 2.0))
            offset = float(y[kept].mean() - gain * x[kept].mean())
        matched[..., channel] = gain * lab[..., channel] + offset
    return matched


# ---- which of it is the target ----


def strong(change: np.ndarray, noise: float) -> np.ndarray:
    """(h, w) bool: in each connected region above the noise, what reaches a share of that region's strong changes."""
    labels, stats = _regions(change > noise)
    strong = np.zeros(change.shape, bool)
    for index in range(1, len(stats)):
        part, inside = _window(labels, stats, index)
        least = max(noise, RELATIVE_CHANGE * float(np.percentile(change[part][inside], 90)))
        strong[part] |= inside & (change[part] > least)
    return strong


def clean(mask: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Gaps closed, holes filled, specks removed; regions that carry a tenth of the strongest one's change stay."""
    reach = max(3, round(0.01 * max(mask.shape)) | 1)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    padded = cv2.morphologyEx(np.pad(mask, reach).astype(np.uint8), cv2.MORPH_CLOSE, disk)
    _, background = cv2.connectedComponents(1 - padded, connectivity=4)
    filled = (background != background[0, 0])[reach:-reach, reach:-reach]
    opened = cv2.morphologyEx(filled.astype(np.uint8), cv2.MORPH_OPEN, disk)
    labels, stats = _regions(opened > 0)
    sums = np.bincount(labels.ravel(), change.ravel(), minlength=len(stats))
    kept = sums >= LEAST_SHARE * sums[1:].max(initial=0)
    kept[0] = False
    return kept[labels]


def _regions(mask: np.ndarray, least_area: float = LEAST_AREA) -> tuple[np.ndarray, np.ndarray]:
    """Labels (h, w) of the connected regions that are large enough, 0 elsewhere, and their boxes x, y, w, h."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    large = [index for index in range(1, count) if stats[index, cv2.CC_STAT_AREA] >= least_area * mask.size]
    renumber = np.zeros(count, int)
    renumber[large] = np.arange(1, len(large) + 1)
    return renumber[labels], stats[[0, *large], :4]


def _window(labels: np.ndarray, stats: np.ndarray, index: int) -> tuple[tuple[slice, slice], np.ndarray]:
    x, y, width, height = stats[index]
    part = slice(y, y + height), slice(x, x + width)
    return part, labels[part] == index


def _figures(mask: np.ndarray, change: np.ndarray, noise: float) -> tuple[float, float, float]:
    """Concentration, changed share and edge contrast of a proposal, each from 0 to 1; all 0 for an empty mask."""
    if not mask.any():
        return 0.0, 0.0, 0.0
    excess = np.maximum(change - noise, 0)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    outside = (cv2.dilate(mask.astype(np.uint8), disk) > 0) & ~mask
    inside = mask & (cv2.erode(mask.astype(np.uint8), disk, borderValue=1) == 0)
    edge = 0.0
    if outside.any() and inside.any():  # not if the mask is the whole image
        edge = 1 - float(np.median(change[outside])) / max(float(np.median(change[inside])), 1e-6)
    concentration = float(excess[mask].sum() / max(excess.sum(), 1e-6))
    return concentration, float((change[mask] > noise).mean()), min(max(edge, 0.0), 1.0)


# ---- sharper borders ----


def refine(proposal: Proposal, image: np.ndarray, method: str) -> Proposal:
    """The proposal with each region's border as SAM 2 draws it, prompted with the region's box and its middle.

    Of the three masks that SAM 2 offers, the one closest to the region is taken, and none if their intersection over
    union is below one half: then it has found something else, and the region stays (`kept_regions`).

    Args:
        proposal (`Proposal`): of a group of (H, W) images.
        image (`np.ndarray`): (H, W, 3) uint8 RGB, one of the group's, best one that shows the surface itself.
        method (`str`): "sam2:<model id>", a hub id or folder that `transformers.Sam2Model` loads.

    Raises:
        ValueError: another method, an image of another size, or a model that cannot be loaded.
    """
    if image.shape != (*proposal.mask.shape, 3) or image.dtype != np.uint8:
        raise ValueError(f"refining takes a uint8 RGB image of the proposal's size, got {image.shape} {image.dtype}")
    model = load_sam2(method)
    labels, stats = _regions(proposal.mask, least_area=0)
    refined = np.zeros_like(proposal.mask)
    kept = 0
    answers = _ask_sam2(model, image, labels, stats) if len(stats) > 1 else []
    for index, candidates in enumerate(answers, start=1):
        region = labels == index
        overlaps = [(mask & region).sum() / (mask | region).sum() for mask in candidates]
        best = int(np.argmax(overlaps))
        found = overlaps[best] >= 0.5
        refined |= candidates[best] if found else region
        kept += 0 if found else 1
    return replace(proposal, mask=refined, refined=method, kept_regions=kept)


@lru_cache(maxsize=1)
def load_sam2(method: str):
    """The network that `refine` asks, loaded once. Raises ValueError as it does."""
    family, _, model_id = method.partition(":")
    if family != "sam2" or not model_id:
        raise ValueError(f"refine {method!r}: write sam2:<model id>, for example sam2:facebook/sam2.1-hiera-small")
    from transformers import Sam2Model

    try:
        return Sam2Model.from_pretrained(model_id).eval()
    except (OSError, ValueError) as error:
        raise ValueError(f"refine {method}: the model cannot be loaded ({reason(error)})") from None


def _ask_sam2(model, image: np.ndarray, labels: np.ndarray, stats: np.ndarray) -> np.ndarray:
    """(regions, 3, H, W) bool: SAM 2's masks for each region's box and middle."""
    import torch

    # Its image processor needs torchvision, which nothing else here does; these are its settings.
    settings = SimpleNamespace(
        resample=Image.Resampling.BILINEAR,
        rescale_factor=1 / 255,
        image_mean=[0.485, 0.456, 0.406],
        image_std=[0.229, 0.224, 0.225],
    )
    side = model.config.prompt_encoder_config.image_size
    height, width = labels.shape
    scale = torch.tensor([side / width, side / height])
    boxes = torch.tensor(stats[1:].astype(np.float32)).reshape(-1, 2, 2)
    boxes[:, 1] += boxes[:, 0]  # x, y, w, h to corners
    middles = torch.tensor([_middle(labels == index) for index in range(1, len(stats))])
    with torch.inference_mode():
        output = model(
            pixel_values=to_pixel_values([Image.fromarray(image)], settings, (side, side)),
            input_boxes=(boxes * scale).reshape(1, -1, 4),
            input_points=(middles * scale).reshape(1, -1, 1, 2),
            input_labels=torch.ones(1, len(middles), 1, dtype=torch.int32),
        )
        logits = torch.nn.functional.interpolate(output.pred_masks[0].float(), (height, width), mode="bilinear")
    return (logits > 0).numpy()


def _middle(region: np.ndarray) -> tuple[float, float]:
    """(x, y) of the pixel farthest from a region's border: inside it even where its centre of mass is not."""
    depth = cv2.distanceTransform(np.pad(region, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    y, x = np.unravel_index(int(depth.argmax()), depth.shape)
    return x + 0.5, y + 0.5
