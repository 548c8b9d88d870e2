"""What the page of a saved map can do, without a browser: measure, crop, fly, export."""

from __future__ import annotations

import html
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
import torch

from mvsgs import view_tools
from mvsgs.view import SavedMapView
from mvsgs_core.export import picking
from mvsgs_core.export.cameras import read_cameras
from mvsgs_core.export.ply import folded, read_ply, write_ply
from nodes.map_page import MapPage
from tests.support.ports import free_port
from tests.support.tiny_map import INTRINSICS, SIZE, final_map, write_tiny_run

BY_HAND = SimpleNamespace(client=SimpleNamespace(send_file_download=lambda name, content: None))  # an event
HALF = np.array([[0.0, 50.0], [0.0, 100.0], [0.0, 100.0]])


@pytest.fixture
def shown(tmp_path: Path) -> Iterator[SavedMapView]:
    run = write_tiny_run(tmp_path / "run")
    opened = MapPage("127.0.0.1", free_port())
    yield SavedMapView(
        opened, read_ply(run / "map.ply"), read_cameras(run / "cameras.json"), run / "keyframes", "tiny",
        (INTRINSICS, SIZE),
    )  # fmt: skip
    opened.server.stop()


def click(shown: SavedMapView, right: float, down: float = 0.0) -> np.ndarray:
    """From the first keyframe's place; where it meets the map, in the page."""
    pose = shown._poses[0]
    shown.measuring.click(pose[:3, 3] / shown.page.unit, pose[:3, :3] @ [right, down, 1.0])
    return shown.measuring.ruler.points[-1]


def test_two_clicks_measure_and_a_known_length_scales_what_is_exported(shown: SavedMapView, tmp_path: Path) -> None:
    one = click(shown, 0.1)
    other = click(shown, 0.4)
    distance = float(np.linalg.norm(other - one))
    assert f"**{distance:.4g} map units**" in shown.measuring.said.content
    shown.measuring.calibrate(10 * distance)
    assert f"**{10 * distance:.4g} true units**" in shown.measuring.said.content
    shown.exporting.write(tmp_path / "map.ply")
    scaled, before = read_ply(tmp_path / "map.ply"), shown._final
    np.testing.assert_allclose(
        scaled.splats.means.numpy() + scaled.origin, 10 * (before.splats.means.numpy() + before.origin), atol=1e-3
    )


def test_a_click_beside_the_map_is_said(shown: SavedMapView) -> None:
    pose = shown._poses[0]
    shown.measuring.click(pose[:3, 3] / shown.page.unit, -pose[:3, 2])
    assert shown.measuring.said.content == "There is nothing of the map."
    shown.measuring.calibrate(1.0)
    assert "measure a distance first" in shown.measuring.said.content


def test_what_is_cropped_is_gone_from_page_render_and_export(shown: SavedMapView, tmp_path: Path) -> None:
    before, whole = shown.pictures.handles["render"].image.copy(), len(shown._final.splats)
    shown.cropping.crop(HALF)
    splats = shown.page.splats
    assert splats is not None
    assert 0.3 * whole < len(splats.centers) < 0.7 * whole
    after = shown.pictures.handles["render"].image
    assert (after.sum(axis=2) == 0).mean() > (before.sum(axis=2) == 0).mean() + 0.05
    for suffix in (".ply", ".splat", ".spz"):
        shown.exporting.write(tmp_path / f"map{suffix}")
    assert len(read_ply(tmp_path / "map.ply").splats) == len(splats.centers)
    assert (tmp_path / "map.splat").stat().st_size == 32 * len(splats.centers)
    shown.cropping.crop(np.array([[49.9, 49.9]] * 3))
    assert shown.cropping.said.content == "Nothing would be left."
    shown.cropping.crop(np.tile([0.0, 100.0], (3, 1)))
    assert len(splats.centers) == whole


def test_shapes_of_splats_become_scales_on_the_page_and_in_what_is_exported(tmp_path: Path) -> None:
    """As browsers and other viewers know only Gaussians."""
    run = write_tiny_run(tmp_path / "run")
    write_ply(run / "map.ply", final_map(1, "exact"))
    opened = MapPage("127.0.0.1", free_port())
    page = SavedMapView(opened, read_ply(run / "map.ply"), None, run / "keyframes", "tiny")
    page.exporting.write(tmp_path / "map.ply")
    opened.server.stop()
    written, plain = read_ply(tmp_path / "map.ply"), folded(page._final.splats, "exact")
    assert written.kernel == "gaussian"
    torch.testing.assert_close(written.splats.log_scales, plain.log_scales)
    assert opened.splats is not None
    assert opened.unit is not None
    shown = np.trace(opened.splats.covariances, axis1=1, axis2=2) * opened.unit**2
    np.testing.assert_allclose(shown, (2.0 * plain.log_scales).exp().sum(dim=1), rtol=2e-3)  # 16 bits
    assert "shapes of splats became scales" in page.exporting.said_of(tmp_path / "map.ply")
    (tmp_path / "map.glb").touch()
    assert page.exporting.said_of(tmp_path / "map.glb") == "map.glb: 0 bytes"


