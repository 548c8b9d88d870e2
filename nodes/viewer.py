"""Preview, TrackerPhase, SplatMap -> nothing: the map as it grows in a web browser, by viser."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import viser

from msgs import Preview, SplatMap, TrackerPhase
from mvsgs_core.export.ply import folded
from mvsgs_core.mapping.preview import gaussian_arrays, thinned
from mvsgs_core.setting_ranges import at_least
from nodes import Node
from nodes.keyframe_pictures import KeyframePictures, depth_points, pictures
from nodes.map_page import MapPage, check_address, escaped
from nodes.page_guard import check_names
from nodes.seen_keyframes import SeenKeyframe, SeenKeyframes

POLL = 0.25  # s between two looks at whether to stop, while the page is kept open
_FIGURES = ("nothing", "coverage", "error")  # that can color keyframes


class Viewer(Node):
    """A page with the splats, a frustum for each keyframe seen, the path, and pictures of the newest keyframe or one
    that is chosen.

    Lengths are divided by the first preview's median distance, so that any map fits the browser's near and far planes.
    Keyframes stand where the newest preview has them: later corrections move their frustums with the splats. The
    refined map is shown whole, and its keyframes as they are rendered from it.
    """

    @dataclass
    class Config:
        host: str = "127.0.0.1"  # address to listen at; 0.0.0.0 opens the page to the whole network, without password
        port: int = 8080  # of the page; the next free one if it is taken
        names: list[str] = field(default_factory=list)  # at which a proxy shows the page, such as maps.example.org
        keep_open: bool = False  # after the end of the run, until the page's button or Ctrl-C closes it
        max_frustums: int = 200  # keyframes drawn; beyond, the oldest go
        max_splats: int = 1000000  # of the refined map that are shown, spread over it

    config: Config

    @classmethod
    def check(cls, config: Config) -> None:
        at_least(config, max_frustums=0, max_splats=1)
        check_address(config.host, config.port)
        check_names(config.names, "names")

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c = self.config
        self.page = MapPage(c.host, c.port, c.names)
        self.server, self.url = self.page.server, self.page.url
        self.stats.values["url"] = self.url
        if c.port and self.server.get_port() != c.port:
            self.stats.warn(f"port {c.port} is taken: the viewer is at {self.url}")
        logging.info("viewer at %s", self.url)
        self.closed = threading.Event()
        self.seen = SeenKeyframes()
        self._showing = threading.RLock()  # the page calls from threads
        self._iterations = 0  # of the map that is shown
        self._phase = "initializing"  # what the tracker does
        self._pose_latency = ""  # of a live stream, and its other latencies
        self._map_latency = ""
        self._shown = "waiting for the first keyframe"
        self._memory = ""
        gui = self.server.gui
        self._status = gui.add_markdown("")
        self._show_status()
        self._follow = gui.add_checkbox("follow the camera", False)
        self.page.add_toggles()
        self._figure = gui.add_dropdown("color keyframes by", _FIGURES, initial_value="nothing")
        self._figure.on_update(lambda _: self._tint())
        self._newest = gui.add_checkbox("newest keyframe", True)
        self._newest.on_update(lambda _: self._show_chosen())
        self._slider: viser.GuiInputHandle[int] = gui.add_slider("keyframe", 0, 1, 1, 0, disabled=True)
        self._slider.on_update(lambda event: self._chosen() if event.client is not None else None)
        self._caption = gui.add_markdown("")
        self.pictures = KeyframePictures(gui)
        if c.keep_open:
            gui.add_button("Close").on_click(lambda _: self.closed.set())

    def on_preview(self, preview: Preview) -> Iterator[None]:
        with self.stats.time("show"), self._showing, self.server.atomic():
            if self.page.unit is None:
                self.page.begin(preview.world_from_cam, preview.means)
            if self.seen.final is None:
                self._show_splats(preview.means, preview.covariances, preview.colors, preview.opacities)
                self._iterations = preview.iterations
                self._say_shown(preview.index, len(preview.means))
            self._move_keyframes(preview)
            self.page.add_keyframe(preview.index, preview.world_from_cam, preview.intrinsics, preview.image.shape[:2])
            self.seen.add(
                SeenKeyframe.of(
                    preview.index, preview.world_from_cam, preview.intrinsics, preview.image, preview.render,
                    preview.depth,
                )
            )  # fmt: skip
            if preview.depth is not None:
                self.page.show_points(preview.index, *depth_points(preview.depth, preview.intrinsics, preview.image))
            if preview.keyframes is not None and preview.splats is not None:
                self.seen.splats = dict(zip(preview.keyframes.tolist(), preview.splats.tolist()))
            while len(self.page.frustums) > self.config.max_frustums:
                self._remove(next(iter(self.page.frustums)))
            self.page.show_path()
            self._fit_slider()
            self._tint()
            self._show_chosen()
            if self._follow.value:
                self.page.follow(preview.world_from_cam)
            if preview.memory:
                self._memory = f"; the mapper holds {preview.memory / 1e6:.0f} MB"
            if preview.latency is not None:
                to_map, to_preview = map(_milliseconds, preview.latency)
                self._map_latency = (
                    f"; capture to map {to_map}, to preview {to_preview}; effort of stereo and fusion, 0 the most: "
                    f"{preview.effort}, {preview.fusion_effort}"
                )
                if preview.coarse:
                    self._map_latency += f"; {preview.coarse} keyframes wait for the rest of their splats"
            self._show_status()
        self.stats.count("previews")
        yield from ()

    def on_splat_map(self, message: SplatMap) -> Iterator[None]:
        """The refined map in place of previews, whole."""
        if message.refined and len(message.means):
            with self.stats.time("show"), self._showing, self.server.atomic():
                final = self.seen.finish(message)
                if self.page.unit is None:
                    self.page.begin(final.relative_pose(message.world_from_cam[-1]), message.means)
                shown = thinned(folded(final.splats, final.kernel), self.config.max_splats)
                self._move(dict(zip(final.keyframes.tolist(), map(final.relative_pose, final.world_from_cam))))
                self._show_splats(**gaussian_arrays(shown))
                self._iterations = message.iterations
                self._shown = f"the **refined** map, {len(shown)} splats, {message.iterations} iterations"
                self._show_chosen()
                self._show_status()
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
            self._await_closing()
        self.server.stop()
        yield from ()

    def _await_closing(self) -> None:
        """Until the page is closed there, or by Ctrl-C: where all nodes are one process that is a KeyboardInterrupt."""
        with suppress(KeyboardInterrupt):
            while not self.closed.wait(POLL):
                self.rest()

    def choose(self, place: int) -> None:
        """Shows the keyframe at this place of the slider, from 0, instead of the newest."""
        with self._showing:
            _set(self._newest, False)
            _set(self._slider, place)
            self._show_chosen()

    def _chosen(self) -> None:
        """The slider was moved."""
        with self._showing:
            _set(self._newest, False)
            self._show_chosen()

    def _show_chosen(self) -> None:
        with self._showing:
            keyframe = self.seen.at(None if self._newest.value else int(self._slider.value))
            if keyframe is None:
                return
            self.page.mark(keyframe.index)
            shown = self.seen.shown(keyframe)
            self.pictures.show(pictures(*shown))
            self._caption.content = self.seen.caption(keyframe, *shown)

    def _fit_slider(self) -> None:
        self._slider.disabled = len(self.seen) < 2
        self._slider.max = max(1, len(self.seen) - 1)  # type: ignore[attr-defined]  # of sliders alone
        if self._newest.value:
            _set(self._slider, max(0, len(self.seen) - 1))

    def _tint(self) -> None:
        figure = str(self._figure.value)
        self.page.tint({} if figure == "nothing" else self.seen.goodness(figure))

    def _show_splats(
        self, means: np.ndarray, covariances: np.ndarray, colors: np.ndarray, opacities: np.ndarray
    ) -> None:
        if self.page.show_splats(means, covariances, colors, opacities):
            self.stats.warn("splats that are not finite were left out of the view")

    def _say_shown(self, index: int, splats: int) -> None:
        self._shown = f"keyframe **{index}**, {splats} splats, {self._iterations} iterations"

    def _show_status(self) -> None:
        self._status.content = (
            f"tracker: **{escaped(self._phase)}**{self._pose_latency}; {self._shown}{self._map_latency}{self._memory}"
        )

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
        self._move(dict(zip(preview.keyframes.tolist(), preview.keyframe_poses)))

    def _move(self, poses: dict[int, np.ndarray]) -> None:
        for index in list(self.page.frustums):
            if index in poses:
                self.page.move_keyframe(index, poses[index])
                self.seen.move(index, poses[index])
            else:
                self._remove(index)

    def _remove(self, index: int) -> None:
        self.page.remove_keyframe(index)
        self.seen.remove(index)


def _set(handle: viser.GuiInputHandle[Any], value: Any) -> None:
    handle.value = value  # type: ignore[misc]  # viser's setter


def _milliseconds(latency: np.ndarray) -> str:
    median, p99 = 1e3 * latency
    return f"{median:.0f} ms (99 %: {p99:.0f} ms)"
