"""VGGT's depth head: a DPT decoder that is told where in the image each feature lies.

Two traps for readers who know other DPT heads: the residual units rectify their shortcut as well, and all resizing
aligns corners.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers.utils.generic import maybe_autocast

from .configuration_vggt import VggtConfig

POSITION_MAP_SCALE = 0.1


def position_map(channels: int, grid: tuple[int, int], image: tuple[int, int], like: Tensor) -> Tensor:
    """(channels, h, w): sines and cosines of where a pixel of the grid lies in the image, as `like`'s dtype.

    Coordinates are relative to the image's diagonal, so the map shows the aspect ratio.
    """
    # Sines of doubles, as precise on every device that has them; an exported graph may run on one that has none.
    single = like.device.type == "mps" or torch.compiler.is_exporting()
    dtype = torch.float32 if single else torch.float64
    count = channels // 4
    frequency = 100.0 ** -(torch.arange(count, device=like.device, dtype=dtype) / count)
    # Sides as tensors: numbers worked out from them would be constants of an exported graph.
    sides = [torch.full((), side, device=like.device, dtype=dtype) for side in image]
    diagonal = (sides[0] ** 2 + sides[1] ** 2).sqrt()
    parts = []
    for axis in (1, 0):
        cells = grid[axis]
        places = 2 * torch.arange(cells, device=like.device, dtype=dtype) - (cells - 1)  # from the middle, half cells
        angles = frequency[:, None] * (places * (sides[axis] / diagonal / cells))
        for wave in (angles.sin(), angles.cos()):
            wave = (wave * POSITION_MAP_SCALE).to(like.dtype)
            parts.append((wave[:, None, :] if axis == 1 else wave[:, :, None]).expand(count, *grid))
    return torch.cat(parts)


class VggtResidualUnit(nn.Module):
    """conv(relu(conv(relu(x)))) + relu(x): the shortcut is rectified too, unlike in other DPT heads."""

    def __init__(self, features: int):
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(x)
        return self.conv2(F.relu(self.conv1(x))) + x


class VggtFusion(nn.Module):
    """Adds a finer level to the coarser ones, refines, and resizes to (h, w). The coarsest has nothing to add to."""

    def __init__(self, features: int, coarsest: bool):
        super().__init__()
        if not coarsest:
            self.resConfUnit1 = VggtResidualUnit(features)
        self.resConfUnit2 = VggtResidualUnit(features)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(self, x: Tensor, size: Sequence[int], skip: Tensor | None = None) -> Tensor:
        if skip is not None:
            x = x + self.resConfUnit1(skip)
        return self.out_conv(resize(self.resConfUnit2(x), size))


def resize(x: Tensor, size: Sequence[int]) -> Tensor:
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=True)


class VggtDepthHead(nn.Module):
    """DPT head: the aggregator's four token maps to logits (B * S, 2, H, W), of log depth and of confidence.

    It runs in its own weights' precision also under autocast, as the original does: float32 in training.
    """

    def __init__(self, config: VggtConfig):
        super().__init__()
        self.patch_size = config.patch_size
        width, features, channels = 2 * config.embed_dim, config.features, config.out_channels
        self.norm = nn.LayerNorm(width)
        self.projects = nn.ModuleList(nn.Conv2d(width, count, 1) for count in channels)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(channels[0], channels[0], kernel_size=4, stride=4),
                nn.ConvTranspose2d(channels[1], channels[1], kernel_size=2, stride=2),
                nn.Identity(),
                nn.Conv2d(channels[3], channels[3], 3, stride=2, padding=1),
            ]
        )
        self.scratch = nn.Module()  # only a name: the official keys have it
        for level, count in enumerate(channels, start=1):
            self.scratch.add_module(f"layer{level}_rn", nn.Conv2d(count, features, 3, padding=1, bias=False))
            self.scratch.add_module(f"refinenet{level}", VggtFusion(features, coarsest=level == len(channels)))
        self.scratch.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.scratch.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, config.head_features_2, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(config.head_features_2, 2, 1),
        )

    def forward(self, levels: Sequence[Tensor], image: tuple[int, int]) -> Tensor:
        grid = (image[0] // self.patch_size, image[1] // self.patch_size)
        with maybe_autocast(device_type=levels[0].device.type, enabled=False):
            x = self.fuse([self.reassemble(index, tokens, grid, image) for index, tokens in enumerate(levels)])
            x = resize(x, image)
            return self.scratch.output_conv2(x + position_map(x.shape[1], image, image, x))

    def reassemble(self, index: int, tokens: Tensor, grid: tuple[int, int], image: tuple[int, int]) -> Tensor:
        """Tokens (B, S, 1 + registers + h * w, 2C) to a feature map (B * S, features, h', w')."""
        patches = tokens.flatten(0, 1)[:, -grid[0] * grid[1] :].to(self.norm.weight.dtype)
        x = self.projects[index](self.norm(patches).transpose(1, 2).unflatten(2, grid))
        x = self.resize_layers[index](x + position_map(x.shape[1], grid, image, x))
        return self.scratch.get_submodule(f"layer{index + 1}_rn")(x)

    def fuse(self, maps: Sequence[Tensor]) -> Tensor:
        """Four maps, finest first, to (B * S, features / 2, 8h, 8w)."""
        scratch = self.scratch
        x = scratch.refinenet4(maps[3], size=maps[2].shape[-2:])
        x = scratch.refinenet3(x, size=maps[1].shape[-2:], skip=maps[2])
        x = scratch.refinenet2(x, size=maps[0].shape[-2:], skip=maps[1])
        x = scratch.refinenet1(x, size=[2 * side for side in maps[0].shape[-2:]], skip=maps[0])
        return scratch.output_conv1(x)
