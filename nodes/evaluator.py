"""Scores a run and writes the report: report.json, report.html, comparison.png and trajectory.txt."""

from __future__ import annotations

import json
import math
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from msgs import FusedKeyframe, GroundTruth, SplatMap, Trajectory
from mvsgs_core import given_frame, machine, trajectory, weights
from mvsgs_core.atomic_file import replace_text, replacing
from mvsgs_core.camera import told_readout_time
from mvsgs_core.evaluation import html, pictures, statistics
from mvsgs_core.evaluation.evaluation import Evaluation
from mvsgs_core.evaluation.lpips import Lpips
from mvsgs_core.evaluation.origin import origin
from mvsgs_core.evaluation.trajectory_metrics import ALIGNED, known_poses
from mvsgs_core.georeference import FILE as GEOREFERENCE
from mvsgs_core.georeference import Georeference, NoReferenceError, georeference, values_of, write_georeference
from mvsgs_core.given_frame import GivenFrame, NoFrameError
from mvsgs_core.held_out import HELD_OUT_EVERY
from mvsgs_core.passwords import without_passwords
from mvsgs_core.trajectory_file import write_trajectory
from nodes import Node
from nodes.splat_map import snapshot_of


class Evaluator(Node):
    """GroundTruth, FusedKeyframe, Trajectory and SplatMap -> report files in `output`; sends nothing."""

    reports = True

    @dataclass
    class Config:
        output: str | None = None  # folder for report.json, report.html, trajectory.txt; none are written if null
        title: str = "MVS-GS run"
        input: str = ""  # what was mapped, for the report
        max_frames: int = 200  # frames scored at most, keyframes, held-out and others evenly; 0: no scoring
        max_bytes: float = 2e9  # of images and depth maps that wait on disk to be scored
        lpips: Literal["auto", "on", "off"] = "auto"  # auto: if its weights are found; on: an error if they are not
        # GPS of a path along a line does not tell the rotation about it: take it from cameras that were held upright
        camera_up: bool = False
        fitted: bool = True  # score held-out frames also with pose and exposure fitted to them at test time

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self.check(self.config)
        folder = Path(self.config.output) if self.config.output else None
        if folder:
            folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._lpips = self._load_lpips()
        given = {"lpips": self._lpips.compare} if self._lpips else {}
        self.evaluation = Evaluation(
            self.config.max_frames, self.config.max_bytes, given, folder, self.config.fitted,
            scored=partial(self.stats.count, "frames_scored"),
        )  # fmt: skip
        self.report: dict[str, Any] = {}

    @classmethod
    def check(cls, config: Config) -> None:
        if config.lpips == "on":
            weights.find("lpips_squeeze_trunk")
            weights.find("lpips_squeeze_head")
        if config.max_frames < 0:
            raise ValueError(f"max_frames={config.max_frames}: frames to be scored at most, 0 for none")
        if not config.max_bytes > 0:
            raise ValueError(f"max_bytes={config.max_bytes}: bytes on disk, more than 0; max_frames=0 keeps no frame")

    def on_ground_truth(self, truth: GroundTruth) -> Iterator[None]:
        self.evaluation.add_frame(
            truth.index, truth.image, truth.intrinsics, truth.world_from_cam, truth.depth, truth.mask
        )
        yield from ()

    def on_fused_keyframe(self, view: FusedKeyframe) -> Iterator[None]:
        self.evaluation.add_keyframe(view.index, view.image, view.intrinsics, view.depth, view.scale, view.mask)
        yield from ()

    def on_trajectory(self, message: Trajectory) -> Iterator[None]:
        self.evaluation.trajectory = trajectory.Trajectory(**vars(message))
        yield from ()

    def on_splat_map(self, splat_map: SplatMap) -> Iterator[None]:
        self.evaluation.add_map(snapshot_of(splat_map), splat_map.refined)
        yield from ()

    def on_end(self) -> Iterator[None]:
        with self.stats.time("scoring"):
            self.report = self.evaluation.report()
        self.stats.seconds["fitting at test time"] = self.evaluation.fitting
        self.stats.seconds["scoring"] -= self.evaluation.fitting
        placed, given = self._georeference(), self._given_frame()
        self._add_statistics()
        for note in self.report["notes"]:
            self.stats.warn(note)
        self.report = without_passwords(self.report)
        if self.folder:
            self._write(self.folder, placed, given)
        self.evaluation.close()
        yield from ()

    def _georeference(self) -> Georeference | None:
        """Where the map lies, where frames have a place; None, and said why, where they do not tell."""
        track = self.evaluation.final_trajectory
        if track is None or track.places is None:
            return None
        placed = track.main(self.evaluation.keyframes) & np.isfinite(track.places).all(axis=1)
        try:
            found = georeference(track.world_from_cam[placed], track.places[placed], self.config.camera_up)
        except NoReferenceError as error:
            self.stats.warn(f"GPS does not tell where the map lies: {error}")
            self.report["georeference"] = None
            return None
        self.report["georeference"] = values_of(found)
        if found.outliers:
            self.stats.warn(
                f"GPS places that do not fit the trajectory, left out: {found.outliers} of {found.positions}, off by "
                f"up to {found.farthest:.0f} m; where they follow each other, GPS drifted or the trajectory is bent"
            )
        return found

    def _given_frame(self) -> GivenFrame | None:
        """Where the map lies in the frame of poses that came with the frames; None, and said why, where they do not
        tell."""
        track = self.evaluation.final_trajectory
        if track is None or not self.evaluation.truth:
            return None
        poses = known_poses(track, self.evaluation.truth, self.evaluation.keyframes)
        try:
            found = given_frame.given_frame(poses.estimate, poses.truth)
        except NoFrameError as error:
            self.stats.warn(f"the poses that came with the frames do not tell where the map lies: {error}")
            self.report["given_frame"] = None
            return None
        self.report["given_frame"] = given_frame.values_of(found)
        return found

    def _load_lpips(self) -> Lpips | None:
        if self.config.lpips == "off":
            return None
        try:
            return Lpips(weights.find("lpips_squeeze_trunk"), weights.find("lpips_squeeze_head"))
        except (FileNotFoundError, ValueError) as error:
            if self.config.lpips == "on":
                raise
            self.stats.warn(f"LPIPS is left out: {error}")
            return None

    def _add_statistics(self) -> None:
        own = {
            "seconds": self.stats.seconds,
            "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
            "warnings": self.stats.warnings.lines(),
        }
        said = statistics.collected({**self.upstream, "evaluator": own})
        self.report["time"] |= said.pop("time")
        self.report["notes"] += said.pop("notes", [])
        self.report |= said
        self.report |= {
            "finished": True,
            "date": time.strftime("%Y-%m-%d %H:%M:%S %Z"),
            "version": machine.version(),
            "input": self.config.input.strip(),
            "run": origin(self.folder, self.evaluation.size, self.evaluation.trajectory, self.upstream),
        }
        self.report["protocol"] = (
            "Scored at native resolution; strict: nothing is fitted to a scored frame, exposure neither. "
            f"{_fitted(self.report)}"
            f"Keyframes are training views; held-out: every {HELD_OUT_EVERY}th frame after the first that is no "
            "keyframe. Covered: pixels at which the render is more than half opaque. "
            f"LPIPS: {'v0.1, SqueezeNet trunk' if self._lpips else 'not computed'}. "
            f"{_shutter(self.evaluation.trajectory)}{_exposure(self.report['exposure'])}"
            f"{_masked(self.evaluation.masked)}{_aligned(self.report['trajectory'])}"
        )

    def _write(self, folder: Path, placed: Georeference | None, given: GivenFrame | None) -> None:
        """Each file in one step; the room that the frames took on disk is given back before.

        report.json comes last: it says that the run has finished, and then nobody goes on with it.
        """
        comparisons = pictures.comparisons(self.evaluation)
        document = html.page(
            self.config.title,
            self.report,
            comparisons,
            pictures.depth_maps(self.evaluation),
            pictures.plots(self.evaluation, self.report["time"]["stages"]),
        )
        self.evaluation.close()
        replace_text(folder / "report.html", document)
        found = self.evaluation.final_trajectory
        if found is not None and self.evaluation.trajectory is not None:  # else the mapper's stays, which has times
            with replacing(folder / "trajectory.txt") as aside:
                shown = found.main(self.evaluation.keyframes)  # other parts have other frames of reference
                write_trajectory(aside, found.timestamp[shown], found.world_from_cam[shown])
        if comparisons:
            with replacing(folder / "comparison.png") as aside:
                pictures.write_sheet(aside, comparisons)
        if placed is not None:
            write_georeference(folder / GEOREFERENCE, placed)
        if given is not None:
            given_frame.write_given_frame(folder / given_frame.FILE, given)
        replace_text(folder / "report.json", json.dumps(_plain(self.report), indent=1, allow_nan=False))


