"""MoGe and MoGe-2 for single images: depth of an open-domain point map, with the mask that goes with it.

The network is the package's (`package_moge`), built from the arguments that a checkpoint states; parameters have their
official names below `network.`. `predicted_depth` is the package's own depth: z of its points with the shift that a
pinhole camera asks for, times the metric scale where the network has a scale head, then in metres.
"""

import pickle
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn
from transformers import PreTrainedModel
from transformers import initialization as init
from transformers.modeling_outputs import DepthEstimatorOutput
from transformers.utils import can_return_tuple

from .configuration_moge import MogeConfig
from .geometry_moge import recover_shift
from .package_moge import build_network

UNUSED = ("backbone.mask_token",)  # of pre-training; some files leave it out


@dataclass
class MogeDepthEstimatorOutput(DepthEstimatorOutput):
    """
    Args:
        predicted_depth (`torch.Tensor` of shape `(B, H, W)`): metres with a scale head, else of unknown scale. Finite
            everywhere; where `valid_mask` is False it means nothing.
        valid_mask (`torch.Tensor` of shape `(B, H, W)`, *optional*): bool, the network's own: False for sky, and for
            what else it takes for infinitely far.
        points (`torch.Tensor` of shape `(B, H, W, 3)`): x, y, z as the network gives them, before shift and scale.
        normals (`torch.Tensor` of shape `(B, H, W, 3)`, *optional*): unit normals.
        metric_scale (`torch.Tensor` of shape `(B,)`, *optional*): metres per unit of the points.
        focal, shift (`torch.Tensor` of shape `(B,)`): of the camera, over half the picture's diagonal, and along z in
            the points' unit.
    """

    valid_mask: torch.Tensor | None = None
    points: torch.Tensor | None = None
    normals: torch.Tensor | None = None
    metric_scale: torch.Tensor | None = None
    focal: torch.Tensor | None = None
    shift: torch.Tensor | None = None


class _TokenGrid:
    """Stands where MoGe-2 takes a number of tokens, n, and gives the rows and columns that are asked for.

    The package works them out as round((n / aspect) ** 0.5) and round((n * aspect) ** 0.5).
    """

    def __init__(self, rows: int, columns: int) -> None:
        self.rows, self.columns = rows, columns

    def __truediv__(self, aspect: float) -> "_TokenSide":
        return _TokenSide(self.rows)

    def __mul__(self, aspect: float) -> "_TokenSide":
        return _TokenSide(self.columns)


class _TokenSide:
    def __init__(self, count: int) -> None:
        self.count = count

    def __pow__(self, exponent: float) -> "_TokenSide":
        return self

    def __round__(self) -> int:
        return self.count


