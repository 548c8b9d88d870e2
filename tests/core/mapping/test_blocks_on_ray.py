"""Blocks on a Ray cluster of two nodes: to the bit what they are here. Skips where Ray is not installed."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from mvsgs_core.mapping.blocks.config import RefineConfig
from mvsgs_core.mapping.blocks.job import Job
from mvsgs_core.mapping.blocks.ray_cluster import RayCluster
from mvsgs_core.mapping.blocks.refinement import refined_in_blocks
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.named_modules import is_installed
from tests.support.small_maps import CONFIG, mapped
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

needs_ray = pytest.mark.skipif(not is_installed("ray"), reason="Ray is not installed")


def refined(refine: RefineConfig) -> OnlineMapper:
    views = [rgbd_keyframe(k, pose_on_arc(k / 3), (24, 32)) for k in range(4)]
    mapper = mapped(views, replace(CONFIG, refinement=0, iterations=4, refine=refine))
    pieces = refined_in_blocks(mapper, 6)
    assert pieces is not None
    for _ in pieces:
        pass
    return mapper


@needs_ray
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_a_cluster_of_two_nodes_refines_as_one_process_does() -> None:
    from bench.ray_nodes import ray_nodes

    here = refined(RefineConfig(blocks=2))
    with ray_nodes(2) as address:
        there = refined(RefineConfig(by="ray", address=address))
    assert there.log.warnings == []
    assert (there.log.values["machines"], there.log.values["blocks"]) == (2, 2)
    assert there.iterations == here.iterations
    assert all(torch.equal(value, there.state.tensors()[name]) for name, value in here.state.tensors().items())


@pytest.mark.parametrize(("gpus", "device"), [(0, "cpu"), (1, "auto")])
def test_a_worker_takes_its_own_device(gpus: int, device: str) -> None:
    given: list[MapperConfig] = []

    def sent(job: Job, config: MapperConfig) -> int:
        given.append(config)
        return len(given)

    cluster = RayCluster(RefineConfig(by="ray", address="head:6379"))
    cluster.machines, cluster.cpus, cluster.gpus = 1, 3, gpus
    cluster._ray = SimpleNamespace(
        remote=lambda **asked: lambda function: SimpleNamespace(remote=sent),
        wait=lambda running, timeout: (running, []),
        get=lambda reference: reference,
        exceptions=SimpleNamespace(RayError=RuntimeError),
    )
    job = Job({}, {}, {})
    assert list(cluster.refined([job, job], replace(CONFIG, device="cuda:1"))) == [{0: 1}, {1: 2}]
    assert [(config.device, config.threads) for config in given] == [(device, 3)] * 2


def test_a_cluster_that_is_not_there_is_said_and_the_map_refined_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(self: RefineConfig) -> None:
        raise ValueError("no Ray in this test")

    monkeypatch.setattr(RefineConfig, "check", missing)
    here, there = refined(RefineConfig(blocks=2)), refined(RefineConfig(by="ray", blocks=2))
    assert "no Ray in this test" in there.log.warnings[0]
    assert all(torch.equal(value, there.state.tensors()[name]) for name, value in here.state.tensors().items())
