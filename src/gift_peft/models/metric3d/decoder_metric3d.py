"""Decoder of Metric3D V2: tokens become feature maps, a DPT makes a first depth and normal, convolutional GRUs at
three scales refine both (RAFT-Stereo's recurrence), and a learned convex combination enlarges them four times.

The state of the recurrence (`flow`) has six channels at 1/4 of the image: depth as (metres - depth_max) /
regress_scale, depth confidence, the normal's x, y, z, and its concentration kappa. It stays in full precision under
autocast.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import nn
from torch.nn import functional as F
from transformers.modeling_layers import GradientCheckpointingLayer

from .configuration_metric3d import Metric3DConfig
from .encoder_metric3d import full_precision


class Metric3DPrediction(NamedTuple):
    """One reading of the state: depth (B,1,H,W) in canonical metres, its confidence (B,1,H,W), normal (B,4,H,W)."""

    depth: torch.Tensor
    confidence: torch.Tensor
    normal: torch.Tensor


class Metric3DDecoderOutput(NamedTuple):
    """The last prediction, all of them if asked for (oldest first), and the initial state's reading at 1/4."""

    last: Metric3DPrediction
    every: list[Metric3DPrediction]
    initial: Metric3DPrediction | None


def conv3x3(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1)


def resize(x: torch.Tensor, size: Sequence[int]) -> torch.Tensor:
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=True)


def normalize_normal(x: torch.Tensor) -> torch.Tensor:
    """(B,4,H,W): a unit vector and kappa >= 0.01 from three raw components and a logit."""
    vector, logit = x.split([3, 1], dim=1)
    # Unlike the root of a sum of squares, the norm has a finite gradient at 0.
    length = torch.linalg.vector_norm(vector, dim=1, keepdim=True) + 1e-10
    return torch.cat([vector / length, F.elu(logit) + 1.01], dim=1)


# ---- from tokens to maps ----


class Metric3DReadout(nn.Module):
    """Patch tokens plus a projection of all special tokens together."""

    def __init__(self, width: int, specials: int):
        super().__init__()
        self.specials = specials
        self.project_patch = nn.Linear(width, width)
        self.project_learn = nn.Linear(width * specials, width, bias=False)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        special = self.project_learn(tokens[:, : self.specials].flatten(1))
        return F.gelu(self.project_patch(tokens[:, self.specials :]) + special[:, None])


class Metric3DRead(nn.Module):
    """Tokens (B,S+h*w,C) as a map of the scale that `sample` makes of (B,C,h,w)."""

    def __init__(self, width: int, specials: int, sample: nn.Module):
        super().__init__()
        self.readoper = Metric3DReadout(width, specials)
        self.sample = sample

    def forward(self, tokens: torch.Tensor, grid: tuple[int, int]) -> torch.Tensor:
        return self.sample(self.readoper(tokens).transpose(1, 2).unflatten(2, grid))


class Metric3DToken2Feature(nn.Module):
    def __init__(self, config: Metric3DConfig):
        super().__init__()
        width, specials = config.embed_dim, 1 + config.num_register_tokens
        quarter, seventh = config.feature_channels[:2]
        # The nearest resize only copies pixels: after the 1x1 convolution it is the same and cheaper.
        small = nn.Sequential(nn.Conv2d(width, quarter, 1), nn.Upsample(scale_factor=3.5, mode="nearest"))
        self.read_3 = Metric3DRead(width, specials, nn.Identity())
        self.read_2 = Metric3DRead(width, specials, nn.Identity())
        self.read_1 = Metric3DRead(width, specials, nn.ConvTranspose2d(width, seventh, 2, stride=2))
        self.read_0 = Metric3DRead(width, specials, small)

    def forward(self, features: Sequence[torch.Tensor], grid: tuple[int, int]) -> tuple[torch.Tensor, ...]:
        """Maps at 1/4, 1/7, 1/14, 1/14 from tokens shallow to deep."""
        reads = (self.read_0, self.read_1, self.read_2, self.read_3)
        return tuple(read(tokens, grid) for read, tokens in zip(reads, features, strict=True))


