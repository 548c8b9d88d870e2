"""Multi-view stereo networks in the frame of the cascade: same keyframes, neighbors and ranges, another estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, Protocol

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from mvsgs_core import camera, geometry
from mvsgs_core.devices import torch_device
from mvsgs_core.mvs.cascade import OnlineStereo, OnlineStereoConfig
from mvsgs_core.mvs.hypotheses import SearchRange
from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.mvs.stereo import StereoDepth
from mvsgs_core.networks import checkpoints, itermvs, mvsformer
from mvsgs_core.setting_ranges import at_least

NOT_FINITE = "pixels that the network gave no finite depth or confidence"  # in the counts of a StereoDepth


class _Output(Protocol):
    @property
    def depth(self) -> Tensor: ...

    @property
    def confidence(self) -> Tensor: ...


class Network(NamedTuple):
    """How a published network is made and fed."""

    make: Callable[[], nn.Module]  # untrained
    weights: str  # its name in mvsgs_core.weights
    inside: str  # key of the state dict in its checkpoint
    multiple: int  # sizes of images that it takes
    calibration: tuple[float, float] | None  # offset and slope of the logit of its confidence; None: as it comes


NETWORKS = {
    "mvsformer": Network(partial(mvsformer.MvsFormer, "twins"), "mvsformer", "state_dict", mvsformer.MULTIPLE, None),
    "mvsformer_p": Network(partial(mvsformer.MvsFormer, "dino"), "mvsformer_p", "state_dict", mvsformer.MULTIPLE, None),
    # of its published weights, by `python -m bench.learned.calibration`: three quarters of the depths are within 5 % of
    # the truth where it says 0.25
    "itermvs": Network(itermvs.IterMvs, "itermvs", "model", itermvs.MULTIPLE, (2.69, 1.27)),
}


@dataclass(frozen=True)
class LearnedStereoConfig(OnlineStereoConfig):
    """Online stereo by a network."""

    network: Literal["itermvs", "mvsformer", "mvsformer_p"] = "itermvs"
    weights: str | None = None  # checkpoint; null: where mvsgs_core.weights finds it; random: untrained, for tests
    network_area: int = 512 * 384  # pixels of the images that the network sees, aspect kept

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, network_area=1)


def make_network(name: str, file: str | None) -> nn.Module:
    """The network with its weights. Raises ValueError for an unknown name and what `weights.find` and the checkpoint
    reader raise, saying what to fetch from where."""
    entry = _network(name)
    return checkpoints.make(entry.make, entry.weights, file, inside=entry.inside)


def check_network(name: str, file: str | None) -> None:
    """Raises what `make_network` would, before the network is needed."""
    entry = _network(name)
    checkpoints.check(entry.make, entry.weights, file, inside=entry.inside)


def _network(name: str) -> Network:
    if name not in NETWORKS:
        raise ValueError(f"no network '{name}'; there are: {', '.join(NETWORKS)}")
    return NETWORKS[name]


class LearnedStereo(OnlineStereo):
    """`prepare` keeps a keyframe's image for the network; `remember` it where the keyframe was made elsewhere."""

    def __init__(self, config: LearnedStereoConfig, calibrate: bool = True) -> None:
        """calibrate: the network's confidence to the probability of an inlier, where it is known how."""
        super().__init__(config)
        self._learned = config
        self._device = torch_device(config.device)
        if config.threads:
            torch.set_num_threads(config.threads)
        self._net = make_network(config.network, config.weights).to(self._device)
        self._calibration = NETWORKS[config.network].calibration if calibrate else None
        self._images: dict[int, np.ndarray] = {}  # (h, w, 3) uint8 at the network's size

    def prepare(self, index: int, image: np.ndarray, **given: Any) -> StereoKeyframe:
        self.remember(index, image)
        return super().prepare(index, image, **given)

    def remember(self, index: int, image: np.ndarray) -> None:
        """Keeps a keyframe's RGB image (H, W, 3) uint8 at the network's size while it may be needed."""
        multiple = NETWORKS[self._learned.network].multiple
        height, width = image.shape[:2]
        size = camera.fit_size(height, width, self._learned.network_area, multiple)
        self._images.pop(index, None)
        self._images[index] = camera.resize_image(image, size)
        for old in list(self._images)[: -(self.config.window + self.config.lag + 2)]:  # as they came: see photographs
            del self._images[old]

    def _estimate(
        self, reference: StereoKeyframe, neighbors: list[StereoKeyframe], search: SearchRange, effort: int
    ) -> StereoDepth:
        views = [reference, *neighbors]
        size = self._images[reference.index].shape[:2]
        images = np.stack([camera.resize_image(self._images[v.index], size) for v in views])  # theirs may be another
        cameras = np.stack([camera.matrix(camera.scale_intrinsics(v.intrinsics, v.size, size)) for v in views])
        cam_from_world = np.stack([geometry.inverse(v.world_from_cam) for v in views])
        # around the reference and at unit median depth: in a far or tiny world float32 has no digits to spare
        cam_from_world = cam_from_world @ reference.world_from_cam
        unit = float(2.0 / (search.low + search.high))
        cam_from_world[:, :3, 3] /= unit
        with torch.inference_mode():
            output: _Output = self._net(
                torch.from_numpy(images).permute(0, 3, 1, 2).float().to(self._device),
                torch.from_numpy(cam_from_world).to(self._device),
                torch.from_numpy(cameras).to(self._device),
                (1.0 / (search.high * unit), 1.0 / (search.low * unit)),
            )
        confidence = calibrated(output.confidence.cpu().numpy(), self._calibration)
        return _at_size(output.depth.cpu().numpy() * unit, confidence, reference.size)


def calibrated(confidence: np.ndarray, calibration: tuple[float, float] | None) -> np.ndarray:
    """Confidence (0 to 1) as the probability of an inlier, which the fusion takes it for; unchanged without one."""
    if calibration is None:
        return confidence
    offset, slope = calibration
    return np.asarray(1 / (1 + np.exp(-offset - slope * logit(confidence))), dtype=np.float32)


def logit(confidence: np.ndarray) -> np.ndarray:
    """Of values that may be 0 or 1: kept a little inside."""
    inside = np.clip(confidence.astype(np.float64), 1e-3, 1 - 1e-3)
    return np.asarray(np.log(inside / (1 - inside)))


def _at_size(depth: np.ndarray, confidence: np.ndarray, size: tuple[int, int]) -> StereoDepth:
    """Maps at the cascade's size; depths are not averaged across edges. What is not finite is unknown, and counted."""
    shape = (size[1], size[0])
    depth = cv2.resize(depth.astype(np.float32), shape, interpolation=cv2.INTER_NEAREST_EXACT)
    confidence = cv2.resize(confidence.astype(np.float32), shape, interpolation=cv2.INTER_NEAREST_EXACT)
    finite = np.isfinite(depth) & np.isfinite(confidence)
    good = finite & (depth > 0)
    counts = {NOT_FINITE: float((~finite).sum())}
    return StereoDepth(np.where(good, depth, np.float32(0)), np.where(good, confidence, np.float32(0)), None, counts)
