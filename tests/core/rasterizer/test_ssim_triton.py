"""The Triton SSIM against the reference in float64: on a GPU where there is one, else in Triton's interpreter."""

from __future__ import annotations

import pytest
import torch

from mvsgs_core.rasterizer.ssim import chosen_backend, image_loss

pytestmark = [pytest.mark.slow, pytest.mark.gpu]

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
pytest.importorskip("triton", reason="triton is not installed: pip install triton to run its interpreter")


def images(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    image = torch.rand(height, width, 3, generator=g)
    target = (image + 0.2 * torch.randn(height, width, 3, generator=g)).clamp(0, 1)
    return image, target, torch.rand(height, width, generator=g)


@pytest.mark.parametrize("size", [(1, 1), (17, 4), (20, 45)])
@pytest.mark.parametrize("weighted", [False, True])
def test_value_and_gradient(size: tuple[int, int], weighted: bool) -> None:
    image, target, weight = images(*size)
    results = []
    for backend, dtype, device in (("triton", torch.float32, DEVICE), ("reference", torch.float64, "cpu")):
        x = image.to(device=device, dtype=dtype, copy=True).requires_grad_()
        loss = image_loss(
            x, target.to(x), l1_weight=0.7, ssim_weight=0.3, pixel_weight=weight.to(x) if weighted else None,
            backend=backend,
        )  # fmt: skip
        (2.0 * loss).backward()
        assert x.grad is not None
        results.append((loss.item(), x.grad.cpu().double()))
    (value, gradient), (true_value, true_gradient) = results
    assert value == pytest.approx(true_value, abs=1e-5)
    assert float((gradient - true_gradient).abs().max() / true_gradient.abs().max()) < 1e-3


def test_equal_images_have_no_gradient() -> None:
    image, _, _ = images(12, 14)
    x = image.to(DEVICE).requires_grad_()
    value = image_loss(x, x.detach(), l1_weight=0.8, ssim_weight=0.2, backend="triton")
    value.backward()
    assert value.item() == pytest.approx(0.0, abs=1e-6)
    assert x.grad is not None
    assert float(x.grad.abs().max()) < 1e-7


def test_the_device_chooses() -> None:
    image = torch.zeros(2, 2, 3)
    assert chosen_backend(image) == "cpu"
    assert chosen_backend(image.double()) == "reference"
    assert chosen_backend(image[..., :1]) == "reference"
    with torch._subclasses.FakeTensorMode():
        assert chosen_backend(torch.empty(2, 2, 3, device="cuda")) == "triton"
    with pytest.raises(ValueError, match="backend 'gpu'"):
        image_loss(image, image, l1_weight=1.0, ssim_weight=0.0, backend="gpu")
