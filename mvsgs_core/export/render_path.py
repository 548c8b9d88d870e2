"""A saved map along a path as a video: `python -m mvsgs_core.export.render_path MAP.ply TRAJECTORY.txt OUT.mp4`.

The camera is that of the newest keyframe in the cameras.json beside the map.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.export.command_line import input_arguments, lens, read_map, read_path, run
from mvsgs_core.export.keyframe_render import near_plane
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.rasterizer.interface import as_bytes
from mvsgs_core.video_file import write_video


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
        color = final.render(pose, intrinsics, size, near=near_plane(final, pose)).color
        yield as_bytes(color)


def render_path(options: argparse.Namespace) -> str:
    """Does what the command line asks; returns one line that says what was written. Raises ValueError, OSError."""
    if not options.trajectory.is_file():
        raise FileNotFoundError(f"{options.trajectory} is missing: a path is poses, as in a run's trajectory.txt")
    final, left_out = read_map(options)
    _, poses = read_path(options.trajectory)
    path = resampled(poses, options.frames or len(poses))
    intrinsics, size = lens(options)
    count = write_video(options.out, frames_along(final, path, intrinsics, size), size, options.fps)
    return f"{options.out}: {count} frames{left_out}"


def main(arguments: list[str] | None = None, prog: str = "python -m mvsgs_core.export.render_path") -> int:
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    input_arguments(parser)
    parser.add_argument("trajectory", type=Path, help="poses, TUM format: time tx ty tz qx qy qz qw")
    parser.add_argument("out", type=Path, help="video.mp4")
    parser.add_argument("--frames", type=int, help="of the video, spread over the path; default: one a pose")
    parser.add_argument("--fps", type=float, default=30.0)
    return run(parser, arguments, render_path)


if __name__ == "__main__":
    sys.exit(main())
