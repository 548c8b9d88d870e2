"""A run that was cut off goes on: with the rest of its stream, or without it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nodes
from launch.compose import compose
from launch.inline import run_inline
from msgs import FusedKeyframe, Poses, Preview, SplatMap, Trajectory
from mvsgs_core.export.ply import read_ply
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from nodes.mapper import Mapper
from nodes.resumed import Resumed
from tests.support.mapper_messages import settings, view_message
from tests.support.patience import LONG
from tests.support.small_atlas import PLAIN, begun
from tests.support.tiny_scene import pose_on_arc

SMALL = [
    "device=cpu", "mapper.iterations=8", "mapper.refinement=20", "evaluator.lpips=off", "mapper.threads=1",
    "mapper.window=4",
]  # fmt: skip
ROOM = ["dataset.size=[96,128]", "dataset.options.frames=80", "tracker.threads=1"]
ALONE = [
    "dataset=resumed", "mapper.reads={FusedKeyframe: dataset, TrackedFrame: dataset, Poses: dataset}",
    "evaluator.reads={GroundTruth: dataset, Trajectory: dataset, FusedKeyframe: dataset, SplatMap: mapper}",
    "tracker._target_=null", "mvs._target_=null", "depth_fusion._target_=null",
]  # fmt: skip


class Cut(Exception):
    """As if the power went."""


def inline(output: Path, *overrides: str, until: int = 10**9) -> tuple[dict[str, nodes.Node], list[Any]]:
    """Runs the graph, cut off at the view after `until`; its nodes, and the messages of the mapper and mvs."""
    sent: list[Any] = []

    def observe(slot: str, node: nodes.Node, message: Any) -> None:
        if isinstance(message, FusedKeyframe) and message.index > until:
            raise Cut
        if slot in ("mapper", "mvs"):
            sent.append(message)

    return run_inline(compose([*SMALL, f"output={output}", *overrides]), observe), sent


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> SplatMap:
    """The map of a run that nothing disturbed."""
    _, sent = inline(tmp_path_factory.mktemp("whole"), *ROOM, "evaluator._target_=null")
    return next(m for m in sent if isinstance(m, SplatMap) and m.refined)


@pytest.fixture(scope="module")
def cut_off(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of a run that ended amid its stream."""
    output = tmp_path_factory.mktemp("cut")
    with pytest.raises(Cut):
        inline(output, *ROOM, "evaluator._target_=null", until=60)
    return output


def copy_of(folder: Path, target: Path) -> Path:
    import shutil

    shutil.copytree(folder, target)
    return target


@pytest.mark.slow
def test_the_map_so_far_is_there(cut_off: Path) -> None:
    info = checkpoint_info(cut_off)
    assert 30 < info.newest_keyframe_index <= 60
    assert len(read_ply(cut_off / "map.ply").splats) == info.splats > 500
    poses = [line for line in (cut_off / "trajectory.txt").read_text().splitlines() if not line.startswith("#")]
    assert len(poses) == len(info.keyframes) > 5


@pytest.mark.slow
def test_with_the_rest_of_the_stream_it_gives_the_same_map_to_the_bit(
    cut_off: Path, whole: SplatMap, tmp_path: Path
) -> None:
    output = copy_of(cut_off, tmp_path / "run")
    info = checkpoint_info(output)
    after = info.keyframes[-13]  # fewer than usual: the stream is short
    found, sent = inline(output, *ROOM, f"mapper.resume={output}", f"mvs.resume_after={after}")
    final = next(m for m in sent if isinstance(m, SplatMap) and m.refined)
    mapper, mvs = found["mapper"], found["mvs"]
    assert mapper.stats.skipped["keyframes that the checkpoint has"] == 12
    assert mvs.stats.skipped["keyframes that the checkpoint has"] == len(info.keyframes) - 12
    assert not any("fit" in warning for warning in mapper.stats.warnings)
    assert final.iterations == whole.iterations
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh", "world_from_cam", "keyframes"):
        np.testing.assert_array_equal(getattr(final, name), getattr(whole, name), err_msg=name)
    report = json.loads((output / "report.json").read_text())
    assert report["counts"]["mapper"]["views"] == len(whole.keyframes)
    assert report["time"]["wall"] is report["time"]["keyframes_per_second"] is None, "of all its parts"
    of = len(whole.keyframes) - len(info.keyframes) + 12, len(whole.keyframes)
    assert any(note.startswith(f"depth is scored of {of[0]} of {of[1]} keyframes") for note in report["notes"])


