"""What a live preview shows of the newest keyframe, before its depth is there. Frames of the finished map: `worst`."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch

from bench.table import Row, at_least, at_most
from launch.compose import compose
from launch.inline import run_inline
from msgs import FusedKeyframe, Keyframe, Poses, Preview
from mvsgs_core.geometry import quaternion_from_rotation
from mvsgs_core.rasterizer.kernels import neutral_beta
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.spherical_harmonics import C0
from mvsgs_core.rasterizer.splats import Splats
from nodes import Node
from nodes.mapper import Mapper

MIN_COVERED = 0.99  # fraction of a frame's pixels above half opacity
MAX_TIME = 5.0  # % of the mapper's
PERIOD = 1e-9  # s between previews: one for each message
WHOLE = 10**7  # splats: more than there are, so that a preview shows all of the map, then what is provisional


def measure(quick: bool) -> list[Row]:
    size = ["dataset.size=[120,160]", "dataset.stop=60"] if quick else []
    sent: list[Keyframe | FusedKeyframe | Poses] = []

    def keep(slot: str, node: Node, message: Any) -> None:
        if isinstance(message, Keyframe | FusedKeyframe) or (isinstance(message, Poses) and slot == "depth_fusion"):
            sent.append(message)

    without_map = ["evaluator.max_frames=0", "mapper.preview_period=0", "mapper.iterations=0", "mapper.refinement=0"]
    run_inline(compose([*without_map, "evaluator.lpips=off", *size]), keep)
    return _live(sent)


def _live(sent: list[Keyframe | FusedKeyframe | Poses]) -> list[Row]:
    """A mapper that gets keyframes when the tracker has them, four of them before their depth."""
    mapper = Mapper(Mapper.Config(preview_period=PERIOD, preview_splats=WHOLE))
    covered, without, delays = [], [], []
    for message in sent:
        if isinstance(message, FusedKeyframe):
            list(mapper.on_fused_keyframe(message))
        elif isinstance(message, Poses):
            list(mapper.on_poses(message))
        else:
            known, start = len(mapper.atlas.current.state), time.perf_counter()
            for preview in mapper.on_keyframe(message):
                delays.append(time.perf_counter() - start)
                covered.append(_coverage(preview, message, len(preview.means)))
                without.append(_coverage(preview, message, known))
    spent = mapper.stats.seconds
    fraction = spent["provisional"] / sum(spent.values())
    return [
        at_least("newest: keyframe in the preview that it gives rise to", min(covered), "least covered", MIN_COVERED),
        Row("newest: the same by the map alone", min(without), "least covered"),
        Row("newest: until that preview is made", 1e3 * float(np.median(delays)), "ms, median"),
        at_most("newest: provisional splats, of the mapper's time", 100 * fraction, "%", MAX_TIME),
    ]


def _coverage(preview: Preview, keyframe: Keyframe, count: int) -> float:
    """Share of the keyframe's pixels that the preview's first `count` splats cover."""
    pose = keyframe.world_from_cam.copy()
    pose[:3, 3] -= np.zeros(3) if preview.origin is None else preview.origin
    size = keyframe.image.shape[0], keyframe.image.shape[1]
    render = rasterize(_splats(preview, count), pose, keyframe.intrinsics, size)
    return float((render.opacity.numpy() > 0.5).mean())


def _splats(preview: Preview, count: int) -> Splats:
    variances, axes = np.linalg.eigh(preview.covariances[:count].astype(np.float64))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1.0
    opacity = np.clip(preview.opacities[:count], 1e-4, 1 - 1e-4)
    quaternions = np.stack([quaternion_from_rotation(rotation) for rotation in axes])
    arrays = (
        preview.means[:count], 0.5 * np.log(np.maximum(variances, 1e-20)), quaternions,
        np.log(opacity / (1 - opacity)), (preview.colors[:count, None] / 255.0 - 0.5) / C0,
        np.full(count, neutral_beta("gaussian")),
    )  # fmt: skip
    return Splats(*(torch.from_numpy(np.ascontiguousarray(a, dtype=np.float32)) for a in arrays))
