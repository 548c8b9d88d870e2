"""`mvsgs view`: the page of a saved map has its splats and keyframes, and the slider shows what each sees."""

from __future__ import annotations

import html
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvsgs import view
from mvsgs.view import SavedMapView
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.export.cameras import read_cameras
from mvsgs_core.export.keyframe_images import write_image
from mvsgs_core.export.ply import read_ply
from nodes.map_page import MapPage, escaped
from tests.support.ports import free_port
from tests.support.shared_data import ROOT
from tests.support.tiny_map import INTRINSICS, SIZE, write_tiny_run
from tests.support.viewer_page import page


@pytest.fixture
def shown(tmp_path: Path) -> Iterator[SavedMapView]:
    run = write_tiny_run(tmp_path / "run")
    write_image(run / "keyframes", 7, np.full((*SIZE, 3), 200, np.uint8))
    opened = MapPage("127.0.0.1", free_port())
    yield SavedMapView(opened, read_ply(run / "map.ply"), read_cameras(run / "cameras.json"), run / "keyframes", "tiny")
    opened.server.stop()


def test_the_page_has_splats_keyframes_and_the_path(shown: SavedMapView) -> None:
    got = page(shown.page.url)
    for name in ("GaussianSplats", "/splats", "/keyframes/0", "/keyframes/14", "/path", "3 keyframes", "Close"):
        assert name in got, name


def test_each_keyframe_shows_its_render_depth_and_photograph(shown: SavedMapView) -> None:
    renders = {}
    for k in (0, 1, 2):
        shown.show(k)
        renders[k] = shown.pictures.handles["render"].image
        assert shown.pictures.handles["photograph"].visible == (k == 1)
    assert renders[0].shape == (*SIZE, 3)
    assert not np.array_equal(renders[0], renders[2])
    shown.show(1)
    assert (shown.pictures.handles["photograph"].image == 200).all()
    assert "keyframe **7**, 32x24; depth" in shown._caption.content
    assert list(shown.page.points) == [7]
    marked = shown.page.frustums[7].color
    assert [shown.page.frustums[index].color == marked for index in (0, 7, 14)] == [False, True, False]


def test_a_frustum_that_is_clicked_is_shown_and_moves_the_slider(shown: SavedMapView) -> None:
    shown._choose(2, None)
    assert shown._slider.value == 2
    assert "keyframe **14**" in shown._caption.content
    assert shown.page.frustums[14].color != shown.page.frustums[0].color


def test_the_render_is_in_the_photographs_exposure(tmp_path: Path) -> None:
    run = write_tiny_run(tmp_path / "run")
    final, cameras = read_ply(run / "map.ply"), read_cameras(run / "cameras.json")
    opened = MapPage("127.0.0.1", free_port())
    try:
        plain = SavedMapView(opened, final, cameras, run, "tiny").pictures.handles["render"].image.astype(int)
        cameras.exposures[0, :, :3] *= 0.5
        darker = SavedMapView(opened, final, cameras, run, "tiny").pictures.handles["render"].image.astype(int)
        assert np.abs(plain - 2 * darker)[plain < 255].max() <= 2  # what is brighter is cut
        assert np.median(plain) > 50
    finally:
        opened.server.stop()


def test_text_from_outside_has_no_markup_in_it() -> None:
    name = "/maps/<img src=x onerror='alert(1)'>/![a](b.png) **_küche_**\n\n# 1 {&lt;}\udc80.ply"
    shown = escaped(name)
    assert not set(re.sub(r"&#\d+;", "", shown)) - set("küche alertmapsonigbyxrcp1 ")
    assert html.unescape(shown) == name.replace("\udc80", "\ufffd")


def page_without_cameras(folder: Path, name: str) -> str:
    """What the page of a map of that name gets, which has no cameras.json."""
    run = write_tiny_run(folder)
    opened = MapPage("127.0.0.1", free_port())
    try:
        SavedMapView(opened, read_ply(run / "map.ply"), None, run, name)
        return page(opened.url)
    finally:
        opened.server.stop()


