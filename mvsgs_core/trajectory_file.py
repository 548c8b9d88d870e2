"""Trajectories as the TUM benchmark writes them: a line `timestamp tx ty tz qx qy qz qw` a pose, camera to world."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.bad_file import BadFileError, reading

LATEST = 1e12  # seconds, or units from the origin: more is damage


def write_trajectory(file: Path, timestamps: np.ndarray, world_from_cam: np.ndarray) -> None:
    """Writes timestamps (N,), seconds, and poses (N, 4, 4). Raises OSError."""
    quaternions = geometry.quaternion_from_rotation(world_from_cam[:, :3, :3])
    with file.open("w") as out:
        out.write("# timestamp tx ty tz qx qy qz qw (camera to world)\n")
        for t, pose, (w, x, y, z) in zip(timestamps, world_from_cam, quaternions):
            position = " ".join(f"{v:.15g}" for v in pose[:3, 3])  # a micrometre at the size of UTM's coordinates, too
            out.write(f"{t:.6f} {position} " + " ".join(f"{v:.9g}" for v in (x, y, z, w)) + "\n")


def read_trajectory(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Timestamps (N,) and world_from_cam (N, 4, 4) float64, sorted by time. Raises BadFileError for a malformed line,
    and where half of the times or more are in other units than seconds.

    Rows that are no pose, or at no time, are left out: motion capture writes zeros where it lost its markers.
    """
    rows: list[list[float]] = []
    count, late = 0, []  # rows, and those at no time in seconds
    for number, line in enumerate(file.read_text(encoding="utf-8-sig", errors="replace").splitlines(), start=1):
        text = line.split("#")[0].replace(",", " ").split()
        if not text:
            continue
        with reading(file, f"has a line {number} that is not `timestamp tx ty tz qx qy qz qw`, {line[:200]!r}"):
            row = [float(v) for v in text]
            if len(row) != 8:
                raise ValueError(f"{len(row)} numbers")
        count += 1
        if LATEST <= abs(row[0]) < np.inf:
            late.append(f"{file} has a line {number} whose time, {text[0]}, is not in seconds")
        if np.all(np.abs(row) < LATEST) and np.linalg.norm(row[4:]) > 0.5:
            rows.append(row)
    if late and 2 * len(late) >= count:
        raise BadFileError(
            f"{late[0]}: divide times by 1e9 where they are nanoseconds, by 1e6 or 1e3 where they are micro- or "
            "milliseconds"
        )
    data = np.array(rows, dtype=np.float64).reshape(-1, 8)
    data = data[np.argsort(data[:, 0], kind="stable")]
    poses = np.tile(np.eye(4), (len(data), 1, 1))
    if len(data):
        poses[:, :3, :3] = geometry.rotation_from_quaternion(data[:, [7, 4, 5, 6]])
        poses[:, :3, 3] = data[:, 1:4]
    return data[:, 0], poses
