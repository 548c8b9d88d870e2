"""A saved map as one of its keyframes saw it, in the exposure and the vignetting of that photograph."""

from __future__ import annotations

import numpy as np
import torch

from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.photometry import vignetting_factor
from mvsgs_core.rasterizer.rasterize import Render

NEAR = 0.01  # of the typical depth: what is nearer to the camera is not drawn


def rendered_keyframe(final: Snapshot, cameras: Cameras, k: int) -> tuple[torch.Tensor, Render]:
    """Keyframe number k, from 0: color (H, W, 3), nominally 0 to 1, and the render in the map's own colors."""
    pose, (height, width) = cameras.world_from_cam[k], cameras.sizes[k].tolist()
    render = final.render(pose, cameras.intrinsics[k], (height, width), near=near_plane(final, pose))
    affine = torch.from_numpy(cameras.exposures[k]).to(render.color)
    color = render.color @ affine[:, :3].T + affine[:, 3]
    if cameras.vignetting is not None:
        factor = vignetting_factor(cameras.vignetting, cameras.intrinsics[k], (height, width))
        color = color * torch.from_numpy(factor).to(color)[..., None]
    return color, render


def near_plane(final: Snapshot, world_from_cam: np.ndarray) -> float:
    """In the map's unit, for a pose in the world (4, 4)."""
    depth = final.typical_depth()
    if depth is not None:
        return NEAR * depth
    distances = np.linalg.norm(final.splats.means.numpy() - final.relative_pose(world_from_cam)[:3, 3], axis=1)
    return NEAR * float(np.median(distances)) if len(distances) else NEAR
