"""Exposures, vignetting and response that the tracker finds, against those of the camera: `python -m bench.photometry`.

On the synthetic scenes the truth is known: the error of an exposure is that of the gray levels which it gives, the
median over the levels from 0.1 to 0.85 that the frame shows. Under steady light none is to be sent at all; what the
gains would be is given beside. On videos every third pair of keyframes is left out, and told by the others: how much of
a pair's log ratio of gray levels is left.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from bench.table import Row, at_most, main, skipped
from bench.tracking.cases import CASES, Case
from bench.tracking.track import track
from mvsgs_core.scene.difficulties import Difficulties, Sensor
from mvsgs_core.tracking.estimation.photometry import PhotometricEdges, solve_photometry
from mvsgs_core.tracking.estimation.response import MIDDLE
from mvsgs_core.tracking.tracker import Tracker

LEVELS = np.linspace(0.1, 0.85, 40)
ALL: Mapping[str, float] = {
    "exposure": 1.0, "white_balance": 0.3, "vignetting": 0.5, "response": 0.15, "noise": 1.5,
}  # fmt: skip
VARYING: Mapping[str, Mapping[str, float]] = {"exposure by a stop": {"exposure": 1.0}, "all that a camera does": ALL}
DRIVE: Mapping[str, Any] = {"scene": "town", "frames": 800, "stride": 2, "streets": 12}
STEADY: Mapping[str, Mapping[str, Any]] = {
    "room, steady": {},
    "room, noise and motion blur": {"noise": 3.0, "motion_blur": 0.5},
    "room, loop of 300 frames": {"frames": 300, "loop": True},
    "aerial, steady": {"scene": "aerial"},
    "town, drive of 400 frames": DRIVE,  # what is far comes near
}
VIDEOS = {
    "tum_fr1_xyz": CASES["tum_fr1_xyz"],
    "redkitchen": CASES["redkitchen, color camera 525"],
    "hololens_000": Case("tum", {"size": (180, 270)}, "hololens_000"),
    "kitti_piece": Case("tum", {"size": (185, 613)}, "kitti_piece"),
}


def level_errors(tracker: Tracker, sensor: Sensor, keyframes: bool) -> float:
    """Percent, the median over keyframes or the frames between; infinite where none is known."""
    trajectory = tracker.trajectory()
    if trajectory.exposure is None:
        return float("inf")
    mean = trajectory.index[trajectory.keyframe].tolist()
    found = []
    for k in np.flatnonzero((trajectory.keyframe == keyframes) & np.isfinite(trajectory.exposure).all(axis=(1, 2))):
        affine = trajectory.exposure[k].astype(np.float64)
        there = np.diag(affine[:, :3])[:, None] * LEVELS + affine[:, 3:]
        true = sensor.transferred(LEVELS, int(trajectory.index[k]), mean)
        shown = (true > 0.05) & (true < 0.9)
        found.append(np.median(np.abs(there / true - 1.0)[shown]))
    return 100.0 * float(np.median(found))


def vignetting_errors(tracker: Tracker, sensor: Sensor) -> tuple[float, float]:
    """Percent, median and largest over the image, against what the response makes of the light's vignetting at mid
    gray: with an offset, the response makes more of it in the dark, which one factor for all levels cannot."""
    height, width = 60, 80
    scale = np.linspace(0.0, 4.0, sensor.STEPS + 1)
    light = float(np.interp(255.0 * MIDDLE, sensor.curve, scale))
    true = np.interp(light * sensor.falloff(height, width), scale, sensor.curve) / (255.0 * MIDDLE)
    v, u = np.mgrid[:height, :width]
    square = ((u - (width - 1) / 2) ** 2 + (v - (height - 1) / 2) ** 2) / (0.25 * (height**2 + width**2))
    found = np.ones((height, width))
    if tracker.vignetting is not None:
        found += np.stack([square, square**2, square**3], axis=-1) @ tracker.vignetting
    off = 100.0 * np.abs(found / true - 1.0)
    return float(np.median(off)), float(off.max())


def response_error(tracker: Tracker, sensor: Sensor, offset: float) -> float:
    """Percent of a gray level: the largest, of gray levels 0.1 to 0.85 a quarter brighter than mid gray demands."""
    found = tracker.session.photometer.photometry.response
    found_offset = MIDDLE * found / (1.0 - found)
    gain = np.log(1.25)

    def brightened(o: float) -> np.ndarray:
        """Levels l with (l + o) proportional to a power of light; mid gray grows by the gain."""
        return np.asarray((LEVELS + o) * (MIDDLE * np.exp(gain) + o) / (MIDDLE + o) - o)

    return 100.0 * float(np.abs(brightened(found_offset) / brightened(offset) - 1.0).max())


def rows_of_varying(name: str, options: Mapping[str, Any], frames: int) -> list[Row]:
    tracker = track(Case("synthetic", {"frames": frames, "threads": 1, **options}).items()).tracker
    sensor = Sensor(Difficulties(**options), 0)
    rows = [
        at_most(f"room, {name}: gray levels of keyframes", level_errors(tracker, sensor, True), "%", 1.0),
        at_most(f"room, {name}: gray levels of frames between", level_errors(tracker, sensor, False), "%", 1.0),
    ]
    if "vignetting" in options:
        usual, largest = vignetting_errors(tracker, sensor)
        rows.append(at_most(f"room, {name}: vignetting, median over the image", usual, "%", 2.0))
        rows.append(at_most(f"room, {name}: vignetting, largest, in a corner", largest, "%", 2.0))
        rows.append(at_most(f"room, {name}: response", response_error(tracker, sensor, options["response"]), "%", 2.0))
    keyframes = len(tracker.session.graph.keyframes)
    cost = 1e3 * tracker.stats.seconds["photometry"] / keyframes
    return [*rows, Row(f"room, {name}: time of it, {keyframes} keyframes", cost, "ms/keyframe CPU")]


def rows_of_steady(name: str, options: Mapping[str, Any]) -> list[Row]:
    tracker = track(Case("synthetic", {"frames": 120, "threads": 1, **options}).items()).tracker
    exposure = tracker.trajectory().exposure
    span = 0.0 if exposure is None else 100.0 * float(np.ptp(np.log(exposure[:, 1, :3].sum(axis=1))))
    return [
        at_most(f"{name}: exposures sent, range", span, "%", 1.0),
        Row(f"{name}: no exposure is sent", str(exposure is None), "", "True", exposure is None),
    ]


def rows_of_video(name: str, case: Case) -> list[Row]:
    try:
        items = case.items()
    except FileNotFoundError as error:
        return [skipped(name, str(error))]
    tracker = track(items).tracker
    photometer = tracker.session.photometer
    found = photometer.photometry
    gains = 100.0 * (np.exp(np.ptp(found.gains)) - 1.0) if found.varies else 0.0
    corner = 1.0 if tracker.vignetting is None else 1.0 + float(tracker.vignetting.sum())
    left, before = left_of_pairs(photometer.edges(sorted(tracker.session.graph.keyframes)))
    return [
        Row(f"{name}: brightest over darkest keyframe at mid gray", float(gains), "% more"),
        Row(f"{name}: white balance, largest", 100.0 * float(np.abs(found.white).max(initial=0.0)), "%"),
        Row(f"{name}: vignetting at the corner", corner, ""),
        Row(f"{name}: log ratio of pairs left out, median", 100.0 * before, "%"),
        at_most(f"{name}: what the other pairs leave of it, median", 100.0 * left, "%", 1.0),
    ]


def left_of_pairs(edges: PhotometricEdges) -> tuple[float, float]:
    """Median log ratio of pairs that were left out, after and before what a solution of the others says of them."""
    out = np.arange(len(edges.source)) % 3 == 1
    count = 1 + int(max(edges.source.max(), edges.to.max()))
    kept = PhotometricEdges(edges.source[~out], edges.to[~out], edges.moments[~out])
    found = solve_photometry(kept, count)
    lights = found.lights
    known = np.isin(edges.source, kept.source) & np.isin(edges.to, kept.to) & out
    steps = np.array([found.step(edges.moments[e])[0] for e in np.flatnonzero(known)])
    told = (lights[edges.to] - lights[edges.source])[known, 0]
    return float(np.median(np.abs(steps - told))), float(np.median(np.abs(steps)))


def measure(options: argparse.Namespace) -> list[Row]:
    cv2.setNumThreads(1)
    if options.quick:
        return rows_of_varying("exposure by a stop", VARYING["exposure by a stop"], 40)
    rows = [row for name, switches in VARYING.items() for row in rows_of_varying(name, switches, 120)]
    rows += [row for name, switches in STEADY.items() for row in rows_of_steady(name, switches)]
    return rows + [row for name, case in VIDEOS.items() for row in rows_of_video(name, case)]


if __name__ == "__main__":
    main(measure, "photometry")
