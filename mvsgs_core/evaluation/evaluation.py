"""Collects what a run produces and turns it into the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.camera import resampled, same_intrinsics, scale_intrinsics
from mvsgs_core.evaluation import metrics, scoring, trajectory_metrics
from mvsgs_core.evaluation.depth_metrics import NO_DEPTH, depth_ratios, score_depth
from mvsgs_core.evaluation.exposure import frame_exposures, summary
from mvsgs_core.evaluation.fitted_camera import fit_camera
from mvsgs_core.evaluation.frames import Frames, Photograph
from mvsgs_core.evaluation.many_frames import each
from mvsgs_core.evaluation.straight import undistortion
from mvsgs_core.evaluation.trajectory_metrics import AlignedPath, known_poses
from mvsgs_core.export.keyframe_render import NEAR, near_plane
from mvsgs_core.export.ply import ply_size
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.trajectory import TrackingState, Trajectory, velocities

ENOUGH = 3  # held-out frames whose mean and worst say something


@dataclass
class Evaluation:
    """Feed it with `add_*` in any order; `report()` needs at least a track."""

    max_frames: int  # frames scored at most, of each kind as many; 0: none, and no depth maps
    max_bytes: float  # of frames that wait on disk
    given: Mapping[str, scoring.Compare] = field(default_factory=dict)  # image metrics made at run time, by key
    folder: Path | None = None  # where they wait
    fitted: bool = True  # held-out frames are scored a second time, their cameras fitted at test time
    scored: Callable[[], None] = lambda: None  # told of each frame that was scored
    started: float | None = None
    mapped: float | None = None
    trajectory: Trajectory | None = None
    maps: dict[bool, Snapshot] = field(default_factory=dict)  # by `refined`
    scores: dict[bool, list[scoring.Score]] = field(default_factory=dict)
    fitting: float = 0.0  # seconds that went into fitting cameras at test time
    masked: list[float] = field(default_factory=list)  # of each frame with a mask, the part that does not count

    def __post_init__(self) -> None:
        self._frames = Frames(self.folder, self.max_frames, self.max_bytes)
        self._received: set[int] = set()  # frames
        self._with_depth: set[int] = set()  # keyframes whose filtered depth came
        self.size: tuple[int, int] | None = None  # height, width of the first frame
        self._intrinsics: np.ndarray | None = None  # (4,) of the first frame
        self.truth: dict[int, np.ndarray] = {}  # poses (4, 4), by frame index

    def add_frame(
        self,
        index: int,
        image: np.ndarray,
        intrinsics: np.ndarray,
        world_from_cam: np.ndarray | None,
        depth: np.ndarray | None,
        mask: np.ndarray | None = None,
    ) -> None:
        """A frame of the stream, with what is known of the truth. mask: (H, W) bool, pixels that count; None: all."""
        if self.started is None:
            self.started = time.perf_counter()
        self._received.add(index)
        self.size = self.size or (image.shape[0], image.shape[1])
        self._intrinsics = intrinsics.copy() if self._intrinsics is None else self._intrinsics
        if mask is None or mask.any():
            if depth is not None and mask is not None:
                depth = np.where(mask, depth, np.float32(0))
            self._frames.add(index, image, intrinsics, depth, mask)
        if mask is not None:
            self.masked.append(1.0 - float(mask.mean()))
        if world_from_cam is not None and np.isfinite(world_from_cam).all():
            self.truth[index] = world_from_cam

    def add_keyframe(
        self, index: int, image: np.ndarray, intrinsics: np.ndarray, depth: np.ndarray, scale: float,
        mask: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """A keyframe as it is mapped, with its filtered depth, computed at the map's scale `scale`."""
        self._with_depth.add(index)
        if mask is None or mask.any():
            self._frames.add_keyframe(index, image, intrinsics, depth, scale, mask)

    def add_map(self, finished: Snapshot, refined: bool) -> None:
        self.maps[refined] = finished
        self.mapped = time.perf_counter()

    def report(self) -> dict[str, Any]:
        """The figures of the run; what could not be computed is null, and `notes` says why."""
        notes: list[str] = []
        alignment, trajectory_report = self._score_trajectory(notes)
        rendering = {refined: self._score_renders(refined, notes) for refined in (True, False)}
        final, before = self.finished, self.maps.get(False)
        wall = None if self.started is None or self.mapped is None else self.mapped - self.started
        keyframes = trajectory_report["keyframes"]
        return {
            "rendering": rendering[True],
            "rendering_before_refinement": rendering[False],
            "trajectory": trajectory_report,
            "depth": self._score_depths(alignment, notes),
            "exposure": self._exposure_report(),
            "frames_on_disk": {"bytes": self._frames.size},
            "map": {
                "splats": len(final.splats.means) if final else 0,
                "bytes": ply_size(final) if final else 0,
                "iterations": final.iterations if final else 0,
                "iterations_before_refinement": before.iterations if before else None,
                "kernel": final.kernel if final else None,
            },
            "time": {
                "wall": wall,
                "keyframes_per_second": keyframes / wall if wall else None,
            },
            "notes": notes + self._frames.notes(),
        }

    @property
    def finished(self) -> Snapshot | None:
        """The map as it is in the end."""
        return self.maps.get(True) or self.maps.get(False)

    @property
    def keyframes(self) -> np.ndarray:
        """(K,) those of the finished map; none where there is none."""
        return self.finished.keyframes if self.finished else np.zeros(0, np.int64)

    @property
    def final_trajectory(self) -> Trajectory | None:
        """The tracker's, following the keyframes to where the finished map has them; where that sent none, of those
        alone. None where there is no map either."""
        return self.trajectory if self.finished is None else self._following(self.finished)

    def _following(self, finished: Snapshot) -> Trajectory:
        """Keyframes are those of the map, too, whether the tracker says so or not: they are no frames held out."""
        if self.trajectory is None:
            return _of_keyframes(finished)
        followed = self.trajectory.following(finished.keyframes, finished.world_from_cam)
        return replace(followed, keyframe=followed.keyframe | np.isin(followed.index, finished.keyframes))

    def scored_frames(self, refined: bool = True) -> list[scoring.ScoredFrame]:
        """All frames with a pose in the part that the map shows whose image is there, in the order of the stream."""
        finished = self.maps[refined]
        tracked = self._following(finished)
        frames = []
        main = tracked.main(finished.keyframes)
        near = near_plane(finished, finished.world_from_cam[0]) if len(finished.keyframes) else NEAR
        moving = tracked.velocity
        if moving is None:
            moving = velocities(tracked.timestamp, tracked.world_from_cam, main)
        exposures = self.exposures(refined)
        photographs = self._photographs()
        for k in np.flatnonzero(main & np.isin(tracked.index, list(photographs))):
            index = int(tracked.index[k])
            photograph = self._as_pinhole(photographs[index], tracked)
            focal = 1.0 if photograph.as_mapped else tracked.focal_factor
            rolling = tracked.readout_time and not photograph.as_mapped
            frames.append(
                scoring.ScoredFrame(
                    index,
                    bool(tracked.keyframe[k]),
                    finished.relative_pose(tracked.world_from_cam[k]),
                    photograph.intrinsics * [focal, focal, 1.0, 1.0],
                    photograph.image,
                    near,
                    tracked.readout_time * moving[k] if rolling else None,
                    None if exposures is None else exposures[k],
                    finished.vignetting,
                    finished.antialiased,
                    finished.background,
                    photograph.mask,
                    tracked.reads_columns,
                )
            )
        return frames

    def exposures(self, refined: bool) -> np.ndarray | None:
        """(N, 3, 4) of all frames of the track; of those outside of the part that the map shows they mean nothing."""
        finished = self.maps[refined]
        tracked = self.trajectory or _of_keyframes(finished)
        main, place = tracked.main(finished.keyframes), _places(finished)
        mapped = np.flatnonzero(main & np.isin(tracked.index, finished.keyframes))
        affines = finished.exposures[[place[int(i)] for i in tracked.index[mapped]]]
        centers = None if tracked.in_order else np.where(main[:, None], tracked.world_from_cam[:, :3, 3], np.nan)
        return frame_exposures(tracked.timestamp, tracked.exposure, mapped, affines, centers)

    def photograph(self, index: int) -> np.ndarray:
        """(H, W, 3) uint8, as renders are compared with it. Raises KeyError for a frame that was not kept."""
        return self._as_pinhole(self._photographs()[index], self.trajectory).image()

    def _photographs(self) -> dict[int, Photograph]:
        """Without a Trajectory nothing says what camera took the stream: keyframes are as they were mapped."""
        return self._frames.photographs(mapped=self.trajectory is None)

    def _as_pinhole(self, photograph: Photograph, tracked: Trajectory | None) -> Photograph:
        """Without the distortion that the tracker found: as its keyframes are."""
        if photograph.as_mapped or tracked is None or tracked.distortion is None:
            return photograph
        assert self.size is not None
        lens = undistortion(tracked, photograph.intrinsics, self.size)
        assert lens is not None
        given, mask = photograph.image, photograph.mask

        def straightened() -> np.ndarray | None:
            seen = mask()
            return None if seen is None else lens.mask(seen)

        return Photograph(lambda: lens.image(given()), lens.intrinsics, True, straightened)

    def _true_depth(self, index: int) -> np.ndarray | None:
        """(H, W) float32, 0 unknown, at the pixels of the keyframe: of its intrinsics, and without the distortion that
        the tracker found."""
        known = self._frames.true_depth(index)
        if known is None:
            return None
        depth, intrinsics = known
        if self.trajectory is None:
            return depth
        assert self.size is not None
        size = depth.shape[0], depth.shape[1]
        if self.trajectory.distortion is None:
            ours = self._frames.mapped_intrinsics(index) / [*2 * [self.trajectory.focal_factor], 1.0, 1.0]
            of_first = self._intrinsics is not None and same_intrinsics(ours, self._intrinsics)
            if same_intrinsics(intrinsics, ours) or not of_first:  # else a tracker resampled it
                return depth
            theirs, ours = (scale_intrinsics(each, self.size, size) for each in (intrinsics, ours))
            return resampled(depth, theirs, ours, nearest=True)
        lens = undistortion(self.trajectory, scale_intrinsics(intrinsics, self.size, size), size)
        assert lens is not None
        return lens.depth(depth)

    def filtered_depths(self) -> list[int]:
        """Keyframes whose filtered depth is there."""
        return [index for index, _ in self._frames.filtered_depths()]

    def filtered_depth(self, index: int) -> np.ndarray | None:
        return self._frames.filtered_depth(index)

    def _score_renders(self, refined: bool, notes: list[str]) -> dict[str, Any]:
        finished = self.maps.get(refined)
        if not self.max_frames:
            return scoring.summarize([])
        if finished is None or not len(finished.splats.means):
            which = "after" if refined else "before"
            notes.append(f"no renders {which} refinement were scored: " + ("no map" if not finished else "empty map"))
            return scoring.summarize([])
        chosen = scoring.choose(self.scored_frames(refined), self.max_frames)
        chosen = [frame for frame in chosen if frame.shows]
        scores = self._scores(finished, chosen)
        if refined and self.fitted:
            started = time.perf_counter()
            cameras = [frame for frame, score in zip(chosen, scores) if score.held_out]
            fitted = {score.index: score.figures for score in self._scores(finished, cameras, fit=True)}
            scores = [replace(score, fitted=fitted.get(score.index)) for score in scores]
            self.fitting = time.perf_counter() - started
        self.scores[refined] = scores
        held_out = sum(score.held_out for score in scores)
        few = f"{held_out} of the {len(scores)} frames scored are held out: their mean and their worst say little"
        if held_out < ENOUGH and few not in notes:
            notes.append(few)
        return scoring.summarize(scores)

    def _exposure_report(self) -> dict[str, Any] | None:
        refined = True in self.maps
        if not self.maps:
            return None
        finished = self.maps[refined]
        return summary(finished.keyframes, finished.exposures, self.exposures(refined), finished.vignetting)

    def _scores(self, finished: Snapshot, frames: list[scoring.ScoredFrame], fit: bool = False) -> list[scoring.Score]:
        """fit: with each frame's camera fitted to it at test time."""
        if not frames:
            return []
        splats, kernel = finished.splats, finished.kernel
        height, width = self.size or frames[0].photograph().shape[:2]

        def score(frame: scoring.ScoredFrame) -> scoring.Score:
            frame = fit_camera(splats, kernel, frame) if fit else frame
            return scoring.score_frame(splats, kernel, frame, self.given)

        scores = []
        for found in each(score, frames, (height, width), splats):
            scores.append(found)
            self.scored()
        return scores

    def _score_trajectory(self, notes: list[str]) -> tuple[geometry.Similarity | None, dict[str, Any]]:
        trajectory = self.final_trajectory or Trajectory.empty()
        notes += self._about_trajectory()
        poses = known_poses(trajectory, self.truth, self.keyframes)
        posed, shown = int(trajectory.posed.sum()), int(trajectory.main(self.keyframes).sum())
        if shown < posed:
            notes.append(
                f"{posed - shown} of {posed} frames with a pose are of parts that the map does not show: they are "
                "neither scored nor in trajectory.txt"
            )
        counts = {**trajectory_metrics.counts(trajectory), "ate_keyframes": int(poses.keyframe.sum())}
        counts["ate_frames"] = len(poses.keyframe)
        if self.trajectory is None:
            counts["frames"] = len(self._received)
        try:
            found = poses.alignment
        except ValueError as error:
            if self.trajectory is not None or len(trajectory.index):
                notes.append(f"no trajectory error: {error if self.truth else 'no true poses'}")
            unknown = {"path_length": None, "scale": None}
            return None, {**metrics.of_all(metrics.TRAJECTORY, None), **unknown, **counts}
        length = {"path_length": poses.path_length, "scale": found.scale}
        return found, {**metrics.of_all(metrics.TRAJECTORY, poses), **length, **counts}

    def _about_trajectory(self) -> list[str]:
        """What a user should know of the one that the tracker sent."""
        if self.trajectory is None:
            instead = "" if self.finished is None else ": the map's keyframes are scored, and no other frame"
            found = self._photographs()
            came = sum(index in found and not found[index].as_mapped for index in self.keyframes.tolist())
            doubtful = (
                f"{came} of {len(self.keyframes)} keyframes were not received as they were mapped: they are scored as "
                "they came"
            )
            return [f"no trajectory was received{instead}", *([doubtful] if came else [])]
        notes = []
        if missing := len(self._received - set(self.trajectory.index.tolist())):
            notes.append(
                f"{missing} of {len(self._received)} frames are not in the tracker's Trajectory: no figure is of them"
            )
        others = self.trajectory.index[~self.trajectory.keyframe]
        if unsaid := int(np.isin(others, self.keyframes).sum()):
            notes.append(f"{unsaid} keyframes of the map are none in the tracker's Trajectory: they count as keyframes")
        return notes

    def aligned_path(self) -> AlignedPath | None:
        """Of the part that the map shows; None where no frame has a pose."""
        trajectory = self.final_trajectory
        if trajectory is None or not trajectory.posed.any():
            return None
        alignment, _ = self._score_trajectory([])
        return trajectory_metrics.aligned_path(trajectory, self.truth, alignment, self.keyframes)

    def _score_depths(self, alignment: geometry.Similarity | None, notes: list[str]) -> dict[str, Any]:
        """After one scale for the whole run, the median ratio of true to estimated depth, as is usual for monocular
        depth; `scale_ratio` is that over the trajectory's scale, 1 where poses and depth maps of the truth agree."""
        finished = self.finished
        now = dict(zip(finished.keyframes.tolist(), finished.scale.tolist())) if finished else {}
        known_frames = None if self.trajectory is None else set(self.trajectory.index.tolist())

        def maps() -> Iterator[tuple[np.ndarray, np.ndarray]]:  # read again for each use: all at once are gigabytes
            for index, scale in self._frames.filtered_depths():
                if known_frames is not None and index not in known_frames:  # of a map before, which has another scale
                    continue
                truth, depth = self._true_depth(index), self._frames.filtered_depth(index)
                if truth is not None and depth is not None:
                    yield depth * (now.get(index, scale) / scale), truth

        ratios = [depth_ratios(depth, truth) for depth, truth in maps()]
        count = sum(len(ratio) > 0 for ratio in ratios)
        known = np.concatenate(ratios) if ratios else np.empty(0)
        if missing := self._depths_that_never_came():
            notes.append(
                f"depth is scored of {count} of {count + missing} keyframes: that of the others did not come, as where "
                "they were in a resumed run's map already: for all of them, run it again from the start"
            )
        if not len(known):
            if self.max_frames:
                notes.append("no depth error: no keyframe has both filtered and true depth")
            return {**metrics.of_all(metrics.DEPTH, NO_DEPTH), "scale_ratio": None, "count": 0}
        scale = float(np.median(known))
        total = sum((score_depth(depth, truth, scale) for depth, truth in maps()), NO_DEPTH)
        ratio = scale / alignment.scale if alignment and alignment.scale > 0.0 else None
        return {**metrics.of_all(metrics.DEPTH, total), "scale_ratio": ratio, "count": count}

    def _depths_that_never_came(self) -> int:
        """Keyframes of the map whose true depth is there."""
        others = self._received.intersection(self.keyframes.tolist()) - self._with_depth
        return sum(self._frames.true_depth(index) is not None for index in others)

    def close(self) -> None:
        self._frames.close()


def _of_keyframes(finished: Snapshot) -> Trajectory:
    """Of a map, those of its keyframes that are of this stream; their numbers stand in for their times."""
    index = finished.keyframes[finished.keyframes >= 0]
    count = len(index)
    return Trajectory(
        index, index.astype(np.float64), finished.world_from_cam[finished.keyframes >= 0], np.ones(count, bool),
        np.full(count, TrackingState.TRACKED, np.uint8), np.zeros(count, np.int32),
    )  # fmt: skip


def _places(finished: Snapshot) -> dict[int, int]:
    """Keyframe -> its row in the map's arrays."""
    return {int(index): row for row, index in enumerate(finished.keyframes)}
