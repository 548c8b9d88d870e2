"""IterMVS (Wang et al. 2022): multi-view stereo by a recurrent search in inverse depth, 0.34 M parameters.

A GRU at 1/4 keeps a distribution over 256 inverse depths; each iteration looks up the correlation at ten samples
around the current depth, at three feature levels. Keys and shapes are those of the official checkpoints.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mvsgs_core.networks.posed_views import check_range, homogeneous_pixels, projections

GROUPS, HIDDEN, BINS, INITIAL_SAMPLES, RADIUS, ITERATIONS = 8, 32, 256, 32, 4, 4
MULTIPLE = 32  # sizes of images that every level divides without rest
# samples around the current depth by feature level, in bins
_OFFSETS = {1: (-2.0, -2 / 3, 2 / 3, 2.0), 2: (-8.0, -8 / 3, 8 / 3, 8.0), 3: (-32.0, 32.0)}


class IterMvsOutput(NamedTuple):
    depth: Tensor  # (H, W)
    confidence: Tensor  # (H, W) 0 to 1
    coarse_depth: Tensor  # (H/4, W/4)


class _ConvBn(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.bn(self.conv(x))
        return y


class _ConvRelu(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.conv(x))


class _Residual(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1, self.conv2 = _ConvBn(inputs, outputs, stride), _ConvBn(outputs, outputs)
        self.downsample = _ConvBn(inputs, outputs, stride) if stride != 1 else None

    def forward(self, x: Tensor) -> Tensor:
        y = self.conv2(torch.relu(self.conv1(x)))
        return torch.relu(y + (x if self.downsample is None else self.downsample(x)))


class FeatureNet(nn.Module):
    """(V, 3, H, W) in -1..1 to features of 16, 32, 48 channels at 1/2, 1/4, 1/8, by level 1, 2, 3."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = _ConvBn(3, 8)
        self.layer1 = nn.Sequential(_Residual(8, 16, 2), _Residual(16, 16))
        self.layer2 = nn.Sequential(_Residual(16, 32, 2), _Residual(32, 32))
        self.layer3 = nn.Sequential(_Residual(32, 48, 2), _Residual(48, 48))
        self.output1 = nn.Conv2d(48, 16, 3, padding=1)
        self.output2 = nn.Conv2d(48, 32, 3, padding=1)
        self.output3 = nn.Conv2d(48, 48, 3, padding=1)
        self.inner1, self.inner2 = nn.Conv2d(16, 48, 1), nn.Conv2d(32, 48, 1)
        self.inner3 = nn.Conv2d(48, 48, 1)  # in the checkpoints, not part of the computation

    def forward(self, x: Tensor) -> dict[int, Tensor]:
        half = self.layer1(torch.relu(self.conv1(x)))
        quarter = self.layer2(half)
        eighth = self.layer3(quarter)
        top2 = _resize(eighth, 2) + self.inner2(quarter)
        top1 = _resize(top2, 2) + self.inner1(half)
        return {1: self.output1(top1), 2: self.output2(top2), 3: self.output3(eighth)}


class _CorrelationNet(nn.Module):
    """Correlation groups (G, N, h, w) to one matching score (N, h, w) a sample: a small 2D U-net."""

    def __init__(self) -> None:
        super().__init__()
        self.conv0, self.conv1, self.conv2 = _ConvRelu(GROUPS, 8), _ConvRelu(8, 16, 2), _ConvRelu(16, 32, 2)
        self.conv3 = nn.ConvTranspose2d(32, 16, 3, 2, 1, output_padding=1, bias=False)
        self.conv4 = nn.ConvTranspose2d(16, 8, 3, 2, 1, output_padding=1, bias=False)
        self.conv5 = nn.Conv2d(8, 1, 3, padding=1)

    def forward(self, groups: Tensor) -> Tensor:
        full = self.conv0(groups.transpose(0, 1))
        half = self.conv1(full)
        x = half + self.conv3(self.conv2(half))
        score: Tensor = self.conv5(full + self.conv4(x))[:, 0]
        return score


