"""A page in a web browser with a map: its splats, a frustum for each keyframe and the path between them, by viser."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import viser

from mvsgs_core.geometry import quaternion_from_rotation

PICTURE_WIDTH = 320  # pixels of the pictures beside the scene: enough to compare, quick to send
_PATH_COLOR = (230, 90, 40)
_PLAIN_COLOR, _MARKED_COLOR = (90, 110, 140), (230, 90, 40)


class MapPage:
    """The page. Lengths in it are divided by the `unit` that `begin` finds, so that any map fits the browser's near and
    far planes; what it is given is in the map's own unit, relative to one origin.
    """

    def __init__(self, host: str, port: int) -> None:
        """Listens at `port`, or at the next free one if it is taken."""
        self.server = viser.ViserServer(host=host, port=port, label="MVS-GS", verbose=False)
        self.url = f"http://{host}:{self.server.get_port()}"
        self.unit: float | None = None  # map units in one unit of the page
        self.splats: viser.GaussianSplatHandle | None = None
        self.path: viser.LineSegmentsHandle | None = None
        self.frustums: dict[int, viser.CameraFrustumHandle] = {}  # by keyframe
        self._visible = dict.fromkeys(("splats", "keyframes", "path"), True)

    def begin(self, world_from_cam: np.ndarray, means: np.ndarray) -> None:
        """Unit, up direction and first view of the page, all from a camera (4, 4) and splats (N, 3)."""
        distances = np.linalg.norm(means - world_from_cam[:3, 3], axis=1)
        median = float(np.median(distances)) if distances.size else 1.0
        self.unit = median if np.isfinite(median) and median > 0 else 1.0
        position = world_from_cam[:3, 3] / self.unit
        self.server.scene.set_up_direction(tuple(-world_from_cam[:3, 1]))
        behind = position - 0.6 * world_from_cam[:3, 2] - 0.25 * world_from_cam[:3, 1]
        self.server.initial_camera.position = tuple(behind)
        self.server.initial_camera.look_at = tuple(position + world_from_cam[:3, 2])

    def add_toggles(self) -> None:
        """A box for each kind of thing, by which it is shown or not."""
        for name, visible in self._visible.items():
            self.server.gui.add_checkbox(name, visible).on_update(partial(self._switched, name))

    def _switched(self, name: str, event: Any) -> None:
        self.set_visible(name, event.target.value)

    def set_visible(self, name: str, visible: bool) -> None:
        """Of splats, keyframes or path: those that are there, and those that come."""
        self._visible[name] = visible
        handles: dict[str, list[Any]] = {
            "splats": [self.splats], "keyframes": list(self.frustums.values()), "path": [self.path]
        }  # fmt: skip
        for handle in handles[name]:
            if handle is not None:
                handle.visible = visible

    def show_splats(self, means: np.ndarray, covariances: np.ndarray, colors: np.ndarray, opacities: np.ndarray) -> int:
        """(N, 3), (N, 3, 3), (N, 3) uint8 and (N,) in place of those before. Returns how many were left out, as a value
        of theirs is not finite."""
        assert self.unit is not None
        known = np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
        if known.any():
            arrays = {
                "centers": (means[known] / self.unit).astype(np.float32),
                "covariances": (covariances[known] / self.unit**2).astype(np.float32),
                "rgbs": colors[known],
                "opacities": opacities[known, None],
            }
            if self.splats is None:
                self.splats = self.server.scene.add_gaussian_splats(
                    "/splats", **arrays, visible=self._visible["splats"]
                )
            else:
                self.splats.set_gaussians(**arrays)
        return int((~known).sum())

    def add_keyframe(
        self, index: int, world_from_cam: np.ndarray, intrinsics: np.ndarray, size: Sequence[int]
    ) -> viser.CameraFrustumHandle:
        """A frustum for the keyframe of a camera (4, 4) with intrinsics (4,) at `size` (height, width)."""
        assert self.unit is not None
        height, width = size
        self.frustums[index] = self.server.scene.add_camera_frustum(
            f"/keyframes/{index}",
            fov=2.0 * float(np.arctan(0.5 * height / intrinsics[1])),
            aspect=width / height,
            scale=0.04,
            color=_PLAIN_COLOR,
            thickness=1.5,
            thickness_units="screen",
            wxyz=quaternion_from_rotation(world_from_cam[:3, :3]),
            position=world_from_cam[:3, 3] / self.unit,
            visible=self._visible["keyframes"],
        )
        return self.frustums[index]

    def mark(self, index: int) -> None:
        """Shows one keyframe in another color than all others."""
        for other, frustum in self.frustums.items():
            color = _MARKED_COLOR if other == index else _PLAIN_COLOR
            if frustum.color != color:
                frustum.color = color

    def move_keyframe(self, index: int, world_from_cam: np.ndarray) -> None:
        assert self.unit is not None
        frustum = self.frustums[index]
        position, rotation = world_from_cam[:3, 3] / self.unit, quaternion_from_rotation(world_from_cam[:3, :3])
        if not np.allclose(frustum.position, position, rtol=0.0, atol=1e-5):
            frustum.position = position
        if not np.allclose(frustum.wxyz, rotation, rtol=0.0, atol=1e-5):
            frustum.wxyz = rotation

    def remove_keyframe(self, index: int) -> None:
        self.frustums.pop(index).remove()

    def show_path(self) -> None:
        """Lines between the keyframes drawn, in the order of the stream."""
        places = np.array([self.frustums[index].position for index in sorted(self.frustums)], dtype=np.float32)
        if len(places) < 2:
            return
        lines = np.stack([places[:-1], places[1:]], axis=1)
        self.path = self.server.scene.add_line_segments(
            "/path", lines, np.array(_PATH_COLOR, np.uint8), thickness=2.0, thickness_units="screen",
            visible=self._visible["path"],
        )  # fmt: skip


def thumbnail(image: np.ndarray) -> np.ndarray:
    """An image (H, W, 3) as small as it is shown beside the scene."""
    step = max(1, image.shape[1] // PICTURE_WIDTH)
    return np.ascontiguousarray(image[::step, ::step])
