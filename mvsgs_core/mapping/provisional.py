"""What a preview shows of the newest keyframes until their depth comes: a sheet at the tracker's coarse depth.

Stereo and fusion wait for later keyframes, so the map is behind the camera by four of them. Where it shows nothing yet
from a keyframe's pose, sparse splats stand in. They are no part of the map: nothing is trained on them or kept of them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import torch

from mvsgs_core import camera
from mvsgs_core.inverse_depth import enlarge_inverse_depth
from mvsgs_core.mapping.densifier import SOLID
from mvsgs_core.mapping.filling import continued_depth
from mvsgs_core.mapping.insertion import Points, depth_colors, points_from_depth, splats_from_points
from mvsgs_core.mapping.keyframes import RGBDKeyframe, training_view
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.photometry import is_exposure
from mvsgs_core.rasterizer.splats import Splats

KEPT = 8  # keyframes that wait for their depth: the newest
SIDE = 4  # pixels of the image, side of the square that a splat stands for, or more where that is too many
MAX_FRACTION = 0.25  # of a preview's splats that may be provisional


@dataclass(frozen=True)
class CoarseKeyframe:
    """A keyframe with the tracker's depth alone."""

    index: int
    image: np.ndarray  # (H, W, 3) uint8 RGB
    intrinsics: np.ndarray  # (4,) at the image's size
    world_from_cam: np.ndarray  # (4, 4) float64
    scale: float  # of the map that pose and depth are in
    inverse_depth: np.ndarray  # (h, w) float32, 0 where unknown
    weight: np.ndarray  # (h, w) float32 0 to 1
    segment: int = 0
    exposure: np.ndarray | None = None  # (3, 4) color affine; None: not known


@dataclass
class _Waiting:
    view: CoarseKeyframe  # as it came
    world_from_cam: np.ndarray
    scale: float
    segment: int
    points: Points | None = None  # camera frame, world units at the view's scale; None: not made yet


class Provisional:
    """Feeds on keyframes as they come; `splats` makes what is missing within its budget of time."""

    def __init__(self, limit: int, time_fraction: float = 0.05) -> None:
        """limit: splats of a whole preview; time_fraction: of the time since the last preview, spent on new ones."""
        self._waiting: list[_Waiting] = []
        self._limit = int(MAX_FRACTION * limit)
        self._time_fraction = time_fraction
        self._newest = -1  # keyframe that is in the map
        self._asked = time.perf_counter()

    def see(self, view: CoarseKeyframe) -> None:
        """A keyframe that the map does not have yet; one that it has, or that is no camera, is passed over."""
        sound = np.isfinite(view.world_from_cam).all() and np.isfinite(view.intrinsics).all() and view.scale > 0
        if view.index > self._newest and sound:
            height, width = view.image.shape[:2]
            size = camera.fit_size(height, width, max(1, min(height * width // SIDE**2, self._limit)), multiple=1)
            at_size = camera.scale_intrinsics(view.intrinsics, (height, width), size)
            view = replace(view, image=camera.resize_image(view.image, size), intrinsics=at_size)
            self._waiting = [*self._waiting, _Waiting(view, view.world_from_cam, view.scale, view.segment)][-KEPT:]

    def came(self, index: int) -> None:
        """This keyframe's own depth is in the map now."""
        self._newest = max(self._newest, index)
        self._waiting = [waiting for waiting in self._waiting if waiting.view.index > self._newest]

    @property
    def shown(self) -> set[int]:
        """Keyframes that the last `splats` showed, or had nothing to show of."""
        return {waiting.view.index for waiting in self._waiting if waiting.points is not None}

    def correct(
        self, index: np.ndarray, world_from_cam: np.ndarray, scale: np.ndarray, segment: np.ndarray | None
    ) -> None:
        """Corrected absolute poses (K, 4, 4), cumulative scales and segments (K,) of the keyframes `index` (K,)."""
        place = {key: k for k, key in enumerate(index.tolist())}
        for waiting in self._waiting:
            k = place.get(waiting.view.index)
            if k is None or not (np.isfinite(world_from_cam[k]).all() and scale[k] > 0):
                continue
            waiting.world_from_cam, waiting.scale = np.array(world_from_cam[k]), float(scale[k])
            waiting.segment = waiting.segment if segment is None else int(segment[k])

    def splats(self, mapper: OnlineMapper, segments: set[int]) -> Splats | None:
        """In the mapper's frame and unit, of the keyframes of these segments; None where there are none.

        The newest keyframe's are made at once; those of older ones only while there is time for it.
        """
        now = time.perf_counter()
        deadline, self._asked = now + self._time_fraction * (now - self._asked), now
        if mapper.frame.unit is None or not len(mapper.state):
            return None
        parts: list[Splats] = []
        room = self._limit
        for waiting in reversed(self._waiting):
            if waiting.segment not in segments:
                continue
            if not mapper.frame.holds(waiting.world_from_cam):
                continue
            local = mapper.frame.local(waiting.world_from_cam)
            if waiting.points is None and (not parts or time.perf_counter() < deadline):
                waiting.points = _points(waiting, local, mapper)
            if waiting.points is None:
                continue
            points = waiting.points.first(room)
            room -= len(points)
            factor = waiting.scale / waiting.view.scale / mapper.frame.unit
            parts.append(
                splats_from_points(
                    replace(points, positions=points.positions * factor, tangents=points.tangents * factor),
                    local, mapper.state.splats.sh.shape[1], mapper.config.training.kernel,
                    mapper.config.insertion,
                )
            )  # fmt: skip
        if not sum(len(part.means) for part in parts):
            return None
        tensors = [part.tensors() for part in parts]
        return Splats(**{name: torch.cat([t[name] for t in tensors]) for name in tensors[0]})


def _points(waiting: _Waiting, local_from_cam: np.ndarray, mapper: OnlineMapper) -> Points:
    """One for each pixel of the small image where the map shows nothing, in world units at the view's scale."""
    view = waiting.view
    size = (view.image.shape[0], view.image.shape[1])
    nothing = np.zeros((1, 1), dtype=np.float32)
    posed = RGBDKeyframe(view.index, view.image, view.intrinsics, waiting.world_from_cam, nothing)
    seen = training_view(posed, local_from_cam, None, mapper.state.device)
    if mapper.config.training.exposure:
        own = view.exposure if view.exposure is not None and is_exposure(view.exposure) else None
        seen.expose(mapper.photometry.exposures.get(view.index, own))
    render = mapper.render(seen)
    solid = render.opacity.cpu().numpy() > SOLID
    factor = waiting.scale / view.scale / mapper.frame.length  # of depths as they came to the mapper's
    shown = np.where(solid, render.depth.cpu().numpy() / factor, 0.0).astype(np.float32)
    depth, confidence = enlarge_inverse_depth(view.inverse_depth, view.weight, size)
    colors = depth_colors(view.image, size)
    depth = continued_depth(depth, confidence, shown, colors)
    of_map = mapper.photometry.colors_of_map(colors, seen)
    return points_from_depth(depth, view.intrinsics, of_map, None, ~solid & (depth > 0))
