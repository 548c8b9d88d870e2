"""Maps with coordinates of many digits, as survey grids have them: files keep the detail, or say that they cannot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from mvsgs_core.export import __main__ as export
from mvsgs_core.export.cameras import write_cameras
from mvsgs_core.export.mesh import write_stl
from mvsgs_core.export.mesh_text import write_obj, write_off
from mvsgs_core.export.ply import read_ply, write_ply
from mvsgs_core.export.splat import spz_origin, write_spz
from mvsgs_core.open3d_loader import open3d
from tests.support.tiny_map import ORIGIN, cameras_around, final_map

UTM = np.array([465e3, 5.24e6, 400.0])
VERTICES = UTM + np.array([[0.0, 0.0, 2.0], [0.01, 0.001, 2.0], [0.0, 0.01, 2.003]])
TRIANGLES, COLORS = np.array([[0, 1, 2]]), np.array([[0.5, 0.0, 1.0], [0.02, 0.2, 0.9], [1.0, 1.0, 1.0]])


def test_a_stray_splat_does_not_round_the_others_away(tmp_path: Path) -> None:
    final = final_map(1, origin=UTM)
    final.splats.means[0] = 1e5
    write_ply(tmp_path / "map.ply", final)
    again = read_ply(tmp_path / "map.ply")
    np.testing.assert_array_equal(again.origin, UTM)
    assert torch.equal(again.splats.means, final.splats.means)


@pytest.mark.parametrize("origin", [np.zeros(3), ORIGIN, 100.0 * ORIGIN])
def test_near_maps_have_world_coordinates_whatever_strays(tmp_path: Path, origin: np.ndarray) -> None:
    final = final_map(1, origin=origin)
    final.splats.means[0] = 1e7
    write_ply(tmp_path / "map.ply", final)
    assert not read_ply(tmp_path / "map.ply").origin.any()


def test_an_origin_that_would_win_nothing_is_not_subtracted(tmp_path: Path) -> None:
    """Of a long drive, which is far from its beginning."""
    final = final_map(1, origin=ORIGIN)
    moved = replace(final, splats=replace(final.splats, means=final.splats.means + 1e6))
    write_ply(tmp_path / "map.ply", moved)
    assert not read_ply(tmp_path / "map.ply").origin.any()


def test_the_command_says_what_positions_are_relative_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "map.ply", final_map(1, origin=UTM))
    assert export.main([str(tmp_path / "map.ply"), str(tmp_path / "map.splat")]) == 0
    assert "positions are relative to 465000 5240000 400" in capsys.readouterr().out


def test_an_spz_reaches_a_map_that_is_far_away_and_says_its_origin_in_its_axes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    final = final_map(1, origin=np.array([3000.0, 400.0, 5.0]))  # float32 holds it, 24 bits do not
    write_ply(tmp_path / "map.ply", final)
    assert not read_ply(tmp_path / "map.ply").origin.any()
    write_spz(tmp_path / "map.spz", final)
    np.testing.assert_array_equal(spz_origin(final), final.origin)
    write_ply(tmp_path / "far.ply", final_map(1, origin=UTM))
    capsys.readouterr()
    assert export.main([str(tmp_path / "far.ply"), str(tmp_path / "far.spz")]) == 0
    assert "positions are relative to 465000 -5240000 -400" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", [".obj", ".off"])
def test_meshes_as_text_keep_their_detail(tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"one{suffix}"
    if suffix == ".obj":
        write_obj(out, VERTICES, TRIANGLES, COLORS, np.tile([0.0, 0.0, 1.0], (3, 1)))
    else:
        write_off(out, VERTICES, TRIANGLES, COLORS)
    mesh, colored = trimesh.load_mesh(out, process=False), open3d().io.read_triangle_mesh(str(out))
    np.testing.assert_allclose(mesh.vertices, VERTICES, rtol=0, atol=2e-5)
    assert mesh.faces.tolist() == TRIANGLES.tolist()
    np.testing.assert_allclose(np.asarray(colored.vertex_colors), COLORS, atol=1.0 / 255)


def test_a_mesh_that_stl_would_round_away_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = cameras_around([0.5])
    cameras.world_from_cam[:, :3, 3] += UTM - ORIGIN
    write_cameras(tmp_path / "cameras.json", cameras)
    write_ply(tmp_path / "map.ply", final_map(1, opacity=0.98, origin=UTM))
    words = [str(tmp_path / "map.ply"), str(tmp_path / "mesh.stl"), "--voxel", "0.02"]
    assert export.main(words) == 1
    assert ".stl holds numbers of seven digits, too few for coordinates up to 5240" in capsys.readouterr().err
    assert not (tmp_path / "mesh.stl").exists()


def test_stl_has_the_triangle_and_its_normal(tmp_path: Path) -> None:
    write_stl(tmp_path / "one.stl", VERTICES - UTM, TRIANGLES, 1e-6)
    mesh = trimesh.load_mesh(tmp_path / "one.stl", process=False)
    np.testing.assert_allclose(mesh.triangles[0], (VERTICES - UTM)[TRIANGLES[0]], atol=1e-7)
    stored = np.frombuffer((tmp_path / "one.stl").read_bytes(), dtype="<f4", count=3, offset=84)
    np.testing.assert_allclose(stored, mesh.face_normals[0], atol=1e-5)
