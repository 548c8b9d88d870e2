"""Meshes as text, .obj and .off, with twelve digits a coordinate: a hundredth of a millimetre at the size of UTM's."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_obj(path: Path, vertices: np.ndarray, triangles: np.ndarray, colors: np.ndarray, normals: np.ndarray) -> None:
    """Vertices (V, 3), triangles (T, 3) of their indices, colors (V, 3) in [0, 1] behind the positions, as most read
    them, and normals (V, 3)."""
    with path.open("w", encoding="ascii") as file:
        np.savetxt(file, np.hstack([vertices, colors]), "v %.12g %.12g %.12g %.4g %.4g %.4g")
        np.savetxt(file, normals, "vn %.6g %.6g %.6g")
        np.savetxt(file, np.repeat(triangles + 1, 2, axis=1), "f %d//%d %d//%d %d//%d")


def write_off(path: Path, vertices: np.ndarray, triangles: np.ndarray, colors: np.ndarray) -> None:
    """Vertices (V, 3), triangles (T, 3) of their indices, colors (V, 3) in [0, 1]."""
    levels = np.clip(np.round(255.0 * colors), 0, 255)
    with path.open("w", encoding="ascii") as file:
        file.write(f"COFF\n{len(vertices)} {len(triangles)} 0\n")
        np.savetxt(file, np.hstack([vertices, levels]), "%.12g %.12g %.12g %d %d %d 255")
        np.savetxt(file, triangles, "3 %d %d %d")


__all__ = ["write_obj", "write_off"]
