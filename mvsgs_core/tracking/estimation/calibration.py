"""What the tracker learns of the camera itself: focal length and distortion, where it is guessed, and readout time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.camera import told_readout_time
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.estimation.focal import FocalConfig, focal_of_all, observability, refine_focal, uncertainty
from mvsgs_core.tracking.estimation.radial import Radial, estimate_radial, lens_problem
from mvsgs_core.tracking.estimation.rolling_shutter import estimating_readout
from mvsgs_core.tracking.estimation.zoom import Zoom, find_zoom
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.steps import Steps, timed, whole

BENT_LENS = "the lens bends, and the focal length makes up for it"
UNKNOWN_LENS = "these images hardly tell a focal length from a lens that bends"
FEW = 128  # keyframes, the first ones, that a given calibration is checked with
MANY = 300  # keyframes, the first ones, that a guess is: their adjustment takes the square of their number in memory
REESTIMATED_AT = (10, 20, 40)  # keyframes of a part of the map at which the readout time is estimated again, ...
NEWEST, LAST = 12, 40  # ... from the newest ones, and in the end from so many


@dataclass
class Calibration:
    """The camera as far as the tracker knows it: it changes the graph's intrinsics until they are settled."""

    graph: KeyframeGraph
    config: FocalConfig
    stats: Stats
    original: np.ndarray  # (4,) intrinsics of the original images, as they came: in their pixels focal lengths are told
    guessed: bool  # the focal length that came with the frames
    readout_time: float | None  # seconds; None: to be estimated
    reads_columns: bool  # where it is given
    threads: int

    def __post_init__(self) -> None:
        self.graph.readout_time, self.graph.reads_columns = self.readout_time or 0.0, self.reads_columns
        if self.readout_time is not None:
            self.stats.values["readout_time"] = self.readout_time
            self.stats.values["reads_columns"] = self.reads_columns
        self.given = self.graph.intrinsics  # (4,) that came with the frames, at the tracker's size
        self.settled = not self.guessed
        self.of_map = False  # the focal length: of a map that is gone on with
        self.rolled = False  # a readout time that is not 0 was used before the one now, also by a map gone on with
        self.readout_of = 0  # keyframes of the part that the readout time is of, `LAST` at most; 0: it is of none

    @property
    def settled(self) -> bool:
        """The focal length will not change any more: keyframes may go out with it, and what contradicts it moves."""
        return self.graph.weighing

    @settled.setter
    def settled(self, settled: bool) -> None:
        self.graph.weighing = settled

    @property
    def pixels(self) -> float:
        """The focal length that came with the frames, in pixels of the original images."""
        return float(self.original[0])

    @property
    def focal_factor(self) -> float:
        """On the focal length that came with the frames."""
        return float(self.graph.intrinsics[0] / self.given[0])

    @property
    def sought(self) -> FocalConfig | None:
        """How the focal length is found; None where it is known."""
        return None if self.settled else self.config

    def refine(self) -> None:
        """With more keyframes: the focal length again, until it is certain or has to do.

        It is that of all parts of the map together, none of which has gone out: one that was lost soon settles nothing.
        """
        if self.settled:
            return
        members = sorted(self.graph.keyframes)
        with self.stats.time("focal length"):
            failure = refine_focal(self.graph, members, self.threads)
            if failure:
                self.stats.warn(f"the focal length could not be adjusted: {failure}")
            elif len(members) >= self.config.min_keyframes:
                rise = observability(self.graph, members, self.config.probe, self.threads)
                if rise > self.config.certain and self._sensible():
                    self.settled = True
                    self._report(members, rise)
            if not self.settled and len(members) >= self.config.max_keyframes:
                self.settle(members)

    def settle(self, members: list[int]) -> None:
        """Takes what there is, or goes back to the guess."""
        if self.settled:
            return
        self.settled = True
        rise = observability(self.graph, members, self.config.probe, self.threads) if len(members) > 2 else 0.0
        if rise > self.config.usable and self._sensible():
            self._report(members, rise)
            return
        self.graph.intrinsics = self.given.copy()
        solver = Solver(steps=15, threads=self.threads)
        solution = self.graph.optimize(members, self.graph.but_first(members), set(members), solver)
        if solution.failure:
            self.stats.count("failed bundle adjustments")
            self.stats.warn(f"poses and depths stay those of another focal length: {solution.failure}")
        self._report([], rise)
        self.stats.values["focal_doubt"] = "it can't be told from these images, and the guess is kept"
        self.stats.warn(
            "the focal length can't be told from these images (a camera that hardly turns, or a flat scene): the guess "
            f"is kept, {_told(self.pixels)}, and the map may be stretched in depth; calibrate and set "
            "dataset.intrinsics=[fx,fy,cx,cy]"
        )

    def check(self, members: list[int]) -> None:
        """At the end: whether the stream agrees with the focal length that the keyframes went out with."""
        if len(members) < self.config.min_keyframes:
            return
        with self.stats.time("calibration"):
            zoom = find_zoom(self.graph, members, self.config, self.threads)
        if zoom is not None:
            self._say_zoomed(zoom)
            return
        if not self.guessed:
            own = [index for index in members if index >= 0]  # of a map that is gone on with, others come first
            self._check_given((own if len(own) >= self.config.min_keyframes else members)[:FEW])
            return
        who = f"the first {MANY} keyframes" if len(members) > MANY else "all keyframes together"
        members = members[:MANY]
        factor = focal_of_all(self.graph, members, self.threads)
        if factor is None:
            return
        rise = observability(self.graph, members, self.config.probe, self.threads, factor)
        sigma = uncertainty(self.graph, members, rise, self.config.probe, self.threads, factor).sigma
        if not np.isfinite(sigma):
            return
        used = self.focal_factor * self.pixels
        self._say_checked(factor, sigma)
        if "focal_sigma_percent" in self.stats.values:
            self._report_radial(estimate_radial(lens_problem(self.graph, members), self.threads), sigma)
        if abs(np.log(factor)) > max(self.config.drift, sigma):
            self.stats.values["focal_doubt"] = f"{who} want {factor:.4f} times as much"
            self.stats.warn(
                f"{who} want a focal length of {_told(factor * used)}, give or take "
                f"{100 * sigma:.1f} %, and {used:.0f} px was used: run again with {self._option(factor)}"
            )

    def _check_given(self, members: list[int]) -> None:
        """A calibration is taken as it is, but what clearly contradicts it is said: poses are worth no more than it."""
        with self.stats.time("calibration"):
            factor = focal_of_all(self.graph, members, self.threads)
            if factor is None:
                self.stats.skip("check of the calibration: its bundle adjustment failed")
                return
            if abs(np.log(factor)) <= self.config.drift:
                return
            rise = observability(self.graph, members, self.config.probe, self.threads, factor)
            if rise <= self.config.certain:
                return
            certainty = uncertainty(self.graph, members, rise, self.config.probe, self.threads, factor)
        if abs(np.log(factor)) <= certainty.interval:
            return
        sigma = certainty.sigma
        self._say_checked(factor, sigma)
        self.stats.values["focal_doubt"] = f"the keyframes want {factor:.4f} times as much"
        used = self.focal_factor * self.pixels
        what, whose, advice = (
            (
                "the map's focal length",
                "of the map",
                "Are the frames of the map's camera, zoomed as it was? A map of their own begins without map=DIR",
            )
            if self.of_map
            else (
                "the given calibration",
                "that were given",
                "Is it of this camera at this size, and does the lens bend (dataset.distortion)? Or run again with "
                f"{self._option(factor)}, as they want it",
            )
        )
        self.stats.warn(
            f"{what} and the images contradict each other: the keyframes want a focal length of "
            f"{_told(factor * used)}, {factor:.3f} times the {used:.0f} px {whose}, give or "
            f"take {100 * sigma:.1f} %; poses and map may be bent. {advice}"
        )

    def _say_zoomed(self, zoom: Zoom) -> None:
        """Another focal length for all, or a lens that bends, would mend nothing."""
        before, after = (
            f"those of frames {part.frames[0]} to {part.frames[1]} want a focal length of "
            f"{_told(part.factor * self.focal_factor * self.pixels)}"
            for part in (zoom.before, zoom.after)
        )
        self.stats.values["focal_doubt"] = f"the camera zoomed, by about {zoom.factor:.1f}"
        self.stats.values["zoom"] = zoom.factor
        self.stats.warn(
            f"the camera zoomed while it filmed: of the keyframes, {before}, {after}, about {zoom.factor:.1f} times as "
            "much. One focal length is used for all frames, so poses and map are bent. Film without zooming, or map "
            "the parts before and after it each by itself (dataset.start, dataset.stop)"
        )

    def _option(self, factor: float) -> str:
        """For the next run. factor: on the focal lengths that were used."""
        fx, fy, cx, cy = self.original * [factor * self.focal_factor, factor * self.focal_factor, 1.0, 1.0]
        return f"dataset.intrinsics=[{fx:.1f},{fy:.1f},{cx:.1f},{cy:.1f}]"

    def _say_checked(self, factor: float, sigma: float) -> None:
        """factor: on what was used."""
        found = factor * self.focal_factor * self.pixels
        self.stats.values["focal_checked_px"] = found
        self.stats.values["focal length, whole stream"] = f"{found:.1f} px, give or take {100 * sigma:.1f} %"

    def estimate_readout(self, members: list[int], newest: int = NEWEST) -> None:
        """Of a rolling shutter, from the newest keyframes of a part of the map.

        Not from a part that has fewer keyframes than that which it was estimated from: the start of another one, of a
        camera that was lost, tells less.
        """
        whole(self.estimating_readout(members, newest))

    def estimating_readout(self, members: list[int], newest: int = NEWEST) -> Steps[None]:
        """`estimate_readout`, a time that is tried a step."""
        if self.readout_time is not None or len(members) < self.readout_of:
            return
        self.readout_of = min(len(members), LAST)
        self.rolled |= self.graph.readout_time != 0.0
        estimating = estimating_readout(self.graph, members[-newest:], self.threads)
        found = yield from timed(self.stats, "rolling shutter", estimating)
        self.graph.readout_time, self.graph.reads_columns = found
        self.stats.values["readout_time"], self.stats.values["reads_columns"] = found
        self.stats.values["rolling shutter"] = told_readout_time(found[0], reads_columns=found[1])

    def readout_due(self, members: int) -> bool:
        """Whether a part of the map has so many keyframes now that the readout time is to be estimated again."""
        return any(self.readout_of < number <= members for number in REESTIMATED_AT)

    def _sensible(self) -> bool:
        return self.config.bounds[0] < self.focal_factor < self.config.bounds[1]

    def _report(self, members: list[int], rise: float) -> None:
        """members: keyframes that the focal length was found from; none: it is the guess. rise: their observability."""
        used = self.focal_factor * self.pixels
        self.stats.values["focal length"] = f"{used:.1f} px, {self.focal_factor:.3f} x the guess"
        self.stats.values["focal_px"] = used
        self.stats.counts["focal length over its guess"] = self.focal_factor
        if not members:
            return
        alone = uncertainty(self.graph, members, rise, self.config.probe, self.threads).sigma
        radial = estimate_radial(lens_problem(self.graph, members), self.threads)
        self._report_radial(radial, alone)
        self.stats.values["focal length"] += f", give or take {self.stats.values['focal_sigma_percent']:.1f} %"
        if alone > self.config.doubt:
            self.stats.values["focal_doubt"] = "the camera hardly turned while it was estimated"
            self.stats.warn(
                f"the focal length of {used:.0f} px is uncertain by {100 * alone:.1f} %: the camera hardly turned "
                "while it was estimated, and the map may be stretched in depth by as much; calibrate and set "
                "dataset.intrinsics=[fx,fy,cx,cy]"
            )
        elif float(np.hypot(alone, radial.error)) > self.config.doubt:
            self.stats.values["focal_doubt"] = BENT_LENS if radial.clear else UNKNOWN_LENS
        if radial.clear:
            self.stats.warn(
                f"the lens bends: a radial distortion of {radial.k1:.3f}, give or take {radial.k1_sigma:.3f}, which is "
                f"left in the images; run again with {self._option(radial.focal_factor)} and "
                f"dataset.distortion=[{radial.k1:.4f},0,0,0], which undistorts them"
            )

    def _report_radial(self, radial: Radial, alone: float) -> None:
        """alone: standard deviation that the focal length would have if the distortion were known, as a fraction."""
        self.stats.values["focal_sigma_percent"] = 100 * float(np.hypot(alone, radial.error))
        focal = self.focal_factor * self.pixels * radial.focal_factor
        sigma = 100 * float(np.hypot(alone, radial.slope * radial.k1_sigma))
        self.stats.values["radial_k1"], self.stats.values["radial_k1_sigma"] = radial.k1, radial.k1_sigma
        self.stats.values["radial distortion"] = (
            f"{radial.k1:.3f}, give or take {radial.k1_sigma:.3f}; with it a focal length of "
            f"{focal:.1f} px, give or take {sigma:.1f} %"
        )


def _told(focal: float) -> str:
    """Pixels, and of what: frames may come smaller than they were taken."""
    return f"{focal:.0f} px in the original images"


__all__ = ["LAST", "Calibration"]
