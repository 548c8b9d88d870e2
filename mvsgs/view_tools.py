"""What can be done with a saved map in a browser: measure, crop, fly through it, export it.

Each tool is a part of the page; what it does is a method that needs no browser. Nothing is written on this machine that
stays: files are made aside and sent to whoever asked for them.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser

from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.command_line import FAILURES, why
from mvsgs_core.export.mesh import write_mesh
from mvsgs_core.export.picking import Box, Ruler, hit, kept
from mvsgs_core.export.ply import write_ply
from mvsgs_core.export.render_path import frames_along, resampled
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.export.splat import WRITERS
from mvsgs_core.geometry import rotation_from_quaternion
from mvsgs_core.video_file import write_video
from nodes.map_page import MapPage, escaped

_LINE = (230, 90, 40)
FPS = 30.0
VOXEL = 0.01  # of the mesh, in median depths
FORMATS = (".ply", *WRITERS, ".glb")
AXES = ("left to right", "front to back", "bottom to top")


class Newest:
    """Does a work one call at a time, whatever threads the page calls from. A call is left out where another one waits:
    what that reads as it begins is the newest."""

    def __init__(self, work: Callable[[], None], working: threading.Lock | None = None) -> None:
        """working: held meanwhile; works that share one wait for each other."""
        self._work, self._working, self._waiting = work, working or threading.Lock(), threading.Lock()

    def __call__(self) -> None:
        if self._waiting.acquire(blocking=False):
            with self._working:
                self._waiting.release()
                self._work()

    def moved(self, event: Any) -> None:
        """A call for what a hand changed in the page; who changes it from here calls by himself."""
        if event.client is not None:
            self()


def send(client: viser.ClientHandle, name: str, said: viser.GuiMarkdownHandle, write: Callable[[Path], str]) -> None:
    """Gives one who looks at the page a file of that name. `said` is what `write` returns, or why there is no file."""
    try:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / name
            told = write(file)
            client.send_file_download(name, file.read_bytes())
        said.content = told
    except InterruptedError:
        pass  # the page was closed: nobody is there to be told
    except FAILURES as error:
        said.content = escaped(why(error))


class Measuring:
    """Two clicks into the scene, and how far they are apart."""

    def __init__(self, page: MapPage, shown: Callable[[], Snapshot]) -> None:
        self.ruler, self._page, self._shown = Ruler(), page, shown
        gui = page.server.gui
        with gui.add_folder("measure", expand_by_default=False):
            self._on = gui.add_checkbox("by two clicks", False)
            self.said = gui.add_markdown("")
            self._length = gui.add_number("its true length", 0.0, min=0.0)
            gui.add_button("Take that as the scale").on_click(lambda _: self.calibrate(float(self._length.value)))
        page.server.scene.on_click()(self._clicked)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if self._on.value:
            self.click(np.array(event.ray_origin), np.array(event.ray_direction))

    def click(self, start: np.ndarray, direction: np.ndarray) -> None:
        """A ray (3,), (3,) in the page's units."""
        assert self._page.unit is not None
        found = hit(self._shown(), start * self._page.unit, direction)
        if found is None:
            self.said.content = "There is nothing of the map."
            return
        self.ruler.add(found)
        self._draw()

    def calibrate(self, length: float) -> None:
        try:
            self.ruler.calibrate(length)
        except ValueError as error:
            self.said.content = str(error)
            return
        self._draw()

    def _draw(self) -> None:
        assert self._page.unit is not None
        scene, points = self._page.server.scene, [point / self._page.unit for point in self.ruler.points]
        places = np.array(points, dtype=np.float32)
        scene.add_point_cloud("/ruler/ends", places, np.tile(_LINE, (len(places), 1)), point_size=0.012)
        distance = self.ruler.distance
        name = "map units" if self.ruler.factor == 1.0 else "true units"
        text = "one end" if distance is None else f"{distance:.4g} {name}"
        scene.add_label("/ruler/text", text, position=places.mean(axis=0), visible=distance is not None)
        line = places[None] if distance is not None else np.repeat(places, 2, axis=0)[None]
        scene.add_line_segments("/ruler/line", line, np.array(_LINE, np.uint8), thickness=3.0, thickness_units="screen")
        self.said.content = f"**{text}**" + ("" if self.ruler.factor == 1.0 else "; exports are in that unit")


class Cropping:
    """A box in which the map is kept; what is rendered, flown through and exported is what is shown."""

    def __init__(self, page: MapPage, final: Snapshot, axes: np.ndarray, changed: Callable[[Snapshot], None]) -> None:
        """axes: (3, 3) right, ahead and up of the scene; changed: called with what is left."""
        self._final, self._changed = final, changed
        self.box = Box.around(final.splats.means.numpy(), axes)
        self._cropping = Newest(self._crop)
        gui = page.server.gui
        with gui.add_folder("crop", expand_by_default=False):
            self._sides = [gui.add_multi_slider(name, 0, 100, 1, (0, 100)) for name in AXES]
            self.said = gui.add_markdown("")
            gui.add_button("All of it").on_click(lambda _: self.crop(np.tile([0.0, 100.0], (3, 1))))
        for side in self._sides:
            side.on_update(self._cropping.moved)

    def crop(self, percent: np.ndarray) -> None:
        """To (3, 2) whole percent of the extent along each axis; nothing at all is refused."""
        for side, (low, high) in zip(self._sides, percent.round().astype(int).tolist()):
            side.value = (low, high)  # type: ignore[misc]  # viser's setter
        self._cropping()

    def _crop(self) -> None:
        percent = np.array([side.value for side in self._sides], dtype=float)
        chosen = self.box.inside(self._final.splats.means.numpy(), percent)
        if not chosen.any():
            self.said.content = "Nothing would be left."
            return
        left = self._final if chosen.all() else kept(self._final, chosen)
        self.said.content = f"{len(left.splats)} of {len(self._final.splats)} splats"
        self._changed(left)


