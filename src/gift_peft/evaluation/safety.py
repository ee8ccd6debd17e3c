"""What an error means to a robot, where true depth is known: glass that is not there, and depth that shakes.

False free space: percent of the target's pixels reported more than 10 % and more than 200 mm behind the surface.
Flicker: standard deviation, in mm, of aligned depth at a pixel of the target over its group's observations, in the
mean over pixels. Both are taken of the aligned depth of the evaluation's protocol.
"""

import math
from typing import Any

import numpy as np

from gift_peft.evaluation.alignment import known

BEHIND = 0.10  # of the depth
BEHIND_MM = 200.0


def false_free_space(aligned: np.ndarray, reference: np.ndarray, target: np.ndarray) -> float:
    """Percent of the target's pixels with known depth; NaN where there is none.

    Args: `aligned` and `reference` (H,W) in mm, `target` (H,W) bool.
    """
    there = target & known(reference)
    if not there.any():
        return math.nan
    behind = aligned[there] - reference[there]
    return 100 * float(np.mean((behind > BEHIND * reference[there]) & (behind > BEHIND_MM)))


class Flicker:
    """The flicker of one group, an observation at a time, so that a group of large pictures takes little memory."""

    def __init__(self) -> None:
        self._count: Any = 0
        self._mean: Any = 0.0
        self._squares: Any = 0.0

    def update(self, aligned: np.ndarray, target: np.ndarray) -> None:
        """One observation: aligned depth (H,W) in mm, its target (H,W) bool. All are of one size."""
        self._count = self._count + target
        # Welford's update, where the pixel is target.
        change = np.where(target, aligned - self._mean, 0.0)
        self._mean = self._mean + change / np.maximum(self._count, 1)
        self._squares = self._squares + np.where(target, change * (aligned - self._mean), 0.0)

    def compute(self) -> float:
        """In mm, over the pixels that are target in two observations or more; NaN if there is none."""
        several = np.asarray(self._count) >= 2
        if not several.any():
            return math.nan
        return float(np.sqrt(self._squares[several] / self._count[several]).mean())
