"""In a browser, the pages of a saved map and of a running one show what our own renderer shows from the same pose."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import viser

from msgs import Preview
from mvsgs.view import SavedMapView
from mvsgs_core.export.cameras import read_cameras, write_cameras
from mvsgs_core.export.ply import read_ply, write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping.preview import covariances
from mvsgs_core.rasterizer.interface import as_bytes
from mvsgs_core.rasterizer.spherical_harmonics import C0
from nodes.map_page import MapPage
from nodes.viewer import Viewer
from tests.support.chromium import Browser, browser
from tests.support.ports import free_port
from tests.support.tiny_map import INTRINSICS, SIZE, cameras_around, final_map

WINDOW = (480, 960)  # height, width of the window; the panel covers its right third
FOCAL = WINDOW[0] / SIZE[0] * INTRINSICS[1]  # the page's view is as high as the keyframe's
CAMERA = np.array([FOCAL, FOCAL, (WINDOW[1] - 1) / 2, (WINDOW[0] - 1) / 2])
SEEN = np.s_[160:460, 200:600]  # free of the panel, of messages and of the axes
ENOUGH, TOO_MUCH = 25.0, 20.0  # dB: of the same view, and of one that is wrong


@pytest.fixture(scope="module")
def window() -> Iterator[Browser]:
    with browser() as opened:
        opened.size(WINDOW[1], WINDOW[0])
        yield opened


def flat() -> Snapshot:
    """Colors do not depend on the direction, which a page does not show, nor is anything repeated in them."""
    final = final_map(size=(48, 64))
    final.splats.sh[:, 1:] = 0.0
    column, row = np.floor(final.splats.means[:, :2].numpy().T / 0.3).astype(int)
    colors = np.random.default_rng(1).uniform(0.05, 0.95, (50, 50, 3))[row, column]  # of tiles
    final.splats.sh[:, 0] = final.splats.sh.new_tensor((colors - 0.5) / C0)
    return final


def expected(final: Snapshot, pose: np.ndarray) -> np.ndarray:
    """(H, W, 3) of the window, before the page's white."""
    render = final.render(pose, CAMERA, WINDOW)
    return as_bytes(render.color + (1.0 - render.opacity[..., None]))


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((one[SEEN].astype(float) - other[SEEN]) ** 2)))


def client(page: MapPage) -> viser.ClientHandle:
    end = time.monotonic() + 60
    while not page.server.get_clients():
        assert time.monotonic() < end, "the browser does not connect"
        time.sleep(0.05)
    return next(iter(page.server.get_clients().values()))


def settled(window: Browser, wanted: Callable[[np.ndarray], bool], seconds: float = 60.0) -> np.ndarray:
    """A screenshot as soon as it is what is wanted, or the last one: splats are loaded and sorted one by one."""
    end = time.monotonic() + seconds
    while True:
        picture = window.screenshot()
        if wanted(picture) or time.monotonic() > end:
            return picture
        time.sleep(0.2)


def check(picture: np.ndarray, final: Snapshot, pose: np.ndarray) -> None:
    """It is that view, and what is wrong with pose, scale or colors shows."""
    own = expected(final, pose)
    assert psnr(picture, own) > ENOUGH
    turned, nearer = pose.copy(), pose.copy()
    turned[:3, 3] += 0.2 * pose[:3, 0]
    nearer[:3, 3] += 0.3 * pose[:3, 2]
    for wrong in (expected(final, turned), expected(final, nearer), own[..., ::-1], own[:, ::-1], own[::-1]):
        assert psnr(picture, wrong) < TOO_MUCH


@pytest.mark.slow
def test_a_saved_map_looks_as_our_own_render_of_it(window: Browser, tmp_path: Path) -> None:
    write_ply(tmp_path / "map.ply", flat())
    write_cameras(tmp_path / "cameras.json", cameras_around([0.0, 0.3, 0.6]))
    final, cameras = read_ply(tmp_path / "map.ply"), read_cameras(tmp_path / "cameras.json")
    page = MapPage("127.0.0.1", free_port())
    try:
        shown = SavedMapView(page, final, cameras, tmp_path, "tiny")
        for kind in ("keyframes", "path"):
            page.set_visible(kind, False)
        window.open(page.url)
        visitor = client(page)
        for k in (1, 2):
            shown.show(k)
            page.look(visitor, int(cameras.keyframes[k]))
            own = expected(final, cameras.world_from_cam[k])
            check(settled(window, lambda seen: psnr(seen, own) > ENOUGH), final, cameras.world_from_cam[k])  # noqa: B023
        assert window.errors == []
    finally:
        page.server.stop()


@pytest.mark.slow
def test_a_growing_map_looks_as_our_own_render_of_it(window: Browser) -> None:
    final, pose = flat(), cameras_around([0.3]).world_from_cam[0]
    splats = final.splats
    node = Viewer(Viewer.Config(port=free_port()))
    try:
        window.open(node.url)
        visitor = client(node.page)
        picture = np.zeros((*SIZE, 3), np.uint8)
        first = Preview(
            index=3, iterations=1, world_from_cam=final.relative_pose(pose), intrinsics=INTRINSICS, image=picture,
            render=picture, means=splats.means.numpy()[::2],
            covariances=covariances(splats.quaternions, splats.log_scales, 1.0).numpy()[::2],
            colors=as_bytes(0.5 + C0 * splats.sh[:, 0])[::2], opacities=splats.opacity_logits.sigmoid().numpy()[::2],
        )  # fmt: skip
        whole = replace(
            first, iterations=2, means=splats.means.numpy(),
            covariances=covariances(splats.quaternions, splats.log_scales, 1.0).numpy(),
            colors=as_bytes(0.5 + C0 * splats.sh[:, 0]), opacities=splats.opacity_logits.sigmoid().numpy(),
        )  # fmt: skip
        for preview in (first, whole):
            list(node.on_preview(preview))
        begun = node.page.server.initial_camera.position  # which the browser takes first
        settled(window, lambda _: bool(np.allclose(visitor.camera.position, begun, atol=1e-3)))
        node.page.set_visible("keyframes", False)
        node.page.look(visitor, 3)
        own = expected(final, pose)
        check(settled(window, lambda seen: psnr(seen, own) > ENOUGH), final, pose)
        node._follow.value = True  # type: ignore[misc]
        moved = whole.world_from_cam.copy()
        moved[0, 3] += 1.0
        before = visitor.camera.position
        list(node.on_preview(replace(whole, index=4, world_from_cam=moved)))
        assert node.page.unit is not None
        step = visitor.camera.position - before  # over the shoulder of a camera that is one unit to the right
        assert step[0] * node.page.unit == pytest.approx(1.0 + 0.6 * 0.0998 * node.page.unit, abs=0.01)
        text = window.evaluate("document.body.innerText")
        for said in (
            "tracker: initializing",
            "follow the camera",
            "depth points",
            "newest keyframe",
            "color keyframes by",
        ):
            assert said in text, said
        assert window.errors == []
    finally:
        node.server.stop()