class Flight:
    """A path of views, rendered to a video."""

    def __init__(
        self, page: MapPage, shown: Callable[[], Snapshot], intrinsics: np.ndarray, size: tuple[int, int],
        keyframes: np.ndarray, closed: threading.Event,
    ) -> None:  # fmt: skip
        """The camera's intrinsics (4,) and size (height, width); keyframes (K, 4, 4) relative to the map's origin;
        closed: ends what is being rendered."""
        self.poses: list[np.ndarray] = []
        self._page, self._shown, self._intrinsics, self._size = page, shown, intrinsics, size
        self._rendering, self._closed = threading.Lock(), closed
        gui = page.server.gui
        with gui.add_folder("path", expand_by_default=False):
            gui.add_button("Add this view").on_click(self._add_view)
            if len(keyframes):
                gui.add_button("Along the keyframes").on_click(lambda _: self.take(list(keyframes)))
            gui.add_button("Begin anew").on_click(lambda _: self.take([]))
            self._seconds = gui.add_number("seconds", 5.0, min=0.1, max=600.0)
            gui.add_button("Render to H.264").on_click(self._download)
            self.said = gui.add_markdown("no views")

    def take(self, poses: list[np.ndarray]) -> None:
        """Views (4, 4) in place of those before."""
        assert self._page.unit is not None
        self.poses = list(poses)
        scene = self._page.server.scene
        if len(self.poses) > 1:
            places = np.array([pose[:3, 3] for pose in self.poses], np.float32) / self._page.unit
            scene.add_spline_catmull_rom("/flight", points=places, color=_LINE, thickness=2.0, thickness_units="screen")
        else:
            scene.remove_by_name("/flight")
        self.said.content = f"{len(self.poses)} views" if self.poses else "no views"

    def _add_view(self, event: viser.GuiEvent[Any]) -> None:
        assert self._page.unit is not None
        if event.client is not None:
            camera, pose = event.client.camera, np.eye(4)
            pose[:3, :3] = rotation_from_quaternion(camera.wxyz)
            pose[:3, 3] = camera.position * self._page.unit
            self.take([*self.poses, pose])

    def _download(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is None or not self._rendering.acquire(blocking=False):
            return
        try:
            send(event.client, "flight.mp4", self.said, self._write)
        finally:
            self._rendering.release()

    def _write(self, file: Path) -> str:
        return f"{self.render(file, float(self._seconds.value))} frames at {FPS:g} a second: {file.name}"

    def render(self, file: Path, seconds: float) -> int:
        """Writes the video, H.264; returns its frames. Raises OSError, also as the page is closed, and ValueError for
        less than two views."""
        if len(self.poses) < 2:
            raise ValueError("a path has two views or more")
        final = self._shown()
        path = resampled(np.stack(self.poses), max(2, round(FPS * seconds)))
        path[:, :3, 3] += final.origin

        def frames() -> Any:
            for k, frame in enumerate(frames_along(final, path, self._intrinsics, self._size)):
                if self._closed.is_set():
                    raise InterruptedError("the page was closed")
                if k % 10 == 0:
                    self.said.content = f"frame {k} of {len(path)}"
                yield frame

        return write_video(file, frames(), self._size, FPS)


class Exporting:
    """What is shown as a file, in the unit that was measured."""

    def __init__(
        self, page: MapPage, shown: Callable[[], Snapshot], factor: Callable[[], float], cameras: Cameras | None
    ) -> None:
        self._shown, self._factor, self._cameras = shown, factor, cameras
        self.writing = threading.Lock()  # one file at a time
        gui = page.server.gui
        with gui.add_folder("export", expand_by_default=False):
            formats = FORMATS if cameras is not None else FORMATS[:-1]
            self._format = gui.add_dropdown("format", formats, initial_value=FORMATS[0])
            gui.add_button("Export").on_click(self._download)
            self.said = gui.add_markdown("")

    def _download(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            with self.writing:
                send(event.client, f"map{self._format.value}", self.said, self._write)

    def _write(self, file: Path) -> str:
        self.write(file)
        return self.said_of(file)

    def said_of(self, file: Path) -> str:
        """What a user should know of a file that was written."""
        shaped = file.suffix != ".glb" and self._shown().kernel != "gaussian"
        told = "; shapes of splats became scales, as other viewers know no shapes" if shaped else ""
        return f"{file.name}: {file.stat().st_size} bytes{told}"

    def write(self, file: Path) -> None:
        """In the format of its suffix, for any viewer. Raises ValueError for one that there is not, OSError, and
        ImportError where there is no open3d for a mesh."""
        factor = self._factor()
        final = self._shown().scaled(factor)
        if file.suffix == ".glb" and self._cameras is not None:
            poses = self._cameras.world_from_cam.copy()
            poses[:, :3, 3] *= factor
            write_mesh(file, final, Cameras(**{**vars(self._cameras), "world_from_cam": poses}), VOXEL)
        elif file.suffix == ".ply":
            write_ply(file, final, fold=True)
        elif file.suffix in WRITERS:
            WRITERS[file.suffix](file, final)
        else:
            raise ValueError(f"no format {file.suffix!r} here")


__all__ = ["Cropping", "Exporting", "Flight", "Measuring", "Newest"]
