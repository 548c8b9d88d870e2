"""Photographs with wide steps, in any order, beside COLMAP on the same photographs: `python -m bench.wide`.

Both know nothing of the lens but a focal length of 65 degrees across the longer side or EXIF's, and estimate it with
two coefficients of distortion; both run on one thread. All photographs are used, none is held out. COLMAP matches all
pairs. Position error: root mean square of the distance to COLMAP's positions after alignment by a similarity, over
photographs that both have, in percent of the path from photograph to photograph in the order of their names.

What was measured of a scene is kept in runs/bench/wide: with --resume the same command measures only the scenes that
are missing there or were measured otherwise, and --minutes ends it early, so that all can be measured at several times.
Ours and COLMAP's are always of the same time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from bench import pieces
from bench.aligned import aligned_error
from bench.baselines.colmap_poses import Model as ColmapModel
from bench.baselines.colmap_poses import reconstruct
from bench.runs import DATA, folder
from bench.table import Row, at_most, main, names, skipped
from mvsgs_core import geometry
from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.photographs.sparse_map import Model
from mvsgs_core.photographs.structure import Photographs

NAMES = {  # folder below the data, and photographs that must have a pose in the largest part
    "fountain": ("strecha/fountain-P11", 11),
    "herz_jesu": ("strecha/Herz-Jesus-P8", 8),
    "fox": ("fox", 25),
    "aerial_caliterra": ("aerial_caliterra", 23),
    "drone_tractor_orbit": ("drone_tractor_orbit", 74),
    "south_building": ("south_building", 126),
}
QUICK = ("fountain", "herz_jesu")
MAX_ERROR = 0.3  # % of the path
MAX_TIME = 0.5  # of COLMAP's


@dataclass(frozen=True)
class Solved:
    """What ours made of photographs."""

    models: list[Model]
    seconds: float  # of the processor, from images in memory to poses

    @property
    def posed(self) -> int:
        return int(self.models[0].registered.sum()) if self.models else 0


def photographs(name: str) -> list[Item]:
    """Those of a scene in the order of their names, of an unknown lens."""
    return list(open_dataset("images", path=DATA / NAMES[name][0], intrinsics="auto"))


def solve(items: Sequence[Item]) -> Solved:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    start = time.process_time()
    try:
        solver = Photographs()
        for item in items:
            solver.add(item.image, item.intrinsics, item.intrinsics_guessed)
        return Solved(solver.solve(), time.process_time() - start)
    finally:
        cv2.setNumThreads(threads)


def position_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Percent of their path; positions (N, 3) of the same photographs, N at least 3."""
    path = np.linalg.norm(np.diff(theirs, axis=0), axis=1).sum()
    return 100.0 * aligned_error(ours, theirs) / float(path)


def positions(model: Model) -> np.ndarray:
    """(P, 3), NaN of photographs that have no pose in it."""
    return np.asarray(geometry.inverse(model.cam_from_world)[:, :3, 3])


def rows_of(name: str, items: Sequence[Item], ours: Solved, shuffled: Solved, order: np.ndarray) -> list[Row]:
    """Ours alone. shuffled: solved in the `order` (P,)."""
    count, least = len(items), NAMES[name][1]
    rows = [posed(f"{name}: photographs with a pose", ours.posed, count, least)]
    rows.append(posed(f"{name}: photographs with a pose, in shuffled order", shuffled.posed, count, least))
    if ours.models and shuffled.models:
        back = np.full((count, 3), np.nan)
        back[order] = positions(shuffled.models[0])
        here = positions(ours.models[0])
        both = np.isfinite(back[:, 0]) & np.isfinite(here[:, 0])
        if both.sum() >= 3:
            rows.append(
                at_most(f"{name}: the orders differ by", position_error(back[both], here[both]), "%", MAX_ERROR)
            )
    rows.append(Row(f"{name}: parts", len(ours.models)))
    if ours.models:
        rows.append(Row(f"{name}: reprojection error, median", float(np.median(ours.models[0].residual)), "px"))
    return rows


def posed(name: str, found: int, count: int, least: int) -> Row:
    return Row(name, f"{found} of {count}", "", f">= {least}", found >= least)


