"""A map that is kept and gone on in: the camera is found at once, tracked in its frame, and nowhere where it is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.array_file import read_arrays, write_arrays
from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import Item
from mvsgs_core.kept_map import STREAM
from mvsgs_core.tracking.estimation.calibration import LAST
from mvsgs_core.tracking.known_map import FORMAT, VERSION, WHAT, KnownMap, load
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.places.relocalization import Relocalizer
from mvsgs_core.tracking.tracker import Tracker, TrackerConfig
from mvsgs_core.trajectory import TrackingState
from tests.support.sequences import synthetic, tracked_room

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "checkpoint" / "tracker.npz"
    tracked_room()[0].keep_map(path)
    return path


def returning(known: KnownMap, items: list[Item]) -> Tracker:
    """A tracker that has gone on in the map with these frames, numbered anew."""
    tracker = Tracker(known=known.renumbered(STREAM))
    for n, item in enumerate(items):
        tracker.add(n, n / 20.0, item.image, item.intrinsics, item.intrinsics_guessed)
    return tracker


def back() -> list[Item]:
    """The way back, in another light, of frames that were no keyframes."""
    items = synthetic(frames=80)[70:20:-1]
    return [replace(i, image=(0.7 * i.image).astype(np.uint8)) for i in items if i.index % 5 == 0]


def test_a_map_comes_back_as_it_was(file: Path) -> None:
    graph, known = tracked_room()[0].session.graph, load(file)
    assert [keyframe.index for keyframe in known.keyframes] == sorted(graph.keyframes)
    assert known.edges.keys() == graph.edges.keys()
    assert np.array_equal(known.intrinsics, graph.intrinsics)
    for keyframe in known.keyframes:
        was = graph.keyframes[keyframe.index]
        assert np.array_equal(keyframe.cam_from_world, was.cam_from_world)
        assert np.array_equal(keyframe.inverse_depth, was.inverse_depth)
        assert np.array_equal(keyframe.triangulated, was.triangulated)
        assert np.array_equal(keyframe.static, was.static.astype(np.float32))
        assert np.array_equal(keyframe.image.gray, was.image.gray)
        assert np.array_equal(keyframe.points, was.points)
    assert any((keyframe.static < 0.5).any() for keyframe in known.keyframes), "nothing to compare"
    assert np.array_equal(known.renumbered(STREAM).keyframes[0].static, known.keyframes[0].static)
    for pair, edge in known.edges.items():
        assert np.array_equal(edge.target, graph.edges[pair].target)
        assert np.array_equal(edge.weight, graph.edges[pair].weight)
        if pair[1]:  # the flow to the first frame came after its matches
            np.testing.assert_allclose(edge.velocity, graph.edges[pair].velocity, rtol=1e-3)


def test_a_map_knows_whether_its_camera_reads_columns(file: Path, tmp_path: Path) -> None:
    meta, arrays = read_arrays(file, FORMAT, VERSION, WHAT)
    meta = {name: value for name, value in meta.items() if name not in ("format", "version", "reads_columns")}
    meta["readout_time"] = 0.02
    for expected in (True, False):
        write_arrays(tmp_path / "map.npz", FORMAT, VERSION, meta | {"reads_columns": expected}, arrays)
        known = load(tmp_path / "map.npz")
        assert (known.readout_time, known.reads_columns) == (0.02, expected)
        assert returning(known, back()[:1]).reads_columns == expected
    write_arrays(tmp_path / "map.npz", FORMAT, VERSION, meta | {"reads_columns": 1}, arrays)
    with pytest.raises(ValueError, match="1 does not say whether columns are read"):
        load(tmp_path / "map.npz")


def test_the_start_of_another_part_leaves_the_readout_time_of_the_map(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is of six keyframes, the map's of more."""
    monkeypatch.setattr(Relocalizer, "relocalize", lambda *_: None)
    meta, arrays = read_arrays(file, FORMAT, VERSION, WHAT)
    meta = {name: value for name, value in meta.items() if name not in ("format", "version")} | {"readout_time": 0.02}
    write_arrays(tmp_path / "map.npz", FORMAT, VERSION, meta, arrays)
    tracker = Tracker(TrackerConfig(loops=False), known=load(tmp_path / "map.npz").renumbered(STREAM))
    for item in synthetic(frames=80)[:30]:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    assert tracker.phase is Phase.TRACKING
    assert tracker.session.segment > 0
    list(tracker.finish())
    assert tracker.readout_time == 0.02


