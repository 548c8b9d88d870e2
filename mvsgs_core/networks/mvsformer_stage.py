"""One stage of MVSFormer's cascade: group-wise correlation over hypotheses, view weights, regularization, depth."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mvsgs_core.networks.mvsformer_features import ConvBn
from mvsgs_core.networks.posed_views import homogeneous_pixels

GROUPS = 8


class StageOutput(NamedTuple):
    depth: Tensor  # (h, w)
    confidence: Tensor  # (h, w) largest probability, without temperature
    logits: Tensor  # (D, h, w)
    hypotheses: Tensor  # (D, h, w), far to near
    view_weight: Tensor  # (S, h, w)
    volume: Tensor  # (groups, D, h, w)


class _Conv3dBn(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: tuple[int, int, int] = (1, 1, 1), up: bool = False) -> None:
        super().__init__()
        if up:
            padding = (stride[0] - 1, stride[1] - 1, stride[2] - 1)
            self.conv: nn.Module = nn.ConvTranspose3d(inputs, outputs, 3, stride, 1, output_padding=padding, bias=False)
        else:
            self.conv = nn.Conv3d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn = nn.BatchNorm3d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.bn(self.conv(x)))


class Regularizer(nn.Module):
    """3D U-net of a cost volume; with few hypotheses the depth axis keeps its length."""

    def __init__(self, hypotheses: int) -> None:
        super().__init__()
        keep_depth = hypotheses <= 8
        stride = (1, 2, 2) if keep_depth else (2, 2, 2)
        self.conv1, self.conv2 = _Conv3dBn(GROUPS, 16, stride), _Conv3dBn(16, 16)
        self.conv3, self.conv4 = _Conv3dBn(16, 32, stride), _Conv3dBn(32, 32)
        self.conv5, self.conv6 = _Conv3dBn(32, 64, stride), _Conv3dBn(64, 64)
        self.conv7 = self._up(64, 32, stride, keep_depth)
        self.conv9 = self._up(32, 16, stride, keep_depth)
        self.conv11 = self._up(16, 8, stride, keep_depth)
        self.prob = nn.Conv3d(8, 1, 1) if keep_depth else nn.Conv3d(8, 1, 3, padding=1, bias=False)

    @staticmethod
    def _up(inputs: int, outputs: int, stride: tuple[int, int, int], keep_depth: bool) -> nn.Module:
        block = _Conv3dBn(inputs, outputs, stride, up=True)
        # the official checkpoints name these layers by number where the depth axis is kept
        return nn.Sequential(block.conv, block.bn, nn.ReLU()) if keep_depth else block

    def forward(self, volume: Tensor) -> Tensor:
        half = self.conv2(self.conv1(volume))
        quarter = self.conv4(self.conv3(half))
        x = self.conv7(self.conv6(self.conv5(quarter))) + quarter
        x = self.conv9(x) + half
        logits: Tensor = self.prob(self.conv11(x) + volume)
        return logits


class Stage(nn.Module):
    def __init__(self, hypotheses: int) -> None:
        super().__init__()
        self.vis = nn.Sequential(
            ConvBn(1, 16, slope=0), ConvBn(16, 16, slope=0), ConvBn(16, 8, slope=0), nn.Conv2d(8, 1, 1), nn.Sigmoid()
        )
        self.cost_reg = Regularizer(hypotheses)

    def forward(self, features: Tensor, projections: Tensor, hypotheses: Tensor, temperature: float) -> StageOutput:
        """features (V, C, h, w), the first view being the reference; projections (V, 4, 4) float64, K [R | t] at this
        size; hypotheses (D, h, w), far to near."""
        reference, sources = features[0], features[1:]
        groups = reference.unflatten(0, (GROUPS, -1))[:, :, None]
        volume = reference.new_zeros(GROUPS, *hypotheses.shape)
        total = reference.new_zeros(hypotheses.shape[1:])
        weights = []
        for source, projection in zip(sources, projections[1:]):
            warped = warp(source, projection @ torch.linalg.inv(projections[0]), hypotheses)
            correlation = (groups * warped.unflatten(0, (GROUPS, -1))).mean(dim=1)
            log_probability = correlation.sum(dim=0).log_softmax(dim=0)
            entropy = -(log_probability.exp() * log_probability).sum(dim=0)
            weight = self.vis(entropy[None, None])[0, 0]
            volume = volume + correlation * weight
            total = total + weight
            weights.append(weight)
        volume = volume / (total + 1e-6)
        logits = self.cost_reg(volume[None])[0, 0]
        depth = (hypotheses * (temperature * logits).softmax(dim=0)).sum(dim=0)
        confidence = logits.softmax(dim=0).amax(dim=0)
        return StageOutput(depth, confidence, logits, hypotheses, torch.stack(weights), volume)


def warp(source: Tensor, source_from_reference: Tensor, hypotheses: Tensor) -> Tensor:
    """Source features (C, h, w) seen from the reference at each hypothesis (D, h, w): (C, D, h, w), 0 outside.

    source_from_reference: (4, 4) float64, pixels times depth of the reference to those of the source.
    """
    d, h, w = hypotheses.shape
    rays = source_from_reference[:3, :3] @ homogeneous_pixels(h, w, source.device)
    points = rays[:, None] * hypotheses.double().reshape(1, d, -1) + source_from_reference[:3, 3, None, None]
    xy = points[:2] / (points[2] + 1e-6)
    grid = torch.stack([xy[0] / ((w - 1) / 2) - 1, xy[1] / ((h - 1) / 2) - 1], dim=-1).to(source)
    # behind the camera there is nothing to see; far outside, so that the sampler gives 0
    grid = torch.where((points[2] > 0)[..., None], grid, torch.full_like(grid, 2.0)).nan_to_num(2.0, 2.0, 2.0)
    return F.grid_sample(source[None], grid[None], align_corners=True)[0].unflatten(2, (h, w))
