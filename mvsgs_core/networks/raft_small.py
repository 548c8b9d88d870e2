"""RAFT, the small model (Teed and Deng 2020): dense optical flow by recurrent lookups in an all-pairs correlation.

Keys and shapes are those of the official raft-small.pth (0.99 M parameters).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mvsgs_core.networks.correlation import CorrelationVolume

STRIDE, HIDDEN, CONTEXT = 8, 96, 64


class _InstanceNorm(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return F.instance_norm(x)


class _Bottleneck(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: int, norm: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs // 4, 1)
        self.conv2 = nn.Conv2d(outputs // 4, outputs // 4, 3, stride, 1)
        self.conv3 = nn.Conv2d(outputs // 4, outputs, 1)
        self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride)) if stride != 1 else None
        self.norm: nn.Module = _InstanceNorm() if norm else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(self.norm(self.conv1(x)))
        y = torch.relu(self.norm(self.conv2(y)))
        y = torch.relu(self.norm(self.conv3(y)))
        if self.downsample is not None:
            x = self.norm(self.downsample(x))
        return torch.relu(x + y)


class _Encoder(nn.Module):
    def __init__(self, outputs: int, norm: bool) -> None:
        super().__init__()
        self.norm: nn.Module = _InstanceNorm() if norm else nn.Identity()
        self.conv1 = nn.Conv2d(3, 32, 7, 2, 3)
        self.layer1 = nn.Sequential(_Bottleneck(32, 32, 1, norm), _Bottleneck(32, 32, 1, norm))
        self.layer2 = nn.Sequential(_Bottleneck(32, 64, 2, norm), _Bottleneck(64, 64, 1, norm))
        self.layer3 = nn.Sequential(_Bottleneck(64, 96, 2, norm), _Bottleneck(96, 96, 1, norm))
        self.conv2 = nn.Conv2d(96, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = torch.relu(self.norm(self.conv1(x)))
        features: Tensor = self.conv2(self.layer3(self.layer2(self.layer1(x))))
        return features


class _MotionEncoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.convc1 = nn.Conv2d(196, 96, 1)
        self.convf1, self.convf2 = nn.Conv2d(2, 64, 7, padding=3), nn.Conv2d(64, 32, 3, padding=1)
        self.conv = nn.Conv2d(128, 80, 3, padding=1)

    def forward(self, flow: Tensor, correlation: Tensor) -> Tensor:
        of_correlation = torch.relu(self.convc1(correlation))
        of_flow = torch.relu(self.convf2(torch.relu(self.convf1(flow))))
        motion = torch.relu(self.conv(torch.cat([of_correlation, of_flow], dim=1)))
        return torch.cat([motion, flow], dim=1)


class _Gru(nn.Module):
    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.convz = nn.Conv2d(HIDDEN + inputs, HIDDEN, 3, padding=1)
        self.convr = nn.Conv2d(HIDDEN + inputs, HIDDEN, 3, padding=1)
        self.convq = nn.Conv2d(HIDDEN + inputs, HIDDEN, 3, padding=1)

    def forward(self, hidden: Tensor, x: Tensor) -> Tensor:
        both = torch.cat([hidden, x], dim=1)
        z, r = torch.sigmoid(self.convz(both)), torch.sigmoid(self.convr(both))
        q = torch.tanh(self.convq(torch.cat([r * hidden, x], dim=1)))
        return (1 - z) * hidden + z * q


class _FlowHead(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.conv2 = nn.Conv2d(HIDDEN, 128, 3, padding=1), nn.Conv2d(128, 2, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        delta: Tensor = self.conv2(torch.relu(self.conv1(x)))
        return delta


class _UpdateBlock(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.gru, self.flow_head = _MotionEncoder(), _Gru(82 + CONTEXT), _FlowHead()

    def forward(self, hidden: Tensor, context: Tensor, correlation: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.gru(hidden, torch.cat([context, self.encoder(flow, correlation)], dim=1))
        return hidden, self.flow_head(hidden)


class RaftSmall(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.fnet, self.cnet = _Encoder(128, norm=True), _Encoder(HIDDEN + CONTEXT, norm=False)
        self.update_block = _UpdateBlock()

    @torch.no_grad()
    def forward(self, first: Tensor, second: Tensor, iterations: int = 12, start: Tensor | None = None) -> Tensor:
        """Flow (N, 2, H, W) in pixels (x, y) from `first` to `second`, (N, 3, H, W) RGB in 0..255, any size.

        start: (N, 2, H/8, W/8) flow to begin with, in pixels of the 1/8 map.
        """
        n, _, h, w = first.shape
        pad_h, pad_w = -h % STRIDE, -w % STRIDE
        padding = (pad_w // 2, pad_w - pad_w // 2, pad_h // 2, pad_h - pad_h // 2)
        images = F.pad(torch.cat([first, second]), padding, mode="replicate") / 127.5 - 1
        features = self.fnet(images)
        correlation = CorrelationVolume(features[:n], features[n:], scale=features.shape[1] ** -0.5)
        hidden, context = self.cnet(images[:n]).split([HIDDEN, CONTEXT], dim=1)
        hidden, context = torch.tanh(hidden), torch.relu(context)
        y, x = torch.meshgrid(
            *(torch.arange(s, device=first.device).float() for s in features.shape[2:]), indexing="ij"
        )
        pixels = torch.stack([x, y])
        flow = torch.zeros_like(hidden[:, :2]) if start is None else start
        for _ in range(iterations):
            found = correlation((pixels + flow).permute(0, 2, 3, 1))
            hidden, delta = self.update_block(hidden, context, found, flow)
            flow = flow + delta
        # the small model has no learned upsampling
        fine = STRIDE * F.interpolate(flow, scale_factor=STRIDE, mode="bilinear", align_corners=True)
        return fine[:, :, padding[2] : padding[2] + h, padding[0] : padding[0] + w]
