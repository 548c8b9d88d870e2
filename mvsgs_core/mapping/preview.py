"""The map for a viewer while it grows: a render of the newest keyframe and a capped number of splats."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from mvsgs_core.export.ply import folded
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.rasterizer.interface import Render, as_bytes
from mvsgs_core.rasterizer.reference import rotation_matrices
from mvsgs_core.rasterizer.spherical_harmonics import to_rgb
from mvsgs_core.rasterizer.splats import Splats

DEPTH_WIDTH = 320  # pixels of the depth map at most: it is for the eye
CHUNK = 16384  # splats whose covariances are made at once: on the way they take several times their size


def preview_arrays(mapper: OnlineMapper, limit: int, provisional: Splats | None = None) -> dict[str, Any]:
    """What a preview shows, in world units, relative to the map's origin.

    Of the newest keyframe `index`, `world_from_cam` (4, 4) and what `seen` gives; for at most `limit` splats spread
    over the map `means` (N, 3), `covariances` (N, 3, 3), `colors` (N, 3) uint8, `opacities` (N,); all `keyframes` (K,),
    their `keyframe_poses` (K, 4, 4) and how many of the map's `splats` (K,) came from each; `origin` (3,) and the
    number of `iterations`.

    provisional: fewer than `limit`, in the mapper's frame and unit, all of which are shown beside the map's. The map
    has keyframes and splats.
    """
    newest, origin, unit = mapper.views[-1], mapper.frame.origin, mapper.frame.length
    assert origin is not None
    whole = thinned(mapper.state.detached(), limit - (0 if provisional is None else len(provisional))).tensors()
    if provisional is not None:
        whole = {name: torch.cat([value, getattr(provisional, name).to(value)]) for name, value in whole.items()}
    shown = folded(Splats(**whole), mapper.config.training.kernel)  # browsers know only Gaussians
    keyframes = np.array([view.index for view in mapper.views], dtype=np.int64)
    poses = np.stack([view.world_from_cam for view in mapper.views])
    poses[:, :3, 3] -= origin
    return {
        "index": newest.index,
        "iterations": mapper.iterations,
        "world_from_cam": poses[-1],
        **seen(mapper, newest),
        **gaussian_arrays(shown, unit),
        "keyframes": keyframes,
        "splats": splats_by_keyframe(mapper.state.anchors.cpu().numpy(), keyframes),
        "keyframe_poses": poses,
        "origin": origin,
    }


def thinned(splats: Splats, limit: int) -> Splats:
    """At most `limit` of them, or one, spread over the map; each covers the area of those that it stands for, too, so
    that no holes are seen."""
    stride = max(1, -(-len(splats) // max(1, limit)))
    if stride == 1:
        return splats
    kept = {name: value[::stride] for name, value in splats.tensors().items()}
    return Splats(**kept | {"log_scales": kept["log_scales"] + 0.5 * math.log(stride)})


def seen(mapper: OnlineMapper, view: TrainingView) -> dict[str, np.ndarray]:
    """What a preview shows of one view: `intrinsics` (4,), `image` and `render` (H, W, 3) uint8.

    And the rendered `depth` (h, w) in world units, of the same field of view, 0 where the map covers less than half of
    a pixel.
    """
    render = mapper.render(view)
    depth = known_depth(render) * mapper.frame.length
    step = -(-depth.shape[1] // DEPTH_WIDTH)
    return {
        "intrinsics": view.intrinsics,
        "image": view.image.cpu().numpy(),
        "render": as_bytes(render.color),
        "depth": np.ascontiguousarray(depth[step // 2 :: step, step // 2 :: step].float().cpu().numpy()),
    }


def known_depth(render: Render) -> torch.Tensor:
    """(H, W), 0 where the map covers less than half of a pixel."""
    return torch.where(render.opacity > 0.5, render.depth, 0.0)


def gaussian_arrays(splats: Splats, unit: float = 1.0) -> dict[str, np.ndarray]:
    """What a browser shows of Gaussians, in a unit of so many world units: `means` (N, 3), `covariances` (N, 3, 3),
    both in world units, `colors` (N, 3) uint8, `opacities` (N,)."""
    return {
        "means": (splats.means * unit).cpu().numpy(),
        "covariances": covariances(splats.quaternions, splats.log_scales, unit).cpu().numpy(),
        "colors": as_bytes(to_rgb(splats.sh[:, 0])),
        "opacities": torch.sigmoid(splats.opacity_logits).cpu().numpy(),
    }


def splats_by_keyframe(anchors: np.ndarray, keyframes: np.ndarray) -> np.ndarray:
    """(K,) how many of the anchors (N,) are each of the keyframes (K,)."""
    known, counts = np.unique(np.append(anchors, keyframes), return_counts=True)  # each keyframe once more
    return np.asarray(counts[np.searchsorted(known, keyframes)] - 1)


def covariances(quaternions: torch.Tensor, log_scales: torch.Tensor, unit: float) -> torch.Tensor:
    """(N, 3, 3) in world units, of quaternions (N, 4) and log scales (N, 3) in a unit of so many of them."""
    made = []
    for q, s in zip(quaternions.split(CHUNK), log_scales.split(CHUNK)):
        axes = rotation_matrices(q) * (s.exp() * unit)[:, None, :]
        made.append(axes @ axes.transpose(1, 2))
    return torch.cat(made)
