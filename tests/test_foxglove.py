"""Recordings hold what Foxglove draws: read back with the libraries of MCAP alone, it is what the run made."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from launch.compose import compose
from launch.inline import run_inline
from msgs import (
    Depth,
    Frame,
    FusedKeyframe,
    GroundTruth,
    Keyframe,
    Poses,
    SplatMap,
    TrackedFrame,
    Trajectory,
)
from msgs.codec import decode
from mvsgs_core.camera import unproject
from mvsgs_core.export import foxglove_messages
from mvsgs_core.image_metrics import psnr
from mvsgs_core.rasterizer.spherical_harmonics import C0
from nodes.recorder import Recorder
from tests.support.example_messages import assert_equal
from tests.support.foxglove_file import SCHEMAS, Shown, matrix, ns, points_of, recorded, seconds, shown

ROOM = ["dataset=synthetic", "dataset.size=[120,160]", "dataset.options.frames=40"]
SMALL = [
    "device=cpu", "mapper.iterations=5", "mapper.refinement=20", "evaluator._target_=null", "screen=off",
    "tracker.threads=1", "mapper.threads=1",
]  # fmt: skip


class Run(NamedTuple):
    folder: Path
    sent: dict[type, list[Any]]

    def of(self, kind: type) -> list[Any]:
        return self.sent[kind]


def run(folder: Path, *overrides: str) -> Run:
    sent: dict[type, list[Any]] = defaultdict(list)
    passed = {Poses: "tracker", TrackedFrame: "tracker"}  # others send them on

    def observe(slot: str, node: object, message: Any) -> None:
        if passed.get(type(message), slot) == slot:
            sent[type(message)].append(message)

    run_inline(compose([*SMALL, *overrides, f"output={folder}"]), observe)
    return Run(folder, sent)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run(tmp_path_factory.mktemp("mapped") / "out", *ROOM, "recorder=mcap")


@pytest.fixture(scope="module")
def topics(mapped: Run) -> dict[str, list[Shown]]:
    return shown(mapped.folder / "recording.mcap")


@pytest.mark.slow
def test_every_channel_is_there_and_only_the_input_is_recorded_itself(
    mapped: Run, topics: dict[str, list[Shown]]
) -> None:
    assert topics.keys() == SCHEMAS.keys()
    assert set(recorded(mapped.folder / "recording.mcap")) == {"Frame", "GroundTruth"}


@pytest.mark.slow
def test_images_are_the_frames(mapped: Run, topics: dict[str, list[Shown]]) -> None:
    assert len(topics["/camera/image"]) == len(mapped.of(Frame)) == 40
    for image, frame in zip(topics["/camera/image"], mapped.of(Frame)):
        assert image.ns == ns(frame.timestamp)
        assert seconds(image.message.timestamp) == pytest.approx(frame.timestamp)
        assert (image.message.format, image.message.frame_id) == ("jpeg", "camera")
        decoded = cv2.imdecode(np.frombuffer(image.message.data, np.uint8), cv2.IMREAD_COLOR)
        assert psnr(decoded[..., ::-1] / 255, frame.image / 255) > 28


@pytest.mark.slow
def test_poses_are_those_of_the_run(mapped: Run, topics: dict[str, list[Shown]]) -> None:
    keyframes = {ns(k.timestamp): k for k in mapped.of(Keyframe)}
    between = {ns(t.timestamp): t for t in mapped.of(TrackedFrame)}
    times = [pose.ns for pose in topics["/camera/pose"]]
    assert sorted(times) == sorted([*keyframes, *between])
    assert len(keyframes) > 5
    assert len(between) > 5
    at = {pose.ns: matrix(pose.message.pose.position, pose.message.pose.orientation) for pose in topics["/camera/pose"]}
    for time, keyframe in keyframes.items():
        np.testing.assert_allclose(at[time], keyframe.world_from_cam, atol=1e-9)
    final = {ns(t): pose for track in mapped.of(Trajectory) for t, pose in zip(track.timestamp, track.world_from_cam)}
    path = np.linalg.norm(np.diff([final[t][:3, 3] for t in sorted(keyframes)], axis=0), axis=1).sum()
    for time in between:  # the final trajectory is corrected, but not by much
        assert np.linalg.norm(at[time][:3, 3] - final[time][:3, 3]) < 0.05 * path
    assert all(pose.message.frame_id == "map" for pose in topics["/camera/pose"])
    assert [transform.ns for transform in topics["/tf"]] == times
    for transform in topics["/tf"]:
        (one,) = transform.message.transforms
        assert (one.parent_frame_id, one.child_frame_id) == ("map", "camera")
        np.testing.assert_allclose(matrix(one.translation, one.rotation), at[transform.ns], atol=1e-12)


@pytest.mark.slow
def test_the_trajectory_is_the_final_one(mapped: Run, topics: dict[str, list[Shown]]) -> None:
    ((_, path),) = topics["/trajectory"]
    (track,) = mapped.of(Trajectory)
    posed = track.world_from_cam[np.isfinite(track.world_from_cam).all(axis=(1, 2))]
    read = np.array([matrix(pose.position, pose.orientation) for pose in path.poses])
    np.testing.assert_allclose(read, posed, atol=1e-9)
    assert topics["/trajectory"][0].ns == ns(max(track.timestamp))


@pytest.mark.slow
def test_depth_and_its_points_are_the_keyframes(mapped: Run, topics: dict[str, list[Shown]]) -> None:
    assert len(topics["/keyframe/depth"]) == len(mapped.of(FusedKeyframe)) > 5
    per_keyframe = zip(
        mapped.of(FusedKeyframe), topics["/keyframe/depth"], topics["/keyframe/calibration"], topics["/keyframe/points"]
    )
    for keyframe, depth, calibration, cloud in per_keyframe:
        assert depth.ns == cloud.ns == calibration.ns == ns(keyframe.timestamp)
        size = (depth.message.height, depth.message.width)
        assert (depth.message.encoding, depth.message.step) == ("32FC1", 4 * size[1])
        values = np.frombuffer(depth.message.data, "<f4").reshape(size)
        np.testing.assert_array_equal(values, keyframe.depth)
        fx, _, cx, _, fy, cy, *_ = calibration.message.K
        assert (calibration.message.height, calibration.message.width) == size
        # What Foxglove computes of depth, calibration and pose lies on the map's surface: so do the points.
        world = unproject(values, np.array([fx, fy, cx, cy])) @ keyframe.world_from_cam[:3, :3].T
        world += keyframe.world_from_cam[:3, 3]
        assert size[0] * size[1] > foxglove_messages.MAX_KEYFRAME_POINTS, "a grid of pixels is sent, not all"
        grid = np.s_[::2, ::2]
        known = keyframe.depth[grid] > 0
        points, colors = points_of(cloud.message)
        assert cloud.message.frame_id == "map"
        np.testing.assert_allclose(points, world[grid][known], atol=1e-5 * np.abs(world).max())
        assert keyframe.image.shape[:2] == size
        np.testing.assert_array_equal(colors[:, :3], keyframe.image[grid][known])
        assert (colors[:, 3] == 255).all()


@pytest.mark.slow
def test_calibrations_are_the_trackers(mapped: Run, topics: dict[str, list[Shown]]) -> None:
    for calibration, keyframe in zip(topics["/camera/calibration"], mapped.of(Keyframe), strict=True):
        fx, fy, cx, cy = keyframe.intrinsics
        np.testing.assert_allclose(calibration.message.K, [fx, 0, cx, 0, fy, cy, 0, 0, 1])
        np.testing.assert_allclose(calibration.message.P, [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0])
        assert (calibration.message.height, calibration.message.width) == keyframe.image.shape[:2]


@pytest.mark.slow
def test_the_map_is_the_refined_one(mapped: Run, topics: dict[str, list[Shown]]) -> None:
    (cloud,) = topics["/map"]
    (final,) = (splats for splats in mapped.of(SplatMap) if splats.refined)
    points, colors = points_of(cloud.message)
    np.testing.assert_allclose(points, final.means + final.origin, atol=1e-5)
    np.testing.assert_allclose(colors[:, :3], np.clip(255 * (0.5 + C0 * final.sh[:, 0]), 0, 255), atol=0.51)
    np.testing.assert_allclose(colors[:, 3], 255 / (1 + np.exp(-final.opacity_logits)), atol=0.51)


@pytest.mark.slow
def test_the_player_gives_the_identical_map_with_and_without(mapped: Run, tmp_path: Path) -> None:
    without = run(tmp_path / "without", *ROOM, "recorder=mcap", "recorder.foxglove=false")
    recordings = [one.folder / "recording.mcap" for one in (mapped, without)]
    assert shown(recordings[1]) == {}
    assert recorded(recordings[0]) == recorded(recordings[1])
    first = (mapped.folder / "map.ply").read_bytes()
    assert (without.folder / "map.ply").read_bytes() == first
    for i, recording in enumerate(recordings):
        played = run(tmp_path / str(i), "dataset=player", f"dataset.path={recording}")
        assert (played.folder / "map.ply").read_bytes() == first


@pytest.mark.slow
def test_without_foxglove_nothing_is_read_for_it() -> None:
    read = {
        (choice, given): {
            edge.message
            for edge in compose([f"recorder={choice}", f"recorder.foxglove={given}", "output=/tmp/x"]).edges
            if edge.reader == "recorder"
        }
        for choice in ("mcap", "mcap_all")
        for given in ("true", "false")
    }
    seen = {Keyframe, TrackedFrame, Poses, Trajectory, FusedKeyframe, SplatMap}
    assert read["mcap", "false"] == {Frame, GroundTruth}
    assert read["mcap", "true"] == {Frame, GroundTruth} | seen
    assert read["mcap_all", "false"] == read["mcap_all", "true"] - {SplatMap} >= seen - {SplatMap}
    with pytest.raises(ValueError, match=r"only_shown=\['Depths'\]: Foxglove's channels show"):
        Recorder.check(Recorder.Config(path="/tmp/none.mcap", only_shown=["Depths"]))


@pytest.mark.slow
def test_what_the_stages_made_is_recorded_as_the_mapper_read_it(tmp_path: Path) -> None:
    """So that a mapper can be run on it: what depth_fusion sent, frames between keyframes too, in its order."""
    handed_on: list[Any] = []

    def observe(slot: str, node: object, message: Any) -> None:
        if slot == "depth_fusion":
            handed_on.append(message)

    overrides = [*ROOM, *SMALL, "dataset.options.frames=25", "mapper._target_=null", "recorder=mcap_all"]
    run_inline(compose([*overrides, f"output={tmp_path}"]), observe)
    kinds = {FusedKeyframe, TrackedFrame, Poses}
    assert {type(message) for message in handed_on} == kinds
    with (tmp_path / "recording.mcap").open("rb") as file:
        records = [
            decode(record.data).message
            for _, channel, record in make_reader(file).iter_messages(log_time_order=False)
            if channel.topic in {kind.__name__ for kind in kinds}
        ]
        assert {Depth.__name__, Keyframe.__name__} <= set(recorded(tmp_path / "recording.mcap"))
    assert len(records) == len(handed_on)
    for a, b in zip(handed_on, records, strict=True):
        assert_equal(a, b)
