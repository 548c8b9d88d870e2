"""Blocks on a Ray cluster of two nodes: to the bit what they are here. Skips where Ray is not installed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mvsgs_core.mapping.blocks.config import RefineConfig
from mvsgs_core.mapping.blocks.refinement import refined_in_blocks
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


def test_a_cluster_that_is_not_there_is_said_and_the_map_refined_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(self: RefineConfig) -> None:
        raise ValueError("no Ray in this test")

    monkeypatch.setattr(RefineConfig, "check", missing)
    here, there = refined(RefineConfig(blocks=2)), refined(RefineConfig(by="ray", blocks=2))
    assert "no Ray in this test" in there.log.warnings[0]
    assert all(torch.equal(value, there.state.tensors()[name]) for name, value in here.state.tensors().items())