# ---- DPT ----


class Metric3DConvBlock(nn.Module):
    """Residual block r + conv2(relu(conv1(r))) of r = relu(x): the skip carries the activated input."""

    def __init__(self, width: int):
        super().__init__()
        self.conv1 = conv3x3(width, width)
        self.conv2 = conv3x3(width, width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = F.relu(x)
        return x + self.conv2(F.relu(self.conv1(x)))


class Metric3DFuseBlock(nn.Module):
    def __init__(self, width: int, outputs: int, scale: float | None):
        super().__init__()
        self.way_trunk = Metric3DConvBlock(width)
        self.way_branch = None if scale is None else Metric3DConvBlock(width)
        self.out_conv = nn.Conv2d(width, outputs, 1)
        self.scale = scale

    def forward(self, trunk: torch.Tensor, branch: torch.Tensor | None = None) -> torch.Tensor:
        if branch is not None:
            trunk = trunk + self.way_branch(branch)
        x = self.way_trunk(trunk)
        if self.scale is not None:
            x = F.interpolate(x, scale_factor=self.scale, mode="bilinear", align_corners=True)
        return self.out_conv(x)


class Metric3DFusion(nn.Module):
    def __init__(self, config: Metric3DConfig):
        super().__init__()
        _, quarter, seventh, middle, deep = config.decoder_channels
        self.upconv_3 = Metric3DFuseBlock(deep, middle, None)
        self.upconv_2 = Metric3DFuseBlock(middle, seventh, 2)
        self.upconv_1 = Metric3DFuseBlock(seventh, quarter + 2, 1.75)

    def forward(self, maps: Sequence[torch.Tensor]) -> torch.Tensor:
        """A map at 1/4 whose last two channels are the logits of depth confidence and normal confidence."""
        _, read_1, read_2, read_3 = maps
        return self.upconv_1(self.upconv_2(self.upconv_3(read_3), read_2), read_1)


# ---- context ----


class Metric3DChannelLayerNorm(nn.LayerNorm):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """LayerNorm over the channels of (B,C,H,W)."""
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Metric3DResidualBlock(nn.Module):
    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.conv1 = conv3x3(inputs, outputs)
        self.norm1 = Metric3DChannelLayerNorm(outputs)
        self.conv2 = conv3x3(outputs, outputs)
        self.norm2 = Metric3DChannelLayerNorm(outputs)
        self.downsample = None
        if inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1))
            self.norm3 = Metric3DChannelLayerNorm(outputs)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = F.relu(self.norm1(self.conv1(x)))
        y = F.relu(self.norm2(self.conv2(y)))
        if self.downsample is not None:
            x = self.norm3(self.downsample(x))
        return F.relu(x + y)


class Metric3DContextEncoder(nn.Module):
    """Start (branch 0) and context (branch 1) of the states at 1/4, 1/7 and 1/14, before their activations."""

    def __init__(self, config: Metric3DConfig):
        super().__init__()
        scales = zip(config.feature_channels[:3], config.hidden_channels[:3], strict=True)
        branches = [
            nn.ModuleList(
                nn.Sequential(Metric3DResidualBlock(inputs, hidden), conv3x3(hidden, hidden)) for _ in range(2)
            )
            for inputs, hidden in scales
        ]
        self.outputs04, self.outputs08, self.outputs16 = branches

    def forward(self, maps: Sequence[torch.Tensor]) -> list[tuple[torch.Tensor, torch.Tensor]]:
        scales = (self.outputs04, self.outputs08, self.outputs16)
        return [(hidden(x), context(x)) for (hidden, context), x in zip(scales, maps, strict=True)]


# ---- recurrence ----


