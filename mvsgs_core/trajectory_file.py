"""Trajectories as the TUM benchmark writes them: a line `timestamp tx ty tz qx qy qz qw` a pose, camera to world."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.bad_file import reading

LATEST = 1e12  # seconds, or units from the origin: more is damage


def write_trajectory(file: Path, timestamps: np.ndarray, world_from_cam: np.ndarray) -> None:
    """Writes timestamps (N,), seconds, and poses (N, 4, 4). Raises OSError."""
    quaternions = geometry.quaternion_from_rotation(world_from_cam[:, :3, :3])
    with file.open("w") as out:
        out.write("# timestamp tx ty tz qx qy qz qw (camera to world)\n")
        for t, pose, (w, x, y, z) in zip(timestamps, world_from_cam, quaternions):
            values = (*pose[:3, 3], x, y, z, w)
            out.write(f"{t:.6f} " + " ".join(f"{v:.9g}" for v in values) + "\n")


def read_trajectory(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Timestamps (N,) and world_from_cam (N, 4, 4) float64, sorted by time. Raises BadFileError for a malformed line.

    Rows that are no pose are left out: motion capture writes zeros where it lost its markers.
    """
    rows = []
    for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        text = line.split("#")[0].replace(",", " ").split()
        if not text:
            continue
        with reading(file, f"has a line {number} that is not `timestamp tx ty tz qx qy qz qw`, {line[:200]!r}"):
            row = [float(v) for v in text]
            if len(row) != 8:
                raise ValueError(f"{len(row)} numbers")
        if np.all(np.abs(row) < LATEST) and np.linalg.norm(row[4:]) > 0.5:
            rows.append(row)
    data = np.array(rows, dtype=np.float64).reshape(-1, 8)
    data = data[np.argsort(data[:, 0], kind="stable")]
    poses = np.tile(np.eye(4), (len(data), 1, 1))
    if len(data):
        poses[:, :3, :3] = geometry.rotation_from_quaternion(data[:, [7, 4, 5, 6]])
        poses[:, :3, 3] = data[:, 1:4]
    return data[:, 0], poses
