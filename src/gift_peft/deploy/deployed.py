"""An exported folder where a `DepthModel` is expected: `gift-peft predict --deployed` takes it, and needs no torch."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from gift_peft.deploy.runtime import Predictor, check_scale
from gift_peft.images import read_image


class DeployedModel:
    """What `gift-peft deploy` exported, with the part of `DepthModel` that predicting files needs.

    Args:
        folder: of `gift-peft deploy --to onnx`, `openvino` or `int8`.
        backend (`str`, *optional*): `onnx` or `openvino`; default what the folder was made for.
        adapter_scale (`float`, *optional*): of a model with a dial, 0 is the base and 1 (default) the adapter; below
            0, to -1, the adapter is turned the other way.

    Attributes:
        size (`tuple[int, int]`): (height, width) at the network.
        kind (`str`): `depth` or `inverse_depth`.
        millimeters_per_unit (`float`): 1000 for models that say they predict metres, else 1.
        adapted (`bool`): whether it also predicts the base's depth: models with a dial do.

    Raises:
        FileNotFoundError: no such folder, or a file of it is missing. ValueError: the runtime is not installed or does
            not read the model, the model is of another export, or a scale that it does not take.
    """

    def __init__(self, folder: str | Path, backend: str | None = None, adapter_scale: float | None = None) -> None:
        if not Path(folder).is_dir():
            raise FileNotFoundError(f"deployed model {folder}: no such folder")
        self.predictor = Predictor(folder, backend)
        if adapter_scale is not None:
            if not self.predictor.has_dial:
                raise ValueError(f"{folder} was exported without --dial: its adapter scale is fixed")
            check_scale(adapter_scale)
        settings = self.predictor.settings
        self.size, self.kind, self.adapted = self.predictor.size, settings["kind"], self.predictor.has_dial
        self.millimeters_per_unit = settings.get("millimeters_per_unit") or 1.0
        self._scale = adapter_scale

    def inputs(self, images: Sequence[Image.Image]) -> np.ndarray:
        """Upright RGB pictures to pixel values (B,3,h,w) float32, to the bit as in training."""
        return np.concatenate([self.predictor.prepare(image) for image in images])

    def depth_at(
        self, image: str | Path | Image.Image, focal_length: float | None = None, base: bool = False
    ) -> np.ndarray:
        """As `DepthModel.depth_at`: (H,W) float32 at the picture's size, in native units.

        Raises ValueError for `base` where the model has no dial, and as `DepthModel.depth_at`.
        """
        name = str(image) if isinstance(image, str | Path) else "the picture"
        picture = read_image(image, name)
        return self.depths_of(self.inputs([picture]), [picture.size[::-1]], [name], focal_length, base)[0]

    def depths_of(
        self,
        pixel_values: np.ndarray,
        sizes: Sequence[tuple[int, int]],
        names: Sequence[str],
        focal_length: float | None = None,
        base: bool = False,
    ) -> list[np.ndarray]:
        """As `DepthModel.depths_of`: `depth_at` of several pictures at once, of their `inputs` and (height, width)."""
        predictions = self.predictor.predict(pixel_values, 0.0 if base else self._scale)
        rows = zip(predictions, sizes, names, strict=True)
        return [self.predictor.finish(prediction, size, name, focal_length) for prediction, size, name in rows]
