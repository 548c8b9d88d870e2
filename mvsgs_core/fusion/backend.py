"""The heavy steps of fusion, on the CPU in C++ or in PyTorch: same arrays in, same arrays out."""

from __future__ import annotations

import numpy as np

from mvsgs_core import native
from mvsgs_core.devices import resolve_device
from mvsgs_core.fusion.interface import Fused, FusionBackend


class NativeFusionBackend:
    """The C++ kernels; `threads` None: all that OpenMP has."""

    def __init__(self, threads: int | None = None) -> None:
        self._kernels = native.load("mvs")
        self._threads = threads or 0

    def consistent_views(
        self,
        depth: np.ndarray,
        neighbor_depths: np.ndarray,
        warps: np.ndarray,
        back: np.ndarray,
        relative: float,
        pixels: float,
        round_trip: bool,
    ) -> np.ndarray:
        return np.asarray(
            self._kernels.consistent_views(
                depth, neighbor_depths, warps, back, relative, pixels, round_trip, threads=self._threads
            )
        )

    def splat(
        self, depths: np.ndarray, confidences: np.ndarray, back: np.ndarray, min_neighbor_confidence: float,
        size: tuple[int, int],
    ) -> np.ndarray:  # fmt: skip
        return np.asarray(
            self._kernels.splat_depths(
                depths, confidences, back, min_neighbor_confidence, size[0], size[1], threads=self._threads
            )
        )

    def fuse(
        self,
        depth: np.ndarray,
        confidence: np.ndarray,
        neighbor_depths: np.ndarray,
        neighbor_confidences: np.ndarray,
        splatted: np.ndarray,
        warps: np.ndarray,
        sigma: float,
        violation: float,
        min_neighbor_confidence: float,
    ) -> Fused:
        return Fused(
            *self._kernels.fuse_depth(
                depth, confidence, neighbor_depths, neighbor_confidences, splatted, warps, sigma, violation,
                min_neighbor_confidence, threads=self._threads,
            )
        )  # fmt: skip


def make_fusion_backend(device: str, threads: int | None = None) -> FusionBackend:
    """`device`: "auto" (CUDA if there is one), "cpu" (C++), "torch" (PyTorch, CPU) or a torch device like "cuda"."""
    device = resolve_device(device)
    if device == "cpu":
        return NativeFusionBackend(threads)
    from mvsgs_core.fusion.torch_backend import TorchFusionBackend

    return TorchFusionBackend(device)
