"""The fused SSIM kernel against its twin in PyTorch, torchmetrics and finite differences."""

from __future__ import annotations

import pytest
import torch

from mvsgs_core.rasterizer import ssim


def pair(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    image = torch.rand(height, width, 3, generator=g)
    return image, (image + 0.2 * torch.randn(height, width, 3, generator=g)).clamp(0, 1)


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (50, 3), (11, 11), (37, 53), (64, 80)])
def test_value_and_gradient_match_the_twin(size: tuple[int, int]) -> None:
    image, target = pair(*size)
    fused = image.clone().requires_grad_()
    twin = image.double().requires_grad_()
    value, expected = ssim.ssim(fused, target), ssim.ssim_reference(twin, target.double())
    assert value.item() == pytest.approx(expected.item(), abs=1e-5)
    value.backward()
    expected.backward()
    assert fused.grad is not None
    assert twin.grad is not None
    error = (fused.grad.double() - twin.grad).abs().max() / twin.grad.abs().max()
    assert error.item() < 1e-3


def test_twin_against_torchmetrics() -> None:
    """torchmetrics mirrors the border: compared inside a frame of zeros, which it sees as the window's zeros."""
    # here: it takes a second, and every worker collects this file
    from torchmetrics.functional.image import structural_similarity_index_measure

    image, target = pair(48, 64)
    framed = [torch.nn.functional.pad(x.permute(2, 0, 1)[None], (10, 10, 10, 10)) for x in (image, target)]
    _, full = structural_similarity_index_measure(
        *framed, data_range=1.0, sigma=1.5, kernel_size=11, return_full_image=True
    )
    assert isinstance(full, torch.Tensor)
    expected = full[..., 10:-10, 10:-10].mean().item()
    assert ssim.ssim_reference(image, target).item() == pytest.approx(expected, abs=2e-5)


def test_twin_gradcheck() -> None:
    image, target = pair(7, 6)
    assert torch.autograd.gradcheck(ssim.ssim_reference, (image.double().requires_grad_(), target.double()))


def test_weighted_l1_and_ssim_together() -> None:
    image, target = pair(20, 33)
    weight = torch.rand(20, 33)
    options = {"l1_weight": 0.7, "ssim_weight": 0.3, "pixel_weight": weight}
    fused, twin = image.clone().requires_grad_(), image.double().requires_grad_()
    value, expected = ssim.image_loss(fused, target, **options), ssim.image_loss(twin, target, **options)  # type: ignore[arg-type]
    by_hand = ((0.7 + weight[..., None]) * (image - target).abs()).mean() + 0.3 * (1 - ssim.ssim(image, target))
    assert value.item() == pytest.approx(expected.item(), abs=1e-5)
    assert value.item() == pytest.approx(by_hand.item(), abs=1e-5)
    (3.0 * value).backward()
    (3.0 * expected).backward()
    assert fused.grad is not None
    assert twin.grad is not None
    torch.testing.assert_close(fused.grad.double(), twin.grad, rtol=1e-3, atol=1e-7)


def test_equal_images() -> None:
    image, _ = pair(30, 40)
    image.requires_grad_()
    value = ssim.ssim(image, image.detach())
    value.backward()
    assert value.item() == pytest.approx(1.0, abs=1e-6)
    assert image.grad is not None
    assert image.grad.abs().max().item() < 1e-7


def test_threads_change_nothing() -> None:
    image, target = pair(61, 47)
    results = []
    for threads in (1, 2, 3):
        x = image.clone().requires_grad_()
        value = ssim.ssim(x, target, threads=threads)
        value.backward()
        assert x.grad is not None
        results.append((value.item(), x.grad))
    assert all(value == results[0][0] and torch.equal(grad, results[0][1]) for value, grad in results)


def test_shapes_that_do_not_fit() -> None:
    image, target = pair(8, 9)
    with pytest.raises(ValueError, match="expected two"):
        ssim.ssim(image, target[:7])
    with pytest.raises(ValueError, match="expected two"):
        ssim.ssim(image[..., :1], target[..., :1])
    with pytest.raises(ValueError, match="pixel_weight"):
        ssim.image_loss(image, target, l1_weight=1.0, ssim_weight=0.0, pixel_weight=torch.ones(9, 8))


def test_a_second_backward_pass_and_a_scaled_loss() -> None:
    g = torch.Generator().manual_seed(0)
    image, target = (torch.rand(24, 30, 3, generator=g) for _ in range(2))
    image.requires_grad_()
    loss = ssim.image_loss(image, target, l1_weight=0.8, ssim_weight=0.2, threads=1)
    (once,) = torch.autograd.grad(loss, image, retain_graph=True)
    loss.backward(retain_graph=True)
    (3.0 * loss).backward()
    torch.testing.assert_close(image.grad, 4.0 * once)
