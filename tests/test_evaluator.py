"""The evaluator as a node: what a run sends goes in, the report files come out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from launch.summary import summary
from msgs import GroundTruth, Trajectory
from mvsgs_core.camera import resampled
from mvsgs_core.datasets.lens import Lens, Undistortion
from mvsgs_core.georeference import read_georeference
from nodes.evaluator import Evaluator
from nodes.parameters import build
from tests.support.evaluated_wall import (
    INTRINSICS,
    ORIGIN,
    SCALE,
    H,
    N,
    W,
    feed,
    poses_along,
    splat_map_of,
    wall_evaluator,
)
from tests.support.full_disk import full_after


@pytest.fixture
def evaluator(tmp_path: Path) -> Evaluator:
    return wall_evaluator(tmp_path)


def test_report(evaluator: Evaluator) -> None:
    report = feed(evaluator)
    after, before = report["rendering"], report["rendering_before_refinement"]
    assert after["keyframes"]["count"] == 4
    assert after["held_out"]["count"] == 2  # frames 5 and 10
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
    assert "depth is scored of 1 of 4 keyframes: that of the others did not come" in " ".join(report["notes"])
    assert report["map"]["splats"] == 1200
    assert report["map"]["iterations"] == report["map"]["iterations_before_refinement"] == 100  # of both maps here
    assert report["time"]["stages"]["tracker"] == {"flow": 1.5}
    assert report["time"]["wall"] > 0
    assert report["memory"]["peak_bytes"]["tracker"] == 5
    assert report["skipped"] == {"tracker": {"frames": 2}}
    assert report["warnings"]["tracker"] == ["w"]
    assert evaluator.stats.counts["frames_scored"] == 2 * N + after["held_out_fitted"]["count"], "a user waits for them"


def test_what_a_resumed_run_took_is_not_known_and_said(evaluator: Evaluator) -> None:
    """Its keyframes are those of all its parts, and its clock is that of the last one."""
    report = feed(evaluator, upstream={"mapper": {"seconds": {"optimization": 8.0}, "values": {"resumed": "a state"}}})
    assert report["time"]["wall"] is report["time"]["keyframes_per_second"] is None
    assert report["time"]["stages"]["mapper"] == {"optimization": 8.0}
    (note,) = [note for note in report["notes"] if "resumed" in note and "depth" not in note]
    assert note.startswith("the run was resumed: how long it took is not known")
    assert note in evaluator.stats.warnings
    assert evaluator.folder is not None
    html = (evaluator.folder / "report.html").read_text()
    for name in ("wall time, first frame to finished map", "keyframes per second"):
        assert f"<tr><td>{name}</td><td>–</td></tr>" in html
    assert not any(line.startswith("time") for line in summary(evaluator.folder).splitlines())


def test_files(evaluator: Evaluator) -> None:
    feed(evaluator)
    assert evaluator.folder is not None
    assert {p.name for p in evaluator.folder.iterdir()} == {
        "report.json",
        "report.html",
        "comparison.png",
        "trajectory.txt",
        "given_frame.json",
    }
    html = (evaluator.folder / "report.html").read_text()
    assert html.count("data:image/jpeg;base64,") == 10  # four of each of the two held-out frames, and a depth map
    assert "http://" not in html  # nothing is fetched
    assert "https://" not in html
    assert len((evaluator.folder / "trajectory.txt").read_text().splitlines()) == N + 1


def places_along() -> np.ndarray:
    """(N, 3) where GPS has the frames: the unit of the poses is 50 m here, x goes east, y down, z north."""
    x, y, z = 50.0 * poses_along()[:, :3, 3].T + 0.1 * np.random.default_rng(0).standard_normal((3, N))
    degree = np.radians(1.0) * 6378137.0  # at the equator; its meridians are bent by a percent more
    return np.stack([z / degree + 1e-7, x / degree, -y], axis=1)


@pytest.mark.parametrize(
    "last", ["write_trajectory", "pictures.write_sheet", "write_georeference", "given_frame.write_given_frame"]
)
def test_a_report_that_is_there_says_that_the_other_files_are(
    evaluator: Evaluator, monkeypatch: pytest.MonkeyPatch, last: str
) -> None:
    """A run whose report.json says finished is not gone on with: killed before, it makes what is missing."""

    def killed(*given: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(f"nodes.evaluator.{last}", killed)
    with pytest.raises(KeyboardInterrupt):
        feed(evaluator, places=places_along())
    assert evaluator.folder is not None
    assert not (evaluator.folder / "report.json").exists()


def test_with_gps_the_report_and_a_file_say_where_the_map_lies(evaluator: Evaluator) -> None:
    places = places_along()
    places[3] += [0.01, 0.0, 30.0]
    places[7] = np.nan
    report = feed(evaluator, places=places)["georeference"]
    assert (report["positions"], report["outliers"]) == (N - 1, 1)
    assert report["residual"] < 0.5
    assert report["scale"] == pytest.approx(50.0, rel=0.01)
    assert evaluator.folder is not None
    found = read_georeference(evaluator.folder / "georeference.json")
    np.testing.assert_allclose(found.rotation, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=0.1)
    assert "GPS: how sure" in (evaluator.folder / "report.html").read_text()
    assert any("left out: 1 of 11" in warning for warning in evaluator.stats.warnings)


def test_renders_are_compared_with_photographs_without_the_distortion_that_was_found(evaluator: Evaluator) -> None:
    """The same as the tracker's keyframes are, which have none."""
    photograph = np.random.default_rng(0).integers(0, 256, (H, W, 3), dtype=np.uint8)
    list(evaluator.on_ground_truth(GroundTruth(5, 0.2, photograph, INTRINSICS, None, None)))
    index, poses = np.arange(N), poses_along()
    track = Trajectory(index, index / 30, poses, index % 3 == 0, np.zeros(N, np.uint8), np.zeros(N, np.int32), 1.2)
    list(evaluator.on_trajectory(replace(track, distortion=np.array([0.1, 0.02]))))
    list(evaluator.on_splat_map(splat_map_of(True)))
    lens = Undistortion(Lens((36.0, 36.0, 15.5, 11.5), (H, W), (0.1, 0.02, 0.0, 0.0)))
    (scored,) = [frame for frame in evaluator.evaluation.scored_frames() if frame.index == 5]
    np.testing.assert_array_equal(scored.photograph(), lens.image(photograph))
    np.testing.assert_array_equal(evaluator.evaluation.photograph(5), lens.image(photograph))
    np.testing.assert_allclose(scored.intrinsics, lens.intrinsics)
    assert lens.intrinsics[0] > 36.0  # zoomed in, so that no pixel is without a source
    evaluator.evaluation.close()


