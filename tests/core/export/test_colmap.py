"""A COLMAP model of the map, opened by COLMAP: images that are there, points that are seen where it is said."""

from __future__ import annotations

import errno
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from mvsgs_core.datasets.colmap import read_colmap
from mvsgs_core.export import __main__ as export
from mvsgs_core.export.cameras import write_cameras
from mvsgs_core.export.keyframe_images import write_image
from mvsgs_core.export.ply import read_ply, write_ply
from mvsgs_core.named_modules import is_installed
from mvsgs_core.rasterizer.splats import Splats
from tests.support.tiny_map import (
    INTRINSICS,
    SIZE,
    cameras_around,
    final_map,
    poses_around,
    save_cameras,
    write_poses,
)
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

TIMES = [0.4, 0.5, 0.6]

# in a process of its own: pycolmap and torch bring different copies of what both are linked with
OPENED_BY_COLMAP = """
import zlib, json, sys
import pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
model.update_point_3d_errors()
found = {"cameras": [[c.model.name, c.width, c.height, *c.params] for c in model.cameras.values()]}
found["images"] = {
    image.name: {
        "cam_from_world": image.cam_from_world().matrix().tolist(),
        "points": image.num_points3D,
        "errors": [
            float(((image.project_point(model.points3D[p.point3D_id].xyz) - p.xy) ** 2).sum() ** 0.5)
            for p in image.points2D if p.has_point3D()
        ],
    }
    for image in model.images.values()
}
found["points"] = {str(k): [*p.xyz.tolist(), *p.color.tolist()] for k, p in model.points3D.items()}
found["tracks"] = {str(k): [[e.image_id, e.point2D_idx] for e in p.track.elements] for k, p in model.points3D.items()}
found["mean_error"] = model.compute_mean_reprojection_error()
print(json.dumps(found))
"""