def beside(name: str, items: Sequence[Item], ours: Solved, theirs: ColmapModel | None, why: str) -> list[Row]:
    """Ours beside COLMAP's."""
    if theirs is None:
        return [Row(f"{name}: COLMAP", why)]
    rows = [Row(f"{name}: photographs with a pose, COLMAP", f"{len(theirs.index)} of {len(items)}")]
    if ours.models:
        if (error := from_theirs(ours, theirs)) is not None:
            rows.append(at_most(f"{name}: position error", error, "% of the path", MAX_ERROR))
        off = 100.0 * (ours.models[0].lens.focal(0) / theirs.focal - 1.0)
        rows.append(Row(f"{name}: focal length, from COLMAP's", off, "%"))
    rows.append(Row(f"{name}: processor time", ours.seconds, "s"))
    rows.append(Row(f"{name}: processor time, COLMAP", theirs.solving_seconds, "s"))
    ratio = ours.seconds / theirs.solving_seconds
    rows.append(at_most(f"{name}: processor time over COLMAP's", ratio, "", MAX_TIME))
    return rows


def from_theirs(ours: Solved, theirs: ColmapModel) -> float | None:
    """Position error of our largest model; None where three photographs have no pose in both."""
    if not ours.models:
        return None
    mine = positions(ours.models[0])[theirs.index]
    both = np.isfinite(mine[:, 0])
    return position_error(mine[both], theirs.world_from_cam[both, :3, 3]) if both.sum() >= 3 else None


def scene(name: str, both_orders: bool) -> list[Row]:
    """Ours in the order of the names and shuffled, and COLMAP's, which is shuffled too if it is to have both orders."""
    items = photographs(name)
    ours = solve(items)
    order = np.random.default_rng(0).permutation(len(items))
    rows = rows_of(name, items, ours, solve([items[n] for n in order]), order)
    theirs, why = solve_with_colmap(items, np.arange(len(items)))
    rows += beside(name, items, ours, theirs, why)
    if both_orders and theirs is not None:
        again, why = solve_with_colmap(items, order)
        rows += apart(name, theirs, again) if again is not None else [Row(f"{name}: COLMAP, shuffled", why)]
        if again is not None and (error := from_theirs(ours, again)) is not None:
            rows.append(Row(f"{name}: position error, from COLMAP's shuffled", error, "% of the path"))
    return rows


def solve_with_colmap(items: Sequence[Item], order: np.ndarray) -> tuple[ColmapModel | None, str]:
    """Of the photographs in this order (P,); the model has their places in `items`. Or why there is none."""
    with tempfile.TemporaryDirectory() as place:
        frames = {n: items[k].image for n, k in enumerate(order)}
        model, why = reconstruct(frames, items[0].intrinsics, Path(place), 1, photographs=True)
    return model and replace(model, index=order[model.index]), why


def apart(name: str, theirs: ColmapModel, again: ColmapModel) -> list[Row]:
    """What COLMAP's own results differ by."""
    _, first, second = np.intersect1d(theirs.index, again.index, return_indices=True)
    if len(first) < 3:
        return []
    off = position_error(again.world_from_cam[second, :3, 3], theirs.world_from_cam[first, :3, 3])
    return [
        Row(f"{name}: COLMAP's orders differ by", off, "%"),
        Row(f"{name}: focal length, COLMAP's orders", 100.0 * (again.focal / theirs.focal - 1.0), "%"),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    scenes = options.scenes or list(QUICK if options.quick else NAMES)
    missing = {name: place for name in scenes if not (place := DATA / NAMES[name][0]).exists()}
    rows = [skipped(name, place) for name, place in missing.items()]
    scenes = [name for name in scenes if name not in missing]
    measured = partial(scene, both_orders=options.colmap_in_both_orders)
    asked = {"colmap_in_both_orders": options.colmap_in_both_orders}
    return pieces.in_pieces(scenes, folder(options, "wide"), options.resume, options.minutes, measured, asked) + rows


def arguments(parser: argparse.ArgumentParser) -> None:
    told = "those to measure, by commas; default: all, or the two smallest with --quick"
    parser.add_argument("--scenes", type=names(NAMES), help=told)
    pieces.kept_arguments(parser, minutes=True)
    parser.add_argument(
        "--colmap-in-both-orders", action="store_true", help="COLMAP shuffled as well: what its results differ by"
    )


if __name__ == "__main__":
    main(measure, "Photographs in any order beside COLMAP", arguments)
