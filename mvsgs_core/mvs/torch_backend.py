"""The stereo kernels in PyTorch, for a GPU: the same mathematics as mvsgs_core/csrc/mvs, compared by tests."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.devices import TorchTwin
from mvsgs_core.mvs.interface import TILE, ChooseOptions, MatchingImages, SmoothingConfig, SurfaceEstimate
from mvsgs_core.mvs.matching_cost import CostConfig, make_cost
from mvsgs_core.mvs.windows import Windows

_MANY = 1e9


class TorchBackend(TorchTwin):
    """Runs on `device`, a torch device such as "cuda" or "cpu"; arrays in and out are numpy."""

    @torch.no_grad()
    def cost_volume(
        self, images: MatchingImages, first: np.ndarray, step: np.ndarray, hypotheses: int, radius: int,
        cost: CostConfig, needed: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        start, interval = self._on(first), self._on(step)
        surfaces = (start + k * interval for k in range(hypotheses))
        return self._sweep(images, surfaces, hypotheses, radius, cost, needed)

    @torch.no_grad()
    def surface_costs(
        self, images: MatchingImages, surfaces: np.ndarray, radius: int, cost: CostConfig,
        needed: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        return self._sweep(images, iter(self._on(surfaces)), len(surfaces), radius, cost, needed)

    def _sweep(
        self, images: MatchingImages, surfaces: Iterator[Tensor], count: int, radius: int, config: CostConfig,
        needed: np.ndarray | None,
    ) -> np.ndarray:  # fmt: skip
        """(H, D, W) costs of `count` surfaces (H, W)."""
        reference = self._on(images.reference)
        windows = Windows(reference, radius, config.noise, config.contrast)
        match = make_cost(windows, config)
        views = list(zip(self._on(images.neighbors), self._on(images.warps), strict=True))
        best = min(config.top_k, len(views))
        volume = torch.empty((reference.shape[0], count, reference.shape[1]), device=self.device)
        for k, surface in enumerate(surfaces):
            each = []
            for image, warp in views:
                sample, seen = _sample(image, warp, surface)
                each.append(match(windows.taps_of(sample)).where(seen, 1.0))
            volume[:, k] = torch.topk(torch.stack(each), best, dim=0, largest=False).values.mean(dim=0)
        if needed is not None:
            tiles = torch.from_numpy(needed).to(self.device).repeat_interleave(TILE[0], 0).repeat_interleave(TILE[1], 2)
            volume[tiles[: volume.shape[0], :, : volume.shape[2]] == 0] = 1.0
        return volume.cpu().numpy()

    @torch.no_grad()
    def choose_surface(
        self, cost: np.ndarray, surfaces: np.ndarray, reference: np.ndarray, options: ChooseOptions
    ) -> tuple[np.ndarray, np.ndarray]:
        volume, heights, gray = self._on(cost), self._on(surfaces).permute(1, 0, 2), self._on(reference)
        total = torch.zeros_like(volume)
        sideways = (volume.permute(2, 1, 0), heights.permute(2, 1, 0), gray.T)
        for reverse in (False, True):
            for shift in (0, 1, -1):
                total += _surface_path(volume, heights, gray, shift, reverse, options)
            total += _surface_path(*sideways, 0, reverse, options).permute(2, 1, 0)
        total /= 8.0
        lowest, best = total.min(dim=1)
        chosen = heights.gather(1, best[:, None])
        worse = torch.where((heights - chosen).abs() > options.apart, total - lowest[:, None], torch.ones_like(total))
        return best.to(torch.int32).cpu().numpy(), worse.amin(dim=1).clamp(max=1.0).cpu().numpy()

    @torch.no_grad()
    def view_correlation(
        self, images: MatchingImages, inverse_depth: np.ndarray, radius: int, cost: CostConfig
    ) -> np.ndarray:
        windows = Windows(self._on(images.reference), radius, cost.noise, cost.contrast)
        surface = self._on(inverse_depth)
        found = []
        for image, warp in zip(self._on(images.neighbors), self._on(images.warps), strict=True):
            sample, seen = _sample(image, warp, surface)
            found.append(windows.correlate(windows.taps_of(sample))[0].where(seen, -2.0))
        return torch.stack(found).cpu().numpy()

    @torch.no_grad()
    def semi_global(
        self, cost: np.ndarray, reference: np.ndarray, first: np.ndarray, step: np.ndarray, p1: float, p2: float,
        smoothing: SmoothingConfig,
    ) -> SurfaceEstimate:  # fmt: skip
        volume, gray, start, interval = (self._on(a) for a in (cost, reference, first, step))
        total = torch.zeros_like(volume)
        sideways = (volume.permute(2, 1, 0), gray.T, start.T, interval.T)
        shifts = (0, 1, -1) if smoothing.paths == 8 else (0,)
        for reverse in (False, True):
            for shift in shifts:
                total += _path(volume, gray, start, interval, shift, reverse, p1, p2, smoothing)
            total += _path(*sideways, 0, reverse, p1, p2, smoothing).permute(2, 1, 0)
        return _select(total / smoothing.paths, smoothing.temperature)


def _sample(image: Tensor, warp: Tensor, inverse_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Bilinear samples (H, W) of an image (h, w), border repeated, and whether the pixel lies inside it."""
    height, width = inverse_depth.shape
    nh, nw = image.shape
    v = torch.arange(height, device=image.device, dtype=torch.float32)[:, None]
    u = torch.arange(width, device=image.device, dtype=torch.float32)[None, :]
    xs, ys, zs = (
        warp[3 * i] * u + (warp[3 * i + 1] * v + warp[3 * i + 2]) + inverse_depth * warp[9 + i] for i in range(3)
    )
    front = zs > 1e-6
    inverse = 1.0 / torch.where(front, zs, torch.ones_like(zs))
    outside = torch.full_like(zs, -1.0)
    px, py = torch.where(front, xs * inverse, outside), torch.where(front, ys * inverse, outside)
    seen = (px >= 0) & (px <= nw - 1) & (py >= 0) & (py <= nh - 1) & (inverse_depth > 0)
    qx, qy = px.clamp(0.0, nw - 1.0), py.clamp(0.0, nh - 1.0)
    ix, iy = qx.long().clamp(max=nw - 2), qy.long().clamp(max=nh - 2)
    ax, ay = qx - ix, qy - iy
    flat, at = image.reshape(-1), iy * nw + ix
    top = flat[at] + ax * (flat[at + 1] - flat[at])
    bottom = flat[at + nw] + ax * (flat[at + nw + 1] - flat[at + nw])
    return top + ay * (bottom - top), seen


