"""transforms.json: read back by our reader, and by nerfstudio's rules written out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.datasets import open_dataset
from mvsgs_core.datasets.colmap import read_colmap
from mvsgs_core.export import __main__ as export
from mvsgs_core.export.cameras import write_cameras
from mvsgs_core.export.keyframe_images import write_image
from mvsgs_core.kept_map import STREAM
from tests.support.tiny_map import SIZE, cameras_around, write_tiny_run


def test_our_reader_finds_the_same_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, cameras = write_tiny_run(tmp_path / "run"), cameras_around([0.0, 0.5, 1.0])
    for index in cameras.keyframes.tolist():
        write_image(run / "keyframes", index, np.full((*SIZE, 3), index, np.uint8))
    assert export.main([str(run), str(run / "transforms.json")]) == 0
    assert capsys.readouterr().out == f"{run / 'transforms.json'}: 3 cameras\n"
    items = list(open_dataset("images", path=run / "keyframes"))
    assert [int(item.image[0, 0, 0]) for item in items] == cameras.keyframes.tolist()
    for k, item in enumerate(items):
        np.testing.assert_allclose(item.world_from_cam, cameras.world_from_cam[k], atol=1e-12)
        np.testing.assert_allclose(item.intrinsics, cameras.intrinsics[k], atol=1e-9)
        assert not item.intrinsics_guessed


def test_axes_and_pixels_are_nerfstudios(tmp_path: Path) -> None:
    run, cameras = write_tiny_run(tmp_path / "run"), cameras_around([0.0, 0.5, 1.0])
    assert export.main([str(run), str(tmp_path / "elsewhere.json")]) == 0
    content = json.loads((tmp_path / "elsewhere.json").read_text())
    frame, pose = content["frames"][1], cameras.world_from_cam[1]
    assert content["camera_model"] == "OPENCV"
    assert (frame["w"], frame["h"]) == (SIZE[1], SIZE[0])
    assert frame["file_path"] == "run/keyframes/000007.png"
    matrix = np.array(frame["transform_matrix"])
    np.testing.assert_allclose(matrix[:3, 3], pose[:3, 3])
    np.testing.assert_allclose(-matrix[:3, 2], pose[:3, 2])  # OpenGL looks along -z,
    np.testing.assert_allclose(-matrix[:3, 1], pose[:3, 1])  # y is up
    assert frame["cx"] == cameras.intrinsics[1, 2] + 0.5  # pixel (0, 0) is a corner there


def test_keyframes_without_an_image_are_left_out_where_others_have_theirs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a map that another stream went on in: nerfstudio opens every image that is named."""
    run, cameras = write_tiny_run(tmp_path / "run"), cameras_around([0.0, 0.5, 1.0])
    write_cameras(run / "cameras.json", replace(cameras, keyframes=np.array([7 - STREAM, 0, 7])))
    for index in (0, 7):
        write_image(run / "keyframes", index, np.zeros((*SIZE, 3), np.uint8))
    assert export.main([str(run), str(run / "transforms.json")]) == 0
    said = f"2 cameras; 1 keyframes without an image in {run / 'keyframes'} were left out"
    assert said in capsys.readouterr().out
    assert len(list(open_dataset("images", path=run / "keyframes"))) == 2
    frames = json.loads((run / "transforms.json").read_text())["frames"]
    assert [Path(frame["file_path"]).name for frame in frames] == ["000000.png", "000007.png"]
    assert export.main([str(run), str(tmp_path / "model"), "--images"]) == 0
    assert "2 images, " in (told := capsys.readouterr().out)
    assert "; 1 keyframes without an image in " in told
    assert len(read_colmap(tmp_path / "model" / "sparse" / "0").shots) == 2
    write_cameras(run / "cameras.json", replace(cameras, keyframes=cameras.keyframes - STREAM))
    assert export.main([str(run), str(tmp_path / "none"), "--images"]) == 1
    assert "no keyframe's image is in " in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--trajectory", "--size"])
def test_images_of_other_cameras_are_not_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str) -> None:
    run = write_tiny_run(tmp_path / "run")
    write_image(run / "keyframes", 0, np.zeros((*SIZE, 3), np.uint8))
    values = {"--trajectory": [str(run / "trajectory.txt")], "--size": ["12", "16"]}[option]
    assert export.main([str(run), str(run / "transforms.json"), option, *values]) == 1
    message = {
        "--trajectory": "names the keyframes' images, of which a --trajectory knows nothing",
        "--size": "000000.png has 32x24 pixels, its camera 16x12",
    }[option]
    assert message in capsys.readouterr().err
    assert not (run / "transforms.json").exists()


def test_missing_images_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_tiny_run(tmp_path / "run")
    assert export.main([str(run), str(run / "transforms.json")]) == 0
    assert f"3 cameras, of which 0 have their image in {run / 'keyframes'}" in capsys.readouterr().out
