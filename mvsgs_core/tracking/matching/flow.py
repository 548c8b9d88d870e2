"""Where the points of one image lie in another: one interface, several methods.

`LucasKanade` is the tracker's own: subpixel, needs a guess. `DenseInverseSearch` gives guesses from frame to frame,
`FeatureFlow` where motion is large; both are off by a pixel or more and know of no lost point, which no initialization
survives: as flows of the tracker they come refined and verified (`RefinedFlow`). Another one (a network) is named in
the configuration as "module:Class".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np

from mvsgs_core import native
from mvsgs_core.named_modules import import_named
from mvsgs_core.tracking.image import BORDER, TrackingImage
from mvsgs_core.tracking.matching.features import match_features

FEWEST_ROWS = 32  # of a half-size image wider than high: OpenCV halves by the width, and reads beyond fewer


@dataclass(frozen=True)
class Matches:
    """N points found in another image."""

    target: np.ndarray  # (N, 2) float64 pixels; NaN where lost
    weight: np.ndarray  # (N,) float64, 0 (lost) to 1
    velocity: np.ndarray | None = None  # (N, 2) of the image at the target, pixels a second; None: not known

    @property
    def alive(self) -> np.ndarray:
        return self.weight > 0


class Flow(Protocol):
    @property
    def needs_color(self) -> bool: ...

    def match(self, a: TrackingImage, b: TrackingImage, points: np.ndarray, guess: np.ndarray) -> Matches:
        """points of `a` (N, 2) and where they are expected in `b` (N, 2)."""
        ...


@dataclass
class LucasKanade:
    """Pyramidal Lucas-Kanade there and back, whatever the gain and offset of the brightness between both images; the
    weight falls with the distance from where it came."""

    start_level: int = 2  # 0 is full size: the guess may be wrong by about 8 * 2^level pixels
    iterations: int = 10
    window_sigma: float = 4.0  # pixels, of the 16x16 window
    min_eigenvalue: float = 1.0  # gray levels² per pixel²
    distance_sigma: float = 0.5  # pixels
    max_distance: float = 1.5  # pixels
    min_correlation: float = 0.7
    threads: int = 1
    needs_color: bool = False

    def match(self, a: TrackingImage, b: TrackingImage, points: np.ndarray, guess: np.ndarray) -> Matches:
        found = (
            native.load("tracking")
            .lucas_kanade(
                a=a.pyramid,
                b=b.pyramid,
                points=np.ascontiguousarray(points, dtype=np.float32),
                guess=np.ascontiguousarray(np.clip(np.nan_to_num(guess, nan=-1e6), -1e6, 1e6), dtype=np.float32),
                border=BORDER,
                start_level=self.start_level,
                iterations=self.iterations,
                window_sigma=self.window_sigma,
                min_eigenvalue=self.min_eigenvalue,
                threads=self.threads,
            )
            .astype(np.float64)
        )
        distance, correlation = found[:, 2], found[:, 3]
        alive = (distance < self.max_distance) & (correlation > self.min_correlation)
        weight = np.where(alive, np.exp(-0.5 * np.square(np.where(alive, distance, 0.0) / self.distance_sigma)), 0.0)
        return Matches(np.where(alive[:, None], found[:, :2], np.nan), weight)


@dataclass
class DenseInverseSearch:
    """OpenCV's DIS flow at half size: quick and complete, for small motion; weights are all 1."""

    preset: str = "fast"  # ultrafast, fast, medium
    needs_color: bool = False

    @cached_property
    def _method(self) -> Any:
        presets = {
            "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
            "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
            "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
        }
        return cv2.DISOpticalFlow.create(presets[self.preset])

    def field(self, a: TrackingImage, b: TrackingImage) -> np.ndarray:
        """(H / 2, W / 2, 2) float32, in pixels of the full size."""
        height, width = a.half.shape
        if height < FEWEST_ROWS and height < width:
            turned = self._method.calc(np.ascontiguousarray(a.half.T), np.ascontiguousarray(b.half.T), None)
            return np.asarray(2.0 * turned.transpose(1, 0, 2)[..., ::-1])
        return np.asarray(2.0 * self._method.calc(a.half, b.half, None))

    def match(self, a: TrackingImage, b: TrackingImage, points: np.ndarray, guess: np.ndarray) -> Matches:
        height, width = b.size
        target = points + sample_field(self.field(a, b), points)
        inside = np.all((target >= 0) & (target <= [width - 1, height - 1]), axis=1)
        return Matches(np.where(inside[:, None], target, np.nan), inside.astype(np.float64))


