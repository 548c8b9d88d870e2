"""Compact files of splats, opened by others: the axes are those that each format is defined in."""

from __future__ import annotations

import base64
import gzip
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from mvsgs_core.export.ply import read_ply, write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.export.splat import write_splat, write_spz
from mvsgs_core.export.turning import RUB_FROM_RDF
from mvsgs_core.geometry import rotation_from_quaternion
from mvsgs_core.open3d_loader import open3d
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.tiny_map import INTRINSICS, ORIGIN, SIZE, final_map
from tests.support.tiny_scene import pose_on_arc


def few_splats() -> Snapshot:
    """Six splats of all orientations, scales and view-dependent colors, by formula."""
    k = torch.arange(6 * 48, dtype=torch.float64)
    waves = torch.sin(1.7 * k + 0.3)
    splats = Splats(
        means=3.0 * waves[:18].reshape(6, 3), log_scales=-2.0 + waves[20:38].reshape(6, 3),
        quaternions=waves[40:64].reshape(6, 4), opacity_logits=2.0 * waves[70:76],
        sh=0.8 * waves.reshape(6, 16, 3), betas=torch.full((6,), 2.0),
    )  # fmt: skip
    small = Splats(**{name: value.float() for name, value in splats.tensors().items()})
    return replace(final_map(16), splats=small, anchors=np.zeros(6, dtype=np.int64), origin=np.zeros(3))


# few_splats() as write_ply writes them, converted by PlayCanvas splat-transform 2.7.1 (--spz-version 3), which takes
# .ply for x right, y down, z forward and writes .spz in the axes of its specification
CONVERTED = base64.b64decode(
    "H4sIAAAAAAAAAz3PMUjDQBQG4IdFJ7FIEeIgnAgSQezhlPEm7SRBQYoumUQRaQptKVhqhFLqoKQgKKg1Y8dTHDreJJ3kBMUgKJGK6NDdRc6XRjsc"
    "Bz/f3Xv/0uKKGQOAITyxYYDkCKw/qMw4fD6rgRfV7ajbRzU/Cul7NTsIP0m4+1ZTczCWAGMGbibAflVr05B/25q8fjo4y1TPs5WL3H6jsNcolhq7"
    "FdtxS9naYb5wVM2W3bJdtdT2yfGydpl734jvXCVWu3V9Id75+JJGym+SmuYSHghJzcALHGIRTqUIOHGJG1iEURnlvsF8DLUa8ULMMHSJjVgIGWIH"
    "sUlllPvMkC1yqjmIuWRM8h72iJCIPcQ2YhHlQYrKlu6RIg78wyhQcSkFXjZiiwjaywOTtoXexM9cnMTCVUOMFaQQlCPuV0Cc1kUbw00c6OHL/15R"
    "BU4sxP0Kv7IA0pmWAQAA"
)  # fmt: skip


def read_spz(path: Path) -> Splats:
    """By open3d, as the file has them."""
    cloud = open3d().t.io.read_point_cloud(str(path))
    point = {name: torch.from_numpy(cloud.point[name].numpy().astype(np.float32)) for name in cloud.point}
    count = len(point["positions"])
    harmonics = torch.cat([point["f_dc"][:, None], point["f_rest"].reshape(count, -1, 3)], dim=1)
    return Splats(
        point["positions"], point["scale"].log(), point["rot"], point["opacity"][:, 0], harmonics,
        torch.full((count,), 2.0),
    )  # fmt: skip


def assert_close(ours: Splats, other: Splats) -> None:
    """Within the steps of .spz."""
    torch.testing.assert_close(ours.means, other.means, atol=2.0 / 4096, rtol=0)
    torch.testing.assert_close(ours.log_scales, other.log_scales, atol=1.0 / 16, rtol=0)
    torch.testing.assert_close(ours.opacity_logits, other.opacity_logits, atol=0.05, rtol=0)
    torch.testing.assert_close(ours.sh, other.sh, atol=1.0 / 8, rtol=0)
    # a splat's axes have no sign, so that its orientation has many quaternions and one covariance; ours are in 8 bits
    # a number, which version 2 has and all viewers read, the other's in 9
    torch.testing.assert_close(covariances(ours), covariances(other), atol=0, rtol=0.2)


def covariances(splats: Splats) -> torch.Tensor:
    rotations = torch.from_numpy(np.stack([rotation_from_quaternion(q) for q in splats.quaternions.double().numpy()]))
    axes = rotations * splats.log_scales.double().exp()[:, None]
    return axes @ axes.transpose(1, 2)


def test_spz_is_what_an_independent_converter_makes_of_our_ply(tmp_path: Path) -> None:
    (tmp_path / "converted.spz").write_bytes(CONVERTED)
    write_spz(tmp_path / "map.spz", few_splats())
    assert_close(read_spz(tmp_path / "map.spz"), read_spz(tmp_path / "converted.spz"))


