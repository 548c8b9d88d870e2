"""V-FUSE in the frame of the online fusion: it refines, the paper's filters then reject."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from mvsgs_core import camera, geometry
from mvsgs_core.fusion.fusion import DepthFusion, FusionConfig
from mvsgs_core.fusion.keyframe_depth import KeyframeDepth
from mvsgs_core.networks import checkpoints
from mvsgs_core.networks.vfuse import FusionInput, VFuse, check_choices

RANDOM = "random"
_PERCENTILES, _MARGIN = (1.0, 99.0), 1.1  # of the known depths, for the range that the network normalizes by


def make_network(file: str | None) -> VFuse:
    """V-FUSE with a checkpoint's weights: `file`, or where mvsgs_core.weights finds it; "random": untrained.

    Raises what `weights.find` and the checkpoint reader raise, saying what to fetch from where.
    """
    if file == RANDOM:
        torch.manual_seed(0)
    net = VFuse()
    if file != RANDOM:
        checkpoints.load_registered(net, "vfuse", file, inside="model_state_dict")
    return net.eval().requires_grad_(False)


@dataclass(frozen=True)
class VFuseConfig:
    """V-FUSE for the fusion."""

    file: str | None = None  # checkpoint; None: where mvsgs_core.weights finds it; "random": untrained, for tests
    center: str = "conf"  # of the search window: "conf", the most confident depth, or "mean", the weighted mean
    confidence: str = "swr"  # of networks.vfuse_confidence.MODES
    device: str = "cpu"  # "cpu" or "cuda[:N]"


class LearnedFusion(DepthFusion):
    """Raises ValueError for an unknown center or confidence, and what `make_network` raises."""

    def __init__(self, config: FusionConfig, learned: VFuseConfig) -> None:
        super().__init__(replace(config, refine=False))
        check_choices(learned.center, learned.confidence)
        self.learned = learned
        self._net = make_network(learned.file).to(learned.device)

    def _prepared(self, reference: KeyframeDepth, neighbors: list[KeyframeDepth]) -> KeyframeDepth:
        if not neighbors or not (reference.depth > 0).any():
            return reference
        return refine(self._net, reference, neighbors, self.learned)


def refine(net: VFuse, reference: KeyframeDepth, neighbors: list[KeyframeDepth], learned: VFuseConfig) -> KeyframeDepth:
    """The reference with V-FUSE's depth and confidence (what it means: networks.vfuse_confidence)."""
    views = [reference, *neighbors]
    depths = np.stack([v.depth for v in views]).astype(np.float32)
    # around the reference and at unit median depth: float32 has no digits to spare in a far or tiny world
    unit = float(np.median(depths[depths > 0]))
    low, high = np.percentile(depths[depths > 0] / unit, _PERCENTILES)
    cam_from_world = np.stack([geometry.inverse(v.world_from_cam) for v in views]) @ reference.world_from_cam
    cam_from_world[:, :3, 3] /= unit
    given = FusionInput(
        torch.from_numpy(depths / np.float32(unit)).to(learned.device),
        torch.from_numpy(np.stack([v.confidence for v in views]).clip(0, 1)).to(learned.device),
        torch.from_numpy(cam_from_world).to(learned.device),
        torch.from_numpy(np.stack([camera.matrix(v.intrinsics) for v in views])).to(learned.device),
        near=float(low / _MARGIN),
        far=float(high * _MARGIN),
    )
    fused = net(given, learned.center, confidence=learned.confidence)
    depth, confidence = fused.depth.cpu().numpy() * np.float32(unit), fused.confidence.cpu().numpy()
    good = np.isfinite(depth) & (depth > 0) & (confidence >= 0)
    return replace(
        reference, depth=np.where(good, depth, np.float32(0)), confidence=np.where(good, confidence, np.float32(0))
    )