def test_true_depth_is_scored_at_the_pixels_of_a_keyframe_that_was_resampled(evaluator: Evaluator) -> None:
    """Depth that rises across the image of a camera whose middle has moved by five pixels."""
    own, image = INTRINSICS * [0.9, 0.9, 1.0, 1.0] + [0.0, 0.0, 5.0, 2.0], np.zeros((H, W, 3), np.uint8)
    depth = np.tile(np.arange(W, dtype=np.float32) + 40.0, (H, 1))
    list(evaluator.on_ground_truth(GroundTruth(3, 0.1, image, own, None, depth)))
    ours = resampled(depth, own, INTRINSICS, nearest=True)
    assert ours[0, 0] == depth[0, round(own[2] - 0.9 * INTRINSICS[2])]
    feed(evaluator)
    np.testing.assert_array_equal(evaluator.evaluation._true_depth(3), ours)
    evaluator.evaluation.add_keyframe(3, image, 1.1 * own, depth, 1.0)  # as photographs, which keep their lens
    np.testing.assert_array_equal(evaluator.evaluation._true_depth(3), depth)


def test_gps_that_does_not_tell_is_said(evaluator: Evaluator) -> None:
    report = feed(evaluator, places=np.random.default_rng(0).uniform(0.0, 0.001, (N, 3)))
    assert report["georeference"] is None
    assert any("GPS does not tell where the map lies: " in warning for warning in report["warnings"]["evaluator"])


def test_lost_frames_have_no_pose_and_are_not_scored(evaluator: Evaluator) -> None:
    report = feed(evaluator, lost=(4, 5))
    assert report["trajectory"]["frames_tracked"] == N - 2
    assert report["rendering"]["all"]["count"] == N - 2
    assert report["rendering"]["held_out"]["count"] == 1


def test_without_truth_the_figures_are_null(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    for k in range(N):
        image = np.full((H, W, 3), 128, np.uint8)
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, None, None)))
    report = feed(node)
    assert report["trajectory"]["ate_rmse"] is None
    assert report["depth"]["abs_rel"] is None
    assert any("no true poses" in note for note in report["notes"])
    assert report["rendering"]["keyframes"]["psnr"] is not None


