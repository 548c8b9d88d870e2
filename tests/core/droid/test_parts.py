"""Framing, edges by proximity, the factor graph's bookkeeping, weights and their failures."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from mvsgs_core import geometry, weights
from mvsgs_core.droid.config import PRESETS, Constant, DroidConfig
from mvsgs_core.droid.factor_graph import FactorGraph
from mvsgs_core.droid.framing import Framing
from mvsgs_core.droid.motion_filter import MotionFilter
from mvsgs_core.droid.networks import Networks, load, random_net
from mvsgs_core.droid.proximity import by_proximity, neighborhood
from mvsgs_core.droid.trajectory_filler import StoredFrame, between, fill
from mvsgs_core.droid.video import Video, VideoFrame
from mvsgs_core.frame_store import FrameStore
from mvsgs_core.networks.droid import DroidNet, Update
from mvsgs_core.stats import Stats
from tests.support.golden import folder, rule_weights

GRID = (8, 10)
INTRINSICS = np.array([8.0, 8.0, 4.5, 3.5])


def video(positions: list[float]) -> Video:
    """Cameras that look along z, at these x, before a wall at distance 1."""
    made = Video(INTRINSICS)
    for n, x in enumerate(positions):
        pose = np.eye(4)
        pose[0, 3] = -x
        features = torch.zeros(128, *GRID)
        made.append(VideoFrame(n, n / 10, pose, np.ones(GRID), features, features, features))
    return made


def test_published_sizes() -> None:
    assert Framing.of(480, 640, DroidConfig().area).grid == (48, 64)
    assert Framing.of(680, 1200, DroidConfig().area).grid == (41, 73)  # 584x328
    with pytest.raises(ValueError, match="larger area"):
        Framing.of(480, 640, 64 * 64)


def test_a_pixel_is_seen_at_the_same_ray_before_and_after_framing() -> None:
    framing = Framing.of(480, 640, DroidConfig().area)
    k = np.array([500.0, 510.0, 319.5, 239.5])
    cells = framing.intrinsics(k)
    u, v = 100.0, 37.0  # of the source: 0.8 of it, about the pixels' centers
    at = ((u + 0.5) * 0.8 - 0.5) / 8, ((v + 0.5) * 0.8 - 0.5) / 8
    assert (at[0] - cells[2]) / cells[0] == pytest.approx((u - k[2]) / k[0])
    assert (at[1] - cells[3]) / cells[1] == pytest.approx((v - k[3]) / k[1])


def test_a_linear_map_keeps_its_values_over_the_whole_view() -> None:
    framing = Framing.of(100, 150, 100 * 150)
    assert framing.grid == (12, 18)
    rows, columns = np.mgrid[:12, :18] * 8.0  # pixels of the source
    there = framing.whole_view(rows + 2 * columns)
    centers = (np.mgrid[:12, :18] + 0.5) * np.array([100 / 12, 150 / 18])[:, None, None] - 0.5
    inner = np.s_[:11, :17]  # beyond the last cell nothing is known
    np.testing.assert_allclose(there[inner], (centers[0] + 2 * centers[1])[inner], rtol=0.02, atol=0.3)


def test_presets() -> None:
    assert DroidConfig(preset="tum").chosen.warmup == 12
    assert (PRESETS["demo"].frontend_threshold, PRESETS["demo"].backend_threshold) == (16.0, 22.0)
    assert PRESETS["replica"].max_factors == 75
    assert DroidConfig(preset="tum", constants={"stride": 1, "beta": 1}).chosen == replace(
        PRESETS["tum"], stride=1, beta=1
    )
    with pytest.raises(ValueError, match="demo, tum, replica"):
        DroidConfig(preset="kitti")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"no constant 'window'; it has: stride, .*frontend_window"):
        DroidConfig(constants={"window": 10})
    for name, wrong in (("warmup", 2.5), ("stride", True), ("backend_steps", 3)):
        with pytest.raises(ValueError, match=rf"constants\.{name}="):
            DroidConfig(constants={name: wrong})


@pytest.mark.parametrize(
    ("name", "wrong", "said"),
    [
        ("stride", 0, "1 or more"),
        ("warmup", 1, "2 or more"),
        ("frontend_radius", 0, "1 or more"),
        ("backend_radius", 0, "1 or more"),
        ("backend_nms", -1, "0 or more"),
        ("backend_steps", (7, 0), "1 or more"),
        ("backend_every", -1, "0 or more"),
        ("beta", 1.5, "0 to 1"),
        ("filter_threshold", float("nan"), "0 or more"),
        ("keyframe_threshold", float("inf"), "0 or more"),
    ],
)
def test_constants_that_cannot_run_are_refused(name: str, wrong: Constant, said: str) -> None:
    with pytest.raises(ValueError, match=rf"constants\.{name}=.*{said}"):
        DroidConfig(constants={name: wrong})


def test_an_area_too_small_for_any_image_is_refused() -> None:
    with pytest.raises(ValueError, match=r"area=4095: must be 4096 or more"):
        DroidConfig(area=64 * 64 - 1)
    assert Framing.of(480, 480, DroidConfig(area=64 * 64).area).grid == (8, 8)


def near(made: Video, **options: float) -> set[tuple[int, int]]:
    settings = {"first_source": 0, "first_to": 0, "radius": 1, "nms": 0, "threshold": 8.0, "beta": 0.5, "limit": 1000}
    return set(by_proximity(made, existing=[], **(settings | options)))  # type: ignore[arg-type]


def test_neighbors_in_time_are_always_linked() -> None:
    pairs = near(video([0.0, 5.0, 10.0, 15.0]), threshold=0.0)
    assert pairs == set(neighborhood(4, 2))


def test_a_place_seen_again_is_linked() -> None:
    """One cell of flow is 1/8 of the distance: frames 0 and 6 are one cell apart, 0 and 3 much more."""
    made = video([0.0, 1.0, 2.0, 3.0, 2.1, 1.1, 0.125])
    pairs = near(made)
    assert {(0, 6), (6, 0)} <= pairs
    assert (0, 3) not in pairs
    alone = near(made, threshold=2.0, nms=2)
    assert {(0, 6), (1, 5)} & alone == {(1, 5)} or {(0, 6), (1, 5)} & alone == {(0, 6)}  # the other one is beside it
    assert made.distances(np.array([0]), np.array([6]), 0.5)[0] == pytest.approx(1.0, rel=1e-4)


def test_edges_that_exist_suppress_those_beside_them() -> None:
    made = video([0.0, 1.0, 2.0, 3.0, 2.1, 1.1, 0.125])
    options = {"first_source": 0, "first_to": 0, "radius": 1, "nms": 1, "threshold": 2.0, "beta": 0.5, "limit": 1000}
    free = by_proximity(made, existing=[], **options)  # type: ignore[arg-type]
    held = by_proximity(made, existing=[(6, 0)], **options)  # type: ignore[arg-type]
    assert (6, 0) in free
    assert (6, 0) not in held
    assert (5, 0) not in held


def graph(made: Video, max_factors: int | None = None) -> FactorGraph:
    return FactorGraph(made, Networks(random_net(), torch.device("cpu")), max_factors=max_factors)


def test_edges_are_added_once_and_the_oldest_make_room() -> None:
    g = graph(video([0.0, 0.1, 0.2, 0.3]), max_factors=4)
    assert g.add([(0, 1), (1, 0), (0, 1), (1, 2), (2, 1)]) == 4
    for edge, age in zip(g.active, (1, 9, 2, 3)):
        edge.age = age
    assert g.add([(1, 0), (2, 3)], make_room=True) == 1
    assert [edge.pair for edge in g.inactive] == [(1, 0)]
    assert g.inactive[0].hidden is None
    assert len(g.active) == 4
    assert g.add([(1, 0)]) == 0  # retired edges count as there


def test_a_removed_keyframe_takes_its_edges_and_the_others_move_up() -> None:
    g = graph(video([0.0, 0.1, 0.2, 0.3]))
    g.add([(0, 1), (0, 2), (2, 3), (3, 2), (3, 1)])
    g.retire_before(1)
    g.remove_keyframe(1)
    assert [frame.index for frame in g.video.frames] == [0, 2, 3] == list(g.video.keyframes)
    assert [edge.pair for edge in g.inactive] == [(0, 1)]
    assert [edge.pair for edge in g.active] == [(1, 2), (2, 1)]
    g.forget_before(1)
    assert not g.inactive


class Broken(DroidNet):
    """The second edge's revision is NaN."""

    def __init__(self) -> None:
        super().__init__()
        self.update.register_forward_hook(self._break)

    @staticmethod
    def _break(module: torch.nn.Module, inputs: object, out: Update) -> Update:
        delta = out.delta.clone()
        delta[1, 0, 0, 0] = torch.nan
        return out._replace(delta=delta)


