"""The loss of a photograph in one kernel against its twin in PyTorch, and the twin against finite differences."""

from __future__ import annotations

import pytest
import torch

from mvsgs_core.rasterizer.photograph_loss import Formation, photograph_loss

GAINS = torch.tensor([[1.3, 0, 0, -0.05], [0, 1.2, 0, 0.02], [0, 0, 0.8, 0.03]])
MIXING = torch.tensor([[1.1, 0.1, 0, -0.05], [0.05, 0.9, 0.02, 0.02], [0, -0.1, 0.8, 0.03]])


def loss(color: torch.Tensor, photograph: torch.Tensor, formation: Formation) -> torch.Tensor:
    return photograph_loss(color, photograph, formation, l1_weight=0.7, ssim_weight=0.3, threads=2)


def taken(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Colors of a map, beyond black and white in places, and a photograph that is black and white in some."""
    g = torch.Generator().manual_seed(height)
    color = 1.6 * torch.rand(height, width, 3, generator=g) - 0.3
    noisy = color + 0.1 * torch.randn(height, width, 3, generator=g)
    return color, (255.0 * noisy.clamp(0.0, 1.0)).round().to(torch.uint8)


def formations(height: int, width: int) -> dict[str, Formation]:
    g = torch.Generator().manual_seed(1)
    factor, valid = 0.5 + 0.5 * torch.rand(height, width, 1, generator=g), torch.rand(height, width, generator=g) > 0.2
    return {
        "plain": Formation(),
        "mask": Formation(valid=valid),
        "gains": Formation(GAINS, clipped=True),
        "mixing": Formation(MIXING, clipped=True),
        "vignetting": Formation(factor=factor, clipped=True),
        "all": Formation(MIXING, factor, valid, clipped=True),
    }


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (50, 3), (37, 53)])
@pytest.mark.parametrize("name", formations(1, 1))
def test_value_and_gradient_match_the_twin(size: tuple[int, int], name: str) -> None:
    color, photograph = taken(*size)
    formation = formations(*size)[name]
    fused, twin = color.clone().requires_grad_(), color.double().requires_grad_()
    value = loss(fused, photograph, formation)
    expected = loss(twin, photograph, formation)
    assert value.item() == pytest.approx(expected.item(), abs=1e-5)
    (2.0 * value).backward()
    (2.0 * expected).backward()
    assert fused.grad is not None
    assert twin.grad is not None
    scale = twin.grad.abs().max().clamp(min=1e-3 / color.numel())
    assert ((fused.grad.double() - twin.grad).abs().max() / scale).item() < 1e-3


@pytest.mark.parametrize("exposure", [GAINS, MIXING])
def test_twin_gradcheck(exposure: torch.Tensor) -> None:
    color, photograph = taken(6, 7)
    factor = 0.5 + 0.5 * torch.rand(6, 7, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(2))

    def of(color: torch.Tensor, affine: torch.Tensor) -> torch.Tensor:
        return loss(color, photograph, Formation(affine, factor))

    assert torch.autograd.gradcheck(of, (color.double().requires_grad_(), exposure.double().requires_grad_()))


def test_an_exposure_that_is_trained_gets_its_gradient() -> None:
    color, photograph = taken(12, 9)
    exposure = GAINS.clone().requires_grad_()
    loss(color.requires_grad_(), photograph, Formation(exposure)).backward()
    assert exposure.grad is not None
    assert exposure.grad.abs().max() > 0


def test_what_a_camera_cuts_off_pulls_in_one_direction() -> None:
    photograph = torch.tensor([[[255, 255, 255], [0, 0, 0]]], dtype=torch.uint8)
    beyond = torch.tensor([[[1.5, 1.5, 1.5], [-0.5, -0.5, -0.5]]]).requires_grad_()
    within = torch.tensor([[[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]]).requires_grad_()
    for color in (beyond, within):
        photograph_loss(color, photograph, Formation(clipped=True), l1_weight=1.0, ssim_weight=0.0).backward()
    assert beyond.grad is not None
    assert within.grad is not None
    assert (beyond.grad == 0).all()
    assert (within.grad[0, 0] < 0).all()
    assert (within.grad[0, 1] > 0).all()


def test_two_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="expected two"):
        loss(torch.zeros(4, 5, 3), torch.zeros(5, 4, 3, dtype=torch.uint8), Formation())


@pytest.mark.parametrize(
    ("part", "formation"),
    [
        ("valid", Formation(valid=torch.ones(2, 2, dtype=torch.bool))),
        ("factor", Formation(factor=torch.ones(4, 1, 1))),
        ("exposure", Formation(exposure=torch.eye(3))),
    ],
)
def test_parts_of_another_size_are_refused(part: str, formation: Formation) -> None:
    with pytest.raises(ValueError, match=part):
        loss(torch.zeros(4, 5, 3), torch.zeros(4, 5, 3, dtype=torch.uint8), formation)


@pytest.mark.parametrize("shape", [(4, 5, 1), (4, 5, 4), (4, 3)])
def test_what_has_not_three_colors_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="expected two"):
        loss(torch.zeros(shape), torch.zeros(shape, dtype=torch.uint8), Formation())