def test_a_map_of_several_parts_has_the_readout_time_of_the_largest(file: Path) -> None:
    known = load(file).renumbered(STREAM)
    count = len(known.keyframes)
    assert count < LAST
    for keyframe in known.keyframes[: count // 3]:
        keyframe.segment = 1
    first = back()[0]
    session = Tracker(known=known).begin(first.image.shape[:2], first.intrinsics)
    assert session.calibration.readout_of == count - count // 3


def test_who_goes_on_in_the_same_run_tells_readers_where_all_keyframes_are(file: Path) -> None:
    """They may have later corrections than the map that was saved. On a map of another run readers begin with it."""
    first, known = back()[0], load(file)
    for again in (True, False):
        tracker = Tracker(known=known if again else known.renumbered(STREAM))
        publisher = tracker.begin(first.image.shape[:2], first.intrinsics).publisher
        correction = publisher.corrections()
        assert (correction is not None) == again
        if correction is not None:
            assert correction.index.tolist() == [keyframe.index for keyframe in known.keyframes]
        assert publisher.corrections() is None


def test_the_camera_is_found_and_tracked_in_the_frame_of_the_map(file: Path) -> None:
    """From the other direction, darker, at larger steps: poses are the first run's, to a hundredth of a depth."""
    items, first = back(), {int(i): pose for i, pose in zip(tracked_room()[1].index, tracked_room()[1].world_from_cam)}
    known = load(file)
    tracker = returning(known, items)
    found = tracker.newest_pose()
    assert found is not None
    assert found.segment == known.keyframes[0].segment
    updates = list(tracker.finish())
    trajectory = tracker.trajectory()
    assert trajectory.posed.all()
    assert set(trajectory.segment.tolist()) == {known.keyframes[0].segment}
    depth = np.median([keyframe.median_depth for keyframe in known.keyframes])
    true = np.stack([np.asarray(item.world_from_cam)[:3, 3] for item in items])
    before = np.stack([first[item.index][:3, 3] for item in items])
    assert np.median(np.linalg.norm(trajectory.world_from_cam[:, :3, 3] - before, axis=1)) < 0.01 * depth
    centers = trajectory.world_from_cam[:, :3, 3]
    assert np.abs(geometry.umeyama(centers, true).apply(centers) - true).max() < 0.01
    assert updates[-1].correction is not None
    assert {keyframe.index - STREAM for keyframe in known.keyframes} <= set(updates[-1].correction.index.tolist())
    assert updates[-1].correction.exposure is not None, "the light is another"
    assert not tracker.stats.warnings


def test_another_scene_is_not_found_and_gets_a_part_of_its_own(file: Path) -> None:
    known, items = load(file), list(synthetic(frames=40, scene="aerial"))
    items = [replace(i, intrinsics=synthetic(frames=80)[0].intrinsics) for i in items]
    tracker = returning(known, items)
    list(tracker.finish())
    assert not set(tracker.trajectory().segment.tolist()) & known.segments
    assert any("was not found at once" in warning for warning in tracker.stats.warnings)


def test_a_stream_that_is_neither_found_in_the_map_nor_starts_has_a_reason(file: Path, tmp_path: Path) -> None:
    """The map stays as it was, and can be kept."""
    first = replace(synthetic(frames=40, scene="aerial")[0], intrinsics=synthetic(frames=80)[0].intrinsics)
    tracker = returning(load(file), [first] * 14)
    list(tracker.finish())
    assert not tracker.trajectory().posed.any()
    assert "not found in the map" in tracker.nothing
    assert "too little motion: the image moved by 0.0 %" in tracker.nothing
    assert tracker.nothing in list(tracker.stats.warnings)
    tracker.keep_map(tmp_path / "tracker.npz")
    kept, known = load(tmp_path / "tracker.npz").keyframes, load(file).renumbered(STREAM).keyframes
    assert [keyframe.index for keyframe in kept] == [keyframe.index for keyframe in known]
    states = tracker.trajectory().state
    lost, unstarted = (int(np.sum(states == s)) for s in (TrackingState.LOST, TrackingState.NOT_INITIALIZED))
    assert unstarted > 0
    assert f"{lost} of 14 frames were lost" in list(tracker.stats.warnings)
    assert f"{unstarted} of 14 frames came before a start and have no pose" in list(tracker.stats.warnings)
    short = returning(load(file), [first] * 3)
    list(short.finish())
    assert short.phase is Phase.RELOCALIZING
    assert "in no frame" in short.nothing


def test_a_stream_may_begin_where_nothing_is_seen(file: Path) -> None:
    """Dark frames, then the room: the camera is looked for as long as nothing else was begun."""
    items = back()
    dark = [replace(items[0], image=np.zeros_like(items[0].image)) for _ in range(10)]
    tracker = Tracker(known=load(file).renumbered(STREAM))
    for n, item in enumerate(dark):
        tracker.add(n, n / 20.0, item.image, item.intrinsics)
    assert tracker.phase is Phase.LOST
    tracker.add(10, 0.5, items[0].image, items[0].intrinsics)
    assert tracker.phase is Phase.TRACKING


def test_the_map_of_a_map_is_gone_on_in_too(file: Path, tmp_path: Path) -> None:
    tracker = returning(load(file), back())
    list(tracker.finish())
    again = tmp_path / "tracker.npz"
    tracker.keep_map(again)
    known = load(again)
    assert len(known.keyframes) == len(tracker.session.graph.keyframes)
    third = returning(known, back()[:4])
    assert third.phase is Phase.TRACKING
    assert min(third.session.graph.keyframes) < -STREAM


def test_a_guessed_focal_length_is_the_maps(file: Path) -> None:
    items = [replace(i, intrinsics=i.intrinsics * [1.2, 1.2, 1.0, 1.0], intrinsics_guessed=True) for i in back()]
    tracker = returning(load(file), items[:3])
    assert tracker.phase is Phase.TRACKING
    assert tracker.focal_factor == pytest.approx(1.0 / 1.2, rel=1e-3)
    assert tracker.session.calibration.of_map


def test_another_camera_is_refused(file: Path) -> None:
    item = back()[0]
    fx = item.intrinsics[0]  # told in pixels of the frames, whatever the tracker works at
    with pytest.raises(BadFileError, match=rf"another camera.* \[{fx:.1f}, .* these frames are \[{1.2 * fx:.1f}, "):
        returning(load(file), [replace(item, intrinsics=item.intrinsics * [1.2, 1.2, 1.0, 1.0])])
    with pytest.raises(BadFileError, match="same shape"):
        returning(load(file), [replace(item, image=np.ascontiguousarray(item.image[:, :160]))])


def test_a_guess_that_is_not_the_maps_camera_but_for_the_focal_length_is_refused(file: Path) -> None:
    """Keyframes would go out with the guess's middle of the image, and poses be found with the map's."""
    item, known, shift = back()[0], load(file), np.array([0.0, 0.0, 16.0, -8.0])
    wide = 1.2 * item.intrinsics  # of images of more pixels, in which the user is told
    camera = known.intrinsics + shift
    scale = item.image.shape[1] / known.size[1]
    fx, fy, cx, cy = wide + 1.2 * scale * shift
    told = rf"dataset\.intrinsics=\[{fx:.1f},{fy:.1f},{cx:.1f},{cy:.1f}\]"
    for factor in (1.0, 1.3):
        tracker = Tracker(known=replace(known, intrinsics=camera))
        guess = [factor, factor, 1.0, 1.0]
        with pytest.raises(BadFileError, match=f"another camera.* guess.*{told}"):
            tracker.begin(item.image.shape[:2], item.intrinsics * guess, True, wide * guess)
    taller = Tracker(known=replace(known, intrinsics=known.intrinsics * [1.0, 1.1, 1.0, 1.0]))
    with pytest.raises(BadFileError, match="another camera"):
        taller.begin(item.image.shape[:2], item.intrinsics, True)


def test_what_is_damaged_or_of_another_version_is_refused(file: Path, tmp_path: Path) -> None:
    meta, arrays = read_arrays(file, FORMAT, VERSION, WHAT)
    meta = {name: value for name, value in meta.items() if name not in ("format", "version")}
    bad = tmp_path / "bad.npz"
    poses = arrays["cam_from_world"].copy()
    poses[0, :3, :3] *= 1.1
    wrong = {
        "poses": {"cam_from_world": poses},
        "depths": {"inverse_depth": -arrays["inverse_depth"]},
        "finite": {"intrinsics": np.full(4, np.nan)},
        "order": {"index": arrays["index"][::-1].copy()},
        "not there": {"edges": arrays["edges"] + 1000},
        "gray": {"gray": arrays["gray"][:, :8].copy()},
        "stand still": {"static": arrays["static"] + np.float32(1.0)},
    }
    for said, change in wrong.items():
        write_arrays(bad, FORMAT, VERSION, meta, {**arrays, **change})
        with pytest.raises(ValueError, match=f"damaged.*{said}"):
            load(bad)
    write_arrays(bad, FORMAT, VERSION + 1, meta, arrays)
    with pytest.raises(ValueError, match="version"):
        load(bad)
    bad.write_bytes(file.read_bytes()[:-1000])
    with pytest.raises(ValueError, match="damaged"):
        load(bad)


def test_a_frozen_map_stays_as_it_is_and_frames_are_found_in_it(file: Path) -> None:
    known, items = load(file), back()
    first = {int(i): pose for i, pose in zip(tracked_room()[1].index, tracked_room()[1].world_from_cam)}
    depth = np.median([keyframe.median_depth for keyframe in known.keyframes])
    tracker = Tracker(known=known.renumbered(STREAM), frozen=True)
    for n, item in enumerate(items):
        update = tracker.add(n, n / 20.0, item.image, item.intrinsics)
        found = tracker.newest_pose()
        assert found is not None
        assert np.linalg.norm(found.world_from_cam[:3, 3] - first[item.index][:3, 3]) < 0.01 * depth
        assert 0.5 < found.confidence <= 1.0
        assert not update.keyframes
        assert update.correction is None
    assert len({record.reference for record in tracker.session.records}) > 1, "the reference follows the camera"
    assert all(update.correction is None for update in tracker.finish())
    now = tracker.session.graph.keyframes
    assert {index + STREAM for index in now} == {keyframe.index for keyframe in known.keyframes}
    for keyframe in known.keyframes:
        assert np.array_equal(now[keyframe.index - STREAM].cam_from_world, keyframe.cam_from_world)
        assert np.array_equal(now[keyframe.index - STREAM].inverse_depth, keyframe.inverse_depth)
    assert tracker.trajectory().posed.all()


def test_a_map_that_is_frozen_for_a_while_grows_again_afterwards() -> None:
    tracker, items = Tracker(), synthetic(frames=80)
    with pytest.raises(ValueError, match="nothing is mapped yet"):
        tracker.freeze()
    for item in items[:50]:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    was = {index: k.cam_from_world.copy() for index, k in tracker.session.graph.keyframes.items()}
    tracker.freeze()
    for item in items[50:65]:
        update = tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
        assert not update.keyframes
        assert tracker.newest_pose() is not None
        assert not tracker.pending
    now = tracker.session.graph.keyframes
    assert now.keys() == was.keys()
    assert all(np.array_equal(now[index].cam_from_world, pose) for index, pose in was.items())
    tracker.thaw()
    for item in items[65:]:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    assert max(tracker.session.graph.keyframes) > 64
    list(tracker.finish())
    trajectory, first = tracker.trajectory(), tracked_room()[1]
    depth = np.median([keyframe.median_depth for keyframe in tracker.session.graph.keyframes.values()])
    apart = np.linalg.norm(trajectory.world_from_cam[:, :3, 3] - first.world_from_cam[:, :3, 3], axis=1)
    assert np.nanmax(apart) < 0.03 * depth
    assert trajectory.posed.sum() == first.posed.sum()


def test_in_a_frozen_map_another_scene_is_found_nowhere(file: Path) -> None:
    intrinsics = synthetic(frames=80)[0].intrinsics
    tracker = Tracker(known=load(file).renumbered(STREAM), frozen=True)
    for item in synthetic(frames=40, scene="aerial"):
        tracker.add(item.index, item.timestamp, item.image, intrinsics)
        assert tracker.newest_pose() is None
    assert tracker.phase is Phase.RELOCALIZING, "it never begins a part of its own"
    list(tracker.finish())
    assert not tracker.trajectory().posed.any()
    assert "in no frame" in tracker.nothing


def test_confidence_falls_with_what_speaks_for_a_pose(file: Path) -> None:
    item = back()[5]
    hidden = item.image.copy()
    hidden[:, :160] = 127
    seen = []
    for image in (item.image, hidden):
        tracker = Tracker(known=load(file).renumbered(STREAM), frozen=True)
        tracker.add(0, 0.0, item.image, item.intrinsics)
        tracker.add(1, 0.05, np.roll(image, 3, axis=1), item.intrinsics)
        found = tracker.newest_pose()
        assert found is not None
        seen.append(found.confidence)
    assert seen[1] < 0.8 * seen[0]
