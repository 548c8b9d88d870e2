"""COLMAP (sequential matching, calibration given) on the frames that the tracker saw: error and time beside ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.aligned import aligned_error
from bench.baselines.colmap_poses import Model, reconstruct_once
from bench.pieces import Kept
from bench.table import Origin, Row, at_most
from bench.tracking.cases import CASES
from mvsgs_core.camera import fit_size, resize_image, scale_intrinsics
from mvsgs_core.datasets import Item
from mvsgs_core.trajectory import Trajectory

AREA = 512 * 384  # pixels of COLMAP's images: 2.6 times those of the tracker
SUCCESS = 0.5  # fraction of the frames that COLMAP must register for its error to be a mark


@dataclass(frozen=True)
class Baseline:
    """What COLMAP made of a sequence; `model` is None where it found none, `why` says so."""

    model: Model | None
    why: str
    size: tuple[int, int]


def solve(items: Sequence[Item], folder: Path, threads: int, kept: Kept) -> Baseline:
    """COLMAP's model of the frames, or the one that an earlier call left in `folder` for the same images."""
    size = items[0].image.shape[0], items[0].image.shape[1]
    small = fit_size(*size, AREA) if size[0] * size[1] > AREA else size
    frames = {i.index: resize_image(i.image, small) for i in items}
    intrinsics = scale_intrinsics(items[0].intrinsics, size, small)
    return Baseline(*reconstruct_once(frames, intrinsics, folder, threads, kept), small)


def solve_case(name: str, folder: Path, resume: bool) -> tuple[Baseline, list[Origin]]:
    """`solve` for a sequence of the benchmark, by one thread: for a process of its own, beside which ours is timed.

    And where that was measured.
    """
    case, kept = CASES[name], Kept(resume)
    place = folder / "".join(c if c.isalnum() else "_" for c in name)
    place.mkdir(parents=True, exist_ok=True)
    return solve(case.items()[:: case.baseline_stride], place, 1, kept), kept.origins


def rows(name: str, baseline: Baseline, path: Trajectory, items: Sequence[Item], seconds: float) -> list[Row]:
    """Both errors over the frames that COLMAP registered and we posed.

    seconds: processor time of our whole run, from images in memory to poses, as COLMAP's here.
    """
    model = baseline.model
    if model is None:
        return [Row(f"{name}: pycolmap", baseline.why)]
    truth = {i.index: i.world_from_cam for i in items if i.world_from_cam is not None}
    theirs = dict(zip(model.index.tolist(), model.world_from_cam, strict=True))
    posed = np.isfinite(path.world_from_cam).all(axis=(1, 2))
    ours = dict(zip(path.index[posed].tolist(), path.world_from_cam[posed], strict=True))
    both = sorted(set(theirs) & set(ours) & set(truth))
    registered = f"{len(theirs)} of {len(items)} frames{_every(name)}, {baseline.size[1]}x{baseline.size[0]}"
    if len(both) < 3:
        return [Row(f"{name}: pycolmap", f"registered {registered}")]
    wanted = np.stack([truth[n][:3, 3] for n in both])
    mine, his = (aligned_error(np.stack([poses[n][:3, 3] for n in both]), wanted) for poses in (ours, theirs))
    ratio = f"{name}: ATE / pycolmap's, same frames"
    found = [Row(f"{name}: pycolmap's ATE", 100.0 * his, f"cm ({registered})")]
    if len(theirs) >= SUCCESS * len(items):
        found.append(at_most(ratio, mine / his, "", 1.2))
    else:
        found.append(Row(ratio, mine / his, "(it failed: most frames are not registered)"))
    total = model.solving_seconds
    return [*found, Row(f"{name}: seconds, pycolmap's / ours", total / seconds, f"({total:.0f} / {seconds:.1f} s CPU)")]


def _every(name: str) -> str:
    stride = CASES[name].baseline_stride
    return "" if stride == 1 else f", one of {stride}"
