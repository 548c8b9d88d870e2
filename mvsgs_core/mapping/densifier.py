"""A keyframe's new splats: at its depth where the map does not show it, sparse ones where it would stay empty."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch

from mvsgs_core import camera
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.exposure import ImageFormation
from mvsgs_core.mapping.filling import continued_depth, fill_points
from mvsgs_core.mapping.frame_of_reference import FrameOfReference
from mvsgs_core.mapping.insertion import (
    Points,
    depth_colors,
    near_points,
    outliers,
    points_from_depth,
    splats_from_points,
    unexplored_mask,
    unoccupied,
    voxel_filter,
)  # fmt: skip
from mvsgs_core.mapping.keyframe_store import KeyframeStore
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView, checked_image
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.rasterizer.rasterize import Render
from mvsgs_core.stats import Stats

SOLID = 0.9  # opacity from which the map's depth at a pixel is its surface's


class Densifier:
    """Adds the splats of one keyframe after the other to a map."""

    def __init__(
        self, config: MapperConfig, state: MapState, frame: FrameOfReference, keyframes: KeyframeStore,
        render: Callable[[TrainingView, tuple[int, int]], Render], photometry: ImageFormation, log: Stats,
    ) -> None:  # fmt: skip
        """render: of `state` as a keyframe's camera photographs it, at a size (height, width). What is given here
        changes by itself."""
        self.config, self.state, self.frame, self.keyframes = config.insertion, state, frame, keyframes
        self.render, self.photometry, self.log = render, photometry, log
        self._kernel = config.training.kernel
        self._max_splats = config.density_control.max_splats

    def add(self, keyframe: RGBDKeyframe, view: TrainingView, depth: np.ndarray) -> int:
        """Adds the splats of the store's newest keyframe; returns their number. depth: (h, w), checked, world units."""
        inserted = self._insert(keyframe, view, depth) if (depth > 0).any() else 0
        return inserted + self._fill(keyframe, view)

    def _insert(self, keyframe: RGBDKeyframe, view: TrainingView, depth: np.ndarray) -> int:
        """Adds splats where `depth` is known and the map does not show the image yet."""
        config = self.config
        size = (depth.shape[0], depth.shape[1])
        median_depth = self.keyframes.median_depth
        mask = valid = (depth > 0) & _valid_pixels(view, size)
        standing_out = np.zeros(size, dtype=bool)
        occupancy = config.map_voxel > 0 and len(self.state) > 0
        if (config.unexplored or occupancy) and len(self.state):
            at = _coarsest(view.size, size)
            render = self.render(view, at)
            images = render.color.cpu().numpy(), render.opacity.cpu().numpy(), _colors(keyframe, view, at)
            if config.unexplored:
                mask = valid & _resized(unexplored_mask(*images, config), size)
                self.log.skip("points_explored", int(valid.sum() - mask.sum()))
            if occupancy and config.map_voxel_error < float("inf"):
                standing_out = _resized(outliers(*images, config), size)
        intrinsics = camera.scale_intrinsics(keyframe.intrinsics, keyframe.image.shape[:2], size)
        points = points_from_depth(
            depth / self.frame.length, intrinsics, self._map_colors(view, size), keyframe.normals, mask
        )
        near = self._near(points, median_depth)
        points, standing_out = points.where(near), standing_out[mask][near]
        if occupancy and len(points):
            pose = view.local_from_cam
            positions = points.positions @ pose[:3, :3].T + pose[:3, 3]
            means = self.state.splats.means.detach().cpu().numpy()
            free = unoccupied(positions, means, config.map_voxel * median_depth) | standing_out
            self.log.skip("points_occupied", int((~free).sum()))
            points = points.where(free)
        if config.voxel > 0 and len(points):
            before = len(points)
            points = voxel_filter(points, config.voxel * median_depth)
            self.log.skip("points_voxel_filter", before - len(points))
        return self._append(points, view, config.initial_opacity, config.initial_scale)

    def _fill(self, keyframe: RGBDKeyframe, view: TrainingView) -> int:
        """Adds sparse splats wherever the map shows nothing, what was just inserted included: at the depth before the
        filters, and where that says nothing continued from what surrounds it."""
        config, unit = self.config, self.frame.unit
        if config.fill == 0 or keyframe.unfiltered is None or unit is None:
            return 0
        depth = checked_depth(keyframe.unfiltered, self.log) * np.float32(view.scale / keyframe.scale / unit)
        size = (depth.shape[0], depth.shape[1])
        empty, shown = _valid_pixels(view, size), np.zeros(size, dtype=np.float32)
        if len(self.state):
            render = self.render(view, _coarsest(view.size, size))
            opacity = render.opacity.cpu().numpy()
            empty = empty & _resized(opacity < config.fill_below, size)
            solid = np.where(opacity > SOLID, render.depth.cpu().numpy(), 0.0).astype(np.float32)
            shown = np.asarray(cv2.resize(solid, size[::-1], interpolation=cv2.INTER_NEAREST))
        confidence = np.ones(size, dtype=np.float32) if keyframe.confidence is None else keyframe.confidence
        intrinsics = camera.scale_intrinsics(keyframe.intrinsics, keyframe.image.shape[:2], size)
        depth = continued_depth(depth, confidence, shown, depth_colors(view.image.cpu().numpy(), size))
        points = fill_points(depth, confidence, intrinsics, self._map_colors(view, size), empty, config.fill)
        points = points.where(self._near(points, self.keyframes.median_depth))
        filled = self._append(points, view, config.fill_opacity, config.fill_scale)
        self.log.count("filled", filled)
        return filled

    def _map_colors(self, view: TrainingView, size: tuple[int, int]) -> np.ndarray:
        """The keyframe's colors (h, w, 3) as the map has them."""
        colors = depth_colors(view.image.cpu().numpy(), size)
        return self.photometry.colors_of_map(colors, view)

    def _near(self, points: Points, median_depth: float) -> np.ndarray:
        near = near_points(points, self.config, median_depth)
        if not near.all():
            self.log.refuse("far_points", int((~near).sum()), "points too far away for the map's voxels were left out")
        return near

    def _append(self, points: Points, view: TrainingView, opacity: float, scale: float) -> int:
        """Makes splats of camera-frame points, as many as the map has room for; returns their number."""
        room = self._max_splats - len(self.state)
        if len(points) > room:
            self.log.refuse("splats", len(points) - room, f"the map is full: {len(self.state)} splats (max_splats)")
            points = points.first(max(0, room))
        new = splats_from_points(
            points, view.local_from_cam, self.state.splats.sh.shape[1], self._kernel, self.config,
            opacity, scale,
        )  # fmt: skip
        self.state.append(new, torch.full((len(points),), view.index, dtype=torch.int64))
        return len(points)


