"""A run that is over, read from its folder: its map at the frames that it was scored on, rendered as they were scored.

It reads what a run with `recorder=track` leaves: config.yaml, track.json, map.ply, cameras.json and report.json. A run
of an earlier checkout, too, where what it lacks can be had otherwise.
"""

from __future__ import annotations

import json
import re
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from msgs import GroundTruth
from mvsgs_core import image_metrics
from mvsgs_core.evaluation import scoring
from mvsgs_core.evaluation.evaluation import Evaluation
from mvsgs_core.evaluation.fitted_camera import fit_camera
from mvsgs_core.evaluation.straight import undistortion
from mvsgs_core.export.cameras import read_cameras
from mvsgs_core.export.ply import read_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.held_out import is_held_out
from mvsgs_core.trajectory import TrackingState, Trajectory
from nodes.parameters import parameter_names
from nodes.reader import Reader

TOLERANCE = 0.5  # dB between the mean of the renders made here and what the report of an earlier evaluator says of them


class FinishedRun:
    """One run's map, trajectory and held-out frames."""

    def __init__(self, folder: Path, frames: dict[int, GroundTruth]) -> None:
        """Raises FileNotFoundError for a folder that lacks some of it, and ValueError where what is rendered is not
        what the report says: a picture of it would show something else than was scored."""
        self.folder = folder
        self.report: dict[str, Any] = json.loads((folder / "report.json").read_text())
        track = json.loads((folder / "track.json").read_text())
        self.trajectory = trajectory_of(track, self.report, frames)
        self.map = snapshot_of(folder, self.trajectory)
        with closing(Evaluation(len(frames), np.inf)) as evaluation:
            for frame in frames.values():
                evaluation.add_frame(frame.index, frame.image, frame.intrinsics, None, None)
            evaluation.trajectory = self.trajectory
            evaluation.add_map(self.map, True)
            scored = evaluation.scored_frames(True)
        self._scored = {f.index: f for f in scored if not f.keyframe and is_held_out(f.index)}
        self._frames = frames
        self.psnr = {index: self._score(index) for index in self._scored}
        found, said = float(np.mean(list(self.psnr.values()))), self.report["rendering"]["held_out"]["psnr"]
        if said is None or not abs(found - said) <= TOLERANCE:
            raise ValueError(f"{folder}: held-out frames are rendered at {found:.2f} dB, the report says {said}")

    def held_out(self) -> list[int]:
        """The worst first."""
        return sorted(self.psnr, key=lambda index: self.psnr[index])

    def photograph(self, index: int) -> np.ndarray:
        """(H, W, 3) uint8 of a held-out frame, without the distortion that the tracker found."""
        frame = self._frames[index]
        size = frame.image.shape[0], frame.image.shape[1]
        lens = undistortion(self.trajectory, frame.intrinsics, size)
        return frame.image if lens is None else lens.image(frame.image)

    def render(self, index: int) -> scoring.Rendered:
        """A held-out frame as it was scored."""
        size = self.photograph(index).shape[:2]
        return scoring.render_frame(self.map.splats, self.map.kernel, self._scored[index], size)

    def fitted(self) -> dict[str, float]:
        """Mean figures of the held-out frames by the other protocol: with their cameras fitted at test time."""
        found = [fit_camera(self.map.splats, self.map.kernel, self._frame(index)) for index in self._scored]
        figures = [scoring.score_frame(self.map.splats, self.map.kernel, frame).figures for frame in found]
        return {key: float(np.mean([f[key] for f in figures])) for key in ("psnr", "ssim")}

    def _frame(self, index: int) -> scoring.ScoredFrame:
        return replace(self._scored[index], photograph=lambda: self.photograph(index))

    def _score(self, index: int) -> float:
        photograph = self.photograph(index).astype(np.float32) / 255.0
        return float(image_metrics.psnr(self.render(index).color, photograph))


def frames_of(folder: Path) -> dict[int, GroundTruth]:
    """The frames that a run in `folder` got, by index."""
    config = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
    assert isinstance(config, dict)
    return read_frames(config["dataset"])


def read_frames(settings: dict[str, Any]) -> dict[int, GroundTruth]:
    """Frames by index, as a reader with these settings, those it does not know left out, gives them."""
    known = {str(k): v for k, v in settings.items() if k in parameter_names(Reader.Config)}
    messages = Reader(Reader.Config(**known)).run()
    return {message.index: message for message in messages if isinstance(message, GroundTruth)}


def trajectory_of(track: dict[str, Any], report: dict[str, Any], frames: dict[int, GroundTruth]) -> Trajectory:
    """What the recorder wrote; what an earlier one left out, from the frames and the report."""
    known: dict[str, Any] = {f.name: track[f.name] for f in fields(Trajectory) if f.name in track}
    known = {name: _array(value) if isinstance(value, list) else value for name, value in known.items()}
    posed = np.isfinite(known["world_from_cam"]).all(axis=(1, 2))
    rest = {
        "timestamp": np.array([frames[i].timestamp for i in track["index"]]),
        "state": np.where(posed, TrackingState.TRACKED, TrackingState.LOST).astype(np.uint8),
        **_told_readout(report),
    }
    return Trajectory(**{**rest, **known})


def snapshot_of(folder: Path, trajectory: Trajectory) -> Snapshot:
    """map.ply with the keyframes of cameras.json, or where there is none those of the trajectory."""
    splats = read_ply(folder / "map.ply")
    if (folder / "cameras.json").exists():
        cameras = read_cameras(folder / "cameras.json")
        index, poses, exposures = cameras.keyframes, cameras.world_from_cam, cameras.exposures
    else:
        mapped = trajectory.keyframe & trajectory.main()
        index, poses = trajectory.index[mapped], trajectory.world_from_cam[mapped]
        exposures = np.tile(np.eye(3, 4), (len(index), 1, 1))
    steady = np.array_equal(exposures, np.broadcast_to(np.eye(3, 4), exposures.shape))  # the map was made without
    return replace(
        splats, keyframes=index, world_from_cam=poses, scale=np.ones(len(index)),
        exposures=exposures.astype(np.float32), vignetting=None if steady else trajectory.vignetting,
    )  # fmt: skip


def _array(values: list[Any]) -> np.ndarray | None:
    """(N, ...), NaN where a row is null; None where all are."""
    rows = [value for value in values if value is not None]
    if not rows:
        return None
    unknown = np.full(np.shape(rows[0]), np.nan)
    return np.array([unknown if value is None else value for value in values])


def _told_readout(report: dict[str, Any]) -> dict[str, Any]:
    """The rolling shutter, as the protocol in the report says it; none where it says nothing of one."""
    found = re.search(r"\(([\d.]+) ms a frame(?:, the (first|last) (row|column) first)?\)", report.get("protocol", ""))
    if found is None:
        return {}
    seconds, end, line = found.groups()
    return {"readout_time": (-1e-3 if end == "last" else 1e-3) * float(seconds), "reads_columns": line == "column"}
