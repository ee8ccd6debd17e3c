"""How much blurrier a camera sees the same scene than it did before, in pixels of a Gaussian.

A number of how sharp one picture is depends on what it shows, on noise and on the codec. Here the earlier picture
itself is blurred by known amounts, and the contrast that its fine detail then keeps, place by place, is compared with
what the later picture has left of it. Contrast is measured by correlation with the earlier picture, so noise does not
count, relative to a coarser band, so the light does not; places that show something else do not correlate.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from gift_peft.prepare.camera_motion import weighted_quantile

SIDE = 1280  # pixels of the longer side at most
PLACES = 32  # along the longer side
LEAST_SIDE = 10  # pixels of a place, else chance makes pictures alike
FINE, COARSE = (1.0, 2.2), (2.2, 5.0)  # of each band, as differences of Gaussians
TRIALS = (0.0, 0.6, 1.0, 1.5, 2.2, 3.2, 4.5)  # pixels of blur
CORRELATION = 0.9  # of the coarser band, from which a place shows the same
LEAST_DETAIL = 0.5  # grey levels of the fine band, from which a place counts
OVER_NOISE = 2.0  # times the noise's energy, likewise
MOST_USABLE, FLAT = 0.5, 0.1  # share of a place that must be usable; share of the places that count as flat
LEAST_PLACES, LEAST_ALIKE = 8, 0.15  # and share of those with detail that must show the same
LOST = 0.4  # fine contrast, below which a picture that is like the earlier one nowhere is out of focus
SMALLER = (1, 2, 4)  # times, the resolutions
ENOUGH_DETAIL = 2.0  # grey levels of the fine band in a tenth of the places, from which a resolution is fine enough


@dataclass(frozen=True)
class Blur:
    """Against the earlier picture.

    Args:
        pixels (`float`): standard deviation of the Gaussian that was added; 0 if it is as sharp, or sharper.
        sharpness (`float`): contrast of fine detail that is left; 1 is as sharp, above 1 is sharper.
    """

    pixels: float
    sharpness: float


class Focus:
    """An earlier picture, to which later ones are compared.

    Args:
        first, second (`np.ndarray`): (H, W) float32, grey levels: means of some frames, and of others that show the
            same. Noise that they do not share counts nowhere.
        mask (`np.ndarray`, *optional*): (H, W) bool, the target, which does not count.
    """

    def __init__(self, first: np.ndarray, second: np.ndarray, mask: np.ndarray | None = None) -> None:
        self.size = first.shape[1], first.shape[0]
        scale = min(1.0, SIDE / max(self.size))
        levels = [_Level(first, second, mask, scale / smaller) for smaller in SMALLER]
        # A soft picture has its detail at a coarser one; what is left of it at a finer one is the codec's to decide.
        clear = [place for place, level in enumerate(levels) if level.detail >= ENOUGH_DETAIL]
        self.levels = levels[clear[0] if clear else 0 :]

    def blur(self, gray: np.ndarray, matrix: np.ndarray | None = None) -> Blur | None:
        """What a later picture (H, W) float32 of the same camera has lost; None if too little shows the same.

        `matrix` (3, 3) is the camera's motion, the earlier picture's pixels to this one's.
        """
        if matrix is not None:
            flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP  # cubic: linear would blur
            gray = cv2.warpPerspective(gray, matrix, self.size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        # A strong blur leaves nothing to compare at a fine resolution, and a very strong one at none.
        first, *coarser = self.levels
        if (blur := first.blur(gray)) is not None:
            return blur
        left = first.detail_left(gray)
        if left is None or left > LOST:
            return None
        blur = next((blur for blur in (level.blur(gray) for level in coarser) if blur is not None), None)
        return Blur(TRIALS[-1] / self.levels[-1].scale if blur is None else blur.pixels, left)


class _Level:
    """The earlier picture at one resolution."""

    def __init__(self, first: np.ndarray, second: np.ndarray, mask: np.ndarray | None, scale: float) -> None:
        self.scale = scale
        first, second = self._small(first), self._small(second)
        small = (first + second) / 2
        height, width = small.shape
        larger = max(height, width)
        places = min(PLACES, larger / LEAST_SIDE)
        self.places = max(1, round(places * width / larger)), max(1, round(places * height / larger))
        self.fine, self.coarse = _band(small, FINE), _band(small, COARSE)
        usable = (small > 6) & (small < 246)
        if mask is not None:
            usable &= self._small(mask.astype(np.float32)) == 0
        margin = np.ones((2 * round(COARSE[1]) + 1,) * 2, np.uint8)
        self.usable = cv2.erode(usable.astype(np.uint8), margin).astype(np.float32)
        self.share = np.maximum(self._mean(np.ones_like(small)), 1e-6)
        one, other, low, low_other = (_band(half, sigmas) for sigmas in (FINE, COARSE) for half in (first, second))
        energy, self.low_energy = (self._mean(a * b) / self.share for a, b in ((one, other), (low, low_other)))
        blurred = [(cv2.GaussianBlur(second, (0, 0), trial) if trial else second) for trial in TRIALS]
        left = np.stack([self._mean(one * _band(half, FINE)) / self.share for half in blurred])
        # A codec keeps the noise of a frame for those that follow: detail to both halves, and to no later picture.
        # Flat places show how much of it there is.
        whole = self.share > MOST_USABLE
        flat = whole & (energy <= (np.quantile(energy[whole], FLAT) if whole.any() else 0))
        frozen = left[:, flat].mean(axis=1, keepdims=True) if flat.any() else np.zeros((len(TRIALS), 1))
        noise = frozen[0] + self._mean(np.square(one - other)) / self.share / 4
        self.energy = energy - frozen[0]
        self.telling = whole & (self.energy > np.maximum(LEAST_DETAIL**2, OVER_NOISE * noise))
        self.detail = float(np.sqrt(np.quantile(self.energy[self.telling], 0.9))) if self.telling.any() else 0.0
        low_left = np.stack([self._mean(low * _band(half, COARSE)) / self.share for half in blurred])
        self.kept = (left - frozen) / np.maximum(self.energy, 1e-6) * self.low_energy / np.maximum(low_left, 1e-6)

    def blur(self, gray: np.ndarray) -> Blur | None:
        left, alike = self._contrasts(self._small(gray))
        places = self.telling & alike
        if places.sum() < LEAST_PLACES or alike[self.telling].mean() < LEAST_ALIKE:
            return None
        weights = np.square(self.energy[places])  # strong edges: codecs smooth what is faint
        apart = [weighted_quantile((left - kept)[places], weights, 0.5) for kept in self.kept]
        sharpness = 1 + apart[0]
        if apart[0] >= 0:
            return Blur(0.0, sharpness)
        # How much too little contrast is left falls with the blur that is tried; between two trials, by the line.
        after = next((index for index, value in enumerate(apart) if value >= 0), None)
        if after is None:
            return Blur(TRIALS[-1] / self.scale, sharpness)
        low, high = apart[after - 1], apart[after]
        share = -low / max(high - low, 1e-9)
        pixels = TRIALS[after - 1] + share * (TRIALS[after] - TRIALS[after - 1])
        return Blur(float(pixels) / self.scale, sharpness)

    def detail_left(self, gray: np.ndarray) -> float | None:
        """Fine contrast over the earlier picture's, where that has some, whatever is shown; None if it has none."""
        if self.telling.sum() < LEAST_PLACES:
            return None
        here = self._mean(np.square(_band(self._small(gray), FINE))) / self.share
        return float(np.sqrt(here[self.telling].sum() / self.energy[self.telling].sum()))

    def _contrasts(self, small: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of each place: the fine contrast that is left, relative to the coarser one; whether it shows the same."""
        fine, coarse = _band(small, FINE), _band(small, COARSE)
        both, own = (self._mean(self.coarse * coarse) / self.share, self._mean(coarse * coarse) / self.share)
        alike = both > CORRELATION * np.sqrt(np.maximum(self.low_energy, 0) * own) + 1e-6
        fine_left = self._mean(self.fine * fine) / self.share / np.maximum(self.energy, 1e-6)
        return fine_left * self.low_energy / np.where(alike, both, np.inf), alike

    def _mean(self, image: np.ndarray) -> np.ndarray:
        return cv2.resize(image * self.usable, self.places, interpolation=cv2.INTER_AREA).ravel().astype(np.float64)

    def _small(self, picture: np.ndarray) -> np.ndarray:
        size = tuple(max(1, round(side * self.scale)) for side in picture.shape[::-1])
        return picture if self.scale == 1 else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def _band(image: np.ndarray, sigmas: tuple[float, float]) -> np.ndarray:
    narrow, wide = (cv2.GaussianBlur(image, (0, 0), sigma) for sigma in sigmas)
    return narrow - wide
