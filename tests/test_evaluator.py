"""The evaluator as a node: what a run sends goes in, the report files come out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msgs import FusedKeyframe, GroundTruth, SplatMap, TrackingState, Trajectory
from mvsgs_core import geometry
from mvsgs_core.evaluation.scoring import render_frame
from mvsgs_core.photometry import vignetting_factor
from nodes.evaluator import Evaluator
from nodes.parameters import build
from tests.support.full_disk import full_after

H, W, N, SCALE = 24, 32, 12, 0.5  # the estimate's unit is 2 true units
INTRINSICS = np.array([30.0, 30.0, 15.5, 11.5])
ORIGIN = np.array([1e6, -2e6, 3e6])


def _poses() -> np.ndarray:
    poses = np.tile(np.eye(4), (N, 1, 1))
    for k in range(N):
        poses[k] = geometry.se3_exp(np.array([0.1 * k, 0.03 * np.sin(k), 0.02 * k, 0, 0.01 * k, 0]))
    return poses


def _splat_map(refined: bool) -> SplatMap:
    """A wall of splats 2 units in front of the cameras, redder after the refinement."""
    x, y = np.meshgrid(np.linspace(-3, 3, 40), np.linspace(-2, 2, 30))
    n = x.size
    keyframes = np.arange(0, N, 3)
    world_from_cam = _poses()[keyframes]
    world_from_cam[:, :3, 3] += ORIGIN
    return SplatMap(
        refined=refined,
        iterations=100,
        kernel="gaussian",
        origin=ORIGIN,
        means=np.stack([x.ravel(), y.ravel(), np.full(n, 2.0)], axis=1).astype(np.float32),
        log_scales=np.full((n, 3), np.log(0.1), np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        opacity_logits=np.full(n, 4.0, np.float32),
        sh=np.tile(np.array([[(0.8 if refined else 0.4) - 0.5, -0.3, -0.3]], np.float32) / 0.2820948, (n, 1, 1)),
        betas=np.full(n, 2.0, np.float32),
        anchors=np.zeros(n, np.int64),
        keyframes=keyframes,
        world_from_cam=world_from_cam,
        scale=np.ones(len(keyframes)),
        exposures=np.tile(np.eye(3, 4, dtype=np.float32), (len(keyframes), 1, 1)),
    )


@pytest.fixture
def evaluator(tmp_path: Path) -> Evaluator:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    poses = _poses()
    for k in range(N):
        true_pose = poses[k].copy()
        true_pose[:3, 3] *= 1 / SCALE
        image = np.full((H, W, 3), (204, 51, 51), np.uint8)
        depth = np.full((H, W), 4.0, np.float32)
        assert not list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, true_pose, depth)))
    return node


def _feed(node: Evaluator, lost: tuple[int, ...] = (), upstream: dict[str, Any] | None = None) -> dict[str, Any]:
    world_from_cam = _poses()
    world_from_cam[:, :3, 3] += ORIGIN
    state = np.zeros(N, np.uint8)
    for k in lost:
        state[k], world_from_cam[k] = TrackingState.LOST, np.nan
    index = np.arange(N)
    keyframe = (index % 3 == 0) & (state == 0)
    list(node.on_trajectory(Trajectory(index, index / 30, world_from_cam, keyframe, state, np.zeros(N, np.int32))))
    depth = np.full((H // 2, W // 2), 2.0, np.float32)
    image = np.zeros((H, W, 3), np.uint8)
    normals = np.zeros((H // 2, W // 2, 3), np.float32)
    view = FusedKeyframe(3, 0.1, image, INTRINSICS, world_from_cam[3], 1.0, depth, np.ones_like(depth), normals, 0)
    list(node.on_fused_keyframe(view))
    for refined in (False, True):
        list(node.on_splat_map(_splat_map(refined)))
    node.upstream |= upstream or {
        "tracker": {"seconds": {"flow": 1.5}, "peak_bytes": 5, "skipped": {"frames": 2}, "warnings": ["w"]}
    }
    list(node.on_end())
    assert node.folder is not None
    report: dict[str, Any] = json.loads((node.folder / "report.json").read_text())
    return report


def test_report(evaluator: Evaluator) -> None:
    report = _feed(evaluator)
    after, before = report["rendering"], report["rendering_before_refinement"]
    assert after["keyframes"]["count"] == 4
    assert after["held_out"]["count"] == 2  # frames 5 and 10; 0 is a keyframe
    assert after["all"]["count"] == N
    assert after["keyframes"]["psnr"] > 35 > 15 > before["keyframes"]["psnr"]  # the far origin costs no precision
    assert after["all"]["lpips"] is None
    assert report["trajectory"]["ate_rmse"] == pytest.approx(0, abs=1e-6)
    assert report["trajectory"]["scale"] == pytest.approx(1 / SCALE)
    assert report["trajectory"]["frames_tracked"] == report["trajectory"]["frames"] == N
    assert report["depth"] == {
        "abs_rel": pytest.approx(0, abs=1e-6),
        "inlier_ratio": 1.0,
        "completeness": 1.0,
        "scale_ratio": pytest.approx(1.0),
        "count": 1,
    }
    assert report["map"]["splats"] == 1200
    assert report["time"]["stages"]["tracker"] == {"flow": 1.5}
    assert report["time"]["wall"] > 0
    assert report["memory"]["peak_bytes"]["tracker"] == 5
    assert report["skipped"] == {"tracker": {"frames": 2}}
    assert report["warnings"]["tracker"] == ["w"]


def test_files(evaluator: Evaluator) -> None:
    _feed(evaluator)
    assert evaluator.folder is not None
    assert {p.name for p in evaluator.folder.iterdir()} == {
        "report.json",
        "report.html",
        "comparison.png",
        "trajectory.txt",
    }
    html = (evaluator.folder / "report.html").read_text()
    assert html.count("data:image/jpeg;base64,") == 10  # four of each of the two held-out frames, and a depth map
    assert "http://" not in html  # nothing is fetched
    assert "https://" not in html
    assert len((evaluator.folder / "trajectory.txt").read_text().splitlines()) == N + 1


def test_lost_frames_have_no_pose_and_are_not_scored(evaluator: Evaluator) -> None:
    report = _feed(evaluator, lost=(4, 5))
    assert report["trajectory"]["frames_tracked"] == N - 2
    assert report["rendering"]["all"]["count"] == N - 2
    assert report["rendering"]["held_out"]["count"] == 1


def test_frames_are_rendered_with_the_focal_length_that_the_tracker_found(evaluator: Evaluator) -> None:
    poses, index, none = _poses(), np.arange(N), np.zeros(N, np.int32)
    list(evaluator.on_trajectory(Trajectory(index, index / 30, poses, index < 0, none.astype(np.uint8), none, 1.25)))
    list(evaluator.on_splat_map(_splat_map(True)))
    for view in evaluator.evaluation.scored_frames():
        np.testing.assert_array_equal(view.intrinsics, INTRINSICS * [1.25, 1.25, 1.0, 1.0])
    evaluator.evaluation.close()


def test_the_rolling_shutter_that_the_tracker_took_out_is_applied_to_renders(evaluator: Evaluator) -> None:
    poses, index, none = _poses(), np.arange(N), np.zeros(N, np.int32)
    poses[:, :3, 3] += ORIGIN
    track = Trajectory(index, index / 30, poses, index < 0, none.astype(np.uint8), none, readout_time=0.02)
    list(evaluator.on_trajectory(track))
    list(evaluator.on_splat_map(_splat_map(True)))
    finished, view = evaluator.evaluation.maps[True], evaluator.evaluation.scored_frames()[5]
    assert view.shutter is not None
    assert view.shutter.readout_time == 0.02
    moved = geometry.se3_log(geometry.inverse(poses[4]) @ poses[6])
    np.testing.assert_allclose(view.shutter.velocity, moved * 15, atol=1e-7)
    color = render_frame(finished.splats, finished.kernel, view, (H, W)).color
    still = render_frame(finished.splats, finished.kernel, replace(view, shutter=None), (H, W)).color
    assert np.abs(color - still).max() > 1e-3
    list(evaluator.on_end())
    assert "20.0 ms a frame" in evaluator.report["protocol"]


def test_frames_are_rendered_at_the_trackers_exposure_and_vignetting(evaluator: Evaluator, tmp_path: Path) -> None:
    poses, index, none = _poses(), np.arange(N), np.zeros(N, np.int32)
    poses[:, :3, 3] += ORIGIN
    gains = np.ones(N)
    gains[[2, 3, 5]] = 0.2, 0.5, 0.7
    exposure = (gains[:, None, None] * np.eye(3, 4)).astype(np.float32)
    vignetting = np.array([-0.3, 0.0, 0.0], np.float32)
    list(
        evaluator.on_trajectory(
            Trajectory(
                index, index / 30, poses, index % 3 == 0, none.astype(np.uint8), none, exposure=exposure,
                vignetting=vignetting,
            )
        )
    )  # fmt: skip
    splat_map = _splat_map(True)
    splat_map.exposures[1, :, :3] *= 0.5  # of frame 3; those of frames 0 and 6 are the identity
    list(evaluator.on_splat_map(splat_map))
    finished, views = evaluator.evaluation.maps[True], evaluator.evaluation.scored_frames()
    factor = vignetting_factor(vignetting, INTRINSICS, (H, W))[..., None]
    for frame in (0, 2, 3, 5, 6):
        view = views[frame]
        bare = replace(view, exposure=None, vignetting=None)
        color, plain = (render_frame(finished.splats, finished.kernel, v, (H, W)).color for v in (view, bare))
        np.testing.assert_allclose(color, gains[frame] * plain * factor, atol=1e-5)
    list(evaluator.on_end())
    assert "each frame's exposure and its vignetting as the tracker estimated" in evaluator.report["protocol"]
    report = json.loads((tmp_path / "report.json").read_text())["exposure"]
    assert report["keyframes"] == list(range(0, N, 3))
    np.testing.assert_allclose(report["gain"][:3], [[1.0] * 3, [0.5] * 3, [1.0] * 3])
    assert report["remainder"] < 1e-6
    np.testing.assert_allclose(report["vignetting"], vignetting)
    assert "Exposure by frame" in (tmp_path / "report.html").read_text()


def test_without_exposures_the_report_speaks_of_none(evaluator: Evaluator, tmp_path: Path) -> None:
    report = _feed(evaluator)
    assert report["exposure"] is None
    assert "tracker estimated" not in report["protocol"]
    assert "Exposure by frame" not in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize("fitted", [True, False])
def test_held_out_frames_are_scored_by_both_protocols(tmp_path: Path, fitted: bool) -> None:
    """Photographs that the map shows but for their exposure; the strict figure is the same with and without fitting."""
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off", fitted=fitted))
    for k in range(N):
        image = np.full((H, W, 3), (150, 40, 45), np.uint8)
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, None, None)))
    report = _feed(node)
    after = report["rendering"]
    assert after["held_out"]["psnr"] == pytest.approx(18.18, abs=0.01)
    assert report["rendering_before_refinement"]["held_out_fitted"]["count"] == 0
    assert all((frame["fitted"] is not None) == (fitted and frame["held_out"]) for frame in after["frames"])
    assert ("held-out, fitted" in (tmp_path / "report.html").read_text()) == fitted
    assert ("ARTDECO" in report["protocol"]) == fitted
    assert (report["time"]["stages"]["evaluator"]["fitting at test time"] > 0) == fitted
    assert after["held_out_fitted"]["count"] == 2 * fitted
    assert not fitted or after["held_out_fitted"]["psnr"] > 40


def test_without_truth_the_figures_are_null(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    for k in range(N):
        image = np.full((H, W, 3), 128, np.uint8)
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, None, None)))
    report = _feed(node)
    assert report["trajectory"]["ate_rmse"] is None
    assert report["depth"]["abs_rel"] is None
    assert any("no true poses" in note for note in report["notes"])
    assert report["rendering"]["keyframes"]["psnr"] is not None


def test_a_run_that_never_made_a_map_still_reports(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    list(node.on_end())
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["rendering"]["all"] == {"psnr": None, "ssim": None, "lpips": None, "count": 0}
    assert report["map"]["splats"] == 0
    assert any("no trajectory" in note for note in report["notes"])


def test_missing_lpips_weights_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="set MVSGS_WEIGHTS to the folder"):
        Evaluator(Evaluator.Config(lpips="on"))
    with pytest.raises(FileNotFoundError, match="set MVSGS_WEIGHTS to the folder"):
        Evaluator.check(Evaluator.Config(lpips="on"))  # before a run
    node = Evaluator(Evaluator.Config(lpips="auto"))
    assert any("LPIPS is left out" in w for w in node.stats.warnings)
    node.evaluation.close()


def test_the_worst_of_all_frames_is_shown_beside_the_held_out(evaluator: Evaluator) -> None:
    """The last frame shows what the map has not: it is no held-out one, and stands in no mean that anybody looks at."""
    spoiled = np.full((H, W, 3), (0, 200, 0), np.uint8)
    list(evaluator.on_ground_truth(GroundTruth(N - 1, (N - 1) / 30, spoiled, INTRINSICS, None, None)))
    report = _feed(evaluator)
    assert report["rendering"]["worst"]["all"]["index"] == N - 1
    assert report["rendering"]["worst"]["held_out"]["index"] in (5, 10)
    assert report["rendering"]["worst"]["all"]["psnr"] < report["rendering"]["worst"]["held_out"]["psnr"] - 10
    assert [frame["index"] for frame in report["rendering"]["frames"]] == list(range(N))
    assert report["rendering"]["coverage"]["count"] == N
    assert report["rendering"]["coverage"]["mean"] > 0.9
    assert evaluator.folder is not None
    html = (evaluator.folder / "report.html").read_text()
    assert f"worst of all {N} frames scored: {N - 1} (between keyframes)" in html
    assert "pixels covered by the map, of 12 frames" in html


def test_no_picture_is_shown_twice_where_few_frames_are_held_out(evaluator: Evaluator) -> None:
    report = _feed(evaluator, lost=(5,))
    assert report["rendering"]["held_out"]["count"] == 1
    assert any("1 of the 11 frames scored are held out" in note for note in report["notes"])
    assert evaluator.folder is not None
    html = (evaluator.folder / "report.html").read_text()
    assert html.count("held-out frame: 10 (held out)") == 1
    assert "only held-out frame: 10" in html


def test_held_out_frames_that_became_keyframes_are_named(evaluator: Evaluator) -> None:
    assert _feed(evaluator)["trajectory"]["held_out_keyframes"] == [0]


def test_frames_without_a_pose_are_counted_by_state(evaluator: Evaluator) -> None:
    trajectory = _feed(evaluator, lost=(0, 1, 7))["trajectory"]
    assert trajectory["frames_without_pose"] == {"lost": 3}
    assert (trajectory["first_tracked"], trajectory["last_tracked"]) == (2, N - 1)


def test_the_report_says_that_the_run_finished(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off", input="tum walk"))
    (tmp_path / "report.json").write_text('{"finished": false}')  # as the launcher leaves it at the start
    report = _feed(node)
    assert report["finished"] is True
    assert report["input"] == "tum walk"
    assert report["date"]
    assert "tum walk" in (tmp_path / "report.html").read_text()


def test_a_report_that_cannot_be_written_leaves_the_one_before(
    evaluator: Evaluator, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert evaluator.folder is not None
    before = '{"finished": false}'
    (evaluator.folder / "report.json").write_text(before)

    def full(path: Path, *_: object, **__: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space left"):
        _feed(evaluator)
    assert [p.name for p in evaluator.folder.iterdir()] == ["report.json"]
    assert (evaluator.folder / "report.json").read_text() == before


def test_what_other_nodes_say_is_shown_whatever_its_form(evaluator: Evaluator) -> None:
    evaluator.upstream = {"mvs": {"warnings": "(5000 entries left out)", "seconds": "fast", "peak_bytes": None}}
    report = _feed(evaluator, upstream={"mapper": {"values": {"nothing": "no splats: all depth was rejected"}}})
    assert report["warnings"]["mvs"] == ["(5000 entries left out)"]
    assert report["nothing"] == {"mapper": "no splats: all depth was rejected"}
    assert evaluator.folder is not None
    html = (evaluator.folder / "report.html").read_text()
    assert "mvs: (5000 entries left out)" in html
    assert "mapper: no splats: all depth was rejected" in html


def test_the_report_is_json_where_a_figure_is_not_finite(evaluator: Evaluator) -> None:
    """A render equal to its photograph has a PSNR without bound."""
    _feed(evaluator, upstream={"tracker": {"counts": {"frames": float("nan"), "keyframes": 4}}})
    assert evaluator.folder is not None

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    report = json.loads((evaluator.folder / "report.json").read_text(), parse_constant=refuse)
    assert report["counts"] == {"tracker": {"keyframes": 4}}


def test_a_resumed_run_is_reported_of_its_keyframes_alone(tmp_path: Path) -> None:
    """Its source knows keyframes only: no true pose, no depth, no frame between."""
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    index = np.arange(0, N, 3)
    image = np.full((H, W, 3), (204, 51, 51), np.uint8)
    world_from_cam = _poses()[index]
    world_from_cam[:, :3, 3] += ORIGIN
    for k in index:
        list(node.on_ground_truth(GroundTruth(int(k), k / 30, image, INTRINSICS, None, None)))
    none = np.zeros(len(index), np.int32)
    keyframe = np.ones(len(index), bool)
    list(node.on_trajectory(Trajectory(index, index / 30, world_from_cam, keyframe, none.astype(np.uint8), none)))
    list(node.on_splat_map(_splat_map(True)))
    list(node.on_end())
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["rendering"]["keyframes"]["count"] == 4
    assert report["rendering"]["keyframes"]["psnr"] > 35
    assert report["rendering"]["held_out"]["count"] == 0
    assert report["trajectory"]["frames_tracked"] == 4
    assert any("no renders before refinement" in note for note in report["notes"])
    assert "0 of the 4 frames scored are held out" in " ".join(report["notes"])
    assert (tmp_path / "comparison.png").exists()


def test_without_any_frame_the_map_is_scored_on_what_was_mapped(tmp_path: Path) -> None:
    """A source that sends no GroundTruth, as a robot in a hurry: the keyframes' own images remain."""
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    report = _feed(node)
    assert report["rendering"]["all"]["count"] == 1  # the one FusedKeyframe
    assert report["rendering"]["frames"][0]["index"] == 3