class MogeForDepthEstimation(PreTrainedModel):
    """MoGe and MoGe-2, around the network of the package dlr-moge."""

    config: MogeConfig
    config_class = MogeConfig
    base_model_prefix = ""
    main_input_name = "pixel_values"
    input_modalities = ("image",)
    supports_gradient_checkpointing = True
    _no_split_modules = ["NestedTensorBlock", "ConvStack", "Head"]  # noqa: RUF012 (transformers declares them so)
    # Layers that give points and their scale, by name, wrapped by PEFT or not; in bf16 depth would move by 0.5 %.
    depth_outputs = r"\bpoints_head\..*\boutput_blocks\.|\bscale_head\.|\bhead\..*\boutput_block\.0\.[1-9]"

    def __init__(self, config: MogeConfig):
        """Raises ValueError with the command that installs the package, if it is missing."""
        super().__init__(config)
        self.network = build_network(config.version, config.network)
        self.post_init()

    @classmethod
    def from_official(
        cls, source: str | Path | Mapping[str, Any], config: MogeConfig | None = None
    ) -> "MogeForDepthEstimation":
        """The model with an official checkpoint's weights, float32, in eval mode.

        Args: `source` a `.pt` file as released, or its content, `{"model_config": ..., "model": tensors by name}`;
        `config` where the file states no sizes, or for another number of tokens.
        Raises FileNotFoundError, and ValueError naming the file's damage, the first tensor that is missing, of another
        size or not finite, or a version that is none.
        """
        where = "the given dict" if isinstance(source, Mapping) else str(source)
        content = source if isinstance(source, Mapping) else _read(Path(source))
        state = content.get("model")
        if not isinstance(state, Mapping) or not state:
            raise ValueError(f"{where}: not a MoGe checkpoint, it has no weights under `model`")
        if config is None:
            stated = content.get("model_config")
            if not isinstance(stated, dict):
                raise ValueError(f"{where}: not a MoGe checkpoint, it states no sizes under `model_config`")
            try:
                config = MogeConfig(network=stated)
            except ValueError as error:
                raise ValueError(f"{where}: {error}") from None
        with torch.device("meta"):
            model = cls(config)
        model.network.load_state_dict(_fitted(state, model.network.state_dict(), config.version, where), assign=True)
        return model.eval()

    @torch.no_grad()
    def _init_weights(self, module: nn.Module) -> None:
        super()._init_weights(module)
        if isinstance(getattr(module, "gamma", None), nn.Parameter):  # LayerScale
            init.constant_(module.gamma, 1e-5)
        for name, parameter in module.named_parameters(recurse=False):
            if name in ("cls_token", "pos_embed", "register_tokens", "mask_token"):
                init.normal_(parameter, std=0.02)

    @property
    def num_tokens(self) -> int:
        """Patches where a call gives no number: the config's, else the most that the network was trained for."""
        stated = self.config.num_tokens
        return int(self.network.num_tokens_range[1]) if stated is None else stated

    @can_return_tuple
    def forward(
        self,
        pixel_values: torch.Tensor,
        labels: None = None,
        num_tokens: int | None = None,
        token_grid: tuple[int, int] | None = None,
        **kwargs: Any,
    ) -> MogeDepthEstimatorOutput:
        """Depth, mask, points and, where it has the head, normals of images.

        Args:
            pixel_values (`torch.Tensor`): floats from 0 to 1 of shape (B, 3, H, W), of any size.
            num_tokens (`int`, *optional*): patches at the vision transformer; default the config's, else the most that
                the network was trained for. Fewer are faster and coarser.
            token_grid (`tuple[int, int]`, *optional*): rows and columns of the patches of MoGe-2, in place of those
                that `num_tokens` gives for the picture's shape.

        Raises ValueError for another shape, an integer dtype, no tokens or a grid for the first version,
        NotImplementedError for `labels`.
        """
        if labels is not None:
            raise NotImplementedError("MogeForDepthEstimation has no loss of its own: leave labels out")
        shape = tuple(pixel_values.shape)
        if len(shape) != 4 or shape[1] != 3 or 0 in shape:
            raise ValueError(f"pixel_values must be (B, 3, H, W), got {shape}")
        if not pixel_values.is_floating_point():
            raise ValueError(f"pixel_values must be floats from 0 to 1, got {pixel_values.dtype}")
        tokens: Any = self.num_tokens if num_tokens is None else num_tokens
        if token_grid is not None:
            if self.config.version == "v1":
                raise ValueError("token_grid: the first version of MoGe works its grid out of num_tokens alone")
            rows, columns = token_grid
            if rows < 1 or columns < 1:
                raise ValueError(f"token_grid must be positive rows and columns, got {token_grid}")
            tokens = _TokenGrid(rows, columns)
        elif tokens < 1:
            raise ValueError(f"num_tokens must be positive, got {tokens}")
        output = self.network.forward(pixel_values, num_tokens=tokens)
        # A half-precision forward ends here: positions of a picture's points need more than its 8 bits.
        with torch.autocast(pixel_values.device.type, enabled=False):
            return self._camera(output)

    def _camera(self, output: Mapping[str, torch.Tensor]) -> MogeDepthEstimatorOutput:
        """Points to depth, as the package's `infer` does it."""
        dtype = torch.float64 if output["points"].dtype == torch.float64 else torch.float32
        points = output["points"].to(dtype)
        threshold = getattr(self.network, "mask_threshold", 0.5)
        mask = output["mask"].detach() > threshold if "mask" in output else None
        focal, shift = recover_shift(points, mask)
        depth = points[..., 2] + shift.to(dtype)[:, None, None]
        if mask is not None:
            mask = mask & (depth.detach() > 0)
        scale = output.get("metric_scale")
        if scale is not None:
            scale = scale.to(dtype)
            depth = depth * scale[:, None, None]
        return MogeDepthEstimatorOutput(
            predicted_depth=depth,
            valid_mask=mask,
            points=points,
            normals=output.get("normal"),
            metric_scale=scale,
            focal=focal.to(dtype),
            shift=shift.to(dtype),
        )


def _read(path: Path) -> Mapping[str, Any]:
    """A torch file's content, tensors and plain values only."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint file")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        raise ValueError(f"{path}: refused, it holds more than tensors and would run code, or is damaged") from None
    except (RuntimeError, EOFError, OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{path}: truncated, or not a torch file ({reason})") from None
    if not isinstance(content, Mapping):
        raise ValueError(f"{path}: not a MoGe checkpoint, it holds a {type(content).__name__}")
    return content


def _fitted(
    state: Mapping[str, torch.Tensor], expected: Mapping[str, torch.Tensor], version: str, where: str
) -> dict[str, torch.Tensor]:
    """Float32 copies for each name of `expected`; what has no place in the network is told and left out."""
    fitted = {}
    for name, tensor in expected.items():
        found = state.get(name)
        if found is None and name.endswith(UNUSED):
            fitted[name] = torch.zeros(tensor.shape)
            continue
        if not isinstance(found, torch.Tensor):
            raise ValueError(f"{where}: {name} is missing; are these the weights of another version than {version}?")
        if found.shape != tensor.shape:
            shapes = f"shape {tuple(found.shape)}, the network has {tuple(tensor.shape)}"
            raise ValueError(f"{where}: {name} has {shapes}; are these the weights of another network?")
        fitted[name] = found.to(torch.float32, copy=True)
        if not torch.isfinite(fitted[name]).all():
            raise ValueError(f"{where}: {name} holds NaN or infinite values")
    unknown = [name for name in state if name not in expected]
    if unknown:
        warnings.warn(
            f"{where}: {len(unknown)} tensors have no place in the network and are left out, such as {unknown[0]}",
            stacklevel=3,
        )
    return fitted


__all__ = ["MogeDepthEstimatorOutput", "MogeForDepthEstimation"]