def opened_by_colmap(folder: Path) -> dict[str, Any]:
    if not is_installed("pycolmap"):
        pytest.skip("pycolmap is not installed: pip install pycolmap")
    done = subprocess.run([sys.executable, "-c", OPENED_BY_COLMAP, folder / "sparse" / "0"], capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def exported(folder: Path, *arguments: str) -> Path:
    write_ply(folder / "map.ply", final_map())
    assert export.main([str(folder / "map.ply"), str(folder / "colmap"), *arguments]) == 0
    return folder / "colmap"


@pytest.mark.slow
def test_colmap_opens_the_model_with_its_cameras_poses_and_points(tmp_path: Path) -> None:
    cameras = save_cameras(tmp_path, TIMES)
    found = opened_by_colmap(exported(tmp_path))
    assert found["cameras"] == [["PINHOLE", 32, 24, 25.0, 26.0, 16.0, 12.0]]
    assert sorted(found["images"]) == ["000000.png", "000007.png", "000014.png"]
    for pose, name in zip(cameras.world_from_cam, sorted(found["images"])):
        np.testing.assert_allclose(found["images"][name]["cam_from_world"], np.linalg.inv(pose)[:3], atol=1e-9)
    points = np.array([found["points"][str(k + 1)] for k in range(24 * 32)])
    np.testing.assert_allclose(points[:, :3], read_ply(tmp_path / "map.ply").splats.means.numpy(), atol=1e-6)
    image = rgbd_keyframe(0, np.eye(4), SIZE).image
    np.testing.assert_allclose(points[:, 3:], image.reshape(-1, 3), atol=1.0)
    assert set(map(len, found["tracks"].values())) == {0}


def test_observations_reproject_where_they_are_and_only_what_is_in_sight_has_them(tmp_path: Path) -> None:
    cameras = cameras_around([*TIMES, 0.5])
    cameras.world_from_cam[3] = cameras.world_from_cam[1] @ np.diag([-1.0, 1.0, -1.0, 1.0])  # looks out of the box
    write_cameras(tmp_path / "cameras.json", cameras)
    found = opened_by_colmap(exported(tmp_path, "--observations"))
    seen = [found["images"][f"{7 * k:06d}.png"]["points"] for k in range(4)]
    assert min(seen[:3]) > 500
    assert seen[3] == 0
    assert found["mean_error"] < 1e-6
    assert max(error for image in found["images"].values() for error in image["errors"]) < 1e-6
    tracks = found["tracks"].values()
    assert sum(map(len, tracks)) == sum(seen)
    assert np.median([len(track) for track in tracks]) == 3


@pytest.mark.slow
@pytest.mark.parametrize("from_behind", [False, True])
def test_a_wall_hides_the_points_behind_it(tmp_path: Path, from_behind: bool) -> None:
    """Of two equal walls, 1 apart, one hides the other, from either side."""
    wall = final_map(opacity=0.98)
    splats = wall.splats.tensors()
    both = Splats(**{name: torch.cat([value, value]) for name, value in splats.items()})
    both.means[24 * 32 :, 2] += 1.0
    write_ply(tmp_path / "map.ply", replace(wall, splats=both))
    cameras = cameras_around([0.5])
    if from_behind:
        cameras.world_from_cam[0, :3, :3] = np.diag([-1.0, 1.0, -1.0])
        cameras.world_from_cam[0, 2, 3] += 7.0
    write_cameras(tmp_path / "cameras.json", cameras)
    assert export.main([str(tmp_path / "map.ply"), str(tmp_path / "colmap"), "--observations"]) == 0
    tracks = opened_by_colmap(tmp_path / "colmap")["tracks"]
    seen = np.array([len(tracks[str(k + 1)]) for k in range(2 * 24 * 32)]).reshape(2, -1)
    nearer = 1 if from_behind else 0
    assert seen[nearer].mean() > 0.95
    assert seen[1 - nearer].mean() < 0.1


def test_images_are_those_of_the_names(tmp_path: Path) -> None:
    save_cameras(tmp_path, TIMES)
    views = [rgbd_keyframe(7 * k, pose_on_arc(t), SIZE) for k, t in enumerate(TIMES)]
    for view in views:
        write_image(tmp_path / "keyframes", view.index, view.image)
    write_image(tmp_path / "keyframes", 99, views[0].image)  # of a keyframe that the map has not
    out = exported(tmp_path, "--images")
    names = sorted(opened_by_colmap(out)["images"])
    assert names == sorted(path.name for path in (out / "images").iterdir())
    for name, view in zip(names, views, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(out / "images" / name))[..., ::-1], view.image)
    assert len(read_colmap(out / "sparse" / "0").shots) == 3  # our own reader of photographs with a model


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({0: (24, 32), 7: (24, 32)}, "000014.png is missing: run with mapper.save_images=true"),
        ({0: (24, 32), 7: (48, 64)}, "has 64x48 pixels, its camera 32x24"),
        ({0: None}, "no image that can be read"),
    ],
)
def test_an_image_that_does_not_fit_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], files: dict[int, tuple[int, int] | None], message: str
) -> None:
    save_cameras(tmp_path, TIMES)
    for index, size in files.items():
        if size is not None:
            write_image(tmp_path / "elsewhere", index, np.zeros((*size, 3), dtype=np.uint8))
        else:
            (tmp_path / "elsewhere").mkdir()
            (tmp_path / "elsewhere" / "000000.png").write_bytes(b"nothing")
    write_ply(tmp_path / "map.ply", final_map())
    out = tmp_path / "colmap"
    assert export.main([str(tmp_path / "map.ply"), str(out), "--images", str(tmp_path / "elsewhere")]) == 1
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_keyframes_of_two_cameras_keep_theirs(tmp_path: Path) -> None:
    cameras = cameras_around(TIMES)
    cameras.intrinsics[0] *= 1.5
    cameras.sizes[0] = 36, 48
    write_cameras(tmp_path / "cameras.json", cameras)
    shots = read_colmap(exported(tmp_path) / "sparse" / "0").shots
    assert shots["000000.png"].lens.size == (36, 48)
    np.testing.assert_allclose(shots["000000.png"].lens.intrinsics, 1.5 * INTRINSICS)
    np.testing.assert_allclose(shots["000007.png"].lens.intrinsics, INTRINSICS)