class Metric3DGRU(nn.Module):
    def __init__(self, hidden: int, inputs: int):
        super().__init__()
        self.convz = conv3x3(hidden + inputs, hidden)
        self.convr = conv3x3(hidden + inputs, hidden)
        self.convq = conv3x3(hidden + inputs, hidden)

    def forward(self, h: torch.Tensor, context: Sequence[torch.Tensor], *inputs: torch.Tensor) -> torch.Tensor:
        x = torch.cat(inputs, dim=1)
        hx = torch.cat([h, x], dim=1)
        z = torch.sigmoid(self.convz(hx) + context[0])
        r = torch.sigmoid(self.convr(hx) + context[1])
        q = torch.tanh(self.convq(torch.cat([r * h, x], dim=1)) + context[2])
        return (1 - z) * h + z * q


class Metric3DFlowHead(nn.Module):
    """Change of the state: two channels of depth (d), four of the normal (n)."""

    def __init__(self, hidden: int):
        super().__init__()
        self.conv1d, self.conv2d = conv3x3(hidden, hidden), conv3x3(hidden, 2)
        self.conv1n, self.conv2n = conv3x3(hidden, hidden), conv3x3(hidden, 4)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.cat([self.conv2d(F.relu(self.conv1d(x))), self.conv2n(F.relu(self.conv1n(x)))], dim=1)


class Metric3DUpdateBlock(GradientCheckpointingLayer):
    """One update of the recurrent states (1/4, 1/7, 1/14), coarse ones more often, and the change of the flow."""

    def __init__(self, config: Metric3DConfig):
        super().__init__()
        fine, middle, coarse = config.hidden_channels[:3]
        self.slow_fast = config.slow_fast_gru
        self.gru08 = Metric3DGRU(fine, 6 + middle)
        self.gru16 = Metric3DGRU(middle, fine + coarse)
        self.gru32 = Metric3DGRU(coarse, middle)
        self.flow_head = Metric3DFlowHead(fine)
        self.mask = nn.Sequential(conv3x3(fine, fine), nn.ReLU(), nn.Conv2d(fine, 9 * 4**2, 1))

    def forward(
        self, states: Sequence[torch.Tensor], contexts: Sequence[Sequence[torch.Tensor]], flow: torch.Tensor
    ) -> tuple[list[torch.Tensor], torch.Tensor]:
        fine, middle, coarse = states
        for layers in (1, 2, 3) if self.slow_fast else (3,):
            coarse = self.gru32(coarse, contexts[2], self._pool(middle))
            if layers > 1:
                smaller = resize(self._pool(fine), middle.shape[-2:])
                middle = self.gru16(middle, contexts[1], smaller, resize(coarse, middle.shape[-2:]))
            if layers > 2:
                fine = self.gru08(fine, contexts[0], flow.to(fine.dtype), resize(middle, fine.shape[-2:]))
        return [fine, middle, coarse], self.flow_head(fine)

    @staticmethod
    def _pool(x: torch.Tensor) -> torch.Tensor:
        return F.avg_pool2d(x, 3, stride=2, padding=1)


# ---- all of it ----


