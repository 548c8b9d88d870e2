"""OpenSplat (pierotofy/OpenSplat), a trainer that shares no code with ours, by its binary: COLMAP's model in, .ply out.

It gets every frame that is not held out, at our size, with COLMAP's poses and points, and trains on the CPU. Its map is
rendered by our rasterizer at COLMAP's poses of the held-out frames on which ours is scored. The CPU path of some
versions blends splats in another order than front to back; the map of such a binary looks right in its own renderer
only.
"""

from __future__ import annotations

import os
import resource
import shutil
import struct
import subprocess
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from bench.baselines.colmap_poses import Model
from bench.baselines.offline import Trained, score
from bench.baselines.ours import Ours
from mvsgs_core import geometry
from mvsgs_core.export.ply import read_ply

PROBE = 30  # iterations by which the time of one is measured
MANY_TIMES = (4, 16)  # as many iterations as at equal time, besides
PINHOLE = 1  # COLMAP's number of that camera model


def write_project(folder: Path, ours: Ours, model: Model, frames: Sequence[int]) -> None:
    """`folder`/images and a binary COLMAP model beside it, of these frames, with all points and no tracks."""
    images = folder / "images"
    shutil.rmtree(images, ignore_errors=True)
    images.mkdir(parents=True)
    poses = dict(zip(model.index.tolist(), model.world_from_cam))
    cameras, views = struct.pack("<Q", len(frames)), struct.pack("<Q", len(frames))
    for number, index in enumerate(frames, start=1):
        frame, name = ours.frames[index], f"{index:06d}.png"
        if not cv2.imwrite(str(images / name), frame.image[..., ::-1]):
            raise OSError(f"could not write {images / name}")
        height, width = frame.image.shape[:2]
        fx, fy, cx, cy = (float(value) for value in frame.intrinsics)
        cameras += struct.pack("<IiQQ4d", number, PINHOLE, width, height, fx, fy, cx + 0.5, cy + 0.5)
        cam_from_world = geometry.inverse(poses[index])
        pose = [*geometry.quaternion_from_rotation(cam_from_world[:3, :3]), *cam_from_world[:3, 3]]
        views += struct.pack("<I7dI", number, *pose, number) + name.encode() + b"\0" + struct.pack("<Q", 0)
    points = struct.pack("<Q", len(model.points))
    for number, (xyz, rgb) in enumerate(zip(model.points, model.colors), start=1):
        points += struct.pack("<Q3d3BdQ", number, *xyz, *rgb.tolist(), 0.0, 0)
    for name, content in (("cameras", cameras), ("images", views), ("points3D", points)):
        (folder / f"{name}.bin").write_bytes(content)


def run(binary: Path, project: Path, iterations: int, threads: int) -> tuple[Path, float]:
    """Its map, and the processor seconds it took, loading included. Raises RuntimeError where it fails."""
    output = project / f"{iterations}.ply"
    output.unlink(missing_ok=True)
    command = [
        str(binary), str(project), "-n", str(iterations), "-o", str(output), "-d", "1", "--num-downscales", "1",
        "--resolution-schedule", str(max(1, iterations // 4)), "--keep-crs", "--cpu",
    ]  # fmt: skip
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    done = subprocess.run(command, cwd=project, capture_output=True, text=True, check=False, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    (project / f"{iterations}.log").write_text(done.stdout + done.stderr)
    if done.returncode or not output.exists():
        last = (done.stderr.strip().splitlines() or ["nothing said"])[-1]
        raise RuntimeError(f"{binary} ended with code {done.returncode}: {last}")
    return output, (after.ru_utime + after.ru_stime) - (before.ru_utime + before.ru_stime)


def train(binary: Path, ours: Ours, model: Model, folder: Path, threads: int) -> list[Trained]:
    """As many iterations as fit into our processor time, then `MANY_TIMES` as many. Raises RuntimeError, OSError."""
    known = set(model.index.tolist())
    write_project(folder, ours, model, [i for i in ours.not_held_out if i in known])
    _, probed = run(binary, folder, PROBE, threads)
    equal = max(PROBE, round(PROBE * ours.optimization / max(probed, 1e-3)))
    results = []
    for times in (1, *MANY_TIMES):
        output, seconds = run(binary, folder, times * equal, threads)
        psnr, ssim, splats = score_map(output, ours, model)
        results.append(Trained(seconds, psnr, ssim, splats, times * equal, times * ours.optimization))
    return results


def score_map(file: Path, ours: Ours, model: Model) -> tuple[float, float, int]:
    """Held-out PSNR and SSIM of a .ply in COLMAP's frame, and its splats."""
    final = read_ply(file)
    poses = dict(zip(model.index.tolist(), model.world_from_cam))

    def render(index: int) -> np.ndarray:
        frame = ours.frames[index]
        color = final.render(poses[index], frame.intrinsics, frame.image.shape[:2]).color
        return np.asarray(color.clamp(0, 1).numpy())

    psnr, ssim = score((ours.frames[i], render(i)) for i in ours.scored if i in poses)
    return psnr, ssim, len(final.splats)