def test_a_path_is_rendered_to_a_video_that_begins_and_ends_where_it_does(shown: SavedMapView, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="two views or more"):
        shown.flight.render(tmp_path / "flight.mp4", 1.0)
    shown.flight.take(list(shown._poses))
    assert shown.flight.said.content == "3 views"
    assert shown.flight.render(tmp_path / "flight.mp4", 0.5) == 15
    with av.open(tmp_path / "flight.mp4") as video:
        assert video.streams.video[0].codec_context.name == "h264"
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in video.decode(video=0)]
    assert frames[0].shape == (*SIZE, 3)
    for frame, k in ((frames[0], 0), (frames[-1], 2)):
        shown.show(k)
        assert np.abs(frame - shown.pictures.handles["render"].image).mean() < 12  # chroma at half the size
    assert np.abs(frames[0] - frames[-1]).mean() > 24


def test_keyframes_are_colored_by_what_the_map_covers(shown: SavedMapView) -> None:
    shown.tint("coverage")
    colors = [shown.page.frustums[index].color for index in (7, 14)]
    assert len(set(colors)) == 2  # the last sees less of it
    shown.tint("nothing")
    assert shown.page.frustums[7].color == shown.page.frustums[14].color


def dragged(slider: Any, values: list[Any], slow: Callable[[], None]) -> None:
    """By a hand, as viser says it: each value is there before its event runs in a thread of a pool. The first event is
    at work, `slow`, as the others come."""
    with ThreadPoolExecutor(32) as pool:
        for value in values:
            slider._impl.value = value
            done = [pool.submit(call, BY_HAND) for call in slider._impl.update_cb]
            slow()
            assert slider.value == value, "it is moved under the hand"
    assert [call.result() for call in done] == [None] * len(done)
    assert slider.value == values[-1]


class Slow:
    """A function that takes its time, how often it is called and by how many at once."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self._lock = function, threading.Lock()
        self.calls = self.at_once = self.most = 0

    def __call__(self, *arguments: Any) -> Any:
        with self._lock:
            self.calls, self.at_once = self.calls + 1, self.at_once + 1
            self.most = max(self.most, self.at_once)
        time.sleep(0.05 if self.calls % 2 else 0.15)  # who began first is not done first
        found = self._function(*arguments)
        with self._lock:
            self.at_once -= 1
        return found


def test_a_crop_that_is_dragged_ends_where_the_hand_does(
    shown: SavedMapView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_tools, "kept", kept := Slow(picking.kept))
    dragged(shown.cropping._sides[0], [(0, percent) for percent in range(99, 49, -1)], lambda: time.sleep(0.01))
    assert kept.most == 1
    assert kept.calls < 40
    splats = shown.page.splats
    assert splats is not None
    seen = len(splats.centers)
    shown.exporting.write(tmp_path / "map.ply")
    assert len(read_ply(tmp_path / "map.ply").splats) == seen == len(shown._left.splats)
    shown.cropping.crop(HALF)
    assert len(splats.centers) == seen


def test_keyframes_that_are_passed_over_are_not_rendered(shown: SavedMapView, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shown, "_rendered", rendered := Slow(shown._rendered))
    dragged(shown._slider, [0, 1, 2] * 10 + [1], lambda: time.sleep(0.01))
    assert rendered.most == 1
    assert rendered.calls < 25
    assert "keyframe **7**" in shown._caption.content
    assert list(shown.page.points) == [7]
    marked = shown.page.frustums[7].color
    assert [shown.page.frustums[index].color == marked for index in (0, 7, 14)] == [False, True, False]


def test_a_video_ends_as_the_page_is_closed(shown: SavedMapView, tmp_path: Path) -> None:
    shown.flight.take(list(shown._poses))
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(shown.flight.render, tmp_path / "flight.mp4", 600.0)
        end = time.monotonic() + 30
        while "frame" not in shown.flight.said.content and time.monotonic() < end:
            time.sleep(0.01)
        shown.closed.set()
        with pytest.raises(OSError, match="the page was closed"):
            done.result(timeout=30)
    assert list(tmp_path.glob("**/*.mp4")) == []


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ImportError("open3d does not load: sudo apt install libegl1"), "sudo apt install libegl1"),
        (MemoryError("of the field"), "not enough memory: of the field"),
        (OSError("no space left"), "no space left"),
    ],
)
def test_why_there_is_no_file_is_said_in_the_page(
    shown: SavedMapView, error: Exception, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(view_tools, "write_mesh", failing)
    monkeypatch.setattr(view_tools, "write_video", failing)
    shown.exporting._format.value = ".glb"  # type: ignore[misc]
    shown.flight.take(list(shown._poses))
    for tool in (shown.exporting, shown.flight):
        tool._download(BY_HAND)  # type: ignore[arg-type]
        assert said in html.unescape(tool.said.content)
