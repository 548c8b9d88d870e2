"""The paper's own path, DROID-SLAM, MVSFormer, V-FUSE and the map, with random weights: only checkpoints lack."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from launch.compose import compose
from launch.inline import run_inline
from msgs import Depth, FusedKeyframe, Keyframe, SplatMap, Trajectory
from tests.support.gpu import GPU

pytestmark = pytest.mark.slow

# Hardly more than the least sizes that the networks take: what comes out is noise at any size.
PATH = [
    "tracker=droid", "tracker.weights=random", "tracker.area=12288", "tracker.constants.stride=1",
    "tracker.constants.warmup=5",
    "mvs=mvsformer", "mvs.weights=random", "mvs.network_area=4096", "mvs.area=1300", "mvs.ranges.min_cells=1",
    "depth_fusion=vfuse", "depth_fusion.weights=random", "depth_fusion.confidence=0", "depth_fusion.check=false",
    "mapper=paper", "mapper.iterations=2", "mapper.refinement=4",
    "dataset=synthetic", "dataset.size=[120,160]", "dataset.options.frames=60", "dataset.stop=8",
    "evaluator.lpips=off", "evaluator.max_frames=6",
]  # fmt: skip


@pytest.mark.parametrize("device", ["cpu", GPU])
def test_the_papers_path_runs_to_a_map_and_says_that_it_is_noise(device: str, tmp_path: Path) -> None:
    sent: dict[type, list[Any]] = {}

    def observe(slot: str, node: object, message: Any) -> None:
        sent.setdefault(type(message), []).append(message)

    run_inline(compose([*PATH, f"device={device}", f"output={tmp_path}"]), observe)
    keyframes, depths, views = (sent[kind] for kind in (Keyframe, Depth, FusedKeyframe))
    assert len(keyframes) == len(depths) == len(views) >= 5
    (track,) = sent[Trajectory]
    assert np.isfinite(track.world_from_cam).all()
    final = sent[SplatMap][-1]
    assert len(final.means) > 100
    assert np.isfinite(final.means).all()
    report = json.loads((tmp_path / "report.json").read_text())
    for slot, noise in (
        ("tracker", "random weights: its poses and depths are noise"),
        ("mvs", "random weights: its depth is noise"),
        ("depth_fusion", "random weights: its refinement is noise"),
    ):
        assert any(noise in warning for warning in report["warnings"][slot]), slot
    assert report["rendering"]["keyframes"]["count"] >= 2
    assert report["map"]["splats"] == len(final.means)
