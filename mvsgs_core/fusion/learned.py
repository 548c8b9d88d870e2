"""V-FUSE in the frame of the online fusion: it refines, the paper's filters then reject."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from mvsgs_core import camera, geometry
from mvsgs_core.devices import torch_device
from mvsgs_core.fusion.fusion import FusionConfig, OnlineFusion
from mvsgs_core.fusion.keyframe_depth import KeyframeDepth
from mvsgs_core.networks import checkpoints
from mvsgs_core.networks.vfuse import FusionInput, VFuse, check_center

_INSIDE = "model_state_dict"  # key of the state dict in the published files
_PERCENTILES, _MARGIN = (1.0, 99.0), 1.1  # of the known depths, for the range that the network normalizes by


@dataclass(frozen=True)
class VFuseConfig(FusionConfig):
    """V-FUSE, then the filters; the weight-free refinement is never used."""

    weights: str | None = None  # checkpoint; null: where mvsgs_core.weights finds it; random: untrained, for tests
    center: Literal["conf", "mean"] = "conf"  # of a pixel's search window: the most confident depth, the weighted mean


def check_weights(file: str | None) -> None:
    """Raises what `LearnedOnlineFusion` would for these weights, before it is made."""
    checkpoints.check(VFuse, "vfuse", file, inside=_INSIDE)


class LearnedOnlineFusion(OnlineFusion):
    """Raises ValueError for an unknown center, and what `checkpoints.make` raises."""

    def __init__(self, config: VFuseConfig) -> None:
        super().__init__(replace(config, refine=False))
        check_center(config.center)
        self._learned = config
        self._net = checkpoints.make(VFuse, "vfuse", config.weights, inside=_INSIDE)
        self._net.to(torch_device(config.device))
        self.not_finite = 0  # pixels that the network gave no finite depth or confidence

    def _prepared(self, reference: KeyframeDepth, neighbors: list[KeyframeDepth]) -> KeyframeDepth:
        if not neighbors or not (reference.depth > 0).any():
            return reference
        refined, wrong = refine(self._net, reference, neighbors, self._learned)
        self.not_finite += wrong
        return refined


def refine(
    net: VFuse, reference: KeyframeDepth, neighbors: list[KeyframeDepth], config: VFuseConfig
) -> tuple[KeyframeDepth, int]:
    """The reference with V-FUSE's depth and confidence (what it means: networks.vfuse), and how many pixels
    have none because one of both was not finite."""
    views, device = [reference, *neighbors], torch_device(config.device)
    depths = np.stack([v.depth for v in views]).astype(np.float32)
    # around the reference and at unit median depth: float32 has no digits to spare in a far or tiny world
    unit = float(np.median(depths[depths > 0]))
    low, high = np.percentile(depths[depths > 0] / unit, _PERCENTILES)
    cam_from_world = np.stack([geometry.inverse(v.world_from_cam) for v in views]) @ reference.world_from_cam
    cam_from_world[:, :3, 3] /= unit
    given = FusionInput(
        torch.from_numpy(depths / np.float32(unit)).to(device),
        torch.from_numpy(np.stack([v.confidence for v in views]).clip(0, 1)).to(device),
        torch.from_numpy(cam_from_world).to(device),
        torch.from_numpy(np.stack([camera.matrix(v.intrinsics) for v in views])).to(device),
        near=float(low / _MARGIN),
        far=float(high * _MARGIN),
    )
    fused = net(given, config.center)
    depth, confidence = fused.depth.cpu().numpy() * np.float32(unit), fused.confidence.cpu().numpy()
    finite = np.isfinite(depth) & np.isfinite(confidence)
    good = finite & (depth > 0) & (confidence >= 0)
    depth, confidence = (np.where(good, value, np.float32(0)) for value in (depth, confidence))
    return replace(reference, depth=depth, confidence=confidence), int((~finite).sum())
