"""Scores a run and writes the report: report.json, report.html, comparison.png and trajectory.txt."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from msgs import GroundTruth, SplatMap, Trajectory, View
from mvsgs_core import weights
from mvsgs_core.evaluation import html, pictures, trajectory
from mvsgs_core.evaluation.evaluation import Evaluation, FinishedMap, Track
from mvsgs_core.evaluation.lpips import Lpips
from mvsgs_core.splats.exposure import IDENTITY
from mvsgs_core.splats.model import Splats
from nodes import Node


class Evaluator(Node):
    """GroundTruth, View, Trajectory and SplatMap -> report files in `output`; sends nothing."""

    @dataclass
    class Config:
        output: str | None = None  # folder for report.json, report.html, trajectory.txt; none are written if null
        title: str = "MVS-GS run"
        max_frames: int = 200  # frames scored at most, keyframes, held-out and others evenly; 0: no scoring
        lpips: str = "auto"  # "auto": if its weights are found, "off", "on": an error if they are not

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        folder = Path(self.config.output) if self.config.output else None
        if folder:
            folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        lpips = self._load_lpips()
        self.evaluation = Evaluation(self.config.max_frames, lpips, folder)
        self.report: dict[str, Any] = {}

    def on_ground_truth(self, truth: GroundTruth) -> Iterator[None]:
        self.evaluation.add_frame(truth.index, truth.image, truth.intrinsics, truth.world_from_cam, truth.depth)
        yield from ()

    def on_view(self, view: View) -> Iterator[None]:
        self.evaluation.add_depth(view.index, view.depth, view.scale)
        yield from ()

    def on_trajectory(self, track: Trajectory) -> Iterator[None]:
        self.evaluation.track = Track(
            track.index,
            track.timestamp,
            track.world_from_cam,
            track.keyframe,
            track.state,
            track.segment,
            track.focal_factor,
            track.readout,
        )
        yield from ()

    def on_splat_map(self, splat_map: SplatMap) -> Iterator[None]:
        self.evaluation.add_map(_finished(splat_map), splat_map.refined)
        yield from ()

    def on_end(self) -> Iterator[None]:
        with self.stats.time("scoring"):
            self.report = self.evaluation.report()
        self._add_statistics()
        for note in self.report["notes"]:
            self.stats.warn(note)
        if self.folder:
            self._write(self.folder)
        self.evaluation.close()
        yield from ()

    def _load_lpips(self) -> Lpips | None:
        if self.config.lpips not in ("auto", "on", "off"):
            raise ValueError(f"evaluator.lpips={self.config.lpips!r}: it is auto, on or off")
        if self.config.lpips == "off":
            return None
        try:
            return Lpips(weights.find("lpips_squeeze_trunk"), weights.find("lpips_squeeze_head"))
        except FileNotFoundError as error:
            text = f"LPIPS is left out: {error}"
        if self.config.lpips == "on":
            raise FileNotFoundError(text)
        self.stats.warn(text)
        return None

    def _add_statistics(self) -> None:
        own = {
            "seconds": dict(self.stats.seconds),
            "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        }
        everything = {**self.upstream, "evaluator": own}
        time = self.report["time"]
        time["stages"] = {node: dict(s.get("seconds", {})) for node, s in everything.items()}
        time["cpu"] = {node: s["cpu_seconds"] for node, s in everything.items() if "cpu_seconds" in s}
        self.report["memory"] = {"peak_bytes": {n: s["peak_bytes"] for n, s in everything.items() if "peak_bytes" in s}}
        self.report["skipped"] = {n: dict(s["skipped"]) for n, s in everything.items() if s.get("skipped")}
        self.report["counts"] = {n: dict(s["counts"]) for n, s in everything.items() if s.get("counts")}
        warned = {n: list(s["warnings"]) for n, s in everything.items() if s.get("warnings")}
        if self.stats.warnings:
            warned["evaluator"] = list(self.stats.warnings)
        self.report["warnings"] = warned
        self.report["protocol"] = (
            "Scored at native resolution; nothing is fitted to a scored frame, exposure neither. "
            "Keyframes are training views; held-out: every 5th frame that is no keyframe. "
            f"LPIPS: {'v0.1, SqueezeNet trunk' if self.evaluation.lpips else 'not computed'}. "
            f"{_shutter(self.evaluation.track)}{_exposure(self.evaluation.maps)}"
            "ATE: RMSE of keyframe positions after Sim(3) alignment."
        )

    def _write(self, folder: Path) -> None:
        track = self.evaluation.track
        if track is not None:
            trajectory.write_tum(
                folder / "trajectory.txt", track.timestamp[track.posed], track.world_from_cam[track.posed]
            )
        (folder / "report.json").write_text(json.dumps(self.report, indent=1, default=_plain))
        comparisons = pictures.comparisons(self.evaluation)
        if comparisons:
            pictures.write_sheet(folder / "comparison.png", comparisons)
        document = html.page(
            self.config.title,
            self.report,
            comparisons,
            pictures.depth_maps(self.evaluation),
            pictures.plots(self.evaluation, self.report["time"]["stages"]),
        )
        (folder / "report.html").write_text(document)


def _finished(message: SplatMap) -> FinishedMap:
    arrays = (message.means, message.log_scales, message.quaternions, message.opacity_logits, message.sh, message.betas)
    splats = Splats(*(torch.from_numpy(np.array(a, dtype=np.float32)) for a in arrays))
    return FinishedMap(
        splats,
        message.density,
        message.origin,
        message.iterations,
        {int(i): pose for i, pose in zip(message.keyframes, message.world_from_cam)},
        {int(i): float(s) for i, s in zip(message.keyframes, message.scale)},
        sum(a.nbytes for a in arrays),
        {int(i): exposure for i, exposure in zip(message.keyframes, message.exposures)},
    )


def _shutter(track: Track | None) -> str:
    if track is None or track.readout == 0.0:
        return ""
    taken_out = f"{1e3 * track.readout:.1f} ms a frame"
    return f"Renders are rolled with the shutter that the tracker took out of the keyframes ({taken_out}). "


def _exposure(maps: dict[bool, FinishedMap]) -> str:
    affines = [affine for finished in maps.values() for affine in finished.exposures.values()]
    if not affines or np.allclose(affines, IDENTITY):
        return ""
    return "Renders have the exposures that the mapper found for keyframes, in between interpolated in time. "


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"the report holds a {type(value).__name__}")
