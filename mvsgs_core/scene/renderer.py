"""Renders a lit scene from any pose: linear images and exact depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.scene.lit import LitScene


@dataclass(frozen=True)
class Rendering:
    """What a camera sees, before exposure and sensor."""

    color: np.ndarray  # (H, W, 3) float32, linear; (0, 0, 3) where it was not wanted
    # (H, W) float32 z at pixel centers, scene units; 0 where there is nothing; (0, 0) where it was not wanted
    depth: np.ndarray


class SceneRenderer:
    """A lit scene, ready to be filmed."""

    def __init__(self, scene: LitScene) -> None:
        """Raises ValueError for arrays that do not fit and ImportError if the kernels are not built."""
        self.kernel = scene.kernel()
        self.gloss_at = scene.gloss_at

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
        color: bool = True,
        depth: bool = True,
    ) -> Rendering:
        """The view of a camera at world_from_cam (4, 4) with intrinsics (4,) at size (height, width).

        gloss: strength of highlights, 0 for a Lambertian scene. `mover` is drawn at world_from_mover (4, 4). color,
        depth: whether it is wanted; color takes four fifths of the time.
        """
        fx, fy, cx, cy = (float(x) for x in intrinsics)
        mover_from_world = np.eye(4) if world_from_mover is None else np.linalg.inv(world_from_mover)
        return Rendering(
            *self.kernel.render(
                np.ascontiguousarray(world_from_cam, dtype=np.float64),
                fx,
                fy,
                cx,
                cy,
                *size,
                gloss,
                self.gloss_at,
                None if mover is None else mover.kernel,
                np.ascontiguousarray(mover_from_world, dtype=np.float64),
                threads,
                color,
                depth,
            )
        )
