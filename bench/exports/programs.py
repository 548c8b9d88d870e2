"""Programs that read an export outside of a browser: converters, libraries of meshes and models, a video decoder."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

import av
import numpy as np

from bench.exports.made import MESHES, SPLATS, Made, Opened, load, rendered
from mvsgs_core.export.render_path import resampled
from mvsgs_core.image_metrics import psnr
from mvsgs_core.named_modules import is_installed
from mvsgs_core.open3d_loader import open3d
from mvsgs_core.trajectory_file import read_trajectory

# pycolmap in a process of its own: it and torch bring different copies of what both are linked with
_READ_MODEL = """
import json, sys, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
poses = {image.name: image.cam_from_world().matrix().tolist() for image in model.images.values()}
print(json.dumps({"poses": poses, "points": len(model.points3D), "error": model.compute_mean_reprojection_error()}))
"""
# nerfstudio in a virtual environment of its own: it asks for versions of packages that this one does not have
_READ_TRANSFORMS = """
import json, sys
from pathlib import Path
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
config = NerfstudioDataParserConfig(data=Path(sys.argv[1]), orientation_method="none", center_method="none",
                                    auto_scale_poses=False, eval_mode="all", load_3D_points=False, downscale_factor=1)
found = config.setup().get_dataparser_outputs("train")
cameras = found.cameras
print(json.dumps({"count": len(found.image_filenames), "fx": cameras.fx.flatten().tolist(),
                  "cx": cameras.cx.flatten().tolist(), "poses": cameras.camera_to_worlds.tolist()}))
"""
SAME = 1e-5  # relative difference of poses that float32 makes


def by_programs(made: Made, node: Path | None, nerfstudio: Path | None) -> list[Opened]:
    """All but the browsers. node: the scratch folder of npm; nerfstudio: a Python that has it."""
    found = [_by_plyfile(made), *_by_open3d(made), *_by_trimesh(made), _by_pycolmap(made), _by_av(made)]
    if node is not None:
        found += [_attempt(name, "splat-transform", partial(_converted, made, node, name)) for name in SPLATS]
    if nerfstudio is not None:
        found.append(_attempt("transforms.json", "nerfstudio's data parser", lambda: _by_nerfstudio(made, nerfstudio)))
    return found


def _attempt(export: str, program: str, read: Callable[[], Opened]) -> Opened:
    try:
        return read()
    except (OSError, ValueError, RuntimeError, KeyError, ImportError, subprocess.SubprocessError) as error:
        said = error.stderr if isinstance(error, subprocess.CalledProcessError) and error.stderr else str(error)
        return Opened(export, program, note=" ".join(said.split())[-200:] or type(error).__name__)


def _by_plyfile(made: Made) -> Opened:
    def read() -> Opened:
        from plyfile import PlyData

        vertices = PlyData.read(str(made.folder / SPLATS[0]))["vertex"]
        return Opened(SPLATS[0], f"plyfile {version('plyfile')}", len(vertices))

    return _attempt(SPLATS[0], "plyfile", read)


def _by_open3d(made: Made) -> list[Opened]:
    def splats(name: str) -> Opened:
        cloud = open3d().t.io.read_point_cloud(str(made.folder / name))
        return Opened(name, f"open3d {version('open3d')}", len(cloud.point.positions))

    def mesh(name: str) -> Opened:
        found = open3d().io.read_triangle_mesh(str(made.folder / name))
        return Opened(name, f"open3d {version('open3d')}", len(found.triangles))

    return [_attempt(name, "open3d", partial(splats, name)) for name in SPLATS] + [
        _attempt(name, "open3d", partial(mesh, name)) for name in MESHES
    ]


def _by_trimesh(made: Made) -> list[Opened]:
    def read(name: str) -> Opened:
        import trimesh

        found = trimesh.load_scene(made.folder / name)
        return Opened(name, f"trimesh {version('trimesh')}", sum(len(part.faces) for part in found.geometry.values()))

    return [_attempt(name, "trimesh", partial(read, name)) for name in MESHES]


def _by_pycolmap(made: Made) -> Opened:
    def read() -> Opened:
        if not is_installed("pycolmap"):
            raise ImportError("not installed: pip install pycolmap")
        folder = next(path.parent for path in (made.folder / "colmap").rglob("cameras.*"))
        found = json.loads(_output(sys.executable, "-c", _READ_MODEL, str(folder)))
        named = {path.name: k for k, path in enumerate(sorted((made.folder / "keyframes").glob("*.png")))}
        for name, pose in found["poses"].items():
            _check_pose(np.linalg.inv(made.pose(named[Path(name).name]))[:3], np.array(pose), name)
        if not found["points"] or not found["error"] < 1.0:
            raise ValueError(f"{found['points']} points, reprojected {found['error']:.2g} pixels off")
        return Opened("colmap", f"pycolmap {version('pycolmap')}", len(found["poses"]))

    return _attempt("colmap", "pycolmap", read)


def _by_av(made: Made) -> Opened:
    """By FFmpeg's decoder."""

    def read() -> Opened:
        with av.open(str(made.folder / "flight.mp4")) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        _, poses = read_trajectory(made.folder / "trajectory.txt")
        path = resampled(poses, len(frames))
        lens = made.cameras.intrinsics[-1]
        pairs = ((frames[k], rendered(made.map, path[k], lens, made.size)) for k in range(0, len(frames), 7))
        found = [psnr(a[: made.size[0], : made.size[1]] / 255.0, b / 255.0) for a, b in pairs]
        return Opened("flight.mp4", f"PyAV {av.__version__} (FFmpeg)", len(frames), float(np.mean(found)))

    return _attempt("flight.mp4", "PyAV", read)


