"""The heavy steps of stereo, on the CPU in C++ or in PyTorch: same arrays in, same arrays out."""

from __future__ import annotations

from typing import Any

import numpy as np

from mvsgs_core import native
from mvsgs_core.devices import resolve_device
from mvsgs_core.mvs.interface import Backend, ChooseOptions, MatchingImages, SmoothingConfig, SurfaceEstimate
from mvsgs_core.mvs.matching_cost import CostConfig


class NativeBackend:
    """The C++ kernels; `threads` None: all that OpenMP has."""

    def __init__(self, threads: int | None = None) -> None:
        self._kernels = native.load("mvs")
        self._threads = threads or 0

    def cost_volume(
        self, images: MatchingImages, first: np.ndarray, step: np.ndarray, hypotheses: int, radius: int,
        cost: CostConfig, needed: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        options = self._cost_options(radius, cost)
        return np.asarray(
            self._kernels.cost_volume(**vars(images), first=first, step=step, hypotheses=hypotheses, options=options,
                                      needed=needed)
        )  # fmt: skip

    def surface_costs(
        self, images: MatchingImages, surfaces: np.ndarray, radius: int, cost: CostConfig,
        needed: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        options = self._cost_options(radius, cost)
        return np.asarray(
            self._kernels.surface_costs(**vars(images), surfaces=surfaces, options=options, needed=needed)
        )

    def semi_global(
        self, cost: np.ndarray, reference: np.ndarray, first: np.ndarray, step: np.ndarray, p1: float, p2: float,
        smoothing: SmoothingConfig,
    ) -> SurfaceEstimate:  # fmt: skip
        options = self._kernels.SmoothOptions(p1=p1, p2=p2, **vars(smoothing), threads=self._threads)
        return SurfaceEstimate(*self._kernels.semi_global(cost, reference, first, step, options))

    def choose_surface(
        self, cost: np.ndarray, surfaces: np.ndarray, reference: np.ndarray, options: ChooseOptions
    ) -> tuple[np.ndarray, np.ndarray]:
        given = self._kernels.ChooseOptions(**vars(options), threads=self._threads)
        best, gap = self._kernels.choose_surface(cost, surfaces, reference, given)
        return np.asarray(best), np.asarray(gap)

    def view_correlation(
        self, images: MatchingImages, inverse_depth: np.ndarray, radius: int, cost: CostConfig
    ) -> np.ndarray:
        options = self._cost_options(radius, cost)
        return np.asarray(self._kernels.view_correlation(**vars(images), inverse_depth=inverse_depth, options=options))

    def _cost_options(self, radius: int, cost: CostConfig) -> Any:
        return self._kernels.CostOptions(**vars(cost), radius=radius, threads=self._threads)


def make_backend(device: str, threads: int | None = None) -> Backend:
    """`device`: "auto" (CUDA if there is one), "cpu" (C++), "torch" (PyTorch, CPU) or a torch device like "cuda"."""
    device = resolve_device(device)
    if device == "cpu":
        return NativeBackend(threads)
    from mvsgs_core.mvs.torch_backend import TorchBackend

    return TorchBackend(device)
