"""A page in a web browser with a map: its splats, a frustum for each keyframe and the path between them, by viser."""

from __future__ import annotations

import re
import socket
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import viser

from mvsgs_core.geometry import quaternion_from_rotation
from nodes.page_guard import guarded, in_address

_PATH_COLOR = (230, 90, 40)
_PLAIN_COLOR, _MARKED_COLOR = (90, 110, 140), (230, 90, 40)
_WORST, _BEST = (215, 48, 39), (69, 117, 180)  # of a figure that colors keyframes
_POINT = 0.004  # size of a depth point, page units
_BEHIND = 0.6, 0.25  # of the page's unit: as far the view stands behind a camera and above it


def check_address(host: str, port: int, dashes: str = "") -> None:
    """Raises ValueError where no page can be: viser would wait for it without a word. dashes: of the option's name."""
    if not 0 <= port <= 65535:
        raise ValueError(f"{dashes}port={port}: must be 1 to 65535, or 0 for any that is free")
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as tried:
            tried.bind(place)
    except (OSError, UnicodeError) as error:
        raise ValueError(
            f"{dashes}host={host}: must be an address of this machine, 127.0.0.1 or 0.0.0.0 ({error})"
        ) from error


def escaped(text: str) -> str:
    """Text from outside, such as a path, as it stands: the page's markdown renders HTML."""
    return re.sub(r"[^\w ]|_", lambda found: f"&#{ord(found[0])};", text)


class MapPage:
    """The page. Lengths in it are divided by the `unit` that `begin` finds, so that any map fits the browser's near and
    far planes; what it is given is in the map's own unit, relative to one origin. No other page can read it.
    """

    def __init__(self, host: str, port: int, names: Sequence[str] = ()) -> None:
        """Listens at `port`, or at the next free one if it is taken. names: at which a proxy shows it. Raises
        ValueError, see `check_address`."""
        check_address(host, port)
        with guarded(host, names):
            self.server = viser.ViserServer(host=host, port=port, label="MVS-GS", verbose=False)
        self.url = f"http://{in_address(host)}:{self.server.get_port()}"
        self.unit: float | None = None  # map units in one unit of the page
        self.splats: viser.GaussianSplatHandle | None = None
        self.path: viser.LineSegmentsHandle | None = None
        self.frustums: dict[int, viser.CameraFrustumHandle] = {}  # by keyframe
        self.points: dict[int, viser.PointCloudHandle] = {}  # by keyframe
        self._marked: int | None = None
        self._tints: dict[int, tuple[int, int, int]] = {}  # of keyframes, instead of the plain color
        self._visible = {"splats": True, "depth points": False, "keyframes": True, "path": True}

    def begin(self, world_from_cam: np.ndarray, means: np.ndarray) -> None:
        """Unit, up direction and first view of the page, all from a camera (4, 4) and splats (N, 3)."""
        distances = np.linalg.norm(means - world_from_cam[:3, 3], axis=1)
        median = float(np.median(distances)) if distances.size else 1.0
        self.unit = median if np.isfinite(median) and median > 0 else 1.0
        position = world_from_cam[:3, 3] / self.unit
        self.server.scene.set_up_direction(tuple(-world_from_cam[:3, 1]))
        self.server.initial_camera.position = tuple(self._behind(world_from_cam))
        self.server.initial_camera.look_at = tuple(position + world_from_cam[:3, 2])

    def _behind(self, world_from_cam: np.ndarray) -> np.ndarray:
        assert self.unit is not None
        back, above = _BEHIND
        axes = world_from_cam[:3, :3]
        return np.asarray(world_from_cam[:3, 3] / self.unit - back * axes[:, 2] - above * axes[:, 1])

    def follow(self, world_from_cam: np.ndarray) -> None:
        """All who look at the page look over the shoulder of a camera (4, 4)."""
        assert self.unit is not None
        ahead = world_from_cam[:3, 3] / self.unit + world_from_cam[:3, 2]
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.up_direction = -world_from_cam[:3, 1]
                client.camera.position = self._behind(world_from_cam)
                client.camera.look_at = ahead

    def look(self, client: viser.ClientHandle, index: int) -> None:
        """One who looks at the page sees what a keyframe sees, as high."""
        frustum = self.frustums[index]
        with client.atomic():
            client.camera.wxyz, client.camera.position = frustum.wxyz, frustum.position
            client.camera.fov = frustum.fov

    def add_toggles(self) -> None:
        """A box for each kind of thing, by which it is shown or not."""
        for name, visible in self._visible.items():
            self.server.gui.add_checkbox(name, visible).on_update(partial(self._switched, name))

    def _switched(self, name: str, event: Any) -> None:
        self.set_visible(name, event.target.value)

    def set_visible(self, name: str, visible: bool) -> None:
        """Of splats, depth points, keyframes or path: those that are there, and those that come."""
        self._visible[name] = visible
        handles: dict[str, list[Any]] = {
            "splats": [self.splats], "depth points": list(self.points.values()),
            "keyframes": list(self.frustums.values()), "path": [self.path],
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

    def show_points(self, index: int, points: np.ndarray, colors: np.ndarray, alone: bool = False) -> None:
        """Of a keyframe that is there, (N, 3) in its camera's axes, map units, and (N, 3) uint8: they move with it.

        alone: those of other keyframes go.
        """
        assert self.unit is not None
        for other in list(self.points) if alone else [index] if index in self.points else []:
            self.points.pop(other).remove()
        frustum = self.frustums[index]
        self.points[index] = self.server.scene.add_point_cloud(
            f"/points/{index}", (points / self.unit).astype(np.float32), colors, point_size=_POINT,
            precision="float32", wxyz=frustum.wxyz, position=frustum.position, visible=self._visible["depth points"],
        )  # fmt: skip

    def mark(self, index: int | None) -> None:
        """Shows one keyframe in another color than all others."""
        self._marked = index
        for other, frustum in self.frustums.items():
            color = _MARKED_COLOR if other == index else self._tints.get(other, _PLAIN_COLOR)
            if frustum.color != color:
                frustum.color = color

    def tint(self, goodness: Mapping[int, float]) -> None:
        """Colors keyframes from red, 0, to blue, 1; those that are not given are plain."""
        worst, best = np.array(_WORST), np.array(_BEST)
        self._tints = {}
        for index, part in goodness.items():
            r, g, b = (worst + np.clip(part, 0.0, 1.0) * (best - worst)).round().astype(int).tolist()
            self._tints[index] = (r, g, b)
        self.mark(self._marked)

    def move_keyframe(self, index: int, world_from_cam: np.ndarray) -> None:
        assert self.unit is not None
        position, rotation = world_from_cam[:3, 3] / self.unit, quaternion_from_rotation(world_from_cam[:3, :3])
        for moved in (self.frustums[index], self.points.get(index)):
            if moved is not None and not np.allclose(moved.position, position, rtol=0.0, atol=1e-5):
                moved.position = position
            if moved is not None and not np.allclose(moved.wxyz, rotation, rtol=0.0, atol=1e-5):
                moved.wxyz = rotation

    def remove_keyframe(self, index: int) -> None:
        self.frustums.pop(index).remove()
        if index in self.points:
            self.points.pop(index).remove()

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
