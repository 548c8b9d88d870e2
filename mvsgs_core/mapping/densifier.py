"""A keyframe's new splats: where the map does not show its image, as many as the image needs there."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch

from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.exposure import ImageFormation
from mvsgs_core.mapping.filling import continued_depth
from mvsgs_core.mapping.frame_of_reference import FrameOfReference
from mvsgs_core.mapping.insertion import Points, depth_colors, points_of_rectangles, splats_from_points
from mvsgs_core.mapping.keyframe_store import KeyframeStore
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.mapping.partition import EMPTY, partition
from mvsgs_core.rasterizer.rasterize import Render
from mvsgs_core.stats import Stats

SOLID = 0.9  # opacity from which the map's depth at a pixel is its surface's
_BEST, _SQUARE_OF_BEST = 0.1, 0.195  # share of pixels; mean square of three normal numbers that it stays below
FAR = 1e6  # median depths from which float32 does not hold a splat beside the others


class Densifier:
    """Adds the splats of one keyframe after the other to a map."""

    def __init__(
        self, config: MapperConfig, state: MapState, frame: FrameOfReference, keyframes: KeyframeStore,
        render: Callable[[TrainingView], Render], photometry: ImageFormation, log: Stats,
    ) -> None:  # fmt: skip
        """render: of `state` as a keyframe's camera photographs it. What is given here changes by itself."""
        self.config, self.state, self.frame, self.keyframes = config.insertion, state, frame, keyframes
        self.render, self.photometry, self.log = render, photometry, log
        self._kernel = config.training.kernel
        self._max_splats = config.density_control.max_splats

    def add(self, keyframe: RGBDKeyframe, view: TrainingView, depth: np.ndarray, late: bool = False) -> int:
        """Adds the splats of the store's newest keyframe; returns their number.

        depth: (h, w), checked, world units; late: the map is coarse there, as splats that were owed are added only now.
        """
        size = view.size
        image = view.target.cpu().numpy()
        valid = np.ones(size, dtype=bool) if view.valid is None else view.valid.cpu().numpy()
        residual, shown, noise = self._residual(view, image, valid)
        near = self._near(depth / np.float32(self.frame.length))
        depth = _nearest(near, size)
        known = wanted = (depth > 0) & valid
        confidence = np.ones(size, dtype=np.float32)
        if self.config.doubtful and self.frame.unit is not None:
            doubtful, confidence = self._doubtful_depth(keyframe, near, view, shown)
            empty = residual >= EMPTY
            likely = empty
            if keyframe.unfiltered is not None and keyframe.confidence is not None:
                likely = confidence >= self.config.doubtful_confidence
            filled = ~known & valid & (doubtful > 0) & (empty | likely)
            depth, wanted = np.where(filled, doubtful, depth), known | filled
        if not wanted.any():
            return 0
        focal = float(np.sqrt(view.intrinsics[0] * view.intrinsics[1]))
        parts = partition(image, residual, wanted, depth, known, 1.0 / focal, self.config.price, 0.0 if late else noise)
        self.log.skip("pixels_explored", int((known & (parts.labels < 0)).sum()))
        self.log.count("pixels_filled", int((~known & (parts.labels >= 0)).sum()))
        normals = None if keyframe.normals is None else _nearest(keyframe.normals, size)
        colors = self.photometry.colors_of_map(depth_colors(view.image.cpu().numpy(), size), view)
        points = points_of_rectangles(parts, depth, known, confidence, view.intrinsics, colors, normals)
        return self._append(points, view)

    def _residual(
        self, view: TrainingView, image: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Squared error (H, W), mean over RGB, of what the map shows of an image, its depth there, 0: nothing, and the
        variance of the image's noise, 0 where there is no map.

        The error counts beyond `median_errors` times the median alone: that is what blur, noise, exposure and a pose's
        error do to this view, which no splat mends. On a clean view it is small, and detail that the map lacks stands
        out. What is usual is asked of `valid` pixels (H, W): behind a mask the photograph shows something else.
        """
        residual, shown = np.full(view.size, EMPTY, dtype=np.float32), np.zeros(view.size, dtype=np.float32)
        if not len(self.state):
            return residual, shown, 0.0
        noise = 0.0
        render = self.render(view)
        opacity = render.opacity.cpu().numpy()
        shown = np.where(opacity > SOLID, render.depth.cpu().numpy(), np.float32(0))
        mapped = opacity >= self.config.min_opacity
        compared = mapped & valid
        if self.config.unexplored and compared.any():
            squared = np.mean((render.color.cpu().numpy() - image) ** 2, axis=-1)
            usual = np.median(squared[compared])
            noise = noise_variance(squared[compared])
            beyond = squared - self.config.median_errors**2 * usual
            residual[mapped] = np.maximum(beyond, 0.0)[mapped]
        return residual, shown, noise

    def _doubtful_depth(
        self, keyframe: RGBDKeyframe, depth: np.ndarray, view: TrainingView, shown: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Depth before the filters and its confidence, (H, W) at the view's size, in the mapper's unit; where matching
        says nothing it is continued from what surrounds it.

        depth: (h, w) after the filters, in that unit, which is taken where that before them was not sent.
        """
        if keyframe.unfiltered is not None:
            depth = checked_depth(keyframe.unfiltered, self.log)
            depth = self._near(depth * np.float32(view.scale / keyframe.scale / self.frame.length))
        size = (min(depth.shape[0], view.size[0]), min(depth.shape[1], view.size[1]))
        depth = _nearest(depth, size)
        sure = np.ones((1, 1), dtype=np.float32) if keyframe.confidence is None else keyframe.confidence
        confidence = _nearest(sure, size)
        colors = depth_colors(view.image.cpu().numpy(), size)
        depth = continued_depth(depth, confidence, _nearest(shown, size), colors)
        return _nearest(depth, view.size), _nearest(confidence, view.size)

    def _near(self, depth: np.ndarray) -> np.ndarray:
        """Depth with 0 for what is too far away to be held beside the rest."""
        far = depth >= FAR * self.keyframes.median_depth
        if far.any():
            self.log.refuse("far_points", int(far.sum()), "points too far away for the map's numbers were left out")
        return np.where(far, np.float32(0), depth)

    def _append(self, points: Points, view: TrainingView) -> int:
        """Makes splats of camera-frame points, as many as the map has room for; returns their number."""
        room = max(0, self._max_splats - len(self.state))  # a map that is gone on with may have more
        if len(points) > room:
            text = f"the map is full: max_splats={self._max_splats}; what is new is not mapped"
            self.log.refuse("splats", len(points) - room, text)
            points = points.first(room)
        bases = self.state.splats.sh.shape[1]
        new = splats_from_points(points, view.local_from_cam, bases, self._kernel, self.config)
        self.state.append(new, torch.full((len(points),), view.index, dtype=torch.int64))
        return len(points)


def checked_depth(depth: np.ndarray, log: Stats) -> np.ndarray:
    """Depth (h, w) float32 with 0, unknown, for what is not finite or negative; counted as refused."""
    bad = ~np.isfinite(depth) | (depth < 0)
    if bad.any():
        log.refuse("depths", int(bad.sum()), "depths that are not finite or negative were left out")
    return np.where(bad, 0.0, depth).astype(np.float32)


def noise_variance(squared: np.ndarray) -> float:
    """Of an image, from the squared errors (N,), mean over RGB, of the map's render of it.

    Noise is everywhere alike, what the map lacks is not: so the best tenth of the pixels tell of it.
    """
    return float(np.quantile(squared, _BEST)) / _SQUARE_OF_BEST


def _nearest(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Values (h, w, ...) at another size, none of them a mean of two."""
    return np.asarray(cv2.resize(np.ascontiguousarray(values), size[::-1], interpolation=cv2.INTER_NEAREST))
