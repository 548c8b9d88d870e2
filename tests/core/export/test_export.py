"""Files that others read: layout, round trips, refusals, the command lines."""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from mvsgs_core.export import __main__ as export
from mvsgs_core.export import render_path
from mvsgs_core.export.command_line import input_arguments, lens, run
from mvsgs_core.export.ply import folded, ply_size, read_ply, write_ply
from mvsgs_core.rasterizer.kernels import log_scale_shift
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.tiny_map import INTRINSICS, ORIGIN, SIZE, final_map, save_cameras, write_poses, write_tiny_run


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


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["gaussian", "exact", "ges_scale"])
def test_a_saved_map_is_read_back(tmp_path: Path, kernel: str) -> None:
    final = final_map(4, kernel)
    write_ply(tmp_path / "map.ply", final)
    again = read_ply(tmp_path / "map.ply")
    assert again.kernel == kernel
    assert f"comment density {kernel}\n".encode() in (tmp_path / "map.ply").read_bytes()  # its name in the files
    for name, value in final.splats.tensors().items():
        if name == "means":
            value = value + torch.from_numpy(ORIGIN)
        if name == "betas" and kernel == "gaussian":
            continue
        torch.testing.assert_close(getattr(again.splats, name), value.float(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("antialiased", [False, True])
def test_a_saved_map_says_that_it_is_antialiased_and_is_rendered_so(
    tmp_path: Path, antialiased: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    final = replace(final_map(1), antialiased=antialiased)
    write_ply(tmp_path / "map.ply", final)
    again = read_ply(tmp_path / "map.ply")
    assert again.antialiased == antialiased
    pose, k = np.eye(4), np.array([25.0, 25.0, 15.5, 11.5])
    pose[:3, 3] = ORIGIN
    seen = [m.render(pose, k, (24, 32)).color for m in (final, again)]
    torch.testing.assert_close(seen[0], seen[1], atol=1e-4, rtol=0)
    other = replace(final, antialiased=not antialiased).render(pose, k, (24, 32)).color
    assert float((seen[0] - other).abs().max()) > 0.01
    assert export.main([str(tmp_path / "map.ply"), str(tmp_path / "map.splat")]) == 0
    assert ("antialiased" in capsys.readouterr().out) == antialiased
    assert export.main([str(tmp_path / "map.ply"), str(tmp_path / "again.ply"), "--antialiased"]) == 0
    assert read_ply(tmp_path / "again.ply").antialiased


@pytest.mark.parametrize(("name", "words", "told"), [
    ("map.ply", [], True), ("map.ply", ["--fold"], False), ("map.splat", [], False), ("map.spz", [], False),
])  # fmt: skip
def test_a_map_with_shapes_says_what_other_viewers_need(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, words: list[str], told: bool
) -> None:
    write_ply(tmp_path / "shaped.ply", final_map(1, "exact", np.zeros(3)))
    assert export.main([str(tmp_path / "shaped.ply"), str(tmp_path / name), *words]) == 0
    assert ("; shaped: other viewers need --fold" in capsys.readouterr().out) == told


@pytest.mark.parametrize(("error", "said"), [
    (MemoryError(), "export: not enough memory\n"),
    (MemoryError("Unable to allocate 5 GiB"), "export: not enough memory: Unable to allocate 5 GiB\n"),
])  # fmt: skip
def test_memory_that_is_not_enough_is_said_in_a_line(
    capsys: pytest.CaptureFixture[str], error: MemoryError, said: str
) -> None:
    def command(options: argparse.Namespace) -> str:
        raise error

    assert run(argparse.ArgumentParser(prog="mvsgs export"), [], command) == 1
    assert capsys.readouterr().err == said


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
    assert again.kernel == "gaussian"
    expected = final.splats.log_scales + log_scale_shift(final.splats.betas)[:, None]
    torch.testing.assert_close(again.splats.log_scales, expected)
    pose, k = np.eye(4), np.array([25.0, 25.0, 15.5, 11.5])
    direct = rasterize(final.splats, pose, k, (24, 32), kernel="ges_scale").color
    torch.testing.assert_close(rasterize(folded(final.splats, "ges_scale"), pose, k, (24, 32)).color, direct)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not a ply", "no PLY file"),
        (b"ply\nformat ascii 1.0\nend_header\n", "binary_little_endian"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n1234", "lacks y"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n1234", "cut short"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 9\nend_header\n", "vertices only"),
        (b"ply\nformat binary_little_endian 1.0\ncomment background 0 nan 0\nend_header\n", "background is not finite"),
    ],
)
def test_a_bad_file_is_refused_with_the_reason(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_ply(tmp_path / "bad.ply")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["mesh.obj"], "need cameras, and there is no cameras.json beside"),
        (["folder"], "need cameras, and there is no cameras.json beside"),
        (["mesh.obj", "--trajectory", "trajectory.txt"], "the camera is not known"),
        (["mesh.obj", "--trajectory", "trajectory.txt", "--size", "24", "32"], "the camera is not known"),
        (["folder", "--trajectory", "trajectory.txt", "--images"], "of which a --trajectory knows nothing"),
        (["map.xyz"], "no format '.xyz'"),
        (["map.splat", "--scale", "0"], "--scale must be positive"),
        (["map.glb", "--voxel", "-1"], "--voxel must be positive"),
        (["folder", "--cameras", "none.json"], "none.json"),
    ],
)
def test_the_command_line_says_what_is_missing(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_poses(tmp_path / "trajectory.txt", [0.5])
    write_ply(tmp_path / "map.ply", final_map(1))
    assert export.main(["map.ply", *arguments]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(("words", "said"), [
    (["a.ply", "--every", "3"], "--every is not for a .ply of splats: leave it out; it is for a mesh, cameras.json,"),
    (["a.ply", "--trajectory", "poses.txt"], "--trajectory is not for a .ply of splats"),
    (["a.ply", "--observations"], "--observations is not for a .ply of splats: leave it out; it is for a COLMAP model"),
    (["a.ply", "--images"], "--images is not for a .ply of splats"),
    (["a.ply", "--mesh", "--fold"], "--fold is not for a mesh"),
    (["a.spz", "--voxel", "3"], "--voxel is not for .spz: leave it out; it is for a mesh"),
    (["a.splat", "--fold"], "--fold is not for .splat"),
    (["a.splat", "--size", "24", "32"], "--size is not for .splat"),
    (["cameras.json", "--images"], "--images is not for cameras.json"),
    (["poses.txt", "--antialiased"], "--antialiased is not for a trajectory"),
])  # fmt: skip
def test_an_option_that_a_format_does_not_read_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    run, (name, *options) = write_tiny_run(tmp_path / "run"), words
    assert export.main([str(run), str(tmp_path / name), *options]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize("background", [None, np.array([0.39, 0.1, 1.0], np.float32)])
@pytest.mark.parametrize("kernel", ["gaussian", "exact"])
def test_how_large_the_file_of_a_map_is(tmp_path: Path, kernel: str, background: np.ndarray | None) -> None:
    final = replace(final_map(4, kernel), background=background, antialiased=background is None)
    write_ply(tmp_path / "map.ply", final)
    assert ply_size(final) == (tmp_path / "map.ply").stat().st_size


@pytest.mark.filterwarnings("error")
def test_a_map_without_splats_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    final, map_file = final_map(4), tmp_path / "map.ply"
    write_poses(tmp_path / "poses.txt", [0.5])
    write_ply(map_file, replace(final, splats=Splats(**{k: v[:0] for k, v in final.splats.tensors().items()})))
    for main, out in ((export.main, ["again.ply"]), (render_path.main, ["poses.txt", "flight.mp4"])):
        assert main([str(map_file), *(str(tmp_path / name) for name in out)]) == 1
        assert f"{map_file} has no splats" in capsys.readouterr().err
    final.splats.sh[:] = float("nan")
    write_ply(map_file, final)
    for options in ([], ["--drop-unsound"]):
        assert export.main([str(map_file), str(tmp_path / "again.ply"), *options]) == 1
        assert f"none of the 768 splats in {map_file} has values that are all finite" in capsys.readouterr().err
    assert not (tmp_path / "again.ply").exists()


def test_splats_that_were_read_are_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of one splat, whose columns lie in the file as an array would."""
    final = final_map(4)
    one = replace(final, splats=Splats(**{name: value[:1] for name, value in final.splats.tensors().items()}))
    write_ply(tmp_path / "map.ply", one)
    data = (tmp_path / "map.ply").read_bytes()
    monkeypatch.setattr(Path, "read_bytes", lambda path: data)
    for value in read_ply(tmp_path / "map.ply").splats.tensors().values():
        value.add_(1.0)
    monkeypatch.undo()
    assert data == (tmp_path / "map.ply").read_bytes()


def arguments_of(*words: str) -> argparse.Namespace:
    """As the export's command line has them, for `map.ply` in the current folder."""
    parser = argparse.ArgumentParser()
    input_arguments(parser)
    return parser.parse_args(["map.ply", *words])


def test_the_camera_is_the_one_that_the_run_estimated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_cameras(tmp_path, [0.0, 1.0])
    intrinsics, size = lens(arguments_of())
    np.testing.assert_array_equal(intrinsics, INTRINSICS)
    assert size == SIZE
    intrinsics, size = lens(arguments_of("--size", "48", "64"))
    np.testing.assert_allclose(intrinsics, [50.0, 52.0, 31.5, 23.5])
    assert size == (48, 64)
    intrinsics, size = lens(arguments_of("--intrinsics", "9", "9", "1", "1"))
    assert intrinsics.tolist() == [9, 9, 1, 1]
    assert size == SIZE
    with pytest.raises(ValueError, match="must be positive"):
        lens(arguments_of("--intrinsics", "nan", "9", "1", "1"))
    with pytest.raises(ValueError, match="must be positive"):
        lens(arguments_of("--size", "0", "64"))


@pytest.mark.slow
@pytest.mark.parametrize("field", ["means", "log_scales", "quaternions", "opacity_logits", "sh"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_splats_that_are_not_finite_are_refused_or_left_out_and_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], field: str, value: float
) -> None:
    broken = final_map(4, origin=np.zeros(3))
    getattr(broken.splats, field)[5:8] = value
    write_ply(tmp_path / "map.ply", broken)
    for name in ("map.splat", "map.spz", "again.ply"):
        out = tmp_path / name
        assert export.main([str(tmp_path / "map.ply"), str(out)]) == 1
        assert "3 of 768 splats" in capsys.readouterr().err
        assert not out.exists()
        assert export.main([str(tmp_path / "map.ply"), str(out), "--drop-unsound"]) == 0
        said = capsys.readouterr().out
        assert "765 splats" in said
        assert "3 splats that are not finite were left out" in said
    kept = read_ply(tmp_path / "again.ply").splats
    assert len(kept) == 765
    assert all(bool(torch.isfinite(tensor).all()) for tensor in kept.tensors().values())


def test_scaling_a_map_scales_its_picture_not_at_all() -> None:
    final = final_map(1)
    larger = final.scaled(3.0)
    pose, k = np.eye(4), np.array([25.0, 25.0, 15.5, 11.5])
    one, two = (rasterize(m.splats, pose, k, (24, 32)).color for m in (final, larger))
    torch.testing.assert_close(one, two, atol=1e-4, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "arguments", "written"),
    [
        ("mvsgs_core.export", ["map.ply", "map.splat"], "768 splats"),
        ("mvsgs_core.export.render_path", ["map.ply", "trajectory.txt", "flight.mp4"], "1 frames"),
    ],
)
def test_as_a_command(tmp_path: Path, module: str, arguments: list[str], written: str) -> None:
    write_ply(tmp_path / "map.ply", final_map(1))
    save_cameras(tmp_path, [0.0])
    write_poses(tmp_path / "trajectory.txt", [0.5])
    words = [tmp_path / word for word in arguments]
    done = subprocess.run(
        [sys.executable, "-m", module, *words],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert f"{words[-1]}: {written}" in done.stdout
    assert words[-1].stat().st_size > 0
