"""Collects what a run produces and turns it into the report."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.evaluation import scoring, trajectory
from mvsgs_core.evaluation.depth_metrics import NO_DEPTH, depth_ratios, score_depth
from mvsgs_core.evaluation.exposure import between_keyframes
from mvsgs_core.evaluation.frame_store import FrameStore
from mvsgs_core.evaluation.lpips import Lpips
from mvsgs_core.evaluation.rolling_shutter import Shutter, velocities
from mvsgs_core.splats.model import Splats

NEAR = 0.01  # of the typical depth: splats nearer to a camera are not drawn
TRACKED = 0  # state of a frame whose pose is good; other states are lost, not started, degenerate


@dataclass(frozen=True)
class FinishedMap:
    """The map at one moment, and the keyframe poses that it was optimized with."""

    splats: Splats
    density: str
    origin: np.ndarray  # (3,) world position that the splats' means are relative to
    iterations: int
    keyframe_poses: dict[int, np.ndarray]
    scale: dict[int, float]  # of each keyframe's depths, see msgs.Poses
    bytes: int
    exposures: dict[int, np.ndarray] = field(default_factory=dict)  # (3, 4) color affine of each keyframe

    def typical_depth(self) -> float:
        """Median distance of the splats from the middle of the keyframes, map units; the world's scale is arbitrary."""
        positions = [pose[:3, 3] - self.origin for pose in self.keyframe_poses.values()]
        if not positions or not len(self.splats.means):
            return 1.0
        center = np.median(positions, axis=0)
        return float(np.median(np.linalg.norm(self.splats.means.numpy() - center, axis=1)))


@dataclass(frozen=True)
class Track:
    """All frames that the tracker saw: arrays over N frames."""

    index: np.ndarray
    timestamp: np.ndarray
    world_from_cam: np.ndarray  # (N, 4, 4), NaN without a pose
    keyframe: np.ndarray
    state: np.ndarray
    segment: np.ndarray
    focal_factor: float = 1.0  # on the focal lengths of the frames, where they were guessed
    readout: float = 0.0  # seconds of the rolling shutter

    @property
    def posed(self) -> np.ndarray:
        return np.asarray(np.isfinite(self.world_from_cam).all(axis=(1, 2)))