class Metric3DDecoder(nn.Module):
    def __init__(self, config: Metric3DConfig):
        super().__init__()
        self.config = config
        quarter, bins = config.decoder_channels[1], config.num_depth_bins
        self.token2feature = Metric3DToken2Feature(config)
        self.decoder_mono = Metric3DFusion(config)
        self.depth_regressor = nn.Sequential(conv3x3(quarter, bins), nn.ReLU(), nn.Conv2d(bins, bins, 1))
        self.normal_predictor = nn.Sequential(
            conv3x3(quarter, 128),
            nn.ReLU(),
            nn.Conv2d(128, 128, 1),
            nn.ReLU(),
            nn.Conv2d(128, 128, 1),
            nn.ReLU(),
            nn.Conv2d(128, 3, 1),
        )
        self.context_feature_encoder = Metric3DContextEncoder(config)
        self.context_zqr_convs = nn.ModuleList(conv3x3(width, 3 * width) for width in config.hidden_channels[:3])
        self.update_block = Metric3DUpdateBlock(config)

    def forward(
        self, features: Sequence[torch.Tensor], grid: tuple[int, int], every: bool, initial: bool
    ) -> Metric3DDecoderOutput:
        """Four token tensors (B,1+R+h*w,C) of a (h,w) grid to predictions at 4*floor(3.5h) x 4*floor(3.5w).

        `every` also upsamples the iterations before the last, `initial` the state before the first.
        """
        maps = self.token2feature(features, grid)
        flow = self._initial_state(self.decoder_mono(maps))
        first, predictions = None, []
        if initial:
            first = self._read(flow)
            predictions.append(self._read(resize(flow, [4 * side for side in flow.shape[-2:]])))
        states, contexts = self._context(maps)
        for index in range(self.config.iters):
            states, change = self.update_block(states, contexts, flow)
            flow = flow + change
            if every or index == self.config.iters - 1:
                predictions.append(self._read(self._upsample(flow, 0.25 * self.update_block.mask(states[0]))))
        return Metric3DDecoderOutput(predictions[-1], predictions if every else [], first)

    def _initial_state(self, fused: torch.Tensor) -> torch.Tensor:
        """(B,6,h,w) from the DPT's map: expected depth over logarithmic bins, and the predicted normal."""
        config = self.config
        features, logits = fused[:, :-2], full_precision(fused[:, -2:])
        weights = full_precision(self.depth_regressor(features)).softmax(dim=1)
        bins = torch.linspace(
            math.log(config.depth_min),
            math.log(config.depth_max),
            config.num_depth_bins,
            dtype=weights.dtype,
            device=weights.device,
        ).exp()
        # Not a matrix product: autocast would make it one of half precision.
        depth = (weights * bins[:, None, None]).sum(dim=1, keepdim=True).clamp(config.depth_min, config.depth_max)
        normal = normalize_normal(torch.cat([full_precision(self.normal_predictor(features)), logits[:, 1:]], dim=1))
        return torch.cat([(depth - config.depth_max) / config.regress_scale, logits[:, :1], normal], dim=1)

    def _context(self, maps: Sequence[torch.Tensor]):
        """Recurrent states at 1/4, 1/7, 1/14, and for each the additive (z, r, q) of its gates."""
        read_0, read_1, read_2, _ = maps
        # The two coarse maps arrive activated (the official DPT activates them in place before).
        branches = self.context_feature_encoder((read_0, F.relu(read_1), F.relu(read_2)))
        states = [torch.tanh(hidden) for hidden, _ in branches]
        contexts = [
            conv(F.relu(context)).chunk(3, dim=1)
            for conv, (_, context) in zip(self.context_zqr_convs, branches, strict=True)
        ]
        return states, contexts

    @staticmethod
    def _upsample(flow: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """(B,6,h,w) to (B,6,4h,4w): every fine pixel is a convex combination of 3x3 coarse ones, zeros outside."""
        height, width = flow.shape[-2:]
        weights = full_precision(mask).unflatten(1, (1, 9, 4, 4)).softmax(dim=2)
        neighbours = F.unfold(flow, 3, padding=1).unflatten(2, (height, width)).unflatten(1, (-1, 9, 1, 1))
        fine = (weights * neighbours).sum(dim=2)  # (B,6,4,4,h,w)
        return fine.permute(0, 1, 4, 2, 5, 3).flatten(4, 5).flatten(2, 3)

    def _read(self, flow: torch.Tensor) -> Metric3DPrediction:
        config = self.config
        depth = config.regress_scale * flow[:, :1] + config.depth_max
        return Metric3DPrediction(
            depth.clamp(config.depth_min, config.depth_max), flow[:, 1:2], normalize_normal(flow[:, 2:])
        )
