"""What masks may do to a training that no formula notices: nothing left to distill from, pairs of a few pixels.

Eq. 5 holds the prediction outside the target; without an outside it is 0, as if `lambda_d` were. Eq. 2 divides each
pair by its own intersection, so that one pixel shared by two masks pulls as much as a whole target.
"""

import logging

from torch import Tensor

from gift_peft.group_inputs import GroupInputs

LARGEST_TARGET = 0.95  # of a group's pixels: above, a warning
SMALLEST_SHARE = 0.01  # of the smaller of two masks, that a pair's intersection should have
FEWEST_PIXELS = 16  # of a pair's intersection, at the network's size

logger = logging.getLogger(__name__)


def check_surroundings(group_id: str, mask: Tensor, valid: Tensor | None) -> None:
    """ValueError for a group (N,H,W) without a single pixel outside its target."""
    outside = ~mask if valid is None else ~mask & valid
    if not outside.any():
        raise ValueError(
            f"group {group_id}: its masks cover the whole photos, so that nothing would hold the depth (as with "
            "lambda_d 0); draw them around the mirror or glass only"
        )


def warn_of_masks(group_id: str, inputs: GroupInputs) -> None:
    """Warn, in one line each, of nearly no surroundings, and of a pair that shares next to nothing."""
    inside, exists = inputs.mask, inputs.valid
    outside = ~inside if exists is None else ~inside & exists
    pixels = inside.numel() if exists is None else int(exists.sum())
    share = 1 - int(outside.sum()) / max(1, pixels)
    if share > LARGEST_TARGET:
        logger.warning(
            "group %s: %.0f %% of its pixels are target; the little that is left must hold the depth",
            group_id,
            100 * share,
        )
    elif without := [name for name, part in zip(inputs.names or (), outside, strict=False) if not part.any()]:
        logger.warning(
            "group %s: the mask of %s covers the whole photo, which nothing holds then", group_id, ", ".join(without)
        )
    if thin := smallest_pair(inputs):
        first, second, count = thin
        logger.warning(
            "group %s: the masks of %s and %s share %d pixels only, which pull as much as a whole mask does (Eq. 2); "
            "draw the masks so that they overlap, or not at all",
            group_id,
            first,
            second,
            count,
        )


def smallest_pair(inputs: GroupInputs) -> tuple[str, str, int] | None:
    """(name, name, pixels) of the pair with the smallest intersection, if that is too small to be meant."""
    count, sizes = inputs.pairs.count, inputs.pairs.sizes
    least = (sizes[:, None].minimum(sizes[None]).float() * SMALLEST_SHARE).clamp(min=FEWEST_PIXELS)
    thin = ((count > 0) & (count < least)).triu(1)
    if not thin.any():
        return None
    first, second = min(thin.nonzero().tolist(), key=lambda pair: int(count[pair[0], pair[1]]))
    names = inputs.names or [f"image {index}" for index in range(len(inputs))]
    return names[first], names[second], int(count[first, second])