class _ViewWeight(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Sequential(_ConvRelu(GROUPS, 16), nn.Conv2d(16, 1, 1))

    def forward(self, groups: Tensor) -> Tensor:
        """(h, w): the largest probability over samples, high where a view matches at one depth only."""
        return self.conv(groups.transpose(0, 1))[:, 0].softmax(dim=0).amax(dim=0)


class _Evaluation(nn.Module):
    """Matching scores of depth samples, summed over the views with their weights."""

    def __init__(self) -> None:
        super().__init__()
        self.pixel_view_weight = _ViewWeight()
        self.corr_conv1 = nn.ModuleList(_CorrelationNet() for _ in range(3))

    def start(self, features: Tensor, projections: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
        """View weights (S, 2h, 2w) and scores (N, h, w) of samples (N, h, w) at level 3."""
        groups = [_correlate(features[0], f, projections, s, samples) for s, f in enumerate(features[1:], start=1)]
        weights = [self.pixel_view_weight(g) for g in groups]
        scores = self.corr_conv1[2](_weighted_mean(groups, weights))
        return _resize(torch.stack(weights)[None], 2)[0], scores

    def look_up(
        self, features: dict[int, Tensor], projections: dict[int, Tensor], samples: dict[int, Tensor], weights: Tensor
    ) -> Tensor:
        """Scores (10, h, w) at level 2's size of the samples of all levels."""
        scores = []
        for level in (1, 2, 3):
            reference = features[level][:1]
            if level != 2:
                reference = _resize(reference, 2.0 ** (level - 2))
            groups = [
                _correlate(reference[0], source, projections[level], s, samples[level])
                for s, source in enumerate(features[level][1:], start=1)
            ]
            scores.append(self.corr_conv1[level - 1](_weighted_mean(groups, list(weights))))
        return torch.cat(scores)


class _Gru(nn.Module):
    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.convz = nn.Conv2d(HIDDEN + inputs, HIDDEN, 3, padding=2, dilation=2)
        self.convr = nn.Conv2d(HIDDEN + inputs, HIDDEN, 3, padding=2, dilation=2)
        self.convq = nn.Conv2d(HIDDEN + inputs, HIDDEN, 3, padding=2, dilation=2)

    def forward(self, hidden: Tensor, x: Tensor) -> Tensor:
        both = torch.cat([hidden, x], dim=1)
        z, r = torch.sigmoid(self.convz(both)), torch.sigmoid(self.convr(both))
        q = torch.tanh(self.convq(torch.cat([r * hidden, x], dim=1)))
        return (1 - z) * hidden + z * q


def _dilated() -> nn.Conv2d:
    return nn.Conv2d(HIDDEN, 32, 3, padding=2, dilation=2, bias=False)


class _Update(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        relu = nn.ReLU()
        self.gru = _Gru(1 + sum(len(o) for o in _OFFSETS.values()))
        self.depth_head = nn.Sequential(
            _dilated(), relu, nn.Conv2d(32, 64, 1, bias=False), relu, nn.Conv2d(64, BINS, 1)
        )
        self.confidence_head = nn.Sequential(_dilated(), relu, nn.Conv2d(32, 1, 1))
        self.hidden_init_head = nn.Sequential(
            nn.Conv2d(INITIAL_SAMPLES, 64, 3, padding=1, bias=False), relu, nn.Conv2d(64, HIDDEN, 1)
        )

    def start(self, scores: Tensor) -> Tensor:
        """Hidden state (1, 32, 2h, 2w) from the first scores (32, h, w)."""
        return torch.tanh(_resize(self.hidden_init_head(scores[None]), 2))

    def position(self, hidden: Tensor) -> Tensor:
        """(h, w) place in the inverse-depth range, 0 far to 1 near: the mean around the most probable bin."""
        probability = self.depth_head(hidden)[0].softmax(dim=0)
        best = probability.argmax(dim=0, keepdim=True)
        around = torch.arange(-RADIUS, RADIUS + 1, device=hidden.device)[:, None, None]
        # clamped at the ends, where the last bin then counts more than once, as in training
        bins = (best + around).clamp(0, BINS - 1)
        p = probability.gather(0, bins)
        return (bins * p).sum(dim=0) / (p.sum(dim=0) + 1e-6) / (BINS - 1)


class _Iteration(nn.Module):
    """All but the features; named as in the official checkpoints."""

    def __init__(self) -> None:
        super().__init__()
        self.evaluation, self.update = _Evaluation(), _Update()
        self.upsample = nn.Sequential(
            nn.Conv2d(32, 64, 3, padding=1, bias=False), nn.ReLU(), nn.Conv2d(64, 16 * 9, 1, bias=False)
        )


class IterMvs(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.feature_net = FeatureNet()
        self.iter_mvs = _Iteration()

    @torch.no_grad()
    def forward(
        self,
        images_rgb: Tensor,
        cam_from_world: Tensor,
        cameras: Tensor,
        depth_range: tuple[float, float],
        iterations: int = ITERATIONS,
    ) -> IterMvsOutput:
        """Depth of the first of V views.

        images_rgb (V, 3, H, W) in 0..255; cam_from_world (V, 4, 4) and cameras (V, 3, 3) float64 at full size;
        depth_range (near, far). Raises ValueError for a bad range or a size that is no multiple of 32.
        """
        near, far = check_range(depth_range)
        if images_rgb.shape[2] % MULTIPLE or images_rgb.shape[3] % MULTIPLE:
            raise ValueError(f"IterMVS needs sizes that are multiples of {MULTIPLE}, got {tuple(images_rgb.shape[2:])}")
        features = self.feature_net(images_rgb / 127.5 - 1)
        at_level = {level: projections(cam_from_world, cameras, 0.5**level) for level in (1, 2, 3)}
        net, update = self.iter_mvs, self.iter_mvs.update

        def depth_at(position: Tensor) -> Tensor:
            return 1 / (1 / far + position * (1 / near - 1 / far))

        steps = torch.linspace(0, 1, INITIAL_SAMPLES, device=images_rgb.device)[:, None, None]
        samples = depth_at(steps.expand(-1, *features[3].shape[2:]))
        weights, scores = net.evaluation.start(features[3], at_level[3], samples)
        hidden = update.start(scores)
        position = update.position(hidden)
        for _ in range(iterations):
            around = {
                level: depth_at((position + position.new_tensor(o)[:, None, None] / BINS).clamp(0, 1))
                for level, o in _OFFSETS.items()
            }
            found = net.evaluation.look_up(features, at_level, around, weights)
            hidden = update.gru(hidden, torch.cat([position[None], found])[None])
            position = update.position(hidden)
        confidence = torch.sigmoid(_resize(update.confidence_head(hidden), 1))
        fine = _upsample(position, net.upsample(features[2][:1])[0])
        return IterMvsOutput(depth_at(fine), _resize(confidence, 4)[0, 0], depth_at(position))


def _resize(x: Tensor, factor: float) -> Tensor:
    if factor == 1:
        return x
    return F.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)


def _correlate(reference: Tensor, source: Tensor, projections: Tensor, view: int, samples: Tensor) -> Tensor:
    """Group-wise correlation (G, N, h, w) of reference (C, h, w) with source (C, h', w') at samples (N, h, w)."""
    warped = _warp(source, projections[view] @ torch.linalg.inv(projections[0]), samples)
    groups = reference.unflatten(0, (GROUPS, -1))[:, :, None]
    return (warped.unflatten(0, (GROUPS, -1)) * groups).mean(dim=1)


def _warp(source: Tensor, source_from_reference: Tensor, samples: Tensor) -> Tensor:
    """Source features (C, h', w') seen from the reference at samples (N, h, w): (C, N, h, w), 0 outside.

    Where the samples' grid is coarser or finer than the source's, its pixels are scaled without a shift.
    """
    n, h, w = samples.shape
    height, width = source.shape[1:]
    pixels = homogeneous_pixels(h, w, samples.device)
    rays = source_from_reference[:3, :3] @ (pixels * pixels.new_tensor([[width / w], [height / h], [1.0]]))
    points = rays[:, None] * samples.double().reshape(1, n, -1) + source_from_reference[:3, 3, None, None]
    # behind the camera, or so near that the division means nothing: far outside, so that the sampler gives 0
    front = points[2] > 1e-6
    xy = points[:2] / points[2].clamp(min=1e-6)
    grid = torch.stack([xy[0] / ((width - 1) / 2) - 1, xy[1] / ((height - 1) / 2) - 1], dim=-1)
    grid = torch.where(front[..., None], grid.clamp(-4, 4), torch.full_like(grid, 4.0)).to(source)
    return F.grid_sample(source[None], grid[None], align_corners=True)[0].unflatten(2, (h, w))


def _weighted_mean(groups: list[Tensor], weights: list[Tensor]) -> Tensor:
    total = sum((g * w for g, w in zip(groups, weights)), torch.zeros_like(groups[0]))
    return total / (torch.stack(weights).sum(dim=0) + 1e-5)


def _upsample(position: Tensor, mask: Tensor) -> Tensor:
    """Convex combination of each pixel's 3x3 neighbors, borders repeated: (h, w) and (144, h, w) to (4h, 4w)."""
    h, w = position.shape
    weights = mask.view(9, 4, 4, h, w).softmax(dim=0)
    padded = F.pad(position[None, None], (1, 1, 1, 1), mode="replicate")
    neighbors = F.unfold(padded, 3).view(9, 1, 1, h, w)
    return (weights * neighbors).sum(dim=0).permute(2, 0, 3, 1).reshape(4 * h, 4 * w)
