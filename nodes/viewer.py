"""Preview, TrackerPhase -> nothing: the map as it grows in a web browser, by viser."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msgs import Preview, TrackerPhase
from nodes import Node
from nodes.map_page import MapPage, thumbnail


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
        self.page = MapPage(c.host, c.port)
        self.server, self.url = self.page.server, self.page.url
        self.stats.values["url"] = self.url
        if self.server.get_port() != c.port:
            self.stats.warn(f"port {c.port} is taken: the viewer is at {self.url}")
        logging.info("viewer at %s", self.url)
        self.closed = threading.Event()
        self._iterations = 0  # of the map that is shown
        self._phase = "initializing"  # what the tracker does
        self._pose_latency = ""  # of a live stream, and its other latencies
        self._map_latency = ""
        self._shown = "waiting for the first keyframe"
        self._status = self.server.gui.add_markdown("")
        self._show_status()
        blank = np.zeros((2, 2, 3), np.uint8)
        self._photo = self.server.gui.add_image(blank, label="photo", format="jpeg")
        self._render = self.server.gui.add_image(blank, label="render", format="jpeg")
        self.page.add_toggles()
        if c.keep_open:
            self.server.gui.add_button("Close").on_click(lambda _: self.closed.set())

    def on_preview(self, preview: Preview) -> Iterator[None]:
        with self.stats.time("show"), self.server.atomic():
            if self.page.unit is None:
                self.page.begin(preview.world_from_cam, preview.means)
            if self.page.show_splats(preview.means, preview.covariances, preview.colors, preview.opacities):
                self.stats.warn("splats that are not finite were left out of the view")
            self._move_keyframes(preview)
            self.page.add_keyframe(preview.index, preview.world_from_cam, preview.intrinsics, preview.image.shape[:2])
            self.page.mark(preview.index)
            while len(self.page.frustums) > self.config.max_frustums:
                self.page.remove_keyframe(next(iter(self.page.frustums)))
            self.page.show_path()
            self._photo.image, self._render.image = thumbnail(preview.image), thumbnail(preview.render)
            self._iterations = preview.iterations
            self._shown = f"keyframe **{preview.index}**, {len(preview.means)} splats, {preview.iterations} iterations"
            if preview.latency is not None:
                to_map, to_preview = map(_milliseconds, preview.latency)
                self._map_latency = (
                    f"; capture to map {to_map}, to preview {to_preview}; effort of stereo and fusion, 0 the most: "
                    f"{preview.effort}, {preview.fusion_effort}"
                )
            self._show_status()
        self.stats.count("previews")
        yield from ()

    def on_tracker_phase(self, message: TrackerPhase) -> Iterator[None]:
        self._phase = message.phase
        if message.latency is not None:
            self._pose_latency = f"; capture to pose {_milliseconds(message.latency)}"
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
        self._status.content = f"tracker: **{self._phase}**{self._pose_latency}; {self._shown}{self._map_latency}"

    def _ending(self) -> str:
        """What is shown once nothing more comes: the map as the mapper left it, or an earlier state of it."""
        done = [stats["values"].get("iterations") for stats in self.upstream.values() if "values" in stats]
        whole = max((number for number in done if isinstance(number, int)), default=0)
        if 0 < whole == self._iterations:
            return "**finished**"
        return f"the run is over; the map went on to {whole} iterations, which were not shown" if whole else "**over**"

    def _move_keyframes(self, preview: Preview) -> None:
        """Earlier frustums to where corrections have put them since; those that the map no longer has go."""
        if preview.keyframes is None or preview.keyframe_poses is None:
            return
        poses = dict(zip(preview.keyframes.tolist(), preview.keyframe_poses))
        for index in list(self.page.frustums):
            if index in poses:
                self.page.move_keyframe(index, poses[index])
            else:
                self.page.remove_keyframe(index)


def _milliseconds(latency: np.ndarray) -> str:
    median, p99 = 1e3 * latency
    return f"{median:.0f} ms (99 %: {p99:.0f} ms)"