@dataclass
class Evaluation:
    """Feed it with `add_*` in any order; `report()` needs at least a track."""

    max_frames: int = 200  # frames scored at most; all keyframes count first
    lpips: Lpips | None = None
    folder: Path | None = None  # where frames wait on disk
    started: float | None = None
    mapped: float | None = None
    track: Track | None = None
    maps: dict[bool, FinishedMap] = field(default_factory=dict)  # by `refined`
    scores: dict[bool, list[scoring.Score]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._store = FrameStore(self.folder)
        self._truth: dict[int, np.ndarray] = {}
        self._intrinsics: dict[int, np.ndarray] = {}
        self._depth_scale: dict[int, float] = {}

    def add_frame(
        self,
        index: int,
        image: np.ndarray,
        intrinsics: np.ndarray,
        world_from_cam: np.ndarray | None,
        depth: np.ndarray | None,
    ) -> None:
        if self.started is None:
            self.started = time.perf_counter()
        self._store.put("image", index, image)
        self._intrinsics[index] = intrinsics
        if world_from_cam is not None and np.isfinite(world_from_cam).all():
            self._truth[index] = world_from_cam
        if depth is not None:
            self._store.put("depth", index, depth.astype(np.float32, copy=False))

    def add_depth(self, index: int, depth: np.ndarray, scale: float) -> None:
        """A keyframe's filtered depth map, computed at the map's scale `scale`."""
        self._store.put("filtered", index, depth)
        self._depth_scale[index] = scale

    def add_map(self, finished: FinishedMap, refined: bool) -> None:
        self.maps[refined] = finished
        self.mapped = time.perf_counter()

    def report(self) -> dict[str, Any]:
        """The figures of the run; what could not be computed is null, and `notes` says why."""
        notes: list[str] = []
        alignment, trajectory_report = self._score_trajectory(notes)
        rendering = {refined: self._score_renders(refined, notes) for refined in (True, False)}
        final = self.maps.get(True) or self.maps.get(False)
        wall = None if self.started is None or self.mapped is None else self.mapped - self.started
        keyframes = int(self.track.keyframe.sum()) if self.track is not None else 0
        return {
            "rendering": rendering[True],
            "rendering_before_refinement": rendering[False],
            "trajectory": trajectory_report,
            "depth": self._score_depths(alignment, notes),
            "map": {
                "splats": len(final.splats.means) if final else 0,
                "bytes": final.bytes if final else 0,
                "iterations": final.iterations if final else 0,
                "density": final.density if final else None,
            },
            "time": {
                "wall": wall,
                "keyframes_per_second": keyframes / wall if wall else None,
            },
            "notes": notes,
        }

    def _views(self, finished: FinishedMap) -> list[scoring.View]:
        assert self.track is not None
        views = []
        main = _largest_segment(self.track)
        near = NEAR * finished.typical_depth()
        from_world = np.eye(4)
        from_world[:3, 3] = -finished.origin
        moving = velocities(self.track.timestamp, self.track.world_from_cam, main)
        exposures = self._exposures(finished, main)
        for k in np.flatnonzero(main & np.isin(self.track.index, list(self._intrinsics))):
            index = int(self.track.index[k])
            views.append(
                scoring.View(
                    index,
                    bool(self.track.keyframe[k]),
                    from_world @ finished.keyframe_poses.get(index, self.track.world_from_cam[k]),
                    self._intrinsics[index] * [self.track.focal_factor, self.track.focal_factor, 1.0, 1.0],
                    lambda index=index: self.photograph(index),  # type: ignore[misc]
                    near,
                    Shutter(self.track.readout, moving[k]) if self.track.readout else None,
                    None if exposures is None else exposures[k],
                )
            )
        return views

    def _exposures(self, finished: FinishedMap, main: np.ndarray) -> np.ndarray | None:
        """Color affines (N, 3, 4) of the track's frames, from the map's keyframes; None where the mapper had none."""
        assert self.track is not None
        known = np.flatnonzero(main & np.isin(self.track.index, list(finished.exposures)))
        affines = np.array([finished.exposures[int(i)] for i in self.track.index[known]], dtype=np.float32)
        return between_keyframes(self.track.timestamp, self.track.timestamp[known], affines)

    def photograph(self, index: int) -> np.ndarray:
        image = self._store.get("image", index)
        if image is None:
            raise KeyError(f"frame {index} was never received")
        return image

    def filtered_depth(self, index: int) -> np.ndarray | None:
        return self._store.get("filtered", index)

    def views(self, refined: bool = True) -> list[scoring.View]:
        return self._views(self.maps[refined])

    def _score_renders(self, refined: bool, notes: list[str]) -> dict[str, Any]:
        finished = self.maps.get(refined)
        if finished is None or self.track is None or not len(finished.splats.means):
            which = "after" if refined else "before"
            notes.append(f"no renders {which} refinement were scored: " + ("no map" if not finished else "empty map"))
            return scoring.summarize([])
        views = scoring.choose(self._views(finished), self.max_frames)
        self.scores[refined] = [scoring.score_view(finished.splats, finished.density, v, self.lpips) for v in views]
        return scoring.summarize(self.scores[refined])

    def _score_trajectory(self, notes: list[str]) -> tuple[trajectory.Alignment | None, dict[str, Any]]:
        report: dict[str, Any] = dict.fromkeys(
            ("ate_rmse", "ate_rmse_frames", "ate_percent", "rpe_translation", "rpe_rotation", "path_length", "scale")
        )
        track = self.track
        if track is None:
            notes.append("no trajectory was received")
            return None, {**report, "frames": len(self._intrinsics), "frames_tracked": 0, "keyframes": 0}
        main = _largest_segment(track)
        report |= {
            "frames": len(track.index),
            "frames_tracked": int((track.posed & (track.state == TRACKED)).sum()),
            "keyframes": int(track.keyframe.sum()),
            "segments": len(np.unique(track.segment[track.posed])),
        }
        known = main & np.isin(track.index, list(self._truth))
        estimate, truth = track.world_from_cam[known], self._true_poses(track.index[known])
        is_keyframe = track.keyframe[known]
        try:
            alignment = trajectory.align(estimate[is_keyframe], truth[is_keyframe])
        except ValueError as error:
            notes.append(f"no trajectory error: {error}" if self._truth else "no trajectory error: no true poses")
            return None, report
        errors = trajectory.absolute_errors(estimate, truth, alignment)
        length = trajectory.path_length(truth)
        report |= {
            "ate_rmse": trajectory.rmse(errors[is_keyframe]),
            "ate_rmse_frames": trajectory.rmse(errors),
            "ate_percent": 100 * trajectory.rmse(errors[is_keyframe]) / length if length else None,
            "path_length": length,
            "scale": alignment.scale,
        }
        if len(estimate) > 1:
            report["rpe_translation"], report["rpe_rotation"] = trajectory.relative_errors(
                estimate, truth, alignment.scale
            )
        return alignment, report

    def _true_poses(self, indices: np.ndarray) -> np.ndarray:
        return np.array([self._truth[int(i)] for i in indices], dtype=np.float64).reshape(-1, 4, 4)

    def aligned_paths(self) -> dict[str, np.ndarray]:
        """Camera positions (N, 3) for a plot: "estimate" in the frame of the "truth" where there is one."""
        if self.track is None:
            return {}
        main = _largest_segment(self.track)
        alignment, _ = self._score_trajectory([])
        if alignment is None:
            return {"estimate": self.track.world_from_cam[main][:, :3, 3]}
        known = main & np.isin(self.track.index, list(self._truth))
        return {
            "truth": self._true_poses(self.track.index[known])[:, :3, 3],
            "estimate": alignment.positions(self.track.world_from_cam[main]),
        }

    def _score_depths(self, alignment: trajectory.Alignment | None, notes: list[str]) -> dict[str, float | None]:
        """After one scale for the whole run, the median ratio of true to estimated depth, as is usual for monocular
        depth; `scale_ratio` is that over the trajectory's scale, 1 where poses and depth maps of the truth agree."""
        finished = self.maps.get(True) or self.maps.get(False)
        maps = []
        for index, scale in self._depth_scale.items():
            truth, depth = self._store.get("depth", index), self._store.get("filtered", index)
            if truth is not None and depth is not None:
                maps.append((depth * (finished.scale.get(index, scale) / scale if finished else 1.0), truth))
        ratios = [depth_ratios(depth, truth) for depth, truth in maps]
        known = np.concatenate(ratios) if ratios else np.empty(0)
        if not len(known):
            notes.append("no depth error: no keyframe has both filtered and true depth")
            return {**NO_DEPTH.summary(), "scale_ratio": None}
        scale = float(np.median(known))
        total = sum((score_depth(depth, truth, scale) for depth, truth in maps), NO_DEPTH)
        return {**total.summary(), "scale_ratio": scale / alignment.scale if alignment else None}

    def close(self) -> None:
        self._store.close()


def _largest_segment(track: Track) -> np.ndarray:
    """(N,) bool: frames with a pose in the part of the map that has most frames."""
    if not track.posed.any():
        return track.posed
    segments, counts = np.unique(track.segment[track.posed], return_counts=True)
    return np.asarray(track.posed & (track.segment == segments[np.argmax(counts)]))
