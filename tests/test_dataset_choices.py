"""The choices of the slot dataset: they compose, and list what their readers take."""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from launch.compose import compose
from launch.jobs import Job, run
from msgs import Frame, GroundTruth
from mvsgs_core.datasets import formats
from mvsgs_core.datasets.bag import Bag
from mvsgs_core.datasets.images import Images
from mvsgs_core.datasets.seven_scenes import SevenScenes
from mvsgs_core.datasets.synthetic import Film
from mvsgs_core.datasets.tum import Tum
from mvsgs_core.datasets.video import Video
from mvsgs_core.scene.difficulties import Difficulties
from nodes.reader import Reader
from tests.support.dataset_folders import write_photos
from tests.support.shared_data import ROOT


@pytest.mark.slow
@pytest.mark.parametrize(
    "choice",
    [
        "synthetic", "tum", "replica", "seven_scenes", "icl_nuim", "euroc", "kitti", "scannet", "sens", "images",
        "video", "bag", "camera", "robot", "ros2",
    ],
)  # fmt: skip
def test_every_dataset_choice_composes(choice: str) -> None:
    graph = compose([f"dataset={choice}"])
    live = choice in ("camera", "robot", "ros2")
    frames = [edge for edge in graph.out_of("dataset") if edge.message is Frame]
    assert frames
    assert all(edge.best_effort == live for edge in frames)
    assert all(not edge.best_effort for edge in graph.out_of("dataset") if edge.message is GroundTruth)


def test_options_of_a_choice_reach_the_reader(tmp_path: Path) -> None:
    folder = write_photos(tmp_path)
    graph = compose(
        ["dataset=images", f"dataset.path={folder}", "dataset.intrinsics=[50,50,31.5,23.5]", "dataset.options.rate=5"]
    )
    reader = Reader(Reader.Config(**graph.slots["dataset"].config))
    assert [m.timestamp for m in reader.run() if isinstance(m, Frame)][:2] == pytest.approx([0.0, 0.2])


def test_every_choice_has_all_options_of_its_format() -> None:
    def options(choice: str) -> set[str]:
        return set(compose([f"dataset={choice}"]).slots["dataset"].config["options"])

    own = {"path", "start", "stop", "stride", "size", "intrinsics", "distortion", "mask", "gps", "gps_start"}
    for name, reader in {"tum": Tum, "seven_scenes": SevenScenes, "images": Images, "video": Video, "bag": Bag}.items():
        assert options(name) == set(inspect.signature(reader).parameters) - own
    film = {field.name for kind in (Film, Difficulties) for field in dataclasses.fields(kind)}
    assert options("synthetic") == film - own


def test_every_format_has_a_choice_of_its_name() -> None:
    files = {file.stem: OmegaConf.load(file) for file in (ROOT / "launch/conf/dataset").glob("*.yaml")}
    readers = {name: config for name, config in files.items() if config._target_ == "nodes.reader.Reader"}
    assert {name: config.name for name, config in readers.items()} == {name: name for name in formats()}


@pytest.mark.parametrize("device", ["cuda:63", "cuda:first"])
def test_a_missing_gpu_of_one_slot_is_refused_too(
    device: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = OmegaConf.create(compose([f"mvs.device={device}", f"output={tmp_path / 'out'}"]).resolved)
    assert run(Job(config, [], {"dataset": "synthetic"}, None)) == 2
    assert f"error: mvs.device={device}: this machine has" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    "choice",
    [
        "tum",
        "replica",
        "seven_scenes",
        "icl_nuim",
        "euroc",
        "kitti",
        "scannet",
        "sens",
        "images",
        "video",
        "bag",
        "player",
    ],
)
@pytest.mark.parametrize("path", [None, "/nowhere/at/all"])
def test_a_missing_path_is_refused_before_a_process_starts(
    choice: str, path: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [f"dataset={choice}", f"output={tmp_path / 'out'}"] + ([f"dataset.path={path}"] if path else [])
    config = OmegaConf.create(compose(given).resolved)
    assert run(Job(config, [], {"dataset": choice}, None)) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: dataset.path={path}: " if choice == "player" else "error: dataset: ")
    assert "dataset.path" in said if path is None or choice == "player" else f"{path} is missing" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("choice", "name", "said"),
    [
        ("video", "walk.mp4", "cut off before its index was written"),
        ("player", "walk.mcap", "is no recording"),
        ("bag", "walk.bag", "is no bag that can be read"),
        ("images", "photos", "no image could be read"),
    ],
)
def test_input_that_cannot_be_read_is_refused_before_a_process_starts(
    choice: str, name: str, said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    if choice == "images":
        path.mkdir()
        path = path / "0.jpg"
    path.write_bytes(b"\x00\x00\x00\x20ftypisom" + bytes(2000))
    given = [f"dataset={choice}", f"dataset.path={tmp_path / name}", f"output={tmp_path / 'out'}"]
    config = OmegaConf.create(compose(given).resolved)
    assert run(Job(config, [], {"dataset": choice}, None)) == 2
    *before, error = capfd.readouterr().err.splitlines()
    assert error.startswith("error: dataset: ")
    assert said in error
    assert all(line.startswith("[mov,mp4") for line in before), "what FFmpeg says of it, and no traceback"
    assert not (tmp_path / "out").exists()
