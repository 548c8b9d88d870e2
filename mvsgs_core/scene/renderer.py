"""Renders a scene from any pose: builds the kernel's scene once, then linear images and exact depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import native
from . import patches as grids
from .lighting import Lighting, bake, light_sizes
from .patches import Patch


@dataclass(frozen=True)
class Rendering:
    """What a camera sees, before exposure and sensor."""

    color: np.ndarray  # (H, W, 3) float32, linear
    depth: np.ndarray  # (H, W) float32 z at pixel centers, scene units; 0 where there is nothing


class SceneRenderer:
    """Triangles, textures and baked light of a list of patches."""

    def __init__(self, patches: Sequence[Patch], lighting: Lighting, seed: int = 0, threads: int = 0) -> None:
        """Bakes the light: a few seconds for a room. threads 0: as many as OpenMP gives.

        Raises ValueError for points that are not finite and ImportError if the kernels are not built.
        """
        if not all(np.isfinite(p.points).all() for p in patches):
            raise ValueError("a patch has points that are not finite")
        parts = [grids.triangles(p.points) for p in patches]
        sizes = light_sizes(patches, lighting.texel)
        self.lighting = lighting
        self.triangle_count = sum(len(corners) for corners, _ in parts)
        self.light_texel_count = int(np.prod(sizes, axis=1).sum())
        self.kernel = native.load("scene").Scene(
            np.ascontiguousarray(np.concatenate([corners for corners, _ in parts]), dtype=np.float32),
            np.ascontiguousarray(np.concatenate([uv for _, uv in parts]), dtype=np.float32),
            np.repeat(np.arange(len(patches), dtype=np.int32), [len(corners) for corners, _ in parts]),
            [np.ascontiguousarray(p.texture) for p in patches],
            sizes,
            np.array([p.gloss for p in patches], dtype=np.float32),
            lighting.sky(),
        )
        bake(self.kernel, patches, sizes, lighting, seed, threads)

    def render(
        self,
        world_from_cam: np.ndarray,
        intrinsics: np.ndarray,
        size: tuple[int, int],
        *,
        gloss: float = 0.0,
        mover: SceneRenderer | None = None,
        world_from_mover: np.ndarray | None = None,
        threads: int = 0,
    ) -> Rendering:
        """The view of a camera at world_from_cam (4, 4) with intrinsics (4,) at size (height, width).

        gloss: strength of highlights, 0 for a Lambertian scene. `mover` is drawn at world_from_mover (4, 4).
        """
        fx, fy, cx, cy = (float(x) for x in intrinsics)
        mover_from_world = np.eye(4) if world_from_mover is None else np.linalg.inv(world_from_mover)
        color, depth = self.kernel.render(
            np.ascontiguousarray(world_from_cam, dtype=np.float64),
            fx,
            fy,
            cx,
            cy,
            *size,
            gloss,
            np.array(self.lighting.gloss_at, dtype=np.float32),
            None if mover is None else mover.kernel,
            np.ascontiguousarray(mover_from_world, dtype=np.float64),
            threads,
        )
        return Rendering(color, depth)
