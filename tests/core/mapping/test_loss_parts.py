"""The parts of the GES loss against reference numbers of the released code, one by one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core.image_metrics import psnr
from mvsgs_core.mapping import losses
from mvsgs_core.rasterizer import kernels
from tests.support.loss_inputs import inputs_of
from tests.support.shared_data import shared


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(shared("golden/ges") / "loss.npz") as arrays:
        return {name: arrays[name] for name in arrays}


def as_image(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array.transpose(1, 2, 0).copy())


def test_the_lowered_image(golden: dict[str, np.ndarray]) -> None:
    """Sizes that 0.2 does not divide: the coordinates use the factor, not the ratio of the sizes."""
    lowered = losses.lowered_gray(as_image(golden["image"]))
    np.testing.assert_allclose(lowered[0, 0], golden["grey_lowres"], atol=1e-5)


def test_differences_of_gaussians(golden: dict[str, np.ndarray]) -> None:
    lowered = torch.from_numpy(golden["grey_lowres"])[None, None]
    last = len(golden["freq"]) - 1
    for i, frequency in enumerate(golden["freq"]):
        sigma = losses.mask_sigma(float(frequency))
        sides = [2 * round(3 * s) + 1 for s in (sigma, 2 * sigma)]
        assert sides == golden["kernel_sizes"][i].tolist()
        ours = losses.difference_of_gaussians(lowered, float(frequency))[0, 0].numpy()
        wanted = golden[f"dog_lowres_f{frequency:.8g}"]
        allowed = 0.03 if i in (0, last) else 1e-5
        assert np.abs(ours - wanted).max() <= allowed * np.abs(wanted).max(), frequency


def test_terms_and_psnr(golden: dict[str, np.ndarray]) -> None:
    image, target = as_image(golden["image"]), as_image(golden["gt"])
    terms = [dict.fromkeys(("l1", "ssim", "frequency"), 0.0) | {name: 1.0} for name in ("l1", "ssim", "frequency")]
    last = len(golden["freq"]) - 1
    for i, frequency in enumerate(golden["freq"]):
        l1, one_minus_ssim, masked = (
            losses.photometric_loss(inputs_of(image, target, float(frequency)), t).item() for t in terms
        )
        wanted = golden["l1_ssim_maskl1"][i]
        assert l1 == pytest.approx(wanted[0], abs=1e-5)
        assert 1 - one_minus_ssim == pytest.approx(wanted[1], abs=1e-5)
        assert masked == pytest.approx(wanted[2], abs=3e-3 if i in (0, last) else 1e-5)
    assert psnr(image.numpy(), target.numpy()) == pytest.approx(golden["psnr"][0], abs=1e-4)


def test_the_strength_of_the_scale_factor() -> None:
    with np.load(shared("golden/ges") / "phi.npz") as arrays:
        b = torch.from_numpy(arrays["b"]).double()
        theirs = 2 * torch.sigmoid(float(arrays["strength"]) * b)
    torch.testing.assert_close(kernels.log_scale_shift(b).exp(), theirs, atol=1e-6, rtol=0)
