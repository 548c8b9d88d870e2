"""Maps in other frames than their own: east, north and up by GPS, and that of poses that came with the frames."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvsgs_core.export import __main__ as export
from mvsgs_core.export.cameras import read_cameras
from mvsgs_core.export.other_frame import in_axes_of
from mvsgs_core.export.ply import read_ply, write_ply
from mvsgs_core.export.turning import RUB_FROM_RDF
from mvsgs_core.geometry import Similarity, so3_exp
from mvsgs_core.georeference import Georeference, write_georeference
from mvsgs_core.given_frame import GivenFrame, write_given_frame
from mvsgs_core.trajectory_file import read_trajectory
from tests.support.tiny_map import INTRINSICS, SIZE, final_map, write_tiny_run


def test_a_map_in_metres_of_a_place_looks_the_same_from_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_tiny_run(tmp_path / "run")
    final, random = final_map(), torch.Generator().manual_seed(1)
    apart = final.splats.means + 0.01 * torch.randn(
        final.splats.means.shape, generator=random
    )  # of equal depth is none
    write_ply(run / "map.ply", replace(final, splats=replace(final.splats, means=apart)))
    out = tmp_path / "map.ply"
    assert export.main([str(run), str(out), "--frame", "enu"]) == 1
    assert "there is no georeference.json beside" in capsys.readouterr().err
    turn = so3_exp(np.array([0.7, -1.1, 0.4]))
    place = Georeference(
        np.array([47.0, 8.0, 400.0]), 3.0, turn, np.array([5.0, -2.0, 1.0]), 9, 1, 0.5, 2.0, 0.01, 0.2, 0.1
    )
    write_georeference(run / "georeference.json", place)
    assert export.main([str(run), str(out), "--frame", "enu"]) == 0
    assert f"x east, y north, z up, in metres, of the place in {out}.origin.json" in capsys.readouterr().out
    said = json.loads((tmp_path / "map.ply.origin.json").read_text())
    assert said["origin"] == {"latitude": 47.0, "longitude": 8.0, "altitude": 400.0}
    before = read_ply(run / "map.ply")
    world = before.splats.means.numpy() + before.origin
    expected = 3.0 * world @ turn.T + [5.0, -2.0, 1.0]
    after = read_ply(out)
    np.testing.assert_allclose(after.splats.means.numpy() + after.origin, expected, atol=1e-4)
    assert export.main([str(run), str(tmp_path / "cameras.json"), "--frame", "enu"]) == 0
    cameras, here = read_cameras(tmp_path / "cameras.json"), read_cameras(run / "cameras.json")
    for pose, moved in zip(here.world_from_cam, cameras.world_from_cam):
        one, other = before.render(pose, INTRINSICS, SIZE), after.render(moved, INTRINSICS, SIZE)
        np.testing.assert_allclose(other.color, one.color, atol=1e-4)
        np.testing.assert_allclose(other.depth, 3.0 * one.depth, rtol=1e-3)
    assert export.main([str(run), str(tmp_path / "path.txt"), "--frame", "enu"]) == 0
    np.testing.assert_allclose(read_trajectory(tmp_path / "path.txt")[1], cameras.world_from_cam, atol=1e-6)


def test_a_map_among_given_poses_has_their_unit_and_axes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = write_tiny_run(tmp_path / "run"), tmp_path / "given.ply"
    assert export.main([str(run), str(out), "--frame", "given"]) == 1
    assert "there is no given_frame.json beside" in capsys.readouterr().err
    place = Similarity(3.0, so3_exp(np.array([0.7, -1.1, 0.4])), np.array([5.0, -2.0, 1.0]))
    write_given_frame(run / "given_frame.json", GivenFrame(place, 9, 0.02, 0.3))
    assert export.main([str(run), str(out), "--frame", "given", "--scale", "2"]) == 1
    assert export.main([str(run), str(out), "--frame", "given"]) == 0
    assert "axes as given, in the unit of the 9 poses that were given, 0.02 off (median)" in capsys.readouterr().out
    before, after = read_ply(run / "map.ply"), read_ply(out)
    expected = place.apply(before.splats.means.numpy() + before.origin)
    np.testing.assert_allclose(after.splats.means.numpy() + after.origin, expected, atol=1e-4)
    assert not (tmp_path / "given.ply.origin.json").exists()


@pytest.mark.parametrize(
    ("rotation", "axes"),
    [
        (np.eye(3), "axes as given"),
        (np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), "axes turned: z as given is y"),
        (np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), "axes as given"),  # z is down
    ],
    ids=["y down", "z up", "z down"],
)
def test_a_given_frame_whose_z_is_up_has_y_up_where_a_format_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], rotation: np.ndarray, axes: str
) -> None:
    run = write_tiny_run(tmp_path / "run")
    turned = rotation @ read_cameras(run / "cameras.json").world_from_cam[0, :3, :3].T  # whose y is down
    given = GivenFrame(Similarity(1.0, turned, np.zeros(3)), 9, 0.0, 0.0)
    write_given_frame(run / "given_frame.json", given)
    assert export.main([str(run), str(tmp_path / "map.spz"), "--frame", "given"]) == 0
    assert f"; {axes}, in the unit" in capsys.readouterr().out
    cameras = read_cameras(run / "cameras.json").world_from_cam
    for suffix in (".glb", ".spz"):
        written, _ = in_axes_of(Path(f"map{suffix}"), given, cameras)
        if axes != "axes as given" or rotation[1, 1] == 1.0:
            up = RUB_FROM_RDF @ written.rotation @ -cameras[0, :3, 1]
            np.testing.assert_allclose(up, [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("suffix", [".glb", ".spz"])
def test_up_is_where_a_format_says(suffix: str) -> None:
    turn = so3_exp(np.array([0.7, -1.1, 0.4]))
    place = Georeference(
        np.array([47.0, 8.0, 400.0]), 3.0, turn, np.array([5.0, -2.0, 1.0]), 9, 1, 0.5, 2.0, 0.01, 0.2, 0.1
    )
    written, axes = in_axes_of(Path(f"map{suffix}"), place, None)
    east, north, up = place.similarity.apply(np.ones((1, 3)))[0]
    np.testing.assert_allclose(RUB_FROM_RDF @ written.apply(np.ones((1, 3)))[0], [east, up, -north])
    assert axes == "x east, y up, z south"