def test_a_revision_that_is_not_finite_gets_no_weight() -> None:
    nets = Networks(Broken().eval().requires_grad_(False), torch.device("cpu"))
    g = FactorGraph(video([0.0, 0.1]), nets)
    g.add([(0, 1), (1, 0)])
    g.update(1)
    assert nets.not_finite == 1
    assert not g.active[1].weight.any()
    assert g.active[0].weight.all()
    assert all(np.isfinite(frame.cam_from_world).all() for frame in g.video.frames)
    assert all(np.isfinite(frame.inverse_depth).all() for frame in g.video.frames)


def test_both_correlations_lead_the_graph_to_the_same() -> None:
    found = []
    for kind, transient in (("volume", False), ("on_the_fly", True)):
        made = video([0.0, 0.1, 0.2])
        for n, frame in enumerate(made.frames):
            frame.features = torch.randn(128, *GRID, generator=torch.Generator().manual_seed(n))
        g = FactorGraph(made, Networks(random_net(), torch.device("cpu")), correlation=kind, transient=transient)
        g.add(neighborhood(3, 2))
        assert not g.update_globally().failure
        found.append(np.stack([edge.target for edge in g.active]))
        assert (g.active[0].correlation is None) == transient
    np.testing.assert_allclose(found[0], found[1], atol=1e-3)


