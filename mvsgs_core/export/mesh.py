"""A triangle mesh of the map: rendered depth fused into a truncated signed distance field (open3d)."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mvsgs_core import camera
from mvsgs_core.atomic_file import replacing
from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.glb import write_glb
from mvsgs_core.export.keyframe_render import near_plane
from mvsgs_core.export.mesh_text import write_obj, write_off
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.open3d_loader import open3d
from mvsgs_core.rasterizer.rasterize import Render

SUFFIXES = (".glb", ".ply", ".obj", ".off", ".stl")
GLANCE = 4  # times smaller than the images: the renders that the size of a voxel is measured on
UNTOUCHED = "No block is touched"  # as open3d says it
OFF_BY = 0.01  # of a voxel's edge, by which what is written may be; a tenth where the format has no way out


def write_mesh(
    path: Path, final: Snapshot, cameras: Cameras, voxel: float = 0.01, min_opacity: float = 0.5
) -> tuple[int, int]:
    """Renders depth from the cameras, fuses it and replaces `path` in one step by a mesh with colors: .glb, .ply, .obj,
    .off or .stl, which has none.

    voxel: edge in median depths. Pixels of an opacity below `min_opacity` say nothing. Positions are world coordinates,
    in the axes of map.ply except for .glb, whose axes are defined. Returns the numbers of vertices and triangles.
    Raises ValueError for another suffix, a voxel that is none, and where no camera sees the map, the depth makes no
    surface, or .stl would round it away.
    """
    if not 0.0 < voxel < math.inf:
        raise ValueError(f"a voxel of {voxel:g} median depths: its edge must be above 0, such as 0.01")
    if path.suffix not in SUFFIXES:
        raise ValueError(f"no mesh is written as {path.suffix!r}: there are {', '.join(SUFFIXES)}")
    o3d = open3d()
    edge = voxel * _median_depth(final, cameras, min_opacity)
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(o3d.core.float32, o3d.core.float32, o3d.core.float32),
        attr_channels=((1), (1), (3)),
        voxel_size=edge,
        block_resolution=16,
        block_count=10000,
    )
    truncation = 6.0  # voxels, of the distance field
    for k, pose in enumerate(cameras.world_from_cam):
        render = _seen(final, cameras, k, min_opacity)
        if not (render.depth > 0).any():
            continue
        # what lies as far as the bound is left out, and so would be the field behind a view's farthest surface
        beyond = float(render.depth.max()) + (truncation + 1.0) * edge
        matrix = o3d.core.Tensor(camera.matrix(cameras.intrinsics[k]))
        extrinsic = o3d.core.Tensor(np.linalg.inv(final.relative_pose(pose)))
        depth_image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(render.depth.numpy())))
        color_image = o3d.t.geometry.Image(o3d.core.Tensor(render.color.clamp(0.0, 1.0).contiguous().numpy()))
        try:
            blocks = grid.compute_unique_block_coordinates(depth_image, matrix, extrinsic, 1.0, beyond, truncation)
        except RuntimeError as error:
            if UNTOUCHED in str(error):  # open3d looks at every so many pixels, of which none sees the map
                continue
            raise
        grid.integrate(blocks, depth_image, color_image, matrix, matrix, extrinsic, 1.0, beyond, truncation)
    mesh = grid.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
    if not len(mesh.triangles):
        raise ValueError("the depth makes no surface: try a larger --voxel")
    vertices, triangles, colors = map(np.asarray, (mesh.vertices, mesh.triangles, mesh.vertex_colors))
    world = vertices + final.origin
    with replacing(path, sync=False) as aside:
        match path.suffix:
            case ".glb":
                write_glb(aside, vertices, triangles, colors, final.origin)
            case ".ply":
                write_mesh_ply(aside, world, triangles, colors, OFF_BY * edge)
            case ".obj":
                write_obj(aside, world, triangles, colors, np.asarray(mesh.vertex_normals))
            case ".off":
                write_off(aside, world, triangles, colors)
            case ".stl":
                write_stl(aside, world, triangles, 0.1 * edge)
    return len(vertices), len(triangles)


def _seen(final: Snapshot, cameras: Cameras, k: int, min_opacity: float, smaller: int = 1) -> Render:
    """From camera k, at so many times less than its size; depth 0 where little is seen."""
    full = (int(cameras.sizes[k, 0]), int(cameras.sizes[k, 1]))
    size = (max(1, full[0] // smaller), max(1, full[1] // smaller))
    intrinsics, pose = camera.scale_intrinsics(cameras.intrinsics[k], full, size), cameras.world_from_cam[k]
    render = final.render(pose, intrinsics, size, near=near_plane(final, pose))
    return replace(render, depth=torch.where(render.opacity >= min_opacity, render.depth, 0.0))


def _median_depth(final: Snapshot, cameras: Cameras, min_opacity: float) -> float:
    """Of what the cameras see, at a glance: all at their full size would fill the memory."""
    depths = [_seen(final, cameras, k, min_opacity, GLANCE).depth.numpy() for k in range(len(cameras))]
    seen = [depth[depth > 0] for depth in depths if (depth > 0).any()]
    if not seen:
        raise ValueError("no camera sees the map: nothing to fuse; check that the poses are those of this map")
    return float(np.median(np.concatenate(seen)))


def write_mesh_ply(
    path: Path, vertices: np.ndarray, triangles: np.ndarray, colors: np.ndarray, tolerance: float
) -> None:
    """Vertices (V, 3), triangles (T, 3) of their indices, colors (V, 3) in [0, 1]; binary little endian.

    Positions are float32, as three.js draws no others, unless that is off by more than `tolerance`: then float64.
    """
    short = _rounding(vertices) <= tolerance
    kind, name = ("<f4", "float") if short else ("<f8", "double")
    points = np.zeros(len(vertices), dtype=[("position", kind, 3), ("color", "u1", 3)])
    points["position"], points["color"] = vertices, np.clip(np.round(255.0 * colors), 0, 255)
    faces = np.zeros(len(triangles), dtype=[("corners", "u1"), ("vertex", "<i4", 3)])
    faces["corners"], faces["vertex"] = 3, triangles
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(points)}",
        *(f"property {name} {axis}" for axis in "xyz"), *(f"property uchar {c}" for c in ("red", "green", "blue")),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n",
    ]  # fmt: skip
    path.write_bytes("\n".join(header).encode() + points.tobytes() + faces.tobytes())


def write_stl(path: Path, vertices: np.ndarray, triangles: np.ndarray, tolerance: float) -> None:
    """Vertices (V, 3), triangles (T, 3) of their indices; binary. Raises ValueError where the format's float32 is off
    by more than `tolerance`."""
    if _rounding(vertices) > tolerance:
        raise ValueError(
            f".stl holds numbers of seven digits, too few for coordinates up to {np.abs(vertices).max():.7g}: "
            "write .obj, .off, .glb, or .ply with --mesh"
        )
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    faces = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    faces["normal"], faces["corners"] = normals / np.where(lengths > 0, lengths, 1.0), corners
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + faces.tobytes())


def _rounding(vertices: np.ndarray) -> float:
    """By how much float32 is off."""
    return float(np.abs(vertices.astype(np.float32) - vertices).max(initial=0.0))