def _fitted(report: dict[str, Any]) -> str:
    if not report["rendering"]["held_out_fitted"]["count"]:
        return ""
    return (
        "Fitted: a held-out frame's pose and color affine, and nothing else, are fitted to it on the finished map "
        "(least squares), as ARTDECO, PLANING and OnTheFly-NVS score. "
    )


def _shutter(found: trajectory.Trajectory | None) -> str:
    if found is None or found.readout_time == 0.0:
        return ""
    told = told_readout_time(found.readout_time, " a frame", found.reads_columns)
    return f"Renders are as the camera's rolling shutter saw them ({told}). "


def _exposure(found: dict[str, Any] | None) -> str:
    if found is None:
        return ""
    vignetting = "" if found["vignetting"] is None else " and its vignetting"
    return f"Renders have each frame's exposure{vignetting} as the tracker estimated it from matches to keyframes. "


def _masked(parts: list[float]) -> str:
    if not parts:
        return ""
    return (
        f"Of {len(parts)} frames, masks leave out {100 * np.mean(parts):.1f} % of the pixels: figures are of the rest. "
    )


def _aligned(found: dict[str, Any]) -> str:
    if found["ate_rmse"] is None and found["ate_rmse_frames"] is not None:
        return f"ATE: all frames are aligned (Sim(3)), as fewer than {ALIGNED} keyframes have a true pose: RMSE of all."
    return "ATE: RMSE of keyframe positions after Sim(3) alignment."


def _plain(value: Any) -> Any:
    """The report as JSON can hold it: what is not finite becomes null."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
