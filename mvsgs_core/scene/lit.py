"""A scene built and lit, as arrays: all that rendering needs, and what is kept of it on the disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mvsgs_core import native
from mvsgs_core.scene import patches as grids
from mvsgs_core.scene.lighting import Lighting, bake, light_sizes
from mvsgs_core.scene.patches import Patch


@dataclass(frozen=True)
class LitScene:
    """T triangles on P patches, each with a texture and a map of light."""

    corners: np.ndarray  # (T, 3, 3) float32, scene units
    coordinates: np.ndarray  # (T, 3, 2) float32 of these in the patch's texture
    patch_of: np.ndarray  # (T,) int32
    texels: np.ndarray  # (N, 3) uint8 sRGB, one texture after the other
    texture_sizes: np.ndarray  # (P, 2) int32 height, width
    gloss: np.ndarray  # (P,) float32
    sky: np.ndarray  # (16,) float32, see `Lighting.sky`
    gloss_at: np.ndarray  # (3,) float32, see `Lighting`
    light_sizes: np.ndarray  # (P, 2) int32 height, width
    light: np.ndarray  # (L, 3) float32, one map after the other; L = 0: not lit yet

    def kernel(self) -> Any:
        """What renders it. Raises ValueError for arrays that do not fit, ImportError if the kernels are not built."""
        ends = np.cumsum(np.prod(self.texture_sizes, axis=1, dtype=np.int64))
        if len(ends) == 0 or ends[-1] != len(self.texels):
            raise ValueError("the textures' sizes are not those of the texels")
        parts = np.split(self.texels, ends[:-1])
        textures = [part.reshape(*size, 3) for part, size in zip(parts, self.texture_sizes)]
        kernel = native.load("scene").Scene(
            self.corners, self.coordinates, self.patch_of, textures, self.light_sizes, self.gloss, self.sky
        )
        if len(self.light):
            kernel.set_light(self.light)
        return kernel


def lit(patches: Sequence[Patch], lighting: Lighting, seed: int = 0, threads: int = 0) -> LitScene:
    """Bakes the light: a second or two for a room. threads 0: as many as OpenMP gives.

    Raises ValueError for points that are not finite and ImportError if the kernels are not built.
    """
    if not all(np.isfinite(p.points).all() for p in patches):
        raise ValueError("a patch has points that are not finite")
    parts = [grids.triangles(p.points) for p in patches]
    scene = LitScene(
        corners=np.concatenate([corners for corners, _ in parts], dtype=np.float32),
        coordinates=np.concatenate([uv for _, uv in parts], dtype=np.float32),
        patch_of=np.repeat(np.arange(len(patches), dtype=np.int32), [len(corners) for corners, _ in parts]),
        texels=np.concatenate([p.texture.reshape(-1, 3) for p in patches]),
        texture_sizes=np.array([p.texture.shape[:2] for p in patches], dtype=np.int32),
        gloss=np.array([p.gloss for p in patches], dtype=np.float32),
        sky=lighting.sky(),
        gloss_at=np.array(lighting.gloss_at, dtype=np.float32),
        light_sizes=light_sizes(patches, lighting.texel),
        light=np.zeros((0, 3), dtype=np.float32),
    )
    light = bake(scene.kernel(), patches, scene.light_sizes, lighting, seed, threads)
    return LitScene(**{**vars(scene), "light": light})
