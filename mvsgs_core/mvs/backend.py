"""The heavy steps of stereo, on the CPU in C++ or in PyTorch: same arrays in, same arrays out."""

from __future__ import annotations

import numpy as np

from mvsgs_core import native
from mvsgs_core.mvs.interface import Backend, Choice, ChooseOptions, CostOptions, SmoothOptions


class NativeBackend:
    """The C++ kernels; `threads` None: all that OpenMP has."""

    def __init__(self, threads: int | None = None) -> None:
        self._kernels = native.load("mvs")
        self._threads = threads or 0

    def cost_volume(
        self,
        reference: np.ndarray,
        neighbors: np.ndarray,
        warps: np.ndarray,
        first: np.ndarray,
        step: np.ndarray,
        hypotheses: int,
        options: CostOptions,
        needed: np.ndarray | None = None,
    ) -> np.ndarray:
        return np.asarray(
            self._kernels.cost_volume(
                reference, neighbors, warps, first, step, hypotheses, options.radius, options.best, options.noise,
                options.contrast, options.level, options.level_range, threads=self._threads, needed=needed,
            )
        )  # fmt: skip

    def semi_global(
        self, cost: np.ndarray, reference: np.ndarray, first: np.ndarray, step: np.ndarray, options: SmoothOptions
    ) -> Choice:
        return Choice(
            *self._kernels.semi_global(
                cost, reference, first, step, options.p1, options.p2, options.edge,
                options.break_steps, options.temperature, options.paths, threads=self._threads,
            )
        )  # fmt: skip

    def surface_costs(
        self, reference: np.ndarray, neighbors: np.ndarray, warps: np.ndarray, surfaces: np.ndarray,
        options: CostOptions, needed: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        return np.asarray(
            self._kernels.surface_costs(
                reference, neighbors, warps, surfaces, options.radius, options.best, options.noise, options.contrast,
                options.level, options.level_range, threads=self._threads, needed=needed,
            )
        )  # fmt: skip

    def choose_surface(
        self, cost: np.ndarray, surfaces: np.ndarray, reference: np.ndarray, options: ChooseOptions
    ) -> tuple[np.ndarray, np.ndarray]:
        best, gap = self._kernels.choose_surface(
            cost, surfaces, reference, options.p1, options.p2, options.edge, options.apart,
            threads=self._threads,
        )  # fmt: skip
        return np.asarray(best), np.asarray(gap)

    def view_correlation(
        self, reference: np.ndarray, neighbors: np.ndarray, warps: np.ndarray, inverse_depth: np.ndarray,
        options: CostOptions,
    ) -> np.ndarray:  # fmt: skip
        return np.asarray(
            self._kernels.view_correlation(
                reference, neighbors, warps, inverse_depth, options.radius, options.noise, options.contrast,
                threads=self._threads,
            )
        )  # fmt: skip


def make_backend(device: str, threads: int | None = None) -> Backend:
    """`device`: "auto" (CUDA if there is one), "cpu" (C++), "torch" (PyTorch, CPU) or a torch device like "cuda"."""
    if device == "auto":
        import torch

        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cpu":
        return NativeBackend(threads)
    from mvsgs_core.mvs.torch_backend import TorchBackend

    return TorchBackend("cpu" if device == "torch" else device)
