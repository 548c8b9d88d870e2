"""V-FUSE in the frame of the online fusion: it refines, the paper's filters then reject."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mvsgs_core import camera, geometry, weights
from mvsgs_core.fusion.fusion import DepthFusion, FusedDepth, FusionConfig, fuse, nearest_views
from mvsgs_core.fusion.views import DepthView
from mvsgs_core.networks import checkpoints
from mvsgs_core.networks.vfuse import FusionInput, VFuse

RANDOM = "random"
_PERCENTILES, _MARGIN = (1.0, 99.0), 1.1  # of the known depths, for the range that the network normalizes by


def make_network(file: str | None) -> VFuse:
    """V-FUSE with a checkpoint's weights: `file`, or where mvsgs_core.weights finds it; "random": untrained.

    Raises what `weights.find` and the checkpoint reader raise, saying what to fetch from where.
    """
    path = None if file == RANDOM else weights.find("vfuse", file)
    if path is None:
        torch.manual_seed(0)
    net = VFuse()
    if path is not None:
        checkpoints.load(net, checkpoints.read(Path(path), inside="model_state_dict"), Path(path))
    return net.eval().requires_grad_(False)


class LearnedFusion(DepthFusion):
    """`center`: "conf", the most confident depth, or "mean", the confidence-weighted mean, as the window's center."""

    def __init__(self, config: FusionConfig, file: str | None, center: str = "conf") -> None:
        super().__init__(replace(config, refine=False))
        self._net = make_network(file)
        self._center = center

    def _next(self) -> FusedDepth:
        index = self._waiting.pop(0)
        reference = next(v for v in self._views if v.index == index)
        others = [v for v in self._views if v.index != index]
        neighbors = nearest_views(reference, others, self.config.neighbors)
        if neighbors and (reference.depth > 0).any():
            reference = refine(self._net, reference, neighbors, self._center)
        return fuse(reference, neighbors, self.config, self._backend)


def refine(net: VFuse, reference: DepthView, neighbors: list[DepthView], center: str) -> DepthView:
    """The reference with V-FUSE's depth and confidence, which is relative to the image (see networks.vfuse)."""
    views = [reference, *neighbors]
    depths = np.stack([v.depth for v in views]).astype(np.float32)
    # around the reference and at unit median depth: float32 has no digits to spare in a far or tiny world
    unit = float(np.median(depths[depths > 0]))
    low, high = np.percentile(depths[depths > 0] / unit, _PERCENTILES)
    cam_from_world = np.stack([geometry.inverse(v.world_from_cam) for v in views]) @ reference.world_from_cam
    cam_from_world[:, :3, 3] /= unit
    fused = net(
        FusionInput(
            torch.from_numpy(depths / np.float32(unit)),
            torch.from_numpy(np.stack([v.confidence for v in views]).clip(0, 1)),
            torch.from_numpy(cam_from_world),
            torch.from_numpy(np.stack([camera.matrix(v.intrinsics) for v in views])),
            near=float(low / _MARGIN),
            far=float(high * _MARGIN),
        ),
        center,
    )
    depth = fused.depth.numpy() * np.float32(unit)
    good = np.isfinite(depth) & (depth > 0) & (fused.confidence.numpy() >= 0)
    return replace(
        reference,
        depth=np.where(good, depth, np.float32(0)),
        confidence=np.where(good, fused.confidence.numpy(), np.float32(0)),
    )