def test_half_precision_passes_through(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU's autocast, as far as a CPU can stand in for it: the same mixture of types, in bfloat16."""
    exact, rough = (Networks(random_net(), torch.device("cpu")) for _ in range(2))
    monkeypatch.setattr(rough, "_precision", lambda: torch.autocast("cpu", dtype=torch.bfloat16))
    image = np.random.default_rng(0).integers(0, 255, (64, 80, 3), dtype=np.uint8)
    results = []
    for nets in (exact, rough):
        features, (hidden, context) = nets.features([image, image[:, ::-1]]), nets.context(image)
        for kind in ("volume", "on_the_fly"):
            made = video([0.0, 0.1])
            for n, frame in enumerate(made.frames):
                frame.features, frame.hidden, frame.context = features[n], hidden, context
            g = FactorGraph(made, nets, correlation=kind)
            g.add([(0, 1), (1, 0)])
            assert not g.update(1).failure
            assert not g.update(1).failure
            assert g.active[0].target.dtype == np.float32
            results.append(g.active[0].target)
    assert features.dtype == hidden.dtype == torch.bfloat16
    assert not exact.not_finite + rough.not_finite
    step = np.abs(results[0] - results[2]).mean() / np.abs(results[0]).mean()
    assert 0 < step < 0.2


def test_the_motion_filter_keeps_the_first_frame_and_those_that_moved() -> None:
    nets = Networks(random_net(), torch.device("cpu"))
    image = np.random.default_rng(0).integers(0, 255, (64, 80, 3), dtype=np.uint8)
    for threshold, kept in ((1e-6, True), (1e6, False)):
        motion_filter = MotionFilter(nets, threshold)
        assert motion_filter.passes(image) is not None
        assert (motion_filter.passes(image) is not None) == kept


def test_a_frame_whose_adjustment_fails_has_no_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    failed = Mock(failure="the system is singular")
    monkeypatch.setattr(FactorGraph, "update", lambda *_, **__: failed)
    stats = Stats()
    nets = Networks(random_net(), torch.device("cpu"))
    made = video([0.0, 0.4, 0.8])
    made.remove(1)
    frame = StoredFrame(1, 0.1, FrameStore())
    frame.put(np.zeros((64, 80, 3), np.uint8))
    poses = fill(made, nets, [frame], "volume", 1, stats)
    assert poses.shape == (1, 4, 4)
    assert np.isnan(poses).all()
    assert any("have no pose" in warning for warning in stats.warnings)
    assert len(made) == 2, "as it was"


def test_scale_is_normalized_and_the_scene_stays_the_same() -> None:
    made = video([0.0, 0.4])
    for frame in made.frames:
        frame.inverse_depth = frame.inverse_depth * 4.0
    before = made.reproject(np.array([0]), np.array([1]))
    assert made.normalize() == pytest.approx(4.0)
    assert made.frames[0].inverse_depth.mean() == pytest.approx(1.0)
    np.testing.assert_allclose(made.reproject(np.array([0]), np.array([1])), before)


def test_poses_between_keyframes_lie_on_the_screw_motion() -> None:
    made = video([0.0, 1.0])
    a, b = made.frames
    twist = np.array([0.4, 0.2, 0.1, 0.1, 0.3, -0.2])
    b.cam_from_world = geometry.se3_exp(twist) @ a.cam_from_world
    np.testing.assert_allclose(between(a, b, 0.025), geometry.se3_exp(0.25 * twist) @ a.cam_from_world, atol=1e-12)
    np.testing.assert_array_equal(between(b, b, 9.0), b.cam_from_world)
    before, after = made.around([0, 1, 7])
    assert before.tolist() == [0, 1, 1]
    assert after.tolist() == [1, 1, 1]


def test_frames_are_stored_without_loss() -> None:
    image = np.random.default_rng(0).integers(0, 255, (16, 24, 3), dtype=np.uint8)
    frame = StoredFrame(0, 0.0, FrameStore())
    assert not frame.is_there
    frame.put(image)
    assert frame.is_there
    np.testing.assert_array_equal(frame.image, image)


def test_an_official_file_loads_and_a_missing_one_says_what_to_do(
    tmp_path: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = rule_weights(folder("droid") / "state_dict.json")
    for key in ("update.weight.2.weight", "update.weight.2.bias", "update.delta.2.weight", "update.delta.2.bias"):
        state[key] = torch.cat([state[key], torch.ones_like(state[key][:1])])  # the row that the authors cut off
    file = tmp_path / "droid.pth"  # type: ignore[operator]
    torch.save({f"module.{key}": value for key, value in state.items()}, file)
    net = load(str(file))
    torch.testing.assert_close(net.update.delta[2].weight, state["update.delta.2.weight"][:2])
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path))
    torch.testing.assert_close(load(None).state_dict(), net.state_dict())
    monkeypatch.setattr(weights, "folders", lambda: [tmp_path / "none"])  # type: ignore[operator]
    with pytest.raises(FileNotFoundError, match=r"droid\.pth.*DROID-SLAM"):
        load(None)


def test_random_weights_repeat() -> None:
    a, b = random_net(), random_net()
    torch.testing.assert_close(a.state_dict(), b.state_dict(), rtol=0, atol=0)