@pytest.mark.slow
def test_without_its_stream_it_is_refined_and_reported(cut_off: Path, tmp_path: Path) -> None:
    output = copy_of(cut_off, tmp_path / "run")
    info = checkpoint_info(output)
    found, sent = inline(output, *ALONE, f"dataset.path={output}", f"mapper.resume={output}")
    before, final = (m for m in sent if isinstance(m, SplatMap))
    assert final.iterations == before.iterations + 20
    np.testing.assert_array_equal(final.keyframes, info.keyframes)
    report = json.loads((output / "report.json").read_text())
    assert report["rendering"]["keyframes"]["count"] == len(info.keyframes)
    assert report["rendering"]["keyframes"]["psnr"] > report["rendering_before_refinement"]["keyframes"]["psnr"] > 20
    assert found["mapper"].stats.counts["views"] == len(info.keyframes)


def abort_after(node: Mapper, count: int, change: Callable[[FusedKeyframe], FusedKeyframe] = lambda view: view) -> None:
    for k in range(count):
        list(node.on_fused_keyframe(change(view_message(k, k / 8))))
    node.on_abort("power")


def test_a_tracker_that_went_another_way_leaves_the_map_as_it_is(tmp_path: Path) -> None:
    first = Mapper(settings(output=str(tmp_path)))
    abort_after(first, 4)
    node = Mapper(settings(output=str(tmp_path), resume=str(tmp_path)))
    for k in range(8):
        pose = pose_on_arc(k / 8)
        pose[:3, 3] *= 1.3
        list(node.on_fused_keyframe(replace(view_message(k, k / 8), world_from_cam=pose)))
        if k > 3:
            list(node.on_poses(Poses(k, np.array([0]), 2 * pose[None], np.ones(1))))
    maps = [m for m in node.on_end() if isinstance(m, SplatMap)]
    assert maps[-1].keyframes.tolist() == [0, 1, 2, 3]
    assert maps[-1].iterations > maps[0].iterations
    assert any("does not fit the map that is gone on with: keyframe" in text for text in node.stats.warnings)
    assert node.stats.skipped == {"keyframes that the checkpoint has": 4, "keyframes that do not fit": 4} | {
        name: n for name, n in node.stats.skipped.items() if not name.startswith("keyframes")
    }


def test_a_stream_of_which_nothing_is_in_the_map_is_not_taken(tmp_path: Path) -> None:
    abort_after(Mapper(settings(output=str(tmp_path))), 3)
    node = Mapper(settings(output=str(tmp_path), resume=str(tmp_path)))
    list(node.on_fused_keyframe(view_message(7, 0.9)))
    assert len(node.atlas.current.views) == 3
    assert any("none of its keyframes came up to frame 2" in text for text in node.stats.warnings)


def test_corrections_that_the_checkpoint_has_are_not_taken_twice(tmp_path: Path) -> None:
    def correction(revision: int, shift: float) -> Poses:
        pose = pose_on_arc(0.0)
        pose[0, 3] += shift
        return Poses(revision, np.array([0]), pose[None], np.ones(1))

    first = Mapper(settings(output=str(tmp_path)))
    list(first.on_fused_keyframe(view_message(0, 0.0)))
    list(first.on_poses(correction(1, 0.3)))
    list(first.on_poses(correction(2, 0.1)))
    first.on_abort("power")
    node = Mapper(settings(output=str(tmp_path), resume=str(tmp_path)))
    before = node.atlas.current.snapshot().splats.means
    list(node.on_fused_keyframe(view_message(0, 0.0)))
    list(node.on_poses(correction(1, 0.3)))
    assert node.atlas.current.snapshot().world_from_cam[0, 0, 3] == pytest.approx(pose_on_arc(0.0)[0, 3] + 0.1)
    list(node.on_poses(correction(2, 0.1)))
    assert (node.atlas.current.snapshot().splats.means == before).all()
    list(node.on_poses(correction(3, 0.2)))
    assert node.atlas.current.snapshot().world_from_cam[0, 0, 3] == pytest.approx(pose_on_arc(0.0)[0, 3] + 0.2)
    assert not node.stats.warnings