def test_nothing_is_scored_nor_kept_with_max_frames_0(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off", max_frames=0))
    for k in range(N):
        image = np.full((H, W, 3), 128, np.uint8)
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, _poses()[k], None)))
    report = _feed(node)
    assert report["frames_on_disk"]["bytes"] == 0
    assert report["rendering"]["all"]["count"] == 0
    assert report["trajectory"]["ate_rmse"] == pytest.approx(0, abs=1e-6)
    assert report["notes"] == []


def test_a_full_disk_costs_frames_and_not_the_report(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    with full_after(500):
        for k in range(N):
            image = np.random.default_rng(k).integers(0, 256, (H, W, 3), np.uint8)
            list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, None, None)))
    report = _feed(node)
    assert report["rendering"]["all"]["count"] == 6  # the last five, and the keyframe's own image
    assert any("other frames could not be kept" in note for note in report["notes"])


@pytest.mark.parametrize(
    "wrong", [{"max_frames": -1}, {"max_bytes": 0.0}, {"max_bytes": float("nan")}, {"lpips": "no"}]
)
def test_parameters_that_mean_nothing_are_refused_before_a_run(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Evaluator.check(build(Evaluator.Config, wrong))
    Evaluator.check(Evaluator.Config())


def test_weights_that_are_damaged_cost_lpips_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("lpips_squeezenet1_1_features.pth", "squeeze.pth"):
        (tmp_path / name).write_bytes(b"no weights")
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path))
    node = Evaluator(Evaluator.Config(lpips="auto"))
    assert any("LPIPS is left out" in w for w in node.stats.warnings)
    with pytest.raises(ValueError, match="lpips_squeezenet1_1_features"):
        Evaluator(Evaluator.Config(lpips="on"))
