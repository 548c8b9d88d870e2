"""What runs on a GPU: no step mixes devices, and what comes back is in main memory and what the CPU gives."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bench import networks
from mvsgs_core.droid.config import DroidConfig
from mvsgs_core.fusion.fusion import FusionConfig, OnlineFusion
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.checkpoint import load, save
from mvsgs_core.mapping.checkpoints.files import FOLDER, KEYFRAMES, state_file
from mvsgs_core.mapping.checkpoints.images import image_name, write_image
from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.density_control import DensityControlConfig
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.preview import preview_arrays
from mvsgs_core.mvs.interface import SmoothingConfig
from mvsgs_core.mvs.matching_cost import CostConfig
from mvsgs_core.mvs.torch_backend import TorchBackend
from mvsgs_core.networks.correlation import CorrelationVolume, OnTheFlyCorrelation
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver, adjust
from tests.support.depth_views import view
from tests.support.gpu import DEVICES, assert_same, on
from tests.support.keyframe_graphs import noisy
from tests.support.pretend_device import DEVICE, PretendDevice
from tests.support.stereo_problems import SIZE, problem
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

BACKENDS = {DEVICE: "reference", "cuda": "triton"}
LIGHT: dict[str, Any] = {
    "exposure": 1.1 * np.eye(3, 4, dtype=np.float32), "vignetting": np.array([-0.1, 0, 0], np.float32)
}  # fmt: skip


@pytest.mark.slow
def test_the_pretended_device_mixes_with_no_other() -> None:
    with PretendDevice():
        here, there = torch.ones(3), torch.ones(3, device=DEVICE)
        assert (there + torch.tensor(2.0)).sum().item() == 9.0
        with pytest.raises(RuntimeError, match="two devices"):
            here + there
        with pytest.raises((RuntimeError, TypeError)):
            there.numpy()
        leaf = there.clone().requires_grad_()
        (leaf * leaf).sum().backward()
        assert leaf.grad is not None
        assert leaf.grad.device.type == DEVICE
        assert (leaf.grad.cpu() + here).tolist() == [3.0] * 3


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", [name for name in networks.CASES if "LPIPS" not in name])
def test_networks(name: str, device: str) -> None:
    with torch.no_grad(), on(device):
        _, work = networks.CASES[name](64, 64, device)
        work()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", [CorrelationVolume, OnTheFlyCorrelation])
def test_a_lookup_of_correlation_copies_nothing_to_the_device(
    kind: type[CorrelationVolume | OnTheFlyCorrelation], device: str
) -> None:
    g = torch.Generator().manual_seed(0)
    source, target = torch.randn(2, 1, 8, 16, 20, generator=g)
    coords = 20 * torch.rand(1, 16, 20, 2, generator=g)
    here = kind(source, target)(coords)
    with on(device):
        correlation, at = kind(source.to(device), target.to(device)), coords.to(device)
    with on(device) as pretended:
        there = correlation(at)
        copied = pretended.copied if isinstance(pretended, PretendDevice) else 0
        assert_same(device, there.cpu(), here)
        torch.ones(3).to(device)
    assert copied == 0
    if isinstance(pretended, PretendDevice):
        assert pretended.copied == 1


def test_the_global_adjustment_takes_the_fast_correlation_everywhere() -> None:
    assert DroidConfig().global_correlation == "volume"


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_stereo_equals_that_of_the_cpu(device: str) -> None:
    p = problem()
    surface = np.full(SIZE, 0.22, np.float32)
    results = []
    with on(device):
        for backend in (TorchBackend(device), TorchBackend("cpu")):
            cost = backend.cost_volume(p.images, p.first, p.step, 5, 2, CostConfig(top_k=2))
            found = backend.semi_global(cost, p.images.reference, p.first, p.step, 0.3, 2.0, SmoothingConfig())
            results.append([cost, *vars(found).values(), backend.view_correlation(p.images, surface, 2, CostConfig())])
    for there, here in zip(*results, strict=True):
        assert_same(device, there, here)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_fusion_equals_that_of_the_cpu(device: str) -> None:
    results = []
    with on(device):
        for where in (device, "torch"):
            fusion = OnlineFusion(FusionConfig(device=where, threads=1))
            found = [one for k in range(5) for one in fusion.add(view(k, 0.1 * k, 0.005))]
            results.append([one.depth for one in [*found, *fusion.flush()]])
    assert len(results[0]) == 5
    assert_same(device, *results)


@pytest.mark.parametrize("device", DEVICES)
def test_bundle_adjustment_equals_that_of_the_cpu(device: str) -> None:
    graph, solver = noisy(k=4, m=20), Solver(steps=2, robust="cauchy", robust_scale=1.5, tolerance=0.0)
    with on(device):
        there, here = (adjust(graph, dataclasses.replace(solver, device=where)) for where in (device, "torch"))
    assert there.steps == here.steps > 0
    assert_same(device, there.cam_from_world, here.cam_from_world)
    assert_same(device, there.inverse_depth, here.inverse_depth)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_mapper_from_the_first_keyframe_to_the_snapshot(device: str) -> None:
    config = MapperConfig(
        iterations=4, refinement=1, sh_degree=1, device=device,
        training=TrainingConfig(
            backend=BACKENDS[device], refine_poses=True, pose_visits=0, betas=True, kernel="exact",
            loss="ges",
        ),
        density_control=DensityControlConfig(every=3),
    )  # fmt: skip
    views = [replace(rgbd_keyframe(k, pose_on_arc(0.3 * k), size=(20, 24)), **LIGHT) for k in range(3)]
    with on(device):
        mapper = OnlineMapper(config)
        for one in views:
            mapper.add_keyframe(one)
        while mapper.step():
            pass
        moved = views[1].world_from_cam.copy()
        moved[0, 3] += 0.2
        assert mapper.correct(np.array([1]), moved[None], np.array([1.1])) > 0
        mapper.refine(0, 1)
        preview = preview_arrays(mapper, 50)
        final = mapper.snapshot()
    assert mapper.state.splats.means.device.type == device
    assert all(isinstance(value, np.ndarray | int) for value in preview.values())
    assert all(tensor.device.type == "cpu" for tensor in final.splats.tensors().values())
    assert np.isfinite(final.splats.means.numpy()).all()
    assert isinstance(final.exposures, np.ndarray)


@pytest.mark.parametrize("device", DEVICES)
def test_a_checkpoint_of_a_mapper_elsewhere_gives_it_back(device: str, tmp_path: Path) -> None:
    training = TrainingConfig(backend=BACKENDS[device], refine_poses=True, pose_visits=0)
    config = MapperConfig(iterations=3, device=device, training=training)
    views = [replace(rgbd_keyframe(k, pose_on_arc(0.3 * k), size=(20, 24)), **LIGHT) for k in range(2)]
    images = tmp_path / FOLDER / KEYFRAMES
    images.mkdir(parents=True)
    with on(device):
        mapper = OnlineMapper(config)
        for one in views:
            mapper.add_keyframe(one)
        mapper.step()
        atlas = Atlas(mapper, {0: mapper})
        frozen = atlas.frozen()
        names = [image_name(view) for view in frozen.current.views]
        for view, name in zip(frozen.current.views, names):
            write_image(images, view, name, sync=False)
        save(frozen, config, state_file(tmp_path, 1), {0: (names, [])}, sync=False)
        again = load(tmp_path, config, Stats())[0].current
        while mapper.step() and again.step():
            pass
        here, there = mapper.snapshot(), again.snapshot()
    assert frozen.current.state.device.type == "cpu"
    assert again.state.splats.means.device.type == device
    assert again.views[0].image.device.type == device
    for name, value in here.splats.tensors().items():
        assert_same(device, there.splats.tensors()[name], value)
    assert_same(device, there.world_from_cam, here.world_from_cam)
