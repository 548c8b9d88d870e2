"""The frequency-modulated loss against reference numbers of the released code, and its rules."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from mvsgs_core.mapping import losses
from mvsgs_core.rasterizer import kernels
from tests.support.loss_inputs import inputs_of
from tests.support.shared_data import shared

GES = {"l1": 0.3, "ssim": 0.2, "frequency": 0.5}


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(shared("golden/ges") / "loss.npz") as arrays:
        return {name: arrays[name] for name in arrays}


def as_image(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array.transpose(1, 2, 0).copy())


def test_mask_and_loss_have_the_released_codes_values(golden: dict[str, np.ndarray]) -> None:
    image, target = as_image(golden["image"]), as_image(golden["gt"])
    last = len(golden["freq"]) - 1
    for i, frequency in enumerate(golden["freq"]):
        ends = i in (0, last)  # there rounding errors are blown up to the mask
        response = losses.edge_response(image, float(frequency)).numpy()
        wanted = golden["mask_before_threshold"][i]
        assert np.abs(response - wanted).max() <= (0.03 if ends else 1e-5)
        sure = np.abs(wanted - 0.5) > (0.03 if ends else 1e-4)
        mask = losses.frequency_mask(image, float(frequency)).numpy()
        assert (mask[sure] == golden["mask"][i].astype(bool)[sure]).all()
        loss = losses.photometric_loss(inputs_of(image, target, float(frequency)), GES).item()
        assert loss == pytest.approx(golden["loss"][i], abs=1e-3 if ends else 1e-5)


@pytest.mark.parametrize("frequency", [5, 75])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_has_the_released_codes_values(
    golden: dict[str, np.ndarray], frequency: int, dtype: torch.dtype
) -> None:
    image = as_image(golden["image"]).to(dtype).requires_grad_()
    losses.photometric_loss(inputs_of(image, as_image(golden["gt"]), float(frequency)), GES).backward()  # type: ignore[no-untyped-call]
    assert image.grad is not None
    wanted = golden[f"dloss_dimage_f{frequency}"].transpose(1, 2, 0)
    assert np.abs(image.grad.numpy() - wanted).max() <= 1e-4 * np.abs(wanted).max()


def test_scale_factor_has_the_released_codes_values() -> None:
    with np.load(shared("golden/ges") / "phi.npz") as arrays:
        b = torch.from_numpy(arrays["b"]).double().requires_grad_()
        phi = kernels.log_scale_shift(b).exp()
        phi.sum().backward()
        np.testing.assert_allclose(phi.detach().numpy(), arrays["phi"], rtol=1e-5, atol=1e-6)
        assert b.grad is not None
        np.testing.assert_allclose(b.grad.numpy(), arrays["dphi_db"], atol=1e-6)
        used = torch.exp(-3.0 + kernels.log_scale_shift(b.detach()))
        np.testing.assert_allclose(used.numpy(), arrays["scale_used_for_log_scale_minus3"], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("frequency", [0.0, 30.0, 50.0, 100.0])
def test_image_without_edges_stays_finite(frequency: float) -> None:
    flat = torch.full((20, 30, 3), 0.4).requires_grad_()
    loss = losses.photometric_loss(inputs_of(flat, torch.zeros(20, 30, 3), frequency), GES)
    loss.backward()  # type: ignore[no-untyped-call]
    assert bool(torch.isfinite(loss))
    assert flat.grad is not None
    assert bool(torch.isfinite(flat.grad).all())


def test_image_smaller_than_the_lowered_grid() -> None:
    assert losses.edge_response(torch.rand(3, 2, 3), 20.0).shape == (3, 2)


def test_edges_are_left_to_the_second_half() -> None:
    image = torch.zeros(100, 100, 3)
    image[:, 50:] = 1.0
    early, late = losses.frequency_mask(image, 45.0), losses.frequency_mask(image, 55.0)
    assert not torch.equal(early, late)
    assert bool((early != late).float().mean() > 0.9)


def test_frequency_of_an_online_view() -> None:
    assert losses.frequency_of(0, 1000) == 0.0
    assert losses.frequency_of(250, 1000) == 25.0
    assert losses.frequency_of(5000, 1000) == 100.0
    with pytest.raises(ValueError, match="frequency 101"):
        losses.edge_response(torch.rand(10, 10, 3), 101.0)


def test_without_the_mask_it_is_l1_and_ssim() -> None:
    image, target = torch.rand(24, 32, 3), torch.rand(24, 32, 3)
    plain = losses.photometric_loss(inputs_of(image, target, 10.0), {"l1": 0.8, "ssim": 0.0, "frequency": 0.0})
    assert plain.item() == pytest.approx(0.8 * (image - target).abs().mean().item(), rel=1e-5)


@pytest.mark.parametrize("beta", [0.5, 1.0, 2.0, 3.0, 4.0])
def test_std_ratio_by_integration(beta: float) -> None:
    """Second moment of the exact form in the plane over that of the Gaussian, by quadrature."""
    r = np.linspace(1e-6, 80.0 ** (1.0 / beta), 1_000_000)
    kernel = np.exp(-0.5 * r**beta)
    variance = np.sum(r**3 * kernel) / np.sum(r * kernel) / 2
    ratio = float(kernels.gaussian_std_ratio(torch.tensor([beta], dtype=torch.float64)))
    assert ratio == pytest.approx(np.sqrt(variance), rel=1e-3)


def test_a_loss_of_ones_own_is_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = inputs_of(torch.rand(24, 32, 3), torch.rand(24, 32, 3), 10.0)

    def make() -> losses.LossFunction:
        return lambda given: given.splats.opacity_logits.sigmoid().mean()

    first, second = make(), make()  # of one name, as a notebook's cell that is run again makes them
    names = [losses.name_of(function) for function in (first, second, first)]
    assert names[0] == names[2] != names[1]
    assert [losses.loss_function(name) for name in names] == [first, second, first]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "losses_of_mine.py").write_text("def squared(given):\n    return (given.target ** 2).mean()\n")
    with pytest.raises(TypeError, match=r"with a gradient to .*it returned a tensor of shape \(\)"):
        losses.own_loss(losses.loss_function("losses_of_mine.squared"), inputs)
    for name in ("losses_of_mine.cubed", "squared", "no_such_file.squared"):
        with pytest.raises(ValueError, match=f"training.loss_function={name}: "):
            losses.loss_function(name)
    with pytest.raises(TypeError, match="a function of LossInputs, not int"):
        losses.name_of(3)  # type: ignore[arg-type]


def test_the_loss_is_the_weighted_sum_of_its_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    image, target = torch.rand(24, 32, 3), torch.rand(24, 32, 3)
    inputs = inputs_of(image, target, 10.0)
    weights = losses.weights_of("ges", losses.LossWeights(l1=1.0))
    assert weights == {"l1": 1.0, "ssim": 0.2, "frequency": 0.5}
    alone = losses.training_loss(inputs, weights)
    assert alone.item() == losses.photometric_loss(inputs, weights).item()

    def opacity(given: losses.LossInputs, weights: dict[str, float]) -> torch.Tensor | None:
        return weights["opacity"] * given.splats.opacity_logits.sigmoid().mean() if weights["opacity"] else None

    monkeypatch.setattr(losses, "TERMS", (*losses.TERMS, opacity))
    assert losses.training_loss(inputs, weights | {"opacity": 0.0}).item() == alone.item()
    more = losses.training_loss(inputs, weights | {"opacity": 2.0}) - alone
    assert more.item() == pytest.approx(2.0 * inputs.splats.opacity_logits.sigmoid().mean().item(), rel=1e-5)
