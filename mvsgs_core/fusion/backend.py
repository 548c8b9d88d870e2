"""The heavy steps of fusion, on the CPU in C++ or in PyTorch: same arrays in, same arrays out."""

from __future__ import annotations

from typing import Any

import numpy as np

from mvsgs_core import native
from mvsgs_core.devices import resolve_device
from mvsgs_core.fusion.interface import DepthMaps, Fused, FuseOptions, FusionBackend


class NativeFusionBackend:
    """The C++ kernels; `threads` None: all that OpenMP has."""

    def __init__(self, threads: int | None = None) -> None:
        self._kernels = native.load("fusion")
        self._threads = threads or 0

    def parallax(self, maps: DepthMaps) -> np.ndarray:
        return np.asarray(self._kernels.parallax(maps.depth, maps.neighbor_depths, maps.there, self._threads))

    def consistent_views(self, maps: DepthMaps, relative: np.ndarray) -> np.ndarray:
        return np.asarray(
            self._kernels.consistent_views(maps.depth, maps.neighbor_depths, maps.there, relative, self._threads)
        )

    def splat(self, maps: DepthMaps, options: FuseOptions) -> np.ndarray:
        return np.asarray(
            self._kernels.splat_depths(
                maps.neighbor_depths, maps.neighbor_confidences, maps.back, *maps.depth.shape, self._options(options)
            )
        )

    def fuse(self, maps: DepthMaps, splatted: np.ndarray, sigma: np.ndarray, options: FuseOptions) -> Fused:
        return Fused(
            *self._kernels.fuse_depth(
                maps.depth, maps.confidence, maps.neighbor_depths, maps.neighbor_confidences, splatted, maps.there,
                sigma, self._options(options),
            )
        )  # fmt: skip

    def _options(self, options: FuseOptions) -> Any:
        return self._kernels.FuseOptions(**vars(options), threads=self._threads)


def make_fusion_backend(device: str, threads: int | None = None) -> FusionBackend:
    """`device`: "auto" (CUDA if there is one), "cpu" (C++), "torch" (PyTorch, CPU) or a torch device like "cuda"."""
    device = resolve_device(device)
    if device == "cpu":
        return NativeFusionBackend(threads)
    from mvsgs_core.fusion.torch_backend import TorchFusionBackend

    return TorchFusionBackend(device)
