"""A bare word on the command line: what it is taken for, and what is said where that cannot be told."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import Writer

from launch.compose import choices_of, compose
from launch.named_input import with_named_input
from launch.refusal import GraphError
from launch.run_all import hydra_arguments
from mvsgs_core.datasets import recognized
from tests.support.dataset_folders import (
    colmap_text,
    write_icl_nuim,
    write_image,
    write_photos,
    write_replica,
    write_seven_scenes,
    write_tum,
)
from tests.support.shared_data import shared
from tests.support.slam_folders import (
    write_euroc,
    write_kitti,
    write_kitti_raw,
    write_scannet,
    write_tartanair,
    write_tum_vi,
)

CHOICES = choices_of("dataset")


def meant(*words: str) -> list[str]:
    return with_named_input(words, CHOICES)


def video(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "walk.mp4").touch()
    return folder / "walk.mp4"


def bag(folder: Path) -> Path:
    folder.mkdir()
    (folder / "metadata.yaml").touch()
    return folder


def recording(folder: Path) -> Path:
    folder.mkdir()
    (folder / "recording.mcap").touch()
    return folder / "recording.mcap"


def bag_file(folder: Path) -> Path:
    folder.mkdir()
    (folder / "walk_0.db3").touch()
    return folder / "walk_0.db3"


def bag_of_mcap(folder: Path) -> Path:
    path = recording(folder)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.finish()
    return path


def within(folder: Path) -> Path:
    write_photos(folder / "images")
    return folder


def rig(folder: Path) -> Path:
    for camera in ("left", "right"):
        write_photos(folder / "images" / camera, 1)
    colmap_text(folder / "sparse/0", ["left/photo0.png", "right/photo0.png"])
    return folder


@pytest.mark.parametrize(
    ("write", "choice"),
    [
        (video, "video"), (write_photos, "images"), (within, "images"), (rig, "images"), (write_tum, "tum"),
        (write_replica, "replica"),
        (write_seven_scenes, "seven_scenes"), (lambda path: write_seven_scenes(path) / "seq-01", "seven_scenes"),
        (write_icl_nuim, "icl_nuim"), (bag, "bag"), (recording, "player"),
        (bag_file, "bag"), (bag_of_mcap, "bag"),
        (write_euroc, "euroc"), (lambda path: write_euroc(path) / "mav0", "euroc"), (write_tum_vi, "euroc"),
        (write_kitti, "kitti"), (write_scannet, "scannet"), (write_kitti_raw, "kitti_raw"),
        (write_tartanair, "tartanair"), (lambda path: write_tartanair(path, "lcam_front"), "tartanair"),
    ],
)  # fmt: skip
def test_files_and_folders_are_known_by_name_and_layout(
    write: Callable[[Path], Path], choice: str, tmp_path: Path
) -> None:
    path = write(tmp_path / "data")
    assert meant(str(path)) == [f"dataset={choice}", f"dataset.path={path}"]
    assert meant(str(path), "mapper.iterations=3")[2:] == ["mapper.iterations=3"]


@pytest.mark.parametrize(
    ("word", "choice"),
    [
        ("rtsp://host/stream?user=a&x=1", "camera"), ("http://host/video.mjpg", "camera"), ("0", "camera"),
        ("/dev/video2", "camera"), ("tcp://127.0.0.1:5555", "robot"),
    ],
)  # fmt: skip
def test_addresses_and_numbers_are_cameras_and_robots(word: str, choice: str) -> None:
    chosen, path = meant(word)
    assert chosen == f"dataset={choice}"
    assert compose([chosen, path]).slots["dataset"].config["path"] == word


def test_what_links_to_a_device_is_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    links = {"/dev/v4l/by-id/usb-eye": "/dev/video2", "/dev/null": "/dev/null"}
    monkeypatch.setattr("os.path.realpath", links.__getitem__)
    assert meant("/dev/v4l/by-id/usb-eye") == ["dataset=camera", "dataset.path=/dev/v4l/by-id/usb-eye"]
    with pytest.raises(GraphError, match="no such file"):
        meant("/dev/null")


def test_a_folder_of_a_number_is_no_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_kitti(tmp_path).rename(tmp_path / "sequences/00")
    monkeypatch.chdir(tmp_path / "sequences")
    assert meant("00") == ["dataset=kitti", "dataset.path='00'"]
    assert meant("0") == ["dataset=camera", "dataset.path='0'"]


def test_a_choice_is_meant_by_its_name_and_overrides_stay() -> None:
    assert meant("camera", "viewer=viser") == ["dataset=camera", "viewer=viser"]
    untouched = ["dataset=tum", "dataset.path=a b", "-m", "+x=1", "--config-path", "somewhere", "--cfg", "job"]
    assert meant(*untouched) == untouched


def test_a_choice_that_is_given_holds(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "data")
    assert meant(str(folder), "dataset=images") == [f"dataset.path={folder}", "dataset=images"]


@pytest.mark.parametrize("name", ["my walk (1), a=b.mp4", "it's.mp4", "a$b${c}.mp4", "back\\slash.mp4", "'\\'.mp4"])
def test_any_name_reaches_the_reader_as_it_is(name: str, tmp_path: Path) -> None:
    (tmp_path / name).touch()
    graph = compose(with_named_input([str(tmp_path / name)], CHOICES))
    assert graph.slots["dataset"].config["path"] == str(tmp_path / name)


@pytest.mark.parametrize(
    "name", ["Küche", "a [1]", "my walk (1)", "a=b", "it's", "a#b", "a;b & c!", "[old", "a, ü", "back\\ä"]
)
def test_any_name_of_a_folder_is_taken_as_it_is_or_it_is_said_how_to_write_it(name: str) -> None:
    for key in ("output", "map", "dataset.path"):
        word = f"{key}=./{name}" if "old" not in name else f"{key}={name}"
        try:
            graph = compose(["dataset=images", word, *([] if key == "output" else ["output=x"])])
        except GraphError as error:
            assert name in ("[old", "a, ü"), "may be a list or a sweep"
            (typed,) = shlex.split(str(error).rpartition("; as a text: ")[2])
            graph = compose(["dataset=images", typed, *([] if key == "output" else ["output=x"])])
        config = {"output": graph.settings.output, "map": graph.settings.map} | graph.slots["dataset"].config
        found = config[key.removeprefix("dataset.")]
        assert Path(str(found)).name == name


def test_the_folder_of_a_sweep_may_have_any_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert f"hydra.sweep.dir='{tmp_path}/Küche (1)'" in hydra_arguments(["-m", "output=./Küche (1)", "seed=1,2"])


HIDDEN = ("gopro/._GX010001.MP4", "gopro/GL010001.LRV", "gopro/GX010001.MP4", "hidden/.DS_Store")


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("wlak.mp4", "no such file or folder here (did you mean walk.mp4?)"),
        ("camrea", "(did you mean camera?)"),
        ("gopher://host", "no address that is known; there are: rtsp://"),
        ("empty", "is an empty folder"),
        ("texts", "has neither images nor a data set in it, but a.txt"),
        ("sequences", "is no data set itself; give sequences/a or 1 more in it"),
        ("bags", "is no data set itself; give bags/evening.db3 or 1 more in it"),
        ("photos/photo0.png", "one image makes no map; give the folder that it is in: photos"),
        ("map.ply", "is a map; `mvsgs view map.ply` shows it"),
        ("run", "is the output of a run; `mvsgs view run` shows its map, resume=run goes on"),
        ("texts/a.txt", "its name does not say what it is; if it is a video: dataset=video"),
        ("both", "is in the layouts of replica and tum; say which with dataset=replica"),
        ("gopro", "is no data set itself; give gopro/GX010001.MP4 or 1 more in it"),
        ("hidden", "is an empty folder"),
    ],
)
def test_what_cannot_be_told_is_said_in_one_line(
    word: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("empty", "texts", "run", "gopro", "hidden"):
        (tmp_path / folder).mkdir()
    for file in ("walk.mp4", "map.ply", "texts/a.txt", "run/config.yaml", "run/map.ply", "run/comparison.png", *HIDDEN):
        (tmp_path / file).touch()
    write_photos(tmp_path / "photos", 2)
    for name in ("a", "b"):
        write_image(tmp_path / "sequences" / name / "0.png", 3)
    write_replica(write_tum(tmp_path / "both"))
    for name in ("morning", "evening"):
        (tmp_path / "bags").mkdir(exist_ok=True)
        bag_file(tmp_path / name).rename(tmp_path / f"bags/{name}.db3")
    with pytest.raises(GraphError) as refused:
        meant(word)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_two_inputs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match=r"0 and viser: one input at a time; a parameter is written slot.parameter="):
        meant("0", "viser")
    with pytest.raises(GraphError, match="the input is given twice"):
        meant("0", "dataset.path=1")


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("tum_fr1_xyz", "tum"), ("hololens_000", "tum"), ("kitti_piece", "tum"), ("fox", "images"),
        ("icl_nuim_of_kt0", "icl_nuim"), ("seven_scenes_redkitchen", "seven_scenes"), ("replica/room0_20f", "replica"),
        ("south_building", "images"), ("strecha/fountain-P11", "images"), ("aerial_caliterra", "images"),
    ],
)  # fmt: skip
def test_published_sets_are_recognized(folder: str, name: str) -> None:
    assert recognized(shared(f"data/{folder}")) == [name]