def _converted(made: Made, node: Path, name: str) -> Opened:
    """By PlayCanvas' converter to a .ply, which we render."""
    out = made.folder / f"{name}.converted.ply"
    program = node / "node_modules" / ".bin" / "splat-transform"
    said = _output(str(program), "--version").split()
    _output(str(program), "-q", "-w", str(made.folder / name), str(out))
    found, _ = load(out)
    renders = ((rendered(found, made.pose(v), made.intrinsics, made.size), made.render(v)) for v in made.views)
    same = float(np.mean([psnr(a / 255.0, b / 255.0) for a, b in renders]))
    return Opened(
        name, f"splat-transform {said[1].removeprefix('v') if len(said) > 1 else ''}", len(found.splats), same
    )


def _by_nerfstudio(made: Made, python: Path) -> Opened:
    found = json.loads(_output(str(python), "-c", _READ_TRANSFORMS, str(made.folder)).splitlines()[-1])
    order = np.argsort([pose[0][3] for pose in found["poses"]])
    ours = sorted(range(len(made.cameras)), key=lambda k: made.pose(k)[0, 3])
    for k, n in zip(ours, order):
        pose = made.pose(k) @ np.diag([1.0, -1.0, -1.0, 1.0])
        _check_pose(pose[:3], np.array(found["poses"][n]), f"keyframe {k}")
        fx, _, cx, _ = made.cameras.intrinsics[k]
        if not np.allclose([found["fx"][n], found["cx"][n]], [fx, cx + 0.5], rtol=1e-4):
            raise ValueError(f"keyframe {k} is read with another lens: {found['fx'][n]}, {found['cx'][n]}")
    said = _output(str(python), "-c", "from importlib.metadata import version; print(version('nerfstudio'))")
    return Opened("transforms.json", f"nerfstudio {said.strip()}", found["count"])


def _check_pose(ours: np.ndarray, read: np.ndarray, name: str) -> None:
    if not np.allclose(ours, read, rtol=SAME, atol=SAME * max(1.0, float(np.abs(ours).max()))):
        raise ValueError(f"{name} is read with another pose")


def _output(*command: str) -> str:
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=300)
    return done.stdout or done.stderr


__all__ = ["by_programs"]
