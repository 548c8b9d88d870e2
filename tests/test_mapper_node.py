"""The mapper as a node: messages in and out, idle slices, previews, map.ply, configuration files."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import nodes
from msgs import FusedKeyframe, Keyframe, Poses, Preview, Reply, Request, SplatMap, TrackedFrame
from mvsgs_core.export.cameras import read_cameras
from mvsgs_core.export.ply import read_ply
from mvsgs_core.image_metrics import psnr
from mvsgs_core.kept_map import STREAM
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.mapping.coarse import LATER
from mvsgs_core.mapping.map_state import PARAMETERS
from mvsgs_core.mapping.preview import splats_by_keyframe
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from nodes.mapper import Mapper
from nodes.parameters import build
from tests.support.mapper_messages import keyframe_message, settings, view_message
from tests.support.shared_data import ROOT
from tests.support.tiny_scene import pose_on_arc


def test_inputs_and_outputs_are_declared() -> None:
    assert nodes.handlers(Mapper) == {
        FusedKeyframe: "on_fused_keyframe",
        TrackedFrame: "on_tracked_frame",
        Poses: "on_poses",
        Keyframe: "on_keyframe",
        Request: "on_request",
    }
    assert set(nodes.outputs(Mapper)) == {SplatMap, Preview, Reply}


def test_two_maps_leave_the_mapper_before_and_after_the_refinement(tmp_path: Path) -> None:
    node = Mapper(settings(output=str(tmp_path / "run")))
    for k in range(3):
        list(node.on_fused_keyframe(view_message(7 * k, k / 2)))
    while node.on_idle() is not None:
        pass
    before, after = list(node.on_end())
    assert (before.refined, after.refined) == (False, True)
    assert after.iterations - before.iterations == 3
    assert before.keyframes.tolist() == [0, 7, 14]
    assert set(after.anchors.tolist()) <= {0, 7, 14}
    assert not np.array_equal(before.means, after.means)
    written = read_ply(tmp_path / "run" / "map.ply")
    np.testing.assert_allclose(written.splats.means.numpy(), after.means + after.origin, atol=1e-5)
    assert node.stats.values["splats"] == len(after.means)
    assert node.stats.seconds["refinement"] > 0


def test_a_map_is_saved_while_it_grows_and_a_new_one_begins_where_it_is_asked(tmp_path: Path) -> None:
    def asked(node: Mapper, request: Request) -> Reply:
        replies: list[Any] = list(node.on_request(request))
        while not replies:
            replies = [m for m in node.on_idle() or () if isinstance(m, Reply)]
        (reply,) = replies
        assert reply.number == request.number
        return reply

    node = Mapper(settings())
    reset = asked(node, Request(1, "reset", kept=str(tmp_path / "none")))
    assert (reset.success, reset.message) == (
        True,
        "a new map begins; there was nothing to keep of the one before",
    )
    assert not (tmp_path / "none").exists()
    assert not asked(node, Request(2, "save_map", folder=str(tmp_path / "none"))).success
    for k in range(2):
        list(node.on_fused_keyframe(view_message(7 * k, k / 2)))
    saved = asked(node, Request(3, "save_map", folder=str(tmp_path / "saved")))
    assert saved.success, saved.message
    splats = len(node.atlas.current.state)
    assert saved.message == f"{tmp_path / 'saved'}: {splats} splats, 2 keyframes"
    assert checkpoint_info(tmp_path / "saved").keyframes.tolist() == [0, 7]
    refused = asked(node, Request(4, "reset", kept=str(tmp_path / "kept"), problem="the disk is full"))
    assert refused == Reply(4, False, "the disk is full")
    assert len(node.atlas.current.state) == splats
    assert asked(node, Request(5, "localize")).success
    assert asked(node, Request(6, "reset", kept=str(tmp_path / "kept"))).success
    assert checkpoint_info(tmp_path / "kept").keyframes.tolist() == [0, 7]
    list(node.on_fused_keyframe(view_message(21, 1.0)))
    while node.on_idle() is not None:
        pass
    before, after = (m for m in node.on_end() if isinstance(m, SplatMap))
    assert after.keyframes.tolist() == [21]
    assert after.iterations > before.iterations, "a new map grows, whatever was asked of the one before"


def test_a_new_map_that_was_asked_for_and_got_no_keyframe_says_so_and_where_the_one_before_is(tmp_path: Path) -> None:
    out = tmp_path / "out"
    node = Mapper(settings(output=str(out), checkpoint=0.01))
    list(node.on_fused_keyframe(view_message(0, 0.0)))
    while not (out / "map.ply").exists():
        time.sleep(0.01)
    list(node.on_request(Request(1, "reset", kept=str(tmp_path / "kept"))))
    list(node.on_end())
    assert list(out.iterdir()) == []
    assert node.stats.values["nothing"] == (
        f"another map was begun on request (the one before is in {tmp_path / 'kept'}: "
        f"{int(node.stats.counts['inserted'])} splats, 1 keyframes); since then the mapper made no splat: "
        "no keyframe with depth came to it"
    )
    assert checkpoint_info(tmp_path / "kept").keyframes.tolist() == [0]


def test_a_map_in_which_frames_are_only_found_stays_as_it_is() -> None:
    node = Mapper(settings())
    for k in range(2):
        list(node.on_fused_keyframe(view_message(7 * k, k / 2)))
    (reply,) = node.on_request(Request(1, "localize"))
    assert reply.success
    iterations = node.atlas.current.trainer.iterations
    assert node.on_idle() is None
    before, after = (m for m in node.on_end() if isinstance(m, SplatMap))
    assert iterations == before.iterations == after.iterations


def test_the_cameras_and_on_request_the_images_are_beside_the_map(tmp_path: Path) -> None:
    node = Mapper(settings(output=str(tmp_path), save_images=True))
    sent = [view_message(7 * k, k / 2) for k in range(3)]
    for view in sent:
        list(node.on_fused_keyframe(view))
    *_, last = node.on_end()
    cameras = read_cameras(tmp_path / "cameras.json")
    assert cameras.keyframes.tolist() == [0, 7, 14]
    np.testing.assert_array_equal(cameras.world_from_cam, last.world_from_cam)
    np.testing.assert_array_equal(cameras.intrinsics, [view.intrinsics for view in sent])
    np.testing.assert_array_equal(cameras.timestamps, [view.timestamp for view in sent])
    for view in sent:
        read = cv2.imread(str(tmp_path / "keyframes" / f"{view.index:06d}.png"))
        np.testing.assert_array_equal(read[..., ::-1], view.image)
    assert node.stats.counts["images_saved"] == 3


def test_a_disk_that_takes_no_images_does_not_cost_the_map(tmp_path: Path) -> None:
    (tmp_path / "keyframes").write_text("in the folder's place")
    node = Mapper(settings(output=str(tmp_path), save_images=True))
    list(node.on_fused_keyframe(view_message(0, 0.5)))
    list(node.on_end())
    assert len(read_ply(tmp_path / "map.ply").splats)
    assert node.stats.skipped["images_not_saved"] == 1
    assert "cannot be saved" in node.stats.warnings[0]


def test_without_refinement_both_maps_are_the_same() -> None:
    node = Mapper(settings(refinement=0))
    list(node.on_fused_keyframe(view_message(0, 0.5)))
    before, after = list(node.on_end())
    assert np.array_equal(before.means, after.means)
    assert before.iterations == after.iterations == 4


def test_where_keyframes_wait_new_splats_get_larger_and_none_is_left_out() -> None:
    node = Mapper(replace(settings(), realtime=True))
    node.waiting = lambda kind: 10**6 if kind is FusedKeyframe else 0
    for index in range(3):
        list(node.on_fused_keyframe(view_message(7 * index, 0.4 * index)))
    hurried = node.atlas.current
    assert len(hurried.views) == 3
    assert hurried.views[1].size == (24, 32)  # what is trained on is as it came
    plain = Mapper(settings())
    list(plain.on_fused_keyframe(view_message(0, 0.0)))
    first = int((hurried.state.anchors == 0).sum())
    assert 0.1 * len(plain.atlas.current.state) < first < 0.6 * len(plain.atlas.current.state)
    assert node.stats.skipped["effort on keyframes: new splats as of half the image's size"] == 1
    assert node.stats.skipped["effort on keyframes: no new splats for now"] == 2
    list(node.on_end())
    assert not len(hurried.coarse)
    assert node.stats.counts[LATER] == 3


def test_the_preview_of_a_live_stream_says_how_late_it_is() -> None:
    node = Mapper(replace(settings(), preview_period=1e-9, realtime=True))
    first = replace(view_message(0, 0.0), captured=time.time() - 1.0, effort=2, fusion_effort=1)
    (preview,) = node.on_fused_keyframe(first)
    assert isinstance(preview, Preview)
    assert preview.latency is not None
    assert 1.0 < preview.latency[0, 0] <= preview.latency[0, 1] * 1.02 < 60.0
    assert (preview.effort, preview.fusion_effort) == (2, 1)
    soon = replace(keyframe_message(7, 1.0), captured=time.time() - 0.25)
    node._previews.seconds = 60.0
    assert list(node.on_keyframe(soon)) == []  # previews take a part of the time, and no more
    node._previews.seconds = 0.0
    list(node.on_keyframe(soon))
    shown = node.stats.values["latency"]["keyframe to preview"]  # its coarse depth stands in
    assert shown["count"] == 2
    assert node.stats.values["latency"]["keyframe to map"]["count"] == 1


def test_an_idle_slice_ends_soon_and_says_when_there_is_nothing_to_do() -> None:
    node = Mapper(settings())
    assert node.on_idle() is None
    list(node.on_fused_keyframe(view_message(0, 0.5)))
    assert node.on_idle() == []
    while node.on_idle() is not None:
        pass
    assert node.atlas.current.iterations == 4


def test_poses_move_the_map() -> None:
    node = Mapper(settings())
    list(node.on_fused_keyframe(view_message(0, 0.5)))
    while node.on_idle() is not None:  # what is pending comes before a correction, whenever that arrives
        pass
    moved = pose_on_arc(0.5)
    moved[:3, 3] += [1.0, 2.0, 3.0]
    before = node.atlas.current.snapshot().splats.means
    assert list(node.on_poses(Poses(1, np.array([0]), moved[None], np.array([1.0])))) == []
    after = node.atlas.current.snapshot()
    np.testing.assert_allclose((after.splats.means - before).numpy(), [[1.0, 2.0, 3.0]] * len(before), atol=1e-4)
    np.testing.assert_allclose(after.world_from_cam[0], moved)


def test_parts_between_which_tracking_was_lost_do_not_mix_and_the_largest_is_sent() -> None:
    node = Mapper(settings())
    for index, segment in [(0, 0), (1, 1), (2, 1), (3, 0), (4, 1)]:
        list(node.on_fused_keyframe(view_message(index, index / 5, segment=segment)))
    before, after = list(node.on_end())
    assert before.keyframes.tolist() == after.keyframes.tolist() == [1, 2, 4]
    assert set(after.anchors.tolist()) <= {1, 2, 4}
    assert node.stats.warnings == ["tracking was lost: the map shows the largest of 2 parts, 3 of 5 keyframes"]
    assert node.stats.counts["views"] == 5


def test_the_maps_of_segments_that_a_loop_joins_become_one() -> None:
    node = Mapper(settings())
    for index, segment in [(0, 0), (1, 0), (2, 1), (3, 1)]:
        list(node.on_fused_keyframe(view_message(index, index / 5, segment=segment)))
    parts = [len(mapper.state) for mapper in node.atlas.parts.values()]
    moved = np.stack([pose_on_arc(k / 5) for k in (2, 3, 4)])
    moved[:, :3, 3] += [0.5, 0.0, 0.0]
    joined = np.zeros(3, np.int32)
    list(node.on_poses(Poses(1, np.array([2, 3, 4]), moved, np.full(3, 2.0), joined)))
    assert len(node.atlas.current.state) == sum(parts)
    list(node.on_fused_keyframe(view_message(4, 0.8, segment=1)))  # on its way when its segment was joined
    list(node.on_fused_keyframe(view_message(5, 1.0, segment=0)))
    before, after = list(node.on_end())
    assert before.keyframes.tolist() == after.keyframes.tolist() == [0, 1, 2, 3, 4, 5]
    assert set(after.anchors.tolist()) >= {0, 2}
    np.testing.assert_allclose(after.world_from_cam[2:5], moved)
    assert after.scale.tolist() == [1.0, 1.0, 2.0, 2.0, 2.0, 1.0]
    assert (node.stats.counts["segments_joined"], node.stats.values["segments_apart"]) == (1, 0)
    assert not any("tracking was lost" in warning for warning in node.stats.warnings)


def test_a_pose_that_is_none_is_counted_once_whatever_the_segments() -> None:
    node = Mapper(settings())
    for index, segment in ((0, 0), (1, 0), (2, 1), (3, 1)):
        list(node.on_fused_keyframe(view_message(index, 0.2 * index, segment=segment)))
    assert len(node.atlas.parts) == 2
    poses = np.stack([pose_on_arc(k / 5) for k in (0, 2)])
    poses[0, 0, 3] = np.nan
    list(node.on_poses(Poses(1, np.array([0, 2]), poses, np.ones(2), np.array([0, 1], np.int32))))
    assert node.stats.counts["refused_poses"] == 1
    list(node.on_end())
    assert node.stats.values["segments_apart"] == 1, "one beside the map that is shown"


def test_a_segment_of_which_only_poses_are_known_yet_waits_for_its_views() -> None:
    node = Mapper(settings())
    list(node.on_fused_keyframe(view_message(2, 0.4, segment=1)))
    zero = np.zeros(1, np.int32)
    list(node.on_poses(Poses(1, np.array([2]), pose_on_arc(0.4)[None], np.ones(1), zero)))
    list(node.on_fused_keyframe(view_message(3, 0.6, segment=0)))
    list(node.on_fused_keyframe(view_message(4, 0.8, segment=2)))
    assert [len(mapper.views) for mapper in node.atlas.parts.values()] == [2, 1]
    assert "segments_joined" not in node.stats.counts


def test_a_preview_is_capped_and_relative_to_the_origin() -> None:
    node = Mapper(settings(preview_splats=100, preview_period=1e-9))
    (preview,) = list(node.on_fused_keyframe(view_message(0, 0.5)))
    assert isinstance(preview, Preview)
    assert 50 <= len(preview.means) <= 100
    assert preview.render.shape == preview.image.shape
    assert np.abs(preview.world_from_cam[:3, 3]).max() == 0.0  # the first keyframe is the origin
    assert preview.keyframes.tolist() == [0]
    np.testing.assert_array_equal(preview.keyframe_poses[0], preview.world_from_cam)
    np.testing.assert_array_equal(preview.origin, view_message(0, 0.5).world_from_cam[:3, 3])
    assert (np.linalg.eigvalsh(preview.covariances) > -1e-9).all()
    assert preview.splats.tolist() == [len(node.atlas.current.state)]
    true = view_message(0, 0.5).depth
    assert np.median(preview.depth[preview.depth > 0]) == pytest.approx(np.median(true[true > 0]), rel=0.1)
    assert preview.memory > 1e7


def test_splats_are_counted_by_the_keyframe_that_they_came_from() -> None:
    anchors = np.array([3, 3, -2, 7, 7, 7])
    assert splats_by_keyframe(anchors, np.array([-5, -2, 3, 7, 9])).tolist() == [0, 1, 2, 3, 0]
    assert splats_by_keyframe(anchors[:0], np.array([1, 2])).tolist() == [0, 0]
    before = np.array([-100_000 * STREAM, 4])  # of a map that was continued many times; no room for all in between
    assert splats_by_keyframe(before.repeat(3), before).tolist() == [3, 3]


def test_an_empty_stream_still_ends_with_two_empty_maps() -> None:
    maps = list(Mapper(settings()).on_end())
    assert [len(m.means) for m in maps] == [0, 0]


def test_refusals_reach_the_statistics() -> None:
    node = Mapper(settings())
    message = view_message(0, 0.5)
    message.depth[:3] = np.nan
    list(node.on_fused_keyframe(message))
    assert node.stats.counts["refused_depths"] == 96
    assert len(node.stats.warnings) == 1


def test_unfiltered_depth_reaches_the_map() -> None:
    node, message = Mapper(settings()), view_message(0, 0.5)
    depth = message.depth.copy()
    depth[:, :16] = 0.0
    list(node.on_fused_keyframe(replace(message, depth=depth, unfiltered=message.depth)))
    assert node.stats.counts["pixels_filled"] == 24 * 16


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", [p for p in sorted((ROOT / "launch/conf/mapper").glob("*.yaml")) if "nodes.mapper." in p.read_text()]
)
def test_every_choice_maps_a_few_views(path: Path, tmp_path: Path) -> None:
    from omegaconf import OmegaConf

    small = {"iterations": 30, "refinement": 10, "output": str(tmp_path), "seed": 0, "threads": 1, "device": "cpu"}
    small["density_control"] = {"every": 100}  # no round: losses rise after it, and are passed over as converged
    chosen: dict[str, Any] = {str(k): v for k, v in OmegaConf.merge(OmegaConf.load(path), small).items()}
    config = build(Mapper.Config, {k: v for k, v in chosen.items() if k not in ("_target_", "reads")})
    node = Mapper(config)
    for k in range(3):
        list(node.on_fused_keyframe(view_message(7 * k, k / 2)))
    before, after = [m for m in node.on_end() if isinstance(m, SplatMap)]
    assert before.iterations == 90
    assert after.kernel == config.training.kernel
    assert bool((after.betas != after.betas[0]).any()) == config.training.betas
    assert (tmp_path / "map.ply").exists()
    message = view_message(99, 0.25)
    with torch.no_grad():
        render = rasterize(
            Splats(**{name: torch.from_numpy(getattr(after, name)) for name in PARAMETERS}),
            message.world_from_cam - np.pad(after.origin[:, None], ((0, 1), (3, 0))), message.intrinsics,
            (24, 32), kernel=after.kernel, background=after.background,
        )  # fmt: skip
    assert psnr(render.color.clamp(0, 1).numpy(), message.image / np.float32(255)) > 25.0
    assert not node.stats.warnings


def test_a_keyframe_without_depth_yet_is_in_the_preview_and_not_in_the_map() -> None:
    node, plain = Mapper(replace(settings(), preview_period=1e-9)), Mapper(settings())
    list(node.on_fused_keyframe(view_message(0, 0.0)))
    (preview,) = node.on_keyframe(keyframe_message(7, 1.0))
    assert isinstance(preview, Preview)
    assert len(preview.means) > len(node.atlas.current.state)
    (moved,) = [*node.on_poses(poses_of(7, 1.0)), *node.on_keyframe(keyframe_message(7, 1.0))][-1:]
    assert isinstance(moved, Preview)
    (after,) = node.on_fused_keyframe(view_message(7, 1.0))
    assert isinstance(after, Preview)
    assert len(after.means) == len(node.atlas.current.state)
    list(plain.on_fused_keyframe(view_message(0, 0.0)))
    list(plain.on_poses(poses_of(7, 1.0)))
    list(plain.on_fused_keyframe(view_message(7, 1.0)))
    for name in PARAMETERS:  # keyframes that came for the preview leave the map as it is
        torch.testing.assert_close(
            getattr(node.atlas.current.state.splats, name), getattr(plain.atlas.current.state.splats, name)
        )


def poses_of(index: int, t: float) -> Poses:
    pose = view_message(index, t).world_from_cam
    return Poses(revision=1, index=np.array([index]), world_from_cam=pose[None], scale=np.array([1.0]))


def test_previews_that_nobody_reads_are_not_made() -> None:
    node = Mapper(replace(settings(), preview_period=1e-9))
    node.unread = frozenset({Preview})
    assert not list(node.on_fused_keyframe(view_message(0, 0.0)))
    assert not list(node.on_keyframe(keyframe_message(7, 1.0)))
    assert "provisional" not in node.stats.seconds