def _path(
    cost: Tensor, gray: Tensor, first: Tensor, step: Tensor, shift: int, reverse: bool, p1: float, p2: float,
    options: SmoothingConfig,
) -> Tensor:  # fmt: skip
    """Path costs (R, D, C) of one direction: row by row, the predecessor `shift` columns to the left."""
    rows, count, columns = cost.shape
    result = torch.empty_like(cost)
    order = range(rows - 1, -1, -1) if reverse else range(rows)
    previous = torch.zeros((count, columns), device=cost.device)
    lowest = torch.zeros(columns, device=cost.device)
    high = torch.full((1, columns), _MANY, device=cost.device)
    source = torch.arange(columns, device=cost.device) - shift
    inside, source = (source >= 0) & (source < columns), source.clamp(0, columns - 1)
    before: int | None = None
    for y in order:
        if before is None:
            value = cost[y].clone()
        else:
            contrast = (gray[y] - gray[before][source]).abs() / options.edge
            jump = (first[y] - first[before][source]).abs()
            broken = jump > options.break_steps * torch.maximum(step[y], step[before][source])
            relax = torch.where(broken, torch.zeros_like(contrast), 1.0 / (1.0 + contrast))
            same = torch.where(inside, previous[:, source], torch.zeros_like(previous))
            base = torch.where(inside, lowest[source], torch.zeros_like(lowest))
            # Outside the image all is 0, as at a path's start, but there is no hypothesis beyond the first and last.
            below, above = torch.cat([high, same[:-1]]), torch.cat([same[1:], high])
            moved = torch.minimum(torch.minimum(below, above) + p1 * relax, base + p2 * relax)
            value = cost[y] + torch.minimum(same, moved) - base
        result[y] = value
        previous, lowest, before = value, value.min(dim=0).values, y
    return result


def _surface_path(
    cost: Tensor, heights: Tensor, gray: Tensor, shift: int, reverse: bool, options: ChooseOptions
) -> Tensor:
    """Path costs (R, D, C) of one direction over surfaces (R, D, C): see `_path`."""
    rows, _, columns = cost.shape
    result = torch.empty_like(cost)
    order = range(rows - 1, -1, -1) if reverse else range(rows)
    source = torch.arange(columns, device=cost.device) - shift
    inside, source = (source >= 0) & (source < columns), source.clamp(0, columns - 1)
    before: int | None = None
    for y in order:
        result[y] = cost[y]
        if before is not None:
            relax = 1.0 / (1.0 + (gray[y] - gray[before][source]).abs() / options.edge)
            apart = (heights[y][:, None] - heights[before][:, source][None]).abs()
            jump = (options.p1 * apart).clamp(max=options.p2) * relax
            least = result[before].amin(dim=0)
            moved = (result[before][:, source][None] + jump).amin(dim=1) - least[source]
            result[y] += torch.where(inside, moved, torch.zeros_like(moved))
        before = y
    return result


def _select(total: Tensor, temperature: float) -> SurfaceEstimate:
    """The best hypothesis of mean path costs (H, D, W), refined by a parabola, and how sure it is."""
    count = total.shape[1]
    lowest, best = total.min(dim=1)
    gap = total - lowest[:, None]
    weight = torch.exp(-gap / temperature)
    distance = (torch.arange(count, device=total.device)[None, :, None] - best[:, None]).abs()
    near = torch.where(distance <= 1, weight, torch.zeros_like(weight)).sum(dim=1)
    margin = torch.where(distance >= 2, gap, torch.ones_like(gap)).amin(dim=1).clamp(max=1.0)
    before = gap.gather(1, (best - 1).clamp(min=0)[:, None])[:, 0]
    after = gap.gather(1, (best + 1).clamp(max=count - 1)[:, None])[:, 0]
    both = before + after
    usable = (best > 0) & (best < count - 1) & (both > 1e-9)
    offset = torch.where(usable, 0.5 * (before - after) / both.clamp(min=1e-9), torch.zeros_like(both))
    return SurfaceEstimate(
        index=(best + offset).cpu().numpy().astype(np.float32),
        probability=(near / weight.sum(dim=1)).cpu().numpy(),
        margin=margin.cpu().numpy(),
        best=best.to(torch.int32).cpu().numpy(),
    )
