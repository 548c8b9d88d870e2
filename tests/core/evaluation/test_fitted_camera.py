"""A held-out frame's camera fitted at test time: what disturbed it is found, and nothing else is touched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvsgs_core import geometry
from mvsgs_core.evaluation import fitted_camera
from mvsgs_core.evaluation.fitted_camera import fit_camera, linearized
from mvsgs_core.evaluation.scoring import ScoredFrame, render_frame, score_frame
from mvsgs_core.rasterizer.splats import Splats

SIZE = (96, 128)
INTRINSICS = np.array([110.0, 112.0, 64.5, 47.0])
DISTURBED = np.array([0.02, -0.015, 0.02, 0.006, -0.012, 0.01])  # one to two pixels
AFFINE = np.array([[1.15, 0.02, 0.0, 0.03], [0.0, 0.9, 0.03, -0.02], [-0.02, 0.0, 1.05, 0.01]], dtype=np.float32)


@pytest.fixture(scope="module")
def splats() -> Splats:
    """A wavy, colored wall of 60 x 80 splats, 2 to 3 units away."""
    generator = torch.Generator().manual_seed(1)
    v, u = torch.meshgrid(torch.linspace(-1.4, 1.4, 60), torch.linspace(-1.8, 1.8, 80), indexing="ij")
    z = 2.5 + 0.3 * torch.sin(2.1 * u) * torch.cos(1.7 * v)
    means = torch.stack([u, v, z], dim=-1).reshape(-1, 3)
    count = len(means)
    colors = torch.stack([torch.sin(5 * u + k) * torch.cos(4 * v - k) for k in range(3)], dim=-1).reshape(-1, 1, 3)
    colors = 0.7 * colors + 0.1 * torch.randn(colors.shape, generator=generator)
    turn = torch.zeros(count, 4)
    turn[:, 0] = 1.0
    return Splats(
        means, torch.full((count, 3), -3.4), turn, torch.full((count,), 3.0), colors, torch.full((count,), 2.0)
    )  # fmt: skip


def photograph(splats: Splats, frame: ScoredFrame, noise: float = 0.0) -> np.ndarray:
    color = render_frame(splats, "gaussian", frame, SIZE).color
    color = color + noise * np.random.default_rng(0).standard_normal(color.shape)
    return (255 * np.clip(color, 0, 1)).round().astype(np.uint8)


def true_frame(splats: Splats, noise: float = 0.0, readout: np.ndarray | None = None) -> ScoredFrame:
    """A frame at the pose and the exposure that its photograph was rendered at."""
    pose = geometry.se3_exp(np.array([0.05, -0.04, 0.1, 0.02, 0.05, -0.03]))
    frame = ScoredFrame(5, False, pose, INTRINSICS, lambda: np.zeros((*SIZE, 3), np.uint8), 0.01, readout, AFFINE)
    image = photograph(splats, frame, noise)
    return replace(frame, photograph=lambda: image)


def disturbed(frame: ScoredFrame) -> ScoredFrame:
    return replace(frame, world_from_cam=frame.world_from_cam @ geometry.se3_exp(DISTURBED), exposure=None)


def psnr(splats: Splats, frame: ScoredFrame) -> float:
    value = score_frame(splats, "gaussian", frame).figures["psnr"]
    assert value is not None
    return value


def apart(a: ScoredFrame, b: ScoredFrame) -> tuple[float, float]:
    """Distance and angle in degrees."""
    twist = geometry.se3_log(geometry.inverse(a.world_from_cam) @ b.world_from_cam)
    return float(np.linalg.norm(twist[:3])), float(np.degrees(np.linalg.norm(twist[3:])))


@pytest.mark.parametrize("samples", [fitted_camera.SAMPLES, 3000])
@pytest.mark.parametrize("readout", [None, np.array([0.01, 0.003, 0.0, 0.003, 0.01, 0.003])])
def test_a_disturbed_pose_and_exposure_are_recovered(
    splats: Splats, readout: np.ndarray | None, samples: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """3000: from every second pixel along both axes, as on images of many pixels."""
    monkeypatch.setattr(fitted_camera, "SAMPLES", samples)
    true = true_frame(splats, noise=0.01, readout=readout)
    start = disturbed(true)
    assert psnr(splats, start) < 24
    found = fit_camera(splats, "gaussian", start)
    distance, angle = apart(found, true)
    assert distance < 2e-3 < 0.03 < apart(start, true)[0]
    assert angle < 0.05 < 0.9 < apart(start, true)[1]
    assert found.exposure is not None
    np.testing.assert_allclose(found.exposure, AFFINE, atol=0.02)
    assert psnr(splats, found) > psnr(splats, true) - 0.05


def test_only_pose_and_exposure_change_and_the_map_does_not(splats: Splats) -> None:
    before = {name: value.clone() for name, value in splats.tensors().items()}
    start = disturbed(true_frame(splats))
    found = fit_camera(splats, "gaussian", start)
    np.testing.assert_equal(vars(replace(found, world_from_cam=start.world_from_cam, exposure=None)), vars(start))
    assert all(torch.equal(value, before[name]) for name, value in splats.tensors().items())
    assert not any(value.requires_grad for value in splats.tensors().values())


def test_a_frame_that_is_right_stays(splats: Splats) -> None:
    true = true_frame(splats)
    found = fit_camera(splats, "gaussian", true)
    assert apart(found, true)[0] < 1e-3
    assert psnr(splats, found) >= psnr(splats, true)


def test_no_frame_gets_worse_even_where_the_photograph_shows_something_else(splats: Splats) -> None:
    noise = np.random.default_rng(3).integers(0, 255, (*SIZE, 3)).astype(np.uint8)
    start = replace(true_frame(splats), photograph=lambda: noise)
    found = fit_camera(splats, "gaussian", start)
    assert np.isfinite(found.world_from_cam).all()
    assert psnr(splats, found) >= psnr(splats, start)


def test_an_empty_view_has_its_color_fitted_and_its_pose_kept(splats: Splats) -> None:
    away = geometry.se3_exp(np.array([0, 0, 0, 0, np.pi, 0.0]))
    gray = np.full((*SIZE, 3), 128, np.uint8)
    start = replace(true_frame(splats), world_from_cam=away, exposure=None, photograph=lambda: gray)
    found = fit_camera(splats, "gaussian", start)
    np.testing.assert_array_equal(found.world_from_cam, away)


def test_a_frame_costs_a_bounded_number_of_renders(splats: Splats, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []

    def counted(*arguments: object) -> object:
        sizes.append(arguments[3])
        return render_frame(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(fitted_camera, "render_frame", counted)
    found = fit_camera(splats, "gaussian", disturbed(true_frame(splats, noise=0.05)))
    assert set(sizes) == {(48, 64), SIZE}
    assert sizes.count((48, 64)) <= fitted_camera.RENDERS + 1
    assert sizes.count(SIZE) <= fitted_camera.RENDERS + 2
    sizes.clear()
    fit_camera(splats, "gaussian", found)
    assert sizes.count(SIZE) == 2, "a step that promises nothing is not rendered"


def test_the_normal_equations_are_those_of_the_render(splats: Splats) -> None:
    """The gradient against differences of the squared error, in every unknown."""
    start = replace(disturbed(true_frame(splats)), vignetting=np.array([-0.5, 0.1, 0.0], np.float32))
    image = start.photograph().astype(np.float32) / 255.0

    def error(step: np.ndarray, length: float) -> float:
        seen = fitted_camera._seen(splats, "gaussian", fitted_camera._moved(start, step, length), image)
        return 0.5 * seen.error * image.size

    linear = linearized(render_frame(splats, "gaussian", start, SIZE), image, start)
    for k, unit in enumerate(1e-3 * np.eye(18)):
        slope = (error(-unit, linear.length) - error(unit, linear.length)) / 2e-3
        assert linear.gradient[k] == pytest.approx(slope, rel=0.15, abs=0.02 * np.abs(linear.gradient).max())
