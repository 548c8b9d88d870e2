"""Meshes, opened by others: axes, colors and material as the format defines them."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from plyfile import PlyData

from mvsgs_core import camera
from mvsgs_core.export import __main__ as export
from mvsgs_core.export.glb import linear, write_glb
from mvsgs_core.export.mesh import write_mesh, write_mesh_ply
from mvsgs_core.export.ply import write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.open3d_loader import open3d
from mvsgs_core.rasterizer.rasterize import Render, rasterize
from tests.support.tiny_map import ORIGIN, cameras_around, final_map, save_cameras, write_poses

SIZE, INTRINSICS = (48, 64), np.array([51.2, 51.2, 31.5, 23.5])


def mesh_of_box(folder: Path, name: str, *arguments: str, origin: np.ndarray = ORIGIN) -> Path:
    write_ply(folder / "map.ply", final_map(1, size=SIZE, opacity=0.98, origin=origin))
    assert export.main([str(folder / "map.ply"), str(folder / name), "--voxel", "0.02", *arguments]) == 0
    return folder / name


@pytest.mark.slow
def test_mesh_lies_on_the_walls_of_the_box(tmp_path: Path) -> None:
    write_poses(tmp_path / "trajectory.txt", [0.5])
    camera_given = ["--size", "48", "64", "--intrinsics", "51", "51", "31.5", "23.5"]
    out = mesh_of_box(tmp_path, "m.ply", "--mesh", "--trajectory", str(tmp_path / "trajectory.txt"), *camera_given)
    mesh = open3d().io.read_triangle_mesh(str(out))
    vertices = np.asarray(mesh.vertices) - ORIGIN - [0.0, 0.0, 1.0]
    assert len(vertices) > 300
    distance = np.abs(np.abs(vertices) - [1.6, 1.2, 1.4]).min(axis=1)
    assert np.median(distance) < 0.05


@pytest.mark.slow
def test_glb_opened_by_another_program_looks_from_its_axes_as_the_map_does_from_ours(tmp_path: Path) -> None:
    """Rendered by casting rays into what trimesh reads, with a camera in glTF's axes (y up, looking along -z)."""
    save_cameras(tmp_path, [0.5], SIZE, INTRINSICS)
    scene = trimesh.load_scene(mesh_of_box(tmp_path, "mesh.glb"))
    (name,) = scene.graph.nodes_geometry
    transform, geometry = scene.graph[name]
    mesh = scene.geometry[geometry]
    vertices = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
    colors = np.asarray(mesh.visual.vertex_attributes["color"], dtype=np.float64)[:, :3]
    rays = camera.unproject(np.ones(SIZE), INTRINSICS) * [1.0, -1.0, -1.0]
    start = np.broadcast_to(ORIGIN * [1.0, -1.0, -1.0], rays.shape)
    caster = open3d().t.geometry.RaycastingScene()
    tensor = open3d().core.Tensor
    caster.add_triangles(tensor(vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    hit = caster.cast_rays(tensor(np.concatenate([start, rays], axis=-1).astype(np.float32)))
    depth, face = hit["t_hit"].numpy(), hit["primitive_ids"].numpy()
    expected = rasterize(final_map(1, size=SIZE, opacity=0.98).splats, np.eye(4), INTRINSICS, SIZE)
    seen = np.isfinite(depth) & (expected.opacity.numpy() > 0.9)
    assert seen.mean() > 0.8
    np.testing.assert_allclose(np.median(np.abs(depth / expected.depth.numpy() - 1.0)[seen]), 0.0, atol=0.02)
    shown = srgb(colors[mesh.faces[face[seen]]].mean(axis=1))  # as a display gets it
    difference = np.abs(shown - expected.color.numpy()[seen]).mean(axis=1)
    assert np.median(difference) < 0.02
    assert np.median(np.abs(colors[mesh.faces[face[seen]]].mean(axis=1) - expected.color.numpy()[seen])) > 0.1


@pytest.mark.parametrize(("far", "kind"), [(0.0, "f4"), (1e6 + 0.3, "f8")])
def test_mesh_ply_is_float32_where_that_holds_it(tmp_path: Path, far: float, kind: str) -> None:
    """Viewers in browsers draw no doubles."""
    vertices = np.array([[far, 0.0, 2.0], [far + 1.0, 0.1, 2.0], [far, 1.0, 3.0]])
    colors = np.array([[0.5, 0.0, 1.0], [0.02, 0.2, 0.9], [1.0, 1.0, 1.0]])
    write_mesh_ply(tmp_path / "one.ply", vertices, np.array([[0, 1, 2]]), colors, 1e-5)
    assert PlyData.read(str(tmp_path / "one.ply"))["vertex"].data.dtype["x"] == np.dtype(kind)
    mesh = trimesh.load_mesh(tmp_path / "one.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-5)
    assert mesh.faces.tolist() == [[0, 1, 2]]
    np.testing.assert_allclose(mesh.visual.vertex_colors[:, :3] / 255.0, colors, atol=0.5 / 255)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".stl", ".off", ".obj"])
def test_other_formats_have_all_triangles_by_trimesh(
    tmp_path: Path, suffix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save_cameras(tmp_path, [0.5], SIZE, INTRINSICS)
    mesh = trimesh.load_mesh(mesh_of_box(tmp_path, f"mesh{suffix}"))
    assert f" {len(mesh.faces)} triangles" in capsys.readouterr().out
    assert len(mesh.faces) > 300


def srgb(values: np.ndarray) -> np.ndarray:
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)


def test_glb_has_the_triangle_that_was_written_in_gltf_axes_linear_and_no_metal(tmp_path: Path) -> None:
    vertices = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 1.0, 3.0]])
    colors = np.array([[0.5, 0.0, 1.0], [0.02, 0.2, 0.9], [1.0, 1.0, 1.0]])
    far = np.array([1e6, 2.0, -3e6])
    write_glb(tmp_path / "one.glb", vertices, np.array([[0, 1, 2]]), colors, far)
    scene = trimesh.load_scene(tmp_path / "one.glb")
    (mesh,) = scene.geometry.values()
    np.testing.assert_array_equal(mesh.vertices, vertices * [1.0, -1.0, -1.0])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2]])
    np.testing.assert_allclose(srgb(np.asarray(mesh.visual.vertex_attributes["color"])), colors, atol=1e-6)
    transform, _ = scene.graph[scene.graph.nodes_geometry[0]]
    np.testing.assert_array_equal(transform[:3, 3], far * [1.0, -1.0, -1.0])
    np.testing.assert_array_equal(transform[:3, :3], np.eye(3))
    assert mesh.visual.material.metallicFactor == 0.0
    assert mesh.visual.material.roughnessFactor == 1.0
    assert mesh.visual.material.doubleSided
    content = json_of(tmp_path / "one.glb")
    assert content["extensionsUsed"] == ["KHR_materials_unlit"]
    assert content["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    with pytest.raises(ValueError, match="no triangles"):
        write_glb(tmp_path / "none.glb", vertices, np.zeros((0, 3), dtype=np.int64), colors, far)


def json_of(path: Path) -> dict[str, list[dict[str, object]]]:
    data = path.read_bytes()
    assert struct.unpack("<I", data[8:12])[0] == len(data)
    (length,) = struct.unpack("<I", data[12:16])
    found: dict[str, list[dict[str, object]]] = json.loads(data[20 : 20 + length])
    return found


def test_linear_light_of_srgb_values() -> None:
    np.testing.assert_allclose(linear(np.array([0.0, 0.04045, 0.5, 1.0])), [0.0, 0.0031308, 0.2140411, 1.0], rtol=1e-5)
    values = np.linspace(0.0, 1.0, 101)
    np.testing.assert_allclose(srgb(linear(values)), values, atol=1e-5)


def test_a_format_that_no_mesh_has_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_cameras(tmp_path, [0.5], SIZE, INTRINSICS)
    write_ply(tmp_path / "map.ply", final_map(1))
    assert export.main([str(tmp_path / "map.ply"), str(tmp_path / "mesh.splat"), "--mesh"]) == 1
    assert "no mesh is written as '.splat': there are .glb, .ply" in capsys.readouterr().err


@pytest.mark.parametrize("voxel", [0.0, -1.0, np.nan, np.inf])
def test_a_voxel_that_is_none_is_refused(tmp_path: Path, voxel: float) -> None:
    with pytest.raises(ValueError, match="its edge must be above 0"):
        write_mesh(tmp_path / "mesh.glb", final_map(1), cameras_around([0.5], SIZE, INTRINSICS), voxel)


def test_views_are_fused_one_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All images of a long run would fill the memory."""
    grid, done = open3d().t.geometry.VoxelBlockGrid, []
    render, integrate = Snapshot.render, grid.integrate

    def rendered(self: Snapshot, pose: np.ndarray, lens: np.ndarray, size: tuple[int, int], **options: Any) -> Render:
        if size == SIZE:
            done.append("rendered")
        return render(self, pose, lens, size, **options)

    def fused(*arguments: Any) -> None:
        done.append("fused")
        integrate(*arguments)

    monkeypatch.setattr(Snapshot, "render", rendered)
    monkeypatch.setattr(grid, "integrate", fused)
    cameras = cameras_around([0.2, 0.5, 0.8], SIZE, INTRINSICS)
    write_mesh(tmp_path / "mesh.ply", final_map(1, size=SIZE, opacity=0.98), cameras, voxel=0.05)
    assert done == 3 * ["rendered", "fused"]


def test_a_wall_straight_ahead_is_fused_and_a_view_of_one_pixel_is_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Open3D takes what is nearer than a bound, and fails where none of the pixels that it looks at sees anything."""
    render, seen = Snapshot.render, []

    def rendered(self: Snapshot, pose: np.ndarray, lens: np.ndarray, size: tuple[int, int], **options: Any) -> Render:
        found = render(self, pose, lens, size, **options)
        depth = torch.full_like(found.depth, 2.0)
        if size == SIZE:
            seen.append(size)
            if len(seen) == 2:
                depth = torch.zeros_like(depth)
                depth[1, 1] = 2.0
        return replace(found, depth=depth, opacity=torch.ones_like(found.opacity))

    monkeypatch.setattr(Snapshot, "render", rendered)
    cameras = cameras_around([0.4, 0.6], SIZE, INTRINSICS)
    vertices, triangles = write_mesh(tmp_path / "mesh.ply", final_map(1, size=SIZE), cameras, voxel=0.02)
    assert vertices > 100
    assert triangles > 100


def test_a_mesh_that_no_camera_sees_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_cameras(tmp_path, [0.5], SIZE, INTRINSICS)
    write_ply(tmp_path / "map.ply", final_map(1, origin=-100.0 * ORIGIN))
    assert export.main([str(tmp_path / "map.ply"), str(tmp_path / "mesh.glb")]) == 1
    assert "no camera sees the map" in capsys.readouterr().err
    assert not (tmp_path / "mesh.glb").exists()
