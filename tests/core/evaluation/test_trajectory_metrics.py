from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

from mvsgs_core import geometry, trajectory_file
from mvsgs_core.bad_file import BadFileError
from mvsgs_core.evaluation import trajectory_metrics


def _trajectories(n: int = 60, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A smooth true trajectory, and an estimate in another frame, at another scale, with noise."""
    rng = np.random.default_rng(0)
    truth = np.tile(np.eye(4), (n, 1, 1))
    for k in range(1, n):
        twist = np.concatenate([[0.05, 0.01 * np.sin(k / 5), 0.02], 0.03 * rng.standard_normal(3)])
        truth[k] = truth[k - 1] @ geometry.se3_exp(twist)
    move = geometry.se3_exp(np.array([1.0, -2.0, 0.5, 0.3, -0.7, 1.1]))
    estimate = move @ truth
    estimate[:, :3, 3] = 0.37 * estimate[:, :3, 3] + 0.002 * rng.standard_normal((n, 3))
    estimate[:, :3, :3] = estimate[:, :3, :3] @ geometry.so3_exp(0.01 * rng.standard_normal((n, 3)))
    truth[:, :3, 3] += offset
    return estimate, truth


def _evo(poses: np.ndarray) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(poses), timestamps=np.arange(len(poses), dtype=float))


def test_agrees_with_evo() -> None:
    estimate, truth = _trajectories()
    alignment = trajectory_metrics.align(estimate, truth)
    ours = trajectory_metrics.rmse(trajectory_metrics.absolute_errors(estimate, truth, alignment))
    reference, aligned = _evo(truth), _evo(estimate)
    _, _, scale = aligned.align(reference, correct_scale=True)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    assert ours == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)
    assert alignment.scale == pytest.approx(scale, rel=1e-9)
    move, turn = trajectory_metrics.relative_errors(estimate, truth, alignment.scale)
    for relation, value in (
        (metrics.PoseRelation.translation_part, move),
        (metrics.PoseRelation.rotation_angle_deg, turn),
    ):
        rpe = metrics.RPE(relation, delta=1, all_pairs=True)
        rpe.process_data((reference, aligned))
        assert value == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)


def test_far_origin_changes_nothing() -> None:
    errors = []
    for offset in (0.0, 1e6):
        estimate, truth = _trajectories(offset=offset)
        errors.append(
            trajectory_metrics.rmse(
                trajectory_metrics.absolute_errors(estimate, truth, trajectory_metrics.align(estimate, truth))
            )
        )
    assert errors[1] == pytest.approx(errors[0], rel=1e-4)


def test_a_mirrored_estimate_is_not_aligned_by_a_reflection() -> None:
    estimate, truth = _trajectories()
    mirrored = estimate.copy()
    mirrored[:, 0, 3] *= -1
    alignment = trajectory_metrics.align(mirrored, truth)
    assert np.linalg.det(alignment.rotation) == pytest.approx(1.0)


def test_no_alignment_is_an_error() -> None:
    estimate, truth = _trajectories()
    with pytest.raises(ValueError, match="at least 3"):
        trajectory_metrics.align(estimate[:2], truth[:2])
    for place in (1.0, 0.1, 1e6 + 0.1):
        still = estimate.copy()
        still[:, :3, 3] = place
        with pytest.raises(ValueError, match="the estimated poses do not move: their positions coincide"):
            trajectory_metrics.align(still, truth)
        with pytest.raises(ValueError, match="the true poses do not move"):
            trajectory_metrics.align(estimate, still)


def test_tum_files_round_trip_and_evo_reads_them(tmp_path: Path) -> None:
    estimate, _ = _trajectories()
    times = np.arange(len(estimate)) / 30 + 1305031102.0
    trajectory_file.write_trajectory(tmp_path / "t.txt", times, estimate)
    read_times, read = trajectory_file.read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(read_times, times, atol=1e-6)
    np.testing.assert_allclose(read, estimate, atol=1e-7)
    theirs = file_interface.read_tum_trajectory_file(str(tmp_path / "t.txt"))
    np.testing.assert_allclose(np.array(theirs.poses_se3), estimate, atol=1e-7)
    (tmp_path / "bad.txt").write_text("1 2 3\n")
    with pytest.raises(ValueError, match=r"bad\.txt has a line 1 that is not `timestamp tx"):
        trajectory_file.read_trajectory(tmp_path / "bad.txt")


def test_tum_files_keep_micrometres_far_from_the_origin(tmp_path: Path) -> None:
    """As of a map in the coordinates of UTM."""
    poses, _ = _trajectories()
    poses[:, :3, 3] += [467123.0, 5412345.0, 312.0]
    trajectory_file.write_trajectory(tmp_path / "t.txt", np.arange(len(poses)) / 30, poses)
    _, read = trajectory_file.read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(read[:, :3, 3], poses[:, :3, 3], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("time", ["1403636579763555584", "1403636579763.5", "-1e15"])
def test_times_that_are_no_seconds_are_refused(tmp_path: Path, time: str) -> None:
    (tmp_path / "t.txt").write_text(f"0.5 1 0 0 0 0 0 1\n{time} 1 0 0 0 0 0 1\n")
    with pytest.raises(BadFileError, match=rf"t\.txt has a line 2 whose time, {time}, is not in seconds: divide"):
        trajectory_file.read_trajectory(tmp_path / "t.txt")


def test_one_time_that_is_no_seconds_is_damage(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("".join(f"{t} 1 0 0 0 0 0 1\n" for t in ("0.1", "9e15", "0.3")))
    np.testing.assert_allclose(trajectory_file.read_trajectory(tmp_path / "t.txt")[0], [0.1, 0.3])
