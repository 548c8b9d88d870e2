"""How Triton kernels are launched: while the GPU of their tensors is the current one, which Triton takes; and as one
variant, whatever their numbers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from mvsgs_core.rasterizer.ssim import image_loss
from tests.support.kernel_variants import Variants
from tests.support.rasterizer_scenes import copy, device_of, gradients, random_splats

pytestmark = [pytest.mark.slow, pytest.mark.gpu]

pytest.importorskip("triton", reason="triton is not installed: pip install triton to run its interpreter")

DEVICE = device_of("triton")


class Launches:
    """What was launched, and on the GPU of which tensor's."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.found: dict[str, torch.device | None] = {}
        self._current: list[torch.device] = []
        self._patch = monkeypatch
        entered, current = torch.cuda.device_of, self._current

        class Watched(entered):  # type: ignore[misc, valid-type]
            def __init__(self, tensor: Tensor) -> None:
                super().__init__(tensor)
                self.device = tensor.device

            def __enter__(self) -> None:
                super().__enter__()
                current.append(self.device)

            def __exit__(self, *error: Any) -> None:
                current.pop()
                super().__exit__(*error)

        monkeypatch.setattr(torch.cuda, "device_of", Watched)

    def watch(self, module: ModuleType, *kernels: str) -> None:
        for name in kernels:
            self._patch.setattr(module, name, _Kernel(getattr(module, name), partial(self._launched, name)))

    def _launched(self, name: str) -> None:
        self.found[name] = self._current[-1] if self._current else None


class _Kernel:
    def __init__(self, kernel: Any, launched: Callable[[], None]) -> None:
        self._kernel, self._launched = kernel, launched

    def __getitem__(self, grid: tuple[int, ...]) -> Any:
        self._launched()
        return self._kernel[grid]


def test_of_a_render_and_its_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    from mvsgs_core.rasterizer.triton import backend, lists

    launches = Launches(monkeypatch)
    launches.watch(backend, "project", "emit", "blend", "blend_backward", "project_backward")
    launches.watch(lists, "per_splat")
    splats = copy(random_splats(5), device=DEVICE)
    gradients(splats, (9, 12), backend="triton")
    assert len(launches.found) == 6
    assert set(launches.found.values()) == {splats.means.device}


def test_of_the_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    from mvsgs_core.rasterizer.triton import ssim

    launches = Launches(monkeypatch)
    launches.watch(ssim, "similarity", "loss_gradient")
    image, target = (torch.rand(6, 7, 3, device=DEVICE) for _ in range(2))
    image_loss(image.requires_grad_(), target, l1_weight=0.8, ssim_weight=0.2, backend="triton").backward()
    assert len(launches.found) == 2
    assert set(launches.found.values()) == {image.device}


def test_no_kernel_is_compiled_anew_for_another_number_of_splats_or_size(monkeypatch: pytest.MonkeyPatch) -> None:
    variants = Variants(monkeypatch)
    for count, size in ((15, (9, 12)), (16, (9, 12)), (33, (16, 16)), (33, (17, 32))):
        before = variants.found.copy()
        gradients(copy(random_splats(count), device=DEVICE), size, backend="triton")
        assert not before or variants.found == before, (count, size)
    assert len({name for name, *_ in variants.found}) == 6
