"""The examples of `Mapping` run as they stand, made small: the notebook's cells, the loop over a camera, the loss."""

from __future__ import annotations

import json
import re
import signal
import sys
import threading
from pathlib import Path
from typing import Any

import cv2
import pytest

from examples import camera_loop, my_loss
from msgs import Frame
from mvsgs import GaussianMap, Mapping
from mvsgs_core.image_metrics import psnr
from nodes import Node
from tests.support.sequences import synthetic
from tests.support.shared_data import ROOT

pytestmark = pytest.mark.slow

FRAMES, SIZE = 26, (96, 128)
SMALL = ("mapper.iterations=4", "mapper.refinement=12", "device=cpu", "mapper.threads=1", "tracker.threads=1")


def cells() -> list[str]:
    found = json.loads((ROOT / "examples" / "notebook.ipynb").read_text())["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == "code"]


def test_the_cells_of_the_notebook(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    items = synthetic(frames=FRAMES, size=SIZE)
    monkeypatch.setattr("mvsgs_core.datasets.open_dataset", lambda name, **options: items)
    names: dict[str, object] = {}
    for cell in cells():
        shown = re.sub(r"^settings = .*", f"settings = {list(SMALL)}", cell, flags=re.MULTILINE)
        exec(compile(shown, "notebook.ipynb", "exec"), names)
    said = capsys.readouterr().out
    assert float(re.search(r"never mapped: ([\d.]+) dB", said)[1]) > 24  # type: ignore[index]
    assert re.search(r"frame \d+: tracking, new keyframes \[0, ", said)
    assert "\ntracking at [" in said
    assert (tmp_path / "runs/notebook/room.splat").stat().st_size > 0


def test_no_output_is_kept_in_the_notebook() -> None:
    found = json.loads((ROOT / "examples" / "notebook.ipynb").read_text())["cells"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in found if "outputs" in cell)


def filmed(folder: Path) -> tuple[Path, list[str]]:
    """A video of the room, and its camera as words of the command line."""
    items, video = synthetic(frames=FRAMES, size=SIZE), folder / "walk.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, SIZE[::-1])
    for item in items:
        writer.write(cv2.cvtColor(item.image, cv2.COLOR_RGB2BGR))
    writer.release()
    return video, ["--intrinsics", *map(str, items[0].intrinsics.tolist())]


def test_the_loop_over_a_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video, camera = filmed(tmp_path)
    words = ["--video", str(video), *camera, "--save", str(tmp_path / "map"), *SMALL]
    camera_loop.main(["--every-frame", *words])
    said = capsys.readouterr().out
    assert re.search(r"tracking\n.*keyframe 0\n", said)
    assert f"saved in {tmp_path / 'map'}" in said
    assert len(GaussianMap.load(tmp_path / "map")) > 500
    newest = camera_loop.NewestFrame(cv2.VideoCapture(str(video)), rate=2000.0)
    taken = [seconds for _, seconds in newest]
    assert taken == sorted(taken)
    assert len(taken) + newest.left_out == FRAMES


def test_ctrl_c_in_the_midst_of_a_frame_leaves_the_camera_and_keeps_the_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen, before = [], signal.getsignal(signal.SIGINT)

    def observe(self: Mapping, slot: str, node: Node, message: Any) -> None:
        watched(self, slot, node, message)
        if isinstance(message, Frame):
            seen.append(message.index)
            if message.index == 15:
                signal.raise_signal(signal.SIGINT)

    watched = Mapping._observe
    monkeypatch.setattr(Mapping, "_observe", observe)
    video, camera = filmed(tmp_path)
    camera_loop.main(["--every-frame", "--video", str(video), *camera, "--save", str(tmp_path / "map"), *SMALL])
    assert seen == list(range(16))
    said = capsys.readouterr().out
    assert "the camera is left; the map is finished" in said
    assert f"saved in {tmp_path / 'map'}" in said
    assert len(GaussianMap.load(tmp_path / "map")) > 500
    assert signal.getsignal(signal.SIGINT) == before


def test_a_second_ctrl_c_ends_the_loop_at_once_and_a_camera_that_hangs_holds_up_none() -> None:
    class Hanging:
        def read(self) -> tuple[bool, None]:
            over.wait()
            return False, None

    over = threading.Event()
    try:
        with camera_loop.ctrl_c() as left:
            threading.Timer(0.1, signal.raise_signal, [signal.SIGINT]).start()
            assert list(camera_loop.NewestFrame(Hanging(), None, left)) == []  # type: ignore[arg-type]
            assert left.is_set()
            assert signal.getsignal(signal.SIGINT) == signal.SIG_DFL
    finally:
        over.set()


def test_the_loss_in_a_program_and_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    items, renders = synthetic(frames=FRAMES, size=SIZE), []
    for given in ({"loss": my_loss.robust}, {"named": "mapper.training.loss_function=my_loss.robust"}, {}):
        words = (*SMALL, given.pop("named")) if "named" in given else SMALL
        with Mapping(*words, poses=True, intrinsics=items[0].intrinsics, **given) as mapping:  # type: ignore[arg-type]
            for item in items[:14]:
                mapping.add(item.image, item.timestamp, pose=item.world_from_cam)
        renders.append(mapping.render(items[5].world_from_cam).image)
    assert (renders[0] == renders[1]).all()
    assert (renders[0] != renders[2]).any()
    assert psnr(renders[0] / 255.0, items[5].image / 255.0) > 20
    sys.modules.pop("my_loss")
