"""Bakes light into a scene: texels over every patch, light from windows, lamps and sun, then bounces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from mvsgs_core.scene import patches as grids
from mvsgs_core.scene.patches import Patch


@dataclass(frozen=True)
class RectLight:
    """A rectangle that shines to the side of cross(edge_u, edge_v)."""

    corner: tuple[float, float, float]  # scene units
    edge_u: tuple[float, float, float]
    edge_v: tuple[float, float, float]
    radiance: tuple[float, float, float]  # linear; 1 is what a white wall in full exposure sends


@dataclass(frozen=True)
class Lighting:
    """Everything that shines on a scene, and how finely it is baked."""

    texel: float  # side of a light texel, scene units
    rects: tuple[RectLight, ...] = ()
    horizon: tuple[float, float, float] = (0.0, 0.0, 0.0)  # radiance of the sky
    zenith: tuple[float, float, float] = (0.0, 0.0, 0.0)
    below: tuple[float, float, float] = (0.0, 0.0, 0.0)
    to_sun: tuple[float, float, float] = (0.0, 0.0, 1.0)
    sun: tuple[float, float, float] = (0.0, 0.0, 0.0)  # irradiance on a surface that faces it
    sun_radius: float = 0.02  # radians, of its disk
    ambient: tuple[float, float, float] = (0.0, 0.0, 0.0)  # stands for the bounces after the last one traced
    direct_rays: int = 30  # per light and texel; the kernel traces 16 at once
    bounce_rays: int = 64  # per texel
    gloss_at: tuple[float, float, float] = field(default=(0.0, 0.0, 3.0))  # what glossy surfaces mirror

    def sky(self) -> np.ndarray:
        """(16,) float32 as the kernel takes it."""
        values = [*self.horizon, *self.zenith, *self.below, *self.to_sun, *self.sun, self.sun_radius]
        return np.array(values, dtype=np.float32)


def light_sizes(patches: Sequence[Patch], texel: float) -> np.ndarray:
    """(P, 2) int32 height and width of each patch's light map: at least 2, at most 512."""
    sizes = [np.clip(np.ceil(np.array(grids.extent(p.points)) / texel), 2, 512) for p in patches]
    sizes = [np.array([1.0, 1.0]) if p.emission is not None else s for p, s in zip(patches, sizes)]
    return np.array(sizes, dtype=np.int32)


def bake(
    kernel: Any, patches: Sequence[Patch], sizes: np.ndarray, lighting: Lighting, seed: int, threads: int
) -> np.ndarray:
    """Light (L, 3) float32 of the kernel's scene. Deterministic in `seed`, whatever the number of threads."""
    points, normals = zip(*(_texels(p, tuple(s), lighting.texel) for p, s in zip(patches, sizes)))
    all_points = np.ascontiguousarray(np.concatenate(points), dtype=np.float32)
    all_normals = np.ascontiguousarray(np.concatenate(normals), dtype=np.float32)
    rects = np.array([[r.corner, r.edge_u, r.edge_v, r.radiance] for r in lighting.rects], dtype=np.float32)
    rects = rects.reshape(-1, 4, 3)

    def finish(light: np.ndarray) -> np.ndarray:
        return _per_patch(light, patches, sizes)

    front = kernel.direct_light(all_points, all_normals, rects, lighting.direct_rays, seed, threads)
    thin = np.concatenate([np.full(len(p), q.two_sided) for p, q in zip(points, patches)])
    back_of_thin = (all_points[thin], -all_normals[thin])
    if thin.any():
        front[thin] = 0.5 * (
            front[thin] + kernel.direct_light(*back_of_thin, rects, lighting.direct_rays, seed + 1, threads)
        )
    ambient = np.array(lighting.ambient, dtype=np.float32)
    kernel.set_light(finish(front + ambient))
    bounced = kernel.bounced_light(all_points, all_normals, lighting.bounce_rays, seed, threads)
    if thin.any():
        back = kernel.bounced_light(*back_of_thin, lighting.bounce_rays, seed + 1, threads)
        bounced[thin] = 0.5 * (bounced[thin] + back)
    return finish(front + bounced)


def _texels(patch: Patch, size: tuple[int, int], texel: float) -> tuple[np.ndarray, np.ndarray]:
    """Centers (N, 3), lifted off the surface, and normals (N, 3) of a patch's light texels."""
    v, u = ((np.arange(n) + 0.5) / n for n in size)
    normal = grids.sample(grids.normals(patch.points), v, u).reshape(-1, 3)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return grids.sample(patch.points, v, u).reshape(-1, 3) + 0.02 * texel * normal, normal


def _per_patch(light: np.ndarray, patches: Sequence[Patch], sizes: np.ndarray) -> np.ndarray:
    """Light texels (N, 3) with the sampling noise of each patch's map smoothed and emission put in."""
    result, start = np.empty_like(light), 0
    for patch, (h, w) in zip(patches, sizes):
        part = light[start : start + h * w].reshape(h, w, 3)
        if patch.emission is not None:
            part = np.full_like(part, patch.emission)
        elif min(h, w) >= 4:
            part = cv2.GaussianBlur(part, (3, 3), 0.7, borderType=cv2.BORDER_REPLICATE)
        result[start : start + h * w] = part.reshape(-1, 3)
        start += h * w
    return result
