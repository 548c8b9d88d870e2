from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from mvsgs_core import image_metrics
from mvsgs_core.bad_file import BadFileError
from mvsgs_core.evaluation.lpips import Lpips
from tests.support.shared_data import shared


def _pair(seed: int, shape: tuple[int, int] = (64, 97)) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    image = rng.random((*shape, 3), dtype=np.float32)
    image[10:40, 20:60] = 0.5  # a flat region, where variances nearly vanish
    noisy = np.clip(image + 0.1 * rng.standard_normal(image.shape, dtype=np.float32), 0, 1)
    return noisy, image


def _batch(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None].double()


@pytest.mark.parametrize("seed", [0, 1])
def test_agrees_with_torchmetrics(seed: int) -> None:
    # here: it takes a second, and every worker collects this file
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

    a, b = _pair(seed)
    expected = structural_similarity_index_measure(_batch(a), _batch(b), data_range=1.0)
    assert image_metrics.ssim(a, b) == pytest.approx(float(expected), abs=1e-5)  # type: ignore[arg-type]
    assert image_metrics.psnr(a, b) == pytest.approx(
        float(peak_signal_noise_ratio(_batch(a), _batch(b), data_range=1.0)), abs=1e-4
    )


def test_equal_images() -> None:
    a, _ = _pair(2)
    assert image_metrics.ssim(a, a) == pytest.approx(1.0)
    assert image_metrics.psnr(a, a) == float("inf")


def test_bad_images_are_refused() -> None:
    a, b = _pair(3)
    with pytest.raises(ValueError, match="different shape"):
        image_metrics.psnr(a, b[:-1])
    b[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        image_metrics.ssim(a, b)
    with pytest.raises(ValueError, match="at least 11x11"):
        image_metrics.ssim(a[:8, :8], a[:8, :8])


def test_lpips_gives_the_documented_value() -> None:
    # torchmetrics documents these two values for its "squeeze" trunk
    model = Lpips(shared("weights/lpips_squeezenet1_1_features.pth"), shared("weights/lpips_v0.1/squeeze.pth"))
    generator = torch.Generator().manual_seed(42)
    a = torch.rand(2, 3, 100, 100, generator=generator)
    b = torch.rand(2, 3, 100, 100, generator=generator)
    assert model(a, b).tolist() == pytest.approx([0.1024, 0.0938], abs=5e-5)
    assert model(a, a).tolist() == [0.0, 0.0]


def test_lpips_refuses_other_weights() -> None:
    with pytest.raises(ValueError, match="does not hold the LPIPS weights"):
        Lpips(shared("weights/raft-small.pth"), shared("weights/lpips_v0.1/squeeze.pth"))


@pytest.mark.parametrize(
    "content", [b"", b"<!doctype html>", b"PK\x03\x04" + bytes(100), b"cos\nsystem\n(S'true'\ntR."]
)
def test_lpips_weights_that_are_none_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "trunk.pth").write_bytes(content)
    with pytest.raises(BadFileError, match=r"trunk\.pth (is truncated|is a web page|holds Python)"):
        Lpips(tmp_path / "trunk.pth", tmp_path / "trunk.pth")
