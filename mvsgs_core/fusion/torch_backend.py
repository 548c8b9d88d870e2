"""The fusion kernels in PyTorch, for a GPU: the same mathematics as mvsgs_core/csrc/fusion, compared by tests."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.devices import TorchTwin
from mvsgs_core.fusion.interface import DepthMaps, Fused, FuseOptions


class TorchFusionBackend(TorchTwin):
    """Runs on `device`, a torch device such as "cuda" or "cpu"; arrays in and out are numpy."""

    @torch.no_grad()
    def parallax(self, maps: DepthMaps) -> np.ndarray:
        z = self._on(maps.depth)
        u, v = _pixels(z.shape, self.device)
        squares = torch.zeros_like(z)
        size = torch.Size(maps.neighbor_depths.shape[1:])
        for there in self._on(maps.there):
            x, y, depth, front = _project(there, u, v, z)
            use = (z > 0) & front & _nearest(x, y, size)[1]
            moved = torch.stack([there[9] - x * there[11], there[10] - y * there[11]]) / torch.where(use, depth, 1.0)
            squares += torch.where(use, moved.square().sum(0), 0.0)
        return squares.sqrt().cpu().numpy()

    @torch.no_grad()
    def consistent_views(self, maps: DepthMaps, relative: np.ndarray) -> np.ndarray:
        z, within = self._on(maps.depth), self._on(relative)
        u, v = _pixels(z.shape, self.device)
        count = torch.zeros(z.shape, dtype=torch.uint8, device=self.device)
        for map_, there in zip(self._on(maps.neighbor_depths), self._on(maps.there)):
            x, y, seen_depth, front = _project(there, u, v, z)
            at, inside = _nearest(x, y, map_.shape)
            found = map_.reshape(-1)[at]
            agree = (z > 0) & front & inside & (found > 0)
            agree &= (found - seen_depth).abs() < within * torch.maximum(found, seen_depth)
            count += agree.to(torch.uint8)
        return count.cpu().numpy()

    @torch.no_grad()
    def splat(self, maps: DepthMaps, options: FuseOptions) -> np.ndarray:
        size = (maps.depth.shape[0], maps.depth.shape[1])
        result = torch.full((len(maps.back), size[0] * size[1]), torch.inf, device=self.device)
        depths, confidences = self._on(maps.neighbor_depths), self._on(maps.neighbor_confidences)
        for i, (z, c, warp) in enumerate(zip(depths, confidences, self._on(maps.back), strict=True)):
            u, v = _pixels(z.shape, self.device)
            x, y, depth, front = _project(warp, u, v, z)
            at, inside = _nearest(x, y, size)
            use = (z > 0) & (c >= options.min_neighbor_confidence) & front & inside
            result[i].scatter_reduce_(0, at[use], depth[use], reduce="amin")
        result[torch.isinf(result)] = 0.0
        return result.reshape(-1, *size).cpu().numpy()

    @torch.no_grad()
    def fuse(self, maps: DepthMaps, splatted: np.ndarray, sigma: np.ndarray, options: FuseOptions) -> Fused:
        own_depth, width = self._on(maps.depth), self._on(sigma)
        known = own_depth > 0
        own_confidence = torch.where(known, self._on(maps.confidence), torch.zeros_like(own_depth))
        depths, sure = self._on(maps.neighbor_depths), self._on(maps.neighbor_confidences)
        there = self._on(maps.there)
        u, v = _pixels(own_depth.shape, self.device)
        tolerance, zero = 3.0 * width, torch.zeros_like(own_depth)
        best = {"score": torch.full_like(own_depth, -1e9), "depth": zero, "for": zero, "against": zero, "own": zero}
        for z in [own_depth, *self._on(splatted)]:
            valid = z > 0
            safe = torch.where(valid, z, torch.ones_like(z))
            difference = (own_depth - safe) / safe
            agree = torch.exp(-0.5 * (difference / width) ** 2)
            from_own = torch.where(known, own_confidence * agree, zero)
            against = torch.where(known & (difference.abs() > tolerance), own_confidence, zero)
            weights = from_own.clone()
            inverse = torch.where(known, from_own / torch.where(known, own_depth, safe), zero)
            support = zero.clone()
            for map_, c_map, warp in zip(depths, sure, there, strict=True):
                x, y, expected, front = _project(warp, u, v, safe)
                at, inside = _nearest(x, y, map_.shape)
                found, c = map_.reshape(-1)[at], c_map.reshape(-1)[at]
                use = valid & front & inside & (found > 0) & (c >= options.min_neighbor_confidence)
                off = torch.where(use, (found - expected) / torch.where(use, expected, safe), zero)
                weight = torch.where(use, c * torch.exp(-0.5 * (off / width) ** 2), zero)
                support += weight
                weights += weight
                inverse += torch.where(use, weight / (safe * (1.0 + off)), zero)
                against += torch.where(use & (off > tolerance), c, zero)
            score = support + from_own - options.violation * against
            better = valid & (score > best["score"])
            refined = torch.where(inverse > 0, weights / torch.where(inverse > 0, inverse, safe), safe)
            new = {"score": score, "depth": refined, "for": support, "against": against, "own": from_own}
            best = {name: torch.where(better, new[name], best[name]) for name in best}
        return Fused(*(best[name].cpu().numpy() for name in ("depth", "for", "against", "own")))


def _pixels(shape: torch.Size, device: str) -> tuple[Tensor, Tensor]:
    v, u = torch.meshgrid(
        torch.arange(shape[0], device=device, dtype=torch.float32),
        torch.arange(shape[1], device=device, dtype=torch.float32),
        indexing="ij",
    )
    return u, v


def _project(warp: Tensor, u: Tensor, v: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixel (x, y) and depth in the other camera, and whether it is in front."""
    w = 1.0 / torch.where(z > 0, z, torch.ones_like(z))
    xs, ys, zs = (warp[3 * i] * u + warp[3 * i + 1] * v + warp[3 * i + 2] + w * warp[9 + i] for i in range(3))
    front = zs > 1e-6
    inverse = 1.0 / torch.where(front, zs, torch.ones_like(zs))
    return xs * inverse, ys * inverse, zs * z, front


def _nearest(x: Tensor, y: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Flat index of the nearest pixel, clamped, and whether (x, y) lies in the image."""
    height, width = shape[0], shape[1]
    inside = (x > -0.5) & (y > -0.5) & (x < width - 0.5) & (y < height - 0.5)
    ix = (torch.where(inside, x, torch.zeros_like(x)) + 0.5).long().clamp(max=width - 1)
    iy = (torch.where(inside, y, torch.zeros_like(y)) + 0.5).long().clamp(max=height - 1)
    return iy * width + ix, inside
