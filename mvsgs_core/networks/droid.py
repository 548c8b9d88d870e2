"""The networks of DROID-SLAM (Teed and Deng 2021, section 3.1): feature and context encoders, update operator.

All state is at 1/8 of the image. Keys and shapes are those of the official droid.pth.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

STRIDE = 8  # image pixels per state pixel
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def normalize_images(images_rgb: Tensor) -> Tensor:
    """(..., 3, H, W) RGB in 0..255 to ImageNet's mean 0 and deviation 1."""
    mean = images_rgb.new_tensor(_MEAN)[:, None, None]
    deviation = images_rgb.new_tensor(_DEVIATION)[:, None, None]
    return (images_rgb / 255.0 - mean) / deviation


class _Residual(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: int, norm: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1)
        self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride)) if stride != 1 else None
        self.norm: nn.Module = nn.InstanceNorm2d(outputs) if norm else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(self.norm(self.conv1(x)))
        y = torch.relu(self.norm(self.conv2(y)))
        if self.downsample is not None:
            x = self.norm(self.downsample(x))
        return torch.relu(x + y)


class Encoder(nn.Module):
    """(N, 3, H, W) normalized images to (N, outputs, H/8, W/8) features."""

    def __init__(self, outputs: int, norm: bool) -> None:
        super().__init__()
        self.norm: nn.Module = nn.InstanceNorm2d(32) if norm else nn.Identity()
        self.conv1 = nn.Conv2d(3, 32, 7, 2, 3)
        self.layer1 = nn.Sequential(_Residual(32, 32, 1, norm), _Residual(32, 32, 1, norm))
        self.layer2 = nn.Sequential(_Residual(32, 64, 2, norm), _Residual(64, 64, 1, norm))
        self.layer3 = nn.Sequential(_Residual(64, 128, 2, norm), _Residual(128, 128, 1, norm))
        self.conv2 = nn.Conv2d(128, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = torch.relu(self.norm(self.conv1(x)))
        features: Tensor = self.conv2(self.layer3(self.layer2(self.layer1(x))))
        return features


class _ConvGru(nn.Module):
    """A convolutional GRU whose gates also see a gated global mean of the hidden state."""

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        both = hidden + inputs
        self.convz, self.convz_glo = nn.Conv2d(both, hidden, 3, padding=1), nn.Conv2d(hidden, hidden, 1)
        self.convr, self.convr_glo = nn.Conv2d(both, hidden, 3, padding=1), nn.Conv2d(hidden, hidden, 1)
        self.convq, self.convq_glo = nn.Conv2d(both, hidden, 3, padding=1), nn.Conv2d(hidden, hidden, 1)
        self.w = nn.Conv2d(hidden, hidden, 1)

    def forward(self, net: Tensor, inputs: Tensor) -> Tensor:
        context = (torch.sigmoid(self.w(net)) * net).mean(dim=(2, 3), keepdim=True)
        both = torch.cat([net, inputs], dim=1)
        z = torch.sigmoid(self.convz(both) + self.convz_glo(context))
        r = torch.sigmoid(self.convr(both) + self.convr_glo(context))
        q = torch.tanh(self.convq(torch.cat([r * net, inputs], dim=1)) + self.convq_glo(context))
        return (1 - z) * net + z * q


class _GraphAggregation(nn.Module):
    """Mean over the edges of a frame, then its damping and its upsampling mask."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(128, 128, 3, padding=1)
        self.conv2 = nn.Conv2d(128, 128, 3, padding=1)
        self.eta = nn.Sequential(nn.Conv2d(128, 1, 3, padding=1), nn.Softplus())
        self.upmask = nn.Sequential(nn.Conv2d(128, STRIDE * STRIDE * 9, 1))

    def forward(self, net: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
        frames, group = torch.unique(source, return_inverse=True)
        net = torch.relu(self.conv1(net))
        total = net.new_zeros(len(frames), *net.shape[1:]).index_add_(0, group, net)
        mean = total / torch.bincount(group, minlength=len(frames)).to(net)[:, None, None, None]
        mean = torch.relu(self.conv2(mean))
        return 0.01 * self.eta(mean)[:, 0], self.upmask(mean)


class Update(NamedTuple):
    """What one application of the update operator gives, for E edges of F distinct source frames."""

    net: Tensor  # (E, 128, h, w) hidden state
    delta: Tensor  # (E, h, w, 2) revision of the flow, 1/8 pixels (x, y)
    weight: Tensor  # (E, h, w, 2) confidence, 0..1
    eta: Tensor | None  # (F, h, w) damping, frames in ascending order
    upmask: Tensor | None  # (F, 576, h, w) mask for `upsample`


class UpdateOperator(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        relu = nn.ReLU()
        self.corr_encoder = nn.Sequential(nn.Conv2d(196, 128, 1), relu, nn.Conv2d(128, 128, 3, padding=1), relu)
        self.flow_encoder = nn.Sequential(nn.Conv2d(4, 128, 7, padding=3), relu, nn.Conv2d(128, 64, 3, padding=1), relu)
        self.weight = nn.Sequential(
            nn.Conv2d(128, 128, 3, padding=1), relu, nn.Conv2d(128, 2, 3, padding=1), nn.Sigmoid()
        )
        self.delta = nn.Sequential(nn.Conv2d(128, 128, 3, padding=1), relu, nn.Conv2d(128, 2, 3, padding=1))
        self.gru = _ConvGru(128, 128 + 128 + 64)
        self.agg = _GraphAggregation()

    def forward(
        self, net: Tensor, inp: Tensor, corr: Tensor, motion: Tensor | None = None, source: Tensor | None = None
    ) -> Update:
        """One step on E edges.

        net, inp: (E, 128, h, w) hidden state and context; corr: (E, 196, h, w) correlation lookup;
        motion: (E, 4, h, w) flow and residual, already clamped to +-64 (zeros if None);
        source: (E,) source frame of each edge; without it no damping and no mask are made.
        """
        if motion is None:
            motion = net.new_zeros(len(net), 4, *net.shape[2:])
        net = self.gru(net, torch.cat([inp, self.corr_encoder(corr), self.flow_encoder(motion)], dim=1))
        delta = self.delta(net).permute(0, 2, 3, 1)
        weight = self.weight(net).permute(0, 2, 3, 1)
        eta, upmask = self.agg(net, source) if source is not None else (None, None)
        return Update(net, delta, weight, eta, upmask)


class DroidNet(nn.Module):
    """Both encoders and the update operator; `load_state_dict` takes what `checkpoints.droid` returns."""

    def __init__(self) -> None:
        super().__init__()
        self.fnet = Encoder(128, norm=True)
        self.cnet = Encoder(256, norm=False)
        self.update = UpdateOperator()

    def features(self, images_rgb: Tensor) -> Tensor:
        """(N, 128, h, w) matching features of (N, 3, H, W) RGB images in 0..255."""
        features: Tensor = self.fnet(normalize_images(images_rgb))
        return features

    def context(self, images_rgb: Tensor) -> tuple[Tensor, Tensor]:
        """(net, inp), both (N, 128, h, w): initial hidden state and context."""
        net, inp = self.cnet(normalize_images(images_rgb)).split(128, dim=1)
        return torch.tanh(net), torch.relu(inp)


def upsample(disparity: Tensor, mask: Tensor) -> Tensor:
    """Convex combination of each pixel's 3x3 neighbors: (F, h, w) and mask (F, 576, h, w) to (F, 8h, 8w).

    Neighbors outside the map count as 0, as in the official code, so borders shrink (RAFT, section 3.3).
    """
    n, h, w = disparity.shape
    weights = mask.view(n, 9, STRIDE, STRIDE, h, w).softmax(dim=1)
    neighbors = F.unfold(disparity[:, None], 3, padding=1).view(n, 9, 1, 1, h, w)
    fine = (weights * neighbors).sum(dim=1)
    return fine.permute(0, 3, 1, 4, 2).reshape(n, STRIDE * h, STRIDE * w)
