"""Preview, TrackerPhase -> nothing: the map as it grows in a web browser, by viser."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import viser

from msgs import Preview, TrackerPhase
from mvsgs_core.geometry import quaternion_from_rotation
from nodes import Node

_PHOTO_WIDTH = 320  # pixels of the pictures beside the scene: enough to compare, quick to send
_PATH_COLOR = (230, 90, 40)
_OLD_COLOR, _NEW_COLOR = (90, 110, 140), (230, 90, 40)


class Viewer(Node):
    """A page with the splats, a frustum for each keyframe seen, the path, and the newest photo beside its render.

    Lengths are divided by the first preview's median distance, so that any map fits the browser's near and far planes.
    Keyframes stand where the newest preview has them: later corrections move their frustums with the splats.
    """

    @dataclass
    class Config:
        host: str = "127.0.0.1"  # address to listen at; 0.0.0.0 opens the page to the whole network, without password
        port: int = 8080  # of the page; the next free one if it is taken
        keep_open: bool = False  # after the end of the run, until the page's button or Ctrl-C closes it
        max_frustums: int = 200  # keyframes drawn; beyond, the oldest go

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c = self.config
        self.server = viser.ViserServer(host=c.host, port=c.port, label="MVS-GS", verbose=False)
        self.url = f"http://{c.host}:{self.server.get_port()}"
        self.stats.values["url"] = self.url
        if self.server.get_port() != c.port:
            self.stats.warn(f"port {c.port} is taken: the viewer is at {self.url}")
        logging.info("viewer at %s", self.url)
        self.closed = threading.Event()
        self._iterations = 0  # of the map that is shown
        self.unit: float | None = None  # map units in one unit of the page
        self._frustums: dict[int, viser.CameraFrustumHandle] = {}  # by keyframe
        self._splats: viser.GaussianSplatHandle | None = None
        self._phase = "initializing"  # what the tracker does
        self._shown = "waiting for the first keyframe"
        self._status = self.server.gui.add_markdown("")
        self._show_status()
        blank = np.zeros((2, 2, 3), np.uint8)
        self._photo = self.server.gui.add_image(blank, label="photo", format="jpeg")
        self._render = self.server.gui.add_image(blank, label="render", format="jpeg")
        if c.keep_open:
            self.server.gui.add_button("Close").on_click(lambda _: self.closed.set())

    def on_preview(self, preview: Preview) -> Iterator[None]:
        with self.stats.time("show"), self.server.atomic():
            if self.unit is None:
                self._begin(preview)
            self._show_splats(preview)
            self._move_keyframes(preview)
            self._show_keyframe(preview)
            self._show_path()
            self._photo.image, self._render.image = _thumbnail(preview.image), _thumbnail(preview.render)
            self._iterations = preview.iterations
            self._shown = f"keyframe **{preview.index}**, {len(preview.means)} splats, {preview.iterations} iterations"
            self._show_status()
        self.stats.count("previews")
        yield from ()

    def on_tracker_phase(self, message: TrackerPhase) -> Iterator[None]:
        self._phase = message.phase
        self._show_status()
        yield from ()

    def on_end(self) -> Iterator[None]:
        if self.config.keep_open:
            self._status.content = f"{self._shown}: {self._ending()}"
            logging.info("the run is over; %s stays open until its button Close is pressed", self.url)
            self.stats.values["kept_open"] = True  # the launcher waits for nothing else
            self.closed.wait()
        self.server.stop()
        yield from ()

    def _show_status(self) -> None:
        self._status.content = f"tracker: **{self._phase}**; {self._shown}"

    def _ending(self) -> str:
        """What is shown once nothing more comes: the map as the mapper left it, or an earlier state of it."""
        done = [stats["values"].get("iterations") for stats in self.upstream.values() if "values" in stats]
        whole = max((number for number in done if isinstance(number, int)), default=0)
        if 0 < whole == self._iterations:
            return "**finished**"
        return f"the run is over; the map went on to {whole} iterations, which were not shown" if whole else "**over**"

    def _begin(self, preview: Preview) -> None:
        """Unit, up direction and first view of the page, all from the first keyframe."""
        pose = preview.world_from_cam
        distances = np.linalg.norm(preview.means - pose[:3, 3], axis=1)
        median = float(np.median(distances)) if distances.size else 1.0
        self.unit = median if np.isfinite(median) and median > 0 else 1.0
        position = pose[:3, 3] / self.unit
        self.server.scene.set_up_direction(tuple(-pose[:3, 1]))
        self.server.initial_camera.position = tuple(position - 0.6 * pose[:3, 2] - 0.25 * pose[:3, 1])
        self.server.initial_camera.look_at = tuple(position + pose[:3, 2])

    def _show_splats(self, preview: Preview) -> None:
        assert self.unit is not None
        known = np.isfinite(preview.means).all(axis=1) & np.isfinite(preview.covariances).all(axis=(1, 2))
        if not known.all():
            self.stats.warn("splats that are not finite were left out of the view")
        if not known.any():
            return
        arrays = {
            "centers": (preview.means[known] / self.unit).astype(np.float32),
            "covariances": (preview.covariances[known] / self.unit**2).astype(np.float32),
            "rgbs": preview.colors[known],
            "opacities": preview.opacities[known, None],
        }
        if self._splats is None:
            self._splats = self.server.scene.add_gaussian_splats("/splats", **arrays)
        else:
            self._splats.set_gaussians(**arrays)

    def _move_keyframes(self, preview: Preview) -> None:
        """Earlier frustums to where corrections have put them since; those that the map no longer has go."""
        assert self.unit is not None
        if preview.keyframes is None or preview.keyframe_poses is None:
            return
        poses = dict(zip(preview.keyframes.tolist(), preview.keyframe_poses))
        for index, frustum in list(self._frustums.items()):
            pose = poses.get(index)
            if pose is None:
                self._frustums.pop(index).remove()
                continue
            position, rotation = pose[:3, 3] / self.unit, quaternion_from_rotation(pose[:3, :3])
            if not np.allclose(frustum.position, position, rtol=0.0, atol=1e-5):
                frustum.position = position
            if not np.allclose(frustum.wxyz, rotation, rtol=0.0, atol=1e-5):
                frustum.wxyz = rotation

    def _show_keyframe(self, preview: Preview) -> None:
        assert self.unit is not None
        for frustum in self._frustums.values():
            if frustum.color != _OLD_COLOR:
                frustum.color = _OLD_COLOR
        height, width = preview.image.shape[:2]
        self._frustums[preview.index] = self.server.scene.add_camera_frustum(
            f"/keyframes/{preview.index}",
            fov=2.0 * float(np.arctan(0.5 * height / preview.intrinsics[1])),
            aspect=width / height,
            scale=0.04,
            thickness=1.5,
            thickness_units="screen",
            color=_NEW_COLOR,
            wxyz=quaternion_from_rotation(preview.world_from_cam[:3, :3]),
            position=preview.world_from_cam[:3, 3] / self.unit,
        )
        while len(self._frustums) > self.config.max_frustums:
            self._frustums.pop(next(iter(self._frustums))).remove()

    def _show_path(self) -> None:
        """Lines between the keyframes drawn, in the order of the stream."""
        places = np.array([self._frustums[index].position for index in sorted(self._frustums)], dtype=np.float32)
        if len(places) < 2:
            return
        lines = np.stack([places[:-1], places[1:]], axis=1)
        self.server.scene.add_line_segments(
            "/path", lines, np.array(_PATH_COLOR, np.uint8), thickness=2.0, thickness_units="screen"
        )


def _thumbnail(image: np.ndarray) -> np.ndarray:
    step = max(1, image.shape[1] // _PHOTO_WIDTH)
    return np.ascontiguousarray(image[::step, ::step])
