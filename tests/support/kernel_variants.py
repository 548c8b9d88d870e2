"""What Triton would compile its kernels for, as they are launched, on a GPU or in the interpreter."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
from torch import Tensor

Variant = tuple[Any, ...]


class Variants:
    """`found`: each kernel's name with what it is compiled anew for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from mvsgs_core.rasterizer.triton import backend, lists, ssim

        self.found: set[Variant] = set()
        kernels = {
            backend: ("project", "emit", "blend", "blend_backward", "project_backward"),
            lists: ("per_splat",), ssim: ("similarity", "loss_gradient"),
        }  # fmt: skip
        for module, names in kernels.items():
            for name in names:
                monkeypatch.setattr(module, name, _Kernel(name, getattr(module, name), self.found))


class _Kernel:
    def __init__(self, name: str, kernel: Any, found: set[Variant]) -> None:
        self._name, self._kernel, self._found = name, kernel, found
        given = kernel.kwargs if hasattr(kernel, "kwargs") else vars(kernel)  # of the interpreter, of the compiler
        self._once = given["do_not_specialize"] or ()

    def __getitem__(self, grid: tuple[int, ...]) -> Any:
        return partial(self._launch, grid)

    def _launch(self, grid: tuple[int, ...], *given: Any, **options: Any) -> None:
        """As Triton's documentation has it: numbers by whether they are 1 or 16 divides them, addresses by whether 16
        does."""
        by: list[Any] = [self._name, tuple(options.items())]
        for name, value in zip(self._kernel.arg_names, given, strict=False):
            if isinstance(value, Tensor):
                by.append((value.dtype, value.data_ptr() % 16 == 0))
            elif isinstance(value, int) and name not in self._once:
                by.append((value == 1, value % 16 == 0))
            else:
                by.append(type(value))
        self._found.add(tuple(by))
        self._kernel[grid](*given, **options)
