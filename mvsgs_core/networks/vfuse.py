"""V-FUSE (Burgdorfer and Mordohai 2023): fuses depth maps of several views through a visibility constraint volume.

Written from the paper; keys and shapes are those of the official checkpoints. The confidence is their default, `swr`:
relative to the image (1 for its narrowest search window, 0 for its widest), so a threshold on it keeps a fraction of
the pixels and is no probability.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mvsgs_core.networks.posed_views import homogeneous_pixels

PLANES = 8


def _conv2d(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU())


def _deconv2d(inputs: int, outputs: int) -> nn.Sequential:
    up = nn.ConvTranspose2d(inputs, outputs, 3, 2, 1, output_padding=1, bias=False)
    return nn.Sequential(up, nn.BatchNorm2d(outputs), nn.ReLU())


def _conv3d(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv3d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm3d(outputs), nn.ReLU())


def _deconv3d(inputs: int, outputs: int) -> nn.Sequential:
    up = nn.ConvTranspose3d(inputs, outputs, 3, 2, 1, output_padding=1, bias=False)
    return nn.Sequential(up, nn.BatchNorm3d(outputs), nn.ReLU())


class SearchWindowNet(nn.Module):
    """Half width of each pixel's search window from the spread of the views' depths and confidences (section 3.2)."""

    def __init__(self) -> None:
        super().__init__()
        # conv1 to conv10: in the official checkpoints, but not part of the computation
        shapes = ((5, 4), (4, 4), (4, 8), (8, 8), (8, 16), (16, 8), (8, 8), (8, 4), (4, 4))
        for k, (inputs, outputs) in enumerate(shapes, start=1):
            self.add_module(f"conv{k}", _deconv2d(inputs, outputs) if k in (6, 8) else _conv2d(inputs, outputs))
        self.conv10 = nn.Sequential(nn.Conv2d(4, 1, 3, 1, 1))
        self.conv11 = _conv2d(5, 4)
        self.conv12 = _conv2d(4, 8, stride=2)
        self.conv13 = _conv2d(8, 16, stride=2)
        self.conv14 = _deconv2d(16, 8)
        self.conv15 = _deconv2d(8, 4)
        self.conv16 = nn.Sequential(nn.Conv2d(4, 1, 3, 1, 1))
        self.max_radius_scale = nn.Parameter(torch.tensor(0.5))
        self.min_radius_scale = nn.Parameter(torch.tensor(0.005))

    def forward(self, statistics: Tensor) -> Tensor:
        """(H, W) window size in 0..1 of statistics (5, H, W), H and W multiples of 4."""
        full = self.conv11(statistics[None])
        half = self.conv12(full)
        up = self.conv14(self.conv13(half)) + half
        up = self.conv15(up) + full
        return torch.sigmoid(self.conv16(up))[0, 0]


@dataclass(frozen=True)
class FusionInput:
    """V views, the first being the reference. 0 marks an unknown depth."""

    depths: Tensor  # (V, H, W)
    confidences: Tensor  # (V, H, W), 0 to 1
    cam_from_world: Tensor  # (V, 4, 4) float64
    cameras: Tensor  # (V, 3, 3) float64
    near: float
    far: float


class Fused(NamedTuple):
    depth: Tensor  # (H, W); 0 where no view has a depth
    confidence: Tensor  # (H, W), 0 to 1, see `narrowness`
    bounds: Tensor  # (2, H, W) ends of the search window
    window: Tensor  # (H, W) in 0..1
    statistics: Tensor  # (5, H, W) input of the window network
    volume: Tensor  # (3, M, H, W) support, occlusion, free space
    logits: Tensor  # (M, H, W)
    probability: Tensor  # (M, H, W)


class VFuse(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.swo_net = SearchWindowNet()
        self.sup_planes = nn.Parameter(torch.tensor(1.5))
        self.scale = nn.Parameter(torch.tensor(3.0))
        self.conv0_1 = _conv3d(3, 8)
        self.conv1_0, self.conv1_1 = _conv3d(3, 16, 2), _conv3d(16, 16)
        self.conv2_0, self.conv2_1 = _conv3d(16, 32, 2), _conv3d(32, 32)
        self.conv3_0, self.conv3_1 = _conv3d(32, 64, 2), _conv3d(64, 64)
        self.conv4_0, self.conv5_0, self.conv6_0 = _deconv3d(64, 32), _deconv3d(32, 16), _deconv3d(16, 8)
        self.conv6_2 = nn.Sequential(nn.Conv3d(8, 1, 3, 1, 1), nn.ReLU())

    @torch.no_grad()
    def forward(
        self,
        views: FusionInput,
        center: str = "conf",
        warped: tuple[Tensor, Tensor] | None = None,
    ) -> Fused:
        """Fuses the views' depths into the reference.

        center: "conf", the most confident depth, or "mean", the confidence-weighted mean. `warped`: depths and
        confidences (V, H, W) already in the reference, else they are splatted here. H and W: multiples of 8. Raises
        ValueError for other sizes or an unknown center.
        """
        check_center(center)
        if views.depths.shape[1] % 8 or views.depths.shape[2] % 8:
            raise ValueError(f"V-FUSE needs maps of multiples of 8, got {tuple(views.depths.shape[1:])}")
        depths, confidences = warped if warped is not None else splat_views(views)
        extent = views.far - views.near
        known = (depths > 0).to(depths)
        count = known.sum(dim=0).clamp(min=1)
        if center == "conf":
            middle = depths.gather(0, confidences.argmax(dim=0, keepdim=True))[0]
        else:
            middle = (depths * confidences).sum(dim=0) / confidences.sum(dim=0).clamp(min=1e-12)
        statistics = self._statistics(middle, depths, confidences, known, count, views.near, extent)
        window = self.swo_net(statistics)
        radius = (self.swo_net.max_radius_scale * window + self.swo_net.min_radius_scale) * extent
        bounds = torch.stack([middle - radius, middle + radius])
        steps = torch.linspace(0, 1, PLANES, device=depths.device, dtype=depths.dtype)[:, None, None]
        planes = bounds[0] + (bounds[1] - bounds[0]) * steps
        volume = self._visibility(views, depths, confidences, known, planes, extent)
        logits = self._regularize(volume)
        probability = logits.softmax(dim=0)
        depth = (planes * probability).sum(dim=0)
        seen = known.amax(dim=0)
        return Fused(depth * seen, narrowness(radius) * seen, bounds, window, statistics, volume, logits, probability)

    def _statistics(
        self,
        middle: Tensor,
        depths: Tensor,
        confidences: Tensor,
        known: Tensor,
        count: Tensor,
        near: float,
        extent: float,
    ) -> Tensor:
        """(5, H, W): center, then mean and deviation over the views of depth and of confidence."""
        rows = [(middle - near) / extent]
        for values in ((depths - near) / extent, confidences):
            mean = (values * known).sum(dim=0) / count
            deviation = ((known * (values - mean) ** 2).sum(dim=0) / count).sqrt()
            rows += [mean, deviation / (deviation.max() + 1e-5)]
        return torch.stack(rows)

    def _visibility(
        self, views: FusionInput, depths: Tensor, confidences: Tensor, known: Tensor, planes: Tensor, extent: float
    ) -> Tensor:
        """Support, occlusion and free space of each plane (section 3.3, equations 3 to 5), each a mean over views.

        The mean is over the terms that are not exactly 0 in float32, so float32 underflow is part of the network.
        """
        spacing = (planes[1] - planes[0]) / extent
        sigma = self.sup_planes / (PLANES - 1) * spacing
        slope = self.scale * PLANES / spacing
        difference = (depths[:, None] - planes) / extent
        known, confidence = known[:, None], confidences[:, None]
        support = known * confidence * torch.exp(-(difference**2) / (2 * sigma**2 + 1e-7))
        occlusion = known * confidence * torch.sigmoid(slope * difference)
        free = [confidence[0] * torch.sigmoid(-slope * difference[0])]
        for view in range(1, len(depths)):
            z, seen_depth, seen_confidence = _look_up(views, view, planes)
            free.append(seen_confidence * torch.sigmoid(slope * (z - seen_depth) / extent))
        return torch.stack([_mean_nonzero(support), _mean_nonzero(occlusion), _mean_nonzero(torch.stack(free))])

    def _regularize(self, volume: Tensor) -> Tensor:
        x = volume[None]
        half = self.conv1_0(x)
        quarter = self.conv2_0(half)
        y = self.conv4_0(self.conv3_1(self.conv3_0(quarter))) + self.conv2_1(quarter)
        y = self.conv5_0(y) + self.conv1_1(half)
        y = self.conv6_0(y) + self.conv0_1(x)
        logits: Tensor = self.conv6_2(y)[0, 0]
        return logits


def check_center(center: str) -> None:
    """Raises ValueError for one that `VFuse` does not know."""
    if center not in ("conf", "mean"):
        raise ValueError(f"center={center!r}: it is conf or mean")


def narrowness(radius: Tensor) -> Tensor:
    """(H, W) 1 for the narrowest window of the image, 0 for the widest; 1 where all are alike."""
    return 1 - (radius - radius.min()) / (radius.max() - radius.min()).clamp(min=1e-12)


def splat_views(views: FusionInput) -> tuple[Tensor, Tensor]:
    """Depths and confidences (V, H, W) of all views seen from the reference; 0 where nothing lands.

    The target pixel is the projection truncated toward 0, and no depth test decides between points that meet (the
    last in raster order stays), as in the official code.
    """
    _, h, w = views.depths.shape
    depths, confidences = [views.depths[0]], [views.confidences[0]]
    pixels = homogeneous_pixels(h, w, views.cameras.device)
    for view in range(1, len(views.depths)):
        z = views.depths[view].double().reshape(-1)
        points = torch.linalg.inv(views.cameras[view]) @ pixels * z
        move = views.cam_from_world[0] @ torch.linalg.inv(views.cam_from_world[view])
        points = move[:3, :3] @ points + move[:3, 3:]
        projected = views.cameras[0] @ points
        u, v = (projected[:2] / projected[2]).trunc().nan_to_num(-1.0, -1.0, -1.0)
        inside = (z > 0) & (points[2] > 0) & (u >= 0) & (u < w) & (v >= 0) & (v < h)
        target = (v[inside] * w + u[inside]).long().cpu().numpy()
        for values, splatted in ((points[2], depths), (views.confidences[view].reshape(-1), confidences)):
            canvas = torch.zeros(h * w, dtype=views.depths.dtype)
            # numpy: an index that repeats takes the last value, which torch leaves open
            canvas.numpy()[target] = values[inside].to(canvas.dtype).cpu().numpy()
            splatted.append(canvas.reshape(h, w).to(views.depths.device))
    return torch.stack(depths), torch.stack(confidences)


def _look_up(views: FusionInput, view: int, planes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Depth z of the planes' points in a source view, and that view's own depth and confidence there; (M, H, W)."""
    m, h, w = planes.shape
    rays = torch.linalg.inv(views.cameras[0]) @ homogeneous_pixels(h, w, views.cameras.device)
    points = rays[:, None] * planes.double().reshape(1, m, -1)
    move = views.cam_from_world[view] @ torch.linalg.inv(views.cam_from_world[0])
    points = move[:3, :3] @ points.reshape(3, -1) + move[:3, 3:]
    projected = views.cameras[view] @ points
    xy = (projected[:2] / projected[2]).reshape(2, m, h, w)
    # normalized for aligned corners but sampled unaligned, half a pixel off: the released weights expect it
    grid = torch.stack([xy[0] / ((w - 1) / 2) - 1, xy[1] / ((h - 1) / 2) - 1], dim=-1).to(planes)
    maps = torch.stack([views.depths[view], views.confidences[view]])[None].expand(m, -1, -1, -1)
    found = F.grid_sample(maps, grid.nan_to_num(2.0, 2.0, -2.0), align_corners=False)
    return points[2].reshape(m, h, w).to(planes), found[:, 0], found[:, 1]


def _mean_nonzero(terms: Tensor) -> Tensor:
    count = (terms != 0).sum(dim=0)
    return terms.sum(dim=0) / count.clamp(min=1)
