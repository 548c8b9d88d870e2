"""Files that others read: layout, round trips, refusals, the command lines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from plyfile import PlyData

from mvsgs_core.datasets.colmap import read_colmap
from mvsgs_core.evaluation.trajectory import write_tum
from mvsgs_core.open3d_loader import open3d
from mvsgs_core.splats import export, render_path
from mvsgs_core.splats.densities import log_scale_shift
from mvsgs_core.splats.export_ply import folded, read_ply, write_ply
from mvsgs_core.splats.export_splat import write_splat, write_spz
from mvsgs_core.splats.insertion import InsertionConfig, points_from_depth, splats_from_points
from mvsgs_core.splats.model import Splats
from mvsgs_core.splats.rasterizer import rasterize
from mvsgs_core.splats.snapshot import Snapshot
from tests.core.splats.tiny_scene import pose_on_arc, posed_view

ORIGIN = np.array([10.0, -3.0, 0.5])


def final_map(bases: int = 4, density: str = "gaussian", origin: np.ndarray = ORIGIN) -> Snapshot:
    view = posed_view(0, np.eye(4), (24, 32))
    points = points_from_depth(
        view.depth, view.intrinsics, view.image / 255.0, view.normals, np.ones((24, 32), dtype=bool)
    )
    splats = splats_from_points(points, np.eye(4), bases, density, InsertionConfig(initial_opacity=0.9))
    generator = torch.Generator().manual_seed(0)
    splats.sh[:, 1:] = 0.1 * torch.randn(splats.sh[:, 1:].shape, generator=generator)
    splats.betas = splats.betas + torch.rand(len(splats), generator=generator)
    return Snapshot(
        splats=splats, anchors=np.zeros(len(splats), dtype=np.int64), origin=origin, density=density, iterations=5,
        keyframes=np.zeros(1, dtype=np.int64), world_from_cam=np.eye(4)[None], scale=np.ones(1),
        exposures=np.eye(3, 4, dtype=np.float32)[None],
    )  # fmt: skip


def write_poses(path: Path, times: list[float]) -> np.ndarray:
    poses = np.stack([pose_on_arc(t) for t in times])
    poses[:, :3, 3] += ORIGIN
    write_tum(path, np.arange(len(times), dtype=np.float64), poses)
    return poses


@pytest.mark.parametrize("bases", [1, 4, 16])
def test_ply_has_the_3dgs_layout_by_plyfile(tmp_path: Path, bases: int) -> None:
    final = final_map(bases)
    write_ply(tmp_path / "map.ply", final)
    vertex = PlyData.read(str(tmp_path / "map.ply"))["vertex"].data
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3))]
    names += [f"f_rest_{k}" for k in range(3 * (bases - 1))]
    names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    assert list(vertex.dtype.names) == names
    np.testing.assert_allclose(vertex["x"], final.splats.means[:, 0].numpy() + 10.0, rtol=1e-6)
    np.testing.assert_array_equal(vertex["scale_2"], final.splats.log_scales[:, 2].numpy())
    np.testing.assert_array_equal(vertex["f_dc_1"], final.splats.sh[:, 0, 1].numpy())
    if bases > 1:  # all of red first
        np.testing.assert_array_equal(vertex["f_rest_1"], final.splats.sh[:, 2, 0].numpy())
        np.testing.assert_array_equal(vertex[f"f_rest_{bases - 1}"], final.splats.sh[:, 1, 1].numpy())


def test_an_empty_map_is_a_file_too(tmp_path: Path) -> None:
    full = final_map(1)
    none = Splats(*(value[:0] for value in vars(full.splats).values()))
    write_ply(tmp_path / "map.ply", replace(full, splats=none, anchors=full.anchors[:0]))
    assert len(PlyData.read(str(tmp_path / "map.ply"))["vertex"].data) == 0


@pytest.mark.parametrize("density", ["gaussian", "exact", "ges_scale"])
def test_a_saved_map_is_read_back(tmp_path: Path, density: str) -> None:
    final = final_map(4, density)
    write_ply(tmp_path / "map.ply", final)
    again = read_ply(tmp_path / "map.ply")
    assert again.density == density
    for name, value in final.splats.tensors().items():
        if name == "means":
            value = value + torch.from_numpy(ORIGIN)
        if name == "betas" and density == "gaussian":
            continue
        torch.testing.assert_close(getattr(again.splats, name), value.float(), rtol=1e-5, atol=1e-6)


def test_a_far_origin_stays_a_comment_so_that_no_detail_is_lost(tmp_path: Path) -> None:
    final = final_map(1, origin=np.array([1e6, 0.0, -2e6]))
    write_ply(tmp_path / "map.ply", final)
    again = read_ply(tmp_path / "map.ply")
    np.testing.assert_array_equal(again.origin, final.origin)
    assert torch.equal(again.splats.means, final.splats.means)


def test_folding_adds_the_logarithm_and_drops_beta(tmp_path: Path) -> None:
    final = final_map(1, "ges_scale")
    write_ply(tmp_path / "map.ply", final, fold=True)
    again = read_ply(tmp_path / "map.ply")
    assert again.density == "gaussian"
    expected = final.splats.log_scales + log_scale_shift(final.splats.betas)[:, None]
    torch.testing.assert_close(again.splats.log_scales, expected)
    pose, k = np.eye(4), np.array([25.0, 25.0, 15.5, 11.5])
    direct = rasterize(final.splats, pose, k, (24, 32), density="ges_scale").color
    torch.testing.assert_close(rasterize(folded(final.splats, "ges_scale"), pose, k, (24, 32)).color, direct)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not a ply", "no PLY file"),
        (b"ply\nformat ascii 1.0\nend_header\n", "binary_little_endian"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n1234", "lacks y"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n1234", "cut short"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 9\nend_header\n", "vertices only"),
    ],
)
def test_a_bad_file_is_refused_with_the_reason(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_ply(tmp_path / "bad.ply")


def test_splat_rows_are_32_bytes_and_open3d_reads_them(tmp_path: Path) -> None:
    final = final_map(1)
    write_splat(tmp_path / "map.splat", final)
    assert (tmp_path / "map.splat").stat().st_size == 32 * len(final.splats)
    cloud = open3d().t.io.read_point_cloud(str(tmp_path / "map.splat"))
    positions = cloud.point["positions"].numpy()
    expected = final.splats.means.numpy() + ORIGIN
    order, expected_order = (np.lexsort(np.round(p, 4).T) for p in (positions, expected))
    np.testing.assert_allclose(positions[order], expected[expected_order], atol=1e-4)
    np.testing.assert_allclose(
        cloud.point["f_dc"].numpy()[order], final.splats.sh[:, 0].numpy()[expected_order], atol=0.02
    )


def test_spz_comes_back_and_a_map_too_fine_for_it_is_refused(tmp_path: Path) -> None:
    final = final_map(4)
    write_spz(tmp_path / "map.spz", final)
    cloud = open3d().t.io.read_point_cloud(str(tmp_path / "map.spz"))
    np.testing.assert_allclose(cloud.point["positions"].numpy(), final.splats.means.numpy() + ORIGIN, atol=5e-4)
    np.testing.assert_allclose(cloud.point["scale"].numpy(), final.splats.log_scales.exp().numpy(), rtol=0.05)
    assert (tmp_path / "map.spz").stat().st_size < 32 * len(final.splats)
    with pytest.raises(ValueError, match="1/4096"):
        write_spz(tmp_path / "fine.spz", export.scaled(final, 1e-3))


def test_colmap_model_is_read_by_the_reader_of_colmap_models(tmp_path: Path) -> None:
    trajectory, out = tmp_path / "trajectory.txt", tmp_path / "colmap"
    poses = write_poses(trajectory, [0.0, 0.5, 1.0])
    write_ply(tmp_path / "map.ply", final_map())
    arguments = [str(tmp_path / "map.ply"), str(out), "--trajectory", str(trajectory), "--every", "1"]
    assert export.main([*arguments, "--size", "24", "32", "--intrinsics", "25", "26", "15.5", "11.5"]) == 0
    model = read_colmap(out)
    assert len(model.shots) == 3
    np.testing.assert_allclose(model.shots["1.000000.png"].world_from_cam, poses[1], atol=1e-6)
    assert (out / "cameras.txt").read_text().splitlines()[1] == "1 PINHOLE 32 24 25.0 26.0 16.0 12.0"
    points = np.loadtxt(out / "points3D.txt")
    assert points.shape == (24 * 32, 8)
    np.testing.assert_allclose(points[:, 1:4], final_map().splats.means.numpy() + ORIGIN, atol=1e-5)


def test_mesh_lies_on_the_walls_of_the_box(tmp_path: Path) -> None:
    trajectory, out = tmp_path / "trajectory.txt", tmp_path / "mesh.ply"
    write_poses(trajectory, [0.5])
    near_origin = replace(final_map(1), splats=_denser(final_map(1).splats))
    write_ply(tmp_path / "map.ply", near_origin)
    arguments = [str(tmp_path / "map.ply"), str(out), "--mesh", "--trajectory", str(trajectory), "--voxel", "0.02"]
    assert export.main([*arguments, "--size", "48", "64", "--intrinsics", "51", "51", "31.5", "23.5"]) == 0
    mesh = open3d().io.read_triangle_mesh(str(out))
    vertices = np.asarray(mesh.vertices) - ORIGIN - [0.0, 0.0, 1.0]
    assert len(vertices) > 300
    distance = np.abs(np.abs(vertices) - [1.6, 1.2, 1.4]).min(axis=1)
    assert np.median(distance) < 0.05


def _denser(splats: Splats) -> Splats:
    return replace(splats, opacity_logits=torch.full_like(splats.opacity_logits, 4.0))


def test_a_path_becomes_a_video(tmp_path: Path) -> None:
    write_poses(tmp_path / "trajectory.txt", [0.0, 1.0])
    write_ply(tmp_path / "map.ply", final_map())
    out = tmp_path / "video.mp4"
    arguments = [str(tmp_path / "map.ply"), str(tmp_path / "trajectory.txt"), str(out), "--frames", "5"]
    assert render_path.main([*arguments, "--size", "48", "64"]) == 0
    video = cv2.VideoCapture(str(out))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 5
    read, frame = video.read()
    assert read
    assert frame.shape == (48, 64, 3)
    assert frame.mean() > 20


def test_a_resampled_path_keeps_its_ends_and_is_even() -> None:
    poses = np.stack([pose_on_arc(t) for t in (0.0, 0.5, 1.0)])
    path = render_path.resampled(poses, 9)
    np.testing.assert_allclose(path[[0, 4, 8]], poses, atol=1e-9)
    np.testing.assert_allclose(render_path.resampled(poses[:1], 3), poses[[0, 0, 0]], atol=1e-9)


@pytest.mark.parametrize(
    ("out", "message"), [("mesh.obj", "--trajectory"), ("map.xyz", "no format '.xyz'"), ("folder", "--trajectory")]
)
def test_the_command_line_says_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], out: str, message: str
) -> None:
    write_ply(tmp_path / "map.ply", final_map(1))
    assert export.main([str(tmp_path / "map.ply"), str(tmp_path / out)]) == 1
    assert message in capsys.readouterr().err


def test_scaling_a_map_scales_its_picture_not_at_all() -> None:
    final = final_map(1)
    larger = export.scaled(final, 3.0)
    pose, k = np.eye(4), np.array([25.0, 25.0, 15.5, 11.5])
    one, two = (rasterize(m.splats, pose, k, (24, 32)).color for m in (final, larger))
    torch.testing.assert_close(one, two, atol=1e-4, rtol=0)