@pytest.mark.parametrize("place", [0.0, 0.1])
def test_true_poses_that_stand_still_align_nothing(tmp_path: Path, place: float) -> None:
    """At .1, which no binary number is, their mean is off by rounding, which is no motion."""
    node, image, depth = wall_evaluator(tmp_path), np.zeros((H, W, 3), np.uint8), np.full((H, W), 4.0, np.float32)
    still = np.eye(4)
    still[:3, 3] = place
    for k in range(N):
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, still, depth)))
    report = feed(node)
    assert report["trajectory"]["ate_rmse"] is None
    assert any("no trajectory error: the true poses do not move" in note for note in report["notes"])
    assert report["depth"]["scale_ratio"] is None
    assert report["depth"]["abs_rel"] == pytest.approx(0, abs=1e-6)


def test_a_run_that_never_made_a_map_still_reports(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off", input="camera rtsp://me:secret@host/2"))
    (tmp_path / "config.yaml").write_text("# mvsgs camera\npath: rtsp://me:secret@host/2\n")
    list(node.on_end())
    assert not [path for path in tmp_path.glob("report.*") if "secret" in path.read_text()]
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["rendering"]["all"] == {"psnr": None, "ssim": None, "lpips": None, "count": 0}
    assert report["map"]["splats"] == 0
    assert report["input"] == "camera rtsp://host/2"
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
    report = feed(evaluator)
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
    report = feed(evaluator, lost=(5,))
    assert report["rendering"]["held_out"]["count"] == 1
    assert any("1 of the 11 frames scored are held out" in note for note in report["notes"])
    assert evaluator.folder is not None
    html = (evaluator.folder / "report.html").read_text()
    assert html.count("held-out frame: 10 (held out)") == 1
    assert "only held-out frame: 10" in html


def test_frames_without_a_pose_are_counted_by_state(evaluator: Evaluator) -> None:
    trajectory = feed(evaluator, lost=(0, 1, 7))["trajectory"]
    assert trajectory["frames_without_pose"] == {"lost": 3}
    assert (trajectory["first_tracked"], trajectory["last_tracked"]) == (2, N - 1)


def test_the_report_says_that_the_run_finished(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off", input="tum walk"))
    (tmp_path / "report.json").write_text('{"finished": false}')  # as the launcher leaves it at the start
    report = feed(node)
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
        feed(evaluator)
    assert [p.name for p in evaluator.folder.iterdir()] == ["report.json"]
    assert (evaluator.folder / "report.json").read_text() == before


def test_what_other_nodes_say_is_shown_whatever_its_form(evaluator: Evaluator) -> None:
    evaluator.upstream = {"mvs": {"warnings": "(5000 entries left out)", "seconds": "fast", "peak_bytes": None}}
    report = feed(evaluator, upstream={"mapper": {"values": {"nothing": "no splats: all depth was rejected"}}})
    assert report["warnings"]["mvs"] == ["(5000 entries left out)"]
    assert report["nothing"] == {"mapper": "no splats: all depth was rejected"}
    assert evaluator.folder is not None
    html = (evaluator.folder / "report.html").read_text()
    assert "mvs: (5000 entries left out)" in html
    assert "mapper: no splats: all depth was rejected" in html


def test_the_report_is_json_where_a_figure_is_not_finite(evaluator: Evaluator) -> None:
    """Of what another node counted."""
    feed(evaluator, upstream={"tracker": {"counts": {"frames": float("nan"), "keyframes": 4}}})
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
    world_from_cam = poses_along()[index]
    world_from_cam[:, :3, 3] += ORIGIN
    for k in index:
        list(node.on_ground_truth(GroundTruth(int(k), k / 30, image, INTRINSICS, None, None)))
    none = np.zeros(len(index), np.int32)
    keyframe = np.ones(len(index), bool)
    list(node.on_trajectory(Trajectory(index, index / 30, world_from_cam, keyframe, none.astype(np.uint8), none)))
    list(node.on_splat_map(splat_map_of(True)))
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
    report = feed(node)
    assert report["rendering"]["all"]["count"] == 1  # the one FusedKeyframe
    assert report["rendering"]["frames"][0]["index"] == 3


def test_nothing_is_scored_nor_kept_with_max_frames_0(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off", max_frames=0))
    for k in range(N):
        image = np.full((H, W, 3), 128, np.uint8)
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, poses_along()[k], None)))
    report = feed(node)
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
    report = feed(node)
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