@dataclass
class FeatureFlow:
    """ORB features that agree with one epipolar geometry (MAGSAC), propagated to the points; for large motion."""

    neighbors: int = 3
    needs_color: bool = False

    def match(self, a: TrackingImage, b: TrackingImage, points: np.ndarray, guess: np.ndarray) -> Matches:
        from_a, in_b = match_features(a, b)
        if len(from_a) < 15:
            return Matches(np.full(points.shape, np.nan), np.zeros(len(points)))
        target = propagate(from_a, in_b - from_a, points, self.neighbors, radius=0.15 * a.longer_side)
        return Matches(target, np.isfinite(target[:, 0]).astype(np.float64))


@dataclass
class RefinedFlow:
    """`coarse` finds the points without the tracker's guess, Lucas-Kanade refines and verifies them."""

    coarse: Flow
    refinement: LucasKanade = field(default_factory=LucasKanade)

    @property
    def needs_color(self) -> bool:
        return self.coarse.needs_color

    def match(self, a: TrackingImage, b: TrackingImage, points: np.ndarray, guess: np.ndarray) -> Matches:
        return self.refinement.match(a, b, points, self.coarse.match(a, b, points, guess).target)


def refined_inverse_search(preset: str = "fast") -> RefinedFlow:
    """DIS is off by a pixel or two: refined from half size on."""
    return RefinedFlow(DenseInverseSearch(preset), LucasKanade(start_level=1))


def refined_features(neighbors: int = 3) -> RefinedFlow:
    """What features around a point do is off by the parallax between them: refined from quarter size on."""
    return RefinedFlow(FeatureFlow(neighbors), LucasKanade(start_level=2))


def propagate(
    points: np.ndarray, displacement: np.ndarray, queries: np.ndarray, neighbors: int = 5, radius: float = 1e6
) -> np.ndarray:
    """Queries (M, 2) moved by the median displacement of their nearest points (N, 2); NaN where none is near."""
    if len(points) == 0:
        return np.full((len(queries), 2), np.nan)
    kernel = native.load("tracking").median_of_nearest
    at, to = (np.ascontiguousarray(p, dtype=np.float64) for p in (points, queries))
    moved = [
        kernel(at, np.ascontiguousarray(displacement[:, n], dtype=np.float64), to, neighbors, radius) for n in (0, 1)
    ]
    return np.asarray(to + np.stack(moved, axis=1))


def sample_field(field: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Half-size flow field (H, W, 2) at full-size points (N, 2), bilinear, clamped to the border."""
    at = np.nan_to_num((points.astype(np.float32) + 0.5) * 0.5 - 0.5, nan=0.0)
    x, y = np.ascontiguousarray(at.T)[:, None]  # two maps: see `raft_flow`, of one OpenCV 5 may read past its end
    sampled = cv2.remap(field, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled).reshape(-1, 2).astype(np.float64)


FLOWS = {
    "lucas_kanade": "mvsgs_core.tracking.matching.flow:LucasKanade",
    "dis": "mvsgs_core.tracking.matching.flow:refined_inverse_search",
    "features": "mvsgs_core.tracking.matching.flow:refined_features",
    "raft_small": "mvsgs_core.tracking.matching.raft_flow:refined_raft",
}


def _maker(name: str) -> Callable[..., Flow]:
    """What makes the flow of a name, see `make_flow`."""
    module, _, attribute = FLOWS.get(name, name).partition(":")
    wanted = f"flow={name}: must be one of {', '.join(FLOWS)}, or module:Class"
    if not (module and attribute):
        raise ValueError(wanted)
    try:
        found: Callable[..., Flow] | None = getattr(import_named(module), attribute, None)
    except (ImportError, ValueError) as error:
        raise ValueError(f"{wanted}; {error}") from error
    if not callable(found):
        raise ValueError(f"{wanted}; there is no {attribute!r} in {module}")
    return found


def make_flow(name: str, **options: Any) -> Flow:
    """A flow by its name in FLOWS or as "module:Class". Raises ValueError for a name that is neither."""
    return _maker(name)(**options)


def check_flow(name: str) -> None:
    """Raises ValueError as `make_flow` does, and FileNotFoundError where weights are missing; makes none of others."""
    maker = _maker(name)
    if name in FLOWS:
        maker()


__all__ = [
    "FLOWS",
    "DenseInverseSearch",
    "FeatureFlow",
    "Flow",
    "LucasKanade",
    "Matches",
    "RefinedFlow",
    "check_flow",
    "make_flow",
    "propagate",
    "refined_features",
    "refined_inverse_search",
    "sample_field",
]
