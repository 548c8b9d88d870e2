"""What the guides show in Python runs as it stands there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mvsgs_core.datasets as datasets
from launch.compose import compose
from launch.inline import run_inline
from launch.named_input import with_named_input
from mvsgs import GaussianMap, Mapping
from mvsgs_core.bad_file import BadFileError
from mvsgs_core.export.keyframe_images import write_image
from tests.support.sequences import synthetic
from tests.support.shared_data import ROOT

pytestmark = pytest.mark.slow

GUIDES = ROOT / "docs" / "guides"
SMALL = ("mapper.iterations=3", "mapper.refinement=3", "device=cpu", "mapper.threads=1", "tracker.threads=1")
ROOM: dict[str, Any] = {"frames": 26, "size": (96, 128)}


def code(document: Path) -> str:
    """The one block of a document that is a whole program, or the longest."""
    return max(re.findall(r"^```python\n(.*?)^```", document.read_text(), re.DOTALL | re.MULTILINE), key=len)


def test_the_programs_of_the_readme(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    items = synthetic(**ROOM)
    program = code(ROOT / "README.md")
    words, camera = ", ".join(f'"{word}"' for word in SMALL), str(items[0].intrinsics.tolist())
    for shown, small in (('"mapper.iterations=100"', words), ("[610, 610, 320, 240]", camera)):
        assert shown in program
        program = program.replace(shown, small)
    names = {"frames": [(item.image, item.timestamp) for item in items]}
    exec(program, names)
    assert len(GaussianMap.load("runs/kitchen")) > 0


def test_the_node_of_the_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_fusion.py").write_text(code(GUIDES / "node.md"))
    monkeypatch.chdir(tmp_path)
    items = synthetic(**ROOM)
    words = ("depth_fusion._target_=my_fusion.Confident", "depth_fusion.confidence=0.7")
    with Mapping(*SMALL, *words, poses=True, intrinsics=items[0].intrinsics) as mapping:
        for item in items[:12]:
            mapping.add(item.image, item.timestamp, pose=item.world_from_cam)
    assert mapping.statistics["depth_fusion"]["counts"]["pixels left out"] > 0
    assert len(mapping.map) > 100


@pytest.mark.parametrize("blind", [False, True])
def test_the_source_of_the_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blind: bool) -> None:
    program = re.findall(r"^```python\n(.*?)^```", (GUIDES / "data_set.md").read_text(), re.DOTALL | re.MULTILINE)[-1]
    if blind:  # the other way that the guide tells of
        lines = [line for line in program.splitlines() if "yield GroundTruth" not in line]
        program = "\n".join(lines).replace("Iterator[Frame | GroundTruth]", "Iterator[Frame]")
    name = f"camera_of_the_guide_{blind}"
    (tmp_path / f"{name}.py").write_text(program)
    monkeypatch.chdir(tmp_path)
    items = synthetic(**ROOM)
    writer = cv2.VideoWriter("walk.avi", cv2.VideoWriter_fourcc(*"MJPG"), 30.0, ROOM["size"][::-1])
    for item in items:
        writer.write(cv2.cvtColor(item.image, cv2.COLOR_RGB2BGR))
    writer.release()
    words = [f"dataset._target_={name}.Camera", "dataset.video=walk.avi", f"dataset.focal={items[0].intrinsics[0]}"]
    found = run_inline(compose([*SMALL, *words, "output=out", *(["evaluator=off"] if blind else [])]))
    assert found["dataset"].stats.warnings == []
    assert len(GaussianMap.load("out")) > 100
    assert Path("out/report.json").exists() != blind


def test_the_reader_of_the_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readers, recording = tmp_path / "readers", tmp_path / "recording"
    readers.mkdir()
    (readers / "of_the_guide.py").write_text(code(GUIDES / "data_set.md"))
    monkeypatch.setattr(datasets, "__path__", [*datasets.__path__, str(readers)])
    monkeypatch.setitem(datasets._READERS, "of_the_guide", type)  # gone after the test
    images = np.random.default_rng(0).integers(0, 255, (3, 24, 32, 3), dtype=np.uint8)
    for index, image in enumerate(images):
        write_image(recording, index, image)
    (recording / "frames.csv").write_text("".join(f"{k / 10},{k:06d}.png\n" for k in range(3)))
    (recording / "camera.txt").write_text("30 30 15.5 11.5 32 24\n")

    found = list(datasets.open_dataset("of_the_guide", path=recording, stride=2))
    assert [item.timestamp for item in found] == [0.0, 0.2]
    np.testing.assert_array_equal(found[1].image, images[2])
    assert found[0].intrinsics.tolist() == [30, 30, 15.5, 11.5]
    assert with_named_input([str(recording)], [])[0] == "dataset=of_the_guide"
    (recording / "frames.csv").write_text("0.0,../elsewhere.png\n")
    with pytest.raises(BadFileError, match=r"frames\.csv is no table of frames"):
        datasets.open_dataset("of_the_guide", path=recording)
