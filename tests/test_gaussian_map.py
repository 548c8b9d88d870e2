"""A map at rest, as programs read and export it: what other programs wrote, and what must not be replaced."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvsgs.gaussian_map import GaussianMap
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.export.cameras import read_cameras, read_source_camera, write_cameras
from mvsgs_core.export.keyframe_images import write_image
from mvsgs_core.export.ply import read_ply, write_ply
from mvsgs_core.export.source_camera import SourceCamera
from tests.support.tiny_map import SIZE, cameras_around, final_map, write_tiny_run

SOURCE = SourceCamera(Lens((50.0, 50.0, 31.5, 23.5), (48, 64)), "given")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_tiny_run(tmp_path / "run")


def test_what_the_map_was_loaded_from_is_not_replaced(run: Path) -> None:
    found = GaussianMap.load(run)
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    for name in ("cameras.json", "map.ply"):
        with pytest.raises(ValueError, match="is what this map was loaded from: give another file"):
            found.export(run / name)
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before


def test_cameras_json_is_written_as_what_its_name_says(run: Path, tmp_path: Path) -> None:
    write_cameras(run / "cameras.json", cameras_around([0.0, 0.5, 1.0]), SOURCE)
    out = GaussianMap.load(run).export(tmp_path / "cameras.json")
    written, there = read_cameras(out), read_cameras(run / "cameras.json")
    np.testing.assert_array_equal(written.world_from_cam, there.world_from_cam)
    assert read_source_camera(out) == SOURCE
    write_ply(tmp_path / "alone.ply", final_map())
    (tmp_path / "cameras.json").unlink()
    with pytest.raises(ValueError, match=r"there is no cameras\.json beside the map"):
        GaussianMap.load(tmp_path / "alone.ply").export(tmp_path / "cameras.json")


def test_transforms_name_the_images_beside_the_map(run: Path, tmp_path: Path) -> None:
    write_image(run / "keyframes", 7, np.zeros((*SIZE, 3), np.uint8))
    out = GaussianMap.load(run).export(tmp_path / "transforms.json")
    (frame,) = json.loads(out.read_text())["frames"]
    assert frame["file_path"] == "run/keyframes/000007.png"


def test_maps_of_other_programs_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    broken = final_map(1)
    broken.splats.means[5:8] = float("nan")
    write_ply(tmp_path / "-other.ply", broken)  # a name that a command line would take for an option
    with pytest.raises(ValueError, match=r"3 of 768 splats .*; drop_unsound=True leaves them out"):
        GaussianMap.load("-other.ply")
    found = GaussianMap.load("-other.ply", drop_unsound=True, antialiased=True)
    assert len(found) == 765
    assert found.snapshot.antialiased
    write_ply(tmp_path / "map.ply", replace(final_map(1), antialiased=True))
    assert GaussianMap.load(tmp_path).snapshot.antialiased
    assert not GaussianMap.load(tmp_path, antialiased=False).snapshot.antialiased
    with pytest.raises(FileNotFoundError, match=r"a map is a map\.ply"):
        GaussianMap.load(tmp_path / "none")


def test_a_map_with_shapes_can_be_folded_for_other_viewers(tmp_path: Path) -> None:
    shaped = GaussianMap(final_map(1, "exact"), None)
    assert read_ply(shaped.export(tmp_path / "ours.ply")).kernel == "exact"
    assert read_ply(shaped.export(tmp_path / "theirs.ply", fold=True)).kernel == "gaussian"