def test_the_page_has_no_html_of_a_path(tmp_path: Path) -> None:
    got = page_without_cameras(tmp_path / "run", "<b>kitchen</b>/map.ply")
    assert "<b>" not in got
    assert "**&#60;b&#62;kitchen&#60;&#47;b&#62;&#47;map&#46;ply**" in got


def test_a_map_of_another_program_is_shown_without_keyframes(tmp_path: Path) -> None:
    got = page_without_cameras(tmp_path / "run", "tiny")
    assert "/splats" in got
    assert "no cameras.json beside this map" in got


@contextmanager
def started(run: Path, code: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process that shows the map of a run, and where: what it says first."""
    process = subprocess.Popen(
        [sys.executable, "-c", code, "view", str(run), "--port", str(free_port())],
        stdout=subprocess.PIPE, text=True, cwd=run.parent, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        said = process.stdout.readline()
        assert said.startswith(f"{run / 'map.ply'}: http://127.0.0.1:")
        time.sleep(0.1)
        yield process, said
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_the_command_says_where_the_page_is_and_ends_by_ctrl_c(tmp_path: Path) -> None:
    run = write_tiny_run(tmp_path / "run")
    with started(run, "import sys; from mvsgs.command import main; sys.exit(main())") as (process, said):
        assert "/splats" in page(said.split()[1].rstrip(";"))
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0


EXPORTING = """
import sys, time
from mvsgs import view
from mvsgs.command import main

class Exporting(view.SavedMapView):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.exporting.write = lambda file: time.sleep(120)
        self.page.server._thread_executor.submit(self.exporting._download, EVENT)

class EVENT:
    client = "somebody"

view.SavedMapView = Exporting
sys.exit(main())
"""


@pytest.mark.slow
def test_ctrl_c_ends_it_at_once_where_an_export_is_waited_for(tmp_path: Path) -> None:
    run = write_tiny_run(tmp_path / "run")
    with started(run, EXPORTING) as (process, _):
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        said = "closed; the export that is being made is waited for, a further Ctrl-C ends it"
        assert f"{run / 'map.ply'}: {said}\n" in (process.stdout.readline(), process.stdout.readline())  # viser's, too
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == -signal.SIGINT


def test_the_camera_of_videos_is_the_one_that_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = write_tiny_run(tmp_path / "run")
    words = [str(run), "--port", str(free_port()), "--size", "48", "64"]
    found = []

    def closed(*arguments: Any) -> SavedMapView:
        shown = SavedMapView(*arguments)
        shown.closed.set()
        found.append((shown.flight._intrinsics.tolist(), shown.flight._size))
        return shown

    monkeypatch.setattr(view, "SavedMapView", closed)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    assert view.main(words) == 0
    (run / "cameras.json").unlink()
    assert view.main([*words, "--intrinsics", "50", "51", "32", "24"]) == 0
    assert view.main(words[:-3]) == 0
    assert [size for _, size in found] == [(48, 64), (48, 64), (720, 1280)]
    np.testing.assert_allclose(found[0][0], scale_intrinsics(INTRINSICS, SIZE, (48, 64)))
    assert found[1][0] == [50.0, 51.0, 32.0, 24.0]


def test_a_camera_that_is_given_by_half_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_tiny_run(tmp_path / "run")
    (run / "cameras.json").unlink()
    assert view.main([str(run), "--size", "48", "64"]) == 1
    assert "give it with --cameras, or its --intrinsics and --size" in capsys.readouterr().err


def test_what_cannot_be_shown_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert view.main([str(tmp_path / "nothing.ply")]) == 1
    assert capsys.readouterr().err.startswith(f"view: {tmp_path / 'nothing.ply'} is missing: a map is")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--port", "70000"], "view: --port=70000: must be 1 to 65535"),
        (["--host", "not an address"], "view: --host=not an address: must be an address of this machine"),
    ],
)
def test_a_page_that_cannot_be_is_refused_and_not_waited_for(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert view.main([str(write_tiny_run(tmp_path / "run")), *words]) == 1
    assert capsys.readouterr().err.startswith(said)