def checked_depth(depth: np.ndarray, log: Stats) -> np.ndarray:
    """Depth (h, w) float32 with 0, unknown, for what is not finite or negative; counted as refused."""
    bad = ~np.isfinite(depth) | (depth < 0)
    if bad.any():
        log.refuse("depths", int(bad.sum()), "depths that are not finite or negative were left out")
    return np.where(bad, 0.0, depth).astype(np.float32)


def _half(size: tuple[int, int]) -> tuple[int, int]:
    return max(1, size[0] >> 1), max(1, size[1] >> 1)


def _coarsest(image: tuple[int, int], depth: tuple[int, int]) -> tuple[int, int]:
    """Half the image's size where that still has the depth map's resolution."""
    half = _half(image)
    return half if half[0] >= depth[0] else image


def _colors(keyframe: RGBDKeyframe, view: TrainingView, size: tuple[int, int]) -> np.ndarray:
    """The keyframe's colors (h, w, 3) float32 in [0, 1], as its camera saw them, at the training size or half of it."""
    if size == view.size:
        return view.target.cpu().numpy()
    image = torch.from_numpy(np.array(camera.resize_image(checked_image(keyframe.image)[0], size)))
    return np.asarray((image.to(view.image.device, torch.float32) / 255.0).cpu().numpy())


def _valid_pixels(view: TrainingView, size: tuple[int, int]) -> np.ndarray:
    """Pixels (h, w) bool of the depth map whose color is known."""
    if view.valid is None:
        return np.ones(size, dtype=bool)
    return np.asarray(camera.resize_image(view.valid.cpu().numpy().astype(np.float32), size) > 0.999)


def _resized(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask (H, W) bool at another size, by majority."""
    return np.asarray(camera.resize_image(mask.astype(np.float32), size) > 0.5)
