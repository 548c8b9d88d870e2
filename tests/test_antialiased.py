"""Who gets a map renders it as it was trained, antialiased or not: the evaluator by its message, others by its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from msgs import GroundTruth, SplatMap, Trajectory
from msgs.codec import decode, encode
from mvsgs_core.evaluation.scoring import render_frame
from mvsgs_core.export.ply import read_ply
from mvsgs_core.mapping.config import TrainingConfig
from nodes.evaluator import Evaluator
from nodes.mapper import Mapper
from tests.support.mapper_messages import settings, view_message

SIZE = (24, 32)


@pytest.mark.parametrize("antialiased", [False, True])
def test_a_map_is_rendered_as_it_was_trained(antialiased: bool, tmp_path: Path) -> None:
    mapper = Mapper(settings(training=TrainingConfig(antialiased=antialiased), output=str(tmp_path)))
    views = [view_message(7 * k, k / 2) for k in range(3)]
    evaluator = Evaluator(Evaluator.Config(lpips="off"))
    for view in views:
        list(mapper.on_fused_keyframe(view))
        truth = GroundTruth(view.index, view.timestamp, view.image, view.intrinsics, None, None)
        list(evaluator.on_ground_truth(truth))
    index = np.array([view.index for view in views])
    state = np.zeros(3, np.uint8)
    poses = np.stack([view.world_from_cam for view in views])
    list(evaluator.on_trajectory(Trajectory(index, index / 30, poses, index >= 0, state, state.astype(np.int32))))
    for message in mapper.on_end():
        if isinstance(message, SplatMap):
            list(evaluator.on_splat_map(decode(bytes(encode(message))).message))
    finished, own = evaluator.evaluation.maps[True], mapper.atlas.current
    assert finished.antialiased == antialiased
    saved = read_ply(tmp_path / "map.ply")
    for view, frame, pose in zip(own.views, evaluator.evaluation.scored_frames(), poses, strict=True):
        trained = own.render(view).color.clamp(0.0, 1.0).numpy()
        scored, other = (
            render_frame(finished.splats, finished.kernel, f, SIZE).color
            for f in (frame, replace(frame, antialiased=not antialiased))
        )
        opened = saved.render(pose, view.intrinsics, SIZE).color.clamp(0.0, 1.0).numpy()
        # splats at the same depth may change places in another unit
        assert max(rms(scored, trained), rms(opened, trained)) < 2e-3
        assert rms(other, trained) > 4e-3
    list(evaluator.on_end())


def rms(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.sqrt(np.mean((one - other) ** 2)))
