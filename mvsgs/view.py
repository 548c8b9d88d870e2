"""`mvsgs view MAP`: a saved map in a web browser, with a slider through its keyframes: photograph, render and depth."""

from __future__ import annotations

import argparse
import contextlib
import io
import signal
import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser

from mvsgs_core.datasets.files import UnreadableImageError, read_image
from mvsgs_core.evaluation.scoring import colorize_depth
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.command_line import input_arguments, known_cameras, read_map, run
from mvsgs_core.export.keyframe_render import rendered_keyframe
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping.preview import as_bytes, covariances
from mvsgs_core.rasterizer.spherical_harmonics import C0
from nodes.map_page import MapPage, thumbnail


class SavedMapView:
    """The page of one saved map. `closed` is set by its button."""

    def __init__(self, page: MapPage, final: Snapshot, cameras: Cameras | None, photographs: Path, name: str) -> None:
        """photographs: folder with the keyframes' images, or one that is not there."""
        self.page, self.closed = page, threading.Event()
        self._showing = threading.Lock()
        self._final, self._cameras, self._photographs = final, cameras, photographs
        gui, splats = page.server.gui, final.splats
        means, colors = splats.means.numpy(), as_bytes(0.5 + C0 * splats.sh[:, 0])
        self._poses = (
            np.zeros((0, 4, 4)) if cameras is None else np.stack([*map(final.relative_pose, cameras.world_from_cam)])
        )
        page.begin(self._poses[0] if len(self._poses) else _outside(means), means)
        left_out = page.show_splats(
            means, covariances(splats.quaternions, splats.log_scales, 1.0).numpy(), colors,
            torch.sigmoid(splats.opacity_logits).numpy(),
        )  # fmt: skip
        said = f"**{name}**: {len(splats)} splats, {len(self._poses)} keyframes"
        gui.add_markdown(said + (f"; {left_out} splats that are not finite are not shown" if left_out else ""))
        page.add_toggles()
        if cameras is None:
            gui.add_markdown("There is no cameras.json beside this map, so that its keyframes are not known.")
        else:
            self._show_keyframes(cameras)
        gui.add_button("Close").on_click(lambda _: self.closed.set())

    def _show_keyframes(self, cameras: Cameras) -> None:
        for k, index in enumerate(cameras.keyframes.tolist()):
            frustum = self.page.add_keyframe(index, self._poses[k], cameras.intrinsics[k], cameras.sizes[k].tolist())
            frustum.on_click(partial(self._choose, k))
        self.page.show_path()
        gui, last = self.page.server.gui, len(cameras) - 1
        if last > 0:
            self._slider: viser.GuiInputHandle[int] = gui.add_slider("keyframe", 0, last, 1, 0)
            self._slider.on_update(lambda _: self.show(int(self._slider.value)))
        self._caption = gui.add_markdown("")
        gui.add_button("Look from here").on_click(self._look)
        blank = np.zeros((2, 2, 3), np.uint8)
        self._pictures = {name: gui.add_image(blank, label=name) for name in ("photograph", "render", "depth")}
        self.show(0)

    def _choose(self, k: int, _: Any) -> None:
        if len(self._poses) > 1:
            self._slider.value = k  # type: ignore[misc]  # viser's setter; it shows the keyframe
        else:
            self.show(k)

    def show(self, k: int) -> None:
        """Keyframe number k, from 0: its frustum is marked, its pictures are beside the scene."""
        with self._showing:  # the page calls from threads
            self._show(k)

    def _show(self, k: int) -> None:
        assert self._cameras is not None
        assert self.page.unit is not None
        self._shown = k
        index, (height, width) = int(self._cameras.keyframes[k]), self._cameras.sizes[k].tolist()
        self.page.mark(index)
        photograph = self._photograph(index)
        self._pictures["photograph"].visible = photograph is not None
        if photograph is not None:
            self._pictures["photograph"].image = thumbnail(photograph)
        color, render = rendered_keyframe(self._final, self._cameras, k)
        self._pictures["render"].image = thumbnail(as_bytes(color))
        self._pictures["depth"].image = thumbnail(colorize_depth(render.depth.numpy()))
        known = render.depth[render.opacity > 0.5]
        depths = f"; depth {_span(known.numpy())}" if len(known) else ""
        self._caption.content = f"keyframe **{index}**, {width}x{height}{depths}"

    def _photograph(self, index: int) -> np.ndarray | None:
        file = self._photographs / keyframe_images.image_name(index)
        try:
            return read_image(file) if file.is_file() else None
        except UnreadableImageError:
            return None

    def _look(self, event: Any) -> None:
        client: viser.ClientHandle | None = event.client
        if client is not None:
            frustum = self.page.frustums[list(self.page.frustums)[self._shown]]
            with client.atomic():
                client.camera.wxyz, client.camera.position = frustum.wxyz, frustum.position


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
    final, left_out = read_map(options)
    if not len(final.splats):
        raise ValueError(f"{options.map} has no splats: there is nothing to show")
    cameras = known_cameras(options)
    with contextlib.redirect_stdout(io.StringIO()):  # viser's own banner
        page = MapPage(options.host, options.port)
    shown = SavedMapView(page, final, cameras, options.map.with_name(keyframe_images.FOLDER), str(options.map))
    print(f"{options.map}: {page.url}{left_out}; the page's button Close or Ctrl-C ends it", flush=True)
    signal.signal(signal.SIGINT, lambda *_: shown.closed.set())
    shown.closed.wait()
    page.server.stop()
    return f"{options.map}: closed"


def main(arguments: list[str] | None = None, prog: str = "mvsgs view") -> int:
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    input_arguments(parser)
    parser.add_argument("--host", default="127.0.0.1", help="0.0.0.0 opens the page to the whole network")
    parser.add_argument("--port", type=int, default=8080, help="of the page; the next free one if it is taken")
    return run(parser, arguments, view)
