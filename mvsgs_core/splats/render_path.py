"""A saved map along a path as a video: `python -m mvsgs_core.splats.render_path MAP.ply TRAJECTORY.txt OUT.mp4`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from mvsgs_core import geometry
from mvsgs_core.evaluation.trajectory import read_tum
from mvsgs_core.splats.export import camera_arguments, intrinsics_of
from mvsgs_core.splats.export_ply import read_ply
from mvsgs_core.splats.rasterizer import rasterize
from mvsgs_core.splats.snapshot import Snapshot


def resampled(world_from_cam: np.ndarray, frames: int) -> np.ndarray:
    """(frames, 4, 4): poses at even steps along the list of poses (K, 4, 4), K >= 1, on screw motions in between."""
    positions = np.linspace(0.0, len(world_from_cam) - 1, frames)
    result = []
    for position in positions:
        before = min(int(position), max(0, len(world_from_cam) - 2))
        after = min(before + 1, len(world_from_cam) - 1)
        result.append(geometry.interpolate(world_from_cam[before], world_from_cam[after], position - before))
    return np.stack(result)


def frames_along(
    final: Snapshot, world_from_cam: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> Iterator[np.ndarray]:
    """Renders (H, W, 3) uint8 RGB of the map from each pose (K, 4, 4)."""
    for pose in world_from_cam:
        local = pose.copy()
        local[:3, 3] -= final.origin
        with torch.no_grad():
            color = rasterize(final.splats, local, intrinsics, size, density=final.density).color
        yield (color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()


def write_video(path: Path, frames: Iterator[np.ndarray], size: tuple[int, int], fps: float) -> int:
    """Writes frames (H, W, 3) uint8 RGB; returns their number. Raises OSError if the file cannot be written."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (size[1], size[0]))
    if not writer.isOpened():
        raise OSError(f"cannot write a video to {path}: use a name that ends in .mp4, in a folder that exists")
    count = 0
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        count += 1
    writer.release()
    return count


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m mvsgs_core.splats.render_path", description=__doc__)
    parser.add_argument("map", type=Path, help="map.ply")
    parser.add_argument("trajectory", type=Path, help="poses, TUM format: time tx ty tz qx qy qz qw")
    parser.add_argument("out", type=Path, help="video.mp4")
    parser.add_argument("--frames", type=int, help="of the video, spread over the path; default: one a pose")
    parser.add_argument("--fps", type=float, default=30.0)
    camera_arguments(parser)
    options = parser.parse_args(arguments)
    try:
        final = read_ply(options.map)
        _, poses = read_tum(options.trajectory)
        path = resampled(poses, options.frames or len(poses))
        size = (options.size[0], options.size[1])
        count = write_video(options.out, frames_along(final, path, intrinsics_of(options), size), size, options.fps)
    except (ValueError, OSError, ImportError) as error:
        print(f"render_path: {error}", file=sys.stderr)
        return 1
    print(f"{options.out}: {count} frames")
    return 0


if __name__ == "__main__":
    sys.exit(main())
