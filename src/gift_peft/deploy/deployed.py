"""An exported folder where a `DepthModel` is expected: `gift-peft predict --deployed` takes it, and needs no torch."""

from pathlib import Path

import numpy as np
from PIL import Image

from gift_peft.deploy.runtime import Predictor
from gift_peft.images import read_image


class DeployedModel:
    """What `gift-peft deploy` exported, with the part of `DepthModel` that predicting files needs.

    Args:
        folder: of `gift-peft deploy --to onnx`, `openvino` or `int8`.
        backend (`str`, *optional*): `onnx` or `openvino`; default what the folder was made for.
        adapter_scale (`float`, *optional*): of a model with a dial, 0 is the base and 1 (default) the adapter.

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
            if not 0 <= adapter_scale <= 1:
                raise ValueError(f"adapter scale {adapter_scale:g}: it goes from 0 (the base) to 1 (the adapter)")
        settings = self.predictor.settings
        self.size, self.kind, self.adapted = self.predictor.size, settings["kind"], self.predictor.has_dial
        self.millimeters_per_unit = settings.get("millimeters_per_unit") or 1.0
        self._scale = adapter_scale

    def depth_at(
        self, image: str | Path | Image.Image, focal_length: float | None = None, base: bool = False
    ) -> np.ndarray:
        """As `DepthModel.depth_at`: (H,W) float32 at the picture's size, in native units.

        Raises ValueError for `base` where the model has no dial, and as `DepthModel.depth_at`.
        """
        name = str(image) if isinstance(image, str | Path) else "the picture"
        picture = read_image(image, name)
        scale = 0.0 if base else self._scale
        prediction = self.predictor.predict(self.predictor.prepare(picture), scale)[0]
        return self.predictor.finish(prediction, (picture.height, picture.width), name, focal_length)
