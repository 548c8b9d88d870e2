"""A keyframe's new splats: at its depth where the map does not explain it, sparse ones where it would stay empty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from mvsgs_core import camera
from mvsgs_core.mapping.exposure import colors_of_map, fitted_exposure
from mvsgs_core.mapping.filling import continued_depth, fill_points
from mvsgs_core.mapping.insertion import (
    InsertionConfig,
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
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.mapping.training import TrainingConfig
from mvsgs_core.rasterizer.rasterize import Render
from mvsgs_core.stats import Stats

SOLID = 0.9  # opacity from which the map's depth at a pixel is its surface's


@dataclass(frozen=True)
class Densifier:
    """Adds the splats of one keyframe to `state`: `expose` first, then `insert`, then `fill`."""

    config: InsertionConfig
    training: TrainingConfig
    max_splats: int
    state: MapState
    render: Callable[[TrainingView, int], Render]  # of `state` from a keyframe's pose at a pyramid level
    unit: float | None  # world units; None: no keyframe had depth yet
    median_depth: float  # of the scene, in `unit`
    log: Stats

    def insert(self, view: RGBDKeyframe, added: TrainingView, depth: np.ndarray) -> int:
        """Adds splats where `depth` (h, w), world units, is known and the map does not explain the image."""
        config = self.config
        size = (depth.shape[0], depth.shape[1])
        valid = depth > 0
        if view.confidence is not None and config.min_confidence > 0:
            valid &= view.confidence >= config.min_confidence
        valid &= _valid_pixels(added, size)
        mask, standing_out = valid, np.zeros(size, dtype=bool)
        occupancy = config.map_voxel > 0 and len(self.state) > 0
        if (config.unexplored or occupancy) and len(self.state):
            level = _level_of(added, size)
            render = self.render(added, level)
            images = render.color.cpu().numpy(), render.opacity.cpu().numpy(), added.target(level).cpu().numpy()
            if config.unexplored:
                mask = valid & _resized(unexplored_mask(*images, config), size)
                self.log.skip("points_explored", int(valid.sum() - mask.sum()))
            if occupancy and config.map_voxel_error < float("inf"):
                standing_out = _resized(outliers(*images, config), size)
        intrinsics = camera.scale_intrinsics(view.intrinsics, view.image.shape[:2], size)
        colors = self._colors(added, size)
        assert self.unit is not None
        points = points_from_depth(depth / self.unit, intrinsics, colors, view.normals, mask)
        near = self._near(points)
        points, standing_out = points.where(near), standing_out[mask][near]
        if occupancy and len(points):
            pose = added.local_from_cam
            positions = points.positions @ pose[:3, :3].T + pose[:3, 3]
            means = self.state.splats.means.detach().cpu().numpy()
            free = unoccupied(positions, means, config.map_voxel * self.median_depth) | standing_out
            self.log.skip("points_occupied", int((~free).sum()))
            points = points.where(free)
        if config.voxel > 0 and len(points):
            before = len(points)
            points = voxel_filter(points, config.voxel * self.median_depth)
            self.log.skip("points_voxel_filter", before - len(points))
        return self._append(points, added, config.initial_opacity, config.initial_scale)

    def fill(self, view: RGBDKeyframe, added: TrainingView) -> int:
        """Adds sparse splats wherever the map shows nothing, what was just inserted included: at the depth before the
        filters, and where that says nothing continued from what surrounds it."""
        config = self.config
        if config.fill == 0 or view.unfiltered is None or self.unit is None:
            return 0
        depth = checked_depth(view.unfiltered, self.log) * np.float32(added.scale / view.scale / self.unit)
        size = (depth.shape[0], depth.shape[1])
        empty, shown = _valid_pixels(added, size), np.zeros(size, dtype=np.float32)
        if len(self.state):
            render = self.render(added, _level_of(added, size))
            opacity = render.opacity.cpu().numpy()
            empty = empty & _resized(opacity < config.fill_below, size)
            solid = np.where(opacity > SOLID, render.depth.cpu().numpy(), 0.0).astype(np.float32)
            shown = np.asarray(cv2.resize(solid, size[::-1], interpolation=cv2.INTER_NEAREST))
        confidence = np.ones(size, dtype=np.float32) if view.confidence is None else view.confidence
        intrinsics = camera.scale_intrinsics(view.intrinsics, view.image.shape[:2], size)
        colors = self._colors(added, size)
        depth = continued_depth(depth, confidence, shown, depth_colors(added.levels[0].cpu().numpy(), size))
        points = fill_points(depth, confidence, intrinsics, colors, empty, config.fill)
        points = points.where(self._near(points))
        filled = self._append(points, added, config.fill_opacity, config.fill_scale)
        self.log.count("filled", filled)
        return filled

    def expose(self, added: TrainingView, earlier: TrainingView | None) -> None:
        """First guess of a keyframe's exposure: what fits the map, or where that shows too little the earlier one's."""
        if len(self.state):
            level = len(added.levels) - 1
            render = self.render(added, level)
            images = render.color.cpu().numpy(), render.opacity.cpu().numpy(), added.target(level).cpu().numpy()
            found = fitted_exposure(*images)
            if found is not None:
                added.exposure.copy_(torch.from_numpy(found))
            elif earlier is not None:
                added.exposure.copy_(earlier.exposure.detach())

    def _colors(self, added: TrainingView, size: tuple[int, int]) -> np.ndarray:
        """The keyframe's colors (h, w, 3) as the map has them."""
        colors = depth_colors(added.levels[0].cpu().numpy(), size)
        if not self.training.exposure:
            return colors
        return colors_of_map(colors, added.exposure.detach().cpu().numpy())

    def _near(self, points: Points) -> np.ndarray:
        near = near_points(points, self.config, self.median_depth)
        if not near.all():
            self.log.refuse("far_points", int((~near).sum()), "points too far away for the map's voxels were left out")
        return near

    def _append(self, points: Points, added: TrainingView, opacity: float, scale: float) -> int:
        """Makes splats of camera-frame points, as many as the map has room for; returns their number."""
        room = self.max_splats - len(self.state)
        if len(points) > room:
            self.log.refuse("splats", len(points) - room, f"the map is full: {len(self.state)} splats (max_splats)")
            points = points.first(max(0, room))
        new = splats_from_points(
            points, added.local_from_cam, self.state.splats.sh.shape[1], self.training.kernel, self.config,
            opacity, scale,
        )  # fmt: skip
        self.state.append(new, torch.full((len(points),), added.index, dtype=torch.int64))
        return len(points)


def checked_depth(depth: np.ndarray, log: Stats) -> np.ndarray:
    """Depth (h, w) float32 with 0, unknown, for what is not finite or negative; counted as refused."""
    bad = ~np.isfinite(depth) | (depth < 0)
    if bad.any():
        log.refuse("depths", int(bad.sum()), "depths that are not finite or negative were left out")
    return np.where(bad, 0.0, depth).astype(np.float32)


def _level_of(view: TrainingView, size: tuple[int, int]) -> int:
    """The coarsest pyramid level that still has the depth map's resolution."""
    fine = [level for level in range(len(view.levels)) if view.size(level)[0] >= size[0]]
    return fine[-1] if fine else 0


def _valid_pixels(view: TrainingView, size: tuple[int, int]) -> np.ndarray:
    """Pixels (h, w) bool of the depth map whose color is known."""
    if view.valid is None:
        return np.ones(size, dtype=bool)
    return np.asarray(camera.resize_image(view.valid[0].cpu().numpy().astype(np.float32), size) > 0.999)


def _resized(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask (H, W) bool at another size, by majority."""
    return np.asarray(camera.resize_image(mask.astype(np.float32), size) > 0.5)
