"""Exposures and white balance of photographs from the gray levels at their verified matches.

A feature is a blob, of which a window shows more surroundings the farther it is: levels are taken at the flattest place
of its cell, in the other photograph as far beside the match, turned and scaled as the two features are.

Those of the map's photographs are solved together, as of keyframes (estimation/photometry.py); a held-out one is then
compared with those that it was matched with, and changes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.photographs.features import Features
from mvsgs_core.photographs.two_views import TwoViews
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation.gray_levels import Levels, Samples, log_ratio_moments
from mvsgs_core.tracking.estimation.lights import ImageLights, edges_between
from mvsgs_core.tracking.estimation.response import radial_terms
from mvsgs_core.tracking.image import CELL, TrackingImage, tracking_size


@dataclass(frozen=True)
class Look:
    """What is kept of a photograph: a few ten thousand gray levels."""

    levels: Levels
    size: tuple[int, int]  # height and width that the levels' points are in
    scale: np.ndarray  # (2,) from pixels of the photograph to those
    intrinsics: np.ndarray  # (4,) at that size
    exposure: float  # see `msgs.Frame`; 0: not known
    flattest: np.ndarray  # (M, 2) place of every cell, by rows, at that size

    @staticmethod
    def of(
        image: np.ndarray, intrinsics: np.ndarray, exposure: float, area: int, mask: np.ndarray | None = None
    ) -> Look:
        """Of an RGB image (H, W, 3) uint8; area: pixels of the size; mask: (H, W) bool, False where it is ignored."""
        native = image.shape[0], image.shape[1]
        size = tracking_size(*native, area)
        levels = TrackingImage.of(0, 0.0, image, size, False, mask=mask).levels
        assert levels is not None
        scale = np.array([size[1] / native[1], size[0] / native[0]])
        return Look(levels, size, scale, scale_intrinsics(intrinsics, native, size), exposure, levels.flattest(CELL))

    def beside(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of pixels (N, 2) of the photograph: which one is nearest to the flattest place of its cell, a cell each (K,),
        and how far beside it that is (K, 2), in pixels of the photograph."""
        points = (pixels + 0.5) * self.scale - 0.5
        rows, columns = self.size[0] // CELL, self.size[1] // CELL
        u, v = np.clip((points / CELL).astype(int), 0, [columns - 1, rows - 1]).T
        cell = v * columns + u
        off = self.flattest[cell] - points
        order = np.lexsort((np.linalg.norm(off, axis=1), cell))
        chosen = order[np.flatnonzero(np.diff(cell[order], prepend=-1))]
        return chosen, off[chosen] / self.scale

    def at(self, pixels: np.ndarray) -> tuple[Samples, np.ndarray]:
        """Gray levels and radial terms (N, 3) at pixels (N, 2) of the photograph."""
        points = (pixels + 0.5) * self.scale - 0.5
        return self.levels.at(points), radial_terms(points, self.intrinsics, self.size)


class Light(ImageLights):
    """Of all photographs, once `solve` was called."""

    def __init__(self, stats: Stats) -> None:
        super().__init__(stats)
        self.looks: list[Look] = []  # of each photograph

    def exposures(self) -> np.ndarray | None:
        """(P, 3, 4) float32 of all, NaN where it is not known; None where exposures do not vary."""
        if not self.varies:
            return None
        none = np.full((3, 4), np.nan, np.float32)
        found = [self.exposure(n) for n in range(len(self.looks))]
        return np.stack([none if affine is None else affine for affine in found])

    def solve(
        self, features: list[Features], pairs: Mapping[tuple[int, int], TwoViews], mapped: np.ndarray, posed: np.ndarray
    ) -> None:
        """features: of each photograph. mapped, posed: (P,) bool: in the map, and with a pose."""
        moments: dict[tuple[int, int], np.ndarray] = {}
        for (i, j), views in pairs.items():
            if posed[i] and posed[j] and (mapped[i] or mapped[j]):
                found = self._compared(self.looks[i], self.looks[j], features[i], features[j], views.matches)
                if found is not None:
                    moments[i, j] = found
        members = np.flatnonzero(mapped & posed).tolist()
        exposures = (self.looks[index].exposure for index in members)
        lights = self._solved(members, edges_between(members, moments), exposures)
        if lights is None:
            return
        self._lights = lights
        if self.varies:
            for index in np.flatnonzero(posed & ~mapped).tolist():
                self._attach(index, moments.items())

    def _compared(self, a: Look, b: Look, of_a: Features, of_b: Features, matches: np.ndarray) -> np.ndarray | None:
        chosen, off = a.beside(of_a.points[matches[:, 0]])
        here, there = matches[chosen].T
        turn = of_b.angle[there] - of_a.angle[here]
        scale = of_b.extent[there] / of_a.extent[here]
        cos, sin = scale * np.cos(turn), scale * np.sin(turn)
        off_b = np.stack([cos * off[:, 0] - sin * off[:, 1], sin * off[:, 0] + cos * off[:, 1]], axis=1)
        (levels_a, at_a), (levels_b, at_b) = a.at(of_a.points[here] + off), b.at(of_b.points[there] + off_b)
        return log_ratio_moments(levels_a, levels_b, (at_a, at_b), np.zeros(3))


__all__ = ["Light", "Look"]