def test_a_trajectory_in_the_keyframes_place(tmp_path: Path) -> None:
    write_poses(tmp_path / "trajectory.txt", [0.0, 0.25, 0.5, 0.75, 1.0])
    camera = ["--size", "24", "32", "--intrinsics", "25", "26", "15.5", "11.5"]
    out = exported(tmp_path, "--trajectory", str(tmp_path / "trajectory.txt"), "--every", "2", *camera)
    shots = read_colmap(out / "sparse" / "0").shots
    assert sorted(shots) == ["000000.png", "000002.png", "000004.png"]
    np.testing.assert_allclose(shots["000004.png"].world_from_cam, poses_around([1.0])[0], atol=1e-6)


def test_a_trajectory_without_poses_is_no_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_cameras(tmp_path, [0.5])
    write_ply(tmp_path / "map.ply", final_map())
    path = tmp_path / "trajectory.txt"
    words = [str(tmp_path / "map.ply"), str(tmp_path / "model"), "--trajectory", str(path)]
    for content, said in (
        ("1403636579763555584 1 0 0 0 0 0 1\n", "has a line 1 whose time, 1403636579763555584, is not in seconds"),
        ("1.5 1 0 0 0 0 0 0\n", "trajectory.txt has no poses"),
        ("", "trajectory.txt has no poses"),
    ):
        path.write_text(content)
        assert export.main(words) == 1
        assert said in capsys.readouterr().err
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize("name", ["cameras.bin", "cameras.txt", "rigs.bin"])
def test_another_programs_model_is_not_written_into(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    save_cameras(tmp_path, TIMES)
    write_ply(tmp_path / "map.ply", final_map())
    model = tmp_path / "project" / "sparse" / "0"
    model.mkdir(parents=True)
    (model / name).write_bytes(b"# Camera list with one line of data per camera:\n\xff")
    assert export.main([str(tmp_path / "map.ply"), str(tmp_path / "project")]) == 1
    assert f"has a model that is no export of a map ({name}): give another folder" in capsys.readouterr().err
    assert [path.name for path in model.iterdir()] == [name]
    assert (model / name).read_bytes() == b"# Camera list with one line of data per camera:\n\xff"


def test_an_earlier_export_is_replaced_with_its_images_and_no_other_images_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_cameras(tmp_path, TIMES)
    for k in range(len(TIMES)):
        write_image(tmp_path / "keyframes", 7 * k, np.zeros((*SIZE, 3), dtype=np.uint8))
    out = exported(tmp_path, "--images")
    before = (out / "sparse" / "0" / "images.txt").read_bytes()
    assert exported(tmp_path, "--images", "--scale", "2") == out
    assert (out / "sparse" / "0" / "images.txt").read_bytes() != before
    photo = tmp_path / "project" / "images" / "000007.png"
    photo.parent.mkdir(parents=True)
    photo.write_bytes(b"a user's")
    assert export.main([str(tmp_path / "map.ply"), str(tmp_path / "project"), "--images"]) == 1
    assert "has another 000007.png: give another folder" in capsys.readouterr().err
    assert photo.read_bytes() == b"a user's"
    assert not (tmp_path / "project" / "sparse").exists()


@pytest.mark.parametrize("at", ["an image", "a text file"])
def test_an_export_that_a_full_disk_cut_off_can_be_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], at: str
) -> None:
    save_cameras(tmp_path, TIMES)
    write_ply(tmp_path / "map.ply", final_map())
    for k in range(len(TIMES)):
        write_image(tmp_path / "keyframes", 7 * k, np.zeros((*SIZE, 3), dtype=np.uint8))
    words = [str(tmp_path / "map.ply"), str(tmp_path / "model"), "--images"]
    copy, write = shutil.copyfile, Path.write_text

    def copyfile(source: Path, target: Path) -> None:
        copy(source, target)
        if source.name == "000007.png":
            target.write_bytes(b"half of it")
            raise OSError(errno.ENOSPC, "No space left on device")

    def write_text(path: Path, text: str, **options: str) -> int:
        if "images" in path.name:
            write(path, "")
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, text, **options)

    with monkeypatch.context() as full:
        if at == "an image":
            full.setattr(shutil, "copyfile", copyfile)
        else:
            full.setattr(Path, "write_text", write_text)
        assert export.main(words) == 1
    assert "No space left" in capsys.readouterr().err
    assert export.main(words) == 0, capsys.readouterr().err
