"""`mvsgs view MAP`: a saved map in a web browser, with its keyframes, to measure, crop, fly through and export it."""

from __future__ import annotations

import argparse
import contextlib
import io
import signal
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import viser

from mvsgs.view_tools import Cropping, Exporting, Flight, Measuring, Newest
from mvsgs_core.camera import resize_image, scale_intrinsics
from mvsgs_core.evaluation.ground_plane import ground_axes, up_direction
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.command_line import input_arguments, known_cameras, lens, read_map, run
from mvsgs_core.export.keyframe_render import rendered_keyframe
from mvsgs_core.export.ply import folded
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping.preview import gaussian_arrays, known_depth
from mvsgs_core.rasterizer.interface import as_bytes
from nodes.keyframe_pictures import KeyframePictures, depth_points, difference, pictures
from nodes.map_page import MapPage, check_address, escaped
from nodes.page_guard import check_names
from nodes.seen_keyframes import goodness

FIGURES = ("coverage", "error")  # that can color keyframes
_POINTS = 20000  # of the depth of the keyframe that is shown
_UNKNOWN = np.array([900.0, 900.0, 639.5, 359.5]), (720, 1280)  # camera of videos where nobody says it


class SavedMapView:
    """The page of one saved map. `closed` is set by its button."""

    def __init__(
        self, page: MapPage, final: Snapshot, cameras: Cameras | None, photographs: Path, name: str,
        camera: tuple[np.ndarray, tuple[int, int]] = _UNKNOWN,
    ) -> None:  # fmt: skip
        """photographs: folder with the keyframes' images, or one that is not there; camera: intrinsics (4,) and size
        (height, width) of videos."""
        self.page, self.closed = page, threading.Event()
        drawing = threading.Lock()
        self._showing, self._tinting = Newest(self._show, drawing), Newest(self._tint, drawing)
        self._final, self._cameras, self._photographs = final, cameras, photographs
        self._left = final  # of the map, where it is cropped
        gui, splats = page.server.gui, final.splats
        means = splats.means.numpy()
        self._poses = (
            np.zeros((0, 4, 4)) if cameras is None else np.stack([*map(final.relative_pose, cameras.world_from_cam)])
        )
        page.begin(self._poses[0] if len(self._poses) else _outside(means), means)
        left_out = self._show_splats(final)
        said = f"**{escaped(name)}**: {len(splats)} splats, {len(self._poses)} keyframes"
        gui.add_markdown(said + (f"; {left_out} splats that are not finite are not shown" if left_out else ""))
        page.add_toggles()
        if cameras is None:
            gui.add_markdown("There is no cameras.json beside this map, so that its keyframes are not known.")
        else:
            self._show_keyframes(cameras)
        self._add_tools(*camera)
        gui.add_button("Close").on_click(lambda _: self.closed.set())
        if cameras is not None:
            self.pictures = KeyframePictures(gui)
            self.show(0)

    def _show_splats(self, final: Snapshot) -> int:
        splats = folded(final.splats, final.kernel)  # browsers know only Gaussians
        return self.page.show_splats(**gaussian_arrays(splats))

    def _add_tools(self, intrinsics: np.ndarray, size: tuple[int, int]) -> None:
        rotations = self._poses[:, :3, :3] if len(self._poses) else np.eye(3)[None]
        axes = np.concatenate([ground_axes(rotations), up_direction(rotations)[None]])
        self.cropping = Cropping(self.page, self._final, axes, self._cropped)
        self.measuring = Measuring(self.page, lambda: self._left)
        self.flight = Flight(self.page, lambda: self._left, intrinsics, size, self._poses, self.closed)
        self.exporting = Exporting(self.page, lambda: self._left, lambda: self.measuring.ruler.factor, self._cameras)

    def _cropped(self, left: Snapshot) -> None:
        self._left = left
        self._show_splats(left)
        if self._cameras is not None:
            self._showing()

    def _show_keyframes(self, cameras: Cameras) -> None:
        for k, index in enumerate(cameras.keyframes.tolist()):
            frustum = self.page.add_keyframe(index, self._poses[k], cameras.intrinsics[k], cameras.sizes[k].tolist())
            frustum.on_click(partial(self._choose, k))
        self.page.show_path()
        gui, last = self.page.server.gui, len(cameras) - 1
        self._figure = gui.add_dropdown("color keyframes by", ("nothing", *FIGURES), initial_value="nothing")
        self._figure.on_update(self._tinting.moved)
        if last > 0:
            self._slider: viser.GuiInputHandle[int] = gui.add_slider("keyframe", 0, last, 1, 0)
            self._slider.on_update(self._showing.moved)
        self._caption = gui.add_markdown("")
        gui.add_button("Look from here").on_click(self._look)

    def _choose(self, k: int, _: Any) -> None:
        self.show(k)

    def show(self, k: int) -> None:
        """Keyframe number k, from 0: its frustum is marked, its pictures are beside the scene."""
        if len(self._poses) > 1:
            self._slider.value = k  # type: ignore[misc]  # viser's setter
        self._showing()

    def _show(self) -> None:
        assert self._cameras is not None
        self._shown = k = int(self._slider.value) if len(self._poses) > 1 else 0
        index, (height, width) = int(self._cameras.keyframes[k]), self._cameras.sizes[k].tolist()
        self.page.mark(index)
        photograph = keyframe_images.known_image(self._photographs, index)
        render, depth = self._rendered(self._cameras, k)
        self.pictures.show(pictures(photograph, render, depth))
        self.page.show_points(index, *depth_points(depth, self._cameras.intrinsics[k], render, _POINTS), alone=True)
        known = depth[depth > 0]
        depths = f"; depth {_span(known)}, {100 * (depth > 0).mean():.0f} % covered" if len(known) else ""
        self._caption.content = f"keyframe **{index}**, {width}x{height}{depths}"

    def _rendered(self, cameras: Cameras, k: int) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) uint8 and the depth (H, W), 0 where the map covers less than half of a pixel."""
        color, render = rendered_keyframe(self._left, cameras, k)
        return as_bytes(color), known_depth(render).numpy()

    def tint(self, figure: str) -> None:
        """Colors all keyframes by "coverage", or by the "error" of those with a photograph; or by "nothing"."""
        self._figure.value = figure  # type: ignore[misc]  # viser's setter
        self._tinting()

    def _tint(self) -> None:
        assert self._cameras is not None
        found, figure = {}, str(self._figure.value)
        for k in range(len(self._cameras)) if figure in FIGURES else ():
            if self.closed.is_set():
                return
            index, small = int(self._cameras.keyframes[k]), _small(self._cameras, k)
            render, depth = self._rendered(small, 0)
            if figure == "coverage":
                found[index] = float((depth > 0).mean())
            elif (photograph := keyframe_images.known_image(self._photographs, index)) is not None:
                size = (int(small.sizes[0, 0]), int(small.sizes[0, 1]))
                found[index] = goodness(float(difference(render, resize_image(photograph, size)).mean()))
        self.page.tint(found)

    def _look(self, event: Any) -> None:
        client: viser.ClientHandle | None = event.client
        if client is not None:
            self.page.look(client, list(self.page.frustums)[self._shown])


def _small(cameras: Cameras, k: int, width: int = 160) -> Cameras:
    """Keyframe number k alone, with a picture that is `width` pixels wide at most."""
    height, full = (int(side) for side in cameras.sizes[k])
    size = (max(1, round(height * min(width, full) / full)), min(width, full))
    intrinsics = scale_intrinsics(cameras.intrinsics[k], (height, full), size)
    return replace(cameras.chosen(slice(k, k + 1)), intrinsics=intrinsics[None], sizes=np.array([size]))


def _span(depths: np.ndarray) -> str:
    near, far = np.percentile(depths, (5, 95))
    return f"{near:.3g} to {far:.3g}"


def _outside(means: np.ndarray) -> np.ndarray:
    """A camera (4, 4) that has splats (N, 3) in front of it."""
    pose = np.eye(4)
    if len(means):
        low, high = np.nanpercentile(means, (5, 95), axis=0)
        pose[:3, 3] = 0.5 * (low + high) - (0.0, 0.0, np.linalg.norm(high - low))
    return pose


def view(options: argparse.Namespace) -> str:
    """Shows the map until it is closed. Raises ValueError, OSError."""
    check_address(options.host, options.port, dashes="--")
    check_names(options.name, "--name")
    final, left_out = read_map(options)
    if not len(final.splats):
        raise ValueError(f"{options.map} has no splats: there is nothing to show")
    cameras = known_cameras(options)
    said = cameras is not None or options.size is not None or options.intrinsics is not None
    camera = lens(options) if said else _UNKNOWN
    with contextlib.redirect_stdout(io.StringIO()):  # viser's own banner
        page = MapPage(options.host, options.port, options.name)
    photographs = options.map.with_name(keyframe_images.FOLDER)
    shown = SavedMapView(page, final, cameras, photographs, str(options.map), camera)
    print(f"{options.map}: {page.url}{left_out}; the page's button Close or Ctrl-C ends it", flush=True)
    signal.signal(signal.SIGINT, lambda *_: shown.closed.set())
    shown.closed.wait()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Python waits for what the page's threads still do
    page.server.stop()
    exporting = "; the export that is being made is waited for, a further Ctrl-C ends it"
    return f"{options.map}: closed{exporting if shown.exporting.writing.locked() else ''}"


def main(arguments: list[str] | None = None, prog: str = "mvsgs view") -> int:
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    input_arguments(parser)
    parser.add_argument("--host", default="127.0.0.1", help="0.0.0.0 opens the page to the whole network")
    parser.add_argument("--port", type=int, default=8080, help="of the page; the next free one if it is taken")
    parser.add_argument(
        "--name", action="append", default=[], help="at which a proxy shows the page, such as maps.example.org"
    )
    return run(parser, arguments, view)
