"""The viewer: a page that answers, and a browser's connection that gets the splats, frustums and pictures."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msgs import Preview, SplatMap, TrackerPhase
from mvsgs_core.photometry import vignetting_factor
from mvsgs_core.rasterizer.interface import as_bytes
from mvsgs_core.rasterizer.kernels import gaussian_std_ratio
from nodes import handlers, outputs
from nodes.runtime.signals import Stopped
from nodes.splat_map import splat_map
from nodes.viewer import Viewer
from tests.support.ports import free_port
from tests.support.shared_data import ROOT
from tests.support.tiny_map import INTRINSICS, SIZE, final_map, poses_around
from tests.support.viewer_page import page


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    node = Viewer(Viewer.Config(port=free_port(), max_frustums=3))
    yield node
    node.server.stop()


def preview(index: int, splats: int = 50, scale: float = 1.0) -> Preview:
    rng = np.random.default_rng(index)
    pose = np.eye(4)
    pose[:3, 3] = scale * np.array([0.1 * index, 0.0, 0.0])
    return Preview(
        index=index,
        iterations=10 * index,
        world_from_cam=pose,
        intrinsics=np.array([500.0, 500.0, 319.5, 239.5]),
        image=rng.integers(0, 255, (480, 640, 3), dtype=np.uint8),
        render=rng.integers(0, 255, (480, 640, 3), dtype=np.uint8),
        means=(scale * rng.normal((0, 0, 2), 0.3, (splats, 3))).astype(np.float32),
        covariances=np.tile(np.eye(3, dtype=np.float32) * np.float32(1e-4 * scale**2), (splats, 1, 1)),
        colors=rng.integers(0, 255, (splats, 3), dtype=np.uint8),
        opacities=rng.uniform(0, 1, splats).astype(np.float32),
    )


def show(viewer: Viewer, message: Preview) -> None:
    assert list(viewer.on_preview(message)) == []


def received(viewer: Viewer) -> str:
    """What a browser gets on connecting, as text to search for names in."""
    viewer.server.flush()
    return page(viewer.url)


def test_reads_previews_and_sends_nothing() -> None:
    assert handlers(Viewer) == {
        Preview: "on_preview", TrackerPhase: "on_tracker_phase", SplatMap: "on_splat_map",
    }  # fmt: skip
    assert outputs(Viewer) == ()


def test_page_answers_on_loopback_only(viewer: Viewer) -> None:
    with urllib.request.urlopen(viewer.url, timeout=10) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()
    assert viewer.server.get_host() == "127.0.0.1"
    assert viewer.stats.values["url"] == viewer.url


def test_browser_gets_splats_frustums_and_pictures(viewer: Viewer) -> None:
    for index in (4, 9):
        show(viewer, preview(index))
    got = received(viewer)
    for name in ("GaussianSplats", "/splats", "/keyframes/4", "/keyframes/9", "/path", "photograph", "render"):
        assert name in got, name
    assert "keyframe **9**, 50 splats, 90 iterations" in got


def test_the_trackers_phase_is_shown(viewer: Viewer) -> None:
    assert "tracker: **initializing**; waiting for the first keyframe" in received(viewer)
    assert list(viewer.on_tracker_phase(TrackerPhase(7, 0.35, "tracking"))) == []
    show(viewer, preview(9))
    assert "tracker: **tracking**; keyframe **9**" in received(viewer)
    assert list(viewer.on_tracker_phase(TrackerPhase(30, 1.5, "relocalizing"))) == []
    assert "tracker: **relocalizing**; keyframe **9**" in received(viewer)


def test_latencies_and_efforts_of_a_live_stream_are_shown(viewer: Viewer) -> None:
    list(viewer.on_tracker_phase(TrackerPhase(7, 0.35, "tracking", np.array([0.02, 0.08]))))
    shown = replace(preview(9), latency=np.array([[0.9, 1.8], [0.4, 1.2]]), effort=2, fusion_effort=1, coarse=5)
    show(viewer, shown)
    got = received(viewer)
    assert "capture to pose 20 ms (99 %: 80 ms)" in got
    assert "capture to map 900 ms (99 %: 1800 ms), to preview 400 ms (99 %: 1200 ms)" in got
    assert "0 the most: 2, 1; 5 keyframes wait for the rest of their splats" in got


def test_map_is_shown_at_unit_distance_whatever_its_scale(viewer: Viewer) -> None:
    show(viewer, preview(0, scale=1e4))
    splats = viewer.server.scene.get_handle_by_name("/splats")
    assert splats is not None
    assert np.median(np.linalg.norm(splats.centers, axis=1)) == pytest.approx(1.0, rel=1e-3)
    assert viewer.page.unit == pytest.approx(2e4, rel=0.1)
    expected = preview(0, scale=1e4).covariances[0, 0, 0] / viewer.page.unit**2
    assert splats.covariances[0, 0, 0] == pytest.approx(expected, rel=2e-3)  # half precision


def test_map_grows_and_oldest_frustums_go(viewer: Viewer) -> None:
    for index in range(5):
        show(viewer, preview(index, splats=20 + index))
    splats = viewer.server.scene.get_handle_by_name("/splats")
    assert splats is not None
    assert len(splats.centers) == 24
    drawn = [viewer.server.scene.get_handle_by_name(f"/keyframes/{index}") is not None for index in range(5)]
    assert drawn == [False, False, True, True, True]


def test_frustums_follow_corrections(viewer: Viewer) -> None:
    for index in (0, 1):
        show(viewer, preview(index))
    assert viewer.page.unit is not None
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[0, :3, 3] = viewer.page.unit * np.array([0.0, 3.0, 0.0])
    poses[1, :3, 3] = preview(2).world_from_cam[:3, 3]
    moved = replace(preview(2), keyframes=np.array([0, 2]), keyframe_poses=poses, origin=np.zeros(3))
    show(viewer, moved)
    first, gone, newest = (viewer.server.scene.get_handle_by_name(f"/keyframes/{index}") for index in range(3))
    assert first is not None
    assert newest is not None
    assert gone is None  # the map begins anew or has dropped it
    np.testing.assert_allclose(first.position, [0.0, 3.0, 0.0], atol=1e-5)
    show(viewer, preview(3))  # says nothing of the others: they stay
    assert viewer.server.scene.get_handle_by_name("/keyframes/0") is not None


def test_what_is_switched_off_stays_off_for_what_comes(viewer: Viewer) -> None:
    show(viewer, preview(1))
    for name in ("keyframes", "path"):
        viewer.page.set_visible(name, False)
    show(viewer, preview(2))
    show(viewer, preview(3))
    scene = viewer.server.scene
    assert [scene.get_handle_by_name(f"/keyframes/{index}").visible for index in (1, 2, 3)] == [False] * 3  # type: ignore[union-attr]
    assert not scene.get_handle_by_name("/path").visible  # type: ignore[union-attr]
    assert scene.get_handle_by_name("/splats").visible  # type: ignore[union-attr]
    viewer.page.set_visible("keyframes", True)
    assert scene.get_handle_by_name("/keyframes/1").visible  # type: ignore[union-attr]
    assert "keyframes" in received(viewer)


def test_splats_that_are_not_finite_are_left_out_and_said(viewer: Viewer) -> None:
    bad = preview(1)
    bad.means[7] = np.nan
    show(viewer, bad)
    splats = viewer.server.scene.get_handle_by_name("/splats")
    assert splats is not None
    assert len(splats.centers) == 49
    assert "not finite" in viewer.stats.warnings[0]
    show(viewer, preview(2, splats=0))


def test_taken_port_is_said() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        node = Viewer(Viewer.Config(port=port))
        assert node.server.get_port() != port
        assert str(port) in node.stats.warnings[0]
        node.server.stop()


@pytest.mark.parametrize(
    ("given", "said"), [({"port": 65536}, "port=65536: must"), ({"host": "no host"}, "host=no host")]
)
def test_a_page_that_cannot_be_is_refused_before_a_run_and_by_itself(given: dict[str, Any], said: str) -> None:
    for refused in (Viewer.check, Viewer):
        with pytest.raises(ValueError, match=said):
            refused(Viewer.Config(**given))
    Viewer.check(Viewer.Config())


@pytest.mark.parametrize(("last", "said"), [(90, "**finished**"), (80, "the map went on to 90 iterations")])
def test_finished_is_said_only_of_the_map_as_the_mapper_left_it(last: int, said: str) -> None:
    node = Viewer(Viewer.Config(port=free_port(), keep_open=True))
    show(node, replace(preview(1), iterations=last))
    node.upstream = {"tracker": {"counts": {}, "values": {"frames": 9}}, "mapper": {"values": {"iterations": 90}}}
    node.closed.set()
    assert list(node.on_end()) == []
    assert said in node._status.content
    assert ("finished" in node._status.content) == (last == 90)


def with_depth(index: int, covered: float = 0.5, **more: Any) -> Preview:
    depth = np.full((120, 160), 2.0, np.float32)
    depth[: round(120 * (1 - covered))] = 0.0
    return replace(preview(index), depth=depth, memory=410_000_000, **more)


def test_memory_and_splats_by_keyframe_are_shown(viewer: Viewer) -> None:
    poses = np.stack([preview(index).world_from_cam for index in (4, 9)])
    show(viewer, with_depth(4))
    show(viewer, with_depth(9, keyframes=np.array([4, 9]), keyframe_poses=poses, splats=np.array([30, 12])))
    got = received(viewer)
    assert "the mapper holds 410 MB" in got
    assert "keyframe **9**, 640x480; 12 splats came from it; depth 2 to 2, 50 % covered; mean error" in got


def test_the_slider_goes_through_the_keyframes_seen(viewer: Viewer) -> None:
    for index in (4, 9, 12):
        show(viewer, with_depth(index))
    assert not viewer._slider.disabled
    assert (viewer._slider.max, viewer._slider.value) == (2, 2)
    viewer.choose(0)
    assert "keyframe **4**" in viewer._caption.content
    assert not viewer._newest.value
    show(viewer, with_depth(15))  # the oldest goes, the choice stays at its place
    assert "keyframe **9**" in viewer._caption.content
    handles = viewer.pictures.handles
    assert [name for name, handle in handles.items() if handle.visible] == ["photograph", "render", "depth"]
    viewer.pictures.set_visible("error", True)
    viewer.pictures.set_visible("depth", False)
    show(viewer, preview(20))
    viewer._newest.value = True
    viewer._show_chosen()
    assert "keyframe **20**" in viewer._caption.content
    assert [name for name, handle in handles.items() if handle.visible] == ["photograph", "render", "error"]


def test_depth_points_lie_where_the_keyframe_sees_them(viewer: Viewer) -> None:
    show(viewer, with_depth(4))
    points = viewer.page.points[4]
    assert not points.visible
    viewer.page.set_visible("depth points", True)
    assert points.visible
    unit = viewer.page.unit
    assert unit is not None
    np.testing.assert_allclose(points.points[:, 2] * unit, 2.0, rtol=1e-5)
    rows = points.points[:, 1] * unit / 2.0 * 500.0 + 239.5  # where the photograph shows them
    assert rows.min() == pytest.approx(0.5 * 480 + 1.5, abs=0.1)  # what is not covered has none
    assert rows.max() <= 479.5
    np.testing.assert_allclose(points.position, viewer.page.frustums[4].position)


def test_keyframes_are_colored_by_how_well_the_map_shows_them(viewer: Viewer) -> None:
    for index, covered in ((4, 1.0), (9, 0.0), (12, 0.5)):
        show(viewer, with_depth(index, covered))
    viewer._figure.value = "coverage"
    viewer._tint()
    assert viewer.page.frustums[4].color == (69, 117, 180)
    assert viewer.page.frustums[9].color == (215, 48, 39)
    viewer._figure.value = "nothing"
    viewer._tint()
    assert viewer.page.frustums[4].color == viewer.page.frustums[9].color


def test_the_refined_map_is_shown_whole_and_rendered(viewer: Viewer) -> None:
    dark = np.zeros((*SIZE, 3), np.uint8)
    show(viewer, replace(preview(0), world_from_cam=np.eye(4), intrinsics=INTRINSICS, image=dark, render=dark))
    final = replace(final_map(), world_from_cam=poses_around([0.0]))
    list(viewer.on_splat_map(splat_map(final, refined=False)))
    assert "refined" not in viewer._status.content
    list(viewer.on_splat_map(splat_map(final, refined=True)))
    splats = viewer.server.scene.get_handle_by_name("/splats")
    assert splats is not None
    assert len(splats.centers) == len(final.splats)
    assert f"the **refined** map, {len(final.splats)} splats, 5 iterations" in received(viewer)
    expected = as_bytes(final.render(poses_around([0.0])[0], INTRINSICS, SIZE).color)
    assert np.abs(viewer.pictures.handles["render"].image.astype(int) - expected).max() <= 1
    assert viewer.page.frustums[0].position == pytest.approx(
        final.relative_pose(poses_around([0.0])[0])[:3, 3] / viewer.page.unit
    )
    show(viewer, preview(1))  # an older state comes late
    assert len(splats.centers) == len(final.splats)


def test_shapes_of_a_refined_map_become_scales(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[np.ndarray] = []
    monkeypatch.setattr(viewer, "_show_splats", lambda covariances, **_: shown.append(covariances))
    plain = replace(final_map(), world_from_cam=poses_around([0.0]))
    shaped = replace(plain.splats, betas=torch.full_like(plain.splats.betas, 4.0))
    for final in (plain, replace(plain, splats=shaped, kernel="exact")):
        list(viewer.on_splat_map(splat_map(final, refined=True)))
    ratio = float(gaussian_std_ratio(torch.tensor([4.0])))
    np.testing.assert_allclose(shown[1], ratio**2 * shown[0], rtol=1e-4)


def test_a_refined_keyframe_has_the_vignetting_of_its_photograph(viewer: Viewer) -> None:
    dark, vignetting = np.zeros((*SIZE, 3), np.uint8), np.array([-0.5, 0.1, 0.05], np.float32)
    show(viewer, replace(preview(0), world_from_cam=np.eye(4), intrinsics=INTRINSICS, image=dark, render=dark))
    final = replace(final_map(), world_from_cam=poses_around([0.0]), vignetting=vignetting)
    list(viewer.on_splat_map(splat_map(final, refined=True)))
    color = final.render(poses_around([0.0])[0], INTRINSICS, SIZE).color
    expected = as_bytes(color * torch.from_numpy(vignetting_factor(vignetting, INTRINSICS, SIZE))[..., None])
    assert np.abs(viewer.pictures.handles["render"].image.astype(int) - expected).max() <= 1


@pytest.mark.slow
def test_the_launcher_says_where_the_page_is_and_sums_up_before_it_is_closed(tmp_path: Path) -> None:
    command = [
        sys.executable,
        ROOT / "launch/run_all.py",
        "dataset=synthetic",
        "dataset.stop=10",
        "dataset.size=[60,80]",
    ]
    command += ["mapper.iterations=3", "mapper.refinement=5", "viewer=viser", "viewer.keep_open=true"]
    command += [f"viewer.port={free_port()}", f"output={tmp_path / 'out'}", "tracker=ground_truth"]
    with (tmp_path / "said").open("wb") as said:
        run = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT, cwd=tmp_path, start_new_session=True)
    try:
        until = time.monotonic() + 120
        while "stays open" not in (text := (tmp_path / "said").read_text()):
            assert time.monotonic() < until, text
            assert run.poll() is None, text
            time.sleep(0.1)
        place = text.index("viewer: http://127.0.0.1:")
        assert (
            place < text.index("keyframes   PSNR") < text.index(f"in {tmp_path / 'out'}: ") < text.index("stays open")
        )
        assert json.loads((tmp_path / "out/report.json").read_text()).get("finished", True)
        url = text[place:].split()[1]
        with urllib.request.urlopen(url, timeout=10) as answer:
            assert answer.status == 200
        assert "**finished**" in page(url)
        run.send_signal(signal.SIGINT)
        assert run.wait(10) == 0
        assert (tmp_path / "said").read_text().count("keyframes   PSNR") == 1
    finally:
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()


def test_ends_with_the_run_unless_kept_open() -> None:
    brief = Viewer(Viewer.Config(port=free_port()))
    assert list(brief.on_end()) == []
    with pytest.raises(OSError):
        urllib.request.urlopen(brief.url, timeout=2)
    kept = Viewer(Viewer.Config(port=free_port(), keep_open=True))
    show(kept, preview(1))
    ending = threading.Thread(target=lambda: list(kept.on_end()))
    ending.start()
    with urllib.request.urlopen(kept.url, timeout=10) as answer:
        assert answer.status == 200
    assert ending.is_alive()
    kept.closed.set()
    ending.join(timeout=15)
    assert not ending.is_alive()


def test_ctrl_c_closes_a_kept_page_in_a_run_of_one_process() -> None:
    kept = Viewer(Viewer.Config(port=free_port(), keep_open=True))
    ctrl_c = threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background it is ignored
    try:
        ctrl_c.start()
        assert list(kept.on_end()) == []
        ctrl_c.join()
    finally:
        signal.signal(signal.SIGINT, before)
    with pytest.raises(OSError):
        urllib.request.urlopen(kept.url, timeout=2)


def test_a_viewer_that_is_told_to_stop_stops_while_its_page_is_kept_open() -> None:
    kept = Viewer(Viewer.Config(port=free_port(), keep_open=True))

    def stop() -> None:
        raise Stopped(signal.SIGINT)

    kept.rest = stop
    with pytest.raises(Stopped):
        list(kept.on_end())
    kept.server.stop()
