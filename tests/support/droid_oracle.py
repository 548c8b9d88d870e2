"""DROID-SLAM's networks replaced by the truth: what is left to test is everything around them.

The camera is in a box, so that depth is known in closed form and nothing is hidden. An image is of one color, its
frame's number; features carry the number, so that a correlation lookup tells which two frames an edge joins.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mvsgs_core import geometry
from mvsgs_core.networks.droid import DroidNet, Update

BOX = np.array([2.5, 1.5, 3.0])  # half extents


def path(count: int, step: float = 0.04) -> np.ndarray:
    """(N, 4, 4) world_from_cam: a curve in the middle of the box, turning."""
    t = step * np.arange(count)
    zero = np.zeros_like(t)
    turn = np.stack([0.2 * np.sin(t), 0.5 * np.sin(0.8 * t), 0.1 * np.sin(0.5 * t)], axis=1)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = geometry.so3_exp(turn)
    poses[:, :3, 3] = np.stack([0.9 * np.sin(t), 0.3 * np.sin(1.7 * t), 0.5 * np.cos(0.9 * t) + zero], axis=1)
    return poses


def image(number: int, height: int, width: int) -> np.ndarray:
    return np.full((height, width, 3), (number // 256, number % 256, 0), np.uint8)


def depth(world_from_cam: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """z of the box's wall along camera rays (..., 3) with z = 1."""
    direction = rays @ world_from_cam[:3, :3].T
    wall = np.where(direction > 0, BOX, -BOX) - world_from_cam[:3, 3]
    return np.asarray((wall / np.where(np.abs(direction) < 1e-9, 1e-9, direction)).min(axis=-1))


class Oracle(DroidNet):
    """intrinsics: (4,) in cells. noise: cells, of the answers; silent_from: number from which it finds nothing."""

    def __init__(self, world_from_cam: np.ndarray, intrinsics: np.ndarray, noise: float = 0.0) -> None:
        super().__init__()
        self.world_from_cam, self.intrinsics, self.noise = world_from_cam, intrinsics, noise
        self.random = np.random.default_rng(0)
        self.update = self._update  # type: ignore[assignment]

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "update" and not isinstance(value, torch.nn.Module):
            self.__dict__["_modules"].pop("update", None)
            object.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)

    @staticmethod
    def _numbers(images: Tensor) -> Tensor:
        return images[:, 0, 0, 0] * 256 + images[:, 1, 0, 0]

    def features(self, images_rgb: Tensor) -> Tensor:
        n, _, h, w = images_rgb.shape
        found = torch.zeros(n, 128, h // 8, w // 8)
        found[:, 0] = (self._numbers(images_rgb) + 1)[:, None, None]
        return found

    def context(self, images_rgb: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.features(images_rgb)
        return hidden, torch.zeros_like(hidden)

    def truth(self, i: int, j: int, h: int, w: int) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (h, w, 2) of the cells of frame i in frame j, and whether they are in its view."""
        u, v = np.meshgrid(np.arange(w), np.arange(h))
        fx, fy, cx, cy = self.intrinsics
        rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1)
        points = rays * depth(self.world_from_cam[i], rays)[..., None]
        move = geometry.inverse(self.world_from_cam[j]) @ self.world_from_cam[i]
        points = points @ move[:3, :3].T + move[:3, 3]
        z = np.where(points[..., 2] > 0.05, points[..., 2], np.inf)
        target = np.stack([fx * points[..., 0] / z + cx, fy * points[..., 1] / z + cy], axis=-1)
        return target, np.isfinite(z) & np.all((target >= 0) & (target <= [w - 1, h - 1]), axis=-1)

    def _update(
        self, net: Tensor, inp: Tensor, corr: Tensor, motion: Tensor | None = None, source: Tensor | None = None
    ) -> Update:
        edges, _, h, w = net.shape
        delta, weight = np.zeros((edges, h, w, 2), np.float32), np.zeros((edges, h, w, 2), np.float32)
        here = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1)
        for e in range(edges):
            a = float(net[e, 0, 0, 0])
            b = round(16.0 * float(corr[e].max()) / a)
            if b == 0:
                continue  # no cell is looked up inside the other map: nothing is known
            target, seen = self.truth(round(a) - 1, b - 1, h, w)
            now = here + (0.0 if motion is None else motion[e, :2].permute(1, 2, 0).numpy())
            delta[e] = target - now + self.noise * self.random.standard_normal(target.shape)
            weight[e] = seen[..., None]
        frames = 0 if source is None else len(torch.unique(source))
        eta = torch.full((frames, h, w), 1e-4) if frames else None
        return Update(net, torch.from_numpy(delta), torch.from_numpy(weight), eta, None)