def test_a_refinement_that_was_cut_off_goes_on_where_it_was(tmp_path: Path) -> None:
    off = np.stack([pose_on_arc(k / 8) for k in range(3)])
    off[1:, 0, 3] += [0.4, -0.4]  # so that more is owed than the end of the stream has room for

    def run(output: Path, cut: int | None, **changes: Any) -> tuple[Mapper, list[SplatMap]]:
        node, maps = Mapper(settings(output=str(output), refinement=9, iterations=30, **changes)), list[SplatMap]()

        def rest() -> None:
            if cut is not None and node.atlas.refined == cut:
                raise Cut

        node.rest = rest  # type: ignore[method-assign]
        for k in range(3):
            list(node.on_fused_keyframe(view_message(k, k / 8)))
        list(node.on_poses(Poses(1, np.arange(3), off, np.ones(3))))
        try:
            maps += (m for m in node.on_end() if isinstance(m, SplatMap))
        except Cut:
            node.on_abort("power")
        return node, maps

    _, (before, whole) = run(tmp_path / "whole", None)
    assert (before.refined, whole.refined) == (False, True)
    run(tmp_path / "cut", 5)
    assert checkpoint_info(tmp_path / "cut").finished
    node, (again,) = run(tmp_path / "cut", None, resume=str(tmp_path / "cut"))
    assert again.refined, "the map before the refinement is gone"
    assert any("within its refinement" in text for text in node.stats.warnings)
    np.testing.assert_array_equal(again.means, whole.means)
    assert again.iterations == whole.iterations


def test_who_watches_is_left_with_the_refined_map() -> None:
    node = Mapper(settings(preview_period=1e9))
    list(node.on_fused_keyframe(view_message(0, 0.5)))
    before, preview, after = list(node.on_end())
    assert isinstance(preview, Preview)
    assert isinstance(before, SplatMap)
    assert preview.iterations == after.iterations == before.iterations + 3
    np.testing.assert_allclose(preview.means, after.means, atol=1e-6)


def test_a_map_without_splats_is_nothing_with_its_reason(tmp_path: Path) -> None:
    none = Mapper(settings(output=str(tmp_path)))
    list(none.on_end())
    assert none.stats.values["nothing"] == "the mapper made no splat: no keyframe with depth came to it"
    blind = Mapper(settings(output=str(tmp_path)))
    for k in range(2):
        list(blind.on_fused_keyframe(replace(view_message(k, 0.1), depth=np.zeros((24, 32), np.float32))))
    list(blind.on_end())
    assert "none of 2 keyframes had a pixel with depth" in blind.stats.values["nothing"]
    refused = Mapper(settings(output=str(tmp_path)))
    list(refused.on_fused_keyframe(replace(view_message(0, 0.1), world_from_cam=np.full((4, 4), np.nan))))
    list(refused.on_end())
    assert "all 1 keyframes were refused (a keyframe with a pose" in refused.stats.values["nothing"]
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_resumed_is_said_before_anything_runs(tmp_path: Path) -> None:
    for check in (
        lambda: Mapper.check(Mapper.Config(resume=str(tmp_path))),
        lambda: Resumed.check(Resumed.Config(path=str(tmp_path))),
    ):
        with pytest.raises(ValueError, match="has no checkpoint"):
            check()
    with pytest.raises(ValueError, match=r"dataset\.path is missing"):
        Resumed.check(Resumed.Config())


def test_what_the_shutter_of_a_map_reads_is_said_with_its_time(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    for k in atlas.current.views:
        k.readout_time, k.reads_columns = -0.02, True
    writer = CheckpointWriter(tmp_path, atlas.current.config)
    writer.submit(atlas.frozen(), sync=True)
    assert writer.wait(LONG)
    (found,) = (m for m in Resumed(Resumed.Config(path=str(tmp_path))).run() if isinstance(m, Trajectory))
    assert (found.readout_time, found.reads_columns) == (-0.02, True)