def test_a_converter_that_is_installed_agrees_on_all_formats(tmp_path: Path) -> None:
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("splat-transform is not installed: npm install --global @playcanvas/splat-transform")
    final = few_splats()
    write_ply(tmp_path / "map.ply", final)
    write_spz(tmp_path / "map.spz", final)
    write_splat(tmp_path / "map.splat", final)
    read = {}
    for name in ("map.ply", "map.spz", "map.splat"):
        converted = tmp_path / f"{name}.converted.ply"
        subprocess.run([program, "-q", "-w", tmp_path / name, converted], check=True, timeout=120)
        read[name] = PlyData.read(str(converted))["vertex"].data
    shapes = {name: covariances(read_ply(tmp_path / f"{name}.converted.ply").splats) for name in read}
    torch.testing.assert_close(shapes["map.spz"], shapes["map.ply"], atol=0.02, rtol=0.13)
    order, splat_order = (np.argsort(read[name]["x"]) for name in ("map.ply", "map.splat"))
    torch.testing.assert_close(shapes["map.splat"][splat_order], shapes["map.ply"][order], atol=0.02, rtol=0.13)
    for name in ("x", "y", "z"):
        np.testing.assert_allclose(read["map.spz"][name], read["map.ply"][name], atol=2.0 / 4096)
        np.testing.assert_allclose(np.sort(read["map.splat"][name]), np.sort(read["map.ply"][name]), atol=1e-5)
    for k in range(45):
        np.testing.assert_allclose(read["map.spz"][f"f_rest_{k}"], read["map.ply"][f"f_rest_{k}"], atol=1.0 / 8)


@pytest.mark.parametrize("antialiased", [False, True])
def test_spz_says_whether_the_map_is_antialiased(tmp_path: Path, antialiased: bool) -> None:
    write_spz(tmp_path / "map.spz", replace(few_splats(), antialiased=antialiased))
    (tmp_path / "converted.spz").write_bytes(CONVERTED)
    ours, other = (gzip.decompress(data) for data in ((tmp_path / "map.spz").read_bytes(), CONVERTED))
    assert ours[:4] == other[:4]
    assert ours[4:8] == b"\2\0\0\0"  # what viewers in browsers read: some know no later version
    assert ours[8:14] == other[8:14]  # number of splats, degree, bits of a fraction: the header is where it is read
    assert ours[14] == int(antialiased)
    assert_close(read_spz(tmp_path / "map.spz"), read_spz(tmp_path / "converted.spz"))


def test_spz_read_by_another_program_renders_as_the_map_from_the_turned_pose(tmp_path: Path) -> None:
    final = final_map(16)
    write_spz(tmp_path / "map.spz", final)
    pose = pose_on_arc(0.2)
    expected = rasterize(final.splats, pose, INTRINSICS, SIZE).color
    turned_pose = np.eye(4)
    turned_pose[:3, :3] = RUB_FROM_RDF @ pose[:3, :3]
    turned_pose[:3, 3] = RUB_FROM_RDF @ (pose[:3, 3] + ORIGIN)
    color = rasterize(read_spz(tmp_path / "map.spz"), turned_pose, INTRINSICS, SIZE).color
    error = float((color - expected).square().mean())
    assert -10.0 * np.log10(error) > 35.0
    unturned = rasterize(read_spz(tmp_path / "map.spz"), _moved(pose), INTRINSICS, SIZE).color
    assert float((unturned - expected).square().mean()) > 100 * error


def _moved(pose: np.ndarray) -> np.ndarray:
    moved = pose.copy()
    moved[:3, 3] += ORIGIN
    return moved


def test_spz_is_small_and_a_map_too_fine_or_too_large_for_it_is_refused(tmp_path: Path) -> None:
    final = final_map(4)
    write_spz(tmp_path / "map.spz", final)
    cloud = open3d().t.io.read_point_cloud(str(tmp_path / "map.spz"))
    expected = (final.splats.means.numpy() + ORIGIN) * [1.0, -1.0, -1.0]
    np.testing.assert_allclose(cloud.point["positions"].numpy(), expected, atol=5e-4)
    np.testing.assert_allclose(cloud.point["scale"].numpy(), final.splats.log_scales.exp().numpy(), rtol=0.05)
    assert (tmp_path / "map.spz").stat().st_size < 32 * len(final.splats)
    with pytest.raises(ValueError, match="1/4096"):
        write_spz(tmp_path / "fine.spz", final.scaled(1e-3))
    with pytest.raises(ValueError, match="768 splats are farther"):
        write_spz(tmp_path / "large.spz", final.scaled(1e4))


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
